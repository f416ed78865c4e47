"""Terminal captures of logging programs: lines without headings.

MotionCal (PJRC) takes nine numbers a line, ``Raw:`` and the counts of accelerometer, gyroscope and
magnetometer; the last three are in 0.1 uT. Adafruit's sketches add ``Uni:`` with the same in m/s2, rad/s and
uT; where a capture has both, ``Uni:`` is read, for it has more digits. Neither has a time: the lines are
taken for a hundred a second, which is what the sketches send.

JSON lines, an object a line, and the sentences of a Marine Magnetics Explorer
(``*26.331/10:00:00.0 F:50000.123 S:150 D:+003.0m ...``) become a table with headings.

References
----------
https://www.pjrc.com/store/prop_shield.html; Adafruit_AHRS, examples/calibration.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.columns import CHANNELS, NT_PER_UNIT
from magbridge.errors import FormatError
from magbridge.logs.deployment import deployment, with_guesses, with_losses

CAPTURE_RATE_HZ = 100.0
"""Lines a second that MotionCal's senders write."""
CAPTURE_LINE = re.compile(
    r"(Raw|Uni):\s*(" + r",\s*".join([r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"] * 9) + r")\s*"
)
OTHER_PREFIXES = "Uni:", "Ori:", "Cal1:", "Cal2:"
"""What else these senders write."""
COUNT = {"Raw": 0.1 * NT_PER_UNIT["uT"], "Uni": NT_PER_UNIT["uT"]}
"""nT in one unit of the magnetometer's numbers."""
EXPLORER = re.compile(
    r"\*(?P<year>\d\d)\.(?P<day>\d{3})/(?P<clock>[\d:.]+) F:(?P<field>[\d.]+)"
    r"(?: S:(?P<signal>[-+\d.]+))?(?: D:(?P<depth>[-+\d.]+)m)?(?: A:(?P<altitude>[-+\d.]+)m)?.*"
)
"""A sentence: year and day of the year, time, field in nT, signal strength, depth and altitude in m."""
EXPLORER_HEADINGS = "time,total_field [nT],signal,depth [m],altitude [m]\n"
MIN_LINE_FRACTION = 0.5
"""Least fraction of the first lines that are of a form."""
Pieces = Iterator[tuple[xr.Dataset, Sequence[int]]]


def reader(header: Sequence[str]) -> Callable[[Path, Iterator[str], int], Pieces] | None:
    """Return the reader of a capture that begins with these lines, or None if it is unknown."""
    kinds = [match[1] for line in header if (match := CAPTURE_LINE.fullmatch(line.strip()))]
    if not kinds or len(kinds) < len(header) / 4:
        return None
    kind = "Uni" if "Uni" in kinds else "Raw"
    return lambda path, lines, rows: _motioncal(path, lines, rows, kind)


def as_table(header: Sequence[str]) -> Callable[[Iterator[str]], Iterator[str]] | None:
    """Return the converter of a capture to a table with a heading, by its first lines.

    None: the lines are of no such form. A line that is damaged stays as it is, and is counted by the reader.
    """
    lines = [line.strip() for line in header if line.strip()]
    if sum(EXPLORER.fullmatch(line) is not None for line in lines) > MIN_LINE_FRACTION * len(lines):
        return _explorer
    objects = [one for line in lines if (one := _json(line)) is not None]
    if len(objects) > MIN_LINE_FRACTION * len(lines):
        names = list(dict.fromkeys(name for one in objects for name in one))
        return lambda lines: _json_lines(names, lines)
    return None


def _explorer(lines: Iterator[str]) -> Iterator[str]:
    yield EXPLORER_HEADINGS
    for line in lines:
        if match := EXPLORER.fullmatch(line.strip()):
            values = (match[name] or "" for name in ("field", "signal", "depth", "altitude"))
            yield f"20{match['year']}-{match['day']}T{match['clock']},{','.join(values)}\n"
        else:
            yield line


def _json(line: str) -> dict[str, object] | None:
    """Return the JSON object of a line, or None."""
    try:
        found = json.loads(line) if line.startswith("{") else None
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _json_lines(names: Sequence[str], lines: Iterator[str]) -> Iterator[str]:
    yield _csv_line(names)
    for line in lines:
        one = _json(line.strip())
        yield (
            line if one is None else _csv_line(["" if one.get(name) is None else one[name] for name in names])
        )


def _csv_line(values: Sequence[object]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(values)
    return text.getvalue()


def _motioncal(path: Path, lines: Iterator[str], rows: int, kind: str) -> Pieces:
    """Yield the lines of one kind, each piece with their numbers; those that are damaged are counted."""
    damaged = 0

    def wanted() -> Iterator[tuple[int, str]]:
        nonlocal damaged
        for number, line in enumerate(lines, 1):
            match = CAPTURE_LINE.fullmatch(line.strip())
            if match and match[1] == kind:
                yield number, match[2]
            elif not match and line.strip() and not line.startswith(OTHER_PREFIXES):
                damaged += 1

    note = f"MotionCal's {kind}: lines, {COUNT[kind]:g} nT a count; time: {CAPTURE_RATE_HZ:g} lines a second"
    attrs = with_guesses(path, {"time_reference": "boot"}, [note])
    found, done = wanted(), 0
    block = list(islice(found, rows))
    if not block:
        raise FormatError(path, f"expected lines as {kind}:0,0,8192,0,0,0,300,50,450")
    while block:
        following = list(islice(found, rows))
        lost, damaged = damaged, 0
        values = np.array([[float(text) for text in numbers.split(",")] for _, numbers in block])
        axes = dict(zip(CHANNELS, COUNT[kind] * values[:, 6:].T, strict=True))
        piece = deployment(path, (done + np.arange(len(block))) / CAPTURE_RATE_HZ, axes, attrs=attrs)
        yield with_losses(piece, {"rows_dropped": lost}), [number for number, _ in block]
        done, block = done + len(block), following
