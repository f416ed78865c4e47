"""Runs left out of a fit one at a time, simulated and of a Seaglider's own magnetometer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gliders import Gliders
from seaglider import COUNT, leave_runs_out

from magbridge.calibration.fitting.observe import observations
from magbridge.errors import CalibrationError
from magbridge.logs import read


@pytest.mark.real
def test_seaglider_dives_left_out(real_data: Path) -> None:
    """Nominal stands at the sensor's quantisation; moving masses take a few per cent of it, if anything."""
    deployment = read(sorted((real_data / "seaglider_sg167").glob("*.nc")))
    nominal = leave_runs_out(observations(deployment, []), "nominal")
    moving = leave_runs_out(observations(deployment, ["vbdCC"]), "auto", 2)
    assert len(nominal.by_run()) == 5
    assert nominal.rms / COUNT == pytest.approx(0.96, abs=0.03)
    assert 0.85 < moving.rms / nominal.rms < 1.02
    # each sigma counts the level of the rock, which the IGRF does not tell: 145 nT beside 88
    assert 0.4 < np.nanstd(moving.standardised) < 1.0


def test_two_runs_at_least(glider: Gliders) -> None:
    runs = glider(0, 2).runs
    with pytest.raises(CalibrationError, match="leaving runs out: found 1"):
        leave_runs_out(runs.part(np.asarray(runs.runs) == 0), "nominal")


def test_left_out_runs_are_near_the_floor(glider: Gliders) -> None:
    """Leaving out inner runs (the outermost would be extrapolation) costs a little; sigma knows how much."""
    runs = glider(0, 1).runs
    found = leave_runs_out(runs.part(np.asarray(runs.runs) < 4), "auto", 1)
    inner = np.asarray(found.runs) < 4
    assert np.isfinite(found.error[inner]).all()
    assert np.nanmedian(np.abs(found.standardised)) < 1.5
