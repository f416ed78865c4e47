"""What there is to do, and what is done: a deployment of the catalogue is a job, named by its inputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from itertools import groupby
from typing import Any

import msgspec

from magbridge.fleet.catalogue import Catalogue, Row
from magbridge.fleet.register import current_files, vehicles

__all__ = ["GIVEN", "Job", "jobs", "last_attempts", "new_jobs", "status"]

GIVEN = "given"
"""In the place of a job's name: the result was made elsewhere."""
STATUS_COLUMNS = (
    "deployments", "logs", "calibrated", "unsupported", "failed", "new", "given", "diagnosed", "mapped"
)  # fmt: skip
"""Of each vehicle; `given` are calibrations made elsewhere."""


@dataclass(frozen=True)
class Job:
    """A deployment to process: its vehicle's row, and those of its logs."""

    vehicle: Row
    deployment: str
    refit: str
    files: tuple[Row, ...]
    diagnose: bool = False
    map: bool = False
    attempt: int = 1

    @property
    def sensor(self) -> str:
        """The sensor it flew with; empty: whichever."""
        return str(next((row["sensor"] for row in self.files if row["sensor"]), self.vehicle["sensor"]))

    @property
    def mark(self) -> Row:
        """What each of its results begins with."""
        return {"job": self.name, "attempt": self.attempt}

    @cached_property
    def name(self) -> str:
        """What its results are made of, as 32 hexadecimal digits: other logs or parameters, another name."""
        made_of = (
            self.vehicle["vehicle"], self.deployment, self.refit, self.sensor,
            self.vehicle["parameters"], self.vehicle["order"], sorted({row["sha256"] for row in self.files}),
        )  # fmt: skip
        return sha256(msgspec.json.encode(made_of)).hexdigest()[:32]


def jobs(catalogue: Catalogue, *, diagnose: bool = False, maps: bool = False) -> list[Job]:
    """Return every deployment of a catalogue as a job, processed or not.

    Parameters
    ----------
    catalogue : Catalogue
        Its files and vehicles.
    diagnose, maps : bool
        Whether each is also to be diagnosed, and mapped.
    """
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
    """Return the jobs of which the catalogue has no result; with `retry`, also those with failures."""
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
        wanted = (job.diagnose and (job.name, "diagnosed") not in has) or (
            job.map and (job.name, "mapped") not in has
        )
        if more or wanted or job.name not in last:
            todo.append(replace(job, attempt=last.get(job.name, 1) + more))
    return todo


def last_attempts(done: Iterable[Row]) -> dict[str, int]:
    """Return the last attempt at each job, from the rows of finished jobs."""
    last: dict[str, int] = {}
    for row in done:
        last[row["job"]] = max(row["attempt"], last.get(row["job"], 0))
    return last


def status(catalogue: Catalogue) -> dict[str, Any]:
    """Return, as a dictionary that JSON can hold, each vehicle's counts and the failures on record."""
    every = {job.name: job for job in jobs(catalogue)}
    done = catalogue.rows("done")
    last = last_attempts(done)
    new = {job.name for job in new_jobs(catalogue, list(every.values()))}
    counts = {row["vehicle"]: Counter[str]() for row in catalogue.rows("vehicles", ["vehicle"])}
    for job in every.values():
        counts[job.vehicle["vehicle"]].update(deployments=1, logs=len(job.files), new=int(job.name in new))
    calibrated = set[str]()
    for row in catalogue.rows("calibrations", ["job", "attempt", "vehicle", "supported"]):
        if row["job"] == GIVEN:
            counts[row["vehicle"]].update(given=1)
        elif row["job"] in every and row["attempt"] == last.get(row["job"], 1):
            calibrated.add(row["job"])
            counts[row["vehicle"]].update(calibrated=1, unsupported=int(not row["supported"]))
    for name in every.keys() - calibrated - new:
        counts[every[name].vehicle["vehicle"]].update(failed=1)
    for what in ("diagnosed", "mapped"):
        for name in {row["job"] for row in done if row[what]} & every.keys():
            counts[every[name].vehicle["vehicle"]].update({what: 1})
    failures = [
        row["line"]
        for row in catalogue.rows("failures")
        if row["job"] in every and row["attempt"] == last.get(row["job"], 1)
    ]
    sensors: dict[str, set[str]] = {}
    for row in catalogue.rows("sensors"):
        sensors.setdefault(row["sensor"], set()).add(row["vehicle"])
    return {
        "vehicles": [
            {"vehicle": name, **{key: one[key] for key in STATUS_COLUMNS}}
            for name, one in sorted(counts.items())
        ],
        "sensors": [{"sensor": name, "vehicles": sorted(on)} for name, on in sorted(sensors.items())],
        "failures": failures,
    }
