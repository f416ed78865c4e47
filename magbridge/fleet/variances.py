"""How far a fleet's members differ: variances, shapes of refits, and the statistics to estimate them.

The equations are those of :mod:`.hierarchy`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from magbridge.arrays import FloatArray, IndexArray

__all__ = [
    "FLEET_LEVELS",
    "NO_SHAPES",
    "Shapes",
    "Spread",
    "Sums",
    "Variances",
    "log_prior",
    "renewed",
    "spreads_of",
]

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
