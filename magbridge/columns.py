"""Define the columns of a deployment: names, units and meanings.

The file ``standard_columns.toml`` lists them. The names are public: files, the command line and the link use
them. A column of any other name is telemetry in the unit that it declares.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from magbridge.errors import FormatError
from magbridge.wording import suggestion

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "AGE", "CHANNELS", "CHANNEL_TIMES", "COLUMNS", "CORRECTED", "FURTHER_AXIS", "HEADINGS", "HEIGHT_GUESS",
    "NT_PER_UNIT", "TEMPERATURE", "YEAR_1980", "Column", "absent", "bare", "counts_from_boot", "decoded",
    "factor", "is_height", "may_be", "require", "require_units", "time_columns", "unit_of_height", "usual",
]  # fmt: skip


class Column(NamedTuple):
    """Unit and meaning of a column; the fields have the names of the variable's attributes."""

    units: str
    long_name: str


CHANNELS = ("mag_x", "mag_y", "mag_z")
"""The raw, uncorrected channels in sensor axes (x forward, y starboard, z down)."""
CHANNEL_TIMES = ("mag_time_x", "mag_time_y", "mag_time_z")
"""Columns with the sampling time of each channel, for logs in which they differ from ``time``."""
FURTHER_AXIS = re.compile(r"mag[1-9]\d*_[xyz]")
"""Pattern of the names of further vector sensors' channels, which are in nT like the first sensor's."""
AGE = "age_"
"""Prefix of a parameter's name for the column with the age of its value, s, in a bridge's log."""

TEMPERATURE = "sensor_temperature"
"""Column of the temperature at the fluxgate: the only calibration channel that comes with a reading."""
_TEXT = Path(__file__).with_name("standard_columns.toml").read_text("utf-8")
_TABLES: dict[str, dict[str, list[str]]] = tomllib.loads(_TEXT)
COLUMNS = {name: Column(units, meaning) for name, (units, meaning) in _TABLES["columns"].items()}
CORRECTED = ("total_field", "total_field_sigma", "field_x", "field_y", "field_z", "anomaly", "quality")
"""Columns that ``magbridge correct`` writes in addition to ``time``."""

HEADINGS = ("magnetic_heading", "heading", "heading_sigma", "declination", "declination_sigma")
"""Columns that ``magbridge correct`` adds if the log has roll and pitch and the calibration a boresight."""

NT_PER_UNIT = {
    "fT": 1e-6, "pT": 1e-3, "nT": 1.0, "uT": 1e3, "µT": 1e3, "mT": 1e6, "T": 1e9,
    "uG": 1e-1, "mG": 1e2, "G": 1e5,
}  # fmt: skip
"""Size of each unit of magnetic flux density, nT."""

_FACTORS = {
    **{(unit, "nT"): factor for unit, factor in NT_PER_UNIT.items()},
    ("ms", "s"): 1e-3,
    ("rad", "deg"): 57.29577951308232,
    ("cm", "m"): 1e-2,
    ("km", "m"): 1e3,
    ("ft", "m"): 0.3048,
    ("cm/s", "m/s"): 1e-2,
}
_SAME = {other: unit for unit, others in _TABLES["spellings"].items() for other in others}
"""Spelling of a unit in other programs' files -> unit of magbridge."""
_CHARACTERS = str.maketrans({"²": "2", "³": "3", "\N{GREEK SMALL LETTER MU}": "\N{MICRO SIGN}"})
_POWER = re.compile(r"(\^|\*\*)(?=[-\d])")
_HEIGHT = re.compile(
    r"(gps|gnss|msl|ellipsoid(al)?|baro|barometric)?(alt|altitude|height|hohe)"
    r"(msl|amsl|asl|gps|ellipsoid(al)?|wgs84)?(m|ft|feet)?"
)
HEIGHT_GUESS = "depth is minus {!r}, as height above the sea"
"""Assumption about a column that is called a height (:func:`is_height`)."""


MAX_NAMES = 60
"""Largest number of columns that a message lists."""
YEAR_1980 = 315_532_800.0
"""Start of 1980, s since 1970: an earlier time means that the clock was never set."""


def counts_from_boot(deployment: xr.Dataset) -> bool:
    """Return True if the times of a deployment count from a boot and their date is unknown.

    This is so if the log states ``time_reference = boot``. A reader states ``utc`` for dates and for counts
    since an epoch. Only numbers without a stated reference are taken for a count from a boot by their size:
    if they end before 1980.
    """
    time = deployment["time"].values
    reference = deployment.attrs.get("time_reference", "utc" if time.dtype.kind == "M" else None)
    return reference == "boot" or bool(time.size and reference is None and time[-1] < YEAR_1980)


