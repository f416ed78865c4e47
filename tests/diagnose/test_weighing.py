"""What a likelihood ratio is worth, by the prior that its numbers have."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.weigh import evidence_of, weigh, worth


def candidate(
    cause: str, size: int = 1, *, positive: bool = False, spectra: np.ndarray | None = None
) -> Candidate:
    return Candidate(
        cause, None, lambda rows: np.zeros((rows.stop - rows.start, size)), np.ones(size), ("b",) * size, ("nT",) * size,
        positive=positive, spectra=spectra,
    )  # fmt: skip


def test_what_cannot_be_negative_has_twice_the_prior_where_it_is() -> None:
    """Against the integral over half a Gaussian of the size that the data like best."""
    estimate = 1.8
    size = np.sqrt(estimate**2 - 1.0)
    b = np.linspace(0.0, 12.0, 20_001)
    prior = np.sqrt(2.0 / np.pi) / size * np.exp(-0.5 * (b / size) ** 2)
    exact = np.log(np.trapezoid(prior * np.exp(b * estimate - 0.5 * b**2), b))
    one_sided = evidence_of(candidate("filter_lag", positive=True), estimate**2, 1)
    assert one_sided == pytest.approx(exact, abs=0.06)
    assert one_sided - weigh(estimate**2, 1) == pytest.approx(np.log(2.0), abs=0.05)


def test_numbers_of_one_size_are_not_weighed_twice() -> None:
    one = candidate("map_error", 40, spectra=np.ones((4, 40)))
    assert evidence_of(one, 30.0, 1) == pytest.approx(15.0 - np.log(4.0))
    assert worth(30.0, [one], {"map_error": 1.0}) == pytest.approx(evidence_of(one, 30.0, 1))


def test_a_second_regressor_pays_for_its_choice_and_for_the_odds() -> None:
    model = [candidate("clock_offset"), candidate("reference_bias")]
    trials = {"clock_offset": 1.0, "reference_bias": 3.0}
    assert weigh(200.0, 2) - worth(200.0, model, trials) == pytest.approx(np.log(20.0 * 2.0 * 3.0))
