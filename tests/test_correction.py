"""Alignment and calibration together: the sigma includes every uncertainty."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, nan

import numpy as np
import pytest
import xarray as xr
from small import polynomial

from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import CalibratedRange, Calibration, Parameter, Reference, identity
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
    coefficients = np.where(np.arange(18) == T_X, LINE, 0.0)
    return polynomial(coefficients, Parameter(channel, unit, -1.0, 1.0, 0.0, 1.0), variance=1e-6)


def total(position: float) -> float:
    return hypot(FIELD[0] - LINE * position, *FIELD[1:])


def test_a_position_that_was_never_sent_may_be_anywhere(calibration: Calibration) -> None:
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


@pytest.mark.parametrize(
    ("depth", "factor"), [(0.0, 1.0), (181.0, 1.0), (362.0, hypot(1.0, 2.0)), (nan, 1.0)]
)
def test_sigma_grows_with_the_depth_beyond_the_calibrated_range(
    calibration: Calibration, depth: float, factor: float
) -> None:
    seen = replace(calibration, conditions=(CalibratedRange("depth", 0.0, 181.0),))
    correction = Correction(decode_calibration(encode_calibration(seen)))
    correction.telemetry("battpos", 0.2, START)
    _, corrected = correction.reading(Reading(FIELD), START, depth=depth)
    assert corrected.total_field_sigma == pytest.approx(factor, rel=1e-3)
    assert bool(corrected.quality & Quality.EXTRAPOLATED) == (factor > 1.5)


@pytest.mark.parametrize("temperature", [3.0, 27.0])
def test_sigma_grows_with_the_temperature_outside_the_calibrated_range(
    calibration: Calibration, temperature: float
) -> None:
    """One temperature of calibration holds for 2 degC either way, and an effect takes the range's place."""
    seen = replace(calibration, conditions=(CalibratedRange("sensor_temperature", 15.0, 15.0),))
    followed = replace(follows("sensor_temperature", "degC"), conditions=seen.conditions)
    sigma = []
    for one in (seen, followed):
        correction = Correction(one)
        correction.telemetry("battpos", 0.2, START)
        sigma.append(correction.reading(Reading(FIELD, temperature=temperature), START)[1].total_field_sigma)
    assert sigma[0] == pytest.approx(hypot(1.0, 5.0), rel=1e-3)
    assert sigma[1] < 1.1


def test_a_depth_effect_beyond_the_calibrated_range_stays_within_sigma() -> None:
    """The offset follows the depth by 0.3 nT/m; the fit sees 100 m of it and the log goes to 200 m."""
    rng = np.random.default_rng(3)
    n = 3000
    direction = rng.normal(size=(n, 3))
    field = 50_000.0 * direction / np.linalg.norm(direction, axis=1)[:, None] + rng.normal(0.0, 1.0, (n, 3))
    depth = np.where(np.arange(n) < 2000, rng.uniform(0.0, 100.0, n), rng.uniform(100.0, 200.0, n))
    field[:, 0] += 0.3 * depth
    columns = {f"mag_{axis}": ("time", field[:, k], {"units": "nT"}) for k, axis in enumerate("xyz")}
    columns["depth"] = ("time", depth, {"units": "m"})
    columns["reference_field"] = ("time", np.full(n, 50_000.0), {"units": "nT"})
    log = xr.Dataset(columns, coords={"time": ("time", np.arange(n) + 1.5e9)}, attrs={"source": "log"})
    found = fit(observations(log.isel(time=slice(2000)), ())).calibration
    assert [condition.name for condition in found.conditions] == ["depth"]
    corrected = correct_rows(Correction(found), log)
    z = (corrected["total_field"].to_numpy() - 50_000.0) / corrected["total_field_sigma"].to_numpy()
    assert np.sqrt((z[2000:] ** 2).mean()) < 1.25
    assert np.sqrt((z[:2000] ** 2).mean()) < 1.25
    deep = corrected["quality"].to_numpy().astype(int)[depth > 160.0]
    assert (deep & Quality.EXTRAPOLATED != 0).mean() > 0.9


def test_level_sigma_is_what_the_level_moves() -> None:
    """A common gain of 0.2 % gives a level of 0.2 % of each field; without a level the column is missing."""
    gain = 0.002 * 50_000.0
    w = np.array([gain] * 3 + [0.0] * 6)
    plain = replace(identity(), covariance=np.outer(w, w), method="survey")
    levelled = replace(plain, level=tuple(w.tolist()), reference=Reference(50_000.0, level_sigma=100.0))
    field = np.array([[10_000.0, 0.0, 48_000.0], [0.0, 20_000.0, 40_000.0]])
    rows = xr.Dataset(
        {f"mag_{axis}": ("time", column) for axis, column in zip("xyz", field.T, strict=True)},
        coords={"time": [1e9, 1e9 + 4.0]},
    )
    corrected = correct_rows(Correction(levelled), rows)
    np.testing.assert_allclose(corrected["level_sigma"], 0.002 * np.linalg.norm(field, axis=1), rtol=1e-6)
    np.testing.assert_allclose(corrected["total_field_sigma"], corrected["level_sigma"], rtol=1e-3)
    assert "level_sigma" not in correct_rows(Correction(plain), rows)
    back = Correction(levelled)
    back._use(plain)  # as a learner that goes back to a calibration without one
    assert "level_sigma" not in correct_rows(back, rows)
