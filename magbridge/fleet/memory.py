"""Read the calibrations of a fleet from a catalogue, and predict a vehicle's next calibration."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.fitting.fit import Fit
from magbridge.calibration.fitting.pose import DEPARTURE, Known, Mounting
from magbridge.calibration.model import Calibration, Noise, Reference
from magbridge.calibration.terms import Polynomial
from magbridge.errors import DataError, WrongUse
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import polynomial_prior
from magbridge.fleet.catalogue import Catalogue, Row, open_catalogue
from magbridge.fleet.hierarchy import FLEET_LEVELS, Variances
from magbridge.fleet.learn import Fleet, Lesson, learn_fleet, packed, unpacked
from magbridge.fleet.register import (
    GIVEN,
    Deployment,
    current,
    current_files,
    jobs,
    masses,
    vehicle_named,
    vehicles,
)
from magbridge.version import __version__
from magbridge.wording import counted


def lessons(catalogue: Catalogue, like: str, excluded: Collection[str] = ()) -> list[Lesson]:
    """Return the training records of all vehicles with the same masses and order as the vehicle `like`.

    A record whose logs have a SHA-256 in `excluded` is omitted. A calibration that was made elsewhere is
    omitted if its logs were also calibrated here.

    WrongUse: the vehicle does not exist.
    """
    vehicle_named(catalogue, like)
    kinds = {name: _kind(row) for name, row in vehicles(catalogue).items()}
    rows = [
        row
        for row in current(catalogue, "calibrations")
        if row["precision"] and kinds.get(row["vehicle"]) == kinds[like]
    ]
    every = sorted(map(_lesson, rows), key=lambda one: (one.time, one.deployment))
    here = frozenset[str]().union(*(one.inputs for one in every if not one.given))
    newest = {(one.vehicle, one.refit): one.sensor for one in every if one.sensor}
    found = []
    for one in every:
        if one.inputs & set(excluded) or (one.given and one.inputs & here):
            continue
        if one.sensor and one.sensor != newest[one.vehicle, one.refit]:  # as good as a refit
            found.append(one._replace(refit=f"{one.refit}, {one.sensor}"))
        else:
            found.append(one)
    return found


def fleet_of(catalogue: Catalogue, vehicle: str, excluded: Collection[str] = ()) -> Fleet:
    """Return the model of the fleet of a vehicle; for `excluded` see :func:`lessons`.

    WrongUse: the vehicle does not exist. DataError: no deployment has been calibrated, or the units of a
    parameter differ.
    """
    found = lessons(catalogue, vehicle, excluded)
    units = {tuple(one.unit for one in lesson.parameters) for lesson in found}
    if len(units) > 1:
        both = " and ".join(", ".join(one) for one in sorted(units))
        raise DataError(f"{catalogue.name}: expected one unit per parameter of {vehicle}'s fleet, got {both}")
    mounted = {name: masses(row) for name, row in vehicles(catalogue).items()}
    of = _name(found, mounted)
    stored = {
        row["of"]: Variances(np.reshape(row["own"], (len(FLEET_LEVELS), -1)), np.array(row["shaped"]))
        for row in catalogue.rows("populations")
    }
    return learn_fleet(found, mounted, stored.get(of))


def fleets(catalogue: Catalogue, names: Iterable[str]) -> dict[str, Fleet | DataError]:
    """Return the fleet model of each vehicle, or the error; vehicles with the same masses share a model."""
    found: dict[Any, Fleet | DataError] = {}
    out: dict[str, Fleet | DataError] = {}
    for name in names:
        kind = _kind(vehicle_named(catalogue, name))
        if kind not in found:
            try:
                found[kind] = fleet_of(catalogue, name)
            except DataError as error:
                found[kind] = error
        out[name] = found[kind]
    return out


def remember(catalogue: Catalogue) -> None:
    """Store the estimated variances of each fleet in the catalogue, so that later calls reuse them."""
    for fleet in fleets(catalogue, vehicles(catalogue)).values():
        if isinstance(fleet, Fleet):
            own, shaped = (one.ravel().tolist() for one in fleet.population.variances)
            of = _name(fleet.lessons, fleet.mounted)
            catalogue.add("populations", [{"of": of, "own": own, "shaped": shaped}])


def last_maps(catalogue: Catalogue) -> dict[str, tuple[str, Path]]:
    """Return vehicle -> deployment and file of its newest anomaly map."""
    of = {job.name: job for job in jobs(catalogue)}
    start = {row["sha256"]: row["start"] for row in catalogue.rows("logs", ["sha256", "start"])}
    found: dict[str, tuple[float, str, Path]] = {}
    for row in current(catalogue, "maps"):
        job = of[row["job"]]
        when = max((start.get(log["sha256"]) or 0.0 for log in job.files), default=0.0)
        name = job.vehicle["vehicle"]
        if name not in found or when > found[name][0]:
            found[name] = when, job.deployment, catalogue.results / row["path"]
    return {name: (deployment, path) for name, (_, deployment, path) in found.items()}


def findings(catalogue: Catalogue) -> dict[str, list[Row]]:
    """Return vehicle -> rows of the causes that ``diagnose`` found, in the order of deployment names.

    A row with a known improvement has ``ratio``, the RMS with the cause modelled over the RMS without, and
    its interval ``low`` to ``high``.
    """
    of = {job.name: job for job in jobs(catalogue)}
    better = {(row["job"], row["cause"], row["channel"]): row for row in current(catalogue, "improvements")}
    found: dict[str, list[Row]] = {}
    for row in current(catalogue, "findings"):
        job = of[row["job"]]
        gain = better.get((row["job"], row["cause"], row["channel"]), {})
        found.setdefault(job.vehicle["vehicle"], []).append({"deployment": job.deployment, **row, **gain})
    return {name: sorted(rows, key=lambda row: str(row["deployment"])) for name, rows in found.items()}


def owner(catalogue: Catalogue, digests: Iterable[str]) -> tuple[str, str]:
    """Return vehicle and refit of the logs with the SHA-256 `digests`; WrongUse: not those of one vehicle."""
    wanted = set(digests)
    rows = [row for row in current_files(catalogue.rows("files")) if row["sha256"] in wanted]
    found = {(row["vehicle"], row["refit"]) for row in rows}
    if len({vehicle for vehicle, _ in found}) != 1:
        note = "of several vehicles" if found else "of none of its vehicles"
        raise WrongUse(f"--fleet {catalogue.name}: the logs are {note}; name the vehicle with --vehicle")
    return sorted(found)[-1]


def _kind(vehicle: Row) -> tuple[tuple[str, ...], int]:
    """Return the masses and the polynomial order, which all vehicles of a fleet have in common."""
    return tuple(vehicle["parameters"]), vehicle["order"]


def _name(lessons: Iterable[Lesson], mounted: Mapping[str, Mapping[str, Mounting]]) -> str:
    """Return a hash of the method and inputs of estimated variances: training records, mass positions."""
    each = sorted(
        (one.vehicle, one.refit, one.deployment, one.time, one.information.vector.tolist()) for one in lessons
    )
    where = [(name, mounted.get(name, {})) for name in sorted({one.vehicle for one in lessons})]
    inputs = (ESTIMATE, each, where)
    return sha256(msgspec.json.encode(inputs, order="sorted")).hexdigest()[:32]


def _lesson(row: Row) -> Lesson:
    """Return the training record in a row of the table ``calibrations``."""
    calibration = decode_calibration(row["calibration"].encode(), f"calibration of {row['deployment']}")
    return Lesson(
        row["vehicle"], row["refit"], row["deployment"], row["start"], calibration.parameters,
        calibration.terms[0].exponents, calibration.reference.field, calibration.noise.sensor, unpacked(row),
        frozenset(calibration.inputs.values()), row["sensor"], row["job"] == GIVEN,
    )  # fmt: skip


ESTIMATE = "without changed deployments, from a clean start"
"""Name of the method that estimates variances; variances stored by another method are not used."""
MAX_VARIANCE_FRACTION = 0.25
"""Posterior over prior variance below which the data are taken to have determined a direction."""
MAX_DEPARTURE_RATIO = 3.0
"""Departure from the vehicle's past, relative to the expected one, above which a warning is printed."""


