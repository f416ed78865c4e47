r"""Properties of a signal (the series that it follows, its autocorrelation) and of a track (its returns).

Notes
-----
*A signal* y is fitted by a series q, delayed by a lag, along the axes of the body and along the field,

.. math:: y = c_0 + \sum_i b_i u_i + q\,\bigl(d_0 + \sum_i d_i u_i\bigr)

with u the direction of the field in the body. The series explains the fraction of y's power that the terms in
q add to the constants. If y follows no series, slow waves in time take the place of q, to find the axis of a
slow signal.

*A track.* A function of the place is the same on every pass. It can imitate the cell means of a parabola in
time x, ``f = (x, x^2)``. With T the covariance of f and W the covariance within the cells, the smallest
eigenvalue of ``T^-1 W`` is the smallest fraction of a parabola's power that no function of the place imitates
(one less the largest squared canonical correlation: Hotelling 1936, Biometrika 28:321).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.special import fdtrc

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import lagged
from magbridge.diagnose.evidence import FALSE_ALARM_RATE
from magbridge.diagnose.problem import Problem
from magbridge.diagnose.survey import Survey
from magbridge.estimation.residual import rms

CORRELATION_LAGS_S = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 60.0, 120.0, 300.0, 700.0, 1700.0, 4000.0, 10000.0)
"""Lags of a signal behind a series that are tried, s."""
MIN_EXPLAINED_FRACTION = 0.1
"""Least fraction of a signal's power that a series must explain to be reported."""
MIN_AXIS_FRACTION = 0.8
"""Least ratio of the power explained by one axis to that by all axes, for a report of the axis."""
MIN_LAG_GAIN = 0.02
"""Fraction of the signal's power that a series with a lag must explain in addition to one without."""
CLEARLY = 0.1
"""Least margin of the best axis over the second, as a fraction of the unexplained power, for a report."""
WAVES, SLOW = 48, 0.5
"""Number of half waves over the log that are fitted to a slow signal; fraction of its power to explain."""
WHITE = 0.9
"""Ratio of the RMS of sample-to-sample changes to the RMS, from which on a residual counts as white."""
EVERY = slice(None)
FIELD_AND_AXES = ("field", "x", "y", "z")
CORRELATION_ROWS = 20_000
"""Largest number of rows on which a signal is compared with the series."""
RETURN_CELL_M = 250.0
"""Side of the cells, m: crustal sources are seldom nearer, and a map's own grid is seldom finer."""
MIN_RETURN_TIME_S = 900.0
"""Time after which another pass of a place is a return, s."""
SEPARABLE = 0.1
"""Least value of :attr:`Returns.separable` at which the track separates space from time: at S/N 10 the log
odds are then 5 (150:1)."""


class Seen(NamedTuple):
    """The series that a signal follows, and how well."""

    channel: str | None
    """Channel that explains most, or ``time``, ``roll``, ``pitch``, ``heading``; None if none does."""
    lag: float
    """Lag of the signal behind the series, s."""
    axis: str | None
    """Axis of the signal: ``x``, ``y`` or ``z`` of the body, or ``field``; None if no axis is clear."""
    size: float
    """RMS of the signal in the total field, nT."""
    share: float
    """Fraction of the signal's power that the series explains."""


class Memory(NamedTuple):
    """Autocorrelation of a residual: its deviation from white noise; `rms` in nT."""

    rms: float
    white: float
    """RMS of the changes from one sample to the next, divided by the root of two, nT."""
    correlation_time: float
    """Time after which the autocorrelation has fallen to 1/e, s."""
    slow: float
    """Fraction of the residual's power that remains in means over `samples` samples."""
    samples: int
    """Number of samples in each mean."""
    means: int
    """Number of means."""

    @property
    def lasts(self) -> bool:
        """Return True if the residual is correlated from one sample to the next."""
        return self.white < WHITE * self.rms


