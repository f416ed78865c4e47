"""A sequential Monte Carlo sampler: particles that follow a posterior as data comes in.

Between two stages of data the new likelihood is let in by a power that grows from 0 to 1 in steps which leave
half of the particles effective; after each they are resampled and moved by Hamiltonian Monte Carlo, in the
metric of their own covariance (Del Moral, Doucet & Jasra 2006, section 3; adaptive steps: Jasra et al. 2011).
Where a posterior is bent or has several maxima, they show it; no Gaussian would.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray, IntArray

__all__ = ["Likelihood", "Particles", "sample"]

Likelihood = Callable[[FloatArray, int, int], tuple[float, FloatArray]]
"""``f(u, kind, count)``: log likelihood of the first `count` data, and its gradient by u (q,)."""

EFFECTIVE = 0.5
"""Share of the particles that stays effective in a step."""
MOVES, LEAPS = 2, 6
"""Moves after a step, and leaps in a move."""
ACCEPTED, LONGEST = 0.7, 1.0
"""Share of moves to be accepted, and the longest leap, in the metric's unit."""
DIVERGED = 1e3
"""Loss of log posterior after which a move is given up."""
ALONE = 0.1
"""Share of the metric that takes the unknowns as independent: few particles do not tell."""


@dataclass(frozen=True, eq=False)
class Particles:
    """Equally likely values of the unknowns: u (k, q), and which kind of model each has (k,)."""

    u: FloatArray
    kind: IntArray


@dataclass(eq=False)
class _Seen:
    """Log likelihood and gradient with the data of the last stage, and with those of this one."""

    before: tuple[float, FloatArray]
    now: tuple[float, FloatArray]

    def log_posterior(self, share: float, u: FloatArray) -> tuple[float, FloatArray]:
        """Return log posterior and gradient, the prior being N(0, 1)."""
        (a, da), (b, db) = self.before, self.now
        return (1.0 - share) * a + share * b - 0.5 * float(u @ u), (1.0 - share) * da + share * db - u


def sample(
    likelihood: Likelihood,
    q: int,
    kinds: int,
    counts: Sequence[int],
    number: int,
    hopeless: Callable[[FloatArray, int], bool] = lambda _u, _count: False,
) -> Particles:
    """Return `number` particles of the posterior of u (q,), N(0, 1) beforehand, and of one of `kinds` models.

    `counts` says how many data each stage has; after one that is `hopeless`, by its u (k, q) and its count,
    no more are used.
    """
    rng = np.random.default_rng(0)
    u, kind = rng.normal(size=(number, q)), rng.integers(0, kinds, number)
    nothing = 0.0, np.zeros(q)
    last = [nothing] * number
    mover = _Mover(likelihood, kinds, rng)
    for before, count in zip((0, *counts), counts, strict=False):
        seen = [_Seen(last[i], likelihood(u[i], int(kind[i]), count)) for i in range(number)]
        mover.before, mover.count, share = before, count, 0.0
        while share < 1.0:
            gained = np.array([one.now[0] - one.before[0] for one in seen])
            share, weights = _step(gained, share)
            metric = _metric(u, weights)
            chosen = np.searchsorted(np.cumsum(weights), (np.arange(number) + rng.uniform()) / number)
            chosen = np.minimum(chosen, number - 1)
            u, kind, seen = u[chosen], kind[chosen], [seen[i] for i in chosen.tolist()]
            mover.share, mover.root = share, metric
            mover.move(u, kind, seen)
        if hopeless(u, count):
            break
        last = [one.now for one in seen]
    return Particles(u, kind)


def _step(gained: FloatArray, share: float) -> tuple[float, FloatArray]:
    """Return the next share of the new likelihood, and the particles' weights (k,) by their gain."""

    def weighed(to: float) -> FloatArray:
        w = np.exp((to - share) * (gained - gained.max()))
        return np.asarray(w / w.sum())

    def effective(to: float) -> bool:
        return float(1.0 / (weighed(to) ** 2).sum()) >= EFFECTIVE * len(gained)

    low, high = share, 1.0
    if not effective(high):
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if effective(middle) else (low, middle)
    return high, weighed(high)


def _metric(u: FloatArray, weights: FloatArray) -> FloatArray:
    """Return a root of the particles' covariance (q, q)."""
    off = u - weights @ u
    C = off.T @ (off * weights[:, None])
    C = (1.0 - ALONE) * C + ALONE * np.diag(np.diag(C)) + 1e-8 * np.eye(len(C))
    return np.asarray(np.linalg.cholesky(C))


class _Mover:
    """Moves particles without changing what they are a sample of."""

    def __init__(self, likelihood: Likelihood, kinds: int, rng: np.random.Generator) -> None:
        self.likelihood, self.kinds, self.rng = likelihood, kinds, rng
        self.before = self.count = 0
        self.share, self.root, self.leap = 0.0, np.eye(1), 0.5 * LONGEST

    def move(self, u: FloatArray, kind: IntArray, seen: list[_Seen]) -> None:
        """Move particles u (k, q) of `kind` (k,) in place."""
        for _ in range(MOVES):
            accepted = 0
            for i in range(len(u)):
                other = int(kind[i] + self.rng.integers(1, self.kinds)) % self.kinds
                there = self._seen(u[i], other)
                if self._better(
                    there.log_posterior(self.share, u[i])[0] - seen[i].log_posterior(self.share, u[i])[0]
                ):
                    kind[i], seen[i] = other, there
                accepted += self._leaped(u, int(kind[i]), seen, i)
            self.leap = min(self.leap * float(np.exp(0.5 * (accepted / len(u) - ACCEPTED))), LONGEST)

    def _leaped(self, u: FloatArray, kind: int, seen: list[_Seen], i: int) -> bool:
        """Move one particle along its posterior's slope (Neal 2011, fig. 2); return whether it moved."""
        leap = self.leap * float(self.rng.uniform(0.7, 1.3))
        x, here = u[i], seen[i]
        p = np.asarray(self.rng.normal(size=u.shape[1]))
        value, slope = here.log_posterior(self.share, x)
        begun = value - 0.5 * float(p @ p)
        for _ in range(LEAPS):
            p = p + 0.5 * leap * (self.root.T @ slope)
            x = x + leap * (self.root @ p)
            here = self._seen(x, kind)
            value, slope = here.log_posterior(self.share, x)
            if not value - begun > -DIVERGED:
                return False
            p = p + 0.5 * leap * (self.root.T @ slope)
        if not self._better(value - 0.5 * float(p @ p) - begun):
            return False
        u[i], seen[i] = x, here
        return True

    def _seen(self, u: FloatArray, kind: int) -> _Seen:
        now = self.likelihood(u, kind, self.count)
        if self.share == 1.0 or not self.before:
            return _Seen((0.0, np.zeros(len(u))), now)
        return _Seen(self.likelihood(u, kind, self.before), now)

    def _better(self, gained: float) -> bool:
        return bool(np.log(self.rng.uniform()) < gained)
