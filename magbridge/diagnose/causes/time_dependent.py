"""Causes that follow time alone: steps, drifts, tones."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.instrument_effects import TimeEffect
from magbridge.diagnose.columns import AXES, Candidate, GridPoint, of_effect, per
from magbridge.diagnose.problem import Problem

__all__ = ["interference_tone", "offset_drift", "offset_step"]

ONSETS = 40
"""Moments tried for a step, evenly over the samples. Four times as many gain only 0.6 in log odds."""


def offset_step(problem: Problem) -> list[Candidate]:
    """The offset jumps, by a power cycle, a shock or a magnet: ``T += b`` from its onset on.

    As likely at a power cycle as at all other times together. Between the calibration's own logs and these
    there has been one.
    """
    survey = problem.survey
    t = survey.time
    fresh = t[~survey.learned]
    onsets = np.quantile(fresh, np.linspace(0.02, 0.98, ONSETS)) if fresh.size else t[:0]
    first = fresh.min() - 1.0
    cycles = {*survey.cycles, *([first] if survey.learned.any() else [])}
    grid = np.unique([first, *onsets, *cycles])

    def rebuild(onset: float) -> Candidate:
        effect = TimeEffect(cause="offset_step", shape="step", start=onset)
        alike = len(cycles) if max(onset, first) in cycles else len(grid) - len(cycles)
        likelier = float(np.log(0.5 * len(grid) / alike)) if cycles else 0.0
        point = GridPoint({"onset": (onset, "s")}, rebuild, likelier)
        return of_effect(problem, effect, 100.0, "nT", point=point)

    return [rebuild(float(onset)) for onset in grid]


def offset_drift(problem: Problem) -> list[Candidate]:
    """The offset creeps (ageing, relaxing stress): ``T += b_1 x + b_2 x^2``, ``x = (t - t_0) / period``."""
    t = problem.survey.time
    span = float(t[-1] - t[0])
    made = []
    for order, start, period in ((1, t[0], span), (1, 0.5 * (t[0] + t[-1]), 0.5 * span), (2, t[0], span)):
        effect = TimeEffect(
            cause="offset_drift", shape="drift", start=float(start), period=period, order=order
        )
        step = f"{period / 3600:.3g} h" if period > 600 else f"{period:.3g} s"
        units = [per(step, power) for power in range(1, order + 1)]
        made.append(of_effect(problem, effect, 50.0, units))
    return made


def interference_tone(problem: Problem) -> list[Candidate]:
    """Machinery at a fixed frequency, seen through the sampling: ``T += b cos + c sin (2 pi t / period)``.

    Frequencies are those where the differenced residual, seen through each axis' projection, has its
    highest peaks. The highest of m (in steps of one period in the log), taken between them, too, exceeds
    a high u by chance as often as the highest of ``m sqrt(pi u / 6)`` independent ones (Davies 1987,
    Biometrika 74:33). At the test's level that is 5 m, and there are five peaks to count.
    """
    survey = problem.survey
    t = survey.time
    interval = float(np.median(np.diff(t)))
    slots = np.rint((t - t[0]) / interval).astype(np.int64)
    if slots[-1] > 8 * len(t):
        return []
    flat = np.append(0.0, np.diff(problem.residual) * survey.follows()[1:])
    size = 1 << int(np.ceil(np.log2(slots[-1] + 1)) + 1)
    body = problem.jacobian[:, 6:]
    lines = np.array([np.fft.rfft(np.bincount(slots, flat * slope, minlength=size)) for slope in body.T])
    # power in all three axes together; the inverse keeps what they share from counting twice
    power = np.einsum("if,ij,jf->f", lines.conj(), np.linalg.inv(body.T @ body), lines).real
    frequency = np.fft.rfftfreq(size, interval)
    width = min(201, len(power))
    smooth = np.convolve(power, np.ones(width) / width, mode="same") + 1e-300
    ratio = np.where(frequency * float(np.ptp(t)) > 20.0, power / smooth, 0.0)
    made: list[Candidate] = []

    def rebuild(period: float) -> Candidate:
        effect = TimeEffect(cause="interference_tone", shape="tone", start=float(t[0]), period=period)
        names = tuple(f"{f} {axis}" for f in ("cos", "sin") for axis in AXES)
        return of_effect(
            problem, effect, 10.0, "nT", names=names, point=GridPoint({"period": (period, "s")}, rebuild),
            look_elsewhere=0.5 * len(t),
        )  # fmt: skip

    for _ in range(5):
        peak = int(np.argmax(ratio))
        if ratio[peak] <= 0.0:
            break
        made.append(rebuild(float(1.0 / (_top(power, peak) * frequency[1]))))
        ratio[max(peak - 4, 0) : peak + 5] = 0.0
    return made


def _top(power: FloatArray, peak: int) -> float:
    """Return where, in bins, a parabola through a peak and its neighbours is highest.

    A line between two bins loses up to a fifth of its power in either.
    """
    low, top, high = power[[peak - 1, peak, peak + 1 if peak + 1 < len(power) else peak - 1]]
    return peak + (0.5 * (low - high) / (low - 2.0 * top + high) if top > max(low, high) else 0.0)