def seen(problem: Problem, signal: FloatArray, component: FloatArray | None = None) -> Seen:
    """Return the series that a signal (n,), nT of total field, and its part `component` (n,) follow."""
    part = slice(None, None, -(-len(signal) // CORRELATION_ROWS))
    u = -(problem.jacobian[:, 6:] / problem.reference_jacobian[:, None])[part]
    axes = np.column_stack([np.ones(len(u)), u])
    y = signal[part] - signal[part].mean()
    total = float(y @ y)
    size = rms(signal)
    if not total:
        return Seen(None, 0.0, None, size, 0.0)
    # Project a constant along each axis out of signal and series
    base = np.linalg.qr(axes)[0]
    y, own = (x - base @ (base.T @ x) for x in (y, signal[part] if component is None else component[part]))

    def fitted(q: FloatArray, columns: slice, y: FloatArray = y) -> FloatArray:
        X = (q[:, :, None] * axes[:, None, columns]).reshape(len(q), -1)
        X -= base @ (base.T @ X)
        G = X.T @ X
        G += 1e-9 * np.trace(G) / len(G) * np.eye(len(G)) + 1e-300 * np.eye(len(G))
        return np.asarray(X @ np.linalg.solve(G, X.T @ y))

    def explained(q: FloatArray, columns: slice = EVERY) -> float:
        return float(y @ fitted(q, columns)) / total

    def axis(q: FloatArray, total_share: float) -> str | None:
        alone = [explained(q, slice(k, k + 1)) for k in range(len(FIELD_AND_AXES))]
        *_, second, k = np.argsort(alone)
        margin = CLEARLY * (1.0 - total_share)
        clear = alone[k] >= MIN_AXIS_FRACTION * total_share and alone[k] - alone[second] >= margin
        return FIELD_AND_AXES[k] if clear else None

    found = [(explained(q), name, lag, q) for name, lag, q in _series(problem, part)]
    # A lag must explain more than its freedom does by chance
    share, name, lag, q = max(found, key=lambda one: one[0] - MIN_LAG_GAIN * (one[2] > 0.0))
    apart = float(own @ fitted(q, EVERY, own)) / (float(own @ own) + 1e-300)
    chance = _by_chance(share, q.shape[1] * len(FIELD_AND_AXES), (y - fitted(q, EVERY))[:, None] * axes)
    if min(share, apart) >= MIN_EXPLAINED_FRACTION and len(found) * chance < FALSE_ALARM_RATE:
        return Seen(name, lag, axis(q, share), size, share)
    # Cosines of half waves over the log
    time = problem.survey.time
    phase = np.pi * (time[part] - time[0]) / max(float(time[-1] - time[0]), 1e-300)
    waves = np.cos(phase[:, None] * np.arange(1, WAVES + 1))
    slow = explained(waves)
    return Seen(None, 0.0, axis(waves, slow) if slow * total >= SLOW * float(y @ y) else None, size, share)


def _by_chance(share: float, terms: int, residual: FloatArray) -> float:
    """Return the p-value (F test) of the fraction `share` of power that a fit of `terms` functions explains.

    The correlation time of the `residual` (n, 4) gives the number of independent samples (Bartlett 1946).
    """
    n = len(residual)
    freedom = max(n / (1.0 + 2.0 * max(map(_remembered, residual.T))) - terms - len(FIELD_AND_AXES), 1.0)
    return float(fdtrc(terms, freedom, share / terms / max((1.0 - share) / freedom, 1e-300)))


def _remembered(e: FloatArray) -> int:
    """Return the number of samples after which the autocorrelation of e (n,) has fallen to 1/e."""
    # Wiener-Khinchin, padded against wrapping
    spectrum = np.abs(np.fft.rfft(e, 2 * len(e))) ** 2
    correlation = np.fft.irfft(spectrum)[: len(e)]
    below = np.flatnonzero(correlation <= correlation[0] / np.e)
    return int(below[0]) if below.size else len(e)


def _series(problem: Problem, part: slice) -> Iterator[tuple[str, float, FloatArray]]:
    """Yield name, lag, s, and functions (m, k) of each series: zero mean, unit variance, rows `part`."""
    survey = problem.survey
    longest, shortest = 0.5 * float(np.ptp(survey.time)), 0.5 * survey.interval
    lags = [lag for lag in CORRELATION_LAGS_S if not lag or shortest <= lag <= longest]
    for name, channel in survey.channels.items():
        if name not in survey.still:
            for lag in lags:
                yield name, lag, _scaled(lagged(survey.time, channel.values, lag)[part])
    yield "time", 0.0, _scaled(survey.time[part])
    if survey.attitude is not None:
        angles = np.radians(survey.attitude[part].T)
        for name, angle in zip(("roll", "pitch", "heading"), angles, strict=True):
            yield name, 0.0, _scaled(np.cos(angle), np.sin(angle))


def _scaled(*values: FloatArray) -> FloatArray:
    q = np.stack(values, axis=1)
    q = q - q.mean(axis=0)
    return np.asarray(q / (q.std(axis=0) + 1e-300))


def memory(problem: Problem, residual: FloatArray) -> Memory:
    """Return the autocorrelation measures of a residual (n,), nT."""
    survey = problem.survey
    e = residual - residual.mean()
    size = max(rms(e), 1e-300)
    joined = survey.follows()[1:]
    white = rms(np.diff(e)[joined]) / 2.0**0.5 if joined.any() else size
    samples = int(np.clip(len(e) // 16, 2, 64))
    # Share of the power that averages over some samples do not remove
    means = e[: len(e) // samples * samples].reshape(-1, samples).mean(axis=1)
    time = _remembered(e) * survey.interval
    return Memory(size, white, time, float(np.mean(means**2)) / size**2, samples, means.size)


class Returns(NamedTuple):
    """How often a track returns to its places, and whether that separates space from time."""

    share: float
    """Fraction of the samples in cells that the track passes more than once."""
    longest: float
    """Longest time between the first and the last sample in a cell, s."""
    separable: float
    """Smallest fraction of the power of a parabola in time that no function of the place imitates."""

    @property
    def distinguishable(self) -> bool:
        """Return True if the log separates spatial from slow temporal changes of the field."""
        return self.separable >= SEPARABLE


def returns(survey: Survey) -> Returns | None:
    """Return how the track of a survey returns to its places; None for a log without positions."""
    if survey.place is None:
        return None
    corner = np.floor(survey.place[:, :2] / RETURN_CELL_M).astype(int)
    cell = np.unique(corner, axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((survey.time, cell))
    of, time = cell[order], survey.time[order]
    again = (np.diff(of) == 0) & (np.diff(time) > MIN_RETURN_TIME_S)
    passed = np.bincount(of[1:], again, of[-1] + 1) > 0
    x = (time - time.min()) / max(float(np.ptp(time)), 1.0)
    f = np.stack([x, x * x], axis=1)
    f -= f.mean(axis=0)
    means = np.stack([np.bincount(of, column) for column in f.T], axis=1) / np.bincount(of)[:, None]
    # Smallest ratio of the power within places to the whole, over all slow curves (generalised eigenvalue)
    within = f - means[of]
    separable = float(eigh(within.T @ within, f.T @ f, eigvals_only=True)[0])
    first = np.searchsorted(of, np.arange(of[-1] + 1))
    last = np.append(first[1:], len(of)) - 1
    longest = float(np.max(np.where(passed, time[last] - time[first], 0.0)))
    return Returns(float(np.mean(passed[of])), longest, float(np.clip(separable, 0.0, 1.0)))
