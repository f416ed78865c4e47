"""Read and write netCDF: one trajectory.

A file is written along the dimension ``time`` with the documented names of the columns, so that
``xarray.open_dataset`` gives the same names as :func:`magbridge.logs.read`. With the vocabulary of
OceanGliders OG1.0 it is written along ``N_MEASUREMENTS`` in capitals instead: ``TIME LATITUDE LONGITUDE DEPTH
ROLL PITCH HEADING TEMP PRES`` are names of OG1.0, the others the documented names in capitals (``MAG_X``).
The attribute ``column`` keeps the documented name in both. Any trajectory is read, by
:mod:`magbridge.logs.trajectory`; a basestation's Seaglider file is recognised by its dimensions and read by
:mod:`magbridge.logs.seaglider`.

References
----------
OceanGliders format 1.0, https://oceangliderscommunity.github.io/OG-format-user-manual/OG_Format.html
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.errors import FormatError, MissingExtra
from magbridge.files import systems_reason
from magbridge.logs import seaglider, trajectory
from magbridge.logs.cf import EPOCH
from magbridge.logs.deployment import sliced
from magbridge.logs.validity import known
from magbridge.records import Quality
from magbridge.version import __version__

try:
    import netCDF4
except ImportError:
    raise MissingExtra("netCDF4", "analysis") from None

__all__ = ["FileWriter", "chunks"]

OG1_DIMENSION = "N_MEASUREMENTS"
OG1_NAMES = {"water_temperature": "TEMP", "water_pressure": "PRES"}
"""Columns whose OG1.0 name is not simply our name in capitals."""
CF_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "time": {"standard_name": "time", "calendar": "gregorian", "units": EPOCH},
    "latitude": {"standard_name": "latitude", "units": "degrees_north"},
    "longitude": {"standard_name": "longitude", "units": "degrees_east"},
    "depth": {"standard_name": "depth", "units": "m", "positive": "down"},
    "roll": {"standard_name": "platform_roll"},
    "pitch": {"standard_name": "platform_pitch"},
    "heading": {"standard_name": "platform_yaw"},
    "water_temperature": {"standard_name": "sea_water_temperature"},
    "water_pressure": {"standard_name": "sea_water_pressure"},
}
COORDINATES = "time", "latitude", "longitude", "depth"
NO_FLAGS = -1
"""Stands for flags that are not known."""
STORED_ROWS = 8192
"""Rows stored together."""


def chunks(path: Path, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file as deployments of at most `rows` rows, each with their numbers.

    FormatError: not netCDF or cut short, or no time in it.
    """
    try:
        with netCDF4.Dataset(path) as file:
            if seaglider.DIMENSION in file.dimensions:
                whole = seaglider.dive(path, seaglider.read_netcdf(path, file))
                for k, part in enumerate(sliced(whole, rows)):
                    yield part, range(k * rows + 1, k * rows + 1 + part.sizes["time"])
            else:
                ours = any("column" in variable.ncattrs() for variable in file.variables.values())
                for part, numbers in trajectory.chunks(path, file, rows):
                    yield (part, numbers) if ours else known(path, part, numbers)
    except (OSError, RuntimeError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(path, f"expected a whole netCDF file: {reason}") from None


class FileWriter:
    """Write successive deployments with the columns of the first one.

    Parameters
    ----------
    path : Path
        The file to write.
    og1 : bool
        The names are those of OG1.0, instead of the documented ones.
    """

    def __init__(self, path: Path, *, og1: bool = False) -> None:
        self._path, self._og1 = path, og1
        self._dimension = OG1_DIMENSION if og1 else "time"
        with systems_reason(path):
            self._file = netCDF4.Dataset(path, "w", format="NETCDF4")
        self._variables: dict[str, Any] = {}
        self._rows = 0

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows, and before the first ones the definitions."""
        with systems_reason(self._path):
            if first:
                self._define(dataset)
            n = dataset.sizes["time"]
            for name, variable in self._variables.items():
                values = dataset[name].values
                if name == "quality":
                    values = np.where(np.isnan(values), NO_FLAGS, values).astype(np.int32)
                variable[self._rows : self._rows + n] = values
            self._rows += n
            if n:
                self._file.time_coverage_end = _iso(float(dataset["time"][-1]))

    def _define(self, dataset: xr.Dataset) -> None:
        file = self._file
        file.set_auto_mask(False)
        file.createDimension(self._dimension, None)
        first = float(dataset["time"][0]) if dataset.sizes["time"] else 0.0
        file.setncatts(
            {
                key: value
                for key, value in dataset.attrs.items()
                if isinstance(value, (str, int, float)) and "/" not in key  # which netCDF forbids
            }
            | {
                "title": "magnetometer deployment",
                "featureType": "trajectory",
                "Conventions": "CF-1.11, ACDD-1.3",
                "start_date": _iso(first),
                "time_coverage_start": _iso(first),
                "history": _history(str(dataset.attrs.get("history", ""))),
            }
        )
        trajectory = file.createVariable(self._written("trajectory"), str)
        trajectory.setncatts({"cf_role": "trajectory_id", "long_name": "trajectory name"})
        trajectory[...] = str(dataset.attrs.get("source", ""))
        there = [name for name in COORDINATES if name == "time" or name in dataset]
        coordinates = " ".join(self._written(name) for name in there)
        taken = {self._written("trajectory")}
        for name in ("time", *(str(name) for name in dataset.data_vars)):
            written = self._written(name)
            while written in taken:
                written += "_"
            taken.add(written)
            attrs = dict(dataset[name].attrs) | CF_ATTRIBUTES.get(name, {})
            flags = name == "quality"  # CF: flags have the type of their masks
            # a coordinate of CF has no fill value: a time is never missing
            fill = {"time": None, "quality": NO_FLAGS}.get(name, np.nan)
            variable = file.createVariable(
                written, "i4" if flags else "f8", (self._dimension,), fill_value=fill, zlib=True, complevel=1,
                chunksizes=(STORED_ROWS,),
            )  # fmt: skip
            if flags:
                attrs["flag_masks"] = np.array([int(flag) for flag in Quality], np.int32)
                attrs["flag_meanings"] = " ".join(str(flag.name).lower() for flag in Quality)
            if name not in COORDINATES and coordinates:
                attrs["coordinates"] = coordinates
            if flags:
                attrs.pop("units", None)
            elif attrs.get("units") == "deg":
                attrs["units"] = "degree"  # UDUNITS knows no deg
            variable.setncatts(attrs)
            variable.setncatts({"column": name})
            self._variables[name] = variable

    def _written(self, name: str) -> str:
        """Return the name of a column's variable; netCDF forbids slashes in it."""
        return (OG1_NAMES.get(name, name.upper()) if self._og1 else name).replace("/", "_")

    def close(self) -> None:
        """Write everything to the file and close it."""
        with systems_reason(self._path):
            self._file.close()


def _history(previous: str) -> str:
    """Return the history, one entry per line, with an entry for this file."""
    written = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} written by magbridge {__version__}"
    return "\n".join(line for line in (*previous.splitlines(), written) if line)


def _iso(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y%m%dT%H%M%S")
