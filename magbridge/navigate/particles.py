"""A sequential Monte Carlo sampler: particles sample a posterior while the data grows in stages.

In each stage, the power of the new likelihood grows from 0 to 1 in steps that leave half of the particles
effective (Del Moral, Doucet & Jasra 2006, section 3; adaptive steps: Jasra et al. 2011). After each step the
particles are resampled, and moved by Hamiltonian Monte Carlo in the metric of their covariance. Particles
represent a curved posterior or one with several maxima, which a Gaussian would not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["Likelihood", "sample"]

Evaluation = tuple[float, FloatArray]
"""Log density, and its gradient (q,) with respect to u (q,)."""
Likelihood = Callable[[FloatArray, int], Evaluation]
"""``f(u, count)``: log likelihood of the first `count` data, and its gradient."""

MIN_EFFECTIVE_FRACTION = 0.5
"""Smallest fraction of the particles that stays effective in a tempering step."""
MOVES_PER_STEP, LEAPFROG_STEPS = 2, 6
"""Moves of a particle after a tempering step, and leapfrog steps in a move."""
TARGET_ACCEPTANCE, MAX_STEP_SIZE = 0.7, 1.0
"""Target fraction of accepted moves, and the largest leapfrog step, in units of the metric."""
MAX_ENERGY_ERROR = 1e3
"""Loss of log posterior beyond which a move is abandoned."""
DIAGONAL_FRACTION = 0.1
"""Weight of the diagonal in the metric: few particles do not determine a full covariance."""


def sample(
    likelihood: Likelihood,
    q: int,
    counts: Sequence[int],
    number: int,
    stop: Callable[[FloatArray, int], bool] = lambda _u, _count: False,
) -> FloatArray:
    """Return particles u (number, q) of the posterior of q unknowns whose prior is N(0, 1).

    `counts` is the number of data after each stage. The sampler ends early if ``stop(u, count)`` is True
    after a stage.
    """
    mover = _Mover(likelihood, np.random.default_rng(0))
    u = mover.rng.normal(size=(number, q))
    for count in counts:
        mover.before, mover.count, mover.power = mover.count, count, 0.0
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
    """Return the next power of the new likelihood, and the particles' weights (k,) at this power.

    `gained` (k,) is the gain of log likelihood by the new data, and `power` the power so far.
    """

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
    """Return the Cholesky factor (q, q) of the weighted particles' covariance, shrunk to its diagonal."""
    off = u - weights @ u
    C = off.T @ (off * weights[:, None])
    # Shrink towards the diagonal: few particles do not determine a full covariance.
    C = (1.0 - DIAGONAL_FRACTION) * C + DIAGONAL_FRACTION * np.diag(np.diag(C)) + 1e-8 * np.eye(len(C))
    return np.asarray(np.linalg.cholesky(C))


class _Mover:
    """Hamiltonian Monte Carlo moves, which preserve the particles' distribution (Neal 2011, fig. 2)."""

    def __init__(self, likelihood: Likelihood, rng: np.random.Generator) -> None:
        self.likelihood, self.rng = likelihood, rng
        self.before = self.count = 0
        self.power, self.root, self.step_size = 0.0, np.eye(1), 0.5 * MAX_STEP_SIZE

    def evaluate(self, u: FloatArray) -> tuple[Evaluation, Evaluation]:
        """Return log likelihood and gradient of the data before this stage, and of those including it."""
        before = self.likelihood(u, self.before) if self.before else (0.0, np.zeros(len(u)))
        return before, self.likelihood(u, self.count)

    def move(self, u: FloatArray, seen: list[tuple[Evaluation, Evaluation]]) -> None:
        """Move the particles u (k, q) and update their likelihoods `seen` in place; adapt the step size."""
        for _ in range(MOVES_PER_STEP):
            accepted = sum(self._move_one(u, seen, i) for i in range(len(u)))
            growth = np.exp(0.5 * (accepted / len(u) - TARGET_ACCEPTANCE))
            self.step_size = min(self.step_size * float(growth), MAX_STEP_SIZE)

    def _move_one(self, u: FloatArray, seen: list[tuple[Evaluation, Evaluation]], i: int) -> bool:
        """Try a Hamiltonian move of particle `i`; return True if the move was accepted."""
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
        """Return log posterior and gradient: prior N(0, 1), earlier data, new data to the power so far."""
        (a, da), (b, db) = seen
        t = self.power
        return (1.0 - t) * a + t * b - 0.5 * float(u @ u), (1.0 - t) * da + t * db - u
