"""Test the uncertainty that an extended calibration states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from posed import candidate, regressors_of, right
from scipy.linalg import inv

from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ClockEffect, PowersEffect, RateEffect, TimeEffect
from magbridge.calibration.model import Calibration
from magbridge.diagnose.assessment import level
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.columns import Candidate, absent_before, of_effect
from magbridge.diagnose.evidence import IDEAL
from magbridge.diagnose.extend import MODES, extend, flyable, relinearised, with_misfit
from magbridge.diagnose.improvement import map_error_variance, with_level_variance
from magbridge.diagnose.joint import Joint, fit_joint
from magbridge.diagnose.noise import fit_noise
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.survey import MAX_LAG, Past, Survey


def current(size: int) -> Candidate:
    """Return a current's effect with a given number of coefficients."""
    return candidate("current_field", np.zeros((9, size)), channel="amps")


def fit(coefficients: np.ndarray, calibration: int = 4) -> Joint:
    rng = np.random.default_rng(3)
    size = calibration + len(coefficients)
    X = rng.standard_normal((200, size)) @ (np.eye(size) + 0.3 * rng.standard_normal((size, size)))
    noise = fit_noise(rng.standard_normal(50), Past(np.ones(50, int), 1))
    return Joint(0.0, np.zeros(calibration), coefficients, inv(X.T @ X), noise, noise.scale, np.ones(size))


def test_a_misfit_grows_with_the_effect_and_points_anywhere() -> None:
    before = fit(np.array([3.0, 0.0, 0.0]))
    after = with_misfit([current(3)], before)
    own = slice(4, 7)
    wald = before.coefficients @ np.linalg.solve(before.covariance[own, own], before.coefficients)
    np.testing.assert_allclose(
        after.covariance[own, own], (1.0 + IDEAL**2 * wald / MODES) * before.covariance[own, own]
    )
    np.linalg.cholesky(after.covariance)
    assert np.all(np.diag(after.covariance) >= np.diag(before.covariance))
    # the calibration's part that has nothing to do with the cause is as well known as it was
    np.testing.assert_allclose(
        np.linalg.inv(after.covariance)[:4, :4], np.linalg.inv(before.covariance)[:4, :4], rtol=1e-6
    )


def test_what_is_hardly_seen_is_hardly_widened() -> None:
    before = fit(np.array([1e-3, 0.0]))
    np.testing.assert_allclose(with_misfit([current(2)], before).covariance, before.covariance, rtol=1e-4)


def test_a_calibration_from_turns_is_freed_of_a_filters_attenuation() -> None:
    """Runs turn in five minutes, the survey in an hour; the gain has absorbed the runs' attenuation."""
    rng, tau = np.random.default_rng(5), 1.5
    leg, row = np.divmod(np.arange(1600), 100)
    learned = leg < 8
    omega = 2.0 * np.pi / np.where(learned, 300.0, 4000.0)
    u, v = np.array([np.linalg.qr(rng.normal(size=(3, 2)))[0].T for _ in range(16)])[leg].swapaxes(0, 1)
    turning = np.cos(4.0 * omega * row)[:, None] * u + np.sin(4.0 * omega * row)[:, None] * v
    field = 5e4 * turning / np.sqrt(1.0 + (omega * tau) ** 2)[:, None] + rng.normal(size=(1600, 3))
    whole = right(1600)
    survey = replace(
        whole.survey, field=field, time=whole.survey.time + 1e4 * leg, dive=leg,
        fitted=learned, learned=learned, steps=np.where(row > 0, 1, MAX_LAG),
    )  # fmt: skip
    lost = 5e4 * 0.5 * (tau * 2.0 * np.pi / 300.0) ** 2
    calibration = replace(
        whole.calibration, coefficients=np.repeat([lost, 0.0], [3, 6]), covariance=np.diag(np.full(9, 100.0))
    )
    problem = pose(survey, calibration)
    *_, attenuated = CAUSES["filter_lag"].candidates(problem)
    found = fit_joint(problem, [attenuated.columns], 1)
    assert abs(found.coefficients[0] - tau**2) < 4.0 * np.sqrt(found.covariance[-1, -1]) < 0.2
    extended = extend(problem, [attenuated], found)
    assert extended.effects == ()
    off = [
        correct(one, field, survey.values(["p"]), survey.time).total[~learned].mean() - 5e4
        for one in (calibration, extended)
    ]
    assert off[0] > 15.0
    assert abs(off[1]) < 1.0
    assert level(problem, [attenuated], extended) is None  # the reference is right
    problem.let_go()
    delay = ClockEffect(cause="filter_lag", sign=-1.0)
    both = of_effect(problem, delay, 2.0, "s", names=("delay",), phi=np.ones((9, 1600))).joined_with(
        attenuated
    )
    assert extend(problem, [both], fit_joint(problem, [both.columns], 1)).effects == (delay,)


