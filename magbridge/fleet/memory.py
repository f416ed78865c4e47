"""What a catalogue's deployments have taught, and what it expects of the next."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magbridge.calibration.file import decode_calibration
from magbridge.calibration.fitting.known import Information
from magbridge.calibration.terms import Polynomial
from magbridge.errors import DataError, WrongUse
from magbridge.fleet.catalogue import Catalogue, Row
from magbridge.fleet.learn import Fleet, Lesson, learn_fleet
from magbridge.fleet.process import jobs
from magbridge.fleet.register import current_files, vehicles

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

__all__ = ["current", "fleet_of", "lessons", "owner"]


def current(catalogue: Catalogue, table: str) -> list[Row]:
    """Return the rows of a table of results that are made of what the catalogue's logs are now."""
    names = {job.name for job in jobs(catalogue)}
    return [row for row in catalogue.rows(table) if row["job"] in names]


def lessons(catalogue: Catalogue, like: str, without: Collection[str] = ()) -> list[Lesson]:
    """Return what deployments of vehicles with the masses of one, `like`, have taught.

    What has been learnt from logs of these SHA-256, `without`, is left out.

    Raises
    ------
    WrongUse
        There is no such vehicle.
    """
    known = vehicles(catalogue)
    if like not in known:
        raise WrongUse(f"{like}: not a vehicle of {catalogue.folder} ({', '.join(known) or 'none yet'})")

    def kind(name: str) -> tuple[list[str], int]:
        return known[name]["parameters"], known[name]["order"]

    rows = (row for row in current(catalogue, "calibrations") if row["precision"])
    found = [_lesson(row) for row in rows if kind(row["vehicle"]) == kind(like)]
    return [one for one, inputs in found if not inputs & set(without)]


def fleet_of(catalogue: Catalogue, vehicle: str, without: Collection[str] = ()) -> Fleet:
    """Return what the vehicles with the masses of this one have taught; `without` as for :func:`lessons`.

    Raises
    ------
    WrongUse
        There is no such vehicle.
    DataError
        Nothing has been calibrated yet, or the columns' units differ.
    """
    found = lessons(catalogue, vehicle, without)
    units = {tuple(one.unit for one in lesson.parameters) for lesson in found}
    if len(units) > 1:
        both = " and ".join(", ".join(one) for one in sorted(units))
        raise DataError(
            f"{catalogue.folder}: {vehicle}'s fleet gives its positions in different units: {both}"
        )
    return learn_fleet(found)


def owner(catalogue: Catalogue, digests: Iterable[str]) -> tuple[str, str]:
    """Return vehicle and refit of logs by their SHA-256.

    Raises
    ------
    WrongUse
        They are not catalogued, or are of several vehicles.
    """
    wanted = set(digests)
    rows = [row for row in current_files(catalogue.rows("files")) if row["sha256"] in wanted]
    found = {(row["vehicle"], row["refit"]) for row in rows}
    if len({vehicle for vehicle, _ in found}) != 1:
        said = "of several of its vehicles" if found else "in its catalogue of none"
        raise WrongUse(f"--fleet {catalogue.folder}: the logs are {said}: name the vehicle (--member)")
    return sorted(found)[-1]


def _lesson(row: Row) -> tuple[Lesson, set[str]]:
    """Return what a calibration has taught, and the SHA-256 of what it was made from."""
    calibration = decode_calibration(row["calibration"].encode(), f"calibration of {row['deployment']}")
    term = calibration.terms[0]
    assert isinstance(term, Polynomial)
    size = len(row["vector"])
    told = Information(np.reshape(row["precision"], (size, size)), np.array(row["vector"]))
    lesson = Lesson(
        row["vehicle"], row["refit"], row["deployment"], row["start"], calibration.parameters,
        term.exponents, calibration.reference.field, told,
    )  # fmt: skip
    return lesson, set(calibration.inputs.values())
