"""Which fields of which of ArduPilot's records become columns, and in what unit.

A log of ArduPilot 3.6 or later declares its units itself (``FMTU``, ``UNIT``, ``MULT``); units that it
declares replace those of this table.
"""

from __future__ import annotations

import numpy as np

from magbridge.logs.autopilot import Fields
from magbridge.logs.dataflash import OWN_SCALE, Flash

__all__ = [
    "ARDUPILOT_FIELDS", "INSTANCE", "SURVEY", "SURVEY_AXES", "SURVEY_ID", "WANTED", "in_declared_units",
    "in_hundredths",
]  # fmt: skip

ARDUPILOT_FIELDS: Fields = {
    "ATT": (("roll", "Roll", "deg", 1.0), ("pitch", "Pitch", "deg", 1.0), ("heading", "Yaw", "deg", 1.0)),
    "AHR2": (("roll", "Roll", "deg", 1.0), ("pitch", "Pitch", "deg", 1.0), ("heading", "Yaw", "deg", 1.0)),
    "POS": (
        ("latitude", "Lat", "deg", 1.0),
        ("longitude", "Lng", "deg", 1.0),
        ("depth", "RelHomeAlt", "m", -1.0),
    ),
    "GPS": (("latitude", "Lat", "deg", 1.0), ("longitude", "Lng", "deg", 1.0)),
    "CTUN": (("depth", "Alt", "m", -1.0), ("throttle", "ThO", "1", 1.0)),
    "THR": (("throttle", "ThrOut", "%", 1.0),),
    "MOTB": (("motor_throttle", "ThrOut", "1", 1.0),),
    "BAT": (("battery#_current", "Curr", "A", 1.0), ("battery#_voltage", "Volt", "V", 1.0)),
    "CURR": (("battery#_current", "Curr", "A", 1.0), ("battery#_voltage", "Volt", "V", 1.0)),
    "BARO": (
        ("pressure#", "Press", "hPa", 0.01),
        ("pressure#_temperature", "Temp", "degC", 1.0),
        ("depth", "Alt", "m", -1.0),
    ),
    "ESC": (
        ("esc#_current", "Curr", "A", 1.0),
        ("esc#_voltage", "Volt", "V", 1.0),
        ("esc#_rpm", "RPM", "rpm", 1.0),
        ("esc#_temperature", "Temp", "degC", 1.0),
    ),
    "RPM": (("rpm#", "RPM", "rpm", 1.0), ("rpm", "rpm1", "rpm", 1.0), ("rpm2", "rpm2", "rpm", 1.0)),
    "IMU": (("imu#_temperature", "T", "degC", 1.0),),
    "RCOU": tuple((f"servo{k}", f"C{k}", "us", 1.0) for k in range(1, 15)),
    "RCO2": tuple((f"servo{k}", f"C{k}", "us", 1.0) for k in range(15, 19)),
    "RCO3": tuple((f"servo{k}", f"C{k}", "us", 1.0) for k in range(19, 33)),
}
"""Of records with one column, the first that the log has is taken. Sub's and Copter's CTUN have height and
throttle, Rover's throttle is in THR, that of all motors together in MOTB."""
INSTANCE = ("I", "Instance", "Inst")
TIME_FIELDS = ("TimeUS", "TimeMS")
"""s since the boot in µs, or in ms up to ArduPilot 3.2."""
SURVEY, SURVEY_ID, SURVEY_AXES = "MAGH", ("Node", "Sensor", "Bus"), ("Mx", "My", "Mz")
"""Record of a survey magnetometer, what distinguishes several, and their axes in G."""
POWER_MESSAGES = "CURR", "BAT"
MAX_VOLTAGE_V = 100.0
"""Larger integers in a log that does not declare its units are in hundredths of V and A."""
NUMBERED = 8
MAG = {*(f"{what}{axis}" for what in ("Mag", "Ofs", "MO", "MOfs") for axis in "XYZ"), "Health", *INSTANCE}
WANTED: dict[str, set[str]] = {
    **{
        f"{name}{k}": {*TIME_FIELDS, *INSTANCE, *(field for _, field, _, _ in fields)}
        for name, fields in {
            **ARDUPILOT_FIELDS,
            "MAG": tuple(("", field, "", 1.0) for field in sorted(MAG)),
        }.items()
        for k in ("", *range(2, NUMBERED + 1))
    },
    SURVEY: {*TIME_FIELDS, *SURVEY_ID, *SURVEY_AXES},
    "PARM": {"TimeUS", "Name", "Value"},
    "XKFS": {"TimeUS", "MI"},
    "FMT": {"Type", "Name", "Columns"},
    "FMTU": {"FmtType", "UnitIds", "MultIds"},
    "UNIT": {"Id", "Label"},
    "MULT": {"Id", "Mult"},
}
"""Kinds of records, and of each the fields that are read."""
for _gps in ("GPS", "GPS2"):
    WANTED[_gps] |= {"GWk", "GMS", "Status", "Week", "T"}

