r"""Kriging from the nearest samples, for areas where nodes as fine as the crustal field are too many.

Random sources at a depth d have the spectrum :math:`e^{-2 k d}` (Spector & Grant 1970). With
:math:`\int e^{-k h} J_0(k r)\, k\, dk = h / (r^2 + h^2)^{3/2}` the covariance of their field is

.. math:: C(r) = s^2 h^3 / (r^2 + h^2)^{3/2}, \quad h = 2 d.

Depth, amplitude s and noise maximise the likelihood of some samples. Each is predicted from its nearest
samples among those that precede it in a random order (Vecchia 1988). A line with wrong positions reads an
additional field of the same covariance, which no other line shares. The covariance between two samples of one
line is therefore :math:`(1 + g^2) C`. The predictions from the other lines determine g.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.estimation.residual import rms
from magbridge.survey.samples import Roughness, Samples

__all__ = ["Kriged", "kriged"]

NEAREST, GIVEN = 100, 40
"""Number of samples that predict a place, and number that predict each of the :data:`CHOOSING` samples."""
AMONG = 400
"""Number of nearest samples from which the :data:`GIVEN` are selected."""
CHOOSING = 600
"""Number of samples whose predictions determine depth, amplitude and noise."""
MAX_SEARCH_STEPS = 50
"""Largest number of evaluations in the search for depth, amplitude and noise."""
SHARE, SPREAD = 0.1, np.log(5.0)
"""Median of the prior of g, and the 1-sigma of its logarithm."""
SHARES = np.geomspace(0.02, 5.0, 60)
"""Values of g that the estimate tries."""
SAMPLE_SPACING_DEPTHS = 2.0
"""Distance between the samples of a line that determine its g, in depths of the sources."""
VARYING_LOG_RATIO = 5.0
"""Smallest gain of log likelihood with which the field's amplitude varies from place to place."""
KRIGED_PLACES = 256
"""Number of places that are kriged at once."""


