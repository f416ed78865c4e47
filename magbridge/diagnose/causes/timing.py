"""What was sampled when: rates of change of the field and of the masses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.followers import ClockEffect
from magbridge.calibration.instrument import RateEffect
from magbridge.diagnose.candidates import AXES, Candidate, of_effect
from magbridge.diagnose.problem import Problem

__all__ = ["channel_skew", "clock_offset", "eddy_current", "filter_lag"]

FloatArray = NDArray[np.float64]


def _rates(problem: Problem) -> FloatArray:
    """(3, n) dH_r/dt, nT/s, by differences both ways.

    A one-sided difference holds the sample's own noise, which would pass for an effect; a two-sided one is odd in
    time, so that against stationary noise its inner product vanishes on average.
    """
    survey = problem.survey
    H, t = survey.field, survey.time
    out = np.zeros((3, len(t)))
    both = np.flatnonzero(survey.follows[1:-1] & survey.follows[2:]) + 1
    out[:, both] = ((H[both + 1] - H[both - 1]) / (t[both + 1] - t[both - 1])[:, None]).T
    return out


def eddy_current(problem: Problem) -> list[Candidate]:
    """A turning conductor carries currents: ``T_i += k_ij dH_j/dt``, i != j (Tolles & Lawson 1950)."""
    names = tuple(i + j for i in AXES for j in AXES if i != j)
    effect = RateEffect(cause="eddy_current", on="eddy")
    return [of_effect(problem, effect, 0.3, "s", names=names, phi=_rates(problem))]


def channel_skew(problem: Problem) -> list[Candidate]:
    """One digitiser takes the channels in turn: ``T_i += tau_i dH_i/dt`` (paper, section 3)."""
    effect = RateEffect(cause="channel_skew", on="skew")
    return [of_effect(problem, effect, 0.5, "s", phi=_rates(problem))]


def filter_lag(problem: Problem) -> list[Candidate]:
    """The anti-alias filter holds the field back against the telemetry: ``T += -tau dH/dt`` (paper, section 3).

    In a uniform field on a vehicle without moving iron it is invisible: ``|H|`` does not change.
    """
    effect = RateEffect(cause="filter_lag", on="lag")
    return [of_effect(problem, effect, 2.0, "s", names=("delay",), phi=_rates(problem))]


def clock_offset(problem: Problem) -> list[Candidate]:
    """Telemetry stamped by another clock: ``theta += tau dtheta/dp dp/dt``."""
    survey, calibration = problem.survey, problem.calibration
    if not calibration.parameters:
        return []
    kernel = calibration.kernel
    W = kernel.weights[: kernel.monomials] * np.array([calibration.reference.field] * 6 + [1.0] * 3)
    positions = survey.values([parameter.name for parameter in calibration.parameters])
    theta = W.T @ kernel.monomials_of(positions)
    rates, t = np.zeros_like(theta), survey.time
    both = np.flatnonzero(survey.follows[1:-1] & survey.follows[2:]) + 1
    rates[:, both] = (theta[:, both + 1] - theta[:, both - 1]) / (t[both + 1] - t[both - 1])
    return [of_effect(problem, ClockEffect(), 5.0, "s", names=("delay",), phi=rates)]
