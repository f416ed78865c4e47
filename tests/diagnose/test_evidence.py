"""Test the evidence of a likelihood ratio, given the prior of its coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import candidate, right
from scipy.stats import chi2

from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.evidence import (
    Information,
    evidence_of,
    log_bayes,
    log_odds,
    score,
)
from magbridge.diagnose.joint import RIDGE, fit_joint


def sized(cause: str, size: int = 1, **more: object) -> Candidate:
    """Return a candidate with a given number of coefficients."""
    return candidate(cause, np.zeros((1, size)), **more)


def test_evidence_asks_its_price() -> None:
    """The evidence accepts many ratios or one; it is zero without free coefficients."""
    np.testing.assert_allclose(
        log_bayes(np.array([2.0, 3.0, 60.0]), 3), [0.0, 0.0, 28.5 - 1.5 * np.log(20.0)]
    )
    assert log_bayes(60.0, 3) < log_bayes(60.0, 1)
    assert log_bayes(60.0, 0) == 0.0


def test_what_cannot_be_negative_has_twice_the_prior_where_it_is() -> None:
    """Compare with the integral over half a Gaussian prior of the likeliest size."""
    estimate = 1.8
    size = np.sqrt(estimate**2 - 1.0)
    b = np.linspace(0.0, 12.0, 20_001)
    prior = np.sqrt(2.0 / np.pi) / size * np.exp(-0.5 * (b / size) ** 2)
    exact = np.log(np.trapezoid(prior * np.exp(b * estimate - 0.5 * b**2), b))
    one_sided = evidence_of(sized("filter_lag", positive=True), estimate**2, 1)
    assert one_sided == pytest.approx(exact, abs=0.06)
    assert one_sided - log_bayes(estimate**2, 1) == pytest.approx(np.log(2.0), abs=0.05)


@pytest.mark.parametrize(
    ("one", "least"),
    [
        (sized("filter_lag", positive=True), 0.08),
        (sized("map_error", 6, spectra=np.array([np.ones(6), 2.0 ** -np.arange(6)])), 0.0),
    ],
)
def test_a_size_that_cannot_be_negative_has_one_tail(one: Candidate, least: float) -> None:
    """Where there is none, no more than the level is found; of a single number, no less either."""
    S = np.diag(30.0 ** -np.linspace(0.0, 1.0, one.size)) * 100.0
    draws = np.random.default_rng(5).standard_normal((2000, one.size)) * np.sqrt(np.diag(S))
    ratios = [score(Information(S, b, np.zeros((0, 0))), slice(None), one).ratio for b in draws]
    assert least <= np.mean(one.tail * chi2.sf(ratios, 1) < 0.1) < 0.12


def test_a_map_that_is_wrong_makes_no_size_of_the_vehicles_likelier() -> None:
    """The evidence of a cause does not depend on a free shape, which has its own prior."""
    step, chart = sized("offset_step", 3), sized("map_error", 6, spectra=np.ones((1, 6)))
    look_elsewhere = {"offset_step": 1.0, "map_error": 1.0}
    worth = log_odds(225.0, [step, chart], look_elsewhere, 25.0) - log_odds(
        200.0, [chart], look_elsewhere, 0.0
    )
    assert worth == pytest.approx(log_bayes(25.0, 3) - np.log(20.0 * 2.0))


def test_a_score_is_the_ratio_its_evidence_and_the_shrunk_estimate() -> None:
    S, b = np.array([[4.0, 1.0], [1.0, 9.0]]), np.array([6.0, -3.0])
    info = Information(S, b, np.zeros((1, 2)))
    one = sized("late", 2)
    found = score(info, slice(0, 2), one)
    assert found.ratio == pytest.approx(b @ np.linalg.solve(S, b))
    assert found.evidence == pytest.approx(float(log_bayes(found.ratio, 2)))
    np.testing.assert_allclose(found.estimate, np.linalg.solve(S + np.eye(2), b))
    assert evidence_of(one, 12.0, 2) == float(log_bayes(12.0, 2)), "a size of either sign has two tails"
    positive = score(info, slice(1, 2), sized("late", 1, positive=True))
    assert (positive.ratio, positive.evidence, positive.freedom) == (0.0, 0.0, 1)
    assert positive.estimate.tolist() == [0.0]


def test_the_prior_of_coefficients_of_one_size_is_that_of_their_spectrum() -> None:
    S, b = np.diag([5.0, 5.0]), np.array([20.0, -15.0])
    spectrum = np.array([[2.0, 1.0]])
    found = score(Information(S, b, np.zeros((1, 2))), slice(0, 2), sized("map_error", 2, spectra=spectrum))
    precision = b / found.estimate - np.diag(S)
    assert precision[1] / precision[0] == pytest.approx(2.0, rel=1e-6)


# ---- calibration, effects and noise at once ----------------------------------------------------------------


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
