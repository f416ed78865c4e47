r"""Model, remove and estimate the noise of residuals: standard deviation, autocorrelation and outliers.

Noise is the sum of a slow part, a first-order autoregressive process AR(1) of autocorrelation :math:`\rho`
at one sampling interval, and a white part with the fraction f of the variance. :class:`NoiseModel` holds
these numbers, :class:`Whitening` removes the correlation, and :func:`estimate_noise` and
:func:`fit_slow_and_white` estimate the noise from the residuals of a fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtbtrs
from scipy.optimize import minimize

from magbridge.arrays import BoolArray, FloatArray
from magbridge.estimation.residual import robust_scale

__all__ = [
    "CLIP_SIGMA", "OUTLIER_SIGMA", "NoiseModel", "Whitening", "effective_fraction", "estimate_noise",
    "fit_slow_and_white", "samples_per_independent", "whiten",
]  # fmt: skip

OUTLIER_SIGMA = 5.0
"""Robust standard deviations beyond which a residual is an outlier; Gaussian noise exceeds them once in 1.7
million samples."""
CLIP_SIGMA = 3.0
"""Robust standard deviations at which residuals are clipped before the autocorrelation is estimated."""
SHORT_MEMORY = 0.2
"""Smallest autocorrelation of the slow part with which its search begins."""
MIN_CORRELATION_TIMES = 30.0
"""Number of its correlation times that the samples must cover, so that the variance of a slow part is known
within a quarter. Longer errors are rather errors of the coefficients."""
MIN_LOG_LIKELIHOOD_GAIN = 5.0
"""Gain in log likelihood that a white part must bring over an AR(1) process alone."""
MAX_AUTOCORRELATION = 0.99
"""Largest autocorrelation that :func:`estimate_noise` returns."""
MIN_PAIRS = 30
"""Fewest pairs of successive samples from which their autocorrelation is estimated, and fewest samples with a
variance of their own."""
WINDOW_TIMES = 5.0
"""Integrated autocorrelation times up to which :func:`samples_per_independent` sums."""
STEADY_STATE_TOLERANCE = 1e-13
"""Relative change of the filter's variance below which it counts as steady."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of residuals: standard deviation, autocorrelation, white fraction and outliers."""

    sigma: float
    """Standard deviation of a sample, nT in sensor axes."""
    autocorrelation: float = 0.0
    """Autocorrelation of the slow part at one sampling interval (rho of the AR(1) process)."""
    white: float = 0.0
    """Fraction of the variance that is white."""
    weight: FloatArray | None = None
    """(n,): 1 for a sample that counts, 0 for an outlier; between 0 and 1 the ratio of this sigma squared to
    the sample's own variance. None if all samples count."""

    @property
    def shape(self) -> tuple[float, float]:
        """Autocorrelation of the slow part, and fraction of the variance that is white."""
        return self.autocorrelation, self.white

    def root_weights(self, n: int) -> FloatArray:
        """Return the sigma of most samples divided by each sample's own sigma, (n,); 1 for an outlier."""
        weight = np.ones(n) if self.weight is None else self.weight
        return np.sqrt(np.where(weight > 0.0, weight, 1.0))

    @property
    def rejected(self) -> int:
        """Number of outliers."""
        return 0 if self.weight is None else int((self.weight == 0.0).sum())


