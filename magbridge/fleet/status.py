"""What is catalogued, what is done, what failed: from light columns only, so that it is quick."""

from __future__ import annotations

from collections import Counter
from typing import Any

from magbridge.fleet.catalogue import Catalogue
from magbridge.fleet.process import jobs, new_jobs

__all__ = ["status"]


def status(catalogue: Catalogue) -> dict[str, Any]:
    """Return, as a dictionary that JSON can hold, each vehicle's counts and the failures on record."""
    every = jobs(catalogue)
    new = {job.name for job in new_jobs(catalogue, every)}
    calibrated = {row["job"] for row in catalogue.rows("calibrations", ["job"])}
    unsupported = {
        row["job"] for row in catalogue.rows("calibrations", ["job", "supported"]) if not row["supported"]
    }
    names = {job.name for job in every}
    failures = [row for row in catalogue.rows("failures") if row["job"] in names]
    counts: dict[str, Counter[str]] = {}
    for job in every:
        done = job.name in calibrated
        counts.setdefault(job.vehicle["vehicle"], Counter()).update(
            deployments=1,
            logs=len(job.files),
            new=job.name in new,
            calibrated=done,
            unsupported=job.name in unsupported,
            failed=not done and job.name not in new,
        )
    for row in catalogue.rows("vehicles", ["vehicle"]):
        counts.setdefault(row["vehicle"], Counter())
    keys = ("deployments", "logs", "calibrated", "unsupported", "failed", "new")
    return {
        "vehicles": [
            {"vehicle": name, **{key: one[key] for key in keys}} for name, one in sorted(counts.items())
        ],
        "failures": [row["line"] for row in failures],
    }
