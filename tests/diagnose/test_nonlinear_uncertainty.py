"""Nonlinear parameters are estimates, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import normal
from magbridge.diagnose.inference.joint import Joint, fit_joint
from magbridge.diagnose.inference.nonlinear_uncertainty import loosened

ROWS, LAG, CELL = 300, 60.0, 40.0


def decay(lag: float) -> Candidate:
    """What decays, of a size and a lag that nobody knows."""
    x = np.exp(-np.arange(ROWS) / lag)
    return Candidate(
        "made", None, lambda rows: x[rows, None], np.ones(1), ("size",), ("nT",),
        shape={"lag": (lag, "s")}, again=decay, cells=(CELL,),
    )  # fmt: skip


@pytest.fixture(scope="module")
def problem(right: Callable[[int], Problem]) -> Problem:
    noise = np.random.default_rng(6).normal(size=ROWS)
    return replace(right(ROWS), residual=9.0 * np.exp(-np.arange(ROWS) / LAG) + noise)


def fitted(problem: Problem, *model: Candidate) -> Joint:
    return fit_joint(problem, [candidate.columns for candidate in model], 1)


def test_the_covariance_is_that_of_a_fit_in_which_the_lag_is_free(problem: Problem) -> None:
    """Against the inverse of the whole information, with the derivative by the lag as one more column."""
    one = decay(LAG)
    fit = fitted(problem, one)
    t = np.arange(ROWS)
    slope = CELL * fit.coefficients[0] * t / LAG**2 * np.exp(-t / LAG)

    def every(rows: slice) -> np.ndarray:
        return np.column_stack([problem.free[rows], one.columns(rows), slope[rows]])

    P = normal(every, fit.noise.response(fit.left), fit.noise)[0] + np.diag(np.append(fit.prior, 1.0))
    expected = np.linalg.inv(P)[:-1, :-1]
    found = loosened(problem, [one], [one.columns], fit).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(expected)), rtol=0.03)
    assert found[-1, -1] > 1.1 * fit.covariance[-1, -1]


def test_what_has_no_nonlinear_parameter_is_as_well_known_as_before(problem: Problem) -> None:
    one = replace(decay(LAG), shape={}, again=None, cells=())
    fit = fitted(problem, one)
    assert loosened(problem, [one], [one.columns], fit) is fit


def test_parts_of_one_cause_have_each_their_own(problem: Problem) -> None:
    both = decay(LAG).with_(decay(5.0))
    fit = fitted(problem, both)
    free = loosened(problem, [both], [both.columns], fit)
    assert np.all(np.diag(free.covariance)[-2:] > np.diag(fit.covariance)[-2:])
    np.linalg.cholesky(free.covariance)
