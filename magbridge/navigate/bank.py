"""Bank of extended Kalman filters, for a position whose uncertainty is too large for one filter.

If a Gaussian is too wide for the map to be linear within it, the bank splits it into many narrow ones, the
hypotheses. A Kalman filter updates each of them, and its likelihood weights it (Alspach & Sorenson 1972).
The bank splits hypotheses that grow too wide, drops those of negligible weight, and merges those at the same
place. It draws no random numbers, so that the same samples give the same bits. A bank of infinite resolution
is one extended Kalman filter of second order.
"""

from __future__ import annotations

from math import inf, isinf, log, nan, pi
from typing import NamedTuple

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.field.geodesy import metres_per_degree, offset, worse_axis
from magbridge.field.grid import AnomalyGrid, Local, curvature
from magbridge.navigate.model import N_STATES, Block

__all__ = ["Bank", "Innovation", "widest"]

MAX_HYPOTHESES = 6_000
"""Largest number of hypotheses."""
MAX_INITIAL_HYPOTHESES = 20_000
"""Largest number of hypotheses before the first measurement."""
MERGE_FRACTION = 0.8
"""Side of a cell over the resolution; hypotheses whose positions share a cell are merged."""
LATTICE_SPACING_SIGMA = 1.2
"""Spacing of neighbouring hypotheses, in their own sigmas: a sum of equal Gaussians is then flat to 1 %."""
LATTICE_EXTENT_SIGMA = 3.5
"""Extent of the first lattice of hypotheses, in sigmas of the Gaussian."""
MIN_WEIGHT_FRACTION = 1e-7
"""Smallest weight of a hypothesis, as a fraction of the largest one; a smaller one is dropped."""
COARSENING_FACTOR = 1.25
"""Factor of one change of the resolution."""
MERGE_INTERVAL = 4
"""Updates from one merging of hypotheses to the next."""
# One Gaussian as three narrower ones (DeMars et al. 2013, table 1); their sum keeps the original variance.
SPLIT_MEANS = np.array([-1.0575154615, 0.0, 1.0575154615])
SPLIT_WEIGHTS = np.array([0.2252246249, 0.5495507502, 0.2252246249])
SPLIT_VARIANCE = 1.0 - float(SPLIT_WEIGHTS @ SPLIT_MEANS**2)


class Innovation(NamedTuple):
    """Innovation of a measurement; off the map it is not used, and value, variance and anomaly are NaN."""

    value: float
    variance: float
    """`value`, `variance`: measured minus expected value, nT (m for a fix), and its variance."""
    log_likelihood: float
    accepted: bool
    """True if the innovation lies within the gate."""
    anomaly: float = nan
    """Anomaly of the map at the likeliest hypothesis, nT."""


