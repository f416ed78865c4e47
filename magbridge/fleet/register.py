"""Add vehicles and logs to a catalogue, from options or a fleet.toml, and list the jobs.

::

    [vehicle.comet]
    serial = "U-213"                        # distinguishes two vehicles of one name
    sensor = "HMR2300 0153"                 # logs of other sensors are rejected
    parameters = ["battpos", "ballast"]

    [vehicle.comet.mass.battpos]            # mounting of the mass, as in vehicle.toml; for all masses or none
    at = [-0.45, 0.0, 0.05]
    travel = [0.0254, 0.0, 0.0]

    [[vehicle.comet.deployment]]
    name = "2026-05"
    refit = "2026-04"                       # refit of the vehicle; default: a new refit with each deployment
    sensor = "HMR2300 0160"                 # only if another sensor was carried
    logs = ["comet/2026-05/*.nc"]
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from magbridge.calibration.fitting.pose import Mounting
from magbridge.errors import ConfigError, FormatError, WrongUse
from magbridge.files import digest, existing
from magbridge.fleet.catalogue import Catalogue, Row
from magbridge.toml import Table, check_entries, convert, load_toml
from magbridge.wording import one_of

FIXED_KEYS = "serial", "parameters"
"""Columns of a vehicle that never change; for all other columns the newest row is valid."""


class Deployment(Table, frozen=True):
    """``[[vehicle.NAME.deployment]]``: a deployment with its refit, sensor and patterns of its logs."""

    name: str
    logs: tuple[str, ...]
    refit: str = ""
    sensor: str = ""


class Vehicle(Table, frozen=True):
    """``[vehicle.NAME]``: a vehicle with its sensor, the position columns and mountings of its masses."""

    parameters: tuple[str, ...] = ()
    serial: str = ""
    sensor: str = ""
    order: Annotated[int, Meta(ge=1, le=6)] = 3
    mass: dict[str, Mounting] = msgspec.field(default_factory=dict)
    deployment: tuple[Deployment, ...] = ()


class _RegisteredFile(Table, frozen=True):
    vehicle: dict[str, Vehicle]


def read_fleet(path: Path) -> dict[str, Vehicle]:
    """Read a fleet.toml and return its vehicles by name; ConfigError: a key or a type is not as expected."""
    table = load_toml(path)
    check_entries(table, "vehicle", Vehicle, path)
    return convert(table, _RegisteredFile, path).vehicle


def vehicles(catalogue: Catalogue) -> dict[str, Row]:
    """Return the newest row of each vehicle, by name; FormatError: two vehicles have one name."""
    found: dict[str, Row] = {}
    for row in sorted(catalogue.rows("vehicles"), key=lambda row: row["version"]):
        last = found.get(row["vehicle"], row)
        if any(last[key] != row[key] for key in FIXED_KEYS):
            both = " and ".join(_described(one) for one in (last, row))
            expected = f"expected one vehicle {row['vehicle']!r}, got two: {both}; remove a row"
            raise FormatError(catalogue.name, expected)
        found[row["vehicle"]] = row
    return found


def masses(row: Row) -> dict[str, Mounting]:
    """Return the mounting of each mass of a vehicle by its column; FormatError: it is not such a table."""
    try:
        return msgspec.json.decode(row["mass"], type=dict[str, Mounting])
    except msgspec.DecodeError as error:
        raise FormatError(f"vehicle {row['vehicle']}", f"mass: expected places of masses: {error}") from error


def vehicle_named(catalogue: Catalogue, name: str) -> Row:
    """Return the row of the vehicle `name`; WrongUse: the vehicle does not exist."""
    known = vehicles(catalogue)
    if name in known:
        return known[name]
    there = f"vehicle: {one_of(name, known)}" if known else "it has no vehicle yet"
    raise WrongUse(f"{catalogue.name}: {there}; magbridge fleet add --vehicle {name} --parameter ... adds it")


def add_vehicle(catalogue: Catalogue, name: str, vehicle: Vehicle) -> int:
    """Add a vehicle or its changed properties to the catalogue; return 1 if a row was added, else 0.

    WrongUse: another vehicle has the name, the name cannot be a folder's, or only some masses have
    a mounting.
    """
    _check_name(name, "a vehicle")
    if vehicle.mass and (odd := sorted(vehicle.mass.keys() ^ set(vehicle.parameters))):
        raise WrongUse(f"{name}: mass: expected a place per parameter or none; not so for {', '.join(odd)}")
    row = {"vehicle": name, **{key: getattr(vehicle, key) for key in ("serial", "sensor", "order")}}
    row["parameters"] = list(vehicle.parameters)
    row["mass"] = msgspec.json.encode(vehicle.mass, order="sorted").decode()
    known = vehicles(catalogue).get(name, {**row, "version": 0})
    if any(known[key] != row[key] for key in FIXED_KEYS):
        raise WrongUse(
            f"{name}: {catalogue.name} has another vehicle of that name: {_described(known)}, "
            f"not {_described(row)}"
        )
    if known == {**row, "version": known["version"]} and known["version"]:
        return 0
    return catalogue.add("vehicles", [{**row, "version": known["version"] + 1}])


def add_logs(
    catalogue: Catalogue, vehicle: str, deployment: Deployment, logs: Sequence[Path]
) -> tuple[int, list[str]]:
    """Add the logs of a deployment to the catalogue; return the number of new rows, and warnings.

    A warning names a log that cannot be read, has changed, or belonged to another deployment.

    WrongUse: the vehicle does not exist, or the deployment's name cannot be a folder's.
    """
    vehicle_named(catalogue, vehicle)
    _check_name(deployment.name, "a deployment")
    before = catalogue.rows("files")
    newest = {row["path"]: row for row in current_files(before)}
    rows, lines = [], []
    for log in logs:
        try:
            sha, size = digest(existing(log)), log.stat().st_size
        except (FormatError, OSError) as error:
            lines.append(str(error))
            continue
        path = str(log.resolve())
        last = newest.get(path)
        content = {
            "vehicle": vehicle, "deployment": deployment.name, "refit": deployment.refit or deployment.name,
            "sensor": deployment.sensor, "path": path, "sha256": sha, "size": size,
        }  # fmt: skip
        if last is not None and content == {key: last[key] for key in content}:
            continue
        if last is not None and last["sha256"] != sha:
            lines.append(f"{log}: has changed since it was catalogued; its present contents count")
        if last is not None and (was := (last["vehicle"], last["deployment"])) != (vehicle, deployment.name):
            lines.append(f"{log}: belonged to {', '.join(was)}; now to {vehicle}, {deployment.name}")
        rows.append({**content, "version": 1 if last is None else last["version"] + 1})
    return catalogue.add("files", rows), lines


def current_files(rows: Iterable[Row]) -> list[Row]:
    """Return the newest row of each path, in the order of vehicle, deployment and path."""
    newest: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: row["version"]):
        newest[row["path"]] = row
    return sorted(newest.values(), key=lambda row: (row["vehicle"], row["deployment"], row["path"]))


def logs_of(fleet: Path, deployment: Deployment) -> list[Path]:
    """Return the files of a deployment's patterns, relative to `fleet`; ConfigError: one has no file."""
    found: list[Path] = []
    for pattern in deployment.logs:
        if not (named := sorted(fleet.parent.glob(pattern))):
            key = f"deployment {deployment.name}: logs"
            raise ConfigError(fleet, key, f"expected files that match {pattern!r}, got none")
        found += named
    return found


