"""The twin of the Bonne Bay trials: flown, calibrated before and after, and scored as in the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.residual import rms
from magbridge.columns import CHANNEL_TIMES, CHANNELS
from magbridge.errors import CalibrationError
from magbridge.field.grid import AnomalyGrid
from magbridge.field.reference import reference_field
from sitl.dataset import at_rest, corrected, segments
from sitl.scenario import load
from sitl.twin import Twin

__all__ = ["METHODS", "PAPER", "TRIALS", "Trials", "fly", "measure"]

MASSES = ("battpos", "ballast")
METHODS: dict[str, dict[str, Any]] = {
    "nominal": {"axes_fixed": True, "equal_xz": True},
    "cubic": {},
    "auto": {},
}
"""The paper's two, with its constraints, and ours."""
TRIALS = ("trial 1", "trial 2")
PAPER = {
    ("trial 1", "nominal"): (153, 207),
    ("trial 2", "nominal"): (145, 136),
    ("trial 1", "cubic"): (29, 124),
    ("trial 2", "cubic"): (17, 69),
}
"""nT RMS on the calibration runs and on the survey (section 4 and Table 2)."""


@dataclass(frozen=True)
class Trials:
    """A simulated deployment, and each method's result on it.

    Attributes
    ----------
    parts : dict of Dataset
        Trial 1, survey, trial 2.
    corrected : dict of array (n,)
        By (part, trial of the coefficients, method), nT.
    failed : dict of str
        Reason of the failure, by (trial, method).
    scales : dict of (float, float)
        By (trial, method), the smallest and the largest scale of A on its runs: a fit can lower its
        residual by shrinking them.
    anomaly : AnomalyGrid
        The map used as reference of the fit.
    """

    parts: dict[str, xr.Dataset]
    corrected: dict[tuple[str, str, str], FloatArray]
    failed: dict[tuple[str, str], str]
    scales: dict[tuple[str, str], tuple[float, float]]
    anomaly: AnomalyGrid

    def error(self, part: str, trial: str, method: str, against: str = "reference_field") -> FloatArray:
        """Return the error of `method` with the coefficients of `trial`, (n,) nT; NaN where it failed."""
        known = self.parts[part][against].to_numpy()
        found: FloatArray = self.corrected.get((part, trial, method), np.full(known.shape, np.nan))
        return np.asarray(found - known)

    def rms(self, part: str, trial: str, method: str) -> float:
        """Return the RMS of :meth:`error` against the reference, nT."""
        return rms(self.error(part, trial, method))


def measure(twin: Twin, *, at_depth: bool = False) -> dict[str, xr.Dataset]:
    """Fly trial 1, survey and trial 2; return each on one time base, without the samples of masses in motion.

    With `at_depth` the reference is the map continued down to the glider, as ``--grid`` does it; else the
    scenario's: the map at the altitude of its survey, as in the paper.
    """
    track = twin.fly()
    instrument = twin.scenario.instrument
    when = np.arange(0.0, track.elapsed[-1] - max(instrument.channel_delay), 1 / instrument.rate)
    parts = segments(at_rest(one_time_base(twin.measure(track, when)), MASSES))
    if not at_depth:
        return parts
    grid = twin.anomaly_map()
    for name, part in parts.items():
        known = reference_field(part.drop_vars("reference_field"), grid)
        parts[name] = part.assign(reference_field=("time", known))
    return parts


def fly(seed: int, methods: Sequence[str] = tuple(METHODS), *, at_depth: bool = False) -> Trials:
    """Simulate the deployment; calibrate it both times with each method against :func:`measure`'s field."""
    twin = Twin.draw(load("bonne_bay"), seed)
    parts = measure(twin, at_depth=at_depth)
    total, failed, scales = {}, {}, {}
    for trial, method in product(TRIALS, methods):
        used = () if method == "nominal" else MASSES
        try:
            fitted = fit(observations(parts[trial], used), method, **METHODS[method])
        except CalibrationError as error:
            failed[trial, method] = str(error)
            continue
        scales[trial, method] = fitted.scales
        for part in (trial, "survey"):
            total[part, trial, method] = corrected(parts[part], fitted.calibration).total
    return Trials(parts, total, failed, scales, twin.anomaly_map())


def one_time_base(deployment: xr.Dataset) -> xr.Dataset:
    """Interpolate the channels to the time of their row, as the paper does."""
    time = deployment["time"].to_numpy()
    moved = {n: ("time", np.interp(time, deployment[f"mag_time_{n[-1]}"], deployment[n])) for n in CHANNELS}
    return deployment.assign(moved).drop_vars(CHANNEL_TIMES)