@dataclass(frozen=True, eq=False)
class Kriged:
    """Kriging predictor at the height of the samples: the samples, and the covariance of their field."""

    place: FloatArray
    value: FloatArray
    line: IndexArray
    """`place`, `value`, `line`: samples' positions (n, 2), m, anomalies (n,), nT, and line numbers (n,)."""
    roughness: Roughness
    tree: cKDTree
    below: float
    """Depth of the sources below the samples, m."""
    size: float
    noise: float
    """`size`, `noise`: standard deviation of the field where the roughness is 1, and of the noise, nT."""
    share: FloatArray
    """g (lines,): amplitude of the field that only this line reads, over that of the crustal field."""

    def evaluate(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the field and its variance (n,) each, nT and nT², at places (n, 2), m."""
        out = np.empty((len(place), 2))
        for start in range(0, len(place), KRIGED_PLACES):
            some = place[start : start + KRIGED_PLACES]
            out[start : start + KRIGED_PLACES] = self.given(some, self.tree.query(some, NEAREST)[1])
        return out[:, 0], out[:, 1]

    def of_a_line(self, place: FloatArray) -> FloatArray:
        """Return the 1-sigma (n,), nT, of a line's reading about the true field at places (n, 2), m."""
        return np.asarray(np.hypot(rms(self.share) * self.size * self.roughness.evaluate(place), self.noise))

    def given(self, place: FloatArray, neighbours: IndexArray, line: IndexArray | None = None) -> FloatArray:
        """Return the field (nT) and its variance (nT²), (n, 2), at places (n, 2), m, from samples (n, k).

        `neighbours` are the samples' indices. The prior of the mean around a place is as wide as the spread
        of all samples. With `line` (n,) the field includes the additional field that this line reads.
        """
        x, lines, here = self.place[neighbours], self.line[neighbours], self.roughness.evaluate(place)
        there = self.roughness.evaluate(x.reshape(-1, 2)).reshape(neighbours.shape)
        wide, own, k = float(self.value.var()), self.share[lines] ** 2, np.arange(neighbours.shape[1])
        among = self._covariance(x[:, :, None] - x[:, None]) * there[:, :, None] * there[:, None]
        among = among * (1.0 + own[:, :, None] * (lines[:, :, None] == lines[:, None])) + wide
        # C + s^2 1 among the neighbours, c from them to the place: value c^T (C + s^2 1)^-1 y.
        among[:, k, k] += self.noise**2
        to = self._covariance(place[:, None] - x) * here[:, None] * there
        variance = (self.size * here) ** 2
        if line is not None:
            to = to * (1.0 + own * (line[:, None] == lines))
            variance = variance * (1.0 + self.share[line] ** 2)
        # Simple kriging about the neighbours' mean, with its variance `wide` added to every covariance.
        mean = self.value[neighbours].mean(axis=1)
        off = self.value[neighbours] - mean[:, None]
        solved = np.linalg.solve(among, np.stack([off, to + wide], axis=2))
        value, known = np.einsum("nk,nkc->cn", to + wide, solved)
        return np.stack([mean + value, np.maximum(variance + wide - known, 0.0)], axis=1)

    def _covariance(self, separation: FloatArray) -> FloatArray:
        """Return the covariance, nT², of places that are `separation` (..., 2), m, apart, for roughness 1."""
        # C(r) = s^2 h^3 / (r^2 + h^2)^(3/2)
        h = 2.0 * self.below
        return np.asarray(self.size**2 * h**3 / ((separation**2).sum(axis=-1) + h * h) ** 1.5)


def kriged(samples: Samples, value: FloatArray, length: float) -> Kriged:
    """Return the kriging predictor; its amplitude varies with the place if that is clearly likelier.

    `value` (n,), nT, is the anomaly without the lines' levels. `length`, m, is about the field's correlation
    length. At least :data:`AMONG` samples are needed.
    """
    tree, size = cKDTree(samples.place), float(np.std(value))
    share = np.zeros(int(samples.line.max()) + 1)
    even, score = _likeliest(Kriged(
        samples.place, value, samples.line, Roughness.uniform(), tree, length / 2.0, size,
        0.02 * size, share,
    ))  # fmt: skip
    rough = Roughness.from_samples(samples, 2.0 * even.below)
    uneven, other = _likeliest(replace(even, roughness=rough))
    best = uneven if other > score + VARYING_LOG_RATIO else even
    share = np.array([_share(best, line) for line in range(len(share))])
    return replace(best, share=share)


def _likeliest(start: Kriged) -> tuple[Kriged, float]:
    """Return `start` with the likeliest depth, amplitude and noise, and their log likelihood."""
    rng = np.random.default_rng(0)
    rank, some = rng.permutation(len(start.value)), rng.choice(len(start.value), CHOOSING)
    near = start.tree.query(start.place[some], AMONG)[1]
    # Vecchia: each sample given the nearest of those before it in a random order.
    near, whole = _first(near, rank[near] < rank[some, None])
    some = some[whole]
    first = np.log([start.below, start.size, start.noise])

    def kriged_with(x: FloatArray) -> Kriged:
        below, size, noise = np.exp(x).tolist()
        return replace(start, below=below, size=size, noise=noise)

    def downhill(x: FloatArray) -> float:
        one = kriged_with(x)
        mean, variance = one.given(one.place[some], near, one.line[some]).T
        return -_likelihood(one.value[some] - mean, variance + one.noise**2)

    # Nelder-Mead over the logs of depth, size and noise.
    simplex = first + 0.5 * np.vstack([np.zeros(3), np.eye(3)])
    options = {"initial_simplex": simplex, "maxfev": MAX_SEARCH_STEPS}
    found = minimize(downhill, first, method="Nelder-Mead", options=options)
    return kriged_with(found.x), -float(found.fun)


def _share(kriged: Kriged, line: int) -> float:
    """Return the likeliest g of a line from predictions by other lines; the prior's median without those."""
    rows = np.flatnonzero(kriged.line == line)
    steps = np.linalg.norm(np.diff(kriged.place[rows], axis=0), axis=1)
    step = float(np.median(steps)) if len(steps) else 1.0
    rows = rows[:: max(round(SAMPLE_SPACING_DEPTHS * kriged.below / max(step, 1e-3)), 1)]
    near = kriged.tree.query(kriged.place[rows], AMONG)[1]
    near, whole = _first(near, kriged.line[near] != line)
    if not whole.any():
        return SHARE
    rows = rows[whole]
    mean, variance = kriged.given(kriged.place[rows], near).T
    # Likelihood of the line's own part g^2 C, times a log-normal prior of g.
    size2 = (kriged.size * kriged.roughness.evaluate(kriged.place[rows])) ** 2
    scores = [
        _likelihood(kriged.value[rows] - mean, variance + g**2 * size2 + kriged.noise**2)
        - 0.5 * (np.log(g / SHARE) / SPREAD) ** 2
        for g in SHARES
    ]
    return float(SHARES[int(np.argmax(scores))])


def _first(neighbours: IndexArray, earlier: BoolArray) -> tuple[IndexArray, BoolArray]:
    """Return the first :data:`GIVEN` of the `neighbours` (n, k) that are True in `earlier` (n, k).

    Rows with fewer are left out; the mask (n,) that is returned too is True for the other rows.
    """
    whole = np.asarray(earlier.sum(axis=1) >= GIVEN)
    order = np.argsort(~earlier[whole], axis=1, kind="stable")[:, :GIVEN]
    return np.take_along_axis(neighbours[whole], order, axis=1), whole


def _likelihood(error: FloatArray, variance: FloatArray) -> float:
    return -0.5 * float((error**2 / variance + np.log(variance)).sum())
