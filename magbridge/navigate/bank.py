"""Many hypotheses: a bank of extended Kalman filters over a position that is not known well enough for one.

A Gaussian too wide for the map to be straight under it is split into many that are narrow enough; each is
filtered as if it were alone, all in one pass of arrays; their weights follow the likelihoods (Alspach & Sorenson
1972). Hypotheses that grow too wide are split again, those that fade are dropped, those that meet are merged.
Nothing is drawn at random: the same samples give the same bits. With one hypothesis it is the tracker.
"""

from __future__ import annotations

from math import hypot, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from magbridge.field.earth import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.model import Block

__all__ = ["Bank"]

Array = NDArray[np.float64]

MOST = 2_000  # hypotheses
AT_FIRST = 20_000  # of them, until the first measurement has thinned them out
CELL = 0.8  # of the resolution, within which two hypotheses are one
SPACING = 1.2  # of two neighbours, in their own sigma: their sum is flat to 1 %
EDGE = 3.5  # sigma, as far as a start is covered
FADED = 1e-7  # of the largest weight
MERGE_EVERY = 4  # updates
# One Gaussian as three narrower ones (DeMars et al. 2013, table 1), their variance such that the sum keeps its own.
THREE = np.array([-1.0575154615, 0.0, 1.0575154615])
THREE_WEIGHT = np.array([0.2252246249, 0.5495507502, 0.2252246249])
THREE_VARIANCE = 1.0 - float(THREE_WEIGHT @ THREE**2)