class Whitening:
    """Whitening of noise of unit variance, applied to successive blocks of rows.

    Parameters
    ----------
    steps : (n,) array
        Sampling intervals since the previous sample; infinite at the first of a run.
    rho : float
        Autocorrelation of the slow part at one sampling interval.
    white : float
        Fraction of the variance that is white.

    Attributes
    ----------
    variance : (n,) array
        Variance of each innovation; the determinant of the covariance is their product.

    Notes
    -----
    A Kalman filter estimates the slow part, of variance ``1 - f``, in white noise of variance f. It predicts
    m and has innovations v (Harvey 1989, Forecasting, structural time series models, section 3.2)::

        v_t = y_t - m_t,   S_t = P_t + f,   K_t = P_t / S_t
        m_t+1 = r (m_t + K_t v_t),   P_t+1 = r^2 (1 - K_t) P_t + (1 - f)(1 - r^2),   r = rho^steps

    ``v / sqrt(S)`` is white, of unit variance. With f = 0 it is ``(y_t - r y_t-1) / sqrt(1 - r^2)``.
    """

    def __init__(self, steps: FloatArray, rho: float, white: float = 0.0) -> None:
        self.decay = np.full(len(steps), rho)
        irregular = np.flatnonzero(steps != 1)
        self.decay[irregular] = rho ** steps[irregular]
        self.variance, self._gain = _innovations(self.decay, white)
        self._row = 0
        self._slow: FloatArray | None = None  # the filtered slow part at the row before

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next k rows (k, ...), which follow the rows of the previous call, whitened."""
        rows = slice(self._row, self._row + len(values))
        y = values.reshape(len(values), -1)
        r, K, S = self.decay[rows, None], self._gain[rows, None], self.variance[rows, None]
        before = np.zeros(y.shape[1]) if self._slow is None else self._slow
        # m_t + K_t v_t = (1 - K_t) m_t + K_t y_t: a bidiagonal system in the filtered slow part
        filtered = y
        if (K != 1.0).any():
            filtered = K * y
            filtered[0] += (1.0 - K[0]) * r[0] * before
            band = np.ones((2, len(y)))
            band[1, :-1] = -((1.0 - K) * r)[1:, 0]
            filtered, _ = dtbtrs(band, filtered, uplo="L", diag="U")
        # innovations, computed in place: allocation costs more than the arithmetic
        v = np.empty_like(y)
        v[0] = r[0] * before
        np.multiply(r[1:], filtered[:-1], out=v[1:])
        np.subtract(y, v, out=v)
        v /= np.sqrt(S)
        self._row, self._slow = rows.stop, filtered[-1].copy()
        return v.reshape(values.shape)


def _innovations(decay: FloatArray, white: float) -> tuple[FloatArray, FloatArray]:
    """Return variance S and gain K (n,) of the filter of :class:`Whitening`, for each row's decay r (n,)."""
    if white == 0.0:
        return 1.0 - decay**2, np.ones(len(decay))
    variance = np.empty(len(decay))
    slow, after, last = 1.0 - white, 0.0, -1.0
    # within a stretch of equal intervals the filter approaches its steady state
    ends = np.flatnonzero(np.diff(decay, append=-1.0))
    start = 0
    for end in ends.tolist():
        for t in range(start, end + 1):
            ahead = decay[t] ** 2 * after + slow * (1.0 - decay[t] ** 2)
            variance[t] = ahead + white
            after = ahead * white / variance[t]
            if abs(after - last) < STEADY_STATE_TOLERANCE * slow:
                variance[t : end + 1] = variance[t]
                break
            last = after
        start, last = end + 1, -1.0
    return variance, 1.0 - white / variance


def whiten(values: FloatArray, steps: FloatArray, rho: float, white: float = 0.0) -> FloatArray:
    """Return the values (n, ...) whitened, also across gaps; arguments as for :class:`Whitening`."""
    return Whitening(steps, rho, white).apply(values)


def effective_fraction(rho: float, white: float = 0.0) -> float:
    """Return the number of independent samples in a mean, divided by the number of samples.

    Notes
    -----
    ``1 / (f + (1 - f)(1 + rho) / (1 - rho))``: Kay 1993, Fundamentals of statistical signal processing, 6.
    """
    return (1.0 - rho) / (white * (1.0 - rho) + (1.0 - white) * (1.0 + rho))


