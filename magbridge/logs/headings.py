"""The headings of a text file: name and unit, and the names that other programs give our columns."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from magbridge.columns import COLUMNS, NT_PER_UNIT, usual

__all__ = ["CELL_NUMBER", "WITH_UNIT", "aliases", "bare", "is_unit", "split"]

HEADING = re.compile(r"(?P<name>.*?)\s*(?:\[(?!\d+\])(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))?")
CELL_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([ed][-+]?\d+)?|[-+]?(nan|inf)|", re.IGNORECASE)
"""A cell that is a number, or empty; Fortran writes 1.5D+03."""
WITH_UNIT = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)) ?([a-zA-Z°µ%/]+)")
"""A cell that is a number with its unit."""
KNOWN_UNITS = {
    *NT_PER_UNIT,
    *(column.units for column in COLUMNS.values() if column.units != "1"),
    *("ms", "us", "ns", "min", "h", "UTC", "iso", "deg/s", "rad/s", "rad", "cm", "km", "mm", "in", "cm3"),
    *("A", "mA", "V", "mV", "Hz", "%", "K", "Pa", "hPa", "kPa", "mbar", "bar", "dbar", "g", "m/s2", "m/s^2"),
    *("cm/s", "kn"),
}
"""Units by which a row of units under the headings is known."""
AXES = "x", "y", "z"
PREFIXED_COLUMNS = "latitude", "longitude", "roll", "pitch", "heading", "depth"
VECTORS = (
    "mag{}", "magnetometer{}", "magneticfield{}", "magfield{}", "magnetic{}", "fluxgate{}", "flux{}", "b{}",
    "m{}", "h{}", "{}mag", "b1{}", "mag1{}", "rawmag{}", "magraw{}", "magn{}", "compass{}", "fgm{}",
)  # fmt: skip
"""What the three axes are called elsewhere, with neither capitals nor punctuation."""
ENDING = re.compile(r"(.*(?:mag|magnetic|magnetometer|field))([xyz])|(.*)([xyz])mag")
"""What they end in, behind the name of a message or a device: ``rawimuxmag``, ``fieldmagneticfieldx``."""
ALIASES = {
    "time": (
        *(
            "timestamp",
            "ts",
            "datetime",
            "timeutc",
            "utctime",
            "datetimeutc",
            "dateandtime",
            "isotime",
            "unixtime",
        ),
        *("unixtimestamp", "posixtime", "epoch", "epochtime", "utc", "gpstime", "gpsseconds", "jd", "mjd"),
        *("juliandate", "julianday", "julian", "exceltime", "exceldate", "datenum", "timeiso", "isoformat"),
        *(
            "zeit",
            "zeitstempel",
            "uhrzeit",
            "heure",
            "hora",
            "timeofday",
            "secondsofday",
            "sod",
            "tod",
            "seconds",
            "t",
            "tempo",
        ),
    ),
    "roll": ("rollangle",),
    "pitch": ("pitchangle",),
    "heading": ("yaw", "hdg", "compassheading", "trueheading", "magneticheading"),
    "latitude": ("lat", "breite", "geobreite"),
    "longitude": ("lon", "long", "lng", "laenge", "lnge", "geolaenge"),
    "depth": ("depthm", "tiefe", "profondeur", "profundidad"),
}
"""Our name -> names in other programs, the surest first."""
TOWED = "magnetometer", "mag", "sensor", "towfish", "fish", "tow", "layback"
"""Words before a position that say that it is the towed sensor's, not the ship's."""
PREFIXED_NAME = re.compile(
    rf"(gps|gnss|location|position|pos|nav|ins|ship|vessel|{'|'.join(TOWED)})?(.+?)(deg|degrees|dd|wgs84|mag1)?"
)
"""Words that may stand before and behind the names of a place and an attitude."""
MAX_SENSORS = 8
"""Largest number of a further vector sensor in one file."""


def split(heading: str) -> tuple[str, str]:
    """Return the name and the unit of a heading: ``Bx [uT]``, ``Bx (uT)``, ``Bx/uT``, ``Bx_uT``, ``Bx, uT``.

    Without a unit it is empty; a number in brackets, as in ``magADC[0]``, is an index.
    """
    match = HEADING.fullmatch(heading.strip())
    assert match is not None
    name, unit = match["name"].strip(), match["square"] or match["round"] or ""
    if not name:  # nothing but brackets is a name after all
        return heading.strip(), ""
    if not unit:
        for sign in "/_,":
            header, _, tail = name.rpartition(sign)
            tail = tail.strip()
            if header and usual(tail) in NT_PER_UNIT and tail not in {"T", "G"}:
                return header.strip(), tail
    return name, unit.strip()


def bare(name: str) -> str:
    """Return a name in lower case, without punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def is_unit(text: str) -> bool:
    """Return True if a cell under the headings is a unit."""
    return usual(text.strip().strip("[]()")) in KNOWN_UNITS


