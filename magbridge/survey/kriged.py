r"""Kriging from the nearest samples, for areas where nodes as fine as the crustal field are too many.

Sources that are distributed at random at a depth d have the spectrum :math:`e^{-2 k d}` (Spector & Grant
1970), and so, as :math:`\int e^{-k h} J_0(k r)\, k\, dk = h / (r^2 + h^2)^{3/2}`, the covariance

.. math:: C(r) = s^2 h^3 / (r^2 + h^2)^{3/2}, \quad h = 2 d.

The estimate of depth, size s and noise maximises the likelihood of some samples, each given the nearest of
those that precede it in a random order (Vecchia 1988). A line with wrong positions reads a crustal field of
the same kind, which no other line crosses: its samples have :math:`(1 + g^2) C` in common, with g from the
predictions of the other lines.
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
"""Samples from which a place is predicted, and from which each of :data:`CHOOSING` samples is."""
AMONG = 400
"""Nearest samples among which are the GIVEN."""
CHOOSING = 600
"""Samples whose predictions choose the depth of the sources."""
MAX_SEARCH_STEPS = 50
"""Steps of the maximisation over depth, size and noise."""
SHARE, SPREAD = 0.1, np.log(5.0)
"""Centre of the prior of g, and the 1-sigma of its logarithm."""
SHARES = np.geomspace(0.02, 5.0, 60)
"""Values of g that are tried."""
SAMPLE_SPACING_DEPTHS = 2.0
"""Distance, in depths of the sources, between the samples of a line that determine its g."""
VARYING_LOG_RATIO = 5.0
"""Nats from which on the field's size may vary from place to place."""
KRIGED_PLACES = 256
"""Places at a time."""


@dataclass(frozen=True, eq=False)
class Kriged:
    """Samples and the covariance of their field, for kriging at the height of the samples."""

    place: FloatArray
    value: FloatArray
    line: IndexArray
    """`place`, `value`, `line`: (n, 2) m, (n,) nT and the number of each's line."""
    roughness: Roughness
    tree: cKDTree
    below: float
    """Depth of the sources below the samples, m."""
    size: float
    noise: float
    """`size`, `noise`: nT, standard deviation of the field where the roughness is 1, and of the noise."""
    share: FloatArray
    """(lines,): g, what each alone reads, over the field."""

    def evaluate(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the field and its variance (n,) each, nT and nT², at places (n, 2), m."""
        out = np.empty((len(place), 2))
        for start in range(0, len(place), KRIGED_PLACES):
            some = place[start : start + KRIGED_PLACES]
            out[start : start + KRIGED_PLACES] = self.given(some, self.tree.query(some, NEAREST)[1])
        return out[:, 0], out[:, 1]

    def of_a_line(self, place: FloatArray) -> FloatArray:
        """Return 1-sigma (n,), nT, of a line's own part, which is not the field, at places (n, 2), m."""
        return np.asarray(np.hypot(rms(self.share) * self.size * self.roughness.evaluate(place), self.noise))

    def given(self, place: FloatArray, neighbours: IndexArray, line: IndexArray | None = None) -> FloatArray:
        """Return the field and its variance (n, 2) at places (n, 2) given the samples `neighbours` (n, k).

        The mean about a place is known only to the spread of all samples. With `line` (n,) it is the
        field as that line reads it.
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
    """Return the predictor from the nearest samples; its size varies with the place if that is likelier.

    There are at least :data:`AMONG` samples; `value` (n,), nT, is without the lines' levels, and the field
    has about the `length`, m.
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
    """Return the likeliest depth, size and noise, and the log likelihood."""
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
    """Return the likeliest g of a line by the prediction of the others; its prior where there are none."""
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
    """Return the first :data:`GIVEN` of the `earlier` `neighbours` (n, k), and whether as many exist (n,)."""
    whole = np.asarray(earlier.sum(axis=1) >= GIVEN)
    order = np.argsort(~earlier[whole], axis=1, kind="stable")[:, :GIVEN]
    return np.take_along_axis(neighbours[whole], order, axis=1), whole


def _likelihood(error: FloatArray, variance: FloatArray) -> float:
    return -0.5 * float((error**2 / variance + np.log(variance)).sum())
