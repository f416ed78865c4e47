"""Test the uncertainty of an extended calibration, and the improvement that held-out dives show."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from posed import calibrated, candidate, regressors_of, right, surveyed, walk
from scipy.linalg import inv
from scipy.stats import multivariate_normal

from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ClockEffect, PowersEffect, RateEffect, TimeEffect
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration, Noise, identity
from magbridge.diagnose.assessment import level
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.columns import Candidate, absent_before, of_effect
from magbridge.diagnose.evidence import IDEAL
from magbridge.diagnose.extend import MODES, extend, flyable, relinearised, with_misfit
from magbridge.diagnose.improvement import level_change_variance, map_error_variance, with_level_variance
from magbridge.diagnose.joint import Joint, fit_joint, held_out
from magbridge.diagnose.noise import fit_noise
from magbridge.diagnose.problem import Problem, isotropic, pose
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import MAX_LAG, Past, Survey, load_survey
from sitl import load, simulate
from sitl.dataset import segments


def current(size: int) -> Candidate:
    """Return a current's effect with a given number of coefficients."""
    return candidate("current_field", np.zeros((9, size)), channel="amps")


def fitted(coefficients: np.ndarray, calibration: int = 4) -> Joint:
    rng = np.random.default_rng(3)
    size = calibration + len(coefficients)
    X = rng.standard_normal((200, size)) @ (np.eye(size) + 0.3 * rng.standard_normal((size, size)))
    noise = fit_noise(rng.standard_normal(50), Past(np.ones(50, int), 1))
    return Joint(0.0, np.zeros(calibration), coefficients, inv(X.T @ X), noise, noise.scale, np.ones(size))


def test_a_misfit_grows_with_the_effect_and_points_anywhere() -> None:
    before = fitted(np.array([3.0, 0.0, 0.0]))
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


# ---- The improvement that held-out dives show --------------------------------------------------------------


DIVES = 5


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Return five dives with turns, calibrated, with 1 nT of noise."""
    rng = np.random.default_rng(4)
    n = 40 * DIVES
    steps, dive = np.where(np.arange(n) % 40 > 0, 1, MAX_LAG), np.arange(n) // 40
    survey = surveyed(walk(n, rng), np.sin(np.arange(n) / 9.0), steps=steps, dive=dive)
    noisy = replace(survey, field=survey.field + rng.normal(size=(n, 3)))
    return pose(noisy, calibrated(np.zeros(18)))


def gaussian(fit: Joint) -> Joint:
    """Return the fit with Gaussian noise, for which the formula is exact."""
    return replace(fit, noise=replace(fit.noise, nu=1e12))


def test_the_score_is_the_density_of_each_dive_given_the_others(problem: Problem) -> None:
    shape = np.sin(np.arange(len(problem)) / 17.0)[:, None]
    columns = [lambda rows: 3.0 * shape[rows]]
    fit = gaussian(
        fit_joint(replace(problem, residual=problem.residual + 2.0 * shape[:, 0]), columns, 1, rounds=20)
    )
    posed = replace(problem, residual=problem.residual + 2.0 * shape[:, 0])
    c = np.append(fit.z, fit.coefficients)
    A = fit.noise.filter(np.hstack([posed.calibration_rows(slice(None)), 3.0 * shape]))
    y = fit.noise.response(posed.residual)
    white = fit.noise.response(fit.residual)
    assert np.abs(A.T @ white - fit.prior * (c - np.append(posed.centre, 0.0))).max() < 0.05 * np.abs(A).max()
    moved = fit.z - posed.centre  # the calibration's own logs: their density at the fit
    expected = fit.noise.log_likelihood + 0.5 * float(white @ white - fit.prior[: len(moved)] @ moved**2)
    for dive in range(DIVES):
        out = posed.survey.dive == dive
        P = A[~out].T @ A[~out] + np.diag(fit.prior)
        mean = np.linalg.solve(P, A[~out].T @ y[~out] + fit.prior * np.append(posed.centre, 0.0))
        spread = np.eye(out.sum()) + A[out] @ np.linalg.solve(P, A[out].T)
        predicted = multivariate_normal(A[out] @ mean, spread).logpdf(y[out])
        expected += predicted + 0.5 * out.sum() * np.log(2.0 * np.pi)
    assert held_out(posed, columns, fit).score == pytest.approx(expected, abs=0.05)


def test_what_is_there_wins_on_the_dives_left_out_and_what_is_not_does_not(problem: Problem) -> None:
    shape = np.sin(np.arange(len(problem)) / 17.0)[:, None]
    columns = [lambda rows: 3.0 * shape[rows]]
    for size, wins in ((2.0, True), (0.0, False)):
        posed = replace(problem, residual=problem.residual + size * shape[:, 0])
        scores = [held_out(posed, some, fit_joint(posed, some, 1)).score for some in (columns, [])]
        assert (scores[0] > scores[1] + 3.0) == wins


def test_what_the_calibration_would_have_to_become_counts_against_it(problem: Problem) -> None:
    """Every other dive predicts a constant that a calibration absorbs; the calibration does not."""
    absorbed = problem.coefficient_jacobian[:, 14]  # what these dives show best
    posed = replace(problem, residual=problem.residual - 8.0 * absorbed)
    columns = [lambda rows: 8.0 * absorbed[rows, None]]
    scores = [held_out(posed, some, fit_joint(posed, some, 1)).score for some in (columns, [])]
    assert scores[0] > scores[1] + 10.0


def test_what_acts_in_one_dive_only_is_not_a_surprise_that_counts_against_it(problem: Problem) -> None:
    """The prediction of the only dive with an effect has the prior's uncertainty, not a contradicted zero."""
    once = (problem.survey.dive == 2).astype(float)[:, None]
    columns = [lambda rows: 10.0 * once[rows]]
    posed = replace(problem, residual=problem.residual + 6.0 * once[:, 0])
    with_it, without = (held_out(posed, some, fit_joint(posed, some, 1)) for some in (columns, []))
    assert with_it.score > without.score
    assert np.std(with_it.residual[once[:, 0] > 0]) < 3.0


