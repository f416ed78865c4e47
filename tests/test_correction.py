"""Alignment and calibration together: what is not known exactly goes into the sigma."""

from __future__ import annotations

from math import hypot, nan

import numpy as np
import pytest
import xarray as xr

from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.config import Align
from magbridge.correction import Correction
from magbridge.records import Quality, Reading
from magbridge.rows import correct_rows

START, SECOND = 1_780_000_000_000_000, 1_000_000
FIELD = (20_000.0, -1_000.0, 45_000.0)
LINE, T_X = 3_000.0, 9 + 6
"""nT along x that the mass makes at 1 in, and the coefficient's place: monomial 1, slot 6."""


@pytest.fixture
def calibration() -> Calibration:
    return follows("battpos", "in")


def follows(channel: str, unit: str) -> Calibration:
    return Calibration(
        parameters=(Parameter(channel, unit, -1.0, 1.0, 0.0, 1.0),),
        terms=(Polynomial(exponents=full_order(1, 1)),),
        coefficients=np.where(np.arange(18) == T_X, LINE, 0.0),
        covariance=np.eye(18) * 1e-6,
        noise=Noise(1.0),
        reference=Reference(50_000.0),
        method="auto",
    )


def total(position: float) -> float:
    return hypot(FIELD[0] - LINE * position, *FIELD[1:])


def test_a_position_never_told_may_be_anywhere(calibration: Calibration) -> None:
    _, corrected = Correction(calibration).reading(Reading(FIELD), START)
    assert corrected.quality & Quality.STALE_TELEMETRY
    assert corrected.total_field == pytest.approx(total(0.0))
    half = 0.5 * abs(total(1.0) - total(-1.0))
    assert corrected.total_field_sigma == pytest.approx(hypot(1.0, half), rel=1e-3)
    assert min(corrected.field_sigma) >= half


def test_a_mass_in_motion_was_somewhere_between(calibration: Calibration) -> None:
    correction = Correction(calibration)
    for k, position in enumerate((0.2, 0.2, 0.5)):
        correction.telemetry("battpos", position, START + k * SECOND)
    _, corrected = correction.reading(Reading(FIELD), START + 2 * SECOND)
    assert corrected.quality & Quality.MOVING
    assert corrected.total_field == pytest.approx(total(0.5))
    half = 0.5 * abs(total(0.5) - total(0.2))
    assert corrected.total_field_sigma == pytest.approx(hypot(1.0, half), rel=1e-3)


def test_a_mass_at_rest_adds_nothing(calibration: Calibration) -> None:
    correction = Correction(calibration, Align(settle_time=1.0))
    for k in range(3):
        correction.telemetry("battpos", 0.2, START + k * SECOND)
    _, corrected = correction.reading(Reading(FIELD, temperature=nan), START + 2 * SECOND)
    assert corrected.total_field_sigma == pytest.approx(1.0, rel=1e-3)
    assert corrected.quality == Quality.NO_BORESIGHT


def test_not_every_reading_need_have_a_temperature() -> None:
    correction = Correction(follows("sensor_temperature", "degC"))
    for k, temperature in enumerate((0.3, nan)):
        _, corrected = correction.reading(Reading(FIELD, temperature=temperature), START + k * SECOND)
        assert not corrected.quality & Quality.STALE_TELEMETRY
        assert corrected.total_field == pytest.approx(total(0.3))
    _, corrected = correction.reading(Reading(FIELD, temperature=nan), START + 60 * SECOND)
    assert corrected.quality & Quality.STALE_TELEMETRY


def test_the_temperature_may_be_in_rows_of_another_log() -> None:
    measured = np.arange(6) % 2 == 1
    columns = {
        f"mag_{axis}": np.where(measured, value, nan) for axis, value in zip("xyz", FIELD, strict=True)
    }
    columns["sensor_temperature"] = np.where(measured, nan, 0.3)
    rows = xr.Dataset(
        {name: ("time", column) for name, column in columns.items()}, coords={"time": 1.78e9 + np.arange(6.0)}
    )
    corrected = correct_rows(Correction(follows("sensor_temperature", "degC")), rows)
    quality = corrected["quality"].to_numpy().astype(int)[measured]
    assert not (quality & Quality.STALE_TELEMETRY).any()
    np.testing.assert_allclose(corrected["total_field"][measured], total(0.3))
