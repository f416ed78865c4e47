"""Causes in the reference field: an error of the anomaly map, a variation with time, and a constant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.spatial.distance import cdist

from magbridge.arrays import FloatArray, IndexArray
from magbridge.diagnose.causes.base import Cause
from magbridge.diagnose.columns import Candidate, of_reference
from magbridge.diagnose.problem import Problem

MAX_MAP_ERROR_CELLS = 300
"""Largest number of cells of the track on which the error of a map is modelled."""
FINEST = 125.0
"""Side of the smallest cell, m."""
SCALES = np.array([1.0, 2.0, 4.0, 8.0, 32.0])
"""Depths of sources below the deepest point of the track, and half of correlation lengths, in cell sides."""
ALTITUDE = 100.0
"""Altitude at which a map holds, m above the sea: aircraft survey at 60 to 150 m."""
FAINT = 1e-6
"""Fraction of a map's mean square error below which a Karhunen-Loeve function is left out."""
ERROR = 20.0
"""Plausible error of a map (1-sigma), nT."""


class MapError(Cause):
    """The anomaly map is wrong: it holds at another height than the vehicle's, or contains errors.

    *Another height*: the map gives the field T at an altitude a, and the vehicle measures it at a depth z.
    The error is ``T(x, z) - T(x, -a)`` (:func:`_lacking`). *Errors of the map* are a smooth function of the
    horizontal position (Matern 3/2).
    """

    name = "map_error"
    meaning = "the map or field model that served as the truth is wrong from place to place"
    needs = "positions over some hundred metres"
    disambiguation = (
        "cross the track again, at another depth too: an error of the map is the same on every pass at one "
        "depth"
    )
    family = "reference"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return two Gaussian processes: a map for another height, and a map with errors."""
        place = problem.survey.place
        if place is None or np.ptp(place[:, :2], axis=0).max() < 200.0:
            return []
        Z, cell = _cells(place)
        weights, corners = _corner_weights(place, cell)
        seen = diags_array(problem.reference_jacobian) @ weights
        # Sources below the deepest place, and correlation lengths, both in units of the cells
        depths, lengths = place[:, 2].max() + cell * SCALES, 2.0 * cell * SCALES
        lacking = _expanded([partial(_lacking, d=d) for d in depths], Z, corners)
        drawn = _expanded([partial(_matern, length=length) for length in lengths], Z, corners)
        drawn[0][:] -= weights.mean(axis=0) @ drawn[0]
        made = []
        for functions, variances, spectra in (lacking, drawn):
            width = ERROR * np.sqrt(variances)
            columns = partial(_interpolated, seen, functions * width)
            names, units = tuple(f"function {k + 1}" for k in range(len(width))), ("nT",) * len(width)
            made.append(
                Candidate(self.name, None, columns, width, names, units, spectra=spectra, about="place")
            )
        return made


def _expanded(
    covariances: Sequence[Callable[[FloatArray, FloatArray], FloatArray]], Z: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Karhunen-Loeve functions (m, k) at places x (m, 3), their variances (k,) and spectra (l, k).

    K is the mean of the l covariances, and ``K(Z, Z) = V lambda V^T`` at the visited cells Z (c, 3). The
    functions are ``K(x, Z) V / lambda``, of variance lambda. Their variances under the l-th covariance,
    ``diag(V^T K_l V)``, divided by lambda, are the spectra.
    """
    # Mean of all covariances, each scaled to unit mean variance, in its eigenfunctions
    each = np.array([K(Z, Z) for K in covariances])
    equal = len(Z) / len(each) / each.trace(axis1=1, axis2=2)
    values, V = np.linalg.eigh(np.tensordot(equal, each, 1))
    values, V = values[kept := values > FAINT * len(Z)], V[:, kept]
    mean = sum(share * K(x, Z) for share, K in zip(equal, covariances, strict=True))
    # Prior variances by each single covariance: the diagonal of V^T K_l V
    own = equal[:, None] * np.einsum("ik,lij,jk->lk", V, each, V, optimize=True)
    return mean @ (V / values), values, np.maximum(own / values, FAINT)


def _cells(place: FloatArray) -> tuple[FloatArray, float]:
    """Return the mean position (c, 3), m, in each of at most 300 cells of the track, and their side, m."""
    # Coarser cells until there are few enough
    side = FINEST
    while (found := _each(np.floor(place / side)))[1].max() >= MAX_MAP_ERROR_CELLS:
        side *= 1.1
    of = found[1]
    return np.stack([np.bincount(of, x) for x in place.T], axis=1) / np.bincount(of)[:, None], side