class Bank:
    """A Gaussian mixture on the six states, each part linearised by itself.

    Parameters
    ----------
    grid : AnomalyGrid
    x, P : ndarray, (6,), (6, 6)
        The Gaussian to begin with.
    resolution : float
        m, the position sigma to which a hypothesis is cut.
    gate : float
        Innovation squared over variance beyond which a hypothesis does not learn from a measurement.
    """

    def __init__(self, grid: AnomalyGrid, x: Array, P: Array, resolution: float, gate: float) -> None:
        self._grid, self._gate = grid, gate
        self._elsewhere = float(np.nanmean(grid.anomaly)), float(np.nanvar(grid.anomaly))
        self._updates = 0
        self.resolution = resolution
        self.w, self.x, self.P = self._cut(x, P)

    def __len__(self) -> int:
        return self.w.size

    def _cut(self, x: Array, P: Array) -> tuple[Array, Array, Array]:
        """Cut one Gaussian into a lattice of Gaussians of the bank's resolution along its position's axes.

        Notes
        -----
        ``N(x, P) = ∫ N(x + g s, P - g g' (σ² - σ_k²)) N(s; 0, σ² - σ_k²) ds`` along an axis e of the position,
        with σ² its variance and ``g = P e / σ²``: everything correlated with the position moves along.
        """
        values, axes = np.linalg.eigh(P[:2, :2])
        area = (
            (2.0 * EDGE / SPACING) ** 2
            * np.pi
            / 4.0
            * np.sqrt(np.prod(np.maximum(values, self.resolution**2)))
        )
        self.resolution = max(self.resolution, float(np.sqrt(area / AT_FIRST)))
        part, w, shifts = P.copy(), np.ones(1), np.zeros((1, x.size))
        for value, axis in zip(values, axes.T, strict=True):
            left = value - self.resolution**2
            if left <= 0.0:
                continue
            n = max(3, int(np.ceil(2.0 * EDGE * np.sqrt(left) / (SPACING * self.resolution))))
            s = np.linspace(-EDGE, EDGE, n)
            g = P[:, :2] @ axis / value
            w = np.outer(w, np.exp(-0.5 * s * s)).ravel()
            shifts = (shifts[:, None, :] + (s * np.sqrt(left))[:, None] * g).reshape(-1, x.size)
            part -= np.outer(g, g) * left
        keep = w > np.exp(-0.5 * EDGE**2)
        w, shifts = w[keep], shifts[keep]
        return w / w.sum(), x + shifts, np.broadcast_to(part, (w.size, *part.shape)).copy()

    def predict(self, F: Array, Q: Array) -> None:
        """Move every hypothesis on by one transition."""
        self.x = self.x @ F.T
        self.P = F @ self.P @ F.T + Q

    def update(self, block: Block) -> tuple[float, float, float]:
        """Take in one measurement; return its innovation (nT), its variance and its log-likelihood.

        A hypothesis off the map expects the map's mean and scatter, and learns nothing.
        """
        north, east = self.x[:, 0], self.x[:, 1]
        per_latitude, per_longitude = metres_per_degree(block.latitude)
        local = self._grid.evaluate(
            block.longitude + east / per_longitude, block.latitude + north / per_latitude
        )
        off = np.isnan(local.anomaly)
        anomaly, gn, ge, hnn, hne, hee, v = (np.where(off, 0.0, part) for part in local)
        pnn, pne, pee = self.P[:, 0, 0], self.P[:, 0, 1], self.P[:, 1, 1]
        a, b, c, d = (
            hnn * pnn + hne * pne,
            hnn * pne + hne * pee,
            hne * pnn + hee * pne,
            hne * pne + hee * pee,
        )
        anomaly += block.slope_north * north + block.slope_east * east + 0.5 * (a + d)
        v = v + block.variance + 0.5 * (a * a + 2.0 * b * c + d * d)
        row = np.zeros_like(self.x)
        row[:, 0], row[:, 1] = gn + block.slope_north, ge + block.slope_east
        row[:, 4:] = 1.0
        row[off, :2] = 0.0
        anomaly[off], v[off] = self._elsewhere[0], block.variance + self._elsewhere[1]
        return self._observe(block.anomaly - anomaly - self.x[:, 4] - self.x[:, 5], row, v, off)

    def update_position(self, north: float, east: float, sigma: float) -> None:
        """Take in a fix from elsewhere, m from the dead-reckoned position."""
        for axis, value in enumerate((north, east)):
            row = np.zeros_like(self.x)
            row[:, axis] = 1.0
            self._observe(
                value - self.x[:, axis], row, np.full(len(self), sigma * sigma), np.zeros(len(self), bool)
            )

    def _observe(
        self, y: Array, row: Array, variance: Array, off: NDArray[np.bool_]
    ) -> tuple[float, float, float]:
        gain = (self.P @ row[:, :, None])[:, :, 0]
        s = np.einsum("ki,ki->k", gain, row) + variance
        z2 = y * y / s
        likelihood = -0.5 * (np.minimum(z2, self._gate) + np.log(s) + log(2.0 * pi))
        mean = float(self.w @ y)
        spread = float(self.w @ (s + (y - mean) ** 2))
        learn = ((z2 <= self._gate) & ~off)[:, None]
        gain = np.where(learn, gain, 0.0)
        self.x = self.x + gain * (y / s)[:, None]
        self.P = self.P - gain[:, :, None] * (gain / s[:, None])[:, None, :]
        top = float(likelihood.max())
        w = self.w * np.exp(likelihood - top)
        total = float(w.sum())
        self.w = w / total
        self._updates += 1
        self._tidy()
        return mean, spread, top + log(total)

    def moments(self) -> tuple[Array, Array]:
        """Return mean (6,) and covariance (6, 6) of the whole mixture."""
        return _moments(self.w, self.x, self.P)

    def _tidy(self) -> None:
        """Drop what has faded, split what has grown too wide, and now and then merge what has met."""
        keep = self.w > FADED * self.w.max()
        if not keep.all():
            self._take(keep)
        if len(self) > MOST:
            self._take(np.sort(np.argsort(-self.w, kind="stable")[:MOST]))
        if self._updates % MERGE_EVERY == 0 and len(self) > 1:
            self._merge()
        pnn, pne, pee = self.P[:, 0, 0], self.P[:, 0, 1], self.P[:, 1, 1]
        largest = 0.5 * (pnn + pee) + np.hypot(0.5 * (pnn - pee), pne)
        wide = (largest > (1.5 * self.resolution) ** 2) & (self.w > 1e-4)
        if wide.any() and len(self) + 2 * int(wide.sum()) <= 2 * MOST:
            self._split(wide)

    def _take(self, keep: NDArray[np.bool_]) -> None:
        self.w, self.x, self.P = self.w[keep] / self.w[keep].sum(), self.x[keep], self.P[keep]

    def _split(self, wide: NDArray[np.bool_]) -> None:
        """Split along the widest axis of each position: the same mean and covariance."""
        w, x, P = self.w[wide], self.x[wide], self.P[wide]
        values, axes = np.linalg.eigh(P[:, :2, :2])
        value, axis = values[:, 1], axes[:, :, 1]
        g = (P[:, :, :2] @ axis[:, :, None])[:, :, 0] / np.sqrt(value)[:, None]
        narrow = P - (1.0 - THREE_VARIANCE) * g[:, :, None] * g[:, None, :]
        parts_x = [self.x[~wide]] + [x + shift * g for shift in THREE]
        self.w = np.concatenate([self.w[~wide]] + [w * share for share in THREE_WEIGHT])
        self.x = np.concatenate(parts_x)
        self.P = np.concatenate([self.P[~wide]] + [narrow] * 3)

    def _merge(self) -> None:
        """Make one of those that have come to the same cell of the position, of the same mean and covariance."""
        cell = np.floor(self.x[:, :2] / (CELL * self.resolution))
        group = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
        n = int(group.max()) + 1
        if n == len(self):
            return
        w = np.zeros(n)
        np.add.at(w, group, self.w)
        share = (self.w / w[group])[:, None]
        x = np.zeros((n, self.x.shape[1]))
        np.add.at(x, group, share * self.x)
        d = self.x - x[group]
        P = np.zeros((n, *self.P.shape[1:]))
        np.add.at(P, group, share[:, :, None] * (self.P + d[:, :, None] * d[:, None, :]))
        self.w, self.x, self.P = w, x, P


def widest(P: Array) -> float:
    """Return the largest 1-sigma of the position, m."""
    (a, b), (_, c) = P[:2, :2].tolist()
    return sqrt(0.5 * (a + c) + hypot(0.5 * (a - c), b))


def _moments(w: Array, x: Array, P: Array) -> tuple[Array, Array]:
    w = w / w.sum()
    mean = w @ x
    d = x - mean
    covariance: Array = np.einsum("k,kij->ij", w, P) + np.einsum("k,ki,kj->ij", w, d, d)
    return mean, covariance
