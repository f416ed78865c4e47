"""A log whose end is not the vehicle's flight: a crash turns the field over, and must not turn the fit."""

from __future__ import annotations

import numpy as np
import pytest
from gliders import codes
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.solve import flown
from magbridge.calibration.fitting.uncertainty import in_sensor_units

FIELD = np.array([21_000.0, 2_000.0, 42_000.0])


def drone(crash: int, n: int = 500) -> Observations:
    """All attitudes, 3 % of soft iron, 200 nT of noise; the last `crash` samples are near other iron."""
    rng, other = np.random.default_rng(1), np.random.default_rng(2)
    body = Rotation.random(n, random_state=1).inv().apply(FIELD)
    body[n - crash :] = body[-1] + other.normal(0.0, 20_000.0, 3) + other.normal(0.0, 2_000.0, (crash, 3))
    field = body @ (np.eye(3) + rng.normal(0.0, 0.03, (3, 3))) + rng.normal(0.0, 3_000.0, 3)
    field += rng.normal(0.0, 200.0, (n, 3))
    return Observations(
        field, np.full(n, np.linalg.norm(FIELD)), np.empty((n, 0)), time=np.arange(n, dtype=float) * 0.1
    )


def test_a_crash_is_left_out_and_reported() -> None:
    found = fit(drone(60))
    error, standardised = in_sensor_units(found.calibration, drone(0))
    assert found.details["ends"] == pytest.approx(60, abs=2)
    assert "ends_left_out" in codes(found)
    assert np.sqrt(np.mean(error**2)) < 220.0
    assert 0.8 < np.std(standardised) < 1.25
    assert "ends" not in fit(drone(0)).details


def test_scattered_outliers_and_halves_are_not_ends() -> None:
    rng = np.random.default_rng(2)
    residual = rng.normal(size=400)
    residual[rng.choice(400, 40, replace=False)] = 50.0
    assert flown(residual).sum() >= 395
    residual[:230] = 50.0  # most of the log: which part is the flight?
    assert flown(residual).all()
