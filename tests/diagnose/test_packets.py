"""What rings for a while: found where it is, and not where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from posed import right, thinned

from magbridge.diagnose.evidence import information
from magbridge.diagnose.joint import Ridge, Statistic, fit_joint
from magbridge.diagnose.packets import Packets, packets
from magbridge.diagnose.problem import Problem, pose


def drawn(problem: Problem, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise of unit variance, of which a log with gaps has a part."""
    place = np.cumsum(np.append(0, problem.survey.steps[1:]))
    r = rng.normal(size=int(place[-1]) + 1)
    for k in range(1, len(r)):
        r[k] = rho * r[k - 1] + np.sqrt(1.0 - rho**2) * r[k]
    return np.asarray(r[place])


def fitted(given: Problem) -> tuple[Packets, Ridge]:
    """Return the packets of a log, and the best estimate of their sizes."""
    base = fit_joint(given, [], 1)
    found = packets(given, base)
    assert found is not None
    info = information(given, base.noise, base, [found.columns])
    return found, Statistic(info.matrix, np.ones((1, len(info.score)))).best(info.score)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_two_packets_are_found_where_they_are_in_noise_of_any_correlation(
    problem: Problem, rho: float
) -> None:
    n, rng = len(problem), np.random.default_rng(3)
    t = np.arange(n)
    planted = np.zeros(n)
    for moment, period, length in ((0.3 * n, 40.0, 90.0), (0.7 * n, 25.0, 30.0)):
        planted += 2.5 * np.exp(-0.5 * ((t - moment) / length) ** 2) * np.cos(2 * np.pi * t / period + 1.0)
    noise = drawn(problem, rho, rng)
    given = replace(problem, residual=problem.reference_jacobian * planted + noise)
    found, best = fitted(given)
    estimate = found.columns(slice(None)) @ best.estimate
    planted *= problem.reference_jacobian
    assert np.sum((estimate - planted) ** 2) < np.sum(planted**2) / 3.0
    assert 0.5 * best.ratio - np.log(found.look_elsewhere) > 10.0
    assert 20.0 < found.period / np.median(np.diff(problem.survey.time)) < 50.0


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_noise_has_no_packet_that_is_worth_its_place(problem: Problem, rho: float) -> None:
    rng = np.random.default_rng(4)
    worth = []
    for _ in range(30):
        given = replace(problem, residual=drawn(problem, rho, rng))
        found = packets(given, fit_joint(given, [], 1))
        worth.append(found is not None)
    assert sum(worth) <= 6


@pytest.mark.parametrize("kept", ["seven of eight", "a hole", "half at half the rate"])
def test_a_packet_keeps_its_period_and_place_where_samples_are_lost(kept: str) -> None:
    whole, rng = right(4000), np.random.default_rng(5)
    n, here = len(whole), np.ones(4000, bool)
    if kept == "seven of eight":
        here = rng.random(n) > 0.125
    elif kept == "a hole":
        here[1500:2400] = False
    else:
        here[1 : n // 2 : 2] = False
    t = np.arange(n)
    planted = 2.5 * np.exp(-0.5 * ((t - 1200.0) / 90.0) ** 2) * np.cos(2 * np.pi * t / 41.0 + 1.0)
    log = pose(thinned(whole.survey, here), whole.calibration)
    planted = log.reference_jacobian * planted[here]
    given = replace(log, residual=planted + drawn(log, 0.5, rng))
    found, best = fitted(given)
    assert np.sum((found.columns(slice(None)) @ best.estimate - planted) ** 2) < 0.2 * np.sum(planted**2)
    assert found.period == pytest.approx(4.0 * 41.0, rel=0.1)
