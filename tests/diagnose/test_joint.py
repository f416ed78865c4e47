"""Calibration, effects and noise at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import right

from magbridge.diagnose.joint import RIDGE, fit_joint, normal
from magbridge.diagnose.problem import Problem, with_slow_noise

ROWS = 300


def test_numbers_of_one_size_that_say_the_same_share_what_they_say() -> None:
    """Two causes with a common size each, a column double or empty: only their sizes distinguish them."""
    rng = np.random.default_rng(4)
    a, b = np.sin(np.arange(ROWS) / 7.0), np.sign(np.sin(np.arange(ROWS) / 40.0))
    problem = replace(right(ROWS), residual=3.0 * a - 2.0 * b + rng.normal(size=ROWS))
    twice = [np.column_stack([x, x, 0.0 * x]) for x in (a, b)]
    fit = fit_joint(problem, [x.__getitem__ for x in twice], 1, spectra=[np.ones((1, 3)), np.ones((1, 3))])
    np.testing.assert_allclose(fit.coefficients, [1.5, 1.5, 0.0, -1.0, -1.0, 0.0], atol=0.1)


def test_a_likelihood_is_the_gaussian_s_less_what_the_priors_cost() -> None:
    """White noise at its likeliest size, and an effect that no noise with a memory takes for its own."""
    rng = np.random.default_rng(5)
    column = rng.choice([-1.0, 1.0], (ROWS, 1))
    y = 3.0 * column[:, 0] + rng.normal(size=ROWS)
    problem = replace(right(ROWS), residual=y)
    fits = [fit_joint(problem, [], 1), fit_joint(problem, [column.__getitem__], 1)]
    naive = [
        -0.5 * ROWS * (np.log(2.0 * np.pi * np.mean(residual**2)) + 1.0)
        for residual in (fit.residual for fit in fits)
    ]
    gained = fits[1].log_likelihood - fits[0].log_likelihood
    assert gained == pytest.approx(naive[1] - naive[0] - 0.5 * RIDGE * fits[1].coefficients[0] ** 2, rel=0.05)
    assert gained > 200.0
    assert fits[1].coefficients[0] == pytest.approx(3.0, abs=0.2)


def test_slow_noise_is_computed_for_the_rows_that_are_asked_for(problem: Problem) -> None:
    """And the calibration's own derivatives are shared, not computed again."""
    noisy, n = with_slow_noise(problem), len(problem)
    assert noisy.coefficient_jacobian is problem.coefficient_jacobian
    wave = np.cos(np.pi * (np.arange(n)[:, None] + 0.5) / n * np.arange(1, 65))
    slopes = problem.jacobian[:, 6:]
    along = wave[:, 16:] * np.linalg.norm(slopes, axis=1)[:, None]
    expected = np.hstack([(wave[:, :16, None] * slopes[:, None]).reshape(n, 48), along])
    rows = slice(100, 300)
    np.testing.assert_allclose(noisy.calibration_rows(rows)[:, noisy.slow], expected[rows], atol=1e-10)


def test_a_stride_counts_every_other_piece_of_a_log() -> None:
    X, y = np.random.default_rng(1).normal(size=(9000, 3)), np.ones(9000)
    counted = np.arange(9000) // 2048 % 2 == 0
    P, b = normal(X.__getitem__, y, stride=2)
    np.testing.assert_allclose(P, X[counted].T @ X[counted])
    np.testing.assert_allclose(b, X[counted].sum(axis=0))
