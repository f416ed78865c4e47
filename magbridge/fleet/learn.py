"""From calibrations of single deployments to what their fleet expects of the next.

All deployments are brought to one scale of the positions and one F_0 (:func:`.rescaling`), and to units of
the coefficients' physical widths (:mod:`magbridge.estimation.priors`). Coefficients that share a
monomial and are of one kind (A or T; for the constant: gain, soft iron, hard iron) share their variances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.pose import Known, Mounting, rescaling
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents
from magbridge.errors import DataError
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import polynomial_prior
from magbridge.fleet.hierarchy import Observed, Population, learn
from magbridge.fleet.shapes import shape_groups, shapes_of
from magbridge.fleet.variances import NO_SHAPES, Shapes, Variances

__all__ = ["Fleet", "Lesson", "learn_fleet", "packed", "unpacked"]

REST = 0.01
"""Share of the physical widths that a refit of a mounted mass moves besides what a dipole does."""
NOWHERE: Mapping[str, Mapping[str, Mounting]] = {}
REFERENCE_FIELD_NT = 50_000.0
"""F_0 that a fleet's coefficients refer to, nT."""


class Lesson(NamedTuple):
    """One deployment's calibration as its own data determine it, without any prior.

    `time` is when it began, s since 1970; `noise` that of a sample, nT; the others as in :class:`.Known` and
    :class:`.GaussianInformation`.
    """

    vehicle: str
    refit: str
    deployment: str
    time: float
    parameters: tuple[Parameter, ...]
    exponents: tuple[Exponents, ...]
    field: float
    noise: float
    information: GaussianInformation

    def brought(self, parameters: tuple[Parameter, ...], basis: FloatArray) -> GaussianInformation:
        """Return the information of z: with ``c_own = B z``, ``J = B^T I B`` and ``h = B^T i``.

        Parameters
        ----------
        parameters : tuple of Parameter
            The scales of the positions to bring it to; the F_0 is :data:`REFERENCE_FIELD_NT`.
        basis : (9 m, q) array
            nT, coefficients there of z.
        """
        B = rescaling(self.exponents, parameters, self.parameters, REFERENCE_FIELD_NT, self.field) @ basis
        return GaussianInformation(B.T @ self.information.precision @ B, B.T @ self.information.vector)


def packed(evidence: GaussianInformation | None) -> dict[str, bytes]:
    """Return information as columns of the catalogue: little-endian doubles, row by row; empty: none."""
    if evidence is None:
        return {"precision": b"", "vector": b""}
    parts = {"precision": evidence.precision, "vector": evidence.vector}
    return {name: np.asarray(part, "<f8").tobytes() for name, part in parts.items()}


def unpacked(row: Mapping[str, bytes]) -> GaussianInformation:
    """Return the information that :func:`packed` has encoded."""
    vector = np.frombuffer(row["vector"], "<f8")
    return GaussianInformation(np.frombuffer(row["precision"], "<f8").reshape(len(vector), -1), vector)


@dataclass(frozen=True, eq=False)
class Fleet:
    """What a fleet of vehicles with the same moving masses has taught."""

    parameters: tuple[Parameter, ...]
    """The scale that all are brought to: the whole range seen."""
    exponents: tuple[Exponents, ...]
    """The m monomials."""
    basis: FloatArray
    """(9 m, 9 m), nT; coefficients of z, which is in units of the physical widths."""
    population: Population
    mounted: Mapping[str, Mapping[str, Mounting]]
    """Vehicle -> where its masses sit."""
    lessons: tuple[Lesson, ...]
    """In the order of time."""
    observed: tuple[Observed, ...]
    """Information of z."""

    def known(self, vehicle: str, refit: str, before_time: float = np.inf) -> Known:
        """Return the prediction of a vehicle's next deployment.

        Parameters
        ----------
        vehicle : str
            May be new to the fleet.
        refit : str
            The refit it flies with: one it had before, or a new one.
        before_time : float
            s since 1970: only its own deployments that began before count.
        """
        past = [
            seen
            for lesson, seen in zip(self.lessons, self.observed, strict=True)
            if lesson.vehicle == vehicle and lesson.time < before_time
        ]
        mean, P = self.population.expected(vehicle, past, refit)
        E = self.basis
        return Known(self.parameters, self.exponents, REFERENCE_FIELD_NT, E @ mean, E @ P @ E.T)


