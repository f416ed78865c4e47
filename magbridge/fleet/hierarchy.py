r"""How coefficients vary from vehicle to vehicle, from refit to refit, and from one power-up to the next.

A tree of Gaussian random effects over the coefficients z (K of them, in units of their physical widths):

.. math::

    \mu \sim N(0, I),\quad
    v_i \sim N(\mu, V_1),\quad
    r_{ij} \sim N(v_i, V_2),\quad
    z_{ijk} \sim N(r_{ij}, V_3)

with diagonal V_l, one variance for each group of similar coefficients. Where it is known how a refit moves a
vehicle's coefficients together, :math:`r_{ij} \sim N(v_i, V_2 + D_i U D_i^T)`: the columns of D_i are such
shapes, and U holds a variance for each group of them. A deployment says of its z what its own
data say, a Gaussian likelihood of precision J and vector h, which may be singular: two runs determine few
combinations, and a whole set most.

Notes
-----
Sums run up the tree and means down (Gaussian belief propagation, exact on a tree; Pearl 1988). Integrating a
child x of its parent p out, with S the covariance of its difference and :math:`L = J + S^{-1}`:

.. math::

    J_p \leftarrow J_p + J L^{-1} S^{-1},\quad h_p \leftarrow h_p + S^{-1} L^{-1} h,\quad
    \log Z \leftarrow \log Z + (h^T L^{-1} h - \log|L| - \log|S|) / 2

and back, :math:`x | p \sim N(L^{-1}(h + S^{-1} p), L^{-1})`. A difference d splits into what each of its
parts, with the covariance Q and the shape B (V and I, or U and D), contributes:
:math:`b | d \sim N(Q B^T S^{-1} d,\ Q - Q B^T S^{-1} B Q)`. The variances maximise the likelihood by
expectation-maximisation (Laird & Ware 1982, Biometrics 38:963), each with a scaled inverse chi-squared prior
worth :data:`.PRIOR_DIFFERENCES` differences, so that a level with few members keeps a plausible size.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.information import GaussianInformation

FLEET_LEVELS = ("vehicle", "refit", "power-up")
"""What coefficients vary with, from the root down."""
VARIATION_FRACTIONS = (1.0, 0.1, 0.02)
"""Fractions of the physical widths by which they are expected to vary with each, before any fleet is seen."""
PRIOR_DIFFERENCES = 2.0
"""Differences that this expectation is worth."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """How refits move coefficients together."""

    of: Mapping[str, FloatArray]
    """Vehicle -> D (K, s); one that is not there has none."""
    groups: IndexArray
    """(s,): Number of the group that each column shares its variance with."""
    rest: FloatArray | float = VARIATION_FRACTIONS[1]
    """(K,): Fraction of the physical widths by which coefficients are expected to vary besides."""

    def expected(self, K: int) -> FloatArray:
        """Return the expected variation of coefficients (3, K), as fractions, before any fleet is seen."""
        return np.stack(
            [np.broadcast_to(size, K) for size in (VARIATION_FRACTIONS[0], self.rest, VARIATION_FRACTIONS[2])]
        )


class Variances(NamedTuple):
    """How far members differ from their parents."""

    own: FloatArray
    """(3, K): Of each coefficient, at each of :data:`FLEET_LEVELS`."""
    shaped: FloatArray
    """(s,): Variances of the amplitude of each shape, from refit to refit."""

    @classmethod
    def expected(cls, K: int, shapes: Shapes) -> Variances:
        """Return the prediction before any fleet is seen."""
        return cls(np.square(shapes.expected(K)), np.full(len(shapes.groups), VARIATION_FRACTIONS[1] ** 2))


class Spread(NamedTuple):
    """Covariance S of a difference, its inverse W, log determinant, and the parts it is made of: Q, B."""

    S: FloatArray
    W: FloatArray
    log_det: float
    parts: tuple[tuple[FloatArray, FloatArray], ...]


class Sums:
    """Expected squares of all differences at each level, and of all shapes' sizes; how many there are."""

    def __init__(self, K: int, s: int) -> None:
        self.own, self.shaped = np.zeros((len(FLEET_LEVELS), K)), np.zeros(s)
        self.counts = [0] * len(FLEET_LEVELS)
        self.refits = 0

    def add(self, level: int, dd: FloatArray, spread: Spread) -> None:
        """Count a difference whose expected d d^T is `dd` (K, K)."""
        self.counts[level] += 1
        (own, *shaped) = (
            q + ((Y := (q[:, None] * B.T) @ spread.W) @ (dd - spread.S) * Y).sum(axis=1)
            for q, B in spread.parts
        )
        self.own[level] += own
        for squares in shaped:
            self.shaped += squares
            self.refits += 1


NO_SHAPES = Shapes({}, np.zeros(0, np.intp))
"""Nothing is known of how refits move coefficients."""


