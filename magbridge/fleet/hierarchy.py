r"""Model how coefficients vary between vehicles, between refits, and between power-ups.

The model is a tree of Gaussian random effects. z are the K coefficients, in units of their physical prior
standard deviations:

.. math::

    \mu \sim N(0, I),\quad
    v_i \sim N(\mu, V_1),\quad
    r_{ij} \sim N(v_i, V_2),\quad
    z_{ijk} \sim N(r_{ij}, V_3)

with diagonal V_l and one variance for each group of similar coefficients. If the directions in which a refit
moves the coefficients of vehicle i are known, :math:`r_{ij} \sim N(v_i, V_2 + D_i U D_i^T)`. The columns of
D_i are these directions (shapes), and the diagonal U holds one variance for each group of shapes. The data of
a deployment give a Gaussian likelihood of its z with precision J and vector h. J may be singular: two runs
determine few combinations of coefficients, ten runs most.

Notes
-----
Messages pass up the tree and means down (Gaussian belief propagation, exact on a tree; Pearl 1988).
A child x differs from its parent p by a difference of covariance S. With :math:`L = J + S^{-1}`, integrating
over x gives the message to the parent:

.. math::

    J_p \leftarrow J_p + J L^{-1} S^{-1},\quad h_p \leftarrow h_p + S^{-1} L^{-1} h

On the way back, :math:`x | p \sim N(L^{-1}(h + S^{-1} p), L^{-1})`. A difference d is a sum of parts B b.
Q is the covariance of b, and (Q, B) is (V, I) or (U, D). The contribution of a part is
:math:`b | d \sim N(Q B^T S^{-1} d,\ Q - Q B^T S^{-1} B Q)`. Expectation-maximisation estimates the variances
(Laird & Ware 1982, Biometrics 38:963). Each variance has a scaled inverse chi-squared prior, with the weight
of :data:`.PRIOR_DIFFERENCES` differences, so that it stays plausible at a level with few members.
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
"""Levels of the tree, from the root down: coefficients vary between the members of each level."""
VARIATION_FRACTIONS = (1.0, 0.1, 0.02)
"""Prior standard deviation at each level, as a fraction of the coefficients' physical widths."""
PRIOR_DIFFERENCES = 2.0
"""Weight of the prior of a variance, in numbers of observed differences."""
MAX_EM_ITERATIONS = 60
"""Largest number of iterations of expectation-maximisation."""
MAX_LOG_CHANGE = 0.02
"""Largest change of a log variance at which the iterations end."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Directions in which refits move coefficients together."""

    of: Mapping[str, FloatArray]
    """Vehicle -> D (K, s); a vehicle that is not listed has none."""
    groups: IndexArray
    """Number of the group of each column of D, (s,); the columns of a group share a variance."""
    rest: FloatArray | float = VARIATION_FRACTIONS[1]
    """Prior standard deviation between refits in addition to D, (K,), in physical widths."""

    def expected(self, K: int) -> FloatArray:
        """Return the prior standard deviations at each level, (3, K), in physical widths."""
        vehicle, _, power_up = VARIATION_FRACTIONS
        return np.stack([np.full(K, vehicle), np.broadcast_to(self.rest, K), np.full(K, power_up)])


NO_SHAPES = Shapes({}, np.zeros(0, np.intp))
"""Default for fleets without known shapes."""


class Variances(NamedTuple):
    """Variances of the differences between the members of a level and their parents."""

    own: FloatArray
    """Variance of each coefficient at each of :data:`FLEET_LEVELS`, (3, K)."""
    shaped: FloatArray
    """Variance of the amplitude of each shape from refit to refit, (s,)."""

    @classmethod
    def expected(cls, K: int, shapes: Shapes) -> Variances:
        """Return the prior variances, before any data of a fleet."""
        return cls(np.square(shapes.expected(K)), np.full(len(shapes.groups), VARIATION_FRACTIONS[1] ** 2))


class _Spread:
    """Covariance S of a difference, its inverse W, and the parts (Q, B) of ``S = sum B diag(Q) B^T``."""

    def __init__(self, *parts: tuple[FloatArray, FloatArray]) -> None:
        self.parts = parts
        self.S: FloatArray = np.asarray(sum((B * Q) @ B.T for Q, B in parts))
        self.W = covariance_of(self.S)


def _spreads(variances: Variances, shapes: Shapes, vehicle: str) -> tuple[_Spread, ...]:
    """Return the spreads of vehicle about fleet, refit about vehicle, and power-up about refit."""
    identity = np.eye(variances.own.shape[1])
    by_vehicle, by_refit, by_power_up = ((row, identity) for row in variances.own)
    D = shapes.of.get(vehicle)
    shaped = () if D is None else ((variances.shaped, D),)
    return _Spread(by_vehicle), _Spread(by_refit, *shaped), _Spread(by_power_up)


class _Sums:
    """Sums and counts of the expected squares of differences (3, K) and shape amplitudes (s,)."""

    def __init__(self, K: int, s: int) -> None:
        self.own, self.shaped = np.zeros((len(FLEET_LEVELS), K)), np.zeros(s)
        self.counts, self.refits = [0] * len(FLEET_LEVELS), 0

    def add(self, level: int, dd: FloatArray, spread: _Spread) -> None:
        """Add a difference d at a level, given `dd` (K, K), the expectation of d d^T."""
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
        """Return the posterior mode of the variances; `groups` (K,) numbers the group of each coefficient."""

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
    """Information about the coefficients z of one deployment, from its own data only."""

    vehicle: str
    refit: str
    information: GaussianInformation


@dataclass(frozen=True, eq=False)
class Population:
    """Fitted model of a fleet: variances, and the information about the fleet's mean."""

    variances: Variances
    """Variances of the differences at each of :data:`.FLEET_LEVELS`."""
    shapes: Shapes
    """Directions in which refits move the coefficients of each vehicle."""
    total: GaussianInformation
    """Posterior information about the fleet's mean, including the prior."""
    each: dict[str, GaussianInformation]
    """Vehicle -> its contribution to `total`."""

    def expected(
        self, vehicle: str, observed: Iterable[Observed], refit: str
    ) -> tuple[FloatArray, FloatArray]:
        """Predict z of the next deployment of a vehicle: return its mean (K,) and covariance (K, K).

        The vehicle may be new to the fleet. `observed` are its earlier deployments; `refit` may be one of
        their refits, or a new one.
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
    """Message of a node x to its parent p, and the terms of ``x | p ~ N(G p + g, R)`` for the way back."""

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
    """Estimate the variances of a fleet from its deployments, all with the same K coefficients.

    `groups` (K,) is the number of each coefficient's group; coefficients of a group share their variances.
    `shapes` are the directions in which refits move coefficients. If `variances` are given, they are used and
    not estimated.
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
    """Pass messages up the tree and moments down; return the population and the sums for the M-step.

    The key of a leaf is (vehicle, refit, number of the deployment); a parent's key lacks the last element.
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
    """Return mean and covariance of N(mean, P) after adding independent information about it."""
    if not evidence:
        return mean, P
    J = covariance_of(P)
    return _moments(reduce(add, evidence, GaussianInformation(J, J @ mean)))


def _moments(information: GaussianInformation) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a Gaussian from its precision and vector."""
    P = covariance_of(information.precision)
    return P @ information.vector, P
