"""Estimate the model of a fleet from its calibrations, and predict the next deployment of a vehicle.

The coefficients of all deployments are converted to one scale of the mass positions and one reference field
F_0 (:func:`.rescaling`). z are these coefficients in units of their physical widths
(:mod:`magbridge.estimation.priors`). Coefficients share their variances if they have the same monomial and
kind: A or T, or for the constant monomial gain, soft iron or hard iron.

A deployment that differs significantly from the earlier ones of its vehicle is not a sample of what
overhauls and power-ups do. The model of the fleet omits it, so that one broken vehicle does not widen the
predictions of all others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.pose import LATENT, Known, Mounting, mass_columns, mounted_prior, rescaling
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents
from magbridge.errors import DataError
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import polynomial_prior
from magbridge.fleet.hierarchy import NO_SHAPES, Observed, Population, Shapes, Variances, learn

SHAPE_ITERATIONS = 4
SHAPE_KINDS = 3
"""Number of kinds of shapes of a mass: moment, susceptibility and position, with three components each."""


def shapes_of(
    mounted: Mapping[str, Mounting],
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
    field: float,
    mean: FloatArray,
    covariance: FloatArray,
) -> FloatArray:
    """Return the directions (shapes) in which refits move a vehicle's coefficients, (K, 9 n), nT.

    A refit changes the moment, the susceptibility and the position of each of the n masses. A shape is the
    derivative of the coefficients by one of these dipole parameters, times the parameter's prior standard
    deviation. The derivative by the position depends on the moment. Therefore a dipole l is first fitted to
    the posterior N(m, P) of the vehicle's coefficients:
    ``l = argmin (c(l) - m)^T P^-1 (c(l) - m) + l^T W^-1 l``, with the dipole's prior variances W. c(l) is
    linearised again in each iteration. `mean` (K,) is m, `covariance` (K, K) is P; for the other arguments
    see :class:`.Known`.
    """
    free = polynomial_prior(exponents, tuple(one.name for one in parameters), field)
    family = mounted_prior(free, exponents, parameters, mounted)
    weight = np.linalg.inv(covariance)
    for _ in range(SHAPE_ITERATIONS):
        prior = family.prior(family.centre)
        pull = prior.E.T @ weight
        z = np.asarray(np.linalg.solve(pull @ prior.E + prior.precision, pull @ (mean - prior.offset)))
        assert family.renew is not None
        family = family.renew(z)
    size, order = len(mean), max(map(sum, exponents))
    shapes = np.zeros((len(exponents), 9, len(mounted), 3 * SHAPE_KINDS))
    latents = z[size:].reshape(-1, LATENT), family.widths(family.centre)[size:].reshape(-1, LATENT)
    for i, ((name, mass), latent, width) in enumerate(zip(mounted.items(), *latents, strict=True)):
        k = [one.name for one in parameters].index(name)
        by = mass_columns(np.array(mass.at), np.array(mass.travel), parameters[k], order, latent) * width
        for n in range(order + 1):
            row = exponents.index(tuple(n * (j == k) for j in range(len(parameters))))
            shapes[row, :, i] = by[n, :, : 3 * SHAPE_KINDS]
    return shapes.reshape(size, -1)


def shape_groups(masses: int) -> IndexArray:
    """Return the group number of each shape, (9 n,): a group is one kind of one of the n masses."""
    return np.repeat(np.arange(SHAPE_KINDS * masses), 3)


UNEXPLAINED_FRACTION = 0.01
"""Prior standard deviation between refits that a mass's dipole does not explain, in physical widths."""
NO_MOUNTINGS: Mapping[str, Mapping[str, Mounting]] = {}
REFERENCE_FIELD_NT = 50_000.0
"""Reference field F_0 to which the coefficients of a fleet are converted, nT."""