def renewed(sums: Sums, groups: IndexArray, shapes: Shapes) -> Variances:
    """Return the mode of the variances' posterior, from differences of each member of groups (K,)."""

    def mode(squares: FloatArray, count: int, member: IndexArray, expected: FloatArray) -> FloatArray:
        members = np.bincount(member)
        inner = np.bincount(member, squares) + PRIOR_DIFFERENCES * np.bincount(member, expected**2) / members
        return np.asarray((inner / (count * members + PRIOR_DIFFERENCES + 2.0))[member])

    own = [
        mode(squares, count, groups, size)
        for squares, count, size in zip(sums.own, sums.counts, shapes.expected(len(groups)), strict=True)
    ]
    sizes = np.full(len(shapes.groups), VARIATION_FRACTIONS[1])
    return Variances(np.array(own), mode(sums.shaped, sums.refits, shapes.groups, sizes))


def spreads_of(variances: Variances, shapes: Shapes, vehicle: str) -> tuple[Spread, Spread, Spread]:
    """Return how a vehicle differs from the fleet, its refits from it, and power-ups from their refit."""
    D = shapes.of.get(vehicle)
    return (
        _spread(variances.own[0]),
        _spread(variances.own[1], *(() if D is None else ((variances.shaped, D),))),
        _spread(variances.own[2]),
    )


def _spread(diagonal: FloatArray, *shaped: tuple[FloatArray, FloatArray]) -> Spread:
    """Return ``S = diag(diagonal) + D diag(u) D^T`` for each u, D of `shaped`."""
    S, W, log_det = np.diag(diagonal), np.diag(1.0 / diagonal), float(np.log(diagonal).sum())
    for u, D in shaped:
        S = S + (D * u) @ D.T
        factor = cho_factor(S)
        W, log_det = cho_solve(factor, np.eye(len(S))), 2.0 * float(np.log(np.diag(factor[0])).sum())
    return Spread(S, np.asarray(W), log_det, ((diagonal, np.eye(len(diagonal))), *shaped))


def log_prior(variances: Variances, groups: IndexArray, shapes: Shapes) -> float:
    """Scaled inverse chi-squared, for one member of each of groups (K,)."""
    _, first = np.unique(groups, return_index=True)
    _, one = np.unique(shapes.groups, return_index=True)
    v = np.append(variances.own[:, first], variances.shaped[one])
    own = np.square(shapes.expected(len(groups)))[:, first]
    expected = np.append(own, np.full(len(one), VARIATION_FRACTIONS[1] ** 2))
    return float(
        -np.sum((0.5 * PRIOR_DIFFERENCES + 1.0) * np.log(v) + 0.5 * PRIOR_DIFFERENCES * expected / v)
    )


ROUNDS, STILL = 60, 0.02
"""Rounds of expectation-maximisation at most; change of a log variance below which they end."""


@dataclass(frozen=True, eq=False)
class Observed:
    """What one deployment's own data say of its z; J (K, K), h (K,)."""

    vehicle: str
    refit: str
    information: GaussianInformation