def skewed(whole: Problem, period: float) -> tuple[Survey, Calibration]:
    """Return a swaying vehicle and a calibration with the effects of a late channel and of a step.

    The channel is 0.3 s late.
    """
    angle = 2.0 * np.pi * (whole.survey.time - whole.survey.time[0]) / period
    theta, rate = 0.3 + 0.1 * np.sin(angle), 0.1 * np.cos(angle) * 2.0 * np.pi / period
    field = 5e4 * np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], axis=1)
    field[:, 1] += 0.3 * 5e4 * np.cos(theta) * rate
    survey = replace(whole.survey, field=field, reference=np.full(len(field), 5e4))
    effects = (
        RateEffect(cause="channel_skew", on="skew"),
        TimeEffect(cause="offset_step", shape="step", start=1.8e9),
    )
    calibration = replace(
        whole.calibration,
        effects=effects,
        coefficients=np.append(whole.calibration.coefficients, [0.0, 0.3, 0.0, 1.0, 2.0, 3.0]),
        covariance=np.diag(np.append(np.diag(whole.calibration.covariance), np.arange(1.0, 7.0))),
    )
    return survey, calibration


def test_a_rate_is_flown_with_where_a_difference_backwards_tells_it() -> None:
    survey, calibration = skewed(right(300), 200.0)
    assert flyable(survey, calibration) == (calibration, [])


def test_a_rate_that_is_noise_live_is_left_out() -> None:
    """A sway with a period of two and a half samples is noise in a live rate of change."""
    survey, calibration = skewed(right(300), 10.0)
    calm, dropped = flyable(survey, calibration)
    assert dropped == [0]
    assert [effect.kind for effect in calm.effects] == ["time"]
    np.testing.assert_array_equal(calm.coefficients[-3:], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(np.diag(calm.covariance)[-3:], [4.0, 5.0, 6.0])


def test_what_has_come_since_is_not_in_the_calibrations_logs() -> None:
    """A field across the magnitude in the second half: linearised again, its value is right."""
    whole = right(300)
    learned, there = np.arange(300) < 150, np.array([900.0, -600.0, 300.0])
    survey = replace(whole.survey, learned=learned, field=whole.survey.field + there * ~learned[:, None])
    problem = pose(survey, whole.calibration)
    effect = PowersEffect(cause="unmodelled_actuator", channel="p", centre=-1e9, scale=1e9, order=1)
    phi = regressors_of(survey, whole.calibration, effect)
    lasting = of_effect(problem, effect, 100.0, "nT", channel="p", phi=phi)
    late = absent_before(lasting, learned)
    assert not late.columns(slice(0, 150)).any()
    np.testing.assert_array_equal(late.columns(slice(150, 300)), lasting.columns(slice(150, 300)))
    fit = fit_joint(problem, [late.columns], 1)
    _, _, settled = relinearised(problem, [late], fit)
    np.testing.assert_allclose(settled.coefficients * late.width, there, atol=0.5)
    np.testing.assert_allclose(settled.residual, 0.0, atol=0.5)


def test_a_maps_error_is_in_the_level_of_what_was_fitted_to_the_same_map() -> None:
    """A map that is 30 nT off along the track: half of it may be its mean."""
    whole = right(300)
    wave = 30.0 * np.sqrt(2.0) * np.sin(0.1 * np.arange(300))
    chart = candidate("map_error", wave, about="place")
    found = fit_joint(replace(whole, residual=whole.residual + wave), [chart.columns], 1)
    new, seen = (
        replace(whole, survey=replace(whole.survey, learned=np.full(300, learned)))
        for learned in (False, True)
    )
    extended = extend(whole, [chart], found)
    assert map_error_variance(new, [chart], found) == 0.0
    spread = with_level_variance(extended, map_error_variance(seen, [chart], found))
    before, after = (
        correct(c, whole.survey.field, whole.survey.values(c.channels), whole.survey.time).sigma
        for c in (extended, spread)
    )
    np.testing.assert_allclose(np.sqrt(after**2 - before**2), 15.0, rtol=0.02)
