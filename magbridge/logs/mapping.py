"""Map columns of other programs to standard names and units, by their headings or by declarations.

A user declares columns by ``--column`` and ``columns.toml``. ``makers.toml`` declares the columns of
instruments and autopilots as their makers document them. PX4's topics as ``ulog2csv`` writes them are in
microseconds since the boot and in gauss (PX4, msg/SensorMag.msg, msg/VehicleMagnetometer.msg). Geometrics'
MagMap writes the month first. DatCon's ``offsetTime`` counts seconds from the start of a DJI flight.
MagArrow's compass has its x to the right, its y aft and its z down (Geometrics, MagArrow user manual, 'Data
Format'); ``Mag`` is its caesium magnetometer. :mod:`.naming` recognises other columns by common names.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from math import isfinite
from pathlib import Path
from typing import Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import msgspec

from magbridge.columns import (
    COLUMNS,
    HEIGHT_GUESS,
    NT_PER_UNIT,
    bare,
    factor,
    is_height,
    unit_of_height,
    usual,
)
from magbridge.errors import WrongUse
from magbridge.toml import Table, check_entries, convert, load_toml

MAKERS_FILE = Path(__file__).with_name("makers.toml")
HEADING = re.compile(r"(?P<name>.*?)\s*(?:\[(?!\d+\])(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))?")
CELL_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([ed][-+]?\d+)?|[-+]?(nan|inf)|", re.IGNORECASE)
"""A cell that is a number, or empty; Fortran writes 1.5D+03."""
NAMES = load_toml(Path(__file__).with_name("names.toml"))
"""Names of columns and units in other programs."""
ALIASES = {column: names.split() for column, names in NAMES["columns"].items()}
"""Standard name -> names in other programs, the least ambiguous first."""
TOWED = NAMES["towed"].split()
"""Words before the name of a position that mark it as the towed sensor's, not the ship's."""
PREFIXED_COLUMNS = "latitude", "longitude", "roll", "pitch", "heading", "depth"
PREFIXED_NAME = re.compile(
    rf"(gps|gnss|location|position|pos|nav|ins|ship|vessel|{'|'.join(TOWED)})?(.+?)(deg|degrees|dd|wgs84|mag1)?"
)
"""Name of a position or an angle, with the words that may stand before and after it."""
PATTERNS = {name: re.compile(pattern) for name, pattern in NAMES["patterns"].items()}
KNOWN_UNITS = {*NT_PER_UNIT, *(column.units for column in COLUMNS.values()), *NAMES["units"].split()} - {"1"}
"""Units by which a row of units under the headings is recognised."""


class ColumnSource(Table, frozen=True, rename={"heading": "from"}):
    """Source of the column NAME in a log, as ``[columns.NAME]`` of a mapping file declares it.

    The column's value is ``scale * number + offset`` in `unit`, for a number in the log.
    """

    heading: str | None = None
    """Heading of the source in the log (key ``from``); by default NAME."""
    unit: str | None = None
    """Unit after scaling; of ``time`` also excel, julian, mjd, gps, matlab, iso, or a strptime pattern."""
    scale: float = 1.0
    offset: float = 0.0
    """`scale`, `offset`: Conversion of the log's number to `unit`."""
    valid: str | None = None
    """Heading of another column that is 0 where the value is missing."""

    def __post_init__(self) -> None:
        if not (isfinite(self.scale) and self.scale and isfinite(self.offset)):
            raise ValueError("expected a scale other than 0, and numbers")


class ColumnMapping(Table, frozen=True):
    """Content of a mapping file, ``columns.toml``."""

    columns: dict[str, ColumnSource] = msgspec.field(default_factory=dict)
    """Standard name of a column -> its :class:`ColumnSource`."""
    heading_reference: Literal["true", "magnetic", "inertial"] | None = None
    """North to which headings refer."""
    fill_value: float | None = None
    """The number that stands for a missing value."""
    separator: str | None = None
    decimal: Literal[".", ","] | None = None
    """`separator`, `decimal`: Characters of a text file; found in its first lines if not given."""
    zone: str | None = None
    """Time zone (``Europe/Berlin``) of times that do not state a zone; UTC if not given."""

    def __post_init__(self) -> None:
        if self.separator is not None and (len(self.separator) != 1 or self.separator in '"\r\n'):
            raise ValueError(f"separator: expected one character, got {self.separator!r}")
        try:
            ZoneInfo(self.zone or "UTC")
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(f"zone: expected a time zone as Europe/Berlin, got {self.zone!r}") from None


