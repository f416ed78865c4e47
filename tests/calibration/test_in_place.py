"""Test that a survey without runs and map separates the vehicle's field from the crustal field."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gliders import codes

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ChannelEffect, lagged
from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.fitting import in_place
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.crossings import too_rough
from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.methods import fit_auto
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import pose
from magbridge.calibration.fitting.uncertainty import apart_from_level, level_of, with_level
from magbridge.calibration.model import Noise, identity
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.estimation.residual import rms
from magbridge.survey.gridding import gridded
from magbridge.survey.samples import Samples

MAIN = np.array([18_000.0, -5_000.0, 48_000.0])
IRON = np.eye(3) + np.array([[0.012, 0.003, -0.004], [0.003, -0.008, 0.002], [-0.004, 0.002, 0.005]])
OFFSET = np.array([900.0, -600.0, 1200.0])
NOISE = 1.0


def flown(
    *, legs: int = 16, straight: bool = False, zigzag: bool = False, seed: int = 3, noise: float = NOISE
) -> tuple[Observations, FloatArray]:
    """Simulate dives on crossing courses; return the readings and the true total field (n,), nT."""
    rng = np.random.default_rng(seed)
    each, dt, speed = 110, 4.0, 0.9
    n = legs * each
    leg = np.arange(n) // each
    course = np.zeros(legs) if straight else np.radians(rng.uniform(0, 360, legs))
    if zigzag:
        course = np.radians(np.where(np.arange(legs) // 2 % 2, 50.0, -50.0))
    heading = course[leg] + rng.normal(0, 0.02, n)
    pitch = np.radians(np.where(leg % 2, 25, -25) + rng.normal(0, 1, n))
    roll = np.radians(rng.normal(0, 5, legs)[leg] + rng.normal(0, 1, n))
    place = np.cumsum(speed * dt * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1), axis=0)
    rock = waves(place, 700.0, 40.0, rng)
    F_0 = float(np.linalg.norm(MAIN))
    true = F_0 + rock
    ned = MAIN * (true / F_0)[:, None]
    attitude = np.stack([roll, pitch, heading], axis=1)
    field = field_body(attitude, ned) @ np.linalg.inv(IRON).T + OFFSET + rng.normal(0, noise, (n, 3))
    data = Observations(
        field=field, reference=np.full(n, F_0), parameters=np.empty((n, 0)),
        time=1e9 + dt * np.arange(n, dtype=float), runs=leg, attitude=attitude,
        reference_ned=np.tile(MAIN, (n, 1)), place=place, unmapped=np.ones(n),
    )  # fmt: skip
    return data, true


def waves(place: FloatArray, length: float, amplitude: float, rng: np.random.Generator) -> FloatArray:
    """Return a random field (n,), nT, of 400 waves at places (n, 2+), m."""
    k, phase = rng.normal(0, 1 / length, (400, 2)), rng.uniform(0, 2 * np.pi, 400)
    return np.asarray(amplitude * np.sqrt(2 / 400) * np.cos(place[:, :2] @ k.T + phase).sum(axis=1))


def error_of(found: Fit, data: Observations, true: FloatArray) -> tuple[float, float]:
    """Return the corrected field's standard deviation of error and its predicted sigma, without bias, nT."""
    channels = data.channels(found.calibration)
    got = correct(found.calibration, data.field, channels, data.time)
    level = level_of(found.calibration, data.field, channels, data.time)
    return float(np.std(got.total - true)), float(np.sqrt(np.median(got.sigma**2 - level**2)))


Survey = tuple[Observations, FloatArray, Fit]


@pytest.fixture(scope="module")
def survey() -> Survey:
    data, true = flown()
    return data, true, fit(data)