def is_file_name(name: str) -> bool:
    """Return True if `name` is usable as a file or folder name and does not lead to another folder."""
    return bool(name.strip()) and name.isprintable() and name[0] != "." and not set(name) & set("/\\")


def _check_name(name: str, kind: str) -> None:
    """Check that `name` is usable as a folder's name, because results are stored in such a folder."""
    if not is_file_name(name):
        raise WrongUse(f"{name!r}: expected {kind}'s name without slashes, not beginning with a dot")


def _described(row: Row) -> str:
    masses = ", ".join(row["parameters"]) or "no moving masses"
    return f"serial {row['serial'] or 'not given'}, sensor {row['sensor'] or 'not given'}, {masses}"


GIVEN = "given"
"""Value of the column `job` in the row of a calibration that was made elsewhere."""
STATUS_COLUMNS = (
    "deployments", "logs", "calibrated", "unsupported", "failed", "new", "given", "diagnosed", "mapped"
)  # fmt: skip
"""Names of the counts for each vehicle; `given` counts calibrations that were made elsewhere."""


@dataclass(frozen=True)
class Job:
    """Deployment to process, with the catalogue rows of its vehicle (`vehicle`) and logs (`files`)."""

    vehicle: Row
    deployment: str
    refit: str
    files: tuple[Row, ...]
    diagnose: bool = False
    map: bool = False
    attempt: int = 1

    @property
    def sensor(self) -> str:
        """Name of the deployment's sensor; empty if any sensor is accepted."""
        return str(next((row["sensor"] for row in self.files if row["sensor"]), self.vehicle["sensor"]))

    @property
    def mark(self) -> Row:
        """Columns `job` and `attempt`, which identify the job in each row of its results."""
        return {"job": self.name, "attempt": self.attempt}

    @cached_property
    def name(self) -> str:
        """Hash of the job's inputs, 32 hexadecimal digits; it changes with the logs and the parameters."""
        made_of = (
            self.vehicle["vehicle"], self.deployment, self.refit, self.sensor,
            self.vehicle["parameters"], self.vehicle["order"], sorted({row["sha256"] for row in self.files}),
        )  # fmt: skip
        return sha256(msgspec.json.encode(made_of)).hexdigest()[:32]