def learn_fleet(
    lessons: Sequence[Lesson],
    mounted: Mapping[str, Mapping[str, Mounting]] = NOWHERE,
    variances: Variances | None = None,
) -> Fleet:
    """Learn from deployments of vehicles whose masses have the same names, fitted to the same order.

    Parameters
    ----------
    lessons : sequence of Lesson
        One for each deployment.
    mounted : mapping
        Vehicle -> where its masses sit, of those of which all are known.
    variances : Variances, optional
        Those that the same lessons have given before.

    Raises
    ------
    DataError
        There is none.
    """
    if not lessons:
        raise DataError("nothing to learn from: no deployment of such a vehicle has been calibrated")
    lessons = sorted(lessons, key=lambda one: (one.time, one.vehicle, one.deployment))
    exponents = lessons[0].exponents
    parameters = _whole_range(lessons)
    family = polynomial_prior(exponents, tuple(one.name for one in parameters), REFERENCE_FIELD_NT)
    basis = np.asarray(family.E * family.widths(family.centre))
    with threadpool_limits(1, "blas"):
        observed = tuple(Observed(one.vehicle, one.refit, one.brought(parameters, basis)) for one in lessons)
        groups = _groups(exponents)
        shapes = _shapes(observed, groups, mounted, exponents, parameters, basis)
        population = learn(observed, groups, shapes, variances)
    return Fleet(parameters, exponents, basis, population, mounted, tuple(lessons), observed)


def _shapes(
    observed: Sequence[Observed],
    groups: IndexArray,
    mounted: Mapping[str, Mapping[str, Mounting]],
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
    basis: FloatArray,
) -> Shapes:
    """Return how refits move z, about where each vehicle is before the variances are estimated."""
    names = {one.name for one in parameters}
    whole = {vehicle: where for vehicle, where in mounted.items() if where.keys() == names}
    if not whole:
        return NO_SHAPES
    first = learn(observed, groups, variances=Variances.expected(len(groups), NO_SHAPES))
    found = {}
    for vehicle, where in whole.items():
        past = [one for one in observed if one.vehicle == vehicle]
        if not past:
            continue
        mean, P = first.expected(vehicle, past, past[-1].refit)
        D = shapes_of(where, exponents, parameters, REFERENCE_FIELD_NT, basis @ mean, basis @ P @ basis.T)
        found[vehicle] = np.asarray(np.linalg.solve(basis, D))
    moves = np.repeat([sum(powers) > 0 for powers in exponents], 9)
    return Shapes(found, shape_groups(len(parameters)), np.where(moves, REST, NO_SHAPES.rest))


def _whole_range(lessons: Sequence[Lesson]) -> tuple[Parameter, ...]:
    """Return the parameters, scaled to the range that any deployment saw."""
    whole = []
    for seen in zip(*(lesson.parameters for lesson in lessons), strict=True):
        low, high = min(one.low for one in seen), max(one.high for one in seen)
        half = (high - low) / 2 or seen[0].scale
        whole.append(Parameter(seen[0].name, seen[0].unit, low, high, (low + high) / 2, half))
    return tuple(whole)


def _groups(exponents: Sequence[Exponents]) -> IndexArray:
    """Return the number (9 m,) of the group whose variances each coefficient shares."""
    names: list[tuple[object, str]] = []
    for powers in exponents:
        moved = sum(power > 0 for power in powers)
        which: object = "cross" if moved > 1 else powers
        kinds = ["gain", *["soft"] * 5, *["T"] * 3] if not moved else [*["A"] * 6, *["T"] * 3]
        names += [(which, kind) for kind in kinds]
    order = {name: k for k, name in enumerate(dict.fromkeys(names))}
    return np.array([order[name] for name in names], np.intp)
