"""Errors of timing, and currents induced by turns: rates of change of the field and of the masses."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.instrument_effects import RateEffect
from magbridge.calibration.memory_effects import ClockEffect
from magbridge.diagnose.causes.candidates import AXES, Candidate, of_effect
from magbridge.diagnose.compare.interpolation import LOST, rates
from magbridge.diagnose.compare.problem import Problem, once

__all__ = ["channel_skew", "clock_offset", "eddy_current", "field_rates", "filter_lag", "mass_rates"]

MOMENT = 0.01
"""s by which masses are moved forward and back, for a central difference of the nine coefficients."""


@once
def field_rates(problem: Problem) -> FloatArray:
    """(3, n) dH_r/dt, nT/s (:func:`~.compare.interpolation.rates`)."""
    return rates(problem.survey, problem.survey.field.T)


@once
def mass_rates(problem: Problem) -> FloatArray:
    """(9, n) rates of change, per s, of the nine coefficients while masses move.

    A drive starts and stops between samples and runs evenly meanwhile. So a mass is in motion at a sample if
    it moves the same way in the intervals before and after it, and its speed is the larger of the two: that
    of an interval in which it moves all the time. One-sided differences do no harm here, because telemetry
    does not contain the residual's noise.
    """
    survey, calibration = problem.survey, problem.calibration
    kernel = calibration.kernel
    p, t = survey.values([parameter.name for parameter in calibration.parameters]), survey.time
    after = np.diff(p, axis=0, append=p[-1:]) / np.diff(t, append=t[-1] + 1.0)[:, None]
    after[:-1] *= survey.follows(LOST)[1:, None]
    before = np.roll(after, 1, axis=0)
    larger = np.where(np.abs(before) > np.abs(after), before, after)
    moved = MOMENT * np.where(before * after > 0.0, larger, 0.0)
    theta = kernel.rate_weights.T @ (kernel.monomials_of(p + moved) - kernel.monomials_of(p - moved))
    return np.asarray(theta / (2.0 * MOMENT))


def eddy_current(problem: Problem) -> list[Candidate]:
    """A turning conductor carries currents: ``T_i += k_ij dH_j/dt``, i != j (Tolles & Lawson 1950)."""
    names = tuple(i + j for i in AXES for j in AXES if i != j)
    effect = RateEffect(cause="eddy_current", on="eddy")
    return [of_effect(problem, effect, 0.3, "s", names=names, phi=field_rates(problem))]


def channel_skew(problem: Problem) -> list[Candidate]:
    """One digitiser takes the sensor's axes in turn: ``T_i += tau_i dH_i/dt``."""
    effect = RateEffect(cause="channel_skew", on="skew")
    return [of_effect(problem, effect, 0.5, "s", phi=field_rates(problem))]


def filter_lag(problem: Problem) -> list[Candidate]:
    """The anti-alias filter: ``T += -tau dH/dt + (variance / 2) d^2H/dt^2``.

    It holds the field back, not the telemetry. In a uniform field ``|H|`` shows the delay only where masses
    move: ``u^T A dH_r/dt = -dF/dtheta dtheta/dt``, theta the nine coefficients. That is the signature of a
    clock offset of the opposite sign, and the same correction removes it. The only difference is that a
    filter's delay cannot be negative.

    It also shortens a field that turns. From turning calibration runs that has gone into the calibration, so
    it shows where these are compared with a survey that turns less.
    """
    delayed = _delay(problem, ClockEffect(cause="filter_lag", sign=-1.0), 2.0, positive=True)
    return [*delayed, _shortened(problem)] if problem.survey.fitted.any() else delayed


def _shortened(problem: Problem) -> Candidate:
    r"""Return the attenuation of a field that turns.

    Notes
    -----
    A filter whose impulse response has the variance sigma^2 about its mean, the delay, passes on

    .. math:: H + \tfrac12 \sigma^2 \ddot H + \dots

    For an RC filter sigma is its time constant. A field that turns with omega is shortened by
    ``sigma^2 omega^2 / 2`` of its turning part. As with ``calibrate --filter-cutoff``, the calibration is
    fitted without it, and nothing is added to a field that turns live. The second derivative is that of
    :attr:`~.compare.problem.Problem.reading`, because it would correlate with the noise of its own sample.
    """
    bend = rates(problem.survey, problem.reading.T, 2).T
    columns = -0.5 * np.einsum("ij,ij->i", problem.jacobian[:, 6:], bend)[:, None]
    return Candidate(
        "filter_lag", None, columns.__getitem__, np.ones(1), ("variance",), ("s^2",), positive=True
    )


def clock_offset(problem: Problem) -> list[Candidate]:
    """Telemetry stamped by another clock: ``T += tau dT/dp dp/dt``, and A alike."""
    return _delay(problem, ClockEffect(cause="clock_offset"), 5.0)


def _delay(problem: Problem, effect: ClockEffect, width: float, *, positive: bool = False) -> list[Candidate]:
    if not problem.calibration.parameters:
        return []
    phi = mass_rates(problem)
    return [of_effect(problem, effect, width, "s", names=("delay",), phi=phi, positive=positive)]
