"""The channel's own response: it bends, it clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.instrument import ResponseEffect
from magbridge.diagnose.causes.candidates import AXES, Candidate, of_effect, per
from magbridge.diagnose.causes.regressors import powers
from magbridge.diagnose.compare.problem import Problem

__all__ = ["nonlinearity", "saturation"]

FloatArray = NDArray[np.float64]


def nonlinearity(problem: Problem) -> list[Candidate]:
    """The response bends: ``T_i += b_i (H_i / H_0)^p``, p = 2 (a leak), 3 (a saturating core), or both.

    The leak is that of an even harmonic. Both together have six coefficients of one common size, because the
    three channels are built alike.
    """
    unit, H = problem.calibration.reference.field, problem.reading
    made = []
    for power in (2, 3):
        effect = ResponseEffect(cause="nonlinearity", unit=unit, power=power)
        phi = lambda rows, power=power: powers(H[rows].T / unit, power)[-1]  # noqa: E731
        names = tuple(f"{axis}{power}" for axis in AXES)
        made.append(of_effect(problem, effect, 50.0, per(f"{unit:.0f} nT", power), names=names, phi=phi))
    return [*made, replace(made[0].with_(made[1]), parts=(), spectra=np.ones((1, 6)))]


def saturation(problem: Problem) -> list[Candidate]:
    """A channel compresses or clips near its end: ``T_i -= b_1 + b_2 (H_i - knee) / H_0`` beyond the knee."""
    made = []
    for axis, sign in product(range(3), (1.0, -1.0)):
        reading = sign * problem.reading[:, axis]
        if reading.max() >= 0.2 * problem.calibration.reference.field:  # anywhere near an end
            knees = [sign * float(np.quantile(reading, share)) for share in (0.7, 0.85, 0.95, 0.99)]
            made += _clipped(problem, axis, knees)
    return made


def _clipped(problem: Problem, axis: int, knees: Sequence[float]) -> list[Candidate]:
    """Return the candidates for one axis, at one end of its range."""
    unit, H = problem.calibration.reference.field, problem.reading
    names = (f"{AXES[axis]} beyond", f"{AXES[axis]} slope")

    def again(knee: float) -> Candidate:
        effect = ResponseEffect(cause="saturation", unit=unit, axis=axis, knee=knee)
        way = 1.0 if knee >= 0.0 else -1.0

        def phi(rows: slice) -> FloatArray:
            over = way * (H[rows, axis] - knee)
            return np.stack([way * (over >= 0), way * np.maximum(over, 0.0) / unit])

        return of_effect(
            problem, effect, np.array([100.0, 0.1 * unit]), ("nT", per(f"{unit:.0f} nT")), names=names,
            phi=phi, shape={"knee": (knee, "nT")}, again=again,
        )  # fmt: skip

    return [again(knee) for knee in knees]