class Lesson(NamedTuple):
    """Information about the coefficients of one deployment from its own data, without a prior.

    `time` is the start of the deployment, s since 1970, `noise` the 1-sigma of a sample, nT, `inputs` the
    SHA-256 of the logs. `given` is True for a calibration that was made elsewhere. For the other fields see
    :class:`.Known`.
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
    inputs: frozenset[str] = frozenset()
    sensor: str = ""
    given: bool = False

    def brought(self, parameters: tuple[Parameter, ...], basis: FloatArray) -> GaussianInformation:
        """Return the information about z, which has q elements.

        The coefficients of the deployment are ``c = B z``, so precision and vector become ``B^T J B`` and
        ``B^T h``. `basis` (9 m, q), nT, maps z to coefficients for the scales of `parameters` and the
        reference field :data:`REFERENCE_FIELD_NT`.
        """
        B = rescaling(self.exponents, parameters, self.parameters, REFERENCE_FIELD_NT, self.field) @ basis
        return GaussianInformation(B.T @ self.information.precision @ B, B.T @ self.information.vector)


def packed(evidence: GaussianInformation | None) -> dict[str, bytes]:
    """Encode information for the catalogue as little-endian doubles in row order; None gives empty bytes."""
    if evidence is None:
        return {"precision": b"", "vector": b""}
    parts = {"precision": evidence.precision, "vector": evidence.vector}
    return {name: np.asarray(part, "<f8").tobytes() for name, part in parts.items()}


def unpacked(row: Mapping[str, bytes]) -> GaussianInformation:
    """Decode the information that :func:`packed` has encoded."""
    vector = np.frombuffer(row["vector"], "<f8")
    return GaussianInformation(np.frombuffer(row["precision"], "<f8").reshape(len(vector), -1), vector)


@dataclass(frozen=True, eq=False)
class Fleet:
    """Model of a fleet of vehicles with the same moving masses."""

    parameters: tuple[Parameter, ...]
    """Common scale of the mass positions: the range that all deployments together cover."""
    exponents: tuple[Exponents, ...]
    """Exponents of the m monomials."""
    basis: FloatArray
    """Matrix from z, in physical widths, to coefficients, (9 m, 9 m), nT."""
    population: Population
    mounted: Mapping[str, Mapping[str, Mounting]]
    """Vehicle -> mounting positions of its masses."""
    lessons: tuple[Lesson, ...]
    """Deployments in the order of time."""
    observed: tuple[Observed, ...]
    """Information about z from each deployment, in the order of `lessons`."""
    changed: frozenset[int] = frozenset()
    """Indices of the deployments that differ significantly from the earlier ones of their vehicle.
    `population` omits them. In predictions they count as a refit of their own."""

    def known(self, vehicle: str, refit: str, before_time: float = np.inf) -> Known:
        """Predict the coefficients of the next deployment of a vehicle, which may be new to the fleet.

        `refit` may be an earlier refit of the vehicle, or a new one. The prediction uses only
        those deployments of the vehicle that began before `before_time` (s since 1970).
        """
        past = []
        for k, lesson in enumerate(self.lessons):
            if lesson.vehicle == vehicle and lesson.time < before_time:
                seen = self.observed[k]
                changed = k in self.changed
                past.append(replace(seen, refit=f"{CHANGED_PREFIX}{seen.refit}") if changed else seen)
        if past and past[-1].refit == f"{CHANGED_PREFIX}{refit}":  # the vehicle has not changed back
            refit = past[-1].refit
        return self.predicted(past, vehicle, refit)

    def predicted(self, observed: Sequence[Observed], vehicle: str, refit: str) -> Known:
        """Predict the coefficients of a vehicle's next deployment from its deployments `observed`."""
        mean, P = self.population.expected(vehicle, observed, refit)
        E = self.basis
        return Known(self.parameters, self.exponents, REFERENCE_FIELD_NT, E @ mean, E @ P @ E.T)


CHANGED_PREFIX = "changed: "
"""Prefix of the refit of a changed deployment."""
MAX_ROUNDS = 8
"""Largest number of times that a fleet is learned without the deployments found to have changed."""
SUSPICION_PROBABILITY = 0.05
"""Probability with which the first round omits an unchanged deployment. The first variances are those with
all changed deployments, which hide each other; the later rounds use :data:`FALSE_ALARM_PROBABILITY`."""


def learn_fleet(
    lessons: Sequence[Lesson],
    mounted: Mapping[str, Mapping[str, Mounting]] = NO_MOUNTINGS,
    variances: Variances | None = None,
) -> Fleet:
    """Estimate the model of a fleet whose vehicles have masses of the same names and one polynomial order.

    `mounted` has the mounting positions of the masses, for the vehicles for which all are known. `variances`
    are the result of an earlier call with the same lessons; if given, they are not estimated again.

    DataError: `lessons` is empty.
    """
    if not lessons:
        raise DataError("no deployment with these masses has been calibrated; run magbridge fleet process")
    lessons = tuple(sorted(lessons, key=lambda one: (one.time, one.vehicle, one.deployment)))
    exponents = lessons[0].exponents
    parameters = _whole_range(lessons)
    family = polynomial_prior(exponents, tuple(one.name for one in parameters), REFERENCE_FIELD_NT)
    basis = np.asarray(family.E * family.widths(family.centre))
    with threadpool_limits(1, "blas"):
        observed = tuple(Observed(one.vehicle, one.refit, one.brought(parameters, basis)) for one in lessons)
        groups = _groups(exponents)
        changed, alarm = frozenset[int](), SUSPICION_PROBABILITY
        for _ in range(MAX_ROUNDS):
            kept = [one for k, one in enumerate(observed) if k not in changed]
            shapes = _shapes(kept, groups, mounted, exponents, parameters, basis)
            population = learn(kept, groups, shapes, variances)
            fleet = Fleet(parameters, exponents, basis, population, mounted, lessons, observed, changed)
            if (found := _changed_deployments(fleet, alarm)) == changed:
                break
            changed, alarm = found, FALSE_ALARM_PROBABILITY
    return fleet