def add_calibration(
    catalogue: Catalogue, vehicle: str, deployment: Deployment, start: float, calibration: Calibration
) -> int:
    """Add the calibration of a deployment to the catalogue, unless it is there; return the number added.

    `start` is the start of the deployment, s since 1970.

    WrongUse: the vehicle does not exist, the calibration has other parameters or another sensor, or the
    deployment has another calibration.
    """
    of = vehicle_named(catalogue, vehicle)
    names = [one.name for one in calibration.parameters]
    if names != of["parameters"]:
        both = [", ".join(each) or "none" for each in (names, of["parameters"])]
        raise WrongUse(f"{vehicle}: expected a calibration with the parameters {both[1]}, got {both[0]}")
    sensor = deployment.sensor or of["sensor"]
    if not calibration.sensor.may_be(sensor):
        raise WrongUse(
            f"{vehicle} {deployment.name}: expected a calibration of sensor {sensor!r}, got one of "
            f"{calibration.sensor.name!r}"
        )
    row = _row(vehicle, deployment, calibration.sensor.name or sensor, start, calibration, of["order"])
    before = [
        one
        for one in catalogue.rows("calibrations", ["job", "vehicle", "deployment", "calibration"])
        if one["job"] == GIVEN and (one["vehicle"], one["deployment"]) == (vehicle, deployment.name)
    ]
    if any(one["calibration"] != row["calibration"] for one in before):
        raise WrongUse(f"{vehicle} {deployment.name}: has another calibration; name another deployment")
    return catalogue.add("calibrations", [row])


