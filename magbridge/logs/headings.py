"""The headings of a text file: name and unit, and the names that other programs give our columns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from magbridge.columns import COLUMNS, NT_PER_UNIT, usual

__all__ = ["NUMBER", "aliases", "bare", "is_unit", "split"]

HEADING = re.compile(r"(?P<name>.*?)\s*(?:\[(?!\d+\])(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))?")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([ed][-+]?\d+)?|[-+]?(nan|inf)|", re.IGNORECASE)
"""A cell that is a number, or empty; Fortran writes 1.5D+03."""
UNITS = {
    *NT_PER_UNIT,
    *(column.units for column in COLUMNS.values() if column.units != "1"),
    *("ms", "us", "ns", "min", "h", "UTC", "iso", "deg/s", "rad/s", "rad", "cm", "km", "mm", "in", "cm3"),
    *("A", "mA", "V", "mV", "Hz", "%", "K", "Pa", "hPa", "kPa", "mbar", "bar", "dbar", "g", "m/s2", "m/s^2"),
    *("cm/s", "kn"),
}
"""Units by which a row of units under the headings is known."""
AXES = "x", "y", "z"
PLACES = "latitude", "longitude", "roll", "pitch", "heading"
VECTORS = (
    "mag{}", "magnetometer{}", "magneticfield{}", "magfield{}", "magnetic{}", "fluxgate{}", "flux{}", "b{}",
    "m{}", "h{}", "{}mag", "b1{}", "mag1{}", "rawmag{}", "magraw{}", "magn{}", "compass{}", "fgm{}",
)  # fmt: skip
"""What the three axes are called elsewhere, with neither capitals nor punctuation."""
ENDING = re.compile(r"(.*(?:mag|magnetic|magnetometer|field))([xyz])|(.*)([xyz])mag")
"""What they end in, behind the name of a message or a device: ``rawimuxmag``, ``fieldmagneticfieldx``."""
ALIASES = {
    "time": (
        *("timestamp", "datetime", "timeutc", "utctime", "datetimeutc", "dateandtime", "isotime", "unixtime"),
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
"""Our name -> what others call it, the surest first."""
AROUND = re.compile("(?:gps|gnss|location|position|pos|nav|ins)?(.+?)(?:deg|degrees|dd|wgs84)?")
"""What may stand before and behind the names of a place and an attitude."""


def split(heading: str) -> tuple[str, str]:
    """Return the name and the unit of a heading: ``Bx [uT]``, ``Bx (uT)``, ``Bx/uT``, ``Bx_uT``, ``Bx, uT``.

    Where there is no unit it is empty; a number in brackets, as in ``magADC[0]``, is an index.
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
    """Return a name in small letters, without punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def is_unit(text: str) -> bool:
    """Whether a cell under the headings is a unit: of a row of them at least one must be."""
    return usual(text.strip().strip("[]()")) in UNITS


def aliases(names: Sequence[str], units: Sequence[str] = ()) -> Mapping[int, str]:
    """Return, for columns under another name than ours that are known to mean the same: position -> our name.

    The three axes are recognised together or not at all: one `b_x` alone may be anything. Three columns in
    units of a magnetic field, alike but for their x, y and z, are the axes whatever they are called.
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
    for name in COLUMNS:
        if name in names or name == "quality":  # a foreign one is not our set of flags
            continue
        for word in (name.replace("_", ""), *ALIASES.get(name, ())):
            place = only(word)
            if place is None and name in PLACES:
                place = only(word, [match[1] if (match := AROUND.fullmatch(one)) else "" for one in words])
            if place is not None and place not in found and name not in found.values():
                found[place] = name
                break
    return found


def _ending_alike(words: Sequence[str]) -> dict[int, str]:
    """Return the positions of the three axes among bare names that end in them, if no others do."""
    ends = [(k, match) for k, word in enumerate(words) if (match := ENDING.fullmatch(word))]
    axes = {k: match[2] or match[4] for k, match in ends}
    alike = len({match[1] or match[3] for _, match in ends}) == 1 and sorted(axes.values()) == list(AXES)
    return {k: f"mag_{axis}" for k, axis in axes.items()} if alike else {}


def _axes(words: Sequence[str], units: Sequence[str]) -> dict[int, str]:
    """Return the positions of the three axes among bare names, if their units say that they are."""
    fields = [k for k, unit in enumerate(units) if usual(unit) in NT_PER_UNIT and words[k]]
    letters = {words[k][-1]: k for k in fields} if len(fields) == len(AXES) else {}
    alike = len({words[k][:-1] for k in fields}) == 1
    return {letters[axis]: f"mag_{axis}" for axis in AXES} if alike and set(letters) == set(AXES) else {}
