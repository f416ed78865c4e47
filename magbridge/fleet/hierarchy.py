r"""How coefficients vary from vehicle to vehicle, from refit to refit, and from one power-up to the next.

A tree of Gaussian random effects over the coefficients z (K of them, in units of their physical widths):

.. math::

    \mu \sim N(0, I),\quad
    v_i \sim N(\mu, V_1),\quad
    r_{ij} \sim N(v_i, V_2),\quad
    z_{ijk} \sim N(r_{ij}, V_3)

with diagonal V_l, one variance for each group of similar coefficients. Where it is known how a refit moves a
vehicle's coefficients together, :math:`r_{ij} \sim N(v_i, V_2 + D_i U D_i^T)`: the columns of D_i are such
shapes, and U holds a variance for each group of them. The data of a deployment give a Gaussian likelihood of
its z, of precision J and vector h. J may be singular: two runs determine few combinations, and ten most.

Notes
-----
Messages pass up the tree and means down (Gaussian belief propagation, exact on a tree; Pearl 1988).
Integrating a child x of its parent p out, with S the covariance of its difference and
:math:`L = J + S^{-1}`:

.. math::

    J_p \leftarrow J_p + J L^{-1} S^{-1},\quad h_p \leftarrow h_p + S^{-1} L^{-1} h

and back, :math:`x | p \sim N(L^{-1}(h + S^{-1} p), L^{-1})`. A difference d splits into what each of its
parts, with the covariance Q and the shape B (V and I, or U and D), contributes:
:math:`b | d \sim N(Q B^T S^{-1} d,\ Q - Q B^T S^{-1} B Q)`. The variances maximise the likelihood by
expectation-maximisation (Laird & Ware 1982, Biometrics 38:963), each with a scaled inverse chi-squared prior
worth :data:`.PRIOR_DIFFERENCES` differences, so that a level with few members keeps a plausible size.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.information import GaussianInformation, covariance_of

FLEET_LEVELS = ("vehicle", "refit", "power-up")
"""Levels of the tree at which coefficients vary, from the root down."""
VARIATION_FRACTIONS = (1.0, 0.1, 0.02)
"""Fractions of the physical widths by which they are expected to vary with each, before any fleet is seen."""
PRIOR_DIFFERENCES = 2.0
"""Differences that this expectation is worth."""
MAX_EM_ITERATIONS = 60
"""Iterations of expectation-maximisation at most."""
MAX_LOG_CHANGE = 0.02
"""Change of every log variance below which the iterations end."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Directions in which refits move coefficients together."""

    of: Mapping[str, FloatArray]
    """Vehicle -> D (K, s); a vehicle that is not listed has none."""
    groups: IndexArray
    """Group with which each column shares its variance, (s,)."""
    rest: FloatArray | float = VARIATION_FRACTIONS[1]
    """Expected variation of each coefficient with refits besides D, (K,), in physical widths."""

    def expected(self, K: int) -> FloatArray:
        """Return the expected variation of coefficients (3, K), as fractions, before any fleet is seen."""
        vehicle, _, power_up = VARIATION_FRACTIONS
        return np.stack([np.full(K, vehicle), np.broadcast_to(self.rest, K), np.full(K, power_up)])


NO_SHAPES = Shapes({}, np.zeros(0, np.intp))
"""Nothing is known of how refits move coefficients."""


class Variances(NamedTuple):
    """Variances of the differences between members and their parents."""

    own: FloatArray
    """Variance of each coefficient at each of :data:`FLEET_LEVELS`, (3, K)."""
    shaped: FloatArray
    """Variance of the amplitude of each shape from refit to refit, (s,)."""

    @classmethod
    def expected(cls, K: int, shapes: Shapes) -> Variances:
        """Return the variances that are expected before any fleet is seen."""
        return cls(np.square(shapes.expected(K)), np.full(len(shapes.groups), VARIATION_FRACTIONS[1] ** 2))


