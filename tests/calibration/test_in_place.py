"""A survey without calibration runs and without a map: the vehicle's field and the rock, told apart."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ChannelEffect, lagged
from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.fitting import rounds
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.crossings import too_rough
from magbridge.calibration.fitting.field_nodes import nodes_for
from magbridge.calibration.fitting.fit import LEVEL, Fit, fit
from magbridge.calibration.fitting.joint import Linear, Sums, add_up, eliminate
from magbridge.calibration.fitting.level import apart_from_level, level_of, with_level
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import pose
from magbridge.calibration.model import Noise, identity
from magbridge.field.place.blocks import Factor, near_inverse
from magbridge.field.place.matern import Matern
from magbridge.field.place.nodes import nodes_near
from magbridge.survey.gridding import gridded
from magbridge.survey.samples import Samples

MAIN = np.array([18_000.0, -5_000.0, 48_000.0])
IRON = np.eye(3) + np.array([[0.012, 0.003, -0.004], [0.003, -0.008, 0.002], [-0.004, 0.002, 0.005]])
OFFSET = np.array([900.0, -600.0, 1200.0])
NOISE = 1.0

Survey = tuple[Observations, FloatArray, Fit]


def flown(
    *, legs: int = 16, straight: bool = False, zigzag: bool = False, seed: int = 3
) -> tuple[Observations, FloatArray]:
    """Fly dives and climbs criss-cross over rock of 40 nT; return what was read, and the true total field."""
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
    k, phase = rng.normal(0, 1 / 700.0, (400, 2)), rng.uniform(0, 2 * np.pi, 400)
    rock = 40.0 * np.sqrt(2 / 400) * np.cos(place[:, :2] @ k.T + phase).sum(axis=1)
    F_0 = float(np.linalg.norm(MAIN))
    true = F_0 + rock
    ned = MAIN * (true / F_0)[:, None]
    attitude = np.stack([roll, pitch, heading], axis=1)
    field = field_body(attitude, ned) @ np.linalg.inv(IRON).T + OFFSET + rng.normal(0, NOISE, (n, 3))
    data = Observations(
        field=field, reference=np.full(n, F_0), parameters=np.empty((n, 0)),
        time=1e9 + dt * np.arange(n, dtype=float), runs=leg, attitude=attitude,
        reference_ned=np.tile(MAIN, (n, 1)), place=place, unmapped=np.ones(n),
    )  # fmt: skip
    return data, true


@pytest.fixture(scope="module")
def survey() -> Survey:
    data, true = flown()
    return data, true, fit(data)


def test_field_about_its_mean(survey: Survey) -> None:
    """The corrected field reaches the noise, rock or not, and its sigma says so, level apart."""
    data, true, found = survey
    assert found.calibration.method == "survey"
    got = correct(found.calibration, data.field, np.empty((len(data), 0)), data.time)
    error = got.total - true
    assert np.std(error) < 1.15 * NOISE
    level = level_of(found.calibration, data.field, np.empty((len(data), 0)), data.time)
    apart = np.sqrt(got.sigma**2 - level**2)
    assert 0.8 < np.std(error) / np.median(apart) < 1.25


def test_level_is_known_as_well_as_the_reference(survey: Survey) -> None:
    """An IGRF alone does not know the level: the sigma counts that, and says how much of it there is."""
    data, true, found = survey
    level = found.calibration.reference.level_sigma
    assert 0.8 * LEVEL < level < 1.5 * LEVEL
    got = correct(found.calibration, data.field, np.empty((len(data), 0)), data.time)
    assert got.sigma.min() > 0.9 * level
    assert abs(np.mean(got.total - true)) < 2.5 * level


def test_rock_is_not_taken_for_noise(survey: Survey) -> None:
    """Its size and length are the rock's, its noise the sensor's."""
    rock = survey[2].details["rock"]
    assert 20.0 < rock["size_nT"] < 100.0
    assert 300.0 < rock["length_m"] < 2000.0
    assert survey[2].calibration.noise.sensor == pytest.approx(NOISE, rel=0.1)


def test_a_level_that_the_reference_contradicts_is_not_believed(survey: Survey) -> None:
    """Its sigma spans what was found; what is apart from it stays."""
    data, _, found = survey
    samples = pose(data, 3, None, None).samples
    doubted, believed = (with_level(found.calibration, samples, bias, LEVEL) for bias in (400.0, 200.0))
    assert doubted.reference.level_sigma == 400.0
    assert believed.reference.level_sigma == pytest.approx(found.calibration.reference.level_sigma, rel=0.01)
    apart = apart_from_level(believed).covariance
    tiny = 1e-6 * float(np.abs(believed.covariance).max())
    np.testing.assert_allclose(apart_from_level(doubted).covariance, apart, atol=tiny)
    got = correct(doubted, data.field, np.empty((len(data), 0)), data.time)
    assert got.sigma.min() > 390.0


def test_level_stands_in_the_file(survey: Survey) -> None:
    calibration = survey[2].calibration
    again = decode_calibration(encode_calibration(calibration))
    assert again.reference == calibration.reference
    assert again.level == calibration.level
    assert again.reference.bias_sigma == LEVEL


def test_level_is_less_than_the_sigma_by_the_noise_at_least() -> None:
    """Whatever it does to the offset: 150 nT across the field lengthen it by 0.2 nT, which is no level."""
    w = np.zeros(9)
    w[:3], w[6] = LEVEL / np.sqrt(3.0), 150.0
    still = identity()
    known = replace(still, covariance=np.outer(w, w), level=tuple(w), noise=Noise(NOISE), method="survey")
    field = np.array([[0.0, 0.0, 50_000.0], [0.0, 30_000.0, 40_000.0]])
    got = correct(known, field, np.empty((2, 0)), np.arange(2.0))
    level = level_of(known, field, np.empty((2, 0)), np.arange(2.0))
    np.testing.assert_allclose(got.sigma**2 - level**2, NOISE**2, atol=0.5)


def test_true_field_is_fitted_as_before() -> None:
    """Where the true field is known at every sample there is no rock, and no level either."""
    data, true = flown(legs=6)
    known = Observations(field=data.field, reference=true, parameters=data.parameters, time=data.time)
    found = fit(known)
    assert found.calibration.method in {"auto", "nominal"}  # which of both predicts parts left out better
    assert found.calibration.reference.level_sigma == 0.0


def error_of(found: Fit, data: Observations, true: FloatArray) -> tuple[float, float]:
    """Return the corrected field's error and its sigma, about the mean, nT."""
    channels = data.channels(found.calibration)
    got = correct(found.calibration, data.field, channels, data.time)
    level = level_of(found.calibration, data.field, channels, data.time)
    return float(np.std(got.total - true)), float(np.sqrt(np.median(got.sigma**2 - level**2)))