def _changed_deployments(fleet: Fleet, alarm: float) -> frozenset[int]:
    """Return the indices of the deployments that differ from their vehicle's earlier unchanged ones."""
    past: dict[str, list[Observed]] = {}
    found = set[int]()
    for k, (lesson, seen) in enumerate(zip(fleet.lessons, fleet.observed, strict=True)):
        mine = past.setdefault(lesson.vehicle, [])
        known = fleet.predicted(mine, lesson.vehicle, lesson.refit)
        if mine and _compare(fleet, lesson, known, alarm=alarm).changes:
            found.add(k)
        else:
            mine.append(seen)
    return frozenset(found)


def _shapes(
    observed: Sequence[Observed],
    groups: IndexArray,
    mounted: Mapping[str, Mapping[str, Mounting]],
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
    basis: FloatArray,
) -> Shapes:
    """Return the shapes in units of z, linearised at each vehicle's estimate under the prior variances."""
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
    return Shapes(found, shape_groups(len(parameters)), np.where(moves, UNEXPLAINED_FRACTION, NO_SHAPES.rest))


def _whole_range(lessons: Sequence[Lesson]) -> tuple[Parameter, ...]:
    """Return the parameters, scaled to the range that all deployments together cover."""
    whole = []
    for seen in zip(*(lesson.parameters for lesson in lessons), strict=True):
        low, high = min(one.low for one in seen), max(one.high for one in seen)
        half = (high - low) / 2 or seen[0].scale
        whole.append(Parameter(seen[0].name, seen[0].unit, low, high, (low + high) / 2, half))
    return tuple(whole)


def _groups(exponents: Sequence[Exponents]) -> IndexArray:
    """Return the group number of each coefficient, (9 m,); coefficients of a group share their variances."""
    names: list[tuple[object, str]] = []
    for powers in exponents:
        moved = sum(power > 0 for power in powers)
        which: object = "cross" if moved > 1 else powers
        kinds = ["gain", *["soft"] * 5, *["T"] * 3] if not moved else [*["A"] * 6, *["T"] * 3]
        names += [(which, kind) for kind in kinds]
    order = {name: k for k, name in enumerate(dict.fromkeys(names))}
    return np.array([order[name] for name in names], np.intp)


FIXED, SOFT = "hard iron", "soft iron"
SOFT_AXES = "xx", "yy", "zz", "xy", "xz", "yz"
"""Axes of the six elements of soft iron; the first three contain the gains of the axes."""
FALSE_ALARM_PROBABILITY = 1e-3
"""Probability of a false alarm in a deployment, over all monitored quantities."""
NOISE = "noise"
LOG_NOISE_SIGMA = 0.3
"""Standard deviation of the logarithm of the noise between deployments of a vehicle. It is assumed, not
estimated: a change of the noise is reported above a factor of about three."""


class Change(NamedTuple):
    """Significant change of a coefficient or the noise; the field names are the keys of the JSON output."""

    what: str
    """Name of the coefficient: mass, hard iron or soft iron, and axis; or noise."""
    by_nT: float  # noqa: N815 - the JSON key
    """Change from the prediction, nT; for soft iron in a field of :data:`REFERENCE_FIELD_NT`."""
    sigmas: float
    """Change divided by its standard deviation."""
    chance: float
    """Probability that any quantity of an unchanged vehicle changes by as many sigmas."""
    cause: str
    """Likely cause, and if a refit is on record."""


class Comparison(NamedTuple):
    """Coefficients of one deployment: predicted from the earlier ones, and estimated with its own data."""

    lesson: Lesson
    expected: FloatArray
    expected_sigma: FloatArray
    """`expected`, `expected_sigma`: Prediction before the deployment, and its 1-sigma, (k,), nT."""
    found: FloatArray
    found_sigma: FloatArray
    """`found`, `found_sigma`: Estimate after its own data, and its 1-sigma, (k,), nT."""
    changes: tuple[Change, ...]
    """Significant changes, the largest first."""
    omitted: bool = False
    """True if the model of the fleet omits the deployment, see :attr:`Fleet.changed`."""

    @property
    def facts(self) -> dict[str, Any]:
        """The comparison as a dictionary for JSON; coefficients in nT."""
        names = "expected", "expected_sigma", "found", "found_sigma"
        return {
            "deployment": self.lesson.deployment, "refit": self.lesson.refit,
            "date": datetime.fromtimestamp(self.lesson.time, UTC).date().isoformat(),
            **{f"{name}_nT": getattr(self, name).tolist() for name in names},
            "changes": [change._asdict() for change in self.changes], "omitted": self.omitted,
        }  # fmt: skip


