r"""How coefficients vary from vehicle to vehicle, from refit to refit, and from one power-up to the next.

A tree of Gaussian random effects over the coefficients z (K of them, in units of their physical widths):

.. math::

    \mu \sim N(0, I),\quad
    v_i \sim N(\mu, V_1),\quad
    r_{ij} \sim N(v_i, V_2),\quad
    z_{ijk} \sim N(r_{ij}, V_3)

with diagonal V_l, one variance for each group of alike coefficients. A deployment says of its z what its own
data say, a Gaussian likelihood of precision J and vector h, which may be singular: two runs determine few
combinations, and a whole set most.

Notes
-----
Sums run up the tree and means down (Gaussian belief propagation, exact on a tree; Pearl 1988). Integrating a
child x of its parent p out, with :math:`L = J + V^{-1}`:

.. math::

    J_p \leftarrow J_p + J L^{-1} V^{-1},\quad h_p \leftarrow h_p + V^{-1} L^{-1} h,\quad
    \log Z \leftarrow \log Z + (h^T L^{-1} h - \log|L| - \log|V|) / 2

and back, :math:`x | p \sim N(L^{-1}(h + V^{-1} p), L^{-1})`. The variances maximise the likelihood by
expectation-maximisation (Laird & Ware 1982, Biometrics 38:963), each with a scaled inverse chi-squared prior
worth :data:`WORTH` differences, so that a level with few members keeps a plausible size.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.known import Information

__all__ = ["LEVELS", "Observed", "Population", "learn"]

LEVELS = ("vehicle", "refit", "power-up")
"""What coefficients vary with, from the root down."""
EXPECTED = (1.0, 0.1, 0.02)
"""Shares of the physical widths by which they are expected to vary with each, before any fleet is seen."""
WORTH = 2.0
"""Differences that this expectation is worth."""
ROUNDS, STILL = 60, 0.02
"""Rounds of expectation-maximisation at most; change of a log variance below which they end."""


@dataclass(frozen=True, eq=False)
class Observed:
    """What one deployment's own data say of its z; J (K, K), h (K,)."""

    vehicle: str
    refit: str
    information: Information


@dataclass(frozen=True, eq=False)
class Population:
    """A fleet's variances, and what all but each vehicle say of the fleet's mean.

    Attributes
    ----------
    variances : (3, K) array
        Of the differences at each of :data:`LEVELS`.
    total : Information
        Of the fleet's mean, its prior included.
    each : dict
        Vehicle -> its part of that.
    log_likelihood : float
        With the variances' prior, up to a constant.
    rounds : int
        Of expectation-maximisation.
    """

    variances: FloatArray
    total: Information
    each: dict[str, Information]
    log_likelihood: float
    rounds: int = 0

    def expected(self, vehicle: str, past: Iterable[Observed], refit: str) -> tuple[FloatArray, FloatArray]:
        """Return mean (K,) and covariance (K, K) of the next deployment's z.

        Parameters
        ----------
        vehicle : str
            May be none of the fleet's.
        past : iterable of Observed
            The same vehicle's deployments before.
        refit : str
            Its refit: one of the past, or another.
        """
        V = self.variances
        known = self.each.get(vehicle)
        others = self.total if known is None else _minus(self.total, known)
        mean, P = _moments(others)
        P = P + np.diag(V[0])
        branches: dict[str, list[Information]] = defaultdict(list)
        for one in past:
            branches[one.refit].append(one.information)
        own = branches.pop(refit, [])
        elsewhere = [
            _up(_summed([_up(i, V[2]).told for i in leaves]), V[1]).told for leaves in branches.values()
        ]
        mean, P = _updated(mean, P, elsewhere)
        mean, P = _updated(mean, P + np.diag(V[1]), [_up(i, V[2]).told for i in own])
        return mean, P + np.diag(V[2])


@dataclass(frozen=True, eq=False)
class _Passed:
    """A node's message to its parent, with what the way down needs: ``x | p ~ N(G p + g, R)``."""

    told: Information
    G: FloatArray
    g: FloatArray
    R: FloatArray
    score: float


def learn(
    observed: Sequence[Observed], groups: IndexArray, variances: FloatArray | None = None
) -> Population:
    """Learn the variances of a fleet.

    Parameters
    ----------
    observed : sequence of Observed
        One for each deployment, all with the same K coefficients.
    groups : (K,) array
        Number of the group that each coefficient shares its variances with.
    variances : (3, K) array, optional
        Those found from the same deployments before.
    """
    if variances is not None:
        return _round(variances, observed, groups)[0]
    start = np.square(EXPECTED)[:, None] * np.ones((1, len(groups)))
    found = Population(start, Information(np.eye(len(groups)), np.zeros(len(groups))), {}, -np.inf)
    for turn in range(1, ROUNDS + 1):
        scored, squares, counts = _round(found.variances, observed, groups)
        renewed = np.empty_like(start)
        for level, (square, count) in enumerate(zip(squares, counts, strict=True)):
            inner = np.bincount(groups, square) + WORTH * EXPECTED[level] ** 2
            # the mode of its posterior: of count differences of each member, and of the prior
            renewed[level] = (inner / (count * np.bincount(groups) + WORTH + 2.0))[groups]
        moved = np.abs(np.log(renewed / found.variances)).max()
        found = replace(scored, variances=renewed, rounds=turn)
        if moved < STILL:
            break
    scored, _, _ = _round(found.variances, observed, groups)
    return replace(scored, rounds=found.rounds)