def test_field_level_and_crust_of_a_survey(survey: Survey) -> None:
    data, true, found = survey
    # the corrected field about its mean reaches the noise, and its sigma without the bias agrees
    assert found.calibration.method == "survey"
    error, sigma = error_of(found, data, true)
    assert error < 1.15 * NOISE
    assert 0.8 < error / sigma < 1.25
    # parts are predicted from the others to the noise, which is the sensor's
    assert found.details["left_out_nT"] == pytest.approx(found.calibration.noise.sensor, rel=0.3)
    assert found.calibration.noise.sensor == pytest.approx(NOISE, rel=0.1)
    # an IGRF does not determine the bias: sigma includes this uncertainty, and the result states it
    level = found.calibration.reference.level_sigma
    assert 0.8 * MAIN_FIELD_SIGMA_NT < level < 1.5 * MAIN_FIELD_SIGMA_NT
    got = correct(found.calibration, data.field, np.empty((len(data), 0)), data.time)
    assert got.sigma.min() > 0.9 * level
    assert abs(np.mean(got.total - true)) < 2.5 * level
    # amplitude and length are the crustal field's
    rock = found.details["crustal_field"]
    assert 20.0 < rock["amplitude_nT"] < 100.0
    assert 300.0 < rock["length_m"] < 2000.0


def test_the_field_of_motors_is_not_taken_for_a_crustal_field() -> None:
    """A compass among motors, whose field of 1,500 nT changes slowly along a track that crosses itself."""
    data, _ = flown(legs=3)
    slow = np.random.default_rng(3).normal(size=data.field.shape).cumsum(axis=0)
    seen = replace(data, field=data.field + 1500.0 * slow / slow.std(axis=0))
    assert fit(seen).calibration.method in {"auto", "nominal"}


def test_a_field_larger_than_any_crust_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compass's own error can be put into places, at thousands of nT: the fit is then one without them."""

    def too_large(data: Observations, order: int = 3, **_: Any) -> Fit:
        found = fit_auto(data, order)
        return replace(found, details={**found.details, "crustal_field": {"rms_nT": 15_000.0}})

    monkeypatch.setattr(in_place, "fit_in_place", too_large)
    found = fit(flown()[0])
    assert found.calibration.method == "auto"
    assert "crustal_field" not in found.details


def test_a_level_that_the_reference_contradicts_is_not_believed(survey: Survey) -> None:
    """The bias is the reference's, with its sigma; independent parts stay."""
    data, _, found = survey
    samples = pose(data, 3, None, None).samples
    doubted, believed = (
        with_level(found.calibration, samples, bias, MAIN_FIELD_SIGMA_NT) for bias in (400.0, 200.0)
    )
    assert doubted.reference.level_sigma == pytest.approx(MAIN_FIELD_SIGMA_NT, rel=0.1)
    assert doubted.reference.bias == 0.0
    totals = [correct(one, data.field, data.channels(one), data.time).total for one in (doubted, believed)]
    assert np.mean(totals[0] - totals[1]) == pytest.approx(-400.0, rel=0.02)
    assert believed.reference.level_sigma == pytest.approx(found.calibration.reference.level_sigma, rel=0.01)
    apart = apart_from_level(believed).covariance
    tiny = 1e-6 * float(np.abs(believed.covariance).max())
    np.testing.assert_allclose(apart_from_level(doubted).covariance, apart, atol=tiny)
    got = correct(doubted, data.field, np.empty((len(data), 0)), data.time)
    assert got.sigma.min() > 0.9 * MAIN_FIELD_SIGMA_NT


def test_a_slope_of_the_crust_is_not_taken_for_a_level() -> None:
    """6 nT/km with depth that no model has, dives of 200 m, and noise in which that shows as in a month."""
    data, true = flown(noise=0.2)
    assert data.place is not None
    dive = np.arange(len(data)) % 220 / 110.0
    depth = 200.0 * np.minimum(dive, 2.0 - dive)
    main, crust = 0.025 * depth, 0.006 * depth
    ned = (data.field - OFFSET) * (1.0 + (main + crust) / true)[:, None]
    place = np.column_stack([data.place[:, :2], depth])
    seen = replace(data, field=ned + OFFSET, reference=data.reference + main, place=place)
    found = fit(seen).calibration
    error = correct(found, seen.field, np.empty((len(seen), 0)), seen.time).total - (true + main + crust)
    assert abs(error.mean()) < 0.5 * MAIN_FIELD_SIGMA_NT
    assert error.std() < 0.25
    assert 0.9 * MAIN_FIELD_SIGMA_NT < found.reference.level_sigma < 1.5 * MAIN_FIELD_SIGMA_NT


