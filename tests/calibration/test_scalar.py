"""Test the compensation of a scalar magnetometer: fit half of a simulated flight, correct the other half."""

from itertools import count
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting import scalar_fit
from magbridge.calibration.fitting.scalar_fit import ScalarFit, adapt_to_log, fit_scalar
from magbridge.calibration.scalar import ScalarSeries, correct_scalar, scalar_design, term_columns
from magbridge.errors import CalibrationError

Halves = tuple[ScalarSeries, ScalarSeries, FloatArray]

NAMES = ("current", "aileron", "step")


def _smooth(random: np.random.Generator, n: int, samples: float) -> FloatArray:
    """Return a smooth random series, (n,), of standard deviation 1 and mean 0."""
    a = np.exp(-1.0 / samples)
    series = lfilter([1.0], [1.0, -a], random.normal(size=n + int(10 * samples)))[-n:]
    series = lfilter([1.0], [1.0, -a], series)
    return np.asarray((series - series.mean()) / series.std(), float)


def _flight(seed: int, minutes: float = 40.0, rate: float = 2.0) -> tuple[ScalarSeries, FloatArray]:
    """Return a flight of eight headings, built with vectors instead of the model's columns."""
    random = np.random.default_rng(seed)
    n = int(minutes * 60.0 * rate)
    time = np.arange(n) / rate
    yaw = 45.0 * (time // 150.0) + 3.0 * _smooth(random, n, 5.0 * rate)
    pitch, roll = 3.0 * _smooth(random, n, 4.0 * rate), 6.0 * _smooth(random, n, 3.0 * rate)
    crust = 30.0 * _smooth(random, n, 20.0 * rate)
    north_east_down = np.array([17_000.0, -3_500.0, 51_000.0])
    main = np.linalg.norm(north_east_down)
    truth = main + crust
    attitude = Rotation.from_euler("ZYX", np.radians(np.column_stack([yaw, pitch, roll])))
    earth = attitude.inv().apply(north_east_down * (truth / main)[:, None])
    u = earth / truth[:, None]
    channels = np.column_stack([
        5.0 + 3.0 * _smooth(random, n, 60.0 * rate),
        2.0 * roll + _smooth(random, n, 2.0 * rate),
        np.where(time > 0.6 * time[-1], 4.0, 0.0) + 0.1 * _smooth(random, n, 5.0 * rate),
    ])  # fmt: skip
    induced = random.normal(0.0, 60.0, (3, 3))
    body = earth + random.normal(0.0, 600.0, 3) + u @ (induced + induced.T) / 2.0
    body += channels @ (random.normal(size=(3, 3)) * np.array([[3.0], [0.3], [1.0]]))
    scalar = np.linalg.norm(body, axis=1) + random.normal(0.0, 0.3, n) + 12.0
    vector = earth + random.normal(0.0, 1.0, earth.shape)
    series = ScalarSeries(time + 1.6e9, scalar, vector, truth.copy(), channels, np.full(n, np.nan))
    return series, truth


def _part(series: ScalarSeries, rows: slice) -> ScalarSeries:
    return ScalarSeries(*(values[rows] for values in series))


@pytest.fixture(scope="module")
def halves() -> Halves:
    series, truth = _flight(3)
    first, second = slice(0, len(truth) // 2), slice(len(truth) // 2, None)
    return _part(series, first), _part(series, second), truth[second]


@pytest.fixture(scope="module")
def fitted(halves: Halves) -> ScalarFit:
    return fit_scalar(halves[0], NAMES, column="scalar", map_known=True)


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
    found = fit_scalar(_part(halves[0], slice(0, 1200)), NAMES, map_known=True)
    assert found.rms_after < 0.1 * found.rms_before


def test_the_width_of_a_channel_that_hardly_moved_adds_to_its_variance(
    halves: Halves, fitted: ScalarFit
) -> None:
    sensor = adapt_to_log(fitted.sensor, halves[1].channels)
    added = np.diag(sensor.total_covariance) / np.diag(np.array(sensor.covariance)) - 1.0
    at = term_columns(sensor.channels)
    assert added.min() >= -1e-9
    assert added[at["step"]].max() > 0.1  # it moves in the second half only
    assert added[at["aileron"]].max() < 0.01


def test_other_half_beats_least_squares_with_a_true_sigma(halves: Halves, fitted: ScalarFit) -> None:
    first, second, truth = halves
    corrected = correct_scalar(adapt_to_log(fitted.sensor, second.channels), second)
    error = corrected.field - truth
    rms = np.sqrt(np.mean(error**2))

    # Tolles-Lawson by least squares: permanent, induced, eddy and a constant.
    def design(part: ScalarSeries) -> FloatArray:
        columns = scalar_design(part, fitted.sensor.channels, fitted.sensor.reference_field)[:, :18]
        return np.column_stack([columns, np.ones(len(columns))])

    solution = np.linalg.lstsq(design(first), first.scalar - first.reference, rcond=1e-10)[0]
    least_squares = second.scalar - design(second) @ solution - truth
    assert rms < 3.0
    assert rms < 0.5 * np.sqrt(np.mean(least_squares**2))
    assert 0.4 < np.sqrt(np.mean((error / corrected.sigma) ** 2)) < 1.6


def test_channel_that_did_not_move_in_the_fit_has_a_wide_sigma(halves: Halves, fitted: ScalarFit) -> None:
    _, second, _ = halves
    corrected = correct_scalar(adapt_to_log(fitted.sensor, second.channels), second)
    after = second.channels[:, 2] > 2.0
    assert corrected.extrapolated[after].all()
    assert np.median(corrected.sigma[after]) > 1.5 * np.median(corrected.sigma[~after])


def test_missing_telemetry_is_not_corrected(halves: Halves, fitted: ScalarFit) -> None:
    _, second, _ = halves
    channels = second.channels.copy()
    channels[5, 0] = np.nan
    corrected = correct_scalar(fitted.sensor, second._replace(channels=channels))
    assert np.isnan(corrected.field[5])
    assert np.isinf(corrected.sigma[5])
    assert corrected.missing[5]
    assert not corrected.missing[6:].any()


def test_wrong_number_of_channels_and_too_few_samples(halves: Halves, fitted: ScalarFit) -> None:
    first, second, _ = halves
    with pytest.raises(CalibrationError, match="expected 3 channels"):
        correct_scalar(fitted.sensor, second._replace(channels=second.channels[:, :1]))
    with pytest.raises(CalibrationError, match="expected at least 100 samples"):
        fit_scalar(_part(first, slice(0, 50)), NAMES)


def test_a_source_that_no_channel_shows_is_left_out_of_the_fit(halves: Halves, fitted: ScalarFit) -> None:
    first, second, truth = halves
    scalar = first.scalar.copy()
    scalar[1500:1600] -= 3_000.0
    found = fit_scalar(first._replace(scalar=scalar), NAMES, map_known=True)
    error = correct_scalar(adapt_to_log(found.sensor, second.channels), second).field - truth
    assert np.sqrt(np.mean(error**2)) < 3.0
    assert found.rms_after < 1.5 * fitted.rms_after


def test_without_a_map_it_beats_ridge_with_a_true_sigma() -> None:
    # The start of the log has no special part: the crustal field there is not taken for the level.
    series, truth = _flight(12)
    first, second = slice(0, len(truth) // 2), slice(len(truth) // 2, None)
    train, test = _part(series, first), _part(series, second)
    train = train._replace(reference=np.full(len(train.time), np.median(truth)))
    found = fit_scalar(train, NAMES)
    corrected = correct_scalar(adapt_to_log(found.sensor, test.channels), test)
    error = corrected.field - truth[second]

    def design(part: ScalarSeries) -> FloatArray:
        columns = scalar_design(part, found.sensor.channels, found.sensor.reference_field)[:, :18]
        return np.column_stack([columns, np.ones(len(columns))])

    A = design(train)
    solution = np.linalg.solve(A.T @ A + 0.025 * np.eye(A.shape[1]), A.T @ (train.scalar - train.reference))
    ridge = test.scalar - design(test) @ solution - truth[second]
    assert np.sqrt(np.mean(error**2)) < min(15.0, float(np.sqrt(np.mean(ridge**2))))
    assert 0.2 < np.sqrt(np.mean((error / corrected.sigma) ** 2)) < 1.8
