"""The simulated deployments of the demo and their calibrations, each made once in a process."""

from functools import cache
from typing import NamedTuple

import xarray as xr

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import unfiltered
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from sitl import load, simulate
from sitl.dataset import segments

MASSES = ("battpos", "ballast")


class Demo(NamedTuple):
    """Calibration runs and survey of a simulated deployment, and the calibration from the runs; read only."""

    calibration: Calibration
    survey: xr.Dataset
    runs: xr.Dataset


def demo_log(seed: int = 5) -> xr.Dataset:
    """Return a copy of the whole simulated deployment."""
    return _simulated(seed).copy(deep=True)


@cache
def demo(seed: int = 2) -> Demo:
    """Return a simulated deployment and the calibration from its runs, without the instrument's filter."""
    parts = segments(_simulated(seed))
    learned = unfiltered(observations(parts["calibration"], MASSES), load("demo").instrument.corner)
    return Demo(fit(learned, "auto").calibration, parts["survey"], parts["calibration"])


@cache
def _simulated(seed: int) -> xr.Dataset:
    return simulate(load("demo"), seed)
