"""Test the compensation of a scalar magnetometer, alone and with a vector magnetometer."""

import ctypes
import shutil
import subprocess
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import xarray as xr
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

import magbridge as mb
from magbridge import logs
from magbridge.arrays import FloatArray
from magbridge.calibration.file import decode_calibration, encode_calibration, load, save
from magbridge.calibration.fitting import scalar_fit
from magbridge.calibration.fitting.scalar_fit import ScalarFit, adapt_to_log, fit_scalar
from magbridge.calibration.fitting.scalar_log import _without_repeated, with_scalar
from magbridge.calibration.model import identity
from magbridge.calibration.scalar import (
    ScalarQuality,
    ScalarSensor,
    ScalarSeries,
    SensorDisagreement,
    compare_sensors,
    correct_scalar,
    scalar_design,
)
from magbridge.cli import main
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.records import Quality

Halves = tuple[ScalarSeries, ScalarSeries]
RATE, MINUTES = 4.0, 24
CHANNELS = "motor_current", "relay", "rudder"
SCALAR = "mag_cabin"


FIRST, SECOND = slice(int(MINUTES * 30 * RATE)), slice(int(MINUTES * 30 * RATE), None)
"""Halves of a flight."""


def flown(seed: int, rows: slice = slice(None), *, relay: bool = True) -> ScalarSeries:
    """Return a simulated flight over a known field, with dipoles and currents independent of the model.

    `relay`: False if it is off during the first half of the flight.
    """
    random = np.random.default_rng(seed)
    n = int(MINUTES * 60 * RATE)
    t = np.arange(n) / RATE

    def slow(seconds: float) -> FloatArray:
        kernel = np.exp(-0.5 * (np.arange(-4 * seconds, 4 * seconds, 1 / RATE) / seconds) ** 2)
        y = np.convolve(random.normal(size=n + len(kernel)), kernel, "valid")[:n]
        return np.asarray((y - y.mean()) / y.std())

    # Four headings in legs of two minutes, with rolls and pitches as in a box flight.
    heading = np.repeat(90.0 * np.arange(MINUTES // 2), int(120 * RATE))
    angles = np.column_stack([heading + 3 * slow(4), 6 * slow(3), 9 * slow(3)])
    earth = np.array([17_000.0, -3_500.0, 51_000.0])
    total = np.linalg.norm(earth) + 30.0 * slow(20.0)
    u = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(earth / np.linalg.norm(earth))
    on = (np.sin(t / 50) > 0.3) & (relay | (t > 0.5 * t[-1]))
    channels = np.column_stack([5 + 3 * slow(60), 2.0 * on, 8 * slow(2)])
    body = u * total[:, None] + [400.0, -250.0, 600.0]
    body += u * total[:, None] @ np.diag([2e-3, -1e-3, 1.5e-3])
    body += np.gradient(u, t, axis=0) @ random.normal(0, 8, (3, 3)).T
    body += channels @ np.array([[3.0, -2.0, 4.0], [6.0, 5.0, -3.0], [0.3, 0.2, -0.4]])
    flicker = np.cumsum(random.normal(0, 0.01, n))
    scalar = np.linalg.norm(body, axis=1) + 0.3 * random.normal(size=n) + flicker - flicker.mean() + 5.0
    vector = u * total[:, None] + random.normal(0, 1.0, (n, 3))
    return part(ScalarSeries(t + 1.6e9, scalar, vector, total, channels, np.full(n, np.nan)), rows)


def part(series: ScalarSeries, rows: slice) -> ScalarSeries:
    return ScalarSeries(*(values[rows] for values in series))


@pytest.fixture(scope="module")
def halves() -> tuple[ScalarSeries, ScalarSeries]:
    series = flown(3, relay=False)
    return part(series, FIRST), part(series, SECOND)


@pytest.fixture(scope="module")
def fitted(halves: Halves) -> ScalarFit:
    return fit_scalar(halves[0], CHANNELS, column=SCALAR, map_known=True)


def test_noise_without_a_whitening_filter_is_not_chosen(
    halves: Halves, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The Riccati equation of extreme noise is ill-conditioned: scipy then raises ValueError."""
    calls = count()

    def sometimes(*arguments: Any) -> FloatArray:
        if next(calls) % 7 == 3:
            raise ValueError("ill-conditioned")
        return np.asarray(solve_discrete_are(*arguments))

    monkeypatch.setattr(scalar_fit, "solve_discrete_are", sometimes)
    found = fit_scalar(part(halves[0], slice(0, 1200)), CHANNELS, map_known=True)
    assert found.rms_after < 0.1 * found.rms_before


def rms_of_least_squares(
    fit: ScalarSeries, test: ScalarSeries, sensor: ScalarSensor, ridge: float = 0.0
) -> float:
    """Return the error, nT, of a compensation of Tolles and Lawson with a constant, without channels."""

    def design(series: ScalarSeries) -> FloatArray:
        columns = scalar_design(series, sensor.channels, sensor.reference_field)[:, :18]
        return np.column_stack([columns, np.ones(len(columns))])

    A = design(fit)
    penalty = ridge * np.eye(A.shape[1])
    solution = np.linalg.lstsq(A.T @ A + penalty, A.T @ (fit.scalar - fit.reference), rcond=1e-12)[0]
    return rms(test.scalar - design(test) @ solution - test.reference)


def test_other_half_beats_least_squares_with_a_true_sigma(halves: Halves, fitted: ScalarFit) -> None:
    first, second = halves
    corrected = correct_scalar(adapt_to_log(fitted.sensor, second.channels), second)
    error = corrected.field - second.reference
    assert rms(error) < 4.0
    assert rms(error) < 0.5 * rms_of_least_squares(first, second, fitted.sensor)
    assert 0.4 < rms(error / corrected.sigma) < 1.6
    # the relay was not on in the fit
    on = second.channels[:, 1] > 0.0
    assert corrected.extrapolated[on].all()
    assert np.median(corrected.sigma[on]) > 1.5 * np.median(corrected.sigma[~on])


def test_missing_telemetry_is_not_corrected(halves: Halves, fitted: ScalarFit) -> None:
    _, second = halves
    channels = second.channels.copy()
    channels[5, 0] = np.nan
    corrected = correct_scalar(fitted.sensor, second._replace(channels=channels))
    assert np.isnan(corrected.field[5])
    assert np.isinf(corrected.sigma[5])
    assert corrected.missing[5]
    assert not corrected.missing[6:].any()


def test_wrong_number_of_channels_and_too_few_samples(halves: Halves, fitted: ScalarFit) -> None:
    first, second = halves
    with pytest.raises(CalibrationError, match="expected 3 channels"):
        correct_scalar(fitted.sensor, second._replace(channels=second.channels[:, :1]))
    with pytest.raises(CalibrationError, match="expected at least 100 samples"):
        fit_scalar(part(first, slice(0, 50)), CHANNELS)


def test_a_source_that_no_channel_shows_is_left_out_of_the_fit(halves: Halves, fitted: ScalarFit) -> None:
    first, second = halves
    scalar = first.scalar.copy()
    scalar[1500:1600] -= 3_000.0
    found = fit_scalar(first._replace(scalar=scalar), CHANNELS, map_known=True)
    error = correct_scalar(adapt_to_log(found.sensor, second.channels), second).field - second.reference
    assert rms(error) < 4.0
    assert found.rms_after < 1.5 * fitted.rms_after


def test_without_a_map_it_beats_ridge_with_a_true_sigma() -> None:
    # The start of the log has no special part: the crustal field there is not taken for the level.
    first, second = flown(12, FIRST), flown(12, SECOND)
    first = first._replace(reference=np.full(len(first.time), np.median(second.reference)))
    found = fit_scalar(first, CHANNELS)
    corrected = correct_scalar(adapt_to_log(found.sensor, second.channels), second)
    error = corrected.field - second.reference
    assert rms(error) < min(15.0, rms_of_least_squares(first, second, found.sensor, ridge=0.025))
    assert 0.2 < rms(error / corrected.sigma) < 1.8


# ---- Files, commands, and the check of one sensor by the other ---------------------------------------------


def test_a_disturbance_that_no_channel_shows_is_seen_by_the_vector() -> None:
    n = 400
    truth = np.full(n, 53_000.0)
    random = np.random.default_rng(3)
    scalar, total = truth + random.normal(0, 0.5, n), truth + random.normal(0, 5.0, n)
    scalar[100:160] -= 3_000.0
    one, five, unknown = np.full(n, 0.5), np.full(n, 5.0), np.full(n, np.nan)

    def compared(reference: FloatArray, rows: slice = slice(None)) -> SensorDisagreement:
        return compare_sensors(scalar[rows], one[rows], total[rows], five[rows], reference[rows])

    seen = compared(truth)
    assert seen.disagrees[100:160].all()
    assert seen.disagrees[:100].mean() < 0.01
    assert (np.sqrt(seen.scalar_variance[100:160]) > 2_900.0).all()
    assert (seen.vector_variance[100:160] == 0.0).all()  # the reference tells which one is off
    assert seen.jump[[100, 160]].all()
    assert (compared(unknown).vector_variance[100:160] == 0.0).all()  # so do the samples before and after
    alone = compared(unknown, slice(100, 160))
    assert (alone.vector_variance > 0.0).all()
    assert (alone.scalar_variance > 0.0).all()


@pytest.mark.filterwarnings("error")
def test_a_disturbance_that_cancels_the_crust_is_not_taken_for_the_truth() -> None:
    """Over an anomaly of 300 nT the disturbed sensor reads the main field, the other one does not."""
    n = 400
    random = np.random.default_rng(5)
    crust = 300.0 + 20.0 * np.sin(np.arange(n) / 30.0)
    scalar = 53_000.0 + crust + random.normal(0, 0.5, n)
    total = 53_000.0 + crust + random.normal(0, 5.0, n)
    main, one, five = np.full(n, 53_000.0), np.full(n, 0.5), np.full(n, 5.0)
    disturbed = np.where((np.arange(n) >= 100) & (np.arange(n) < 160), -300.0, 0.0)
    seen = compare_sensors(scalar + disturbed, one, total, five, main)
    assert (seen.vector_variance[100:160] == 0.0).all()
    assert (seen.scalar_variance[100:160] > 0.0).all()
    seen = compare_sensors(scalar, one, total + disturbed, five, main)
    assert (seen.scalar_variance[100:160] == 0.0).all()
    assert (seen.vector_variance[100:160] > 0.0).all()


@pytest.mark.filterwarnings("error")
def test_channels_that_disturb_are_named_and_an_idle_one_is_not() -> None:
    series = flown(6, FIRST)
    idle = np.random.default_rng(1).normal(size=len(series.time))
    series = series._replace(channels=np.column_stack([series.channels, idle]))
    found = fit_scalar(series, (*CHANNELS, "fan"), map_known=True).findings
    assert {finding.code for finding in found} == {"scalar.channel"}
    assert {finding.values["channel"] for finding in found} <= set(CHANNELS)
    assert found[0].values["effect_nT"] == max(finding.values["effect_nT"] for finding in found)


def test_samples_of_one_time_are_fitted_and_corrected() -> None:
    series = flown(8, FIRST)
    pairs = np.repeat(np.arange(len(series.time)), 1 + (np.arange(len(series.time)) % 7 == 0))
    twice = ScalarSeries(*(column[pairs] for column in series))
    found = fit_scalar(twice, CHANNELS, map_known=True)
    error = correct_scalar(found.sensor, twice).field - twice.reference
    assert rms(error) < 1.0


@pytest.mark.parametrize("rows", [[0], [800], [-1], [100, 101, 900]])
def test_a_missing_value_costs_its_own_row(rows: list[int]) -> None:
    series = flown(8, slice(1200))
    vector, reference = series.vector.copy(), series.reference.copy()
    vector[rows, 1], reference[[300, 600]] = np.nan, np.nan
    missing = series._replace(vector=vector, reference=reference)
    found = fit_scalar(missing, CHANNELS, map_known=True, lag=0.0)
    assert found.rms_after < 1.0
    error = correct_scalar(found.sensor, missing).field - series.reference
    assert np.flatnonzero(np.isnan(error)).tolist() == sorted(row % 1200 for row in rows)
    assert np.nanmax(np.abs(error)) < 5.0
    design = scalar_design(missing, found.sensor.channels, found.sensor.reference_field)
    # A missing position does not make the field's rate of change a jump between reference and reading.
    assert np.nanmax(np.abs(design[:, 18])) < 40.0


def test_the_file_holds_the_sensor_and_refuses_numbers_that_do_not_belong_together(fitted: ScalarFit) -> None:
    both = replace(identity(), sensors=(fitted.sensor,))
    written = encode_calibration(both)
    assert decode_calibration(written).sensors == both.sensors
    assert b'"format": 5' in written
    sensor = msgspec.structs.replace(fitted.sensor, coefficients=fitted.sensor.coefficients[:-1])
    short = replace(both, sensors=(sensor,))
    with pytest.raises(CalibrationError, match=r"sensor 'mag_cabin': expected \d+ coefficients"):
        decode_calibration(encode_calibration(short))


def write(series: ScalarSeries, path: Path) -> None:
    columns = {f"mag_{axis}": series.vector[:, k] for k, axis in enumerate("xyz")}
    columns |= {SCALAR: series.scalar, "reference_field": series.reference}
    columns |= dict(zip(CHANNELS, series.channels.T, strict=True))
    units = {"motor_current": "A", "relay": "A", "rudder": "deg"}
    ds = xr.Dataset(
        {name: ("time", values, {"units": units.get(name, "nT")}) for name, values in columns.items()},
        coords={"time": series.time},
    )
    logs.write(ds, path)


def test_commands_calibrate_and_correct_a_scalar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    series = flown(5)
    write(part(series, FIRST), tmp_path / "a.nc")
    write(part(series, SECOND), tmp_path / "b.nc")
    cal, out = tmp_path / "cal.json", tmp_path / "out.nc"
    assert main(["calibrate", str(tmp_path / "a.nc"), "--scalar", SCALAR, "-o", str(cal)]) == 0
    assert "with 3 channels" in capsys.readouterr().out
    assert [channel.name for channel in load(cal).sensors[0].channels] == list(CHANNELS)
    assert main(["correct", str(tmp_path / "b.nc"), "--calibration", str(cal), "-o", str(out)]) == 0
    back = logs.read(out)
    error = back["scalar_field"].to_numpy() - part(series, SECOND).reference
    assert rms(error) < 2.0
    assert np.mean((back["scalar_quality"].to_numpy().astype(int) & ScalarQuality.DISAGREES) > 0) < 0.01
    assert main(["calibrate", str(tmp_path / "a.nc"), "--lag", "1", "-o", str(cal)]) == 2
    assert "--scalar COLUMN" in capsys.readouterr().err
    wrong = ["calibrate", str(tmp_path / "a.nc"), "--scalar", SCALAR, "--lever", "1,2", "-o", str(cal)]
    assert main(wrong) == 2
    assert "F,R,D" in capsys.readouterr().err


@pytest.mark.parametrize("dead", [0.0, 54_000.0])
def test_a_dead_zone_is_flagged_and_not_fitted(tmp_path: Path, dead: float) -> None:
    series = flown(7, FIRST)
    frozen = np.zeros(len(series.time), bool)
    frozen[600:700] = frozen[1500:1900] = True
    write(series._replace(scalar=np.where(frozen, dead, series.scalar)), tmp_path / "a.nc")
    log = mb.read(tmp_path / "a.nc")
    corrected = mb.correct(mb.calibrate(log, scalar=SCALAR), log)
    error = corrected["scalar_field"].to_numpy() - series.reference
    assert rms(error[~frozen]) < 1.0
    missing = (corrected["scalar_quality"].to_numpy().astype(int) & ScalarQuality.MISSING) > 0
    np.testing.assert_array_equal(missing, frozen)


def test_a_coarse_sensor_at_rest_may_repeat_its_reading() -> None:
    reference = np.full(300, 50_000.0)
    reading = np.round(reference + np.random.default_rng(1).normal(0.0, 0.2, 300))
    reading[100:200] = 50_000.0
    np.testing.assert_array_equal(_without_repeated(reading, reference), reading)
    assert np.isnan(_without_repeated(reading, reference + 0.1 * np.arange(300.0))[100:200]).all()


def test_a_compensation_that_improves_nothing_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    series = flown(7, slice(1500))
    random = np.random.default_rng(2)
    write(series._replace(scalar=series.scalar + random.normal(0.0, 3_000.0, 1500)), tmp_path / "a.nc")
    cal = tmp_path / "cal.json"
    command = ["calibrate", str(tmp_path / "a.nc"), "--scalar", SCALAR, "-o", str(cal)]
    assert main([*command, "--parameter", "relay"]) == 1
    assert "improves nothing" in capsys.readouterr().err
    assert not cal.exists()
    assert main([*command, "--parameter", "relay", "--force"]) == 0
    assert "improves nothing" in load(cal).warnings[-1]


def test_a_wrong_reference_is_refused_and_a_scalar_far_from_it_is_flagged(halves: Halves) -> None:
    series, _ = halves
    wrong = part(series._replace(reference=0.5 * series.reference), slice(800))
    found = fit_scalar(wrong, CHANNELS, map_known=True, lag=0.0)
    assert "sign of the latitude" in found.doubt
    n, one = 50, np.ones(50)
    truth = series.reference[:n]
    seen = compare_sensors(truth * 0.5, one, truth * 0.5, one, truth)
    assert seen.disagrees.all()
    assert (np.sqrt(seen.scalar_variance) > 0.4 * truth).all()


def test_a_doubtful_vector_makes_the_scalar_doubtful(tmp_path: Path) -> None:
    series = flown(7, FIRST)
    write(series, tmp_path / "a.nc")
    log = mb.read(tmp_path / "a.nc")
    calibration = mb.calibrate(log, scalar=SCALAR)
    vector = xr.Dataset(dict(mb.correct(replace(calibration, sensors=()), log)))
    flags = np.zeros(len(series.time))
    flags[300:700] = int(Quality.IMPLAUSIBLE)
    corrected = with_scalar(vector.assign(quality=("time", flags)), log, calibration.sensors)
    doubtful = (corrected["scalar_quality"].to_numpy().astype(int) & ScalarQuality.DISAGREES) > 0
    assert doubtful[300:700].all()
    assert doubtful[800:].mean() < 0.01
    sigma = corrected["scalar_field_sigma"].to_numpy()
    assert sigma[300:700].min() > 700.0  # the permanent field of [400, -250, 600] nT, and induced field
    assert np.median(sigma[800:]) < 10.0
    flags[:1500] = int(Quality.IMPLAUSIBLE)  # more than half: the axes are wrong everywhere
    corrected = with_scalar(vector.assign(quality=("time", flags)), log, calibration.sensors)
    assert corrected["scalar_field_sigma"].to_numpy().min() > 700.0


def test_the_common_sigma_is_the_part_that_all_samples_share() -> None:
    series = flown(8, slice(1200))
    sensor = fit_scalar(series, CHANNELS, map_known=True, lag=0.0).sensor
    size = len(sensor.coefficients) - 1
    random = np.random.default_rng(1)
    design = np.column_stack([scalar_design(series, sensor.channels, sensor.reference_field), np.ones(1200)])
    draws = random.multivariate_normal(np.zeros(size + 1), sensor.total_covariance, 1000, method="eigh")
    errors = draws @ design.T
    found = correct_scalar(sensor, series)
    assert (found.level_sigma <= found.sigma).all()
    assert np.median(found.level_sigma) == pytest.approx(errors.mean(axis=1).std(), rel=0.1)
    # What remains is the scatter about the common part, with the sensor's noise.
    noise = sensor.noise.white**2 + sensor.slow_variance
    scatter = np.mean((errors - errors.mean(axis=1)[:, None]) ** 2)
    assert np.mean(found.sigma**2 - found.level_sigma**2) - noise == pytest.approx(scatter, rel=0.15)


@pytest.mark.parametrize(("late", "given"), [(0.1, None), (0.6, 0.6), (-0.4, None)])
def test_a_lag_moves_direction_and_channels_too(late: float, given: float | None) -> None:
    """The main field is constant: only the vehicle's own field shows the lag."""
    t = np.arange(4000) / 10.0
    angles = np.column_stack([90.0 * (t // 100.0), 8.0 * np.sin(2.0 * t), 9.0 * np.sin(1.5 * t)])
    u = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply([0.3, -0.06, 0.95])
    u /= np.linalg.norm(u, axis=1)[:, None]
    current = np.sin(0.4 * t)
    vehicle = u @ [30.0, -20.0, 10.0] + 5.0 * current * u[:, 0]
    noise = np.random.default_rng(1).normal(0.0, 0.01, len(t))
    reading = 50_000.0 + np.interp(t - late, t, vehicle) + noise
    series = ScalarSeries(
        t, reading, 50_000.0 * u, np.full(4000, 50_000.0), current[:, None], np.full(4000, np.nan)
    )
    found = fit_scalar(series, ("current",), map_known=True, lag=given)
    assert found.sensor.lag == pytest.approx(late, abs=0.005)
    assert found.lag_sigma == 0.0 if given else 0.0 < found.lag_sigma < 0.01
    error = correct_scalar(found.sensor, series).field - 50_000.0
    inner = np.abs(t % 100.0 - 50.0) < 45.0  # no turn from one heading to the next
    assert np.sqrt(np.nanmean(error[inner] ** 2)) < 0.03


def test_a_lag_below_a_smooth_crustal_field_is_not_left_to_the_linear_term() -> None:
    """0.12 s in a small vehicle's field was 0.1006 s with a sigma of 0.0049 s."""
    t = np.arange(2800) / 10.0
    axis, within = (t % 70.0) // 23.0, t % 70.0 % 23.0
    swing = np.where(
        (within > 6.0) & (within < 22.0) & (t % 70.0 < 69.0), np.sin(np.pi / 2 * (within - 6)), 0
    )
    angles = np.column_stack(
        [5.0 * swing * (axis == 2), 5.0 * swing * (axis == 1), 10.0 * swing * (axis == 0)]
    )
    angles[:, 0] += 90.0 * (t // 70.0)
    u = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply([0.39, 0.02, 0.92])
    u /= np.linalg.norm(u, axis=1)[:, None]
    vehicle = 0.25 * (u @ [14.0, -9.0, 18.0] + 10.0 * u[:, 0] ** 2 - 5.0 * u[:, 1] * u[:, 2])
    random = np.random.default_rng(5)
    centres, sizes = random.uniform(0.0, 280.0, 12), random.normal(0.0, 15.0, 12)
    truth = 50_000.0 + np.exp(-0.5 * ((t[:, None] - centres) / 20.0) ** 2) @ sizes
    reading = np.interp(t - 0.12, t, vehicle + truth) + random.normal(0.0, 0.02, len(t))
    vector = truth[:, None] * u + random.normal(0.0, 2.0, (len(t), 3))
    known, nothing = np.full(len(t), 50_000.0), np.empty((len(t), 0))
    found = fit_scalar(ScalarSeries(t, reading, vector, known, nothing, np.full(len(t), np.nan)), ())
    assert abs(found.sensor.lag - 0.12) < min(2.0 * found.lag_sigma, 0.01)


def test_compiled_c_gives_the_field_of_python(tmp_path: Path, halves: Halves, fitted: ScalarFit) -> None:
    gcc = shutil.which("gcc") or shutil.which("cc")
    if gcc is None:
        pytest.skip("no C compiler is installed")
    series, sensor = halves[1], fitted.sensor
    save(replace(identity(), sensors=(sensor,)), tmp_path / "cal.json")
    assert main(["export", str(tmp_path / "cal.json"), "--c", str(tmp_path)]) == 0
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-shared", "-fPIC"]
    library = tmp_path / "scalar.so"
    subprocess.run([gcc, *strict, str(tmp_path / "magbridge_scalar.c"), "-o", library, "-lm"], check=True)

    class Corrected(ctypes.Structure):
        _fields_ = [(name, ctypes.c_double) for name in ("field", "sigma", "level_sigma")] + [
            ("extrapolated", ctypes.c_int)
        ]

    correct_in_c = ctypes.CDLL(str(library)).magbridge_correct_scalar
    three = ctypes.c_double * 3
    series = series._replace(reference=np.full(len(series.time), np.nan))
    expected = correct_scalar(sensor.without_shift(), series)
    u = series.vector / np.linalg.norm(series.vector, axis=1)[:, None]
    turn, rate = np.gradient(u, series.time, axis=0), np.gradient(series.scalar, series.time)
    out = Corrected()
    for k in range(0, len(series.time), 97):
        reading = ctypes.c_double(series.scalar[k]), three(*series.vector[k]), three(*turn[k])
        correct_in_c(*reading, ctypes.c_double(rate[k]), three(*series.channels[k]), 1, ctypes.byref(out))
        assert out.field == pytest.approx(expected.field[k], abs=1e-6)
        assert out.sigma == pytest.approx(expected.sigma[k], rel=1e-6)
        assert bool(out.extrapolated) == expected.extrapolated[k]
    correct_in_c(*reading, ctypes.c_double(0.0), three(1e3, 0.0, 0.0), 0, ctypes.byref(out))
    assert out.extrapolated
    assert out.level_sigma == 30.0


def test_the_vector_is_calibrated_by_the_scalar(tmp_path: Path) -> None:
    """A scalar away from the iron is the reference: no map and no position are needed."""
    series = flown(6)
    iron = np.array([300.0, -200.0, 100.0])
    seen = series._replace(scalar=series.reference, vector=np.add(series.vector, iron))
    path, cal, out = tmp_path / "a.nc", tmp_path / "cal.json", tmp_path / "out.nc"
    write(seen, path)
    only = tmp_path / "only.nc"
    logs.write(logs.read(path).drop_vars("reference_field"), only)
    assert main(["calibrate", str(only), "--scalar", SCALAR, "--reference", "scalar", "-o", str(cal)]) == 0
    assert load(cal).sensors == ()
    assert main(["correct", str(path), "--calibration", str(cal), "-o", str(out)]) == 0
    error = logs.read(out)["total_field"].to_numpy() - series.reference
    assert rms(error) < 1.5
