"""An error of the map, as the search describes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from posed import right

from magbridge.diagnose.causes.instrument import OffsetDrift, OffsetStep
from magbridge.diagnose.causes.reference import DiurnalVariation, MapError, ReferenceBias
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.joint import Joint, fit_joint
from magbridge.diagnose.problem import Problem
from magbridge.diagnose.search import beside_slow_noise, search

N = 1500
NORTH = 2000.0 * (1.0 - np.abs(np.linspace(-1.0, 1.0, N)))
DOWN = 75.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(N) / 170.0))
"""m, a line there and back at other depths."""


def drawn(whole: Problem, error: NDArray[np.float64], down: NDArray[np.float64]) -> Problem:
    """Return a problem whose reference has an `error` (n,), nT, along a track at depths `down`."""
    place = np.stack([NORTH, np.zeros(N), down], axis=1)
    return replace(whole, residual=whole.residual + error, survey=replace(whole.survey, place=place))


def fitted(problem: Problem, chart: Candidate) -> Joint:
    assert chart.nonparametric
    return fit_joint(problem, [chart.columns], 1, spectra=[chart.spectra])


def flown(altitude: float) -> NDArray[np.float64]:
    """(n,) nT that a map from an altitude lacks of two waves, which do not average out along the track."""
    found = np.zeros(N)
    for length, phase in ((1600.0, 0.3), (5000.0, 1.0)):
        k = 2.0 * np.pi / length
        grown = np.exp(k * (DOWN - 150.0)) - np.exp(k * (-altitude - 150.0))
        found += 60.0 * grown * np.cos(k * NORTH + phase)
    return found


def test_what_a_map_as_flown_lacks_grows_with_depth() -> None:
    """Without the depths, one place has two errors."""
    missing, residual = flown(90.0), []
    for down in (DOWN, np.zeros(N)):
        problem = drawn(right(N), missing, down)
        residual.append(float(np.std(fitted(problem, MapError().candidates(problem)[0]).residual)))
    assert residual[0] < 0.1 * np.std(missing) < 0.2 * np.std(missing) < residual[1], residual


@pytest.mark.parametrize("altitude", [60.0, 100.0, 150.0])
def test_the_mean_of_what_a_map_lacks_is_known(altitude: float) -> None:
    """The growth with depth distinguishes it from a constant."""
    missing = flown(altitude)
    problem = drawn(right(N), missing + 40.0, DOWN)
    chart, _ = MapError().candidates(problem)
    [constant] = ReferenceBias().candidates(problem)
    fit = fit_joint(problem, [chart.columns, constant.columns], 1, spectra=[chart.spectra, None])
    error = chart.columns(slice(None)) @ fit.coefficients[: chart.size] / problem.reference_jacobian
    assert abs(error.mean() - missing.mean()) < 0.2 * np.sqrt(np.mean(missing**2))


def test_what_is_drawn_wrong_is_the_same_at_every_depth() -> None:
    wrong = 30.0 * np.exp(-0.5 * ((NORTH - 900.0) / 400.0) ** 2)
    problem = drawn(right(N), wrong, DOWN)
    _, chart = MapError().candidates(problem)
    fit = fitted(problem, chart)
    assert np.std(fit.residual) < 0.1 * np.std(wrong)
    error = chart.columns(slice(None)) @ fit.coefficients / problem.reference_jacobian
    np.testing.assert_allclose(error, error[::-1], atol=1e-6)  # there and back


def test_a_gradient_over_the_whole_region_is_the_maps_error_alone() -> None:
    """A line there and back separates place from time: no second, slow cause is named."""
    rng = np.random.default_rng(5)
    whole = right(N)
    survey = replace(whole.survey, time=whole.survey.time[0] + 16.0 * np.arange(N))
    wrong = 0.01 * (NORTH - 1000.0) + rng.normal(size=N)
    problem = drawn(replace(whole, survey=survey), wrong, DOWN)
    causes = MapError(), DiurnalVariation(), OffsetDrift(), OffsetStep()
    every = [candidate for cause in causes for candidate in cause.candidates(problem)]
    found = beside_slow_noise(search(problem, every, 4), every, 4)
    assert [h.candidate.cause for h in found.chosen] == ["map_error"]
