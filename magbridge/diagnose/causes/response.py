"""The response of each of the sensor's axes: it bends, it clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import product

import numpy as np

from magbridge.calibration.instrument_effects import ResponseEffect
from magbridge.diagnose.columns import AXES, Candidate, GridPoint, of_effect, per
from magbridge.diagnose.problem import Problem

__all__ = ["BENT", "nonlinearity", "saturation"]

BENT = 50.0
"""nT, the most that a response may plausibly bend (RMS of its coefficients): a thousandth of the field, as
magnetoresistive sensors do. Fluxgates are ten times better."""


def nonlinearity(problem: Problem) -> list[Candidate]:
    """The response bends: ``T_i += b_i (H_i / H_0)^p``, p = 2 (a leak), 3 (a saturating core), or 1 to 3.

    The leak is that of an even harmonic. A feedback of finite gain leaves the core the field that its output
    takes, and that is the inverse of its magnetisation curve: steeper the farther out, but not flat at zero
    either. So a core that shows through also changes the sensitivity, and p = 1 belongs to the bend. All nine
    coefficients have one common size, because the three axes have the same design, up to :data:`BENT`: nine
    free numbers could otherwise take a wrong reference and a mass' error for one bend.
    """
    # a common size is at most ten widths (:data:`~magbridge.diagnose.joint.PRIOR_SIZES`)
    common = [_power(problem, power, 0.1 * BENT) for power in (1, 2, 3)]
    every = replace(reduce(Candidate.with_, common), parts=(), spectra=np.ones((1, 9)))
    return [*(_power(problem, power, BENT) for power in (2, 3)), every]


def _power(problem: Problem, power: int, width: float) -> Candidate:
    unit = problem.calibration.reference.field
    effect = ResponseEffect(cause="nonlinearity", unit=unit, power=power)
    names = tuple(f"{axis}{power}" for axis in AXES)
    return of_effect(problem, effect, width, per(f"{unit:.0f} nT", power), names=names)


def saturation(problem: Problem) -> list[Candidate]:
    """An axis compresses or clips near its end: ``T_i -= b_1 + b_2 (H_i - knee) / H_0`` beyond the knee."""
    made = []
    for axis, sign in product(range(3), (1.0, -1.0)):
        reading = sign * problem.reading[:, axis]
        if reading.max() >= 0.2 * problem.calibration.reference.field:  # anywhere near an end
            knees = [sign * float(np.quantile(reading, share)) for share in (0.7, 0.85, 0.95, 0.99)]
            made += _clipped(problem, axis, knees)
    return made


def _clipped(problem: Problem, axis: int, knees: Sequence[float]) -> list[Candidate]:
    """Return the candidates for one axis, at one end of its range."""
    unit = problem.calibration.reference.field
    names = (f"{AXES[axis]} jump", f"{AXES[axis]} slope")

    def rebuild(knee: float) -> Candidate:
        effect = ResponseEffect(cause="saturation", unit=unit, axis=axis, knee=knee)
        return of_effect(
            problem, effect, np.array([100.0, 0.1 * unit]), ("nT", per(f"{unit:.0f} nT")), names=names,
            point=GridPoint({"knee": (knee, "nT")}, rebuild),
        )  # fmt: skip

    return [rebuild(knee) for knee in knees]