class _Spread:
    """Covariance S of a difference, its inverse W, and the parts (Q, B) of ``S = sum B diag(Q) B^T``."""

    def __init__(self, *parts: tuple[FloatArray, FloatArray]) -> None:
        self.parts = parts
        self.S: FloatArray = np.asarray(sum((B * Q) @ B.T for Q, B in parts))
        self.W = covariance_of(self.S)


def _spreads(variances: Variances, shapes: Shapes, vehicle: str) -> tuple[_Spread, ...]:
    """Return how a vehicle differs from the fleet, its refits from it, and power-ups from their refit."""
    identity = np.eye(variances.own.shape[1])
    by_vehicle, by_refit, by_power_up = ((row, identity) for row in variances.own)
    D = shapes.of.get(vehicle)
    shaped = () if D is None else ((variances.shaped, D),)
    return _Spread(by_vehicle), _Spread(by_refit, *shaped), _Spread(by_power_up)


class _Sums:
    """Expected squares of the differences (3, K) and of the shapes' amplitudes (s,), and their numbers."""

    def __init__(self, K: int, s: int) -> None:
        self.own, self.shaped = np.zeros((len(FLEET_LEVELS), K)), np.zeros(s)
        self.counts, self.refits = [0] * len(FLEET_LEVELS), 0

    def add(self, level: int, dd: FloatArray, spread: _Spread) -> None:
        """Count a difference d with the expectation `dd` (K, K) of d d^T."""
        squares = []
        for Q, B in spread.parts:
            # E[b^2] = Q + diag(Y (dd - S) Y^T) with the gain Y = Q B^T S^-1
            Y = (Q[:, None] * B.T) @ spread.W
            squares.append(Q + (Y @ (dd - spread.S) * Y).sum(axis=1))
        self.counts[level] += 1
        self.own[level] += squares[0]
        if len(squares) > 1:
            self.refits += 1
            self.shaped += squares[1]

    def maximised(self, groups: IndexArray, shapes: Shapes) -> Variances:
        """Return the mode of the variances' posterior; `groups` (K,) of coefficients share a variance."""

        def mode(squares: FloatArray, count: int, member: IndexArray, expected: FloatArray) -> FloatArray:
            members = np.bincount(member)
            prior = PRIOR_DIFFERENCES * np.bincount(member, expected**2) / members
            inner = np.bincount(member, squares) + prior
            return np.asarray((inner / (count * members + PRIOR_DIFFERENCES + 2.0))[member])

        rows = zip(self.own, self.counts, shapes.expected(len(groups)), strict=True)
        own = [mode(squares, count, groups, size) for squares, count, size in rows]
        sizes = np.full(len(shapes.groups), VARIATION_FRACTIONS[1])
        return Variances(np.array(own), mode(self.shaped, self.refits, shapes.groups, sizes))


@dataclass(frozen=True, eq=False)
class Observed:
    """Information about the z of one deployment from its own data."""

    vehicle: str
    refit: str
    information: GaussianInformation