def test_level_is_less_than_the_sigma_by_the_noise_at_least() -> None:
    """For any change of the offset: 150 nT across the field lengthen it by 0.2 nT, not a level."""
    w = np.zeros(9)
    w[:3], w[6] = MAIN_FIELD_SIGMA_NT / np.sqrt(3.0), 150.0
    still = identity()
    known = replace(still, covariance=np.outer(w, w), level=tuple(w), noise=Noise(NOISE), method="survey")
    field = np.array([[0.0, 0.0, 50_000.0], [0.0, 30_000.0, 40_000.0]])
    got = correct(known, field, np.empty((2, 0)), np.arange(2.0))
    level = level_of(known, field, np.empty((2, 0)), np.arange(2.0))
    np.testing.assert_allclose(got.sigma**2 - level**2, NOISE**2, atol=0.5)


def test_true_field_is_fitted_as_before() -> None:
    """With a true field at every sample neither crustal field nor level is estimated."""
    data, true = flown(legs=6)
    known = Observations(field=data.field, reference=true, parameters=data.parameters, time=data.time)
    found = fit(known)
    assert found.calibration.method in {"auto", "nominal"}  # which of both predicts parts left out better
    assert found.calibration.reference.level_sigma == 0.0


def test_straight_line_is_not_supported() -> None:
    """One straight line cannot separate field and heading: the fit warns, and --strict refuses it."""
    data, true = flown(legs=8, straight=True)
    found = fit(data)
    assert not found.supported
    error, sigma = error_of(found, data, true)
    assert error < 1.5 * sigma
    assert "never_crossed" in codes(found)


def test_a_zigzag_separates_crustal_field_and_heading_without_a_crossing() -> None:
    """Rock is smooth about a turn, and what changes there is the vehicle's."""
    data, true = flown(zigzag=True)
    found = fit(data)
    assert found.calibration.method == "survey"
    error, sigma = error_of(found, data, true)
    assert error < 1.15 * NOISE
    assert 0.8 < error / sigma < 1.25


@pytest.mark.parametrize("code", ["far_position", "without_position", "position_jumps"])
def test_positions_that_are_wrong_or_missing_are_reported(code: str) -> None:
    """A fix on the other side of the Earth does not spread the nodes there, and a gap is not a jump."""
    data, true = flown(legs=8)
    assert data.place is not None
    place = data.place.copy()
    place[100:103, 0] += 8e6 * (code == "far_position")
    place[300:350] += np.nan if code == "without_position" else 0.0
    place[500:, 0] += 600.0 * (code == "position_jumps")
    found = fit(replace(data, place=place), "auto" if code == "far_position" else "survey")
    (warning,) = (one for one in found.warnings if one.code in ("far_position", "without_position", code))
    assert warning.code == code
    if code == "position_jumps":
        assert warning.values["step_m"] == pytest.approx(605.0, abs=5.0)
        assert "--position-sigma" in warning.text
    else:
        lost = {"far_position": 3, "without_position": 50}[code]
        assert warning.values == {"samples": f"{lost} samples"}
        assert sum(run.samples for run in found.calibration.runs) == len(data) - lost
    error, sigma = error_of(found, data, true)
    assert error < 1.25 * sigma


def test_two_vehicles_in_one_log_are_not_supported() -> None:
    """Half of the log has another hard iron (300 nT): the fit must not pass for one that holds."""
    data, true = flown()
    field = data.field.copy()
    field[880:] += [300.0, -200.0, 150.0]
    found = fit(replace(data, field=field), "survey")
    assert not found.supported
    error, sigma = error_of(found, replace(data, field=field), true)
    assert 50.0 < error < 1.5 * sigma
    assert any("two vehicles in one log" in line for line in found.calibration.warnings)


