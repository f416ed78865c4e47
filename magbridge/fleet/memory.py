"""What a catalogue's deployments have taught, and its prediction of the next."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from magbridge.calibration.file import decode_calibration
from magbridge.calibration.fitting.pose import Mounting
from magbridge.calibration.terms import Polynomial
from magbridge.errors import DataError, WrongUse
from magbridge.fleet.catalogue import Catalogue, Row
from magbridge.fleet.job import GIVEN, jobs, last_attempts
from magbridge.fleet.learn import Fleet, Lesson, learn_fleet, unpacked
from magbridge.fleet.register import current_files, masses, vehicle_named, vehicles
from magbridge.fleet.variances import FLEET_LEVELS, Variances

__all__ = ["current", "findings", "fleet_of", "fleets", "last_maps", "lessons", "owner", "remember"]


class _Taught(NamedTuple):
    """A lesson, what its logs' SHA-256 are, the sensor it flew, and whether it was made elsewhere."""

    lesson: Lesson
    inputs: frozenset[str]
    sensor: str
    given: bool


def current(catalogue: Catalogue, table: str, columns: Collection[str] = ()) -> list[Row]:
    """Return the rows of a table of results that are made of what the catalogue's logs are now.

    Rows of a deployment that was tried again, those of the last attempt; and all that was made elsewhere.
    """
    names = {job.name for job in jobs(catalogue)}
    last = last_attempts(catalogue.rows("done"))
    wanted = [*columns, "job", "attempt"] if columns else ()
    return [
        row
        for row in catalogue.rows(table, wanted)
        if row["job"] == GIVEN or (row["job"] in names and row["attempt"] == last.get(row["job"], 1))
    ]


def lessons(catalogue: Catalogue, like: str, excluded: Collection[str] = ()) -> list[Lesson]:
    """Return the training records of all deployments of vehicles with the masses of the vehicle `like`.

    Estimates from logs of the SHA-256 in `excluded` are left out. A calibration made elsewhere from logs that
    were also calibrated here is left out, too.

    WrongUse: the vehicle does not exist.
    """
    vehicle_named(catalogue, like)
    kinds = {name: _kind(row) for name, row in vehicles(catalogue).items()}
    rows = [
        row
        for row in current(catalogue, "calibrations")
        if row["precision"] and kinds.get(row["vehicle"]) == kinds[like]
    ]
    taught = sorted(map(_taught, rows), key=lambda one: (one.lesson.time, one.lesson.deployment))
    here = frozenset[str]().union(*(one.inputs for one in taught if not one.given))
    newest = {(one.lesson.vehicle, one.lesson.refit): one.sensor for one in taught if one.sensor}
    found = []
    for one in taught:
        if one.inputs & set(excluded) or (one.given and one.inputs & here):
            continue
        of = one.lesson.vehicle, one.lesson.refit
        if one.sensor != newest.get(of, one.sensor) and one.sensor:  # another sensor is as good as a refit
            found.append(one.lesson._replace(refit=f"{one.lesson.refit}, {one.sensor}"))
        else:
            found.append(one.lesson)
    return found


def fleet_of(catalogue: Catalogue, vehicle: str, excluded: Collection[str] = ()) -> Fleet:
    """Return the fleet of the vehicles with the masses of this one; `excluded` as for :func:`lessons`.

    WrongUse: there is no such vehicle. DataError: nothing has been calibrated yet, or the columns' units
    differ.
    """
    found = lessons(catalogue, vehicle, excluded)
    units = {tuple(one.unit for one in lesson.parameters) for lesson in found}
    if len(units) > 1:
        both = " and ".join(", ".join(one) for one in sorted(units))
        raise DataError(f"{catalogue.name}: {vehicle}'s fleet gives its positions in different units: {both}")
    mounted = {name: masses(row) for name, row in vehicles(catalogue).items()}
    of = _name(found, mounted)
    stored = {
        row["of"]: Variances(np.reshape(row["own"], (len(FLEET_LEVELS), -1)), np.array(row["shaped"]))
        for row in catalogue.rows("populations")
    }
    return learn_fleet(found, mounted, stored.get(of))


def fleets(catalogue: Catalogue, names: Iterable[str]) -> dict[str, Fleet | DataError]:
    """Return each vehicle's fleet, or why there is none; vehicles with the same masses share theirs."""
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
    """Put on record how the coefficients of the catalogue's fleets vary, so that it is estimated once."""
    for fleet in fleets(catalogue, vehicles(catalogue)).values():
        if isinstance(fleet, Fleet):
            own, shaped = (one.ravel().tolist() for one in fleet.population.variances)
            of = _name(fleet.lessons, fleet.mounted)
            catalogue.add("populations", [{"of": of, "own": own, "shaped": shaped}])


def last_maps(catalogue: Catalogue) -> dict[str, tuple[str, Path]]:
    """Return the deployment and the file of each vehicle's newest anomaly map."""
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
    """Return the results of each vehicle's deployments, with their names, in the order of these.

    A cause has its improvement, ``ratio low high``: the RMS with it over that without, and its interval.
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
    """Return vehicle and refit of logs by their SHA-256.

    WrongUse: they are not catalogued, or are of several vehicles.
    """
    wanted = set(digests)
    rows = [row for row in current_files(catalogue.rows("files")) if row["sha256"] in wanted]
    found = {(row["vehicle"], row["refit"]) for row in rows}
    if len({vehicle for vehicle, _ in found}) != 1:
        note = "of several of its vehicles" if found else "in its catalogue of none"
        raise WrongUse(f"--fleet {catalogue.name}: the logs are {note}: name the vehicle (--vehicle)")
    return sorted(found)[-1]


def _kind(vehicle: Row) -> tuple[tuple[str, ...], int]:
    """Return the masses and the order, which vehicles must share to be one fleet."""
    return tuple(vehicle["parameters"]), vehicle["order"]


def _name(lessons: Iterable[Lesson], mounted: Mapping[str, Mapping[str, Mounting]]) -> str:
    """Return the name of the estimates: from other lessons, another name."""
    each = sorted(
        (one.vehicle, one.refit, one.deployment, one.time, one.information.vector.tolist()) for one in lessons
    )
    where = [(name, mounted.get(name, {})) for name in sorted({one.vehicle for one in lessons})]
    return sha256(msgspec.json.encode((each, where), order="sorted")).hexdigest()[:32]


def _taught(row: Row) -> _Taught:
    """Return the lesson of a calibration."""
    calibration = decode_calibration(row["calibration"].encode(), f"calibration of {row['deployment']}")
    term = calibration.terms[0]
    assert isinstance(term, Polynomial)
    lesson = Lesson(
        row["vehicle"], row["refit"], row["deployment"], row["start"], calibration.parameters,
        term.exponents, calibration.reference.field, calibration.noise.sensor, unpacked(row),
    )  # fmt: skip
    return _Taught(lesson, frozenset(calibration.inputs.values()), row["sensor"], row["job"] == GIVEN)
