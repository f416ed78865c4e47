"""The reference is wrong: with time, with place, by a constant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.spatial.distance import cdist

from magbridge.diagnose.causes.candidates import Candidate, of_reference
from magbridge.diagnose.compare.columns import Interpolated
from magbridge.diagnose.compare.problem import Problem

__all__ = ["diurnal_variation", "map_error", "reference_bias"]

FloatArray = NDArray[np.float64]

CELLS, WAVES = 300, 200
"""Most cells at which a map's error is described, and most functions that describe it."""
FINEST = 125.0
"""m, the smallest cell: from the height that maps are flown at nothing finer is seen."""
LENGTHS = np.array([2.0, 4.0, 8.0, 16.0])
"""Correlation lengths of a map's error, in cells."""
ERROR = 20.0
"""nT, a plausible error of a map (1-sigma)."""


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
        made.append(of_reference(problem, "diurnal_variation", basis, width, names))
    return made


def map_error(problem: Problem) -> list[Candidate]:
    r"""The anomaly map is wrong by a smooth function of place, a Gaussian process (Matern 3/2).

    It is the same on every pass at one depth. The sources of what a map lacks lie below, so it changes with
    depth as fast as along the track (a wave of wavenumber k grows as ``exp(k z)``: Laplace's equation). A map
    used as it was flown, high above the vehicle, lacks little else than this growth.

    The error is expanded in Karhunen-Loeve functions at the visited cells Z, ``K(x, Z) V / lambda`` with
    ``K(Z, Z) = V lambda V^T``: there are no more functions than visited cells, however large the box. A
    correlation length l enters by the functions' prior variances alone, ``diag(V^T K_l V)``.
    """
    place = problem.survey.place
    if place is None or np.ptp(place[:, :2], axis=0).max() < 200.0:
        return []
    Z, cell = _cells(place)
    lengths = cell * LENGTHS
    middle = float(lengths[len(lengths) // 2])
    values, vectors = np.linalg.eigh(_matern(Z, Z, middle))
    values, V = values[::-1][:WAVES], vectors[:, ::-1][:, :WAVES]
    between, corners = _between(place, cell)
    at_corners = _matern(corners, Z, middle) @ (V / values)
    at_corners -= between.mean(axis=0) @ at_corners  # a constant is another cause
    spectra = np.array([np.einsum("ik,ij,jk->k", V, _matern(Z, Z, length), V) for length in lengths])
    width = ERROR * np.sqrt(values)
    names = tuple(f"function {k + 1}" for k in range(len(width)))
    columns = Interpolated(diags_array(problem.gain) @ between, at_corners * width)
    units = ("nT",) * len(width)
    return [Candidate("map_error", None, columns, width, names, units, spectra=spectra / values)]


def _cells(place: FloatArray) -> tuple[FloatArray, float]:
    """(m, d) mean places of the track in the cells that hold it, at most :data:`CELLS`, and their side, m."""
    side = FINEST
    while (found := _each(np.floor(place / side)))[1].max() >= CELLS:
        side *= 1.1
    of = found[1]
    return np.stack([np.bincount(of, x) for x in place.T], axis=1) / np.bincount(of)[:, None], side


def _each(corners: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the distinct rows (c, d) of whole numbers (n, d), and the place of each row among them (n,)."""
    low = corners.min(axis=0)
    box = np.ptp(corners, axis=0).astype(int) + 1
    keys, of = np.unique(np.ravel_multi_index((corners - low).astype(int).T, box), return_inverse=True)
    return np.stack(np.unravel_index(keys, box), axis=1) + low, of


def _between(place: FloatArray, side: float) -> tuple[csr_array, FloatArray]:
    """(n, c) weights of linear interpolation between the corners (c, d), m, of the visited cells."""
    low = np.floor(place / side)
    high = place / side - low
    steps = list(np.ndindex((2,) * place.shape[1]))
    share = np.concatenate([np.prod(np.where(step, high, 1.0 - high), axis=1) for step in steps])
    corners, of = _each(np.concatenate([low + step for step in steps]))
    rows = np.tile(np.arange(len(place)), len(steps))
    return csr_array((share, (rows, of)), (len(place), len(corners))), corners * side


def _matern(a: FloatArray, b: FloatArray, length: float) -> FloatArray:
    """(n, m) correlation between places, Matern's of order 3/2."""
    r = np.sqrt(3.0) / length * cdist(a, b)
    found: FloatArray = (1.0 + r) * np.exp(-r)
    return found


def reference_bias(problem: Problem) -> list[Candidate]:
    """The reference is off by a constant: the main-field model, say, by some tens of nT at this site."""
    ones = (~problem.survey.learned[:, None]).astype(np.float64)
    return [of_reference(problem, "reference_bias", lambda rows: ones[rows], np.array([30.0]), ("bias",))]