class History(NamedTuple):
    """A vehicle's coefficients from deployment to deployment."""

    names: tuple[str, ...]
    """Names of the k coefficients: hard iron, the effect of each mass over half its range, soft iron."""
    deployments: tuple[Comparison, ...]
    """Deployments of the vehicle in the order of time."""

    @property
    def facts(self) -> dict[str, Any]:
        """The history as a dictionary for JSON; coefficients in nT."""
        return {"coefficients": list(self.names), "deployments": [one.facts for one in self.deployments]}


def history(fleet: Fleet, vehicle: str) -> History:
    """Return the history of a vehicle's coefficients, and their significant changes.

    The prediction of a deployment is N(m, S), with a larger S after a refit. The deployment's own data give
    the posterior N(m', P). Under the model, ``Cov(m' - m) = S - P``. So the change of a coefficient, divided
    by its sigma, has a standard normal distribution, however much the runs determine. A change is reported if
    the probability of a change as large is below :data:`FALSE_ALARM_PROBABILITY` over all monitored
    coefficients and the noise. The noise is compared with the median of the earlier deployments.
    """
    rows: list[Comparison] = []
    for k, lesson in enumerate(fleet.lessons):
        if lesson.vehicle != vehicle:
            continue
        known = fleet.known(vehicle, lesson.refit, lesson.time)
        row = _compare(fleet, lesson, known, [one.lesson for one in rows])
        # the first deployment has no predecessor
        rows.append(row._replace(changes=row.changes if rows else (), omitted=k in fleet.changed))
    return History(_looked_at(fleet)[0], tuple(rows))


def _compare(
    fleet: Fleet,
    lesson: Lesson,
    known: Known,
    earlier: Sequence[Lesson] = (),
    alarm: float = FALSE_ALARM_PROBABILITY,
) -> Comparison:
    """Compare a deployment with the prediction `known`, and its noise and refit with `earlier` ones."""
    names, places = _looked_at(fleet)
    evidence = lesson.brought(fleet.parameters, np.eye(len(fleet.basis)))
    S = known.covariance
    gain = np.linalg.solve(np.eye(len(S)) + S @ evidence.precision, np.column_stack([S, known.mean]))
    P = 0.5 * (gain[:, :-1] + gain[:, :-1].T)  # (S^-1 + J)^-1
    found = (P @ evidence.vector + gain[:, -1])[places]
    expected, variance, left = known.mean[places], np.diag(S)[places], np.diag(P)[places]
    moves = found - expected
    z = np.abs(moves) / np.sqrt(np.maximum(variance - left, 1e-24))
    changed = [(name, float(move), float(one)) for name, move, one in zip(names, moves, z, strict=True)]
    if earlier:
        usual = float(np.median([one.noise for one in earlier]))
        if min(usual, lesson.noise) > 0.0:  # a calibration made elsewhere may state no noise
            ratio = abs(float(np.log(lesson.noise / usual)))
            changed.append((NOISE, lesson.noise - usual, ratio / LOG_NOISE_SIGMA))
    refitted = lesson.refit not in {one.refit for one in earlier}
    changes = [
        Change(name, move, one, chance, _cause(name, refitted))
        for name, move, one in changed
        if (chance := min(2.0 * float(norm.sf(one)) * (len(names) + 1), 1.0)) < alarm
    ]
    changes.sort(key=lambda change: -change.sigmas)
    return Comparison(lesson, expected, np.sqrt(variance), found, np.sqrt(left), tuple(changes))


def _cause(name: str, refitted: bool) -> str:
    """Return the text of the likely cause of a change of a coefficient or of the noise."""
    if name == NOISE:
        return "sensor, wiring, currents, or disturbed runs"
    mass, _, _ = name.rpartition(",")
    what = {
        FIXED: "iron that was magnetised, fitted or removed",
        SOFT: "gain or axes of the sensor, or iron that was fitted or removed",
    }.get(mass, f"another pack, moment or place of what {mass} moves")
    return f"{what}, {'more than refits do' if refitted else 'and no refit is on record'}"


def _looked_at(fleet: Fleet) -> tuple[tuple[str, ...], list[int]]:
    """Return names and indices of the hard iron, its change with each mass, and soft iron with gains."""
    names = [f"{FIXED}, {axis}" for axis in "xyz"]
    places = [6, 7, 8]
    for m, powers in enumerate(fleet.exponents):
        if sum(powers) != 1:
            continue
        names += [f"{fleet.parameters[powers.index(1)].name}, {axis}" for axis in "xyz"]
        places += [9 * m + 6, 9 * m + 7, 9 * m + 8]
    return (*names, *(f"{SOFT}, {axes}" for axes in SOFT_AXES)), [*places, *range(6)]
