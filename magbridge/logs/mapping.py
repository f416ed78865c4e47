"""Map columns of other programs to ours, with units: ``--column`` and ``columns.toml``.

:data:`MAKERS` has the same for instruments and autopilots whose makers state what the columns mean. PX4's
topics as ``ulog2csv`` writes them are in microseconds since the boot and in gauss (PX4, msg/SensorMag.msg,
msg/VehicleMagnetometer.msg). Geometrics' MagMap writes the month first. DatCon's ``offsetTime`` counts
seconds from the start of a DJI flight. MagArrow's compass has its x to the right, its y aft and its z down
(Geometrics, MagArrow user manual, 'Data Format'); ``Mag`` is its caesium magnetometer.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import msgspec

from magbridge.errors import WrongUse
from magbridge.logs.headings import split
from magbridge.toml import Table, check_entries, convert, load_toml

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["ColumnMapping", "declared", "declared_by_maker", "renamed"]


class ColumnSource(Table, frozen=True, rename={"heading": "from"}):
    """``[columns.NAME]`` of a mapping file: where the column NAME comes from.

    The value is ``scale * theirs + offset``, in `unit`.
    """

    heading: str | None = None
    """Their name of the column (key ``from``), as the file has it; by default our own."""
    unit: str | None = None
    """Its unit after scaling, where the file does not say it or is wrong. Of ``time`` also: excel, julian,
    mjd, gps, matlab, iso, or a pattern as ``%d.%m.%Y %H:%M:%S``."""
    scale: float = 1.0
    offset: float = 0.0
    """`scale`, `offset`: By which their number becomes one in `unit`."""
    valid: str | None = None
    """Their name of a column that is 0 where a value is missing."""

    def __post_init__(self) -> None:
        if not (isfinite(self.scale) and self.scale and isfinite(self.offset)):
            raise ValueError("expected a scale other than 0, and numbers")


class ColumnMapping(Table, frozen=True):
    """A mapping file, ``columns.toml``, whole."""

    columns: dict[str, ColumnSource] = msgspec.field(default_factory=dict)
    """Our name of a column -> its :class:`ColumnSource`."""
    heading_reference: Literal["true", "magnetic"] | None = None
    """What headings refer to."""
    fill_value: float | None = None
    """The number that stands for a missing value."""
    separator: str | None = None
    decimal: Literal[".", ","] | None = None
    """`separator`, `decimal`: Characters of a text file; found in its first lines where they are not
    given."""
    zone: str | None = None
    """Time zone (``Europe/Berlin``) of times of day that do not say theirs; UTC if not given."""

    def __post_init__(self) -> None:
        if self.separator is not None and (len(self.separator) != 1 or self.separator in '"\r\n'):
            raise ValueError(f"separator: expected one character, got {self.separator!r}")
        try:
            ZoneInfo(self.zone or "UTC")
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(f"zone: expected a time zone as Europe/Berlin, got {self.zone!r}") from None


def declared(column: Sequence[str], file: Path | None) -> ColumnMapping:
    """Return the combined declarations of a mapping file and of ``--column``.

    Parameters
    ----------
    column : sequence of str
        ``NAME="THEIRS [unit]"``; each overrules the file.
    file : path or None
        A ``columns.toml``.

    Raises
    ------
    ConfigError
        A key of the mapping file that is wrong.
    WrongUse
        A text without its name.
    """
    declaration = _load(file) if file else ColumnMapping()
    return msgspec.structs.replace(declaration, columns={**declaration.columns, **dict(map(_named, column))})


def _load(path: Path) -> ColumnMapping:
    table = load_toml(path)
    check_entries(table, "columns", ColumnSource, path)
    return convert(table, ColumnMapping, path)


def _named(text: str) -> tuple[str, ColumnSource]:
    name, equals, heading = (part.strip() for part in text.partition("="))
    if not (name and equals and heading):
        raise WrongUse(f'--column {text}: expected NAME="THEIRS [unit]", as mag_x="Bx [uT]"')
    return name, ColumnSource(heading=heading)


def renamed(dataset: xr.Dataset, declaration: ColumnMapping) -> xr.Dataset:
    """Rename the columns of a deployment as declared, for formats with column names of their own.

    FormatError: a column that is not there, or a unit that does not fit ours.
    """
    from magbridge.columns import require  # noqa: PLC0415 - xarray is for ashore
    from magbridge.logs.deployment import deployment  # noqa: PLC0415

    taken: dict[str, Any] = {}
    for name, source in declaration.columns.items():
        theirs, unit = _column(dataset, name, source)
        require(dataset, [theirs])
        values = source.scale * dataset[theirs].to_numpy() + source.offset
        unit = unit or str(dataset[theirs].attrs.get("units", ""))
        part = deployment(dataset.attrs["source"], dataset["time"].to_numpy(), {name: values}, {name: unit})
        taken[name] = part[name]
    used = {_column(dataset, name, source)[0] for name, source in declaration.columns.items()}
    named = dataset.drop_vars(used - declaration.columns.keys()).assign(taken)
    return named.assign_attrs(
        {"heading_reference": declaration.heading_reference} if declaration.heading_reference else {}
    )


def _column(dataset: xr.Dataset, name: str, source: ColumnSource) -> tuple[str, str]:
    """Return the name of the column of `source`, and its declared unit."""
    theirs = source.heading or name
    if theirs in dataset:
        return theirs, source.unit or ""
    theirs, unit = split(theirs)
    return theirs, source.unit or unit


MAKERS: dict[str, tuple[set[str], dict[str, ColumnSource]]] = {
    "MagArrow": (
        {"Counter", "Date", "Time", "Mag", "MagValid"},
        {
            "total_field": ColumnSource(heading="Mag", unit="nT", valid="MagValid"),
            "mag_x": ColumnSource(heading="CompassY", unit="nT", scale=-1.0),
            "mag_y": ColumnSource(heading="CompassX", unit="nT"),
            "mag_z": ColumnSource(heading="CompassZ", unit="nT"),
            "sensor_temperature": ColumnSource(heading="CompassTemperature", unit="degC"),
        },
    ),
    "MagMap": (
        {"READING_1", "DATE", "TIME", "LINE", "MARK"},
        {
            "total_field": ColumnSource(heading="READING_1", unit="nT"),
            "time": ColumnSource(heading="TIME", unit="%m/%d/%y %H:%M:%S"),
        },
    ),
    "DJI's DatCon": (
        {"Tick#", "offsetTime"},
        {
            "time": ColumnSource(heading="offsetTime", unit="s"),
            "latitude": ColumnSource(heading="GPS:Lat", unit="deg"),
            "longitude": ColumnSource(heading="GPS:Long", unit="deg"),
            "roll": ColumnSource(heading="IMU_ATTI(0):roll:C", unit="deg"),
            "pitch": ColumnSource(heading="IMU_ATTI(0):pitch:C", unit="deg"),
            "heading": ColumnSource(heading="IMU_ATTI(0):yaw:C", unit="deg"),
        },
    ),
    "an RM3100 logger": (
        {"ts", "rt", "lt", "x", "y", "z", "rx", "ry", "rz"},
        {f"mag_{axis}": ColumnSource(heading=axis, unit="uT") for axis in "xyz"}
        | {"sensor_temperature": ColumnSource(heading="rt", unit="degC")},
    ),
    "PX4's vehicle_magnetometer": (
        {"timestamp", "device_id", "magnetometer_ga[0]"},
        {"time": ColumnSource(heading="timestamp", unit="us")}
        | {
            f"mag_{axis}": ColumnSource(heading=f"magnetometer_ga[{k}]", unit="G")
            for k, axis in enumerate("xyz")
        },
    ),
    "PX4's sensor_mag": (
        {"timestamp", "device_id", "x", "error_count"},
        {"time": ColumnSource(heading="timestamp", unit="us")}
        | {f"mag_{axis}": ColumnSource(heading=axis, unit="G") for axis in "xyz"},
    ),
}
"""Instrument -> headings by which its files are known, and what its columns are."""


def declared_by_maker(headings: Sequence[str], declared: ColumnMapping) -> tuple[str, ColumnMapping]:
    """Return the instrument's name and its maker's declarations; the user's declarations have priority.

    The name is empty where the headings are of no known instrument.
    """
    bare = {heading.replace(" ", "") for heading in headings}
    for name, (known, columns) in MAKERS.items():
        if known <= bare:
            there = {ours: source for ours, source in columns.items() if source.heading in bare}
            return name, msgspec.structs.replace(declared, columns={**there, **declared.columns})
    return "", declared
