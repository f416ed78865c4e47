"""Test alignment and calibration together: the sigma includes every uncertainty."""

from dataclasses import replace
from math import hypot, nan

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter
from small import polynomial

from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import (
    Boresight,
    CalibratedRange,
    CalibratedSensor,
    Calibration,
    Noise,
    Parameter,
    Reference,
    identity,
)
from magbridge.config import Align
from magbridge.correction import Correction
from magbridge.errors import OutOfRange
from magbridge.field.reference import missing_anomaly, reference_field
from magbridge.filter_lag import LagCorrection
from magbridge.logs.deployment import deployment
from magbridge.records import Quality, Reading
from magbridge.rows import correct_rows

START, SECOND = 1_780_000_000_000_000, 1_000_000
FIELD = (20_000.0, -1_000.0, 45_000.0)
LINE, T_X = 3_000.0, 9 + 6
"""Field along x by the mass at 1 in, nT, and index of its coefficient: monomial 1, slot 6."""


@pytest.fixture
def calibration() -> Calibration:
    return follows("battpos", "in")


def follows(channel: str, unit: str) -> Calibration:
    coefficients = np.where(np.arange(18) == T_X, LINE, 0.0)
    return polynomial(coefficients, Parameter(channel, unit, -1.0, 1.0, 0.0, 1.0), variance=1e-6)


def total(position: float) -> float:
    return hypot(FIELD[0] - LINE * position, *FIELD[1:])


