"""The unexplained part without a description: outliers, slow noise, mere size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from magbridge.arrays import BoolArray, FloatArray
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.competing import CompetingHypothesis
from magbridge.diagnose.inference.evidence import REMNANT
from magbridge.diagnose.inference.hypothesis import Hypothesis
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.outliers import Outliers
from magbridge.diagnose.seen import Memory, memory
from magbridge.diagnose.unexplained.leftover import Leftover
from magbridge.estimation.residual import rms

__all__ = ["far_from_white", "switching", "unlisted"]

LOUD = 2.0
"""Multiple of the calibration's stated noise: 1.5 times is still noise, at twice something is wrong."""
SLOW, SMOOTH, NEGLIGIBLE = 0.4, 5.0, 1e-5
"""A residual is far from white if so much of its power is left in means over 64 samples, or if its RMS is so
many times what changes from one sample to the next (autoregressive noise of 0.96); and its RMS, as a share of
the field, below which that does not matter."""


def unlisted(
    problem: Problem,
    fit: Joint,
    named: Sequence[Hypothesis],
    off: Outliers | None,
    after: FloatArray,
    counts: BoolArray,
) -> Leftover | None:
    """Return the part that the `named` causes leave unexplained, or None.

    `off` are wrong samples, `after` (n,) is the residual on parts left out, nT, of which `counts` (n,) count.
    """
    return _passing(off) or _slow(problem, fit, named) or _loud(problem, after, counts)


def switching(
    problem: Problem, fit: Joint, named: Sequence[Hypothesis], off: Outliers | None, *, ended: bool
) -> Leftover | None:
    """Describe a switching signal if it is stronger than all `named` causes, or has ended the search.

    Else return None. The noise's memory has absorbed the signal except for its level shifts, and the names
    describe that rest; after a search that ended, competing names were not tried.
    """
    if off is None or not off.lasting:
        return None
    slow = _slow(problem, fit, named)
    if not ended and (slow is None or any(one.signal_to_noise >= slow.signal_to_noise for one in named)):
        return None
    within = tuple(CompetingHypothesis(one.candidate, 0.0) for one in named)
    rest = slow or _passing(off)
    return rest and rest._replace(kind="switching", within=within, shifts=tuple(off.rows.tolist()))


def _passing(off: Outliers | None) -> Leftover | None:
    """Describe wrong samples that are not isolated: something passed by, rang for a few samples, switched."""
    if off is None or off.isolated:
        return None
    kind = "switching" if off.lasting else "transient"
    shifts = tuple(off.rows.tolist()) if off.lasting else ()
    return Leftover(kind, float(np.sqrt(off.ratio)), off.p_value, 0.5 * off.ratio, None, None, shifts=shifts)


def _loud(problem: Problem, after: FloatArray, counts: BoolArray) -> Leftover | None:
    """Describe a structureless residual beyond the calibration's stated noise and coefficient errors."""
    power = float(np.sum(after[counts] ** 2 / np.maximum(problem.stated[counts], 1e-12)))
    n = int(counts.sum())
    if problem.calibration.noise.sensor <= 0.0 or power < LOUD**2 * n:
        return None
    return Leftover("broadband", float(np.sqrt(power - n)), float(chi2.sf(power, n)), 0.0, None, None)


def far_from_white(problem: Problem, found: Memory) -> bool:
    """Return True if a residual of this memory is more than noise of the sensor."""
    lasts = found.slow >= SLOW or found.rms >= SMOOTH * found.white
    return lasts and found.rms >= NEGLIGIBLE * float(np.median(problem.survey.reference))


def _slow(problem: Problem, fit: Joint, named: Sequence[Hypothesis]) -> Leftover | None:
    """Describe a residual that is far from white, though no description of the list stands out of it.

    Noise of a long memory can describe any slow signal, but such a signal is not noise of the sensor. Noise
    that grows towards low frequencies can, too, unless it may be a remnant of the strongest cause.
    """
    slow = problem.slow_noise(fit.z)
    residual = (fit.residual + slow) / problem.reference_jacobian
    found = memory(problem, residual)
    if problem.waves.size:
        known = fit.prior[problem.slow] * np.diag(fit.covariance)[problem.slow]
        power, freedom = float(np.sum(fit.noise.whiten(slow) ** 2)), float(np.sum(1.0 - known))
        if power < (REMNANT * max((h.signal_to_noise for h in named), default=0.0)) ** 2:
            return None
        ratio, size = power, rms(slow / problem.reference_jacobian)
    elif far_from_white(problem, found):
        power, freedom = found.means * found.samples * found.slow, found.means
        ratio, size = (
            power * (found.rms / max(found.white, 1e-9)) ** 2,
            found.rms * float(np.sqrt(found.slow)),
        )
    else:
        return None
    p_value = float(chi2.sf(power, freedom))
    return Leftover("drift", float(np.sqrt(ratio)), p_value, 0.0, None, None, size=size)
