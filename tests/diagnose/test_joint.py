"""Calibration, effects and noise at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import right

from magbridge.diagnose.joint import RIDGE, fit_joint

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
