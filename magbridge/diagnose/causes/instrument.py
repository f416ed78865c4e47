"""Causes in the sensor: an offset that steps, drifts or oscillates; a nonlinear or clipped response."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from itertools import product

import numpy as np

from magbridge.calibration.effects import ResponseEffect, TimeEffect
from magbridge.diagnose.causes.base import Cause
from magbridge.diagnose.columns import AXIS_NAMES, Candidate, GridPoint, of_effect, per
from magbridge.diagnose.problem import Problem

ONSETS = 40
"""Number of onsets tried for a step, evenly over the samples. Four times as many gain only 0.6 in log
odds."""
TONES = 5
"""Number of peaks of the spectrum that are tried as tones."""
MAX_BEND_NT = 50.0
"""Largest plausible nonlinearity (RMS of its coefficients), nT: that of magnetoresistive sensors."""


class OffsetStep(Cause):
    """The offset jumps after a power cycle, a shock or a magnet: ``T += b`` after an onset.

    All power cycles together are as likely beforehand as all other times together. One power cycle is
    assumed between the calibration's own logs and the diagnosed ones.
    """

    name = "offset_step"
    meaning = "the sensor's zero jumped, as after a power cycle or a magnetic shock"
    needs = "time"
    disambiguation = "log the power-cycle counter; fly one attitude before and after"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a step at each of :data:`ONSETS` quantiles of the time, and at each power cycle."""
        survey = problem.survey
        t = survey.time
        fresh = t[~survey.learned]
        onsets = np.quantile(fresh, np.linspace(0.02, 0.98, ONSETS)) if fresh.size else t[:0]
        first = fresh.min() - 1.0
        # Moments: power cycles, quantiles of the time, and the change of logs
        cycles = {*survey.cycles, *([first] if survey.learned.any() else [])}
        grid = np.unique([first, *onsets, *cycles])

        def rebuild(onset: float) -> Candidate:
            effect = TimeEffect(cause=self.name, shape="step", start=onset)
            # Half of the prior for all power cycles together, half for all other moments
            alike = len(cycles) if max(onset, first) in cycles else len(grid) - len(cycles)
            likelier = float(np.log(0.5 * len(grid) / alike)) if cycles else 0.0
            point = GridPoint({"onset": (onset, "s")}, rebuild, likelier)
            return of_effect(problem, effect, 100.0, "nT", point=point)

        return [rebuild(float(onset)) for onset in grid]


class OffsetDrift(Cause):
    """The offset drifts (ageing, relaxing stress): ``T += b_1 x + b_2 x^2``, ``x = (t - t_0) / period``."""

    name = "offset_drift"
    meaning = "the sensor's zero creeps with time"
    needs = "time"
    disambiguation = "return to one place and attitude hours later"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a linear drift from the start, a linear one about the middle, and a quadratic one."""
        t = problem.survey.time
        span = float(t[-1] - t[0])
        shapes = (1, t[0], span), (1, 0.5 * (t[0] + t[-1]), 0.5 * span), (2, t[0], span)
        made = []
        for order, start, period in shapes:
            effect = TimeEffect(
                cause=self.name, shape="drift", start=float(start), period=period, order=order
            )
            step = f"{period / 3600:.3g} h" if period > 600 else f"{period:.3g} s"
            units = [per(step, power) for power in range(1, order + 1)]
            made.append(of_effect(problem, effect, 50.0, units))
        return made


class InterferenceTone(Cause):
    """Machinery at a fixed frequency, perhaps aliased: ``T += b cos + c sin (2 pi t / period)``.

    The frequencies are the highest peaks in the spectrum of the differenced residual. The largest of m
    frequencies exceeds a high u by chance as often as the largest of ``m sqrt(pi u / 6)`` independent ones
    (Davies 1987, Biometrika 74:33).
    """

    name = "interference_tone"
    meaning = "something disturbs the sensor periodically"
    needs = "even sampling"
    disambiguation = "change the sampling rate: an alias changes its frequency"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a tone at each of the highest peaks of the residual's spectrum."""
        t = problem.survey.time

        def rebuild(period: float) -> Candidate:
            effect = TimeEffect(cause=self.name, shape="tone", start=float(t[0]), period=period)
            names = tuple(f"{f} {axis}" for f in ("cos", "sin") for axis in AXIS_NAMES)
            return of_effect(
                problem, effect, 10.0, "nT", names=names, look_elsewhere=0.5 * len(t),
                point=GridPoint({"period": (period, "s")}, rebuild),
            )  # fmt: skip

        return [rebuild(period) for period in _loudest_periods(problem)]