@pytest.mark.parametrize("start", [0.0, -5_000.0, -145e6, -2.2e9])
def test_times_of_any_sign_give_the_same_result(start: float, calibration: Calibration) -> None:
    """The checks of field and direction, and their memory, do not depend on the sign of the time."""
    n = 600
    rng = np.random.default_rng(3)
    jump = np.where(np.arange(n) > n // 2, 900.0, 0.0)
    columns = {
        f"mag_{axis}": value + rng.normal(0, 1, n) + jump for axis, value in zip("xyz", FIELD, strict=True)
    }
    columns |= {"battpos": 0.0 * jump, "roll": 0.0 * jump, "pitch": 0.0 * jump, "heading": 0.0 * jump}
    fitted = replace(
        calibration,
        boresight=Boresight((0.0, 0.0, 0.0), ((1e-6, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 1e-6))),
        noise=Noise(sensor=1.0),
    )

    def corrected(since: float) -> xr.Dataset:
        log = deployment("log", since + 4.0 * np.arange(n), columns, attrs={"time_reference": "boot"})
        return correct_rows(Correction(fitted), log)

    expected, found = corrected(1.78e9), corrected(start)
    assert (expected["quality"] != 0).any()
    for name in ("total_field", "total_field_sigma", "quality"):
        np.testing.assert_array_equal(found[name], expected[name])


def test_outside_the_main_field_model_only_the_anomaly_is_missing(calibration: Calibration) -> None:
    """A log that crosses 2030 keeps its anomaly up to there, and its total field throughout."""
    n, end = 20, 1_893_456_000.0
    columns = {f"mag_{axis}": np.full(n, value) for axis, value in zip("xyz", FIELD, strict=True)}
    columns |= {"battpos": np.zeros(n), "latitude": np.full(n, 49.0), "longitude": np.full(n, -57.0)}
    log = deployment("late.csv", end + 4.0 * (np.arange(n) - n // 2), columns)
    found = correct_rows(Correction(calibration), log)
    assert np.isfinite(found["total_field"]).all()
    np.testing.assert_array_equal(np.isfinite(found["anomaly"]), np.arange(n) <= n // 2)
    assert "outside the IGRF: time = 2030-01-01" in missing_anomaly(log)
    assert missing_anomaly(log.isel(time=slice(0, 5))) == ""
    with pytest.raises(OutOfRange, match="IGRF covers"):
        reference_field(log)


@pytest.mark.parametrize(
    ("reports", "ends", "flag"),
    [
        ((), (-1.0, 1.0), Quality.STALE_TELEMETRY),
        ((0.2, 0.2, 0.5), (0.2, 0.5), Quality.MOVING),
        ((0.2, 0.2, 0.2), (0.2, 0.2), Quality(0)),
    ],
)
def test_sigma_counts_where_a_mass_may_have_been(
    calibration: Calibration, reports: tuple[float, ...], ends: tuple[float, float], flag: Quality
) -> None:
    """A position that was never sent may be anywhere; a mass in motion was somewhere between."""
    correction = Correction(calibration, Align(settle_time=1.0))
    for k, position in enumerate(reports):
        correction.telemetry("battpos", position, START + k * SECOND)
    _, corrected = correction.reading(Reading(FIELD, temperature=nan), START + 2 * SECOND)
    assert corrected.quality == flag | Quality.NO_BORESIGHT
    assert corrected.total_field == pytest.approx(total(reports[-1] if reports else 0.0))
    half = 0.5 * abs(total(ends[1]) - total(ends[0]))
    assert corrected.total_field_sigma == pytest.approx(hypot(1.0, half), rel=1e-3)
    assert min(corrected.field_sigma) >= half


@pytest.mark.parametrize("interval", [20.0, 40.0, 60.0])
@pytest.mark.parametrize("has_age", [False, True])
@pytest.mark.parametrize("amplitude", [0.0, 0.3])
def test_between_two_slow_reports_of_a_log_a_mass_was_between_them(
    calibration: Calibration, interval: float, amplitude: float, *, has_age: bool
) -> None:
    """Telemetry is stale after 30 s; a whole log has the next report, too."""
    time = 4.0 * np.arange(300)
    reported = np.floor(time / interval) * interval

    def position(t: np.ndarray) -> np.ndarray:
        return np.asarray(0.2 + amplitude * np.sin(t / 100.0))

    columns = {f"mag_{axis}": np.full(300, value) for axis, value in zip("xyz", FIELD, strict=True)}
    columns["mag_x"] += LINE * position(time)
    columns["battpos"] = position(reported)
    if has_age:
        columns["age_battpos"] = time - reported
    else:
        columns["battpos"][time - reported >= 4.0] = nan
    found = correct_rows(Correction(calibration), deployment("slow.csv", 1.78e9 + time, columns))
    found = found.isel(time=time < reported[-1])
    if not amplitude:
        assert not (found["quality"].to_numpy().astype(int) & Quality.STALE_TELEMETRY).any()
        np.testing.assert_allclose(found["total_field_sigma"], 1.0, rtol=1e-3)
    elif interval > 30.0:  # else the log is corrected as live
        z = (found["total_field"] - hypot(*FIELD)) / found["total_field_sigma"]
        assert float(np.sqrt((z**2).mean())) < 1.3


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


# ---- Undo the anti-alias filter sample after sample ------------------------------------------------------


CUTOFF_HZ, HORIZONTAL_NT = 0.33, 18_000.0


def turning(
    step_s: float, noise_nt: float, rate_deg_s: float = 1.6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (s), the true and the filtered field (n, 3), nT, of a vehicle that turns."""
    fine, tau = 0.01, 1.0 / (2.0 * np.pi * CUTOFF_HZ)
    time = np.arange(0.0, max(200.0, 100.0 * step_s), fine)
    angle = np.radians(1.6) * time
    true = np.stack(
        [HORIZONTAL_NT * np.cos(angle), HORIZONTAL_NT * np.sin(angle), np.full(len(time), 48_000.0)], axis=1
    )
    share = 1.0 - np.exp(-fine / tau)
    slow = lfilter([share], [1.0, share - 1.0], true - true[0], axis=0) + true[0]
    rows = slice(round(20.0 / fine), None, round(step_s / fine))
    noise = np.random.default_rng(1).normal(0.0, noise_nt, slow[rows].shape)
    return time[rows], true[rows], slow[rows] + noise


def heading_error(field: np.ndarray, true: np.ndarray) -> float:
    """Return the RMS error of the direction of the horizontal field, deg."""
    difference = np.arctan2(field[:, 1], field[:, 0]) - np.arctan2(true[:, 1], true[:, 0])
    return float(np.degrees(np.sqrt(np.mean((np.angle(np.exp(1j * difference))) ** 2))))


@pytest.mark.parametrize("step_s", [4.0, 1.0, 0.1, 0.02])
def test_the_lag_of_a_turn_is_undone_and_the_length_stays(step_s: float) -> None:
    time, true, measured = turning(step_s, 1.0)
    lag = LagCorrection(CUTOFF_HZ)
    found, variance = [], []
    for seconds, field in zip(time.tolist(), measured.tolist(), strict=True):
        found.append(lag.undo(round(seconds * 1e6), tuple(field)))
        variance.append(lag.variance)
    assert heading_error(measured, true) > 0.7
    assert heading_error(np.array(found)[3:], true[3:]) < 0.1
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(measured, axis=1), rtol=1e-12)
    assert np.sqrt(np.mean(variance[3:])) < 0.002 * HORIZONTAL_NT


def test_an_abrupt_change_is_no_turn_but_makes_the_vector_uncertain() -> None:
    """Eight time constants after a step nothing of it is left in the filter; the slope says otherwise."""
    lag = LagCorrection(CUTOFF_HZ)
    before, after = (20_000.0, 0.0, 40_000.0), (0.0, 20_000.0, 40_000.0)
    for k, field in enumerate([before] * 5 + [after] * 5):
        assert lag.undo(4_000_000 * k, field) == pytest.approx(field, abs=1.0)
        assert (lag.variance > 1000.0**2) == (k in (5, 6))


def test_a_gap_and_a_missing_number_are_no_slope() -> None:
    lag = LagCorrection(CUTOFF_HZ)
    assert lag.undo(0, (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert np.isnan(lag.undo(1_000_000, (np.nan, 2.0, 3.0))[0])
    lag.undo(1_000_000, (2.0, 2.0, 3.0))
    assert lag.undo(60_000_000, (500.0, 2.0, 3.0)) == (500.0, 2.0, 3.0)


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_a_calibration_that_names_the_filter_corrects_without_lag(delay_s: float) -> None:
    """What ``align.filter_delay`` corrects in the time of a sample is not undone once more."""
    sensor = CalibratedSensor("ascii", filter_cutoff=CUTOFF_HZ)
    calibration = replace(identity(), sensor=sensor, method="made for a test", noise=Noise(1.0))
    kept = decode_calibration(encode_calibration(calibration))
    assert kept.sensor == calibration.sensor
    time, true, measured = turning(0.5, 0.0)
    correction = Correction(kept, Align(filter_delay=delay_s))
    field = []
    for seconds, row in zip(time.tolist(), measured.tolist(), strict=True):
        field.append(correction.reading(Reading(tuple(row)), round(seconds * 1e6))[1].field)
    late = np.radians(1.6) * delay_s
    turn = np.array([[np.cos(late), np.sin(late), 0.0], [-np.sin(late), np.cos(late), 0.0], [0.0, 0.0, 1.0]])
    assert heading_error(np.array(field)[6:], true[6:] @ turn.T) < 0.05


@pytest.mark.parametrize("unit", ["A", "in"])
def test_a_jump_that_the_next_telemetry_explains_is_withdrawn(unit: str) -> None:
    """A parameter steps at 12 s and 24 s; telemetry (4 Hz) has the time of its arrival, 0.1 s late."""
    rng, correction, sigma = np.random.default_rng(4), Correction(follows("amps", unit)), []
    for k in range(20 * 40):
        time_us, at = START + 50_000 * k, 0.04 * (k // 240 % 2)
        if k % 5 == 1:
            correction.telemetry("amps", 0.04 * (max(k - 2, 0) // 240 % 2), time_us)
        x, y, z_raw = (rng.normal(0.0, 1.0, 3) + FIELD).tolist()
        _, one = correction.reading(Reading((x + LINE * at, y, z_raw)), time_us)
        wrong = abs(one.total_field - hypot(*FIELD)) > 10.0
        assert one.quality & Quality.IMPLAUSIBLE or not wrong
        sigma.append(one.total_field_sigma)
    assert correction.notices == []
    assert max(sigma[100:240] + sigma[270:480] + sigma[510:720] + sigma[750:]) < 1.5


def test_a_jump_beside_an_unsteady_current_is_reported_after_its_next_telemetry() -> None:
    rng, correction, flags = np.random.default_rng(4), Correction(follows("amps", "A")), []
    for k in range(20 * 20):
        time_us, amps = START + 50_000 * k, 0.02 * (k // 5 % 2)
        correction.telemetry("amps", amps, time_us)
        x, y, z = (rng.normal(0.0, 1.0, 3) + FIELD).tolist()
        _, one = correction.reading(Reading((x + LINE * amps + 150.0 * (k >= 240), y, z)), time_us)
        flags.append(bool(one.quality & Quality.IMPLAUSIBLE))
        assert bool(correction.notices) == (k >= 250)
    assert "which no telemetry explains" in correction.notices[0]
    assert flags == [k >= 240 for k in range(400)]
