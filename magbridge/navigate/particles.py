"""A sequential Monte Carlo sampler: particles that follow a posterior as data comes in.

Between two stages of data the new likelihood is let in by a power that grows from 0 to 1 in steps which leave
half of the particles effective; after each they are resampled and moved by Hamiltonian Monte Carlo, in the
metric of their own covariance (Del Moral, Doucet & Jasra 2006, section 3; adaptive steps: Jasra et al. 2011).
Where a posterior is bent or has several maxima, the particles show it; a Gaussian would not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["Likelihood", "sample"]

Evaluation = tuple[float, FloatArray]
"""A log density and its gradient by u (q,)."""
Likelihood = Callable[[FloatArray, int], Evaluation]
"""``f(u, count)``: log likelihood of the first `count` data."""

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


def sample(
    likelihood: Likelihood,
    q: int,
    counts: Sequence[int],
    number: int,
    stop: Callable[[FloatArray, int], bool] = lambda _u, _count: False,
) -> FloatArray:
    """Return particles u (number, q) of the posterior of unknowns that are N(0, 1) beforehand.

    `counts` is the number of data after each stage. The sampler ends early where `stop`, given the particles
    and the count, is True.
    """
    mover = _Mover(likelihood, np.random.default_rng(0))
    u = mover.rng.normal(size=(number, q))
    for count in counts:
        mover.begin_stage(count)
        seen = [mover.evaluate(one) for one in u]
        # Tempering: raise the power of the new likelihood in steps, resample, and move the particles.
        while mover.power < 1.0:
            gained = np.array([now[0] - before[0] for before, now in seen])
            power, weights = _next_power(gained, mover.power)
            mover.root = _metric(u, weights)
            # Systematic resampling: one uniform number for all particles.
            chosen = np.searchsorted(np.cumsum(weights), (np.arange(number) + mover.rng.uniform()) / number)
            chosen = np.minimum(chosen, number - 1)
            u, seen, mover.power = u[chosen], [seen[i] for i in chosen.tolist()], power
            mover.move(u, seen)
        if stop(u, count):
            break
    return u


def _next_power(gained: FloatArray, power: float) -> tuple[float, FloatArray]:
    """Return the next power of the new likelihood, and the particles' weights (k,) by their gain."""

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
    """Hamiltonian moves of particles, which leave their distribution unchanged (Neal 2011, fig. 2)."""

    def __init__(self, likelihood: Likelihood, rng: np.random.Generator) -> None:
        self.likelihood, self.rng = likelihood, rng
        self.before = self.count = 0
        self.power, self.root, self.step_size = 0.0, np.eye(1), 0.5 * MAX_STEP_SIZE

    def begin_stage(self, count: int) -> None:
        """Begin a stage that ends with the first `count` data."""
        self.before, self.count, self.power = self.count, count, 0.0

    def evaluate(self, u: FloatArray) -> tuple[Evaluation, Evaluation]:
        """Return the log likelihood of the data before this stage, and of all after it."""
        before = self.likelihood(u, self.before) if self.before else (0.0, np.zeros(len(u)))
        return before, self.likelihood(u, self.count)

    def move(self, u: FloatArray, seen: list[tuple[Evaluation, Evaluation]]) -> None:
        """Move particles u (k, q) in place, and their likelihoods `seen`; adapt the step size."""
        for _ in range(MOVES_PER_STEP):
            accepted = sum(self._move_one(u, seen, i) for i in range(len(u)))
            growth = np.exp(0.5 * (accepted / len(u) - TARGET_ACCEPTANCE))
            self.step_size = min(self.step_size * float(growth), MAX_STEP_SIZE)

    def _move_one(self, u: FloatArray, seen: list[tuple[Evaluation, Evaluation]], i: int) -> bool:
        """Move one particle along its posterior's slope; return True if the move was accepted."""
        step_size = self.step_size * float(self.rng.uniform(0.7, 1.3))
        x, here = u[i], seen[i]
        # Leapfrog integration of H = -log posterior + p'p / 2, in the metric root root'.
        p = np.asarray(self.rng.normal(size=u.shape[1]))
        value, slope = self._log_posterior(x, here)
        begun = value - 0.5 * float(p @ p)
        for _ in range(LEAPFROG_STEPS):
            p = p + 0.5 * step_size * (self.root.T @ slope)
            x = x + step_size * (self.root @ p)
            here = self.evaluate(x)
            value, slope = self._log_posterior(x, here)
            if not value - begun > -MAX_ENERGY_ERROR:
                return False
            p = p + 0.5 * step_size * (self.root.T @ slope)
        # Metropolis test of the change of H
        if not np.log(self.rng.uniform()) < value - 0.5 * float(p @ p) - begun:
            return False
        u[i], seen[i] = x, here
        return True

    def _log_posterior(self, u: FloatArray, seen: tuple[Evaluation, Evaluation]) -> Evaluation:
        """Return log posterior and gradient, with the prior N(0, 1) and the new data's `power`."""
        (a, da), (b, db) = seen
        t = self.power
        return (1.0 - t) * a + t * b - 0.5 * float(u @ u), (1.0 - t) * da + t * db - u