def over(data: Observations, length: float) -> Observations:
    """Return the data with a further crustal field of 30 nT and a `length`, m."""
    assert data.place is not None
    rock = waves(data.place, length, 30.0, np.random.default_rng(0))
    return replace(data, field=data.field * (1.0 + rock / np.linalg.norm(data.field, axis=1))[:, None])


def test_crustal_field_rougher_than_the_tracks_is_not_supported(survey: Survey) -> None:
    """A crustal field of 35 m between tracks at 90 m: one message reports it, and the sigma is consistent."""
    smooth, true = flown(legs=2)
    data, every_second = over(smooth, 35.0), np.arange(len(smooth)) % 2 == 0
    true = true * (np.linalg.norm(data.field, axis=1) / np.linalg.norm(smooth.field, axis=1))
    seen = data.part(every_second)
    found = fit(seen, "survey")
    assert not found.supported
    error, sigma = error_of(found, seen, true[every_second])
    assert error < 1.25 * sigma
    assert sum("half the distance between your tracks" in line for line in found.calibration.warnings) == 1
    assert survey[2].supported


def test_a_field_is_rough_given_the_distance_of_tracks_or_at_the_shortest_length() -> None:
    """Lines 400 m apart; a straight line has no distance between tracks."""
    along = np.arange(0.0, 4_000.0, 20.0)
    turned = [along[:: 1 if line % 2 else -1] for line in range(11)]
    lines = np.concatenate([np.stack([x, np.full(len(x), 400.0 * i)], axis=1) for i, x in enumerate(turned)])
    assert next(too_rough(lines, 100.0)).code == "rough_crust"
    assert next(too_rough(lines, 290.0, 300.0)).code == "shortest_crust"
    assert not list(too_rough(lines, 290.0))
    assert not list(too_rough(lines[:200], 10.0))


def test_a_track_that_drifts_is_bent_to_where_the_crustal_field_repeats() -> None:
    """Positions that are slowly off by 150 m: as exact ones, where the fit knows that they may be."""
    data, true = flown()
    t = (data.time - data.time[0]) / np.ptp(data.time)
    drift = 150.0 * np.stack([np.sin(2.2 * np.pi * t + 0.3), np.cos(1.7 * np.pi * t) - 1.0, 0.0 * t], axis=1)
    off = replace(data, place=data.place + drift)
    bent = fit(off, "survey", position_sigma=100.0)
    assert bent.creep is None
    error, sigma = error_of(bent, data, true)
    assert error < 1.1 * NOISE
    assert sigma < 1.3 * NOISE


def slowly(data: Observations) -> Observations:
    """Return the survey performed in 6 h, a sample every 12 s, so that an offset has time to creep."""
    return replace(data, time=1e9 + 3.0 * (data.time - data.time[0]))


def test_a_mass_that_begins_to_move_unseen_is_not_a_creep_of_the_offset() -> None:
    """A motion may begin between two reports: samples near it are neither field nor drift."""
    data, true = flown(legs=14)
    leg, within = np.divmod(np.arange(len(data)), 110)
    moved = np.where(leg % 2, 1.0, -1.0) * np.array([-1.0, -0.2, 0.6, *np.ones(107)])[within]  # ends in 12 s
    begun = np.where(within == 0, 0.3 * np.where(leg % 2, 1.0, -1.0), 0.0)  # no report tells of it
    iron = np.outer(moved + begun, [300.0, -200.0, 150.0])
    seen = slowly(replace(data, field=data.field + iron, parameters=moved[:, None], names=("battpos",)))
    found = fit(seen)
    assert found.creep is None
    assert found.details["outliers"] == 0
    got = correct(found.calibration, seen.field, seen.parameters, seen.time)
    assert np.std((got.total - true)[within > 3]) < 1.2 * NOISE


