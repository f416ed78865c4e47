r"""The likelihood of a track in an unmapped field: how well it agrees with itself.

With drift d(t), a field f in place and the calibration's error b,

.. math:: y_i = f(x_i + d(t_i)) + b(t_i) + e_i, \quad
          \log p(y | d) = -\tfrac12 y^T K^{-1} y - \tfrac12 \log|K| + \text{const},

.. math:: K_{ij} = s^2 k(|x_i + d_i - x_j - d_j| / \ell) + \beta_{ij} + R_{ij}

f is integrated out: a Gaussian field (Rasmussen & Williams 2006, eq. 2.30; gradient eq. 5.9) of size s and
length l. Its covariance k is one of :data:`COVARIANCE_KINDS`, from rough to smooth.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from magbridge.arrays import FloatArray
from magbridge.navigate.model import Block, transition
from magbridge.navigate.options import Options

__all__ = ["COVARIANCE_KINDS", "OwnField", "drift_functions"]

COVARIANCE_KINDS = ("exponential, once smooth", "exponential, twice smooth", "Gaussian")
"""Matern's covariances of smoothness 3/2 and 5/2, and the limit of both (Rasmussen & Williams, eq. 4.17)."""
SIZE, SIZE_SPREAD = 50.0, np.log(4.0)
"""nT of the crustal field, and the 1-sigma of its logarithm: sea floor and land by airborne surveys."""
LENGTH_SPREAD, NOISE_SPREAD = np.log(6.0), np.log(1.3)
"""1-sigma of the logarithm of the length, and of the noise over what the calibration claims."""
STEPS, SHARE = 4.0, 2.5
"""The shortest length expected, over the distance of neighbours; the longest, over the track's extent."""
LEVEL_SCATTERS = 10.0
"""The level's 1-sigma, over the scatter of the measured field: it is not known."""
KNOTS, WAVES, LEFT_OUT = 240, 48, 1e-4
"""Times at which a drift's covariance is taken, its functions at most, and the share they may leave out."""
FARTHEST = 8.0
"""Sigmas of its prior beyond which no size, length or noise is tried."""
IMPOSSIBLE_LOG_LIKELIHOOD = -1e300
"""Log likelihood of an impossible track."""


def drift_functions(time: FloatArray, options: Options) -> FloatArray:
    """Return functions (n, r), m, whose sum with weights N(0, 1) is the error of dead reckoning on one axis.

    `time` (n,) is in s. They are Karhunen-Loeve's: eigenvectors of the covariance that the state of
    :mod:`.model` has, scaled by the root of their eigenvalues.
    """
    knots = np.linspace(time[0], max(time[-1], time[0] + 1.0), min(KNOTS, max(len(time), 2)))
    F, Q = (one[np.ix_((0, 2), (0, 2))] for one in transition(options, knots[1] - knots[0], 0.0))
    P = np.diag([options.start_sigma, options.current_sigma]) ** 2
    C = np.zeros((len(knots), len(knots)))
    for k in range(len(knots)):
        later = P.copy()
        for j in range(k, len(knots)):
            C[j, k] = C[k, j] = later[0, 0]
            later = F @ later
        P = F @ P @ F.T + Q
    values, vectors = np.linalg.eigh(C)
    order = np.argsort(values)[::-1][:WAVES]
    kept = order[values[order] > LEFT_OUT * values.max()]
    functions = vectors[:, kept] * np.sqrt(values[kept])
    return np.stack([np.interp(time, knots, one) for one in functions.T], axis=1)