def jobs(catalogue: Catalogue, *, diagnose: bool = False, maps: bool = False) -> list[Job]:
    """Return every deployment of a catalogue as a job, with diagnosis and map if requested."""
    known = vehicles(catalogue)

    def owner(row: Row) -> tuple[str, str, str]:
        return row["vehicle"], row["deployment"], row["refit"]

    rows = sorted(current_files(catalogue.rows("files")), key=owner)
    return [
        Job(known[vehicle], deployment, refit, tuple(files), diagnose, maps)
        for (vehicle, deployment, refit), files in groupby(rows, owner)
        if vehicle in known
    ]


def new_jobs(catalogue: Catalogue, every: list[Job], *, retry: bool = False) -> list[Job]:
    """Return the jobs without a requested result in the catalogue; with `retry`, also jobs with failures."""
    done = catalogue.rows("done")
    last = last_attempts(done)
    has = {(row["job"], what) for row in done for what in ("diagnosed", "mapped") if row[what]}
    failed = set[str]()
    if retry:
        rows = catalogue.rows("failures", ["job", "attempt"])
        failed = {row["job"] for row in rows if row["attempt"] == last.get(row["job"])}
    todo = []
    for job in every:
        more = job.name in failed
        wanted = {"diagnosed": job.diagnose, "mapped": job.map}
        lacks = any(asked and (job.name, what) not in has for what, asked in wanted.items())
        if more or lacks or job.name not in last:
            todo.append(replace(job, attempt=last.get(job.name, 1) + more))
    return todo


def last_attempts(done: Iterable[Row]) -> dict[str, int]:
    """Return job -> number of its last attempt, from the rows `done` of finished jobs."""
    last: dict[str, int] = {}
    for row in done:
        last[row["job"]] = max(row["attempt"], last.get(row["job"], 0))
    return last


def current(catalogue: Catalogue, table: str, columns: Collection[str] = ()) -> list[Row]:
    """Return the rows of results of each present job's last attempt, and those that were made elsewhere."""
    names = {job.name for job in jobs(catalogue)}
    last = last_attempts(catalogue.rows("done"))
    wanted = [*columns, "job", "attempt"] if columns else ()
    return [
        row
        for row in catalogue.rows(table, wanted)
        if row["job"] == GIVEN or (row["job"] in names and row["attempt"] == last.get(row["job"], 1))
    ]


def status(catalogue: Catalogue) -> dict[str, Any]:
    """Return the counts of each vehicle, the vehicles of each sensor, and the failures, for JSON."""
    every, done = jobs(catalogue), catalogue.rows("done")
    calibrations = current(catalogue, "calibrations", ["vehicle", "supported"])
    given = Counter(row["vehicle"] for row in calibrations if row["job"] == GIVEN)
    own = [row for row in calibrations if row["job"] != GIVEN]
    names = {
        "new": {job.name for job in new_jobs(catalogue, every)},
        "calibrated": {row["job"] for row in own},
        "unsupported": {row["job"] for row in own if not row["supported"]},
        **{result: {row["job"] for row in done if row[result]} for result in ("diagnosed", "mapped")},
    }
    names["failed"] = {job.name for job in every} - names["calibrated"] - names["new"]
    counts: dict[str, dict[str, int]] = {}
    for vehicle in sorted({row["vehicle"] for row in catalogue.rows("vehicles", ["vehicle"])}):
        mine = [job for job in every if job.vehicle["vehicle"] == vehicle]
        counts[vehicle] = {result: sum(job.name in known for job in mine) for result, known in names.items()}
        counts[vehicle] |= {"deployments": len(mine), "logs": sum(len(job.files) for job in mine)}
        counts[vehicle]["given"] = given[vehicle]
    failures = [row["line"] for row in current(catalogue, "failures")]
    sensors: dict[str, set[str]] = {}
    for row in catalogue.rows("sensors"):
        sensors.setdefault(row["sensor"], set()).add(row["vehicle"])
    return {
        "vehicles": [
            {"vehicle": name, **{key: one[key] for key in STATUS_COLUMNS}} for name, one in counts.items()
        ],
        "sensors": [{"sensor": name, "vehicles": sorted(on)} for name, on in sorted(sensors.items())],
        "failures": failures,
    }