@dataclass(frozen=True, eq=False)
class Population:
    """A fleet's variances, and the information about the fleet's mean."""

    variances: Variances
    """Variances of the differences at each of :data:`.FLEET_LEVELS`."""
    shapes: Shapes
    """Directions in which refits move the coefficients of each vehicle."""
    total: GaussianInformation
    """Posterior of the fleet's mean, its prior included."""
    each: dict[str, GaussianInformation]
    """Vehicle -> its part of `total`."""

    def expected(
        self, vehicle: str, observed: Iterable[Observed], refit: str
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean (K,) and covariance (K, K) of the next deployment's z of a vehicle, known or not.

        `observed` are the same vehicle's deployments before; `refit` is one of theirs, or another.
        """
        by_vehicle, by_refit, by_power_up = _spreads(self.variances, self.shapes, vehicle)
        others = self.total
        if vehicle in self.each:
            known = self.each[vehicle]
            others = GaussianInformation(others.precision - known.precision, others.vector - known.vector)
        mean, P = _moments(others)
        branches: dict[str, list[GaussianInformation]] = defaultdict(list)
        for one in observed:
            branches[one.refit].append(_Message(one.information, by_power_up).evidence)
        own = branches.pop(refit, [])
        elsewhere = [_Message(reduce(add, leaves), by_refit).evidence for leaves in branches.values()]
        mean, P = _updated(mean, P + by_vehicle.S, elsewhere)
        mean, P = _updated(mean, P + by_refit.S, own)
        return mean, P + by_power_up.S


class _Message:
    """A node's message to its parent, with what the way down needs: ``x | p ~ N(G p + g, R)``."""

    def __init__(self, information: GaussianInformation, spread: _Spread) -> None:
        self.spread = spread
        self.R = covariance_of(information.precision + spread.W)
        self.G, self.g = self.R @ spread.W, self.R @ information.vector
        J = information.precision @ self.G
        self.evidence = GaussianInformation(0.5 * (J + J.T), spread.W @ self.g)


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
    found, sums = _pass_messages(variances or Variances.expected(len(groups), shapes), observed, shapes)
    for _ in range(0 if variances else MAX_EM_ITERATIONS):
        old, new = found.variances, sums.maximised(groups, shapes)
        found, sums = _pass_messages(new, observed, shapes)
        change = np.log(np.append(new.own, new.shaped) / np.append(old.own, old.shaped))
        if np.abs(change).max() < MAX_LOG_CHANGE:
            break
    return found


def _pass_messages(
    variances: Variances, observed: Sequence[Observed], shapes: Shapes
) -> tuple[Population, _Sums]:
    """Pass messages up the tree and means down; return the population and the expected squares.

    A node's key is (vehicle, refit, number of the deployment), its parent's key the same without the last.
    """
    K = variances.own.shape[1]
    spreads = {one.vehicle: _spreads(variances, shapes, one.vehicle) for one in observed}
    inner: dict[tuple[str, ...], GaussianInformation] = {
        (one.vehicle, one.refit, str(number)): one.information for number, one in enumerate(observed)
    }
    levels: list[dict[tuple[str, ...], _Message]] = []  # from the root down
    for level in reversed(range(len(FLEET_LEVELS))):
        messages = {key: _Message(one, spreads[key[0]][level]) for key, one in inner.items()}
        levels.insert(0, messages)
        inner = {}
        for key, message in messages.items():
            parent = key[:-1]
            inner[parent] = inner[parent] + message.evidence if parent in inner else message.evidence
    none = GaussianInformation(np.zeros((K, K)), np.zeros(K))
    total = inner.get((), none) + GaussianInformation(np.eye(K), np.zeros(K))
    moments: dict[tuple[str, ...], tuple[FloatArray, FloatArray]] = {(): _moments(total)}
    sums = _Sums(K, len(shapes.groups))
    for level, messages in enumerate(levels):
        for key, message in messages.items():
            mean, P = moments[key[:-1]]
            own = message.G @ mean + message.g
            moments[key] = own, message.R + message.G @ P @ message.G.T
            # d = x - p has the mean (G - I) p + g
            off = message.G - np.eye(K)
            dd = np.outer(own - mean, own - mean) + message.R + off @ P @ off.T
            sums.add(level, dd, message.spread)
    each = {vehicle: message.evidence for (vehicle,), message in levels[0].items()}
    return Population(variances, shapes, total, each), sums


def _updated(
    mean: FloatArray, P: FloatArray, evidence: Sequence[GaussianInformation]
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a Gaussian after independent information about it."""
    if not evidence:
        return mean, P
    J = covariance_of(P)
    return _moments(reduce(add, evidence, GaussianInformation(J, J @ mean)))


def _moments(information: GaussianInformation) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a Gaussian from its precision and vector."""
    P = covariance_of(information.precision)
    return P @ information.vector, P