def samples_per_independent(values: FloatArray, steps: FloatArray) -> float:
    """Return the number of correlated samples that count as one independent sample, at least 1.

    `values` (n, q): contribution of each sample to the gradient by q coefficients, in comparable units:
    residual times row of the Jacobian. `steps` (n,): sampling intervals since the previous sample; infinite
    at the first of a run.

    Notes
    -----
    The integrated autocorrelation ``1 + 2 sum rho(l)``, summed up to the first lag that is
    :data:`WINDOW_TIMES` times as long as the sum so far (Sokal 1997, Monte Carlo methods in statistical
    mechanics, section 3). The error of a model lasts as long as a manoeuvre. So the sum corresponds to a
    time that does not depend on the sampling rate, unlike the autocorrelation of neighbours.
    """
    # Samples of two runs have no lag: the longest run limits the lags, and memory is linear in the samples.
    within = np.isfinite(steps)
    starts = np.union1d([0], np.flatnonzero(~within))
    span = np.add.reduceat(np.where(within, steps, 0.0), starts).max()
    longest = int(max(min(len(values) // 4, span + 1), 1))
    # place the samples on their intervals; the gap between runs exceeds the longest lag
    gaps = np.minimum(np.where(within, steps, longest), longest)
    slot = (np.cumsum(gaps) - gaps[0]).astype(int)
    size = 2 ** int(np.ceil(np.log2(slot[-1] + 1 + longest)))
    grid = np.zeros((size, values.shape[1]))
    grid[slot] = values
    power = (np.abs(np.fft.rfft(grid, axis=0)) ** 2).sum(axis=1)
    products = np.fft.irfft(power, size)[:longest]
    total = 2.0 * np.cumsum(products / (products[0] or 1.0)) - 1.0
    window = np.flatnonzero(np.arange(longest) >= WINDOW_TIMES * 0.5 * total)
    return max(float(total[window[0] if window.size else -1]), 1.0)


def estimate_noise(
    e: FloatArray,
    steps: FloatArray,
    free: float,
    shape: tuple[float, float] | None = None,
    moving: BoolArray | None = None,
) -> NoiseModel:
    """Estimate the noise model from the residuals of a fit.

    Parameters
    ----------
    e : (n,) array
        Residuals, nT.
    steps : (n,) array
        Sampling intervals since the previous sample.
    free : float
        Number of parameters that the data determined.
    shape : tuple of 2 float, optional
        Autocorrelation and white fraction, if they are known: see :func:`fit_slow_and_white`.
    moving : (n,) array, optional
        True for samples that may have a larger error, with a variance of their own.
    """
    if shape is None:
        shape = (_autocorrelation(_clipped(e), steps == 1), 0.0)
    white = whiten(e, steps, *shape)
    weight = _variance_ratio(white, moving)
    weight *= np.abs(white) * np.sqrt(weight) <= OUTLIER_SIGMA * _scale(white * np.sqrt(weight))
    kept = np.count_nonzero(weight)
    sigma = float(np.sqrt((weight * white * white).sum() / max(kept - free, 1.0)))
    return NoiseModel(sigma or 1e-9, *shape, None if weight.all() else weight)


def fit_slow_and_white(
    e: FloatArray, steps: FloatArray, noise: NoiseModel, free: float, moving: BoolArray | None = None
) -> NoiseModel:
    """Return the noise as a slow and a white part, if that is likelier than the given AR(1) process.

    The correlation time of noise is a property of the sensor. At a high sampling rate, the slow part of
    neighbours is nearly equal. An AR(1) process alone then underestimates the slow or the white part. A small
    slow part in white noise of many samples hardly shows in neighbours, but it limits the mean.

    `e` (n,): Residuals, nT. `steps` (n,): sampling intervals since the previous sample. `noise`: the result
    of :func:`estimate_noise`. `free`: number of parameters that the data determined. `moving`: samples with
    a variance of their own, (n,).
    """
    clipped, rho = _clipped(e * np.sqrt(_variance_ratio(e, moving))), noise.autocorrelation
    # the variance of a slow part is known only from many of its correlation times
    longest = max(np.isfinite(steps).sum() / MIN_CORRELATION_TIMES, 2.0)

    def negative_log_likelihood(rho: float, white: float) -> float:
        # sigma is profiled out: n/2 log(v^T v) + 1/2 sum log S
        whitening = Whitening(steps, rho, white)
        v = whitening.apply(clipped)
        return float(0.5 * len(e) * np.log(v @ v) + 0.5 * np.log(whitening.variance).sum())

    def shape(x: FloatArray) -> tuple[float, float]:
        # x: logarithm of the correlation time in samples, logit of the white fraction
        return float(np.exp(-np.exp(-x[0]))), float(1.0 / (1.0 + np.exp(-x[1])))

    bounds = [(np.log(1.0), np.log(longest)), (-12.0, 6.0)]
    starts = ((min(-1.0 / np.log(max(rho, SHORT_MEMORY)), longest), 0.05), (0.7 * longest, 0.3))
    answers = [
        minimize(
            lambda x: negative_log_likelihood(*shape(x)), np.log(start), method="L-BFGS-B", bounds=bounds
        )
        for start in starts
    ]
    best = min(answers, key=lambda answer: answer.fun)
    if best.fun > negative_log_likelihood(rho, 0.0) - MIN_LOG_LIKELIHOOD_GAIN:
        return noise
    # The standard deviation and the outliers belong to the same model.
    return estimate_noise(e, steps, free, shape(best.x), moving)


def _variance_ratio(e: FloatArray, moving: BoolArray | None) -> FloatArray:
    """Return the variance of the other residuals divided by each residual's own variance, (n,), at most 1."""
    ratio = np.ones(len(e))
    if moving is not None and moving.sum() >= MIN_PAIRS:
        ratio[moving] = min(_scale(e[~moving]) / _scale(e[moving]), 1.0) ** 2
    return ratio


def _clipped(e: FloatArray) -> FloatArray:
    """Return the residuals (n,) clipped at :data:`CLIP_SIGMA` robust standard deviations."""
    scale = _scale(e)
    return np.asarray(np.clip(e, -CLIP_SIGMA * scale, CLIP_SIGMA * scale))


def _scale(e: FloatArray) -> float:
    """Return the robust scale of residuals (n,), or their mean magnitude if more than half are zero."""
    return robust_scale(e) or float(np.abs(e).mean()) or 1e-9


def _autocorrelation(e: FloatArray, follows: BoolArray) -> float:
    """Return the autocorrelation of successive residuals; 0 if it is below three of its standard errors."""
    late, early = e[1:][follows[1:]], e[:-1][follows[1:]]
    if len(late) < MIN_PAIRS:
        return 0.0
    rho = float((late @ early) / (np.sqrt((late @ late) * (early @ early)) + 1e-300))
    return min(rho, MAX_AUTOCORRELATION) if rho > 3.0 / np.sqrt(len(late)) else 0.0
