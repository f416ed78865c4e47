"""Read ArduPilot's onboard logs, binary (``.BIN``) or as text (``.log``).

The log holds the field as the autopilot used it, and the corrections of the autopilot: offsets, motor
compensation and soft-iron matrix (``COMPASS_DIA``, ``COMPASS_ODI``). The reader undoes these corrections, so
``mag_x`` is the raw channel in steps of 1 mG (100 nT):

    MAG = D (s raw + Ofs) + MO        with D of DIA and ODI; the scale s = ``COMPASS_SCALE`` is not undone

UTC minus the time since boot is the median over the GPS fixes, so a damaged record does not change it. The
compass is the one that the estimator used (``XKFS``), or the first that is enabled (``COMPASS_USE``) and
healthy. Survey magnetometers (``MAGH``, G, of DroneCAN's high-resolution messages) have the next numbers.

The table :data:`ARDUPILOT_FIELDS` lists fields and their units. A log of ArduPilot 3.6 or later declares its
units (``FMTU``, ``UNIT``, ``MULT``); declared units replace those of the table.

References
----------
ArduPilot, "Onboard Message Log Messages", https://ardupilot.org/copter/docs/logmessages.html
ArduPilot, ``libraries/AP_Compass/AP_Compass_Backend.cpp``, ``correct_field``
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT
from magbridge.errors import FormatError
from magbridge.logs.checks import boots
from magbridge.logs.clocks import GPS_EPOCH, WEEK, leap_seconds
from magbridge.logs.compasses import BootRun, Magnetometer, Series, pieces, sampled, symmetric
from magbridge.logs.dataflash import OWN_SCALE, Flash, Records, read_binary, read_text
from magbridge.logs.fields import DEG_PER_RAD, FieldMap, field_maps, fields_of
from magbridge.logs.mapping import Options

MIN_GPS_STATUS = 3
"""Lowest ``GPS.Status`` of a three-dimensional fix."""
MAX_KIND_NUMBER = 8
"""Highest number in the name of a kind of record, as ``ESC8``."""
ID_PARAMETERS = ("COMPASS_PRIO{}_ID", "COMPASS_DEV_ID{}")
"""Parameters that hold a compass's device id, preferred first; the first compass is ``COMPASS_DEV_ID``."""


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows; all values that are read are in memory.

    FormatError: the log lacks a record of a magnetometer with a time.
    """
    with path.open("rb") as file:
        text = b"FMT," in file.read(4096)
    flash = (read_text if text else read_binary)(path, WANTED)
    fields, notes = _in_own_units(flash)
    records = {name: _in_microseconds(name, one) for name, one in flash.records.items()}
    runs = [run for part in _boots(records) if (run := _run(fields, part)).magnetometers]
    if not runs:
        timeless = ", whose records have times" * any(name.startswith("MAG") for name in records)
        raise FormatError(path, f"expected an ArduPilot log with MAG records{timeless}")
    lost = {"lines_skipped" if text else "bytes_skipped": flash.skipped}
    yield from pieces(path, rows, runs, lost, notes, options.compass if options else None)


def _run(fields: Fields, records: dict[str, Records]) -> BootRun:
    parameters: dict[str, float] = {}
    parm = records.get("PARM")
    if parm is not None and {"Name", "Value"} <= parm.keys():
        pairs = zip(parm["Name"], parm["Value"].tolist(), strict=True)
        parameters = dict(reversed(list(pairs)))  # as they were at the boot
    chosen = None
    if (estimator := records.get("XKFS")) is not None and len(estimator.get("MI", ())):
        numbers, counts = np.unique(estimator["MI"], return_counts=True)
        chosen = int(numbers[counts.argmax()])  # the compass that the estimator used most
    mags = [
        _magnetometer(number, records_of, parameters, chosen)
        for number, records_of in _instances(records, "MAG").items()
        if {"MagX", "MagY", "MagZ"} <= records_of.keys()
    ]
    mags += _survey_magnetometers(records.get(SURVEY), len(mags))
    return BootRun(mags, _telemetry(fields, records), _utc_offset(records))


def _in_microseconds(name: str, records: Records) -> Records:
    """Return records with ``TimeUS``, µs since the boot, also for ArduPilot up to 3.2, which logs ms."""
    if "TimeMS" not in records or "TimeUS" in records:
        return records
    if not name.startswith("GPS"):
        return Records(records.at, {**records, "TimeUS": 1e3 * records["TimeMS"]})
    if not {"T", "Week"} <= records.keys():
        return records
    times = {"TimeUS": 1e3 * records["T"], "GWk": records["Week"], "GMS": records["TimeMS"]}
    return Records(records.at, {**records, **times})


def _boots(records: dict[str, Records]) -> Iterator[dict[str, Records]]:
    """Yield the records of each boot."""
    timed = [one for one in records.values() if "TimeUS" in one]
    if not timed:
        return
    at = np.concatenate([one.at for one in timed])
    order = np.argsort(at)
    time = np.concatenate([one["TimeUS"] for one in timed])[order] * 1e-6
    starts = at[order][boots(time)]
    starts[0] = 0
    ends = [*starts[1:].tolist(), np.iinfo(np.intp).max]
    for first, last in zip(starts.tolist(), ends, strict=True):
        yield {
            name: one.part(slice(*np.searchsorted(one.at, [first, last]).tolist()))
            for name, one in records.items()
        }


def _magnetometer(
    number: int, fields: Records, parameters: Mapping[str, float], chosen: int | None
) -> Magnetometer:
    """Return the compass `number` with its raw channels; `chosen` is the number that the estimator used."""
    field: FloatArray = np.stack([fields[f"Mag{axis}"] for axis in "XYZ"])
    none = np.zeros(len(fields.at))
    # the motor compensation is MOX, up to ArduPilot 4.0 MOfsX
    field -= np.stack([fields.get(f"MO{axis}", fields.get(f"MOfs{axis}", none)) for axis in "XYZ"])
    diagonal, off = ([parameters.get(f"COMPASS_{kind}{_numbered(number)}_{axis}", 0.0) for axis in "XYZ"]
                     for kind in ("DIA", "ODI"))  # fmt: skip
    soft_iron = symmetric(diagonal, off)
    if all(diagonal) and abs(np.linalg.det(soft_iron)) > 1e-3:
        field = np.asarray(np.linalg.solve(soft_iron, field), dtype=np.float64)
    field -= np.stack([fields.get(f"Ofs{axis}", none) for axis in "XYZ"])
    names = (ID_PARAMETERS[0].format(number + 1), ID_PARAMETERS[1].format(_numbered(number)))
    device = next((parameters[name] for name in names if parameters.get(name)), 0.0)
    use = parameters.get(f"COMPASS_USE{_numbered(number)}")
    health = fields.get("Health")
    return sampled(
        number,
        fields["TimeUS"] * 1e-6,
        NT_PER_UNIT["mG"] * field,
        id=f"{device:.0f}" if device else "",
        enabled=None if use is None else use != 0,
        healthy=None if health is None else float((health > 0).mean()),
        priority=number + 1 if names[0] in parameters else None,
        in_use=number == chosen,
    )


def _survey_magnetometers(records: Records | None, first: int) -> list[Magnetometer]:
    """Return the magnetometers of ``MAGH`` records, numbered from `first`; ids are node, sensor and bus."""
    if records is None or not {"TimeUS", *SURVEY_AXES} <= records.keys():
        return []
    ids = np.column_stack(
        [np.zeros(len(records.at)), *(records[name] for name in SURVEY_ID if name in records)]
    )
    found: list[Magnetometer] = []
    for numbers in np.unique(ids, axis=0):
        here = records.part((ids == numbers).all(axis=1))
        device = f"{SURVEY} {':'.join(f'{number:g}' for number in numbers[1:])}"
        gauss = np.stack([here[name] for name in SURVEY_AXES])
        found.append(sampled(first + len(found), here["TimeUS"] * 1e-6, NT_PER_UNIT["G"] * gauss, id=device))
    return found


def _numbered(number: int) -> str:
    """Return the number of a compass in names of parameters: "" for the first, "2" for the second."""
    return str(number + 1) if number else ""


def _telemetry(fields: Fields, records: dict[str, Records]) -> Iterator[Series]:
    """Yield the columns of all records in :data:`ARDUPILOT_FIELDS`, which has no magnetometers."""
    for record in ARDUPILOT_FIELDS:
        for number, found in _instances(records, record).items():
            fixed = np.ones(len(found.at), bool)
            if record == "GPS" and "Status" in found:
                fixed = found["Status"] >= MIN_GPS_STATUS
            for column, unit, values in fields_of(fields[record], found, number):
                if np.any(values) or not column.startswith("servo"):  # an output that is 0 is not in use
                    yield found["TimeUS"] * 1e-6, column, unit, np.where(fixed, values, np.nan)


def _instances(records: dict[str, Records], kind: str) -> dict[int, Records]:
    """Return number (from 0) -> records of each instance of a kind, also if the name has it (``MAG2``)."""
    found: dict[int, Records] = {}
    for number, name in enumerate((kind, *(f"{kind}{k}" for k in range(2, MAX_KIND_NUMBER + 1)))):
        if (one := records.get(name)) is None or "TimeUS" not in one or not len(one.at):
            continue
        which = next((one[field] for field in INSTANCE if field in one), None)
        if which is None:
            found.setdefault(number, one)
            continue
        found |= {int(k): one.part(which == k) for k in np.unique(which[np.isfinite(which)])}
    return found


def _utc_offset(records: dict[str, Records]) -> float | None:
    """Return UTC minus time since boot in s, the median of all GPS fixes; None without a fix."""
    offsets = []
    for gps in _instances(records, "GPS").values():
        if {"GWk", "GMS"} <= gps.keys():
            fixed = (gps["GWk"] > 0) & (gps.get("Status", MIN_GPS_STATUS) >= MIN_GPS_STATUS)
            ahead = GPS_EPOCH + gps["GWk"] * WEEK + gps["GMS"] * 1e-3 - gps["TimeUS"] * 1e-6
            offsets.append(ahead[fixed])
    known = np.concatenate(offsets) if offsets else np.empty(0)
    if not len(known):
        return None
    offset = np.median(known, keepdims=True)
    return float((offset - leap_seconds(offset))[0])


Fields = dict[str, list[FieldMap]]
"""Kind of record -> its fields."""
ARDUPILOT_FIELDS: Fields = field_maps("ardupilot")
"""If several records fill one column, the first in the log is used. CTUN has height and throttle in Sub and
Copter, THR the throttle in Rover, MOTB the throttle of all motors together."""
INSTANCE = ("I", "Instance", "Inst")
SURVEY, SURVEY_ID, SURVEY_AXES = "MAGH", ("Node", "Sensor", "Bus"), ("Mx", "My", "Mz")
"""Record of survey magnetometers, the fields that identify a sensor, and the fields of its axes, G."""
POWER_MESSAGES = "CURR", "BAT"
MAX_VOLTAGE_V = 100.0
"""Median above which integers without declared unit are in hundredths of V (and of A for the current)."""
WANTED = {
    *(f"{kind}{k}" for kind in ("MAG", *ARDUPILOT_FIELDS) for k in ("", *range(2, MAX_KIND_NUMBER + 1))),
    *(SURVEY, "PARM", "XKFS", "FMT", "FMTU", "UNIT", "MULT"),
}
"""Kinds of record that are read."""
UNIT_FACTORS = {
    **{label: (label, 1.0) for label in ("deg", "m", "A", "V", "rpm", "%")},
    **dict.fromkeys(("degheading", "deglatitude", "deglongitude"), ("deg", 1.0)),
    "rad": ("deg", DEG_PER_RAD),
    "O": ("degC", 1.0),
    "degC": ("degC", 1.0),
    "Pa": ("hPa", 0.01),
    "PWM": ("us", 1.0),
    "us": ("us", 1.0),
    "cm": ("m", 0.01),
}
"""Label of a unit in a log -> unit of the column, and factor to it."""


def _in_own_units(flash: Flash) -> tuple[Fields, list[str]]:
    """Return :data:`ARDUPILOT_FIELDS` in the units that the log itself declares, and notes for the user.

    Logs up to 2015 hold voltage and current of ``CURR`` as integers, in undeclared hundredths of V and A.
    """
    declared = _declared(flash)
    found = {
        kind: [_converted(one, declared.get((kind, one.field))) for one in fields]
        for kind, fields in ARDUPILOT_FIELDS.items()
    }
    notes = []
    for name in POWER_MESSAGES:
        volts = flash.records[name].get("Volt", np.empty(0)) if name in flash.records else np.empty(0)
        is_whole = bool((volts == np.round(volts)).all())
        if (name, "Curr") in declared or not len(volts) or not is_whole or np.median(volts) < MAX_VOLTAGE_V:
            continue
        found[name] = [one._replace(factor=0.01 * one.factor) for one in found[name]]
        otherwise = f"{np.median(volts):g} V else"
        notes.append(f"{name}: current and voltage are read in hundredths of A and V: {otherwise}")
    return found, notes


def _converted(field: FieldMap, declared: tuple[str, float] | None) -> FieldMap:
    """Return a field with the unit and factor that the log declares, if this unit fits the field."""
    if declared is None or declared[0] not in UNIT_FACTORS:
        return field
    unit, scale = UNIT_FACTORS[declared[0]]
    if field.unit not in (unit, "1"):
        return field
    return field._replace(unit=unit, factor=float(np.copysign(scale * declared[1], field.factor)))


def _declared(flash: Flash) -> dict[tuple[str, str], tuple[str, float]]:
    """Return (kind, field) -> declared unit label and multiplier; empty if the log does not declare units."""
    try:
        formats, fmtu, unit, mult = (flash.records[name] for name in ("FMT", "FMTU", "UNIT", "MULT"))
        labels = dict(zip(_characters(unit["Id"]), unit["Label"], strict=True))
        factors = dict(zip(_characters(mult["Id"]), mult["Mult"].tolist(), strict=True))
        kinds = zip(formats["Type"].tolist(), formats["Name"], formats["Columns"], strict=True)
        columns = {number: (name, text.split(",")) for number, name, text in kinds}
        rows = zip(fmtu["FmtType"].tolist(), fmtu["UnitIds"], fmtu["MultIds"], strict=True)
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


def _characters(codes: FloatArray) -> list[str]:
    return [chr(int(code) & 0xFF) for code in codes]
