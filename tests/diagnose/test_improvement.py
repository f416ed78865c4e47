"""Test the improvement that held-out dives show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from posed import calibrated, surveyed, walk
from scipy.stats import multivariate_normal

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Noise, identity
from magbridge.diagnose.improvement import level_change_variance
from magbridge.diagnose.joint import Joint, fit_joint, held_out
from magbridge.diagnose.problem import Problem, isotropic, pose
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import MAX_LAG, load_survey
from sitl import load, simulate
from sitl.dataset import segments

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