@pytest.mark.parametrize(("change", "sigma"), [(60.0, 2.0**0.5 * 60.0), (0.5, 0.0)])
def test_a_level_that_moved_beyond_its_sigma_may_move_as_much_again(
    problem: Problem, change: float, sigma: float
) -> None:
    given = problem.calibration
    extended = replace(given, coefficients=given.coefficients + change * isotropic(given))
    assert np.sqrt(level_change_variance(problem, extended)) == pytest.approx(sigma, rel=0.1)


# ---- a log that the calibration was fitted to, diagnosed all the same --------------------------------------


def test_what_a_calibration_learned_from_a_log_does_not_count_twice() -> None:
    """With the calibration's own fit projected out, the log shows a filter's attenuation in the turns."""
    ds = segments(simulate(load("demo"), 2))["calibration"]
    calibration = fit(observations(ds, ("battpos", "ballast")), "auto").calibration

    def named(*again: xr.Dataset) -> set[str]:
        found = diagnose([ds], calibration, training_logs=again).diagnosis
        return {finding.candidate.cause for finding in found.findings}

    assert "filter_lag" in named(ds) - named()


def test_moves_that_the_training_logs_determine_are_not_refused() -> None:
    """The tutorial in docs/when-the-model-is-wrong.md: the water is 8 degC warmer than in the runs."""
    flight = simulate(load("warming"), 2).isel(time=slice(None, None, 2))
    runs, survey = (flight.sel(time=chosen) for chosen in (flight["run"] <= 10, flight["run"] > 10))
    calibration = fit(observations(runs, ("battpos", "ballast")), "auto").calibration
    found = diagnose([survey], calibration, training_logs=[runs]).diagnosis
    assert found.refused == ""
    assert found.improvement.before > 10.0
    assert found.improvement.after < 1.5


def test_a_report_names_and_counts_the_dives_of_what_is_diagnosed_alone() -> None:
    """The survey's dives have equal numbers and source, with and without the log of the calibration."""
    parts = segments(simulate(load("survey"), 2))
    survey = parts["survey"].drop_vars("run").assign_attrs(source="survey.nc")
    learned = parts["calibration"].assign_attrs(source="runs.nc")
    calibration = replace(identity(), noise=Noise(1.0))
    alone, both = load_survey([survey], calibration), load_survey([survey], calibration, [learned])
    assert len(set(both.dive[~both.learned].tolist())) == len(set(alone.dive.tolist())) > 1
    assert alone.source == both.source == "survey.nc"
    new = both.dive[~both.learned]
    np.testing.assert_array_equal(new - new[0], alone.dive - alone.dive[0])
    assert not set(both.dive[both.learned].tolist()) & set(new.tolist())
