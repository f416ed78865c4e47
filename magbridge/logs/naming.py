"""Identify the columns of a text file, their units, and the columns that form the time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNELS, COLUMNS, FURTHER_AXIS, NT_PER_UNIT, usual
from magbridge.errors import FormatError
from magbridge.logs.clocks import DAY, SECONDS_OF_DAY
from magbridge.logs.layout import PROJECTED_UNIT, Layout, Rows
from magbridge.logs.mapping import CELL_NUMBER, NAMES, WITH_UNIT, aliases, bare, is_unit, split

ROW_COUNT = re.compile(r"row \[(\d+\.?\d*|\.\d+) ?Hz\]")
"""Declared time of a file without times: ``row [20 Hz]`` counts the rows at this rate."""
HOUR = re.compile(
    r"\d{1,2}:\d{2}(:\d{2}([.,:]\d+)?)?( ?[AP]M)?|[0-2]\d[0-5]\d[0-5]\d([.,]\d*)?", re.IGNORECASE
)
DATED = re.compile("(?<!up)(date|datum|fecha|jour|yyyy.?mm.?dd|dd.?mm.?yy|mm.?dd.?yy)", re.IGNORECASE)
"""Part of a heading that marks a column of dates."""
TIMED = re.compile("time|stamp|clock|millis|epoch|zeit|heure|hora", re.IGNORECASE)
"""Part of a heading that marks the column of times, if only one heading has it."""
UTM_HEADING = re.compile(r"[xy]_\w*?utm_?(\d{1,2})([ns])_m", re.IGNORECASE)
"""Heading of an easting or northing that names a zone of UTM, as MagComPy's ``X_NAD83UTM10N_m``."""
LINE_NAMES = "line", "linename", "lineno", "linenumber"
"""Names of the column with the survey line, in lower case without punctuation."""
REMARKS = "raw", "mag", "true", "cal", "uncal", "measured", "compass"
"""Words in brackets after a heading that are not units."""
DATE_AND_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d.*)?")
"""A cell that is a date with its time of day."""
CLOCK = re.compile(r"\d{1,2}:\d{2}:\d{2}([.,]\d+)?")
"""A cell that is a time of day."""
HOUR_AND_MINUTE = re.compile(r"([01]?\d|2[0-3])?[0-5]?\d(\.\d+)?")
"""A cell that is a time of day as HHMM.mmm, as in the exchange format MGD77T."""
SECONDS_HEADING = re.compile("day|sod|utc|midnight", re.IGNORECASE)
"""Part of a heading that marks seconds since midnight, in a file with a column of dates."""
JOINED: dict[str, list[str]] = NAMES["times"]
"""Kind of time that several columns form -> patterns of their names, in lower case without punctuation."""
UNIT_CELL_COLUMNS = "depth", "total_field", "sensor_temperature"
"""Standard columns whose cells may end with a unit, as 5.8m; those of a position end with N, S, E or W."""
HEMISPHERES = {"latitude": "NS", "longitude": "EW"}


def name_columns(path: Path, layout: Layout, units: Sequence[str], rows: Rows) -> Layout:
    """Return the layout with name and unit of each column, as declared or as recognised by its heading.

    `units`: cells of the row of units, empty without one. FormatError: a declared column is missing, or two
    columns have the same standard name.
    """
    if layout.separator != ",":
        sign = {"\t": "tabs", " ": "blanks"}.get(layout.separator, repr(layout.separator))
        layout = layout.guessing(f"fields separated by {sign}")
    parts = [split(heading) for heading in layout.headings]
    declares = [parts[k][1] or (units[k] if k < len(units) else "") for k in range(len(parts))]
    layout = _with_names(path, layout, [name for name, _ in parts], declares)
    for k, name in enumerate(layout.names):
        layout = _with_unit(layout, name, layout.headings[k], declares[k])
    layout = _with_line(_with_utm(layout))
    layout = _with_calendar(_with_time(layout, rows), rows)
    return _without_texts(with_total(with_units_of_axes(layout, rows), rows), rows)


