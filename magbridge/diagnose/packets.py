r"""Transient signals: wave packets (oscillations of limited duration), and the passage of a distant dipole.

Notes
-----
A packet is an oscillation of the total field under a Gaussian envelope (Gabor 1946, J. IEE 93:429):

.. math:: e^{-(t - t_0)^2 / 2 L^2} \left(a \cos 2 \pi f (t - t_0) + b \sin 2 \pi f (t - t_0)\right)

The prior is uniform in the moment t_0, in the logarithm of the length L and in the number of cycles f L. With
g the score of a single sample and h its information at the frequency, the likelihood ratio of a and b is
``R = |B|^2 / S``,

.. math:: B = \sum_t g_t e^{-(t - t_0)^2 / 2 L^2 + 2 \pi i f (t - t_0)}, \qquad
          S = \tfrac12 \sum_t h_t e^{-(t - t_0)^2 / L^2}

B is a short-time Fourier transform for each length. A *place* is a triple of length, frequency and moment. A
packet is accepted if its Bayes factor, averaged over all places, is above one.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from magbridge.arrays import FloatArray
from magbridge.diagnose.columns import Columns
from magbridge.diagnose.evidence import log_bayes
from magbridge.diagnose.joint import Joint, in_threads
from magbridge.diagnose.noise import ResidualNoise
from magbridge.diagnose.problem import Problem

CYCLES = 0.75, 7.0
"""Smallest and largest number of cycles f L."""
SHORTEST, LONGEST = 4, 1.0 / 6.0
"""Shortest length and shortest period, in sampling intervals; longest length, as a fraction of the log."""
WINDOW, FINER = 6, 8
"""Width of the Fourier window in units of L; ratio of 1 / L to the step of the frequencies."""
LEAST_RATIO = 6.0
"""Likelihood ratio below which a place is ignored."""
MAX_PACKETS = 12
"""Largest number of packets in a log."""
PACKET_SEPARATION = 2.5
"""Distance, in lengths and in bandwidths, below which two places belong to one packet."""
PACKET_CUTOFF_LENGTHS = 5.0
"""Distance from its moment, in lengths L, beyond which a packet is set to zero."""
MAX_SAMPLE_INTERVALS = 8
"""Largest mean number of sampling intervals per sample in a log that is searched for packets."""
DURATIONS, BRIEFEST, SLOWEST = 12, 8.0, 0.125
"""Durations of a passage: their number, the shortest in samples, the longest as a fraction of the log."""
QUARTERS = np.arange(-12, 13)
"""Offsets from the nearest point, in quarters of the duration, at which a passage is evaluated."""


class Packets(NamedTuple):
    """The accepted packets."""

    columns: Columns
    """Two columns for each packet, a cosine and a sine."""
    look_elsewhere: float
    """Number of equally likely sets of places from which the packets were chosen."""
    period: float
    """Period of the strongest packet, s."""


def packets(problem: Problem, fit: Joint) -> Packets | None:
    """Return the packets in the residual of a fit, the strongest first; None if no packet is accepted."""
    survey = problem.survey
    # Lengths by powers of two; each has frequencies and moments of its own
    n = int(survey.slots[-1]) + 1
    lengths = SHORTEST * 2 ** np.arange(max(int(np.log2(max(LONGEST * n / SHORTEST, 0.5))) + 1, 0))
    if n > MAX_SAMPLE_INTERVALS * len(survey) or not lengths.size:
        return None
    listed = in_threads(n, partial(_places, problem, fit), lengths.tolist())
    length, frequency, moment, ratio, log_prior = np.concatenate(listed, axis=1)
    log_prior = log_prior - np.log(len(lengths))
    found: list[int] = []
    price = 0.0
    # Matching pursuit: the loudest place, then those outside of its bandwidth and duration
    while len(found) < MAX_PACKETS and ratio.any():
        k = int(np.argmax(ratio))
        band = np.hypot(1.0 / length, 1.0 / length[k]) / (2.0 * np.pi)
        same = np.abs(frequency - frequency[k]) < PACKET_SEPARATION * band
        same &= np.abs(moment - moment[k]) < PACKET_SEPARATION * np.hypot(length, length[k])
        near = float(np.log(np.sum(np.exp(log_prior[same] + 0.5 * (ratio[same] - ratio[k])))))
        if log_bayes(ratio[k], 2) + near <= 0.0:
            break
        price -= near
        found.append(k)
        ratio[same] = 0.0
    if not found:
        return None
    columns = partial(_columns, problem, length[found], frequency[found], moment[found])
    return Packets(columns, float(np.exp(price)), survey.interval / float(frequency[found[0]]))


def _columns(
    problem: Problem, length: FloatArray, frequency: FloatArray, moment: FloatArray, rows: slice
) -> FloatArray:
    """Return (m, 2 k) cosine and sine columns of k packets; lengths and moments are in intervals."""
    since = (problem.survey.slots[rows, None] - moment) / length
    turns = 2.0 * np.pi * length * frequency * since
    # divided by the root of the length, so that in white noise all packets have about one norm
    under = np.where(np.abs(since) < PACKET_CUTOFF_LENGTHS, np.exp(-0.5 * since**2), 0.0) / np.sqrt(length)
    waves = np.stack([under * np.cos(turns), under * np.sin(turns)], axis=2)
    return np.asarray(problem.reference_jacobian[rows, None] * waves.reshape(len(waves), -1))


def _places(problem: Problem, fit: Joint, length: int) -> FloatArray:
    """Return (5, m) length, frequency, moment (intervals), ratio and log prior of notable places."""
    noise, slots, slope = fit.noise, problem.survey.slots, problem.reference_jacobian
    wide, every = WINDOW * length, length // 2
    window = np.exp(-0.5 * ((np.arange(wide) - wide // 2) / length) ** 2)

    def windows(values: FloatArray) -> FloatArray:
        each = np.pad(np.bincount(slots, values), (wide // 2, wide - wide // 2 - 1))
        return np.asarray(sliding_window_view(each, wide)[::every], float)

    # B by a short-time Fourier transform of the scores, S by the power of the slope in each window
    f = np.fft.rfftfreq(FINER * length)
    asked = (f * length >= CYCLES[0]) & (f * length <= CYCLES[1]) & (f <= 1.0 / SHORTEST)
    B = np.fft.rfft(windows(slope * noise.filter_back(noise.response(fit.residual))) * window, FINER * length)
    h = slope**2 * noise.kappa / noise.scale**2
    parts = noise.past.whole, ~noise.past.whole
    power = np.stack([windows(h * some) @ window**2 for some in parts], axis=1)
    # the mean over the packet's band, at the nodes of Gauss-Hermite quadrature
    near = f[asked, None] + np.array([-1.0, 0.0, 1.0]) * np.sqrt(1.5) / (2.0 * np.pi * length)
    gain = _passed(noise, near.ravel()).reshape(2, -1, 3) @ np.array([1.0, 4.0, 1.0]) / 6.0
    known = 0.5 * power @ gain
    ratio = np.abs(B[:, asked]) ** 2 / np.maximum(known, 1e-3 * known.max())
    at, line = np.nonzero(ratio > LEAST_RATIO)
    one = np.ones(at.size)
    return np.stack([length * one, f[asked][line], every * at, ratio[at, line], -np.log(ratio.size) * one])


def _passed(noise: ResidualNoise, frequency: FloatArray) -> FloatArray:
    """Return the power gain of whitening (2, k), away from gaps and after, at frequencies (k,)."""
    # |1 - sum a_k e^(-2 pi i f k)|^2 away from gaps, and its mean over the patterns after them
    past, gaps = noise.past, noise.near_gaps
    lags = np.arange(1, past.order + 1)
    whole = np.abs(1.0 - np.exp(-2j * np.pi * np.outer(frequency, lags)) @ noise.ar) ** 2
    waves = np.exp(-2j * np.pi * frequency[:, None, None] * past.lags)
    early = np.abs(gaps.f * (1.0 - np.sum(gaps.a * waves, axis=2))) ** 2
    return np.stack([whole, early @ np.bincount(past.pattern) / max(len(past.rows), 1)])


def passage(problem: Problem, fit: Joint) -> tuple[Columns, float]:
    r"""Return three columns of the likeliest passage of a distant dipole, and the number of passages tried.

    A dipole near a straight course adds to the total field :math:`(b_0 + b_1 s + b_2 s^2) / (1 + s^2)^{5/2}`,
    with s the time since its nearest point in units of the duration (Ginzburg, Frumkis & Kaplan 2002, Sens.
    Actuators A 102:67).
    """
    t = problem.survey.time - problem.survey.time[0]
    # Score and information of each quarter of a duration, then matched filters at all moments
    improvement = fit.noise.whiten(problem.reference_jacobian)
    matched, power = improvement * fit.noise.response(fit.residual), improvement * improvement
    shape = _passing(QUARTERS / 4.0)
    pairs = np.einsum("ik,jk->ijk", shape, shape).reshape(9, -1)
    best, nearest, scale, look_elsewhere = -np.inf, 0.0, 1.0, 1.0
    for duration in np.geomspace(BRIEFEST / len(t), SLOWEST, DURATIONS) * float(t[-1]):
        # Sums by quarters, then b and S at every moment by a product with the shapes
        quarters = (4.0 * t / duration).astype(int)
        b, S = (_around(np.bincount(quarters, x)) @ f.T for x, f in ((matched, shape), (power, pairs)))
        ratio = _ratio(S.reshape(-1, 3, 3), b)
        at, count = int(np.argmax(ratio)), float(ratio.size * DURATIONS)
        evidence = 0.5 * float(ratio[at]) - float(np.log(count))
        if evidence > best:
            best, nearest, scale, look_elsewhere = evidence, (2 * at + 0.5) * duration / 4.0, duration, count
    return (
        lambda rows: problem.reference_jacobian[rows, None] * _passing((t[rows] - nearest) / scale).T,
        look_elsewhere,
    )


def _passing(s: FloatArray) -> FloatArray:
    """Return Anderson's functions ``(1, s, s^2) / (1 + s^2)^(5/2)`` of s (n,) as (3, n)."""
    return np.stack([np.ones_like(s), s, s * s]) / (1.0 + s * s) ** 2.5


def _around(values: NDArray[Any]) -> FloatArray:
    """Return the windows (m, 25) of :data:`QUARTERS` about every other one of `values`, one per quarter."""
    return sliding_window_view(np.pad(values, len(QUARTERS) // 2), len(QUARTERS))[::2]


def _ratio(S: FloatArray, b: FloatArray) -> FloatArray:
    """Return the likelihood ratios ``b^T S^-1 b`` (m,) of scores b (m, k) and information S (m, k, k)."""
    size = np.trace(S, axis1=1, axis2=2)[:, None, None] + 1e-300
    S = S + 1e-6 * size * np.eye(b.shape[1])
    return np.asarray(np.einsum("mi,mi->m", b, np.linalg.solve(S, b[:, :, None])[:, :, 0]))
