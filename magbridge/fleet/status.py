"""Catalogued, finished and failed deployments: from light columns only, so that it is quick."""

from __future__ import annotations

from collections import Counter
from typing import Any

from magbridge.fleet.catalogue import Catalogue
from magbridge.fleet.job import GIVEN, jobs, last_attempts, new_jobs

__all__ = ["status"]

STATUS_COLUMNS = (
    "deployments", "logs", "calibrated", "unsupported", "failed", "new", "given", "diagnosed", "mapped"
)  # fmt: skip
"""Of each vehicle; `given` are calibrations made elsewhere."""


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
