"""Errors of timing, and currents induced by turns: rates of change of the field and of the masses."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal

import numpy as np

from magbridge.arrays import FloatArray, IntArray
from magbridge.calibration.effects import ClockEffect, RateEffect
from magbridge.diagnose.causes.base import Cause
from magbridge.diagnose.columns import AXIS_NAMES, Candidate, GridPoint, of_effect
from magbridge.diagnose.problem import MAX_MISSING_SAMPLES, Problem, cached_per_problem, rates

SHIFTS_S = (0.5, 2.0, 6.0, 20.0, 60.0)
"""Shifts of the telemetry that are tried, s: those between half an interval and a fiftieth of the log."""
MIN_SHIFT = 0.1
"""Shift, in sampling intervals, below which rates of change describe it."""
CENTRAL_STEP_S = 0.01
"""s by which masses are moved forward and back, for a central difference of the nine coefficients."""


@cached_per_problem
def field_rates(problem: Problem) -> FloatArray:
    """Return (3, n) dH_r/dt, nT/s (:func:`~magbridge.diagnose.problem.rates`)."""
    return rates(problem.survey, problem.survey.field.T)


@cached_per_problem
def mass_rates(problem: Problem) -> FloatArray:
    """Return (9, n) rates of change, per s, of the nine coefficients while masses move.

    A drive runs evenly, and starts and stops between samples. So a mass is in motion at a sample if it moves
    the same way in the intervals before and after, and its speed is the larger of the two.
    """
    survey, calibration = problem.survey, problem.calibration
    kernel = calibration.kernel
    p, t = survey.values([parameter.name for parameter in calibration.parameters]), survey.time
    # Speeds of the intervals after and before each sample; none across a gap
    after = np.diff(p, axis=0, append=p[-1:]) / np.diff(t, append=t[-1] + 1.0)[:, None]
    after[:-1] *= survey.follows(MAX_MISSING_SAMPLES)[1:, None]
    before = np.roll(after, 1, axis=0)
    # In motion where both have the same sign; the larger is that of an interval in motion throughout
    larger = np.where(np.abs(before) > np.abs(after), before, after)
    moved = CENTRAL_STEP_S * np.where(before * after > 0.0, larger, 0.0)
    # Central difference of theta(p) along that motion
    theta = kernel.rate_weights.T @ (kernel.monomials_of(p + moved) - kernel.monomials_of(p - moved))
    return np.asarray(theta / (2.0 * CENTRAL_STEP_S))


class _Rate(Cause):
    """Offsets in proportion to the rate of change of the reading."""

    needs = "turns"
    family = "rate"
    on: ClassVar[Literal["skew", "eddy"]]
    width_s: ClassVar[float]
    """Plausible coefficient, s."""
    axes: ClassVar[tuple[str, ...]] = AXIS_NAMES
    """Names of the coefficients."""

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return the one candidate, by central differences: the live ones contain their sample's noise."""
        effect, phi = RateEffect(cause=self.name, on=self.on), field_rates(problem)
        return [
            of_effect(
                problem, effect, self.width_s, "s", names=self.axes, phi=phi,
                regressors=lambda rows: phi[:, rows],
            )
        ]  # fmt: skip


class EddyCurrent(_Rate):
    """A turning conductor carries currents: ``T_i += k_ij dH_j/dt``, i != j (Tolles & Lawson 1950)."""

    name = "eddy_current"
    meaning = "currents that are induced while the vehicle turns make a field"
    disambiguation = "reverse the turn"
    on, width_s = "eddy", 0.3
    axes = tuple(i + j for i in AXIS_NAMES for j in AXIS_NAMES if i != j)


class ChannelSkew(_Rate):
    """One digitiser takes the sensor's axes in turn: ``T_i += tau_i dH_i/dt``."""

    name = "channel_skew"
    meaning = "the sensor's three axes were not read when the log says"
    disambiguation = "reverse the turn; roll about the axis that all delays share"
    on, width_s = "skew", 0.5


@cached_per_problem
def _legs(problem: Problem) -> tuple[FloatArray, IntArray]:
    """Return positions of the masses (n, k) and the leg's number (n,), which all shifts share."""
    survey = problem.survey
    p = survey.values([parameter.name for parameter in problem.calibration.parameters])
    return p, np.cumsum(~survey.follows(MAX_MISSING_SAMPLES))


