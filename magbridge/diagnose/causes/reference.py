"""The reference is wrong: with time, by a constant. Where it is a map: :mod:`.map_error`."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate, of_reference
from magbridge.diagnose.compare.problem import Problem

__all__ = ["diurnal_variation", "reference_bias"]


def diurnal_variation(problem: Problem) -> list[Candidate]:
    """The Earth's field itself varies: harmonics of the day along the field (Chulliat et al. 2016)."""
    t = problem.survey.time
    span = float(t[-1] - t[0])
    harmonics = [h for h in (1, 2, 3) if 86400.0 / h < 4.0 * span]
    made = []
    for some in (harmonics[k:] for k in range(len(harmonics))):

        def basis(rows: slice, some: list[int] = some) -> FloatArray:
            angle = 2.0 * np.pi * t[rows, None] / 86400.0 * np.array(some)
            return np.hstack([np.cos(angle), np.sin(angle)])

        names = tuple(f"{f} {24 // h} h" for f in ("cos", "sin") for h in some)
        width = np.tile(20.0 / np.array(some), 2)
        made.append(of_reference(problem, "diurnal_variation", basis, width, names, "time"))
    return made


def reference_bias(problem: Problem) -> list[Candidate]:
    """The reference is off by a constant, as a main-field model is by the rock that it lacks.

    At 68 % of sites each component is within 73 to 114 nT (Beggan 2022, Earth Planets Space 74:17).
    """
    ones = (~problem.survey.learned[:, None]).astype(np.float64)
    return [
        of_reference(
            problem, "reference_bias", lambda rows: ones[rows], np.array([100.0]), ("bias",), "constant"
        )
    ]
