"""Causes proportional to a rate of change of the field or of a mass: delays, and eddy currents."""

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
"""Shifts of the telemetry, s. Those between half an interval and a fiftieth of the log are tried."""
MIN_SHIFT = 0.1
"""Shift, in sampling intervals, up to which it is computed from rates of change."""
CENTRAL_STEP_S = 0.01
"""Time by which masses are moved forward and back for a central difference of the nine coefficients, s."""


@cached_per_problem
def field_rates(problem: Problem) -> FloatArray:
    """Return the rates of change of the raw readings (3, n), nT/s, from a cubic spline."""
    return rates(problem.survey, problem.survey.field.T)


@cached_per_problem
def mass_rates(problem: Problem) -> FloatArray:
    """Return the rates of change (9, n), per s, of the nine coefficients while masses move.

    A drive has a constant speed, and starts and stops between samples. A mass is taken to be in motion at a
    sample if it moves in the same direction in the intervals before and after. Its speed is the larger of
    the two.
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
    """An offset proportional to the rate of change of the reading."""

    needs = "turns"
    family = "rate"
    on: ClassVar[Literal["skew", "eddy"]]
    width_s: ClassVar[float]
    """Plausible size of a coefficient (1-sigma), s."""
    axes: ClassVar[tuple[str, ...]] = AXIS_NAMES
    """Names of the coefficients."""

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return the single candidate; its rates are less noisy than the live backward differences."""
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
    """The sensor's axes are sampled one after the other: ``T_i += tau_i dH_i/dt``."""

    name = "channel_skew"
    meaning = "the sensor's three axes were not read when the log says"
    disambiguation = "reverse the turn; roll about the axis that all delays share"
    on, width_s = "skew", 0.5


@cached_per_problem
def _legs(problem: Problem) -> tuple[FloatArray, IntArray]:
    """Return the positions of the masses (n, k), and for each sample the number of its leg (n,)."""
    survey = problem.survey
    p = survey.values([parameter.name for parameter in problem.calibration.parameters])
    return p, np.cumsum(~survey.follows(MAX_MISSING_SAMPLES))


def _averaged(problem: Problem, shift: float) -> Callable[[slice], FloatArray]:
    """Return a function of m rows: mean rates (9, m), per s, of the nine coefficients theta over a shift d.

    The rates are ``(theta(p(t + d)) - theta(p(t))) / d``, with positions p interpolated between samples, and
    0 across a gap. They are not zero where a mass moves within one sampling interval.
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
    """A delay between the readings of the field and the positions of the masses."""

    family = "mass"
    sign: ClassVar[float] = 1.0
    """-1 if the field is delayed, 1 if the telemetry is."""
    width_s: ClassVar[float]
    """Plausible delay (1-sigma), s."""

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a delay by the rates of the masses, and one by each shift of their telemetry."""
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

    In a uniform field ``|H|`` shows the delay only while masses move: ``u^T A dH_r/dt = -dF/dtheta
    dtheta/dt``, theta the nine coefficients. This is the signature of a clock offset of the opposite sign,
    but a filter's delay cannot be negative. A filter also attenuates a field that turns, which a log shows
    if the calibration runs turned faster.
    """

    name = "filter_lag"
    meaning = "a filter delays the sensor's readings against the telemetry"
    needs = "masses that move while sampled, or the calibration's own runs"
    disambiguation = "change the corner of the filter, or step an actuator"
    sign, width_s = -1.0, 2.0

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return the delays and, if the calibration's own runs are given, the attenuation of turns."""
        delayed = super().candidates(problem)
        return [*delayed, _shortened(problem)] if problem.survey.fitted.any() else delayed


def _shortened(problem: Problem) -> Candidate:
    """Return the candidate of a filter's attenuation of a field that turns.

    A filter whose impulse response has the variance ``sigma^2`` about its mean returns
    ``H + sigma^2 / 2 d^2H/dt^2``. The refit of the calibration excludes the attenuation (as ``calibrate
    --filter-cutoff`` does), and the live correction does not undo it. The second derivative is taken of the
    noise-free readings, because it would correlate with noise.
    """
    bend = rates(problem.survey, problem.reading.T, 2).T
    columns = -0.5 * np.einsum("ij,ij->i", problem.jacobian[:, 6:], bend)[:, None]
    return Candidate(
        "filter_lag", None, columns.__getitem__, np.ones(1), ("variance",), ("s^2",), positive=True
    )
