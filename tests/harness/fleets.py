"""Small vehicles with one moving mass, and a fleet.toml of two of them."""

from functools import cache
from pathlib import Path

import numpy as np
from gliders import Glider, make

from magbridge.cli import main
from magbridge.fleet.catalogue import CATALOGUE_TABLES, Row
from magbridge.fleet.catalogue import FolderCatalogue as Catalogue
from magbridge.logs import write
from magbridge.logs.deployment import deployment

DAY = 86_400.0


@cache
def _glider(vehicle: int) -> Glider:
    return make(vehicle, masses=1)


def fly(path: Path, vehicle: int, number: int, start: float | None = None, sensor: str = "") -> Path:
    """Write calibration runs of a vehicle with one mass; each deployment draws an offset (5 nT, 1-sigma)."""
    runs = _glider(vehicle).runs
    rows = np.arange(0, len(runs), 2)
    rng = np.random.default_rng([vehicle, number])
    field = runs.field[rows] + rng.normal(0, 5, 3) + rng.normal(0, 1, (len(rows), 3))
    when = runs.time[rows] + 30 * DAY * number if start is None else start + 8.0 * np.arange(len(rows))
    columns = {f"mag_{axis}": field[:, k] for k, axis in enumerate("xyz")}
    columns |= {"battpos": runs.parameters[rows, 0], "reference_field": runs.reference[rows]}
    columns |= {"run": runs.runs[rows].astype(float)}
    path.parent.mkdir(parents=True, exist_ok=True)
    attrs = {"sensor": sensor} if sensor else {}
    write(deployment(path, when, columns, {"battpos": "in"}, attrs), path)
    return path


def catalogue_of(folder: Path, flown: Path) -> Catalogue:
    """Return a new catalogue in `folder` with the vehicles and logs of the fleet.toml in `flown`."""
    assert main(["fleet", "add", str(flown / "fleet.toml"), "--catalogue", str(folder / "fleet")]) == 0
    return Catalogue(folder / "fleet")


def content(catalogue: Catalogue) -> dict[str, list[Row]]:
    """Return the rows of each table of a catalogue."""
    return {table: catalogue.rows(table) for table in CATALOGUE_TABLES}


FLEET = """
[vehicle.one]
parameters = ["battpos"]
serial = "1"
[[vehicle.one.deployment]]
name = "first"
refit = "spring"
logs = ["one/first.nc"]
[[vehicle.one.deployment]]
name = "second"
refit = "spring"
logs = ["one/second.nc"]

[vehicle.two]
parameters = ["battpos"]
[[vehicle.two.deployment]]
name = "first"
logs = ["two/*.nc"]
"""