@dataclass(frozen=True)
class Options:
    """The user's options for reading logs."""

    strict: bool = False
    """True to reject a log if anything would be dropped from it."""
    date: float | None = None
    """Time of the boot, s since 1970 UTC, for logs whose times count from the boot."""
    compass: str | None = None
    """Number (from 0) or device id of the compass to use; None for the compass that the vehicle used."""
    sensor_log: tuple[Path, ...] = ()
    """Logs of a sensor with its own logger, whose rows get the telemetry of the vehicle's logs."""
    clock_offset_s: float = 0.0
    """Offset that is added to the times of a sensor's own log, s."""
    column: tuple[str, ...] = ()
    """Declarations of single columns, each ``NAME="THEIRS [unit]"``."""
    columns: Path | None = None
    """Mapping file (:class:`magbridge.logs.mapping.ColumnMapping`) that declares all columns of a log."""
    elsewhere: tuple[str, ...] = ()
    """Standard names of declared columns that another file has, and this one lacks."""

    @cached_property
    def declared(self) -> ColumnMapping:
        """Combined declarations of `columns` and `column`; raise ConfigError or WrongUse for a wrong one.

        A height that is declared as the depth is read as its opposite.
        """
        every = declared(self.column, self.columns)
        own = {name: source for name, source in every.columns.items() if name not in self.elsewhere}
        depth = own.get("depth", ColumnSource())
        name, unit = split(depth.heading or "")
        if is_height(name) and depth.scale == 1.0:
            in_feet = unit_of_height(name, depth.unit or unit) == "ft"
            own["depth"] = msgspec.structs.replace(depth, unit="ft" if in_feet else depth.unit, scale=-1.0)
        return msgspec.structs.replace(every, columns=own)


def guess_of_height(declared: ColumnMapping) -> list[str]:
    """Return the assumption, if any, that the column declared as depth counts upwards."""
    depth = declared.columns.get("depth", ColumnSource())
    is_opposite = depth.scale < 0.0 and is_height(split(depth.heading or "")[0])
    return [HEIGHT_GUESS.format(depth.heading)] if is_opposite else []


def declared(column: Sequence[str], file: Path | None) -> ColumnMapping:
    """Return the declarations of a ``columns.toml``, overruled by those of ``--column``."""
    declaration = ColumnMapping()
    if file:
        table = load_toml(file)
        check_entries(table, "columns", ColumnSource, file)
        declaration = convert(table, ColumnMapping, file)
    return msgspec.structs.replace(declaration, columns={**declaration.columns, **dict(map(_named, column))})


def _named(text: str) -> tuple[str, ColumnSource]:
    name, equals, heading = (part.strip() for part in text.partition("="))
    if not (name and equals and heading):
        raise WrongUse(f'--column {text}: expected NAME="THEIRS [unit]", as mag_x="Bx [uT]"')
    return name, ColumnSource(heading=heading)


class Maker(Table, frozen=True):
    """Columns of an instrument as its maker documents them, and the headings that identify its files."""

    headings: frozenset[str]
    columns: dict[str, ColumnSource]


@cache
def makers() -> dict[str, Maker]:
    """Return the instruments of ``makers.toml`` by name."""
    return convert(load_toml(MAKERS_FILE), dict[str, Maker], MAKERS_FILE)


def declared_by_maker(headings: Sequence[str], declared: ColumnMapping) -> tuple[str, ColumnMapping]:
    """Return the instrument's name ("" if unknown), and its maker's declarations overruled by the user's."""
    names = {heading.replace(" ", "") for heading in headings}
    for name, maker in makers().items():
        if maker.headings <= names:
            there = {ours: source for ours, source in maker.columns.items() if source.heading in names}
            return name, msgspec.structs.replace(declared, columns={**there, **declared.columns})
    return "", declared


def split(heading: str) -> tuple[str, str]:
    """Return the name and the unit of a heading: ``Bx [uT]``, ``Bx (uT)``, ``Bx/uT``, ``Bx_uT``, ``Bx, uT``.

    The last three forms are those of fields, and of names that mean a standard column: ``yaw_rad``.
    The unit is "" for a heading without one; a number in brackets, as in ``magADC[0]``, is an index.
    """
    match = HEADING.fullmatch(heading.strip())
    assert match is not None
    name, unit = match["name"].strip(), match["square"] or match["round"] or ""
    if not name:  # a heading that is only brackets is a name
        return heading.strip(), ""
    if not unit:
        for sign in re.finditer("[/_,]", name):
            header, tail = name[: sign.start()].strip(), name[sign.end() :].strip()
            if header and _may_end(header, tail):
                return header, tail
    return name, unit.strip()


def split_all(headings: Sequence[str]) -> list[tuple[str, str]]:
    """Return the name and the unit of each heading; ``depth_m`` next to ``depth`` keeps its name."""
    parts = [(heading, *split(heading)) for heading in headings]
    kept = {heading for heading, name, _ in parts if heading != name in headings and heading[-1] not in "])"}
    return [(heading, "") if heading in kept else (name, unit) for heading, name, unit in parts]


def _may_end(name: str, unit: str) -> bool:
    """Return True if a text behind a name is a unit of a field, or one that its standard column can have."""
    if usual(unit) in NT_PER_UNIT:
        return unit not in {"T", "G"}
    meant = ["depth"] if is_height(name) else []
    inner = PREFIXED_NAME.fullmatch(word := bare(name))
    for column in COLUMNS.keys() - {"time", "quality"}:
        known = {bare(column), *ALIASES.get(column, ())}
        prefixed = column in PREFIXED_COLUMNS and inner is not None and inner[2] in known
        meant += [column] if word in known or prefixed else []
    return unit not in {"", "1"} and any(factor(unit, column) is not None for column in meant)


def is_called(name: str, kind: str) -> bool:
    """Return True if a name, in lower case without punctuation, matches a pattern of ``names.toml``."""
    return PATTERNS[kind].fullmatch(bare(name)) is not None


def is_unit(text: str) -> bool:
    """Return True if a cell under the headings is a unit."""
    return usual(text.strip().strip("[]()")) in KNOWN_UNITS
