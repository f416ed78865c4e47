r"""Oscillations of limited duration: what rings, surges or bursts for a while.

Notes
-----
A packet is a wave along the field under a Gaussian, with an amplitude and a phase of its own (Gabor 1946,
J. IEE 93:429):

.. math:: e^{-(t - t_0)^2 / 2 (Q P)^2}
          \left(a \cos \tfrac{2 \pi (t - t_0)}{P} + b \sin \tfrac{2 \pi (t - t_0)}{P}\right)

Its moment t_0 is as likely as any other; its period P and its cycles Q are uniform in their logarithms. With
g the score of each single sample and h its information at that frequency, the likelihood ratio of a and b is
``R = |B|^2 / S``,

.. math:: B(t_0) = \sum_t g_t e^{-(t - t_0)^2 / 2 (Q P)^2 + 2 \pi i (t - t_0) / P}, \qquad
          S(t_0) = \tfrac12 \sum_t h_t e^{-(t - t_0)^2 / (Q P)^2}

so two convolutions over the log's intervals evaluate all moments at once; intervals without a sample have
g = h = 0. A place is a period, a length and a moment. A packet is accepted if its Bayes factor, averaged over
all places that it could have had, is above one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import ifft, irfft, next_fast_len, rfft

from magbridge.arrays import FloatArray
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import in_threads
from magbridge.diagnose.inference.evidence import log_bayes
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.noise import Noise

__all__ = ["Packets", "packets"]

CYCLES = (0.75, 2.25, 6.75)
"""Values of Q that are tried."""
SHORTEST, LONGEST = 4.0, 1.0 / 6.0
"""Shortest period, in intervals; longest length Q P, as a share of the log."""
LEAST_RATIO = 6.0
"""Likelihood ratio below which a place is ignored."""
MOST = 12
"""Most packets in a log."""
APART = 2.5
"""Lengths in time, and bandwidths in frequency, within which two places hold the same packet."""
REACH = 5.0
"""Lengths from its moment beyond which a packet is cut off."""
SPARSE = 8
"""Intervals per sample; a log with fewer samples than one in so many is not searched for packets."""


class Places(NamedTuple):
    """Places of packets of one period and length, in intervals.

    Moments (m,), likelihood ratios (m,), and the log of the prior probability of one place.
    """

    period: float
    length: float
    moment: FloatArray
    ratio: FloatArray
    log_prior: float


class Packets(NamedTuple):
    """The accepted packets.

    Their columns, two for each; how many sets of as many packets they were chosen from; and the period of the
    loudest, s.
    """

    columns: Columns
    look_elsewhere: float
    period: float


def packets(problem: Problem, fit: Joint) -> Packets | None:
    """Find the packets in what a fit has left, the loudest first."""
    slots = problem.survey.slots
    if slots[-1] > SPARSE * len(slots):
        return None
    listed = _Spectra(problem, fit).places()
    found: list[tuple[float, Places]] = []
    price = 0.0
    while len(found) < MOST:
        best = max(listed, key=lambda places: places.ratio.max(), default=None)
        if best is None:
            break
        at = int(np.argmax(best.ratio))
        ratio, moment = float(best.ratio[at]), float(best.moment[at])
        near = 0.0
        for places in listed:
            length = np.hypot(places.length, best.length)
            band = np.hypot(1.0 / places.length, 1.0 / best.length)
            if abs(1.0 / places.period - 1.0 / best.period) < APART * band / (2.0 * np.pi):
                same = np.abs(places.moment - moment) < APART * length
                near += float(np.sum(np.exp(places.log_prior + 0.5 * (places.ratio[same] - ratio))))
                places.ratio[same] = 0.0
        if log_bayes(ratio, 2) + np.log(near) <= 0.0:
            break
        price -= float(np.log(near))
        found.append((moment, best))
    if not found:
        return None
    period = found[0][1].period * problem.survey.interval
    return Packets(_columns(problem, found), float(np.exp(price)), period)


def _columns(problem: Problem, found: list[tuple[float, Places]]) -> Columns:
    slots = problem.survey.slots

    def columns(rows: slice) -> FloatArray:
        out = np.zeros((len(slots[rows]), 2 * len(found)))
        for k, (moment, places) in enumerate(found):
            since = (slots[rows] - moment) / places.length
            here = np.abs(since) < REACH
            turns = 2.0 * np.pi * places.length / places.period * since[here]
            # divided by the root of the length, so that in white noise all packets have about one norm
            under = np.exp(-0.5 * since[here] ** 2) / np.sqrt(places.length)
            out[here, 2 * k], out[here, 2 * k + 1] = under * np.cos(turns), under * np.sin(turns)
        return np.asarray(problem.reference_jacobian[rows, None] * out)

    return columns


class _Spectra:
    """Spectra of g and h of the module's notes, over `whole` intervals: the log's n, then zeros."""

    def __init__(self, problem: Problem, fit: Joint) -> None:
        noise, slots = fit.noise, problem.survey.slots
        self.noise, self.n = noise, int(slots[-1]) + 1
        self.finest = 2 ** max(int(np.log2(self.n)) - 6, 0)
        self.whole = self.finest * next_fast_len(int((1.0 + 3.0 * LONGEST) * self.n / self.finest) + 1)
        g = problem.reference_jacobian * noise.back(noise.response(fit.residual))
        self.G = rfft(np.bincount(slots, g), self.whole)
        h = problem.reference_jacobian**2 * noise.kappa / noise.scale**2
        parts = (noise.past.whole, ~noise.past.whole)
        self.H = np.array([rfft(np.bincount(slots, h * some), self.whole) for some in parts])

    def places(self) -> list[Places]:
        """List the places of each period and length whose likelihood ratio exceeds :data:`LEAST_RATIO`."""
        asked = []
        for Q in CYCLES:
            # periods one relative bandwidth, 1 / (2 pi Q), apart
            count = max(int(2.0 * np.pi * Q * np.log(LONGEST * self.n / Q / SHORTEST)), 0)
            periods = SHORTEST * np.exp(np.arange(count) / (2.0 * np.pi * Q))
            asked += [(Q, float(period), count) for period in periods]
        found = in_threads(self.n, lambda one: self._likely(*one), asked)
        return [places for places in found if places.moment.size]

    def _likely(self, Q: float, period: float, count: int) -> Places:
        """Places of one period and length; `count` periods are tried with this Q."""
        length = Q * period
        # thinned to so few moments, all frequencies up to twice the packet's own are still resolved
        every = min(2 ** int(np.log2(period / SHORTEST)), self.finest)
        samples = self.whole // every
        f = np.arange(samples // 2 + 1) / self.whole
        kernel = np.exp(-0.5 * (2.0 * np.pi * length * (f - 1.0 / period)) ** 2)
        B = ifft(self.G[: len(f)] * kernel, samples) / every
        # the mean over the packet's band, at the nodes of Gauss-Hermite quadrature
        near = 1.0 / period + np.array([-1.0, 0.0, 1.0]) * np.sqrt(1.5) / (2.0 * np.pi * length)
        seen = _passed(self.noise, near) @ np.array([1.0, 4.0, 1.0]) / 6.0
        kernel = np.exp(-0.25 * (2.0 * np.pi * length * f) ** 2)
        S = irfft(seen @ self.H[:, : len(f)] * kernel, samples) / every
        # the kernels sum to one, those of the notes to sqrt(2 pi) length and sqrt(pi) length
        known = 0.5 * np.sqrt(np.pi) * length * S
        ratio = 2.0 * np.pi * length**2 * np.abs(B) ** 2 / np.maximum(known, 1e-3 * known.max())
        moments = -(-self.n // every)
        likely = np.flatnonzero(ratio[:moments] > LEAST_RATIO)
        log_prior = -float(np.log(len(CYCLES) * count * moments))
        return Places(period, length, (every * likely).astype(float), ratio[likely], log_prior)


def _passed(noise: Noise, frequency: FloatArray) -> FloatArray:
    """(2, k) power gain of whitening at frequencies (k,), per sample: away from gaps, and after them."""
    past, gaps = noise.past, noise.near_gaps
    lags = np.arange(1, past.order + 1)
    whole = np.abs(1.0 - np.exp(-2j * np.pi * np.outer(frequency, lags)) @ noise.ar) ** 2
    waves = np.exp(-2j * np.pi * frequency[:, None, None] * past.lags)
    early = np.abs(gaps.f * (1.0 - np.sum(gaps.a * waves, axis=2))) ** 2
    return np.stack([whole, early @ np.bincount(past.pattern) / max(len(past.rows), 1)])
