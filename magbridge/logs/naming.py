"""Identify the columns of a text file, their units, and the columns that form the time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from msgspec import structs

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNELS, COLUMNS, FURTHER_AXIS, NT_PER_UNIT, bare, usual
from magbridge.errors import AbsentColumns, FormatError
from magbridge.logs.clocks import BY_HOUR, DAY, SECONDS_OF_DAY
from magbridge.logs.layout import PROJECTED_UNIT, Layout, Rows, numbers_of
from magbridge.logs.mapping import (
    ALIASES,
    CELL_NUMBER,
    NAMES,
    PATTERNS,
    PREFIXED_COLUMNS,
    PREFIXED_NAME,
    TOWED,
    ColumnSource,
    guess_of_height,
    is_called,
    is_unit,
    split,
    split_all,
)  # fmt: skip

AXES = "xyz"
MAX_SENSORS = 8
"""Largest number of a further vector sensor in one file."""
NUMBERINGS = (r"0(\D*)$", r"{0}\1"), (r"1(\D*)$", r"{1}\1"), (r"(.)$", r"{1}\1"), (r"$", r"{1}")
"""Pattern in the name of an axis of the first sensor, and what replaces it for a further sensor: the sensor's
number, counted from 0 or from 1. In imu0magx and b1x the last 0 or 1 is the number."""
ROW_COUNT = re.compile(r"row \[(\d+\.?\d*|\.\d+) ?Hz\]")
"""Declared time of a file without times: ``row [20 Hz]`` counts the rows at this rate."""
HOUR = re.compile(
    r"\d{1,2}:\d{2}(:\d{2}([.,:]\d+)?)?( ?[AP]M)?|[0-2]\d[0-5]\d[0-5]\d([.,]\d*)?", re.IGNORECASE
)
DATE_AND_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d.*)?")
"""A cell that is a date with its time of day."""
CLOCK = re.compile(r"\d{1,2}:\d{2}:\d{2}([.,]\d+)?")
"""A cell that is a time of day."""
HOUR_AND_MINUTE = re.compile(r"([01]?\d|2[0-3])?[0-5]?\d(\.\d+)?")
"""A cell that is a time of day as HHMM.mmm, as in the exchange format MGD77T."""
UNIT_CELL_COLUMNS = "depth", "total_field", "sensor_temperature"
"""Standard columns whose cells may end with a unit, as 5.8m; those of a position end with N, S, E or W."""
WITH_UNIT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+) ?([a-zA-Z°µ%/]+)")
"""A cell that is a number with its unit."""
HEMISPHERES = {"latitude": "NS", "longitude": "EW"}


def name_columns(path: Path, layout: Layout, units: Sequence[str], rows: Rows) -> Layout:
    """Return the layout with name and unit of each column, as declared or as recognised by its heading.

    `units`: cells of the row of units, empty without one. FormatError: a declared column is missing, or two
    columns have the same standard name.
    """
    if layout.separator != ",":
        sign = {"\t": "tabs", " ": "blanks"}.get(layout.separator, repr(layout.separator))
        layout = layout.guessing(f"fields separated by {sign}")
    parts = split_all(layout.headings)
    declares = [parts[k][1] or (units[k] if k < len(units) else "") for k in range(len(parts))]
    layout = _with_names(path, layout, [name for name, _ in parts], declares)
    for k, name in enumerate(layout.names):
        layout = _with_unit(layout, name, layout.headings[k], declares[k])
    lines = [k for k, name in enumerate(layout.names) if is_called(name, "line")]
    if layout.foreign and len(lines) == 1:
        layout = layout.renamed({lines[0]: "line"})
    layout = _with_time(_with_utm(layout).guessing(*guess_of_height(layout.declared)), rows)
    return _turned(_without_texts(_with_total(_with_units_of_axes(layout, rows), rows), rows))


def _turned(layout: Layout) -> Layout:
    """Return the layout with the field of ROS turned from FLU to FRD: y and z change their signs."""
    declared, opposite = layout.declared.columns, ColumnSource(scale=-1.0)
    turned = {
        name: opposite
        for name, heading in zip(layout.names, layout.headings, strict=True)
        if name not in declared and re.fullmatch(r"mag\d*_[yz]", name) and PATTERNS["ROS"].match(heading)
    }
    if not turned:
        return layout
    columns = structs.replace(layout.declared, columns={**declared, **turned})
    return replace(layout, declared=columns).guessing(
        f"ROS axes turned from FLU to FRD: {', '.join(turned)} reversed"
    )


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
        timed = [k for k, name in enumerate(names) if PATTERNS["time"].search(name) and k not in taken]
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
    if name == "heading" and (match := re.search(r"\b(magnetic|mag)\b", f"{heading} {unit}".lower())):
        layout = replace(layout, attrs={"heading_reference": "magnetic", **layout.attrs})
        unit = unit.replace(match[1], "").strip(" ,")
    if name in COLUMNS and unit.lower() in NAMES["remarks"].split():
        unit = ""
    if source := layout.declared.columns.get(name):
        theirs = (source.heading or heading).strip()
        said = split(theirs)[1] if theirs != heading.strip() else ""
        unit = source.unit if source.unit is not None else said or unit
    return layout.with_units({name: unit}) if name and unit else layout


def _declared(path: Path, layout: Layout, names: Sequence[str]) -> dict[int, str]:
    """Return index and standard name of each declared column; AbsentColumns: some are missing."""
    taken: dict[int, str] = {}
    lacking: dict[str, str] = {}
    for name, source in layout.declared.columns.items():
        theirs = source.heading or name
        if name == "time" and layout.rate:
            continue
        wanted = theirs, split(theirs)[0]
        found = [there.index(one) for there in (layout.headings, names) for one in wanted if one in there]
        if free := [k for k in found if k not in taken]:
            taken[free[0]] = name
        else:
            lacking[name] = theirs
    if lacking:
        present = " ".join(repr(heading) if " " in heading else heading for heading in layout.headings)
        expected = f"expected this column; there are: {present}"
        first = next(iter(lacking.values()))
        raise AbsentColumns(path, expected, (*lacking,), row=layout.row, column=first)
    return taken


def _with_utm(layout: Layout) -> Layout:
    """Return the layout with eastings and northings of a named UTM zone as longitude and latitude.

    All datums of such headings (WGS 84, NAD83, ETRS89) agree within 2 m, so the zone of WGS 84 is used.
    """
    names, zones = {}, set()
    for k, heading in enumerate(layout.headings):
        if match := PATTERNS["UTM"].fullmatch(heading.strip()):
            names[k] = "longitude" if match[1] in "xX" else "latitude"
            zones.add(f"{PROJECTED_UNIT}{'326' if match[3] in 'nN' else '327'}{int(match[2]):02d}")
    if sorted(names.values()) != [*HEMISPHERES] or len(zones) != 1 or {*HEMISPHERES} & {*layout.names}:
        return layout
    layout = layout.renamed(names).with_units(dict.fromkeys(HEMISPHERES, *zones))
    return layout.guessing(f"position in the projection {layout.projection}")


def _with_time(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with the fields that form the time: the last one is named ``time``, the others ''."""
    stamp, unit = _stamp(layout, rows)
    layout = replace(layout, stamp=stamp)
    if not stamp:
        return layout
    layout = layout.with_units({"time": unit})
    if layout.rate:
        return layout
    if len(stamp) > 1 or layout.names[stamp[0]] != "time":
        layout = layout.guessing(f"time from {' and '.join(repr(layout.headings[k]) for k in stamp)}")
    return layout.renamed({**dict.fromkeys(stamp, ""), stamp[-1]: "time"})