def test_straight_line_is_not_supported() -> None:
    """On one straight line rock and heading are one: the pilot is told, and --strict refuses."""
    data, true = flown(legs=8, straight=True)
    found = fit(data)
    assert not found.supported
    error, sigma = error_of(found, data, true)
    assert error < 1.5 * sigma
    assert any("never crossed your own track" in line for line in found.warnings)


def test_a_long_survey_is_searched_with_the_part_about_its_middle(
    survey: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rock's size and length are that part's, the calibration and the nodes those of all samples."""
    used, few = [], rounds._Rounds._few

    def counted(own: rounds._Rounds, field: Matern) -> Sums:
        sums = few(own, field)
        used.append(sums.samples)
        return sums

    monkeypatch.setattr(rounds, "SEARCHED", 600)
    monkeypatch.setattr(rounds, "WIDE", 0.0)
    monkeypatch.setattr(rounds._Rounds, "_few", counted)
    data, true, _ = survey
    found = fit(data)
    assert 500 < max(used) <= 601
    assert 300.0 < found.details["rock"]["length_m"] < 2000.0
    error, sigma = error_of(found, data, true)
    assert error < 1.15 * NOISE
    assert 0.8 < error / sigma < 1.25


def test_a_long_log_comes_to_rest_with_few_samples_and_ends_with_all(
    survey: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What every sixth sample tells is a start; calibration and sigma are those of all samples."""
    data, true, _ = survey
    whole = fit(data)
    used, sums = [], rounds._Rounds._sums

    def counted(own: rounds._Rounds, *args: Any) -> Sums:
        found = sums(own, *args)
        used.append(found.samples)
        return found

    monkeypatch.setattr(rounds, "SETTLED", len(data) // 6)
    monkeypatch.setattr(rounds._Rounds, "_sums", counted)
    found = fit(data)
    all_of_them = [number for number in used if number > len(data) // 2]
    assert used[-1] == all_of_them[-1]
    assert len(all_of_them) < len(used) / 4
    error, sigma = error_of(found, data, true)
    assert error < 1.15 * NOISE
    assert 0.8 < error / sigma < 1.25
    assert found.calibration.noise.sensor == pytest.approx(whole.calibration.noise.sensor, rel=0.03)


def test_steps_that_are_shortened_get_the_rounds_they_take(
    survey: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As from a start far off: after a dozen rounds the residuals still move."""
    damped = rounds._Rounds._damped
    monkeypatch.setattr(
        rounds._Rounds, "_damped", lambda own, step, reduced, field: damped(own, 0.2 * step, reduced, field)
    )
    data, true, _ = survey
    error, sigma = error_of(fit(data), data, true)
    assert error < 1.08 * NOISE
    assert 0.8 < error / sigma < 1.25


def test_a_zigzag_tells_rock_from_heading_without_a_crossing() -> None:
    """Rock is smooth about a turn, and what changes there is the vehicle's."""
    data, true = flown(zigzag=True)
    found = fit(data)
    assert found.calibration.method == "survey"
    error, sigma = error_of(found, data, true)
    assert error < 1.15 * NOISE
    assert 0.8 < error / sigma < 1.25


def test_a_jump_in_position_is_left_out_and_told() -> None:
    """A fix on the other side of the Earth must not spread the nodes there."""
    data, true = flown(legs=8)
    assert data.place is not None
    place = data.place.copy()
    place[100:103, 0] += 8e6
    found = fit(replace(data, place=place))
    error, sigma = error_of(found, data, true)
    assert 0.8 < error / sigma < 1.25
    assert any("3 samples far from all others" in line for line in found.warnings)
    assert sum(run.samples for run in found.calibration.runs) == len(data) - 3


def test_samples_without_a_position_are_told_apart_from_a_jump() -> None:
    """A hole in the positions is no jump; a fix that moves the rest of the track is one."""
    data, true = flown(legs=8)
    assert data.place is not None
    hole, moved = data.place.copy(), data.place.copy()
    hole[300:350] = np.nan
    moved[500:, 0] += 600.0
    holed, jumped = (fit(replace(data, place=place), "survey") for place in (hole, moved))
    assert "50 samples without a position: left out" in holed.warnings
    assert any("the position jumps by 60" in line and "--position-sigma" in line for line in jumped.warnings)
    for found in (holed, jumped):
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
    """Return the data with further rock of 30 nT that changes over a `length`, m."""
    rng = np.random.default_rng(0)
    assert data.place is not None
    k, phase = rng.normal(0, 1 / length, (400, 2)), rng.uniform(0, 2 * np.pi, 400)
    rock = 30.0 * np.sqrt(2 / 400) * np.cos(data.place[:, :2] @ k.T + phase).sum(axis=1)
    return replace(data, field=data.field * (1.0 + rock / np.linalg.norm(data.field, axis=1))[:, None])


def test_rock_rougher_than_the_tracks_is_not_supported(survey: Survey) -> None:
    """Rock that changes over 35 m, tracks 90 m apart: one line says so, and the sigma holds."""
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


def test_rock_is_rough_beside_the_distance_of_tracks_or_at_the_shortest_length() -> None:
    """Lines 400 m apart; a straight line has no distance between tracks."""
    along = np.arange(0.0, 4_000.0, 20.0)
    turned = [along[:: 1 if line % 2 else -1] for line in range(11)]
    lines = np.concatenate([np.stack([x, np.full(len(x), 400.0 * i)], axis=1) for i, x in enumerate(turned)])
    assert "(about 3" in next(too_rough(lines, 100.0))
    assert "shortest length that these samples can tell being 300 m" in next(too_rough(lines, 290.0, 300.0))
    assert not list(too_rough(lines, 290.0))
    assert not list(too_rough(lines[:200], 10.0))


def test_an_hour_is_fitted_with_an_honest_sigma() -> None:
    data, true = flown(legs=8)
    error, sigma = error_of(fit(data, "survey"), data, true)
    assert 0.5 < error / sigma < 1.25


def test_a_track_that_drifts_is_bent_to_where_the_rock_repeats() -> None:
    """Positions that are slowly off by 150 m: as exact ones, where the fit knows that they may be."""
    data, true = flown(legs=20)
    t = (data.time - data.time[0]) / np.ptp(data.time)
    drift = 150.0 * np.stack([np.sin(2.2 * np.pi * t + 0.3), np.cos(1.7 * np.pi * t) - 1.0, 0.0 * t], axis=1)
    off = replace(data, place=data.place + drift)
    still, bent = (fit(off, "survey", position_sigma=sigma) for sigma in (0.0, 100.0))
    assert still.creep is not None  # what else should it be taken for: then the sigma counts it
    assert bent.creep is None
    error, sigma = error_of(bent, data, true)
    assert error < 1.1 * NOISE
    assert sigma < 1.3 * NOISE


def slowly(data: Observations) -> Observations:
    """Return the same survey flown in 6 h, a sample every 12 s: time for an offset to creep."""
    return replace(data, time=1e9 + 3.0 * (data.time - data.time[0]))


def test_a_mass_that_begins_to_move_unseen_is_no_creep_of_the_offset() -> None:
    """Between two reports a motion may have begun: the samples beside one are neither rock nor drift."""
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
    """2 nT/degC, and 10 degC between surface and depth: it is in the calibration, and not in the rock."""
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
    assert any("follows its temperature" in line for line in found.warnings)
    again = decode_calibration(encode_calibration(found.calibration))
    assert again.effects == found.calibration.effects


def test_temperature_that_moves_nothing_is_left_out(survey: Survey) -> None:
    """A clean survey's calibration needs no temperature and knows of no creep, whatever the log holds."""
    data, true, plain = survey
    water = 20.0 - 10.0 * np.abs(np.sin(data.time / 140.0))
    found = fit(slowly(replace(data, temperature=water)))
    assert found.calibration.channels == ()
    assert found.creep is None
    assert error_of(found, data, true)[0] < 1.05 * error_of(plain, data, true)[0]


def test_creep_of_the_offset_goes_neither_into_rock_nor_into_the_map() -> None:
    """20 nT in 6 h: the map is as without it; the calibration holds the mean, its sigma the rest."""
    data, true = flown()
    data = slowly(data)
    t = np.linspace(-0.5, 0.5, len(data))[:, None]
    creep = 20.0 * t * [0.8, -0.5, 0.4] + 3.0 * np.sin(5.0 * t + [0.0, 1.0, 2.0])
    creep -= creep.mean(axis=0)
    seen = replace(data, field=data.field + creep)
    found = fit(seen)
    assert found.creep is not None
    assert np.sqrt(np.mean((found.creep.at(data.time) - creep) ** 2)) < 0.4 * np.sqrt(np.mean(creep**2))
    still = found.creep.calibration
    value = correct(still, seen.field - found.creep.at(data.time), data.parameters, data.time).total
    n = len(data)
    assert data.place is not None
    samples = Samples(
        data.place[:, :2], np.zeros(n), data.time, value - true.mean(), np.zeros(n, int), np.zeros(n, bool),
        (0.0, 0.0),
    )  # fmt: skip
    drawn, _ = gridded(samples).at(samples.place)
    assert np.std(drawn - true) < 1.5 * NOISE
    error, sigma = error_of(found, seen, true)
    assert error > 2.0 * NOISE
    assert 0.4 < error / sigma < 1.5
    assert any("crept by" in line for line in found.warnings)


def test_an_offset_that_jumps_is_found_and_counted_in_the_sigma() -> None:
    """By 37 nT in the survey: the rock is found, and another day is off by no more than is said."""
    data, true = flown()
    data = slowly(data)
    jump = np.outer(np.arange(len(data)) > 0.6 * len(data), [30.0, -20.0, 10.0])
    found = fit(replace(data, field=data.field + jump))
    assert found.creep is not None
    moved = jump - jump.mean(axis=0)
    assert np.sqrt(np.mean((found.creep.at(data.time) - moved) ** 2)) < 0.5 * np.sqrt(np.mean(moved**2))
    assert 350.0 < found.details["rock"]["length_m"] < 1400.0
    error, sigma = error_of(found, data, true)
    assert error > 2.0 * NOISE
    assert error < 1.25 * sigma


@pytest.mark.parametrize(
    ("alpha", "harmonic", "buried"),
    [(2, False, False), (3, False, False), (4, False, False), (4, True, False), (4, False, True)],
)
def test_prior_has_unit_variance_and_its_inverse_is_exact(alpha: int, harmonic: bool, buried: bool) -> None:
    """Away from edges the splines' variance is 1; blocks of the inverse are those of the dense one.

    Of sources at a depth the edge is felt farther.
    """
    rng = np.random.default_rng(alpha)
    place = np.cumsum(rng.normal(0, 60, (1500, 2)), axis=0)
    field = Matern(nodes_near(place, 400.0, 1000.0), 1000.0, alpha, harmonic, buried)
    Q = field.precision.toarray()
    B = field.basis(place[::9])
    variance = near_inverse(field.precision, field.edges).variances(B)
    np.testing.assert_allclose(variance, np.einsum("ni,ij,nj->n", B.toarray(), np.linalg.inv(Q), B.toarray()))
    np.testing.assert_allclose(variance, 1.0, atol=0.2 if buried else 0.05)
    assert field.log_determinant == pytest.approx(np.linalg.slogdet(Q)[1])
    factor = Factor(field.precision)
    assert factor.log_determinant == pytest.approx(field.log_determinant)
    root = factor.draw(np.eye(field.nodes.size))
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(Q), atol=1e-6 * np.abs(np.linalg.inv(Q)).max())


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.99])
def test_sums_are_those_of_the_whitened_samples_however_they_are_cut(rho: float) -> None:
    """A gap in the log, one just where a piece ends, and a sample alone."""
    rng = np.random.default_rng(4)
    V, B = rng.normal(size=(12, 3)), rng.normal(size=(12, 5))
    follows = np.ones(12, bool)
    follows[[0, 3, 4, 8]] = False
    pieces = [(0, 4), (3, 9), (8, 12)]
    sums = add_up(Linear(V[a:b], csr_array(B[a:b]), follows[a:b], overlap=a > 0) for a, b in pieces)
    both = np.hstack([V, B])
    white = both.copy()
    white[follows] = (both[follows] - rho * both[np.flatnonzero(follows) - 1]) / np.sqrt(1.0 - rho**2)
    found, expected = sums.whitened(rho), white.T @ white
    assert (sums.samples, sums.pairs) == (12, 8)
    np.testing.assert_allclose(found.VV, expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found.VB, expected[:3, 3:], atol=1e-9)
    np.testing.assert_allclose(found.BB.toarray(), expected[3:, 3:], atol=1e-9)


def test_sources_at_a_depth_reach_far_and_are_smooth_nearby() -> None:
    """Their correlation begins to fall as a Gaussian's of the length, and ends as a layer of dipoles'."""
    length = 600.0
    place = np.stack([np.linspace(0.0, 4.0 * length, 33), np.zeros(33)], axis=1)
    field = Matern(nodes_near(place, 120.0, 3000.0), length, 4, buried=True)
    B = field.basis(place)
    covariance = B @ Factor(field.precision).solve(B.T.toarray())
    correlation = covariance[0] / covariance[0, 0]
    depth = length * np.sqrt(0.75)  # of a layer whose correlation (1 + r²/4d²)^-3/2 begins to fall so
    layer = (1.0 + place[:, 0] ** 2 / (4.0 * depth**2)) ** -1.5
    np.testing.assert_allclose(correlation, layer, atol=0.06)
    assert correlation[24] > 10.0 * np.exp(-0.5 * 3.0**2)


def test_nodes_too_fine_for_a_long_field_are_refused() -> None:
    """Where the prior is singular to rounding, the evidence is noise that a search would climb."""
    place = np.stack([np.linspace(0.0, 6000.0, 200), np.zeros(200)], axis=1)
    values = np.sin(place[:, 0] / 900.0)

    def evidence(fine: float) -> float:
        field = Matern(nodes_near(place, 1500.0 / fine, 1500.0), 1500.0, 16)
        sums = add_up([Linear(np.ones((200, 1)) * values[:, None], field.basis(place), np.zeros(200, bool))])
        reduced = eliminate(sums, field, 50.0, 0.0)
        return reduced.log_evidence - 0.5 * reduced.quadratic.c_0

    assert evidence(5.0) == pytest.approx(evidence(4.0), abs=0.5)
    with pytest.raises(np.linalg.LinAlgError, match="too fine"):
        evidence(9.0)


def test_nodes_are_as_fine_as_the_area_allows() -> None:
    """A rough field over 100 km of lines: coarser nodes, and no more of them than asked for."""
    x = np.arange(0.0, 100e3, 50.0)
    place = np.concatenate([np.stack([x, 0.0 * x + east], axis=1) for east in np.arange(0.0, 60e3, 1e3)])
    assert 0.7 * 4_000 < nodes_for(place, 300.0, 2, 4_000).size < 1.06 * 4_000
    assert nodes_for(place[:100], 300.0, 2).spacing == pytest.approx(300.0 / 8.0)


@pytest.mark.parametrize("waves", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("deeper", [-150.0, -50.0, 80.0, 150.0])
def test_a_wave_falls_off_upwards_as_laplace_demands(waves: float, deeper: float) -> None:
    """A wave of wave number k is larger by exp(k d) where the track is d deeper."""
    length = 900.0
    x = np.linspace(-4000.0, 4000.0, 400)
    field = Matern(nodes_near(np.stack([x, 0.0 * x], axis=1), 300.0, 2000.0), length, 6, harmonic=True)
    k = waves / length
    u = np.cos(k * field.nodes.places[:, 0])
    inner = np.stack([np.linspace(-1500.0, 1500.0, 60), np.zeros(60)], axis=1)
    here, there = (field.basis(inner, depth) @ u for depth in (0.0, deeper))
    np.testing.assert_allclose(there, np.exp(k * deeper) * here, atol=0.012 * np.abs(here).max())


def test_slopes_are_the_splines_derivatives() -> None:
    nodes = nodes_near(np.array([[0.0, 0.0], [3000.0, 500.0]]), 300.0, 900.0)
    rng = np.random.default_rng(1)
    w, x = rng.normal(size=nodes.size), np.array([[100.0, 50.0], [2900.0, 600.0]])
    step = np.array([[0.5, 0.0]])
    for harmonic in (False, True):
        field = Matern(nodes, 900.0, 4, harmonic)
        north, east = (slope @ w for slope in field.slopes(x))
        np.testing.assert_allclose(north, (field.basis(x + step) - field.basis(x - step)) @ w, rtol=1e-4)
        np.testing.assert_allclose(
            east, (field.basis(x + step[:, ::-1]) - field.basis(x - step[:, ::-1])) @ w, rtol=1e-4
        )