def aliases(names: Sequence[str], units: Sequence[str] = ()) -> Mapping[int, str]:
    """Return a mapping from position to our name for columns with a known other name.

    The three axes are recognised together or not at all: one `b_x` alone may be anything. Three columns in
    units of a magnetic field, with names that differ only in x, y and z, are the axes whatever they are
    called.
    """
    words = list(map(bare, names))
    found: dict[int, str] = {}

    def only(word: str, words: Sequence[str] = words) -> int | None:
        return words.index(word) if words.count(word) == 1 else None

    if not all(f"mag_{axis}" in names for axis in AXES):
        for pattern in VECTORS:
            places = [only(pattern.format(axis)) for axis in AXES]
            if None not in places:
                found |= {
                    place: f"mag_{axis}"
                    for place, axis in zip(places, AXES, strict=True)
                    if place is not None
                }
                break
        else:
            others = ["" if name in COLUMNS else word for name, word in zip(names, words, strict=True)]
            found |= _axes(words, units) or _ending_alike(others)
        found |= _further_axes(names, words, {name: k for k, name in found.items()})
    pair = _position(words)
    if any(names[k] != name for k, name in pair.items()):
        found |= pair
    inner = [match[2] if (match := PREFIXED_NAME.fullmatch(word)) else "" for word in words]
    for name in COLUMNS:
        if name in names or name in pair.values() or name == "quality":  # a foreign one is not our flags
            continue
        aliases_of = (name.replace("_", ""), *ALIASES.get(name, ()))
        places = [only(word) for word in aliases_of]
        if name in PREFIXED_COLUMNS:
            places += [only(word, inner) for word in aliases_of]
        there = [k for k in places if k is not None and k not in found and names[k] not in COLUMNS]
        if there:
            found[there[0]] = name
    return found


def _position(words: Sequence[str]) -> dict[int, str]:
    """Return the positions of latitude and longitude among bare names, both from columns with similar names.

    A towed sensor's position comes before one without such words, and that before any other.
    """
    pairs: dict[tuple[str, str], dict[str, int]] = {}
    for k, word in enumerate(words):
        match = PREFIXED_NAME.fullmatch(word)
        for name in ("latitude", "longitude"):
            if match and match[2] in (name, *ALIASES[name]):
                pairs.setdefault((match[1] or "", match[3] or ""), {}).setdefault(name, k)
    whole = {around: pair for around, pair in pairs.items() if len(pair) == 2}
    if not whole:
        return {}
    best = min(whole, key=lambda around: (around[0] not in TOWED, around[0] != "", list(whole).index(around)))
    return {k: name for name, k in whole[best].items()}


def _ending_alike(words: Sequence[str]) -> dict[int, str]:
    """Return the positions of the three axes among bare names that end in them, if no others do.

    If the names of several sensors differ by a number, the axes are those of the lowest number.
    """
    sensors: dict[str, dict[str, int]] = {}
    for k, word in enumerate(words):
        if match := ENDING.fullmatch(word):
            axes = sensors.setdefault(match[1] or match[3], {})
            axes[match[2] or match[4]] = k
    alike = len({re.sub(r"\d+", "", name) for name in sensors}) == 1
    if not alike or any(sorted(axes) != list(AXES) for axes in sensors.values()):
        return {}
    return {k: f"mag_{axis}" for axis, k in sensors[min(sensors)].items()}


def _further_axes(names: Sequence[str], words: Sequence[str], first: Mapping[str, int]) -> dict[int, str]:
    """Return the positions of the axes of further sensors, named as the first with another number."""
    if not all(f"mag_{axis}" in first for axis in AXES):
        return {}
    found: dict[int, str] = {}
    for number in range(2, MAX_SENSORS + 1):
        if f"mag{number}_x" in names:
            continue
        for numbered in _numberings(number):
            wanted = [numbered(words[first[f"mag_{axis}"]]) for axis in AXES]
            places = [words.index(word) for word in wanted if words.count(word) == 1]
            if len(places) == len(AXES) and not {*places} & {*first.values()}:
                found |= {k: f"mag{number}_{axis}" for k, axis in zip(places, AXES, strict=True)}
                break
    return found


def _numberings(number: int) -> list[Callable[[str], str]]:
    """Return the ways in which the name of an axis of sensor `number` is made from that of the first."""
    return [
        # b1x, imu0magx: the last 0 or 1 counts
        lambda word: re.sub(r"([01])(\D*)$", lambda m: f"{int(m[1]) + number - 1}{m[2]}", word),
        lambda word: f"{word[:-1]}{number}{word[-1]}",
        lambda word: f"{word}{number}",
    ]


def _axes(words: Sequence[str], units: Sequence[str]) -> dict[int, str]:
    """Return the positions of the three axes among bare names, if their units say that they are."""
    fields = [k for k, unit in enumerate(units) if usual(unit) in NT_PER_UNIT and words[k]]
    letters = {words[k][-1]: k for k in fields} if len(fields) == len(AXES) else {}
    alike = len({words[k][:-1] for k in fields}) == 1
    return {letters[axis]: f"mag_{axis}" for axis in AXES} if alike and set(letters) == set(AXES) else {}