@pytest.mark.parametrize("lag", [0.0, 600.0])
def test_offset_that_follows_the_temperature_is_found_and_written(lag: float) -> None:
    """2 nT/degC, and 10 degC between surface and depth: it is in the calibration, not in the crust."""
    data, true = flown()
    dive = np.arange(len(data)) % 220 / 110.0
    water = 20.0 - 10.0 * np.minimum(dive, 2.0 - dive)
    slope = np.array([2.0, -1.0, 1.5])
    warm = lagged(data.time, water, lag) - 15.0
    seen = replace(data, field=data.field + np.outer(warm, slope), temperature=water)
    found = fit(seen)
    assert found.calibration.channels == ("sensor_temperature",)
    (effect,) = found.calibration.effects
    assert isinstance(effect, ChannelEffect)
    assert effect.lag == lag
    np.testing.assert_allclose(found.calibration.coefficients[-3:], slope, atol=0.3)
    error, sigma = error_of(found, seen, true)
    assert error < 1.15 * NOISE
    assert 0.8 < error / sigma < 1.25
    assert "temperature_removed" in codes(found)
    again = decode_calibration(encode_calibration(found.calibration))
    assert again.effects == found.calibration.effects


def test_temperature_that_moves_nothing_is_left_out(survey: Survey) -> None:
    """A clean survey's calibration needs neither temperature nor drift, whatever telemetry the log has."""
    data, true, plain = survey
    water = 20.0 - 10.0 * np.abs(np.sin(data.time / 140.0))
    found = fit(slowly(replace(data, temperature=water)))
    assert found.calibration.channels == ()
    assert found.creep is None
    assert error_of(found, data, true)[0] < 1.05 * error_of(plain, data, true)[0]


def test_creep_of_the_offset_goes_neither_into_the_field_nor_into_the_map() -> None:
    """20 nT in 6 h: the map is as without it; the calibration holds the mean, its sigma the rest."""
    data, true = flown()
    data = slowly(data)
    t = np.linspace(-0.5, 0.5, len(data))[:, None]
    creep = 20.0 * t * [0.8, -0.5, 0.4] + 3.0 * np.sin(5.0 * t + [0.0, 1.0, 2.0])
    creep -= creep.mean(axis=0)
    seen = replace(data, field=data.field + creep)
    found = fit(seen)
    assert found.creep is not None
    assert rms(found.creep.offset_at(data.time) - creep) < 0.4 * rms(creep)
    still = found.creep.calibration
    value = correct(still, seen.field - found.creep.offset_at(data.time), data.parameters, data.time).total
    n = len(data)
    assert data.place is not None
    samples = Samples(
        data.place[:, :2], np.zeros(n), data.time, value - true.mean(), np.zeros(n, int), np.zeros(n, bool),
        (0.0, 0.0),
    )  # fmt: skip
    drawn, _ = gridded(samples).evaluate(samples.place)
    assert np.std(drawn - true) < 1.5 * NOISE
    error, sigma = error_of(found, seen, true)
    assert error > 2.0 * NOISE
    assert 0.4 < error / sigma < 1.5
    assert "offset_crept" in codes(found)


def test_an_offset_that_jumps_is_found_and_counted_in_the_sigma() -> None:
    """The offset jumps by 37 nT: the fit finds the crustal field, and the error of another day fits sigma."""
    data, true = flown()
    data = slowly(data)
    jump = np.outer(np.arange(len(data)) > 0.6 * len(data), [30.0, -20.0, 10.0])
    found = fit(replace(data, field=data.field + jump))
    assert found.creep is not None
    moved = jump - jump.mean(axis=0)
    assert rms(found.creep.offset_at(data.time) - moved) < 0.5 * rms(moved)
    assert 350.0 < found.details["crustal_field"]["length_m"] < 1400.0
    error, sigma = error_of(found, data, true)
    assert error > 2.0 * NOISE
    assert error < 1.25 * sigma