def _round(
    V: FloatArray, observed: Sequence[Observed], groups: IndexArray
) -> tuple[Population, FloatArray, tuple[int, int, int]]:
    """Go up and down the tree once; return expected squares of all differences (3, K), and how many."""
    tree: dict[str, dict[str, list[_Passed]]] = defaultdict(lambda: defaultdict(list))
    for one in observed:
        tree[one.vehicle][one.refit].append(_up(one.information, V[2]))
    size = V.shape[1]
    middle = {
        vehicle: {
            refit: _up(_summed([leaf.told for leaf in leaves]), V[1]) for refit, leaves in refits.items()
        }
        for vehicle, refits in tree.items()
    }
    top = {
        vehicle: _up(_summed([one.told for one in refits.values()]), V[0])
        for vehicle, refits in middle.items()
    }
    total = _summed([Information(np.eye(size), np.zeros(size)), *(one.told for one in top.values())])
    mean, P = _moments(total)
    nodes = [
        *top.values(),
        *(one for refits in middle.values() for one in refits.values()),
        *(leaf for refits in tree.values() for leaves in refits.values() for leaf in leaves),
    ]
    score = sum(one.score for one in nodes) + 0.5 * (
        total.vector @ mean - np.linalg.slogdet(total.precision)[1]
    )
    squares = np.zeros_like(V)
    for vehicle, at in top.items():
        there = _down(at, mean, P, squares[0])
        for refit, inner in middle[vehicle].items():
            here = _down(inner, *there, squares[1])
            for leaf in tree[vehicle][refit]:
                _down(leaf, *here, squares[2])
    counts = len(top), sum(map(len, middle.values())), len(observed)
    score += _log_prior(V, groups)
    return Population(V, total, {name: one.told for name, one in top.items()}, float(score)), squares, counts


def _log_prior(V: FloatArray, groups: IndexArray) -> float:
    """Scaled inverse chi-squared, for one member of each group."""
    _, first = np.unique(groups, return_index=True)
    v, expected = V[:, first], np.square(EXPECTED)[:, None]
    return float(-np.sum((0.5 * WORTH + 1.0) * np.log(v) + 0.5 * WORTH * expected / v))


def _up(own: Information, variance: FloatArray) -> _Passed:
    """Integrate a node out whose differences from its parent have that variance (K,)."""
    L = own.precision + np.diag(1.0 / variance)
    factor = cho_factor(L)
    R = np.asarray(cho_solve(factor, np.eye(len(L))))
    G = R / variance
    g = R @ own.vector
    J = own.precision @ G
    log_L = 2.0 * np.log(np.diag(factor[0])).sum()
    score = 0.5 * (own.vector @ g - log_L - np.log(variance).sum())
    return _Passed(Information(0.5 * (J + J.T), g / variance), G, g, R, float(score))


def _down(
    node: _Passed, mean: FloatArray, P: FloatArray, squares: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a node's mean and covariance from its parent's; add the expected squares of the difference."""
    own = node.G @ mean + node.g
    off = node.G - np.eye(len(mean))
    squares += (own - mean) ** 2 + np.diag(node.R) + ((off @ P) * off).sum(axis=1)
    return own, node.R + node.G @ P @ node.G.T


def _updated(mean: FloatArray, P: FloatArray, told: Sequence[Information]) -> tuple[FloatArray, FloatArray]:
    """Return a Gaussian with what is told of it."""
    if not told:
        return mean, P
    J = np.asarray(np.linalg.inv(P), float)
    return _moments(_summed([Information(J, J @ mean), *told]))


def _moments(of: Information) -> tuple[FloatArray, FloatArray]:
    P = np.asarray(cho_solve(cho_factor(of.precision), np.eye(len(of.vector))))
    P = 0.5 * (P + P.T)
    return P @ of.vector, P


def _summed(told: Sequence[Information]) -> Information:
    J, h = (np.asarray(np.sum(parts, axis=0)) for parts in zip(*told, strict=True))
    return Information(J, h)


def _minus(total: Information, part: Information) -> Information:
    return Information(total.precision - part.precision, total.vector - part.vector)