def _row(
    vehicle: str, deployment: Deployment, sensor: str, start: float, calibration: Calibration, order: int
) -> Row:
    samples = sum(run.samples for run in calibration.runs)
    squares = sum(run.samples * run.rms**2 for run in calibration.runs)
    return {
        "job": GIVEN, "attempt": 1, "vehicle": vehicle, "deployment": deployment.name,
        "refit": deployment.refit or deployment.name, "start": start, "sensor": sensor,
        "method": calibration.method, "rms": float(np.sqrt(squares / max(samples, 1))),
        "noise": calibration.noise.sensor, "expected": None, "supported": not calibration.warnings,
        "warnings": list(calibration.warnings), "calibration": encode_calibration(calibration).decode(),
        **packed(_information(calibration, order)),
    }  # fmt: skip


def _information(calibration: Calibration, order: int) -> GaussianInformation | None:
    """Return the information that the data of a calibration contributed, without the prior.

    The result is None if the calibration is not a single polynomial of degree `order`. A cal.json holds the
    posterior N(c, P); its prior is assumed to be the physical prior N(0, W). With
    ``W^-1/2 P W^-1/2 = sum lambda_k v_k v_k^T``, a direction v_k with lambda_k below
    :data:`MAX_VARIANCE_FRACTION` gets the precision ``1 / lambda_k - 1``; all others get 0.
    """
    term, *others = calibration.terms
    if others or max(map(sum, term.exponents)) != order:
        return None
    size = term.size
    names = tuple(one.name for one in calibration.parameters)
    family = polynomial_prior(term.exponents, names, calibration.reference.field)
    to_z = np.linalg.inv(family.E * family.widths(family.centre))
    left, v = np.linalg.eigh(to_z @ calibration.covariance[:size, :size] @ to_z.T)
    left = np.maximum(left, 1e-12)
    known = left < MAX_VARIANCE_FRACTION
    J = (v[:, known] * (1.0 / left[known] - 1.0)) @ v[:, known].T
    h = (v[:, known] / left[known]) @ (v[:, known].T @ to_z @ calibration.coefficients[:size])
    return GaussianInformation(to_z.T @ J @ to_z, to_z.T @ h)


def unflown(fleet: Fleet, vehicle: str, refit: str = "") -> Calibration:
    """Return the prediction of a vehicle's next deployment as a calibration.

    The arguments are those of :meth:`.Fleet.known`. The noise is the RMS of the noise of the vehicle's own
    deployments, or of all deployments of the fleet if it has none.
    """
    known = fleet.known(vehicle, refit)
    own = [one.noise for one in fleet.lessons if one.vehicle == vehicle]
    noise = float(np.sqrt(np.mean(np.square(own or [one.noise for one in fleet.lessons]))))
    return Calibration(
        known.parameters, (Polynomial(exponents=known.exponents),), np.asarray(known.mean), known.covariance,
        Noise(noise), Reference(known.field), method="fleet", software=f"magbridge {__version__}",
        warnings=("no run of this deployment: its coefficients are its fleet's prediction",),
    )  # fmt: skip


class FleetPrediction(NamedTuple):
    """Prior for a calibration, with the numbers of deployments: of the vehicle (`own`), and of all others."""

    known: Known
    vehicle: str
    own: int
    others: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns with the positions of the vehicle's masses."""
        return tuple(one.name for one in self.known.parameters)


def start(location: str | Path, member: str, refit: str, digests: Collection[str]) -> FleetPrediction:
    """Return the prediction of the calibration of logs, from the other logs of a catalogue.

    Calibrations from the logs themselves, with the SHA-256 `digests`, are not used. `member` and `refit` are
    the vehicle and the refit of the logs; if empty, the catalogue's entries for the logs are used.

    WrongUse: the vehicle does not exist, or is not known for these logs. DataError: no deployment has been
    calibrated.
    """
    catalogue = open_catalogue(location)
    if not member:
        member, on_record = owner(catalogue, digests)
        refit = refit or on_record
    fleet = fleet_of(catalogue, member, excluded=digests)
    own = sum(one.vehicle == member for one in fleet.lessons)
    return FleetPrediction(fleet.known(member, refit), member, own, len(fleet.lessons) - own)


def gained(found: Fit, single: Fit | None, began: FleetPrediction) -> tuple[dict[str, Any], list[str]]:
    """Return the benefit of the fleet's prior, as values and as lines of text.

    `found` is the fit with the fleet's prior; `single` is the fit to the same data without the prior, or None
    if that fit fails.
    """
    with_it, without = (
        one and one.details["expected_over_noise"] * one.calibration.noise.sensor for one in (found, single)
    )
    departure = found.details.get("widths_nT", {}).get(DEPARTURE, 1.0)
    facts = {
        "vehicle": began.vehicle, "deployments": began.own, "deployments_of_others": began.others,
        "expected_nT": with_it, "expected_alone_nT": without, "departure": departure,
    }  # fmt: skip
    otherwise = f"instead of {without:.1f}" if without is not None else "where these runs alone allow no fit"
    past = f"{counted(began.own, 'deployment')} of {began.vehicle} and {began.others} of its fleet"
    lines = [f"{past}: expect {with_it:.1f} nT of error {otherwise}"]
    if departure > MAX_DEPARTURE_RATIO:
        lines.append(
            f"{began.vehicle} differs from its past by {departure:.1f} times the expected: another "
            "vehicle, or something on it has changed"
        )
    return facts, lines