def _stamp(layout: Layout, rows: Rows) -> tuple[tuple[int, ...], str]:
    """Return the indices of the fields that form the time, and its unit."""
    place = layout.names.index("time") if "time" in layout.names else None
    unit = layout.units.get("time", "")
    ours = [name if name in layout.declared.columns else "" for name in layout.names]
    called = [bare(name or split(theirs)[0]) for name, theirs in zip(ours, layout.headings, strict=True)]
    for kind, patterns in NAMES["times"].items():
        places = [[k for k, name in enumerate(called) if re.fullmatch(one, name)] for one in patterns]
        if all(len(one) == 1 for one in places) and (place is None or [place] in places):
            return tuple(k for (k,) in places), kind if len(patterns) == 2 else ""
    dates = [k for k, name in enumerate(called) if PATTERNS["date"].search(name) and k != place]
    if place is None and len(dates) == 1:
        clocks = [k for k in range(len(called)) if k not in dates and _all_match(CLOCK, rows, k)]
        near = [k for k in clocks if called[k][:4] == called[dates[0]][:4]]
        place = next((group[0] for group in (clocks, near) if len(group) == 1), dates[0])
    if place is None:
        return (), unit
    if len(dates) != 1 or dates == [place]:
        return (place,), unit
    # the time is a time of day, unless its cells are whole moments or count something else
    present = cells_in(rows, place)
    numbers = pd.Series(numbers_of(pd.Series(present, dtype="str").str.replace(",", ".")))
    counted = (
        PATTERNS["seconds since midnight"].search(layout.headings[place])
        and numbers.between(0.0, DAY, "left").all()
    )
    undated = "%" in unit and not {"%d", "%j"} & {*re.findall("%.", unit)}
    by_hour = not unit and not counted and _by_hour(present)
    on_clock = [HOUR.fullmatch(cell) is not None for cell in present]
    stamp = (dates[0], place) if (any(on_clock) or counted or by_hour) and not undated else (place,)
    of_day = SECONDS_OF_DAY if counted and not all(on_clock) else unit
    return stamp, BY_HOUR if by_hour else of_day