@dataclass(frozen=True, eq=False)
class Population:
    """A fleet's variances, and what all but each vehicle say of the fleet's mean."""

    variances: Variances
    """Variances of the differences at each of :data:`.FLEET_LEVELS`."""
    shapes: Shapes
    """How refits move the coefficients of each vehicle."""
    total: GaussianInformation
    """Posterior of the fleet's mean, its prior included."""
    each: dict[str, GaussianInformation]
    """Vehicle -> its part of that."""
    log_likelihood: float
    """With the variances' prior, up to a constant."""
    rounds: int = 0
    """Of expectation-maximisation."""

    def expected(
        self, vehicle: str, observed: Iterable[Observed], refit: str
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean (K,) and covariance (K, K) of the next deployment's z of a vehicle, known or not.

        `observed` are the same vehicle's deployments before; `refit` is one of theirs, or another.
        """
        by_vehicle, by_refit, by_power_up = spreads_of(self.variances, self.shapes, vehicle)
        known = self.each.get(vehicle)
        others = self.total if known is None else _minus(self.total, known)
        mean, P = _moments(others)
        P = P + by_vehicle.S
        branches: dict[str, list[GaussianInformation]] = defaultdict(list)
        for one in observed:
            branches[one.refit].append(_to_parent(one.information, by_power_up).evidence)
        own = branches.pop(refit, [])
        elsewhere = [_to_parent(_summed(leaves), by_refit).evidence for leaves in branches.values()]
        mean, P = _updated(mean, P, elsewhere)
        mean, P = _updated(mean, P + by_refit.S, own)
        return mean, P + by_power_up.S


@dataclass(frozen=True, eq=False)
class _Passed:
    """A node's message to its parent, with what the way down needs: ``x | p ~ N(G p + g, R)``."""

    evidence: GaussianInformation
    G: FloatArray
    g: FloatArray
    R: FloatArray
    score: float


def learn(
    observed: Sequence[Observed],
    groups: IndexArray,
    shapes: Shapes = NO_SHAPES,
    variances: Variances | None = None,
) -> Population:
    """Learn the variances of a fleet from its deployments, all with the same K coefficients.

    `groups` (K,) has the number of the group that each coefficient shares its variances with, `shapes` how
    refits move coefficients together. If `variances` are given, they are taken instead of learned.
    """
    start = variances or Variances.expected(len(groups), shapes)
    found, sums = _round(start, observed, groups, shapes)
    for turn in range(1, (0 if variances else ROUNDS) + 1):
        old = found.variances
        new = renewed(sums, groups, shapes)
        found, sums = _round(new, observed, groups, shapes)
        found = replace(found, rounds=turn)
        moved = np.log(np.append(new.own, new.shaped) / np.append(old.own, old.shaped))
        if np.abs(moved).max() < STILL:
            break
    return found


def _round(
    variances: Variances, observed: Sequence[Observed], groups: IndexArray, shapes: Shapes = NO_SHAPES
) -> tuple[Population, Sums]:
    """Go up and down the tree once."""
    K = len(groups)
    spreads = {one.vehicle: spreads_of(variances, shapes, one.vehicle) for one in observed}
    tree: dict[str, dict[str, list[_Passed]]] = defaultdict(lambda: defaultdict(list))
    for one in observed:
        tree[one.vehicle][one.refit].append(_to_parent(one.information, spreads[one.vehicle][2]))
    middle = {
        vehicle: {
            refit: _to_parent(_summed([leaf.evidence for leaf in leaves]), spreads[vehicle][1])
            for refit, leaves in refits.items()
        }
        for vehicle, refits in tree.items()
    }
    top = {
        vehicle: _to_parent(_summed([one.evidence for one in refits.values()]), spreads[vehicle][0])
        for vehicle, refits in middle.items()
    }
    total = _summed([GaussianInformation(np.eye(K), np.zeros(K)), *(one.evidence for one in top.values())])
    mean, P = _moments(total)
    score = 0.5 * (total.vector @ mean - np.linalg.slogdet(total.precision)[1])
    sums = Sums(K, len(shapes.groups))
    for vehicle, at in top.items():
        by = spreads[vehicle]
        score += at.score
        there = _to_child(at, mean, P, sums, 0, by[0])
        for refit, inner in middle[vehicle].items():
            score += inner.score
            here = _to_child(inner, *there, sums, 1, by[1])
            for leaf in tree[vehicle][refit]:
                score += leaf.score
                _to_child(leaf, *here, sums, 2, by[2])
    score += log_prior(variances, groups, shapes)
    each = {name: one.evidence for name, one in top.items()}
    return Population(variances, shapes, total, each, float(score)), sums


def _to_parent(information: GaussianInformation, spread: Spread) -> _Passed:
    """Integrate a node out whose difference from its parent has that covariance."""
    L = information.precision + spread.W
    factor = cho_factor(L)
    R = np.asarray(cho_solve(factor, np.eye(len(L))))
    G, g = R @ spread.W, R @ information.vector
    J = information.precision @ G
    log_L = 2.0 * np.log(np.diag(factor[0])).sum()
    score = 0.5 * (information.vector @ g - log_L - spread.log_det)
    return _Passed(GaussianInformation(0.5 * (J + J.T), spread.W @ g), G, g, R, float(score))


def _to_child(
    node: _Passed, mean: FloatArray, P: FloatArray, sums: Sums, level: int, spread: Spread
) -> tuple[FloatArray, FloatArray]:
    """Return a node's mean and covariance from its parent's; count the difference."""
    own = node.G @ mean + node.g
    off = node.G - np.eye(len(mean))
    sums.add(level, np.outer(own - mean, own - mean) + node.R + off @ P @ off.T, spread)
    return own, node.R + node.G @ P @ node.G.T


def _updated(
    mean: FloatArray, P: FloatArray, evidence: Sequence[GaussianInformation]
) -> tuple[FloatArray, FloatArray]:
    """Return a Gaussian with the message about it."""
    if not evidence:
        return mean, P
    J = np.asarray(np.linalg.inv(P), float)
    return _moments(_summed([GaussianInformation(J, J @ mean), *evidence]))


def _moments(information: GaussianInformation) -> tuple[FloatArray, FloatArray]:
    P = np.asarray(cho_solve(cho_factor(information.precision), np.eye(len(information.vector))))
    P = 0.5 * (P + P.T)
    return P @ information.vector, P


def _summed(evidence: Sequence[GaussianInformation]) -> GaussianInformation:
    total, *others = evidence
    for part in others:
        total = total + part
    return total


def _minus(total: GaussianInformation, part: GaussianInformation) -> GaussianInformation:
    return GaussianInformation(total.precision - part.precision, total.vector - part.vector)
