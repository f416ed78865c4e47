"""Nonlinear parameters are estimates, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import candidate, right

from magbridge.diagnose.columns import Candidate, GridPoint
from magbridge.diagnose.evidence import log_bayes
from magbridge.diagnose.extend import loosened
from magbridge.diagnose.joint import Joint, fit_joint, normal
from magbridge.diagnose.problem import Problem

ROWS, LAG, CELL = 300, 60.0, 40.0


def decay(lag: float) -> Candidate:
    """A decay of unknown amplitude and lag."""
    x = np.exp(-np.arange(ROWS) / lag)
    return candidate("made", x, point=GridPoint({"lag": (lag, "s")}, decay, cells=(CELL,)))


@pytest.fixture(scope="module")
def problem() -> Problem:
    noise = np.random.default_rng(6).normal(size=ROWS)
    return replace(right(ROWS), residual=9.0 * np.exp(-np.arange(ROWS) / LAG) + noise)


def fitted(problem: Problem, *model: Candidate) -> Joint:
    return fit_joint(problem, [one.columns for one in model], 1)


def test_the_covariance_is_that_of_a_fit_in_which_the_lag_is_free(problem: Problem) -> None:
    """Against the inverse of the whole information, with the derivative by the lag as one more column."""
    one = decay(LAG)
    fit = fitted(problem, one)
    t = np.arange(ROWS)
    slope = CELL * fit.coefficients[0] * t / LAG**2 * np.exp(-t / LAG)

    def every(rows: slice) -> np.ndarray:
        return np.column_stack([problem.calibration_rows(rows), one.columns(rows), slope[rows]])

    P = normal(every, fit.noise.response(fit.residual), fit.noise)[0] + np.diag(np.append(fit.prior, 1.0))
    expected = np.linalg.inv(P)[:-1, :-1]
    found = loosened(problem, [one], [one.columns], fit).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(expected)), rtol=0.03)
    assert found[-1, -1] > 1.1 * fit.covariance[-1, -1]


def step(onset: float) -> Candidate:
    """An effect of unknown onset."""
    x = (np.arange(ROWS) >= onset).astype(float)
    return candidate("made", x, point=GridPoint({"onset": (onset, "s")}, step, cells=(4.0,)))


def test_other_peaks_of_the_likelihood_count_by_their_evidence() -> None:
    """Against the mixture of fits at every onset: a small one early or a large one late explain the same.

    Beside them is another cause, which gives way to each by as much as it must.
    """
    t = np.arange(ROWS)
    signal = 0.25 * (t >= 60) + 0.5 * (t >= 240)
    problem = replace(right(ROWS), residual=signal + np.random.default_rng(6).normal(size=ROWS))
    conditional_on = replace(decay(LAG), cause="other", point=GridPoint())
    grid = [step(float(onset)) for onset in range(10, ROWS, 10)]
    fits = [fitted(problem, conditional_on, one) for one in grid]
    null = fitted(problem, conditional_on).log_likelihood
    weight = np.exp([log_bayes(2.0 * (one.log_likelihood - null), 1) for one in fits])
    best = int(np.argmax(weight))
    fit = fits[best]
    apart = np.array([np.append(one.z, one.coefficients) for one in fits]) - np.append(
        fit.z, fit.coefficients
    )
    weight /= weight.sum() + weight[best]  # the estimate is a point of the grid as well
    more = sum(
        w * (np.outer(d, d) + one.covariance - fit.covariance)
        for w, d, one in zip(weight, apart, fits, strict=True)
    )
    model = [conditional_on, grid[best]]
    found = loosened(problem, model, [one.columns for one in model], fit, grid).covariance
    # each of those fits has noise of its own, so that weights differ a little
    units = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    np.testing.assert_allclose(found / units, (fit.covariance + more) / units, atol=0.15)
    assert found[-1, -1] > 1.3 * fit.covariance[-1, -1]
    np.linalg.cholesky(found)