class Bank:
    """Gaussian mixture on the six states, each component (hypothesis) linearised about its own mean.

    The hypothesis is the last axis of every array: weights ``w`` (n,), states ``x`` (6, n) and covariances
    ``P`` (6, 6, n). Each operation then runs along memory, three times as fast as on n small matrices.

    The bank begins with the Gaussian `x` (6,), `P` (6, 6), and splits it into hypotheses with a position
    sigma of `resolution` m; if that is infinite, there is one hypothesis. A hypothesis is not updated if the
    squared innovation over its variance exceeds `gate`. If `level` (nT) exceeds the bias's 1-sigma in P, half
    of the weight goes to copies of the hypotheses whose bias has this 1-sigma.
    """

    def __init__(
        self,
        grid: AnomalyGrid,
        x: FloatArray,
        P: FloatArray,
        resolution: float,
        gate: float,
        level: float = 0.0,
    ) -> None:
        self._grid, self._gate = grid, gate
        self._off_map = grid.mean_and_variance
        self._updates = 0
        self.resolution = self.finest = resolution
        self.curvature_variance = 0.0
        """Variance that the map's curvature within the hypotheses added to the last measurement, nT²."""
        self.w, self.x, self.P = self._lattice(x, P)
        if level**2 > P[4, 4]:
            free = P.copy()
            free[4], free[:, 4], free[4, 4] = 0.0, 0.0, level**2
            both = zip((self.w, self.x, self.P), self._lattice(x, free), strict=True)
            self.w, self.x, self.P = (np.concatenate(pair, axis=-1) for pair in both)
            self.w /= 2.0

    def __len__(self) -> int:
        return self.w.size

    @property
    def is_single(self) -> bool:
        """True if the bank is one filter, which is never split."""
        return isinf(self.finest)

    def _lattice(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Split one Gaussian into a lattice of Gaussians as narrow as the resolution; return w, x and P.

        Notes
        -----
        ``N(x, P) = ∫ N(x + g s, P - g g' (σ² - σ_k²)) N(s; 0, σ² - σ_k²) ds`` along an axis e of
        the position, with σ² its variance and ``g = P e / σ²``: states that are correlated with the
        position shift with it.
        """
        # Principal axes of the position. Limit the number of lattice points, by area, before they are made.
        values, axes = np.linalg.eigh(P[:2, :2])
        spread = np.sqrt(np.prod(np.maximum(values, self.resolution**2)))
        area = (2.0 * LATTICE_EXTENT_SIGMA / LATTICE_SPACING_SIGMA) ** 2 * np.pi / 4.0 * spread
        self.resolution = max(self.resolution, float(np.sqrt(area / MAX_INITIAL_HYPOTHESES)))
        part, w, shifts = P.copy(), np.ones(1), np.zeros((x.size, 1))
        for value, axis in zip(values, axes.T, strict=True):
            # Along this axis the variance is that of the lattice (`left`) plus that of each hypothesis.
            left = value - self.resolution**2
            if left <= 0.0:
                continue
            width = 2.0 * LATTICE_EXTENT_SIGMA * np.sqrt(left)
            n = max(3, int(np.ceil(width / (LATTICE_SPACING_SIGMA * self.resolution))))
            s = np.linspace(-LATTICE_EXTENT_SIGMA, LATTICE_EXTENT_SIGMA, n)
            # States that are correlated with the position shift by g for each metre along the axis.
            g = P[:, :2] @ axis / value
            w = np.outer(w, np.exp(-0.5 * s * s)).ravel()
            shifts = (shifts[:, :, None] + np.outer(g, s * np.sqrt(left))[:, None, :]).reshape(x.size, -1)
            part -= np.outer(g, g) * left
        # The corners of the lattice lie beyond its extent in sigmas.
        keep = w > np.exp(-0.5 * LATTICE_EXTENT_SIGMA**2)
        w, shifts = w[keep], shifts[:, keep]
        return w / w.sum(), x[:, None] + shifts, np.repeat(part[:, :, None], w.size, axis=2)

    def predict(self, F: FloatArray, Q: FloatArray) -> None:
        """Propagate every hypothesis by one transition: F and the noise's covariance Q, (6, 6)."""
        # x' = F x and P' = F P F' + Q for all hypotheses: F P first, with (6, 6 n) as one matrix product.
        self.x = F @ self.x
        half = (F @ self.P.reshape(N_STATES, -1)).reshape(self.P.shape)
        self.P = F @ half + Q[:, :, None]

    def update(self, block: Block) -> Innovation:
        """Update with one measurement of the field and return its innovation.

        A hypothesis off the map predicts the map's mean with the map's variance; its state is not updated.

        Notes
        -----
        ``h = a(p) + ∇F·δ + b + e m`` and ``R = r + map variance``, both with the contribution of the map's
        curvature (:func:`~magbridge.field.grid.curvature`); e as in
        :meth:`~magbridge.field.grid.AnomalyGrid.error`.
        """
        # 1. Map and its slopes at each hypothesis; off the map, zeros stand in for NaN.
        north, east = self.x[:2]
        per_latitude, per_longitude = metres_per_degree(block.latitude)
        local = self._grid.evaluate(
            block.longitude + east / per_longitude, block.latitude + north / per_latitude, block.depth
        )
        off = np.isnan(local.anomaly)
        if off.all() and self.is_single:
            return Innovation(nan, nan, 0.0, accepted=False)
        seen = local.anomaly
        local = Local(*np.where(off, 0.0, local))
        # 2. Second-order filter: the curvature within a hypothesis shifts the expected value by `bent` and
        # adds the variance `spread`.
        bent, spread = curvature(local, self.P[0, 0], self.P[0, 1], self.P[1, 1])
        self.curvature_variance = float(self.w @ spread)
        anomaly = local.anomaly + (block.slope_north * north + block.slope_east * east + bent)
        errors, independent = self._grid.error(local.variance)
        v = independent + block.variance + spread
        slopes = np.where(off, 0.0, (local.north + block.slope_north, local.east + block.slope_east))
        gain = slopes[0] * self.P[0] + slopes[1] * self.P[1] + self.P[4] + errors * self.P[5]
        s = slopes[0] * gain[0] + slopes[1] * gain[1] + gain[4] + errors * gain[5]
        # 3. Off the map the field is that of the whole map: its mean, with its variance.
        anomaly[off], v[off] = self._off_map[0], block.variance + self._off_map[1]
        y = block.anomaly - anomaly - self.x[4] - errors * self.x[5]
        innovation = self._observe(y, gain, s + v, off, self._gate)
        return innovation._replace(
            anomaly=float(seen[0]) if self.is_single else self._map_at_likeliest(block)
        )

    def _map_at_likeliest(self, block: Block) -> float:
        """Return the map's anomaly, nT, at the likeliest hypothesis; NaN off the map."""
        north, east = self.x[:2, int(self.w.argmax())].tolist()
        latitude, longitude = offset(block.latitude, block.longitude, north, east)
        return self._grid.look_up(longitude, latitude, block.depth).anomaly

    def update_position(self, north: float, east: float, sigma: float) -> None:
        """Update with a fix, m north and east of the dead-reckoned position; `sigma` is for each axis."""
        # One filter uses every fix, because the caller has tested the fix.
        gate = inf if self.is_single else self._gate
        for axis, value in enumerate((north, east)):
            gain, used = self.P[axis], np.zeros(len(self), dtype=bool)
            self._observe(value - self.x[axis], gain, gain[axis] + sigma * sigma, used, gate)

    def _observe(
        self, y: FloatArray, gain: FloatArray, s: FloatArray, rejected: BoolArray, gate: float
    ) -> Innovation:
        """Update every hypothesis with innovations `y` (n,), their variances `s` (n,), and ``P H'`` (6, n).

        `rejected` (n,) marks hypotheses whose state must not change. Return the mixture's innovation.
        """
        # Log-likelihood of each innovation. The gate limits it, so that one outlier cannot decide.
        z2 = y * y / s
        likelihood = -0.5 * (np.minimum(z2, self._gate) + np.log(s) + log(2.0 * pi))
        # Mean and variance of the mixture's innovation.
        mean = float(self.w @ y)
        spread = float(self.w @ (s + (y - mean) ** 2))
        # Kalman update, K = P H' / s; a rejected measurement has the gain zero.
        gain = np.where((z2 <= gate) & ~rejected, gain, 0.0)
        scaled = gain / s
        self.x = self.x + scaled * y
        self.P = self.P - gain[:, None] * scaled
        # Bayes: weights times likelihoods, scaled by the largest one against underflow.
        top = float(likelihood.max())
        w = self.w * np.exp(likelihood - top)
        total = float(w.sum())
        self.w = w / total
        self._updates += 1
        self._limit_hypotheses()
        accepted = mean * mean <= self._gate * spread
        return Innovation(mean, spread, top + log(total), accepted)

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Return mean (6,) and covariance (6, 6) of the whole mixture."""
        # Law of total variance: mean of the covariances plus covariance of the means.
        mean: FloatArray = self.x @ self.w / self.w.sum()
        d = self.x - mean[:, None]
        covariance: FloatArray = (self.P @ self.w + (self.w * d) @ d.T) / self.w.sum()
        return mean, covariance

    def _limit_hypotheses(self) -> None:
        """Drop hypotheses of negligible weight, split wide ones, and regularly merge those at one place."""
        keep = self.w > MIN_WEIGHT_FRACTION * self.w.max()
        if not keep.all():
            w = self.w[keep]
            self.w, self.x, self.P = w / w.sum(), self.x[:, keep], self.P[:, :, keep]
        while len(self) > MAX_HYPOTHESES:  # coarsen: dropping a hypothesis could lose the true place
            self.resolution *= COARSENING_FACTOR
            self._merge()
        # With few hypotheses the resolution becomes finer again, in the same steps.
        if self.resolution > self.finest and len(self) < MAX_HYPOTHESES / 4:
            self.resolution = max(self.finest, self.resolution / COARSENING_FACTOR)
        if self._updates % MERGE_INTERVAL == 0 and len(self) > 1:
            self._merge()
        # A hypothesis that grew too wide for the map to be linear in it is split; one without weight is not.
        width = worse_axis(self.P[0, 0], self.P[0, 1], self.P[1, 1])
        wide = (width > 1.5 * self.resolution) & (self.w > 1e-4)
        if wide.any() and len(self) + 2 * int(wide.sum()) <= 2 * MAX_HYPOTHESES:
            self._split(wide)

    def _split(self, wide: BoolArray) -> None:
        """Split each `wide` hypothesis in three along its longest position axis; keep mean and covariance."""
        w, x, P = self.w[wide], self.x[:, wide], self.P[:, :, wide]
        values, axes = np.linalg.eigh(np.moveaxis(P[:2, :2], 2, 0))
        axis = axes[:, :, 1].T
        g = (P[:, 0] * axis[0] + P[:, 1] * axis[1]) / np.sqrt(values[:, 1])
        # Three components along the longest axis; their means and variances sum to the original's.
        narrow = P - (1.0 - SPLIT_VARIANCE) * g[:, None] * g
        self.w = np.concatenate([self.w[~wide]] + [w * share for share in SPLIT_WEIGHTS])
        self.x = np.concatenate([self.x[:, ~wide]] + [x + shift * g for shift in SPLIT_MEANS], axis=1)
        self.P = np.concatenate([self.P[:, :, ~wide]] + [narrow] * 3, axis=2)

    def _merge(self) -> None:
        """Merge hypotheses whose positions lie in the same cell; keep mean and covariance."""
        # Sort by cell, then sum over runs of equal cells: moments of each cell's mixture.
        cell = np.floor(self.x[:2] / (MERGE_FRACTION * self.resolution)).astype(np.int64)
        order = np.lexsort(cell)
        cell = cell[:, order]
        first = np.flatnonzero(np.append(True, (np.diff(cell) != 0).any(axis=0)))
        if first.size == len(self):
            return
        sizes = np.diff(np.append(first, len(self)))
        w = np.add.reduceat(self.w[order], first)
        share = self.w[order] / np.repeat(w, sizes)
        x = np.add.reduceat(share * self.x[:, order], first, axis=1)
        d = self.x[:, order] - np.repeat(x, sizes, axis=1)
        P = np.add.reduceat(share * (self.P[:, :, order] + d[:, None] * d), first, axis=2)
        self.w, self.x, self.P = w, x, P


def widest(P: FloatArray) -> float:
    """Return the position's 1-sigma, m, along its longest axis, from a covariance `P` (6, 6)."""
    (nn, ne), (_, ee) = P[:2, :2].tolist()
    return float(worse_axis(nn, ne, ee))