def _with_names(path: Path, layout: Layout, names: list[str], units: Sequence[str]) -> Layout:
    """Return the layout with a name for each column; '' for a column that is not read."""
    headings = layout.headings
    # of two equal names with different units, the second keeps its unit in the name
    names = [name if name not in names[:k] else headings[k] for k, name in enumerate(names)]
    # a column 'Quality' of another program does not hold magbridge's flags
    lower = [name if name in COLUMNS or name.lower() == "quality" else name.lower() for name in names]
    names = [
        low if low in COLUMNS and lower.count(low) == 1 else name
        for name, low in zip(names, lower, strict=True)
    ]
    source = layout.declared.columns.get("time")
    if match := ROW_COUNT.fullmatch(source.heading or "time") if source else None:
        if not float(match[1]):
            raise FormatError(path, "expected a rate other than 0 Hz", column="time")
        layout = replace(layout, rate=float(match[1]))
    taken = _declared(path, layout, names)
    # a simulation's true values are not readings: they must not fill a channel that the log lacks
    open_to_all = ["" if k in taken or name.startswith("truth_") else name for k, name in enumerate(names)]
    known = {k: name for k, name in aliases(open_to_all, units).items() if name not in taken.values()}
    if "time" not in {*taken.values(), *known.values(), *names}:
        timed = [k for k, name in enumerate(names) if TIMED.search(name) and k not in taken]
        known |= dict.fromkeys(timed[:1], "time") if len(timed) == 1 else {}
    layout = layout.guessing(*(f"{name} is {headings[k]!r}" for k, name in known.items()))
    if nameless := [str(k + 1) for k, heading in enumerate(headings) if not heading and k not in taken]:
        layout = layout.guessing(f"left out, no heading: column {', '.join(nameless)}")
    chosen = taken | known
    unnamed = [name for k, name in enumerate(names) if k not in chosen and name in chosen.values()]
    final: list[str] = []
    for k, name in enumerate(names):
        ours = chosen.get(k, "" if name in unnamed or headings[k] == "(nothing)" else name)
        if ours in final and ours:
            if ours in COLUMNS:
                expected = f"expected a name of its own for column {k + 1}, not {ours!r}"
                raise FormatError(path, expected, row=layout.row)
            ours = f"{ours}_{k + 1}"
        final.append(ours)
    return replace(layout, names=tuple(final))


def _with_unit(layout: Layout, name: str, heading: str, unit: str) -> Layout:
    """Return the layout with a column's unit; a heading that states magnetic sets ``heading_reference``."""
    source = layout.declared.columns.get(name)
    if name == "heading" and (match := re.search(r"\b(magnetic|mag)\b", f"{heading} {unit}".lower())):
        layout = replace(layout, attrs={"heading_reference": "magnetic", **layout.attrs})
        unit = unit.replace(match[1], "").strip(" ,")
    if name in COLUMNS and unit.lower() in REMARKS:
        unit = ""
    if source is not None and source.unit is not None:
        unit = source.unit
    elif source is not None and source.heading and source.heading.strip() != heading.strip():
        unit = split(source.heading)[1] or unit
    return layout.with_units({name: unit}) if name and unit else layout


def _declared(path: Path, layout: Layout, names: Sequence[str]) -> dict[int, str]:
    """Return index and standard name of each column that the user declares; FormatError: one is missing."""
    taken: dict[int, str] = {}
    for name, source in layout.declared.columns.items():
        theirs = source.heading or name
        if name == "time" and layout.rate:
            continue
        for candidates in (layout.headings, names):
            for wanted in (theirs, split(theirs)[0]):
                if wanted in candidates:
                    taken.setdefault(candidates.index(wanted), name)
                    break
            if name in taken.values():
                break
        else:
            there = " ".join(repr(heading) if " " in heading else heading for heading in layout.headings)
            expected = f"expected this column; there are: {there}"
            raise FormatError(path, expected, row=layout.row, column=theirs)
    return taken


