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

MIN_EFFECTIVE_FRACTION = 0.5
"""Fraction of the particles that stays effective in a step."""
MOVES_PER_STEP, LEAPFROG_STEPS = 2, 6
"""Moves after a step, and leaps in a move."""
TARGET_ACCEPTANCE, MAX_STEP_SIZE = 0.7, 1.0
"""Fraction of moves to be accepted, and the longest step_size, in the metric's unit."""
MAX_ENERGY_ERROR = 1e3
"""Loss of log posterior after which a move is given up."""
DIAGONAL_FRACTION = 0.1
"""Fraction of the metric that takes the unknowns as independent: few particles do not tell."""


@dataclass(frozen=True, eq=False)
class Particles:
    """Equally likely values of the unknowns: u (k, q), and which kind of model each has (k,)."""

    u: FloatArray
    kind: IntArray


@dataclass(eq=False)
class _Tempered:
    """Log likelihood and gradient with the data of the last stage, and with those of this one."""

    before: tuple[float, FloatArray]
    now: tuple[float, FloatArray]

    def log_posterior(self, power: float, u: FloatArray) -> tuple[float, FloatArray]:
        """Return log posterior and gradient, the prior being N(0, 1)."""
        (a, da), (b, db) = self.before, self.now
        return (1.0 - power) * a + power * b - 0.5 * float(u @ u), (1.0 - power) * da + power * db - u


def sample(
    likelihood: Likelihood,
    q: int,
    kinds: int,
    counts: Sequence[int],
    number: int,
    stop: Callable[[FloatArray, int], bool] = lambda _u, _count: False,
) -> Particles:
    """Return `number` particles of the posterior of u (q,), N(0, 1) beforehand, and of one of `kinds` models.

    `counts` says how many data each stage has; after one that is `stop`, by its u (k, q) and its count,
    no more are used.
    """
    rng = np.random.default_rng(0)
    u, kind = rng.normal(size=(number, q)), rng.integers(0, kinds, number)
    nothing = 0.0, np.zeros(q)
    last = [nothing] * number
    mover = _Mover(likelihood, kinds, rng)
    for before, count in zip((0, *counts), counts, strict=False):
        seen = [_Tempered(last[i], likelihood(u[i], int(kind[i]), count)) for i in range(number)]
        mover.before, mover.count, power = before, count, 0.0
        # Tempering: raise the power of the new likelihood in steps, resample, and move the particles.
        while power < 1.0:
            gained = np.array([one.now[0] - one.before[0] for one in seen])
            power, weights = _step(gained, power)
            metric = _metric(u, weights)
            # Systematic resampling: one uniform number for all particles.
            chosen = np.searchsorted(np.cumsum(weights), (np.arange(number) + rng.uniform()) / number)
            chosen = np.minimum(chosen, number - 1)
            u, kind, seen = u[chosen], kind[chosen], [seen[i] for i in chosen.tolist()]
            mover.power, mover.root = power, metric
            mover.move(u, kind, seen)
        if stop(u, count):
            break
        last = [one.now for one in seen]
    return Particles(u, kind)


def _step(gained: FloatArray, power: float) -> tuple[float, FloatArray]:
    """Return the next fraction of the new likelihood, and the particles' weights (k,) by their gain."""

    def weighed(to: float) -> FloatArray:
        w = np.exp((to - power) * (gained - gained.max()))
        return np.asarray(w / w.sum())

    def effective(to: float) -> bool:
        return float(1.0 / (weighed(to) ** 2).sum()) >= MIN_EFFECTIVE_FRACTION * len(gained)

    # Bisection for the power at which MIN_EFFECTIVE_FRACTION of the particles remains effective.
    low, high = power, 1.0
    if not effective(high):
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if effective(middle) else (low, middle)
    return high, weighed(high)


def _metric(u: FloatArray, weights: FloatArray) -> FloatArray:
    """Return a root of the particles' covariance (q, q)."""
    off = u - weights @ u
    C = off.T @ (off * weights[:, None])
    # Shrink towards the diagonal: few particles do not determine a full covariance.
    C = (1.0 - DIAGONAL_FRACTION) * C + DIAGONAL_FRACTION * np.diag(np.diag(C)) + 1e-8 * np.eye(len(C))
    return np.asarray(np.linalg.cholesky(C))


class _Mover:
    """Moves particles without changing what they are a sample of."""

    def __init__(self, likelihood: Likelihood, kinds: int, rng: np.random.Generator) -> None:
        self.likelihood, self.kinds, self.rng = likelihood, kinds, rng
        self.before = self.count = 0
        self.power, self.root, self.step_size = 0.0, np.eye(1), 0.5 * MAX_STEP_SIZE

    def move(self, u: FloatArray, kind: IntArray, seen: list[_Tempered]) -> None:
        """Move particles u (k, q) of `kind` (k,) in place."""
        for _ in range(MOVES_PER_STEP):
            accepted = 0
            for i in range(len(u)):
                # Metropolis move between kinds of field, then a Hamiltonian move of the unknowns.
                other = int(kind[i] + self.rng.integers(1, self.kinds)) % self.kinds
                there = self._evaluate(u[i], other)
                if self._accept(
                    there.log_posterior(self.power, u[i])[0] - seen[i].log_posterior(self.power, u[i])[0]
                ):
                    kind[i], seen[i] = other, there
                accepted += self._hamiltonian_move(u, int(kind[i]), seen, i)
            self.step_size = min(
                self.step_size * float(np.exp(0.5 * (accepted / len(u) - TARGET_ACCEPTANCE))), MAX_STEP_SIZE
            )

    def _hamiltonian_move(self, u: FloatArray, kind: int, seen: list[_Tempered], i: int) -> bool:
        """Move one particle along its posterior's slope (Neal 2011, fig. 2); return whether it moved."""
        step_size = self.step_size * float(self.rng.uniform(0.7, 1.3))
        x, here = u[i], seen[i]
        # Leapfrog integration of H = -log posterior + p'p / 2, in the metric root root'.
        p = np.asarray(self.rng.normal(size=u.shape[1]))
        value, slope = here.log_posterior(self.power, x)
        begun = value - 0.5 * float(p @ p)
        for _ in range(LEAPFROG_STEPS):
            p = p + 0.5 * step_size * (self.root.T @ slope)
            x = x + step_size * (self.root @ p)
            here = self._evaluate(x, kind)
            value, slope = here.log_posterior(self.power, x)
            if not value - begun > -MAX_ENERGY_ERROR:
                return False
            p = p + 0.5 * step_size * (self.root.T @ slope)
        if not self._accept(value - 0.5 * float(p @ p) - begun):
            return False
        u[i], seen[i] = x, here
        return True

    def _evaluate(self, u: FloatArray, kind: int) -> _Tempered:
        now = self.likelihood(u, kind, self.count)
        if self.power == 1.0 or not self.before:
            return _Tempered((0.0, np.zeros(len(u))), now)
        return _Tempered(self.likelihood(u, kind, self.before), now)

    def _accept(self, gained: float) -> bool:
        return bool(np.log(self.rng.uniform()) < gained)
