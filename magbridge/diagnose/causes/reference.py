"""The reference is wrong: with time, with place, by a constant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.candidates import Candidate, of_reference
from magbridge.diagnose.problem import Problem

__all__ = ["diurnal_variation", "map_error", "reference_bias"]

FloatArray = NDArray[np.float64]


def diurnal_variation(problem: Problem) -> list[Candidate]:
    """The Earth's field itself varies: the Sq system's harmonics of the day, along the field (Chulliat et al. 2016)."""
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
        made.append(of_reference(problem, "diurnal_variation", basis, width, names))
    return made


def map_error(problem: Problem) -> list[Candidate]:
    """The anomaly map is wrong: smooth in place, the same on every pass; cosines over the box that was visited."""
    place = problem.survey.place
    if place is None:
        return []
    low, size = place.min(axis=0), np.ptp(place, axis=0)
    if size.max() < 200.0:
        return []
    u = (place - low) / max(float(size.max()), 1.0)
    made = []
    for highest in (1, 2, 3):
        waves = [(i, j) for i in range(highest + 1) for j in range(highest + 1) if i + j > 0]

        def basis(rows: slice, waves: list[tuple[int, int]] = waves, highest: int = highest) -> FloatArray:
            along = np.cos(np.pi * u[rows, :, None] * np.arange(highest + 1))
            return np.stack([along[:, 0, i] * along[:, 1, j] for i, j in waves], axis=1)

        width = np.array([40.0 / (i + j) for i, j in waves])
        names = tuple(f"north {i} east {j}" for i, j in waves)
        made.append(of_reference(problem, "map_error", basis, width, names))
    return made


def reference_bias(problem: Problem) -> list[Candidate]:
    """The reference is off by a constant: the main-field model at this site, some tens of nT."""
    ones = (~problem.survey.learned[:, None]).astype(np.float64)
    return [of_reference(problem, "reference_bias", lambda rows: ones[rows], np.array([30.0]), ("bias",))]