def _with_line(layout: Layout) -> Layout:
    """Return the layout with a column Line or Line_Name of another program as ``line``."""
    found = [k for k, name in enumerate(layout.names) if bare(name) in LINE_NAMES]
    if len(found) != 1 or not layout.foreign:
        return layout
    (k,) = found
    return replace(layout, names=(*layout.names[:k], "line", *layout.names[k + 1 :]))


def _with_utm(layout: Layout) -> Layout:
    """Return the layout with eastings and northings of a named UTM zone as longitude and latitude.

    All datums of such headings (WGS 84, NAD83, ETRS89) agree within 2 m, so the zone of WGS 84 is used.
    """
    zones = {
        k: match for k, one in enumerate(layout.headings) if (match := UTM_HEADING.fullmatch(one.strip()))
    }
    if len(zones) != 2 or {"latitude", "longitude"} & set(layout.names):
        return layout
    names, units = list(layout.names), {}
    for k, match in zones.items():
        names[k] = "longitude" if layout.headings[k].strip()[0] in "xX" else "latitude"
        units[names[k]] = f"{PROJECTED_UNIT}{'326' if match[2] in 'nN' else '327'}{int(match[1]):02d}"
    if len(set(units)) != 2 or len(set(units.values())) != 1:
        return layout
    layout = replace(layout, names=tuple(names)).with_units(units)
    return layout.guessing(f"position in the projection {layout.projection}")