def time_columns(deployment: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the columns (n,) of a deployment that contain times, by name."""
    return {name: deployment[name] for name in ("time", *CHANNEL_TIMES) if name in deployment.variables}


def decoded(deployment: xr.Dataset) -> xr.Dataset:
    """Return a deployment with its times converted to datetime64 (UTC, ns).

    Times that count from a boot are converted as if they counted from 1970.
    """
    import numpy as np  # noqa: PLC0415 - drivers need the units without numpy

    for name, time in time_columns(deployment).items():
        if time.dtype.kind == "M":
            continue
        seconds = np.where(np.isfinite(time.values), time.values, 0.0)
        whole = np.floor(seconds)
        moments = whole.astype("datetime64[s]").astype("datetime64[ns]")
        moments = moments + np.rint((seconds - whole) * 1e9).astype("timedelta64[ns]")
        moments[~np.isfinite(time.values)] = np.datetime64("NaT")
        described = {key: value for key, value in time.attrs.items() if key != "units"}
        deployment = deployment.assign({name: (time.dims, moments, described)})
    return deployment


def factor(unit: str, column: str) -> float | None:
    """Return the factor that converts `unit` to the unit of `column`; None without a conversion.

    The factor is 1 for a column that is not in :data:`COLUMNS`, which keeps its declared unit. It is also 1
    for an undeclared unit (an empty text or "1").
    """
    if unit in ("", "1"):
        return 1.0
    if FURTHER_AXIS.fullmatch(column):
        return NT_PER_UNIT.get(usual(unit), 1.0)
    if column not in COLUMNS:
        return 1.0
    wanted, unit = COLUMNS[column].units, usual(unit)
    return 1.0 if unit == wanted else _FACTORS.get((unit, wanted))


def usual(unit: str) -> str:
    """Return a unit in the spelling of :data:`COLUMNS`, such as ``degC`` for ``Celsius``."""
    unit = _POWER.sub("", unit.strip().translate(_CHARACTERS))
    written_out = unit.lower().replace("-", "").replace(" ", "").replace("teslas", "tesla")
    return _SAME.get(unit) or (_SAME.get(written_out, unit) if len(written_out) > 4 else unit)


def bare(name: str) -> str:
    """Return a name in lower case, without punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def is_height(name: str) -> bool:
    """Return True if a column is called a height above the sea, as ``altitude`` or ``gps_alt_m``."""
    return _HEIGHT.fullmatch(bare(name)) is not None


def unit_of_height(name: str, unit: str) -> str:
    """Return the unit of a height: `unit` if it is declared, else the one in its name, else m."""
    return unit if unit not in ("", "1") else "ft" if bare(name).endswith(("ft", "feet")) else "m"


def may_be(unit: str, other_unit: str) -> bool:
    """Return True if two units are equal, or at least one is undeclared (an empty text or "1")."""
    return {unit, other_unit} & {"", "1"} != set() or usual(unit) == usual(other_unit)


def absent(name: str, present: Iterable[str]) -> str:
    """Return the message that the column `name` is missing, with the present columns and a remedy."""
    names = [repr(one) if " " in one else one for one in present]
    headings = " ".join(names[:MAX_NAMES]) + f" and {len(names) - MAX_NAMES} more" * (len(names) > MAX_NAMES)
    near = suggestion(name, names)
    return f'expected this column{near}; there are: {headings}; if one is it: --column {name}="THEIRS [unit]"'


def require(deployment: xr.Dataset, names: Iterable[str]) -> None:
    """Check that a deployment has all columns in `names`; FormatError: names the first that is missing."""
    for name in names:
        if name not in deployment:
            source = deployment.attrs.get("source", "the deployment")
            guessed = f"; guessed: {deployment.attrs['guessed']}" if "guessed" in deployment.attrs else ""
            there = [str(column) for column in deployment.data_vars]
            raise FormatError(source, absent(name, there) + guessed, column=name)


def require_units(deployment: xr.Dataset, units: Mapping[str, str]) -> None:
    """Check that columns have the `units` (column -> unit) if they declare one; FormatError: names one."""
    for name, unit in units.items():
        given = str(deployment[name].attrs.get("units", "")) if name in deployment else ""
        if not may_be(given, unit):
            expected = f"expected {unit!r}, the calibration's unit, not {given!r}"
            raise FormatError(deployment.attrs.get("source", "the deployment"), expected, column=name)