def cells_in(rows: Rows, place: int) -> list[str]:
    """Return the cells of one column that are not empty."""
    return [row[place] for row in rows if place < len(row) and row[place]]


def _all_match(pattern: re.Pattern[str], rows: Rows, place: int) -> bool:
    """Return True if all non-empty cells of a column match a pattern and there is at least one."""
    present = set(cells_in(rows, place))
    return bool(present) and all(map(pattern.fullmatch, present))


def _by_hour(present: Sequence[str]) -> bool:
    """Return True if the cells in a column next to a date are times of day written as HHMM.mmm."""
    is_long = any(len(cell.partition(".")[0]) >= 3 for cell in present)
    return is_long and all(map(HOUR_AND_MINUTE.fullmatch, present)) and any("." in cell for cell in present)


def calendar_of(layout: Layout, rows: Rows) -> tuple[int, ...]:
    """Return the indices of fields, other than the time, that alone give date and time of day."""
    others = [k for k in range(len(layout.headings)) if k not in layout.stamp]
    moments = [k for k in others if _all_match(DATE_AND_TIME, rows, k)]
    dates = [k for k in others if PATTERNS["date"].search(layout.headings[k])]
    clocks = [k for k in others if _all_match(CLOCK, rows, k)]
    if len(moments) == 1:
        return tuple(moments)
    return (*dates, *clocks) if len(dates) == len(clocks) == 1 else ()


def _without_texts(layout: Layout, rows: Rows) -> Layout:
    """Return the layout without columns of text; a column of N/S or E/W letters gives a position its sign."""
    units, hemispheres = dict(layout.units), dict(layout.hemispheres)
    left: dict[int, str] = {}
    for k, name in enumerate(layout.names):
        present = set(cells_in(rows, k))
        kept = name in {"line", "line_type"} or (name in COLUMNS and name not in UNIT_CELL_COLUMNS)
        if not name or kept or not present:
            continue
        texts = [layout.number(cell) for cell in present]
        if any(CELL_NUMBER.fullmatch(cell) or cell.lower() in {"true", "false"} for cell in texts):
            continue
        behind = {match[1] if (match := WITH_UNIT.fullmatch(cell)) else "" for cell in texts}
        if layout.foreign and len(behind) == 1 and is_unit(*behind) and behind != {""}:
            units.setdefault(name, *behind)
        else:
            left[k] = name
    for k in left:
        letters = {cell.upper() for cell in cells_in(rows, k)}
        side = [one for one, known in HEMISPHERES.items() if letters <= {*known}]
        if side and side[0] in layout.names:
            hemispheres[side[0]] = k
    texts = [name for k, name in left.items() if k not in hemispheres.values()]
    layout = replace(layout, units=units, hemispheres=hemispheres).renamed(dict.fromkeys(left, ""))
    return layout.guessing(f"left out, no numbers: {', '.join(texts)}") if texts else layout