def _with_time(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with the column of the time, or with the columns that together form the time."""
    place = layout.names.index("time") if "time" in layout.names else None
    ours = [name if name in layout.declared.columns else "" for name in layout.names]
    called = [bare(name or split(theirs)[0]) for name, theirs in zip(ours, layout.headings, strict=True)]
    for kind, patterns in JOINED.items():
        places = [[k for k, name in enumerate(called) if re.fullmatch(one, name)] for one in patterns]
        if all(len(one) == 1 for one in places) and (place is None or [place] in places):
            stamp = tuple(one[0] for one in places)
            unit = kind if len(patterns) == 2 else ""
            return _with_stamp(replace(layout, stamp=stamp).with_units({"time": unit}))
    dates = [k for k, name in enumerate(called) if DATED.search(name) and k != place]
    if place is None and len(dates) == 1:
        clocks = [k for k in range(len(called)) if k not in dates and _all_match(CLOCK, rows, k)]
        near = [k for k in clocks if called[k][:4] == called[dates[0]][:4]]
        place = next((group[0] for group in (clocks, near) if len(group) == 1), dates[0])
    if place is None:
        return layout
    layout = replace(layout, stamp=(place,))
    if len(dates) == 1 and dates != [place]:
        layout = _with_date(layout, dates[0], place, rows)
    return _with_stamp(layout)


def _with_date(layout: Layout, date: int, place: int, rows: Rows) -> Layout:
    """Return the layout with column `date` joined to column `place`, if the latter holds times of day."""
    cells = [row[place] for row in rows if len(row) > place]
    numbers = pd.to_numeric(pd.Series([cell.replace(",", ".") or "0" for cell in cells]), errors="coerce")
    counted = SECONDS_HEADING.search(layout.headings[place]) and numbers.between(0.0, DAY, "left").all()
    unit = layout.units.get("time", "")
    undated = "%" in unit and not {"%d", "%j"} & {*re.findall("%.", unit)}
    by_hour = not unit and not counted and _by_hour(cells)
    if (any(map(HOUR.fullmatch, cells)) or counted or by_hour) and not undated:
        layout = replace(layout, stamp=(date, place))
    if by_hour or (counted and not all(map(HOUR.fullmatch, cells))):
        layout = replace(layout, by_hour=by_hour).with_units({"time": SECONDS_OF_DAY})
    return layout


def _with_stamp(layout: Layout) -> Layout:
    """Return the layout in which the last field of the time is named ``time`` and its other fields ''."""
    stamp = layout.stamp
    if layout.rate:
        return layout
    if len(stamp) > 1 or layout.names[stamp[0]] != "time":
        layout = layout.guessing(f"time from {' and '.join(repr(layout.headings[k]) for k in stamp)}")
    names = list(layout.names)
    for k in stamp:
        names[k] = "time" if k == stamp[-1] else ""
    return replace(layout, names=tuple(names))


def _all_match(pattern: re.Pattern[str], rows: Rows, place: int) -> bool:
    """Return True if all non-empty cells of a column match a pattern and there is at least one."""
    values = {row[place] for row in rows if place < len(row) and row[place]}
    return bool(values) and all(map(pattern.fullmatch, values))


def _by_hour(cells: Sequence[str]) -> bool:
    """Return True if the cells in a column next to a date are times of day written as HHMM.mmm."""
    there = [cell for cell in cells if cell]
    long = [cell for cell in there if len(cell.partition(".")[0]) >= 3]
    return bool(long) and all(map(HOUR_AND_MINUTE.fullmatch, there)) and any("." in cell for cell in there)


def _with_calendar(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with the fields, other than the time, that alone give date and time of day."""
    others = [k for k in range(len(layout.headings)) if k not in layout.stamp]
    moments = [k for k in others if _all_match(DATE_AND_TIME, rows, k)]
    dates = [k for k in others if DATED.search(layout.headings[k])]
    clocks = [k for k in others if _all_match(CLOCK, rows, k)]
    if len(moments) == 1:
        return replace(layout, calendar=tuple(moments))
    if len(dates) == len(clocks) == 1:
        return replace(layout, calendar=(*dates, *clocks))
    return layout


def _without_texts(layout: Layout, rows: Rows) -> Layout:
    """Return the layout without columns of text; a column of N/S or E/W letters gives a position its sign."""
    names, units, hemispheres = list(layout.names), dict(layout.units), dict(layout.hemispheres)
    left = []
    for k, name in enumerate(layout.names):
        values = {row[k] for row in rows if k < len(row) and row[k]}
        kept = name == "line" or (name in COLUMNS and name not in UNIT_CELL_COLUMNS)
        if not name or kept or not values:
            continue
        text = [layout.number(cell) for cell in values]
        if any(CELL_NUMBER.fullmatch(cell) or cell.lower() in {"true", "false"} for cell in text):
            continue
        behind = {match[2] if (match := WITH_UNIT.fullmatch(cell)) else "" for cell in text}
        if layout.foreign and len(behind) == 1 and is_unit(*behind) and behind != {""}:
            units.setdefault(name, *behind)
            continue
        names[k] = ""
        side = [one for one, letters in HEMISPHERES.items() if {v.upper() for v in values} <= {*letters}]
        if side and side[0] in names:
            hemispheres[side[0]] = k
        else:
            left.append(name)
    layout = replace(layout, names=tuple(names), units=units, hemispheres=hemispheres)
    return layout.guessing(f"left out, no numbers: {', '.join(left)}") if left else layout


def on_side(name: str, values: FloatArray, letters: pd.Series) -> FloatArray:
    """Return latitudes or longitudes (n,), deg, signed by hemisphere `letters` (n,); NaN without a letter."""
    side = letters.astype("str").str.strip().str.upper()
    signed = np.where(side.isin(["S", "W"]), -np.abs(values), values)
    return np.asarray(np.where(side.isin([*HEMISPHERES[name]]), signed, np.nan))


READING_RANGE_NT = LOWEST_NT, HIGHEST_NT = 15_000.0, 90_000.0
"""Range of a reading's magnitude, the Earth's field plus the vehicle's, nT."""
TOTAL_NAME = re.compile(
    "f|nt|mag|tm[fi]|field(mag1?)?|(mag|b)total|magtot1?|total(magnetic)?(field|intensity)|magneticfield"
    "|reading1|scalar.*|magnitude"
)
"""Names of a scalar magnetometer's column, in lower case without punctuation."""


SCALAR_NAME = re.compile("tm[fi]|total(magnetic)?intensity|scalar.*")
"""Names of a scalar sensor in a file with a vector, whose magnitude may have the other names."""
ANGLES = "roll", "pitch", "heading"
NEAR_HALF_TURN_RAD = 0.1
"""Headings whose maximum is less than this below pi or 2 pi are taken as radians, rad."""


def units_of_angles(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with rad for angles without a unit, if headings end just below pi or 2 pi."""
    names = [name for name in ANGLES if name in layout.names and name not in layout.units]
    if "heading" not in names:
        return layout
    values = {name: _numbers(layout, rows, [layout.names.index(name)]) for name in names}
    heading = values["heading"]
    if len(heading) < 3 or any(np.abs(one).max(initial=0.0) > 2.0 * np.pi + 1e-3 for one in values.values()):
        return layout
    largest = float(np.abs(heading).max())
    ends = [end - NEAR_HALF_TURN_RAD < largest < end + 1e-3 for end in (np.pi, 2.0 * np.pi)]
    if not any(ends) or np.ptp(heading) <= np.pi:
        return layout
    guess = f"{', '.join(names)} in rad, since headings end at {largest:.4g}"
    return layout.with_units(dict.fromkeys(names, "rad")).guessing(guess)


def with_units_of_axes(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with a unit for axes without one, from another axis or from the field's magnitude."""
    undeclared = layout.foreign and not set(CHANNELS) & set(layout.declared.columns)
    if not undeclared or not set(CHANNELS) <= set(layout.names):
        return layout
    stated = {layout.units.get(name, "") for name in CHANNELS}
    if stated == {""}:
        length = _length(layout, rows, [layout.names.index(name) for name in CHANNELS])
        units = {unit: length * factor for unit, factor in NT_PER_UNIT.items()}
        fitting = [unit for unit, nanotesla in units.items() if LOWEST_NT < nanotesla < HIGHEST_NT]
        unit = "" if "nT" in fitting else next(iter(fitting), "")
        guess = f"mag_x, mag_y, mag_z in {unit}, by the field's length"
    elif len(stated) == 2 and "" in stated:
        unit = max(stated)
        guess = f"mag_x, mag_y, mag_z all in {unit}"
    else:
        return layout
    if not unit:
        return layout
    further = [name for name in layout.names if FURTHER_AXIS.fullmatch(name) and name not in layout.units]
    return layout.with_units(dict.fromkeys([*CHANNELS, *further], unit)).guessing(guess)


def with_total(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with ``total_field``, if one column has a scalar's name and the Earth's magnitude."""
    if not layout.foreign or "total_field" in layout.names:
        return layout
    pattern = SCALAR_NAME if set(CHANNELS) <= set(layout.names) else TOTAL_NAME
    fields = [
        k for k, name in enumerate(layout.names) if pattern.fullmatch(bare(name)) and name not in COLUMNS
    ]
    if len(fields) != 1:
        return layout
    (k,) = fields
    unit = layout.units.get(layout.names[k], "nT")
    length = _length(layout, rows, fields) * NT_PER_UNIT.get(usual(unit), 0.0)
    if not LOWEST_NT < length < HIGHEST_NT:
        return layout
    units = {name: unit for name, unit in layout.units.items() if name != layout.names[k]}
    names = (*layout.names[:k], "total_field", *layout.names[k + 1 :])
    named = replace(layout, names=names, units={**units, "total_field": unit})
    return named.guessing(f"total_field is {layout.headings[k]!r}")


def _numbers(layout: Layout, rows: Rows, places: Sequence[int]) -> FloatArray:
    """Return the numbers (n, k) in k columns, from the rows in which all k cells are numbers."""
    texts = [[layout.number(row[k]) for k in places] for row in rows if max(places) < len(row)]
    frame = pd.DataFrame(texts, columns=range(len(places)), dtype="str").apply(pd.to_numeric, errors="coerce")
    numbers = frame.to_numpy(np.float64)
    return np.asarray(numbers[np.isfinite(numbers).all(axis=1)])


def _length(layout: Layout, rows: Rows, places: Sequence[int]) -> float:
    """Return the median magnitude of the vector in the columns `places`, in their unit; 0 without numbers."""
    numbers = _numbers(layout, rows, places)
    return float(np.median(np.linalg.norm(numbers, axis=1))) if len(numbers) else 0.0