def _averaged(problem: Problem, shift: float) -> Callable[[slice], FloatArray]:
    """Return the mean rates of change of the nine coefficients theta over a shift d of the telemetry.

    They are ``(theta(p(t + d)) - theta(p(t))) / d``, with positions p interpolated between samples, and none
    across a gap. A mass that moves within one sampling interval has no rate at any sample, but a shift.
    """
    kernel, t = problem.calibration.kernel, problem.survey.time
    p, leg = _legs(problem)

    def rows_of(rows: slice) -> FloatArray:
        later = t[rows] + shift
        # Sample that stands next to the shifted time: both must be in one leg
        near = np.clip(np.searchsorted(t, later, side="left" if shift > 0.0 else "right"), 0, len(t) - 1)
        near -= 0 if shift > 0.0 else 1
        moved = np.stack([np.interp(later, t, column) for column in p.T], axis=1)
        here = p[rows]
        moved = np.where((leg[np.maximum(near, 0)] == leg[rows])[:, None], moved, here)
        change = kernel.monomials_of(moved) - kernel.monomials_of(here)
        return np.asarray(kernel.rate_weights.T @ change / shift)

    return rows_of


class _Delay(Cause):
    """A delay between the field and the positions of the masses."""

    family = "mass"
    sign: ClassVar[float] = 1.0
    """-1 if the field is late, 1 if the telemetry is."""
    width_s: ClassVar[float]
    """Plausible delay, s."""

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return the delay by the rates of the masses, and by shifts of their telemetry."""
        if not problem.calibration.parameters:
            return []
        # Shifts from half an interval to a fiftieth of the log; a filter delays only the field
        interval, longest = problem.survey.interval, 0.02 * float(np.ptp(problem.survey.time))
        shifts = [shift for shift in SHIFTS_S if 0.5 * interval <= shift <= longest]
        late = self.sign < 0.0
        both = [-shift for shift in shifts] if late else [sign * x for x in shifts for sign in (-1.0, 1.0)]

        def rebuild(shift: float) -> Candidate:
            effect, rate = ClockEffect(cause=self.name, sign=self.sign), mass_rates(problem)
            by_rates = abs(shift) <= MIN_SHIFT * interval
            phi = (lambda rows: rate[:, rows]) if by_rates else _averaged(problem, shift)
            # The rates are as likely beforehand as all shifts together
            likelier = float(np.log(0.5 * (len(both) + 1) / (1 if by_rates else len(both)))) if both else 0.0
            return of_effect(
                problem, effect, self.width_s, "s", names=("delay",), phi=phi, positive=late, regressors=phi,
                point=GridPoint({"shift": (shift, "s")}, rebuild, likelier),
            )  # fmt: skip

        return [rebuild(shift) for shift in (0.0, *both)]


class ClockOffset(_Delay):
    """Telemetry stamped by another clock: ``T += tau dT/dp dp/dt``, and the same for A."""

    name = "clock_offset"
    meaning = "the clocks of sensor and telemetry differ"
    needs = "a calibration with parameters that move while sampled"
    disambiguation = "move an actuator at constant attitude"
    delays_telemetry = True
    width_s = 5.0


class FilterLag(_Delay):
    """The anti-alias filter: ``T += -tau dH/dt + (variance / 2) d^2H/dt^2``.

    In a uniform field ``|H|`` shows the delay only where masses move: ``u^T A dH_r/dt = -dF/dtheta
    dtheta/dt``, theta the nine coefficients, the signature of a clock offset of the opposite sign. A filter's
    delay cannot be negative. It also shortens a field that turns, which shows if the calibration runs turned
    faster.
    """

    name = "filter_lag"
    meaning = "a filter delays the sensor's readings against the telemetry"
    needs = "masses that move while sampled, or the calibration's own runs"
    disambiguation = "change the corner of the filter, or step an actuator"
    sign, width_s = -1.0, 2.0

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return the delay and, in addition to the calibration's own runs, the attenuation."""
        delayed = super().candidates(problem)
        return [*delayed, _shortened(problem)] if problem.survey.fitted.any() else delayed


def _shortened(problem: Problem) -> Candidate:
    """Return the attenuation of a field that turns.

    A filter whose impulse response has the variance ``sigma^2`` about its mean passes on
    ``H + sigma^2 / 2 d^2H/dt^2``. The calibration is fitted without it (``calibrate --filter-cutoff``), and
    nothing is added live. The readings are free of noise, with which a second derivative would correlate.
    """
    bend = rates(problem.survey, problem.reading.T, 2).T
    columns = -0.5 * np.einsum("ij,ij->i", problem.jacobian[:, 6:], bend)[:, None]
    return Candidate(
        "filter_lag", None, columns.__getitem__, np.ones(1), ("variance",), ("s^2",), positive=True
    )