READING_RANGE_NT = 15_000.0, 90_000.0
"""Range of a reading's magnitude, the Earth's field plus the vehicle's, nT."""
ANGLES = "roll", "pitch", "heading"
NEAR_HALF_TURN_RAD = 0.1
"""Headings whose maximum is less than this below pi or 2 pi are taken as radians, rad."""


def earthly_units(length: float) -> list[str]:
    """Return the units in which a vector of this length is in :data:`READING_RANGE_NT`."""
    low, high = READING_RANGE_NT
    return [unit for unit, factor in NT_PER_UNIT.items() if low < length * factor < high]


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


def _with_units_of_axes(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with a unit for axes without one, from another axis or from the field's magnitude."""
    undeclared = layout.foreign and not set(CHANNELS) & set(layout.declared.columns)
    if not undeclared or not set(CHANNELS) <= set(layout.names):
        return layout
    stated = {layout.units.get(name, "") for name in CHANNELS}
    if stated == {""}:
        length = _length(layout, rows, [layout.names.index(name) for name in CHANNELS])
        fitting = earthly_units(length)
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


def _with_total(layout: Layout, rows: Rows) -> Layout:
    """Return the layout with ``total_field``, if one column has a scalar's name and the Earth's magnitude."""
    if not layout.foreign or "total_field" in layout.names:
        return layout
    kinds = ["scalar"] if set(CHANNELS) <= set(layout.names) else ["scalar", "total field"]
    others = {k: name for k, name in enumerate(layout.names) if name not in COLUMNS}
    fields = [k for k, name in others.items() if any(is_called(name, kind) for kind in kinds)]
    if len(fields) != 1:
        return layout
    theirs = layout.names[fields[0]]
    unit = layout.units.get(theirs, "nT")
    length = _length(layout, rows, fields) * NT_PER_UNIT.get(usual(unit), 0.0)
    if "nT" not in earthly_units(length):
        return layout
    units = {name: unit for name, unit in layout.units.items() if name != theirs}
    layout = replace(layout, units={**units, "total_field": unit}).renamed({fields[0]: "total_field"})
    return layout.guessing(f"total_field is {layout.headings[fields[0]]!r}")


def _numbers(layout: Layout, rows: Rows, places: Sequence[int]) -> FloatArray:
    """Return the numbers (n, k) in k columns, from the rows in which all k cells are numbers."""
    texts = [[layout.number(row[k]) for k in places] for row in rows if max(places) < len(row)]
    frame = pd.DataFrame(texts, columns=range(len(places)), dtype="str")
    numbers = np.column_stack([numbers_of(column) for _, column in frame.items()])
    return np.asarray(numbers[np.isfinite(numbers).all(axis=1)])


def _length(layout: Layout, rows: Rows, places: Sequence[int]) -> float:
    """Return the median magnitude of the vector in the columns `places`, in their unit; 0 without numbers."""
    numbers = _numbers(layout, rows, places)
    return float(np.median(np.linalg.norm(numbers, axis=1))) if len(numbers) else 0.0


def aliases(names: Sequence[str], units: Sequence[str] = ()) -> Mapping[int, str]:
    """Return index -> standard name of the columns that have a common other name.

    The three axes are recognised together or not at all: a single `b_x` is ambiguous. Three columns in
    units of a magnetic field, with names that differ only in x, y and z, are the axes.
    """
    words = list(map(bare, names))
    found: dict[int, str] = {}

    def only(word: str, words: Sequence[str] = words) -> int | None:
        return words.index(word) if words.count(word) == 1 else None

    if not set(CHANNELS) <= set(names):
        for pattern in NAMES["vectors"].split():
            places = [only(pattern.format(axis)) for axis in AXES]
            if None not in places:
                found |= {int(k or 0): name for k, name in zip(places, CHANNELS, strict=True)}
                break
        else:
            fields = [k for k, unit in enumerate(units) if usual(unit) in NT_PER_UNIT and words[k]]
            of_fields = [word if k in fields else "" for k, word in enumerate(words)]
            others = ["" if name in COLUMNS else word for name, word in zip(names, words, strict=True)]
            found |= _vector(of_fields, PATTERNS["axis with a unit"]) if len(fields) == len(AXES) else {}
            found |= {} if found else _vector(others, PATTERNS["axis"])
        found |= _further_axes(names, words, {name: k for k, name in found.items()})
    pair = _position(words)
    if any(names[k] != name for k, name in pair.items()):
        found |= pair
    inner = [match[2] if (match := PREFIXED_NAME.fullmatch(word)) else "" for word in words]
    for name in COLUMNS:
        if name in names or name in pair.values() or name == "quality":  # a foreign column has other flags
            continue
        aliases_of = [name.replace("_", ""), *ALIASES.get(name, [])]
        places = [only(word) for word in aliases_of]
        if name in PREFIXED_COLUMNS:
            places += [only(word, inner) for word in aliases_of]
        there = [k for k in places if k is not None and k not in found and names[k] not in COLUMNS]
        if there:
            found[there[0]] = name
    return found


def _position(words: Sequence[str]) -> dict[int, str]:
    """Return index -> name of latitude and longitude in `words`, two names with equal prefix and ending.

    A towed sensor's position is preferred, then a position without prefix, then any other.
    """
    pairs: dict[tuple[str, str], dict[str, int]] = {}
    for k, word in enumerate(words):
        match = PREFIXED_NAME.fullmatch(word)
        for name in ("latitude", "longitude"):
            if match and match[2] in [name, *ALIASES[name]]:
                pairs.setdefault((match[1] or "", match[3] or ""), {}).setdefault(name, k)
    whole = {around: pair for around, pair in pairs.items() if len(pair) == 2}
    if not whole:
        return {}
    best = min(whole, key=lambda around: (around[0] not in TOWED, around[0] != "", list(whole).index(around)))
    return {k: name for name, k in whole[best].items()}


def _vector(words: Sequence[str], pattern: re.Pattern[str]) -> dict[int, str]:
    """Return index -> name of the three axes in `words` by the endings of these, if they are unambiguous.

    If the names of several sensors differ by a number, the axes are those of the lowest number.
    """
    sensors: dict[str, dict[str, int]] = {}
    for k, word in enumerate(words):
        if match := pattern.fullmatch(word):
            name, axis = match.groups()[:2] if match[2] else match.groups()[2:]
            sensors.setdefault(name, {})[axis] = k
    alike = len({re.sub(r"\d+", "", name) for name in sensors}) == 1
    if not alike or any(sorted(axes) != list(AXES) for axes in sensors.values()):
        return {}
    return {k: f"mag_{axis}" for axis, k in sensors[min(sensors)].items()}


def _further_axes(names: Sequence[str], words: Sequence[str], first: Mapping[str, int]) -> dict[int, str]:
    """Return index -> name of the axes of further sensors, named as the first sensor with another number."""
    found: dict[int, str] = {}
    for number in range(2, MAX_SENSORS + 1):
        if f"mag{number}_x" in names or not all(name in first for name in CHANNELS):
            continue
        for pattern, other in NUMBERINGS:
            numbered = other.format(number - 1, number)
            wanted = [re.sub(pattern, numbered, words[first[name]]) for name in CHANNELS]
            places = [words.index(word) for word in wanted if words.count(word) == 1]
            if len(places) == len(AXES) and not {*places} & {*first.values()}:
                found |= {k: f"mag{number}_{axis}" for k, axis in zip(places, AXES, strict=True)}
                break
    return found