class OwnField:
    """Blocks along a dead-reckoned track, and the likelihood of what they measured.

    Unknown is u (q,), N(0, 1) each beforehand: the weights of the drift's functions north (r,) and east (r,),
    and the logarithms of the field's size, its length and the noise over their spread.

    Parameters
    ----------
    blocks : list of Block
    place : (n, 2) array
        m, north and east, where dead reckoning has them.
    options : Options
        How well start, current and calibration are known.

    Attributes
    ----------
    time : (n,) array
        s.
    drift : (n, r) array
        m, :func:`drift_functions`.
    q : int
        Number of unknowns.
    """

    def __init__(self, blocks: list[Block], place: FloatArray, options: Options) -> None:
        rows = np.array(blocks)
        self.time, self.place = rows[:, 0] * 1e-6, place
        self.anomaly, self.variance, self.slope = rows[:, 3], rows[:, 4], rows[:, 5:7]
        self.drift = drift_functions(self.time, options)
        self.r = self.drift.shape[1]
        self.q = 2 * self.r + 3
        self.mean = float(np.median(self.anomaly))
        step = float(np.median(np.linalg.norm(np.diff(place, axis=0), axis=1)))
        extent = float(np.hypot(*np.ptp(place, axis=0)))
        self.shortest = STEPS * max(step, 1.0)
        self._middle = float(np.sqrt(self.shortest * max(extent / SHARE, 1.5 * self.shortest)))
        apart = np.abs(self.time[:, None] - self.time) / options.bias_time
        self._other = (
            options.bias_sigma**2 * np.exp(-apart) + (LEVEL_SCATTERS * float(self.anomaly.std())) ** 2
        )

    def moved(self, u: FloatArray) -> FloatArray:
        """Return the error of dead reckoning (n, 2), m, of u (q,); (k, n, 2) of several, (k, q)."""
        by = np.stack([u[..., : self.r], u[..., self.r : 2 * self.r]], axis=-1)
        return np.asarray(self.drift @ by)

    def scales(self, u: FloatArray) -> FloatArray:
        """Return the field's size, nT, its length, m, and the noise over the claimed one: (3,) or (k, 3)."""
        at_zero = np.array([SIZE, self._middle, 1.0])
        return np.asarray(at_zero * np.exp(u[..., -3:] * (SIZE_SPREAD, LENGTH_SPREAD, NOISE_SPREAD)))

    def log_likelihood(self, u: FloatArray, kind: int, count: int) -> tuple[float, FloatArray]:
        """Return log p of the first `count` blocks, up to a constant, and its gradient by u (q,)."""
        gradient = np.zeros(self.q)
        if np.abs(u[-3:]).max() > FARTHEST:
            return IMPOSSIBLE_LOG_LIKELIHOOD, gradient
        n = slice(0, count)
        size, length, noise = self.scales(u)
        d, W = self.moved(u)[n], self.drift[n]
        x, y = self.place[n] + d, self.anomaly[n] - self.mean - (self.slope[n] * d).sum(axis=1)
        squared, k, h, K, R = self._covariance(x, kind, size, length, noise)
        L, info = dpotrf(K.T, lower=1)
        if info:
            return IMPOSSIBLE_LOG_LIKELIHOOD, gradient
        alpha = dpotrs(L, y, lower=1)[0]
        value = -0.5 * float(y @ alpha) - float(np.log(L.diagonal()).sum())
        inverse = np.tril(dpotri(L, lower=1)[0])
        G = np.outer(alpha, alpha) - inverse - np.tril(inverse, -1).T  # twice the slope by K
        Gh = G * h
        steep = (size / length) ** 2
        by_place = steep * (Gh.sum(axis=1)[:, None] * x - Gh @ x) + self.slope[n] * alpha[:, None]
        gradient[: 2 * self.r] = (W.T @ by_place).T.ravel()
        gradient[-3] = size * size * float((G * k).sum()) * SIZE_SPREAD
        gradient[-2] = -0.5 * steep * float((Gh * squared).sum()) * LENGTH_SPREAD
        gradient[-1] = float(G.diagonal() @ R) * NOISE_SPREAD
        return value, gradient

    def covariance(self, place: FloatArray, u: FloatArray, kind: int) -> tuple[FloatArray, FloatArray]:
        """Return K (n, n), nT², with the blocks at places (n, 2), m, and its part R (n,) that is noise."""
        _, _, _, K, R = self._covariance(place, kind, *self.scales(u))
        return K, R

    def slopes(self, place: FloatArray, u: FloatArray, kind: int) -> FloatArray:
        """Return the slopes (n, 2), nT/m, of the field that the blocks show if they are at places (n, 2), m.

        Notes
        -----
        The mean, ``∂k(x_i, x) K^-1 y`` (Rasmussen & Williams 2006, eq. 2.25 and section 9.4).
        """
        size, length, noise = self.scales(u)
        _, _, h, K, _ = self._covariance(place, kind, size, length, noise)
        y = self.anomaly - self.mean - (self.slope * (place - self.place)).sum(axis=1)
        weight = (size / length) ** 2 * h * np.linalg.solve(K, y)
        return np.asarray(weight.sum(axis=1)[:, None] * place - weight @ place)

    def _covariance(
        self, x: FloatArray, kind: int, size: float, length: float, noise: float
    ) -> tuple[FloatArray, ...]:
        """Return ``|x_i - x_j|²``, k and h (n, n) of it, K (n, n), and R (n,)."""
        squared = (x[:, None, 0] - x[:, 0]) ** 2 + (x[:, None, 1] - x[:, 1]) ** 2
        k, h = _kind(np.sqrt(squared) / length, kind)
        K = size * size * k + self._other[: len(x), : len(x)]
        R = self.variance[: len(x)] * noise**2
        K.flat[:: len(x) + 1] += R
        return squared, k, h, K, R


def _kind(a: FloatArray, kind: int) -> tuple[FloatArray, FloatArray]:
    """Return covariances of unit variance at distances a over the length, and h = k'(a)/a."""
    if kind == 2:
        k = np.exp(-0.5 * a * a)
        return k, -k
    a = np.sqrt(2.0 * kind + 3.0) * a
    falling = np.exp(-a)
    if kind == 0:
        return (1.0 + a) * falling, -3.0 * falling
    return (1.0 + a + a * a / 3.0) * falling, -(5.0 / 3.0) * (1.0 + a) * falling