UNIT_FACTORS = {
    **{label: (label, 1.0) for label in ("deg", "m", "A", "V", "rpm", "%")},
    **dict.fromkeys(("degheading", "deglatitude", "deglongitude"), ("deg", 1.0)),
    "rad": ("deg", 57.29577951308232),
    "O": ("degC", 1.0),
    "degC": ("degC", 1.0),
    "Pa": ("hPa", 0.01),
    "PWM": ("us", 1.0),
    "us": ("us", 1.0),
    "cm": ("m", 0.01),
}
"""Label of a unit that a log declares to ours and its factor."""


def in_declared_units(flash: Flash) -> Fields:
    """Return :data:`ARDUPILOT_FIELDS` with the units and factors that the log itself declares."""
    declared = _declared(flash)
    return {
        kind: tuple(_converted(row, declared.get((kind, row[1]))) for row in rows)
        for kind, rows in ARDUPILOT_FIELDS.items()
    }


def in_hundredths(flash: Flash, fields: Fields) -> tuple[Fields, list[str]]:
    """Return `fields` with the factor 0.01 for powers in hundredths, and a note for the user.

    Logs up to 2015 hold voltage and current of ``CURR`` as integers in hundredths, and do not declare it.
    """
    found, notes = dict(fields), []
    declared = _declared(flash)
    for name in POWER_MESSAGES:
        table = flash.records[name].fields if name in flash.records else {}
        volts = table.get("Volt", np.empty(0))
        is_whole = bool((volts == np.round(volts)).all())
        if (name, "Curr") in declared or not len(volts) or not is_whole or np.median(volts) < MAX_VOLTAGE_V:
            continue
        found[name] = tuple(
            (column, field, unit, 0.01 * factor) for column, field, unit, factor in found[name]
        )
        notes.append(
            f"{name}: current and voltage are read in hundredths of A and V: {np.median(volts):g} V else"
        )
    return found, notes


def _converted(
    row: tuple[str, str, str, float], declared: tuple[str, float] | None
) -> tuple[str, str, str, float]:
    """Return the row of a column with the declared unit, where that is one of its kind."""
    column, field, unit, factor = row
    if declared is None or declared[0] not in UNIT_FACTORS:
        return row
    ours, scale = UNIT_FACTORS[declared[0]]
    if unit not in (ours, "1"):
        return row
    return column, field, ours, float(np.copysign(scale * declared[1], factor))


def _declared(flash: Flash) -> dict[tuple[str, str], tuple[str, float]]:
    """Return kind and field to the label of its unit, and what the number is to be multiplied with."""
    try:
        formats, fmtu, unit, mult = (flash.records[name] for name in ("FMT", "FMTU", "UNIT", "MULT"))
        labels = dict(zip(_characters(unit.fields["Id"]), unit.texts["Label"], strict=True))
        factors = dict(zip(_characters(mult.fields["Id"]), mult.fields["Mult"].tolist(), strict=True))
        columns = {
            number: (name, text.split(","))
            for number, name, text in zip(
                formats.fields["Type"].tolist(), formats.texts["Name"], formats.texts["Columns"], strict=True
            )
        }
        rows = zip(fmtu.fields["FmtType"].tolist(), fmtu.texts["UnitIds"], fmtu.texts["MultIds"], strict=True)
    except KeyError:  # the log declares nothing, or not all of it
        return {}
    found = {}
    for number, units, multipliers in rows:
        kind, names = columns.get(number, ("", []))
        for name, one, multiplier in zip(names, units, multipliers, strict=False):
            own = flash.letters.get((kind, name)) in OWN_SCALE
            factor = 1.0 if own else factors.get(multiplier, 1.0) or 1.0
            found[kind, name] = labels.get(one, ""), factor
    return found


def _characters(codes: np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[str]:
    return [chr(int(code) & 0xFF) for code in codes]