def _each(corners: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Return the distinct rows (c, d) of whole numbers (n, d), and for each row (n,) its index among them."""
    low = corners.min(axis=0)
    box = np.ptp(corners, axis=0).astype(int) + 1
    keys, of = np.unique(np.ravel_multi_index((corners - low).astype(int).T, box), return_inverse=True)
    return np.stack(np.unravel_index(keys, box), axis=1) + low, of


def _corner_weights(place: FloatArray, side: float) -> tuple[csr_array, FloatArray]:
    """Return (n, c) weights of linear interpolation between corners of visited cells, and these (c, d), m."""
    low = np.floor(place / side)
    high = place / side - low
    # Trilinear weights of the corners of each sample's cell
    steps = list(np.ndindex((2,) * place.shape[1]))
    share = np.concatenate([np.prod(np.where(step, high, 1.0 - high), axis=1) for step in steps])
    corners, of = _each(np.concatenate([low + step for step in steps]))
    rows = np.tile(np.arange(len(place), dtype=np.int32), len(steps))
    return csr_array((share, (rows, of.astype(np.int32))), (len(place), len(corners))), corners * side


def _interpolated(weights: csr_array, values: FloatArray, rows: slice) -> FloatArray:
    """Return rows of the product of `weights` (n, c) and `values` (c, k): columns interpolated from nodes."""
    return np.asarray(weights[rows] @ values)


def _lacking(a: FloatArray, b: FloatArray, d: float) -> FloatArray:
    """Return the covariance (n, m) of a map's height error between places a (n, 3) and b (m, 3), m.

    The sources are at a depth d. At a horizontal distance r and depths z and z' the field has the covariance
    ``C(z, z') = (s^2 + r^2)^(-1/2)``, ``s = 2 d - z - z'`` (Moritz 1980, the reciprocal distance).
    """
    r2 = cdist(a[:, :2], b[:, :2], "sqeuclidean")

    def reciprocal(upper: FloatArray | float, lower: FloatArray | float) -> FloatArray:
        return np.asarray(((upper + lower) ** 2 + r2) ** -0.5)

    # C(z, z') - C(z, -a) - C(-a, z') + C(-a, -a), each from its distance to the sources
    here, there, high = d - a[:, 2:], d - b[:, 2], d + ALTITUDE
    return reciprocal(here, there) - reciprocal(here, high) - reciprocal(high, there) + reciprocal(high, high)


def _matern(a: FloatArray, b: FloatArray, length: float) -> FloatArray:
    """Return the Matern 3/2 correlation (n, m) of the horizontal positions of places (n, 3) and (m, 3)."""
    r = np.sqrt(3.0) / length * cdist(a[:, :2], b[:, :2])
    found: FloatArray = (1.0 + r) * np.exp(-r)
    return found


class DiurnalVariation(Cause):
    """The Earth's field itself varies: harmonics of the day along the field (Chulliat et al. 2016)."""

    name = "diurnal_variation"
    meaning = "the Earth's field itself changed during the day"
    needs = "at least two hours"
    disambiguation = "a base station ashore"
    family = "reference"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return the harmonics of a day of which the log covers a quarter period, also less the slowest."""
        t = problem.survey.time
        span = float(t[-1] - t[0])
        # Harmonics of which the log has at least a quarter of a period
        harmonics = [h for h in (1, 2, 3) if 86400.0 / h < 4.0 * span]
        made = []
        for some in (harmonics[k:] for k in range(len(harmonics))):

            def basis(rows: slice, kept: list[int] = some) -> FloatArray:
                angle = 2.0 * np.pi * t[rows, None] / 86400.0 * np.array(kept)
                return np.hstack([np.cos(angle), np.sin(angle)])

            names = tuple(f"{f} {24 // h} h" for f in ("cos", "sin") for h in some)
            width = np.tile(20.0 / np.array(some), 2)
            made.append(of_reference(problem, self.name, basis, width, names, "time"))
        return made


class ReferenceBias(Cause):
    """The reference is off by a constant: a main-field model lacks the crustal field.

    At 68 % of sites a model errs by at most 73 to 114 nT (Beggan 2022, Earth Planets Space 74:17).
    """

    name = "reference_bias"
    meaning = "the map or field model that served as the truth is wrong by a constant"
    needs = "a reference"
    disambiguation = "calibrate and survey at one place, next to a proton magnetometer"
    family = "reference"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a constant error, which is zero in the calibration's own logs."""
        ones = (~problem.survey.learned[:, None]).astype(np.float64)
        width = np.array([100.0])
        return [of_reference(problem, self.name, ones.__getitem__, width, ("bias",), "constant")]