def _loudest_periods(problem: Problem) -> list[float]:
    """Return the periods, s, of the highest peaks in the residual's spectrum; none without even sampling."""
    survey = problem.survey
    t = survey.time
    interval = float(np.median(np.diff(t)))
    slots = np.rint((t - t[0]) / interval).astype(np.int64)
    if slots[-1] > 8 * len(t):
        return []
    # Differences flatten the noise's spectrum; zero padding places it on a fine grid
    flat = np.append(0.0, np.diff(problem.residual) * survey.follows()[1:])
    size = 1 << int(np.ceil(np.log2(slots[-1] + 1)) + 1)
    body = problem.jacobian[:, 6:]
    lines = np.array([np.fft.rfft(np.bincount(slots, flat * slope, minlength=size)) for slope in body.T])
    # power in all three axes together; the inverse keeps what they share from counting twice
    power = np.einsum("if,ij,jf->f", lines.conj(), np.linalg.inv(body.T @ body), lines).real
    # Peaks over the local mean of the spectrum, from 20 periods per log on
    frequency = np.fft.rfftfreq(size, interval)
    width = min(201, len(power))
    smooth = np.convolve(power, np.ones(width) / width, mode="same") + 1e-300
    ratio = np.where(frequency * float(np.ptp(t)) > 20.0, power / smooth, 0.0)
    periods = []
    for _ in range(TONES):
        peak = int(np.argmax(ratio))
        if ratio[peak] <= 0.0:
            break
        # Maximum of a parabola through the peak and its two neighbours
        low, top, high = power[[peak - 1, peak, peak + 1 if peak + 1 < len(power) else peak - 1]]
        off = 0.5 * (low - high) / (low - 2.0 * top + high) if top > max(low, high) else 0.0
        periods.append(float(1.0 / ((peak + off) * frequency[1])))
        ratio[max(peak - 4, 0) : peak + 5] = 0.0
    return periods


class Nonlinearity(Cause):
    """The response bends: ``T_i += b_i (H_i / H_0)^p``, p = 2 (a leak), 3 (a saturating core), or 1 to 3.

    With a feedback of finite gain the response is the inverse of the core's magnetisation curve, which also
    changes the sensitivity (p = 1). All nine coefficients have one common size, because the three axes have
    the same design. Nine free coefficients could fit an error of the reference or of a mass instead.
    """

    name = "nonlinearity"
    meaning = "the sensor's response bends"
    needs = "attitudes that take an axis of the sensor through its range"
    disambiguation = "turn every axis of the sensor through the whole field"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a candidate for p = 2, one for p = 3, and one for p = 1 to 3 together."""
        # a common size is at most ten widths (:data:`~magbridge.diagnose.joint.PRIOR_SIZES`)
        common = [self._power(problem, power, 0.1 * MAX_BEND_NT) for power in (1, 2, 3)]
        every = replace(reduce(Candidate.joined_with, common), parts=(), spectra=np.ones((1, 9)))
        return [*(self._power(problem, power, MAX_BEND_NT) for power in (2, 3)), every]

    def _power(self, problem: Problem, power: int, width: float) -> Candidate:
        unit = problem.calibration.reference.field
        effect = ResponseEffect(cause=self.name, unit=unit, power=power)
        names = tuple(f"{axis}{power}" for axis in AXIS_NAMES)
        return of_effect(problem, effect, width, per(f"{unit:.0f} nT", power), names=names)


class Saturation(Cause):
    """An axis compresses or clips near its end: ``T_i -= b_1 + b_2 (H_i - knee) / H_0`` beyond the knee."""

    name = "saturation"
    meaning = "an axis of the sensor clips near the end of its range"
    needs = "an axis of the sensor near its end"
    disambiguation = "turn that axis away from the field: saturation occurs only near full scale"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return four knees for each end of an axis' range where its reading reaches 20 % of the field."""
        made = []
        for axis, sign in product(range(3), (1.0, -1.0)):
            reading = sign * problem.reading[:, axis]
            if reading.max() >= 0.2 * problem.calibration.reference.field:
                knees = [sign * float(np.quantile(reading, share)) for share in (0.7, 0.85, 0.95, 0.99)]
                made += [self._clipped(problem, axis, knee) for knee in knees]
        return made

    def _clipped(self, problem: Problem, axis: int, knee: float) -> Candidate:
        """Return the candidate of one axis, 0 to 2, that saturates beyond `knee`, nT."""
        unit = problem.calibration.reference.field
        effect = ResponseEffect(cause=self.name, unit=unit, axis=axis, knee=knee)
        point = GridPoint({"knee": (knee, "nT")}, lambda other: self._clipped(problem, axis, other))
        return of_effect(
            problem, effect, np.array([100.0, 0.1 * unit]), ("nT", per(f"{unit:.0f} nT")),
            names=(f"{AXIS_NAMES[axis]} jump", f"{AXIS_NAMES[axis]} slope"), point=point,
        )  # fmt: skip
