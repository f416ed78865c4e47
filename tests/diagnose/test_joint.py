"""Calibration, effects and noise at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from posed import right

from magbridge.diagnose.inference.joint import fit_joint

ROWS = 300


def test_numbers_of_one_size_that_say_the_same_share_what_they_say() -> None:
    """Two causes with a common size each, a column double or empty: only their sizes keep them apart."""
    rng = np.random.default_rng(4)
    a, b = np.sin(np.arange(ROWS) / 7.0), np.sign(np.sin(np.arange(ROWS) / 40.0))
    problem = replace(right(ROWS), residual=3.0 * a - 2.0 * b + rng.normal(size=ROWS))
    twice = [np.column_stack([x, x, 0.0 * x]) for x in (a, b)]
    fit = fit_joint(problem, [x.__getitem__ for x in twice], 1, spectra=[np.ones((1, 3)), np.ones((1, 3))])
    np.testing.assert_allclose(fit.coefficients, [1.5, 1.5, 0.0, -1.0, -1.0, 0.0], atol=0.1)
    assert np.isfinite(fit.log_likelihood)
