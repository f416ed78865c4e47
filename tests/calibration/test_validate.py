"""Runs held out of a fit one at a time, simulated and of a Seaglider's own magnetometer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gliders import Gliders
from measured import hold_runs_out

from magbridge.calibration.fitting.observe import observations
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.logs import read

COUNT_NT = 100.0
"""A step of the Seaglider's magnetometer."""


@pytest.mark.real
def test_seaglider_dives_held_out(real_data: Path) -> None:
    """The nominal fit is at the sensor's quantisation; moving masses take a few per cent of it."""
    dives = sorted((real_data / "seaglider_sg167").glob("*.nc"))[:3]
    deployment = read(dives).isel(time=slice(None, None, 2))
    nominal, _ = hold_runs_out(observations(deployment, []), "nominal")
    moving, normalised = hold_runs_out(observations(deployment, ["vbdCC"]), "auto", 2)
    nominal, moving = (error[np.isfinite(error)] for error in (nominal, moving))
    assert rms(nominal) / COUNT_NT == pytest.approx(1.0, abs=0.03)
    assert 0.85 < rms(moving) / rms(nominal) < 1.02
    # each sigma includes the bias of the IGRF: 145 nT, in addition to 88
    assert 0.4 < np.nanstd(normalised) < 1.0


def test_two_runs_at_least(glider: Gliders) -> None:
    runs = glider(0, 2).runs
    with pytest.raises(CalibrationError, match="expected 2 runs"):
        hold_runs_out(runs.part(np.asarray(runs.runs) == 0), "nominal")


def test_held_out_runs_are_near_the_floor(glider: Gliders) -> None:
    """Holding out inner runs (the outermost would be extrapolation) costs a little; sigma includes it."""
    runs = glider(0, 1).runs
    few = runs.part(np.asarray(runs.runs) < 4)
    error, normalised = hold_runs_out(few, "auto", 1)
    assert np.isfinite(error[np.asarray(few.runs) < 4]).all()
    assert np.nanmedian(np.abs(normalised)) < 1.5
