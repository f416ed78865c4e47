"""Read the records of an ArduPilot log, binary or text, by the log's own format records (``FMT``).

A binary record is the bytes A3 95, the number of its kind, and the fields that an ``FMT`` record describes.
It has neither a length nor a checksum. So the reader accepts a record only if it adjoins another: it begins
at the end of an accepted record, or another header follows at its end. All other bytes are damage and are
counted. A record that reaches beyond the start of the next chain was truncated and is damage as well. Numpy
finds the records in a few passes over all bytes.

The text form (``.log``, as Mission Planner and ``mavlogdump.py`` write it) has one record a line, with values
in the unit of the field. Lines without a record are counted.

References
----------
ArduPilot, "Logs (for developers)", https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, IndexArray
from magbridge.logs.fields import number_of

Bytes = NDArray[np.uint8]

FMT = 128
RECORD_HEADER_BYTES = 3
PASS = 1 << 24
"""Bytes that are searched for headers at a time."""
LETTERS = {
    "b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8",
    "g": "<f2", "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "a": "V64",
    "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4",
}  # fmt: skip
OWN_SCALE = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
"""Letter of a field's type -> factor by which the stored number exceeds the value."""
FORMAT_LAYOUT = np.dtype("V3, u1, u1, S4, S16, S64")
"""Layout of a record ``FMT``: header, number, length, name, letters and columns of the described kind."""


class Records(dict[str, Any]):
    """Records of one kind: field -> numbers or texts (n,), in the unit of the field.

    `at` (n,): position of each record in the file, increasing: its first byte, or its line in a text.
    """

    def __init__(self, positions: IndexArray, fields: Mapping[str, Any]) -> None:
        super().__init__(fields)
        self.at = positions

    def part(self, chosen: slice | BoolArray | IndexArray) -> Records:
        """Return some of the records."""
        return Records(self.at[chosen], {name: values[chosen] for name, values in self.items()})


class Flash(NamedTuple):
    """Records read from a log."""

    records: dict[str, Records]
    """Name of the kind -> its records."""
    letters: dict[tuple[str, str], str]
    """Kind and field -> letter of the field's type."""
    skipped: int
    """Number of bytes, or lines, that do not belong to a record."""


class _Kind(NamedTuple):
    """A kind of record, as an ``FMT`` record describes it, and the first byte for which it is valid."""

    since: int
    length: int
    name: str
    letters: str
    columns: list[str]


def read_binary(path: Path, wanted: Collection[str]) -> Flash:
    """Return the records of a binary log; `wanted` lists the kinds to read."""
    data = np.memmap(path, dtype=np.uint8, mode="r")
    found = []
    for start in range(0, data.size - 2, PASS):
        stop = min(start + PASS, data.size - 2)
        is_header = (data[start:stop] == 0xA3) & (data[start + 1 : stop + 1] == 0x95)
        found.append(start + np.flatnonzero(is_header))
    headers = np.concatenate(found) if found else np.empty(0, dtype=np.intp)
    kinds = _kinds(data, headers)
    table, numbers = np.zeros(256, dtype=np.intp), data[headers + 2]
    for number, described in kinds.items():
        table[number] = described[0].length
    lengths = table[numbers]  # 0 for a kind that is not described
    for number, (_, *again) in kinds.items():
        for kind in again:
            lengths[(numbers == number) & (headers >= kind.since)] = kind.length
    headers, lengths = headers[lengths > 0], lengths[lengths > 0]
    believed = _chained(headers, headers + lengths, data.size)
    at = headers[believed]
    numbers = data[at + 2]
    pieces: dict[str, list[Records]] = {}
    letters: dict[tuple[str, str], str] = {}
    for number, described in kinds.items():
        here = at[numbers == number]
        ends = np.searchsorted(here, [kind.since for kind in described[1:]])
        for kind, positions in zip(described, np.split(here, ends), strict=True):
            if kind.name in wanted and len(positions):
                pieces.setdefault(kind.name, []).append(_decoded(data, kind, positions))
                fields = zip(kind.columns, kind.letters, strict=False)
                letters |= {(kind.name, name): letter for name, letter in fields}
    records = {name: _joined(found) for name, found in pieces.items()}
    return Flash(records, letters, int(data.size - lengths[believed].sum()))


def _joined(pieces: Sequence[Records]) -> Records:
    """Return records of one kind that several descriptions read, with the fields that all of them have."""
    shared = [field for field in pieces[0] if all(field in other for other in pieces)]
    whole = Records(
        np.concatenate([part.at for part in pieces]),
        {field: np.concatenate([part[field] for part in pieces]) for field in shared},
    )
    return whole.part(np.argsort(whole.at)) if len(pieces) > 1 else whole


def _kinds(data: Bytes, headers: IndexArray) -> dict[int, list[_Kind]]:
    """Return number -> layouts of a kind of record in file order, without contradictory descriptions.

    A log describes a kind again after a boot with other firmware. Each layout is then valid from its own
    description on.
    """
    at = headers[(headers <= data.size - FORMAT_LAYOUT.itemsize)]
    at = at[data[at + 2] == FMT]
    kinds: dict[int, list[_Kind]] = {}
    described = _gather(data, at, FORMAT_LAYOUT).tolist()
    for start, (_, number, size, *texts) in zip(at.tolist(), described, strict=True):
        name, letters, columns = (text.decode("latin-1") for text in texts)
        known = all(letter in LETTERS for letter in letters)
        sizes = [np.dtype(LETTERS[letter]).itemsize for letter in letters] if known else []
        is_sound = not known or RECORD_HEADER_BYTES + sum(sizes) == size
        if is_sound and size > RECORD_HEADER_BYTES and name.isalnum():
            before = kinds.setdefault(number, [])
            kind = _Kind(start if before else 0, size, name, letters, columns.split(","))
            if not before or before[-1][1:] != kind[1:]:
                before.append(kind)
    return kinds


def _chained(starts: IndexArray, ends: IndexArray, size: int) -> IndexArray:
    """Return the indices of accepted records among candidates from byte `starts` (n,) to byte `ends` (n,)."""
    n = len(starts)
    if not n:
        return np.empty(0, dtype=np.intp)
    joins = np.append(ends[:-1] == starts[1:], False)
    breaks = np.flatnonzero(~joins)
    after = np.searchsorted(starts, ends[breaks])  # first header that is not inside the record
    meets = np.append(starts, -1)[after] == ends[breaks]
    joins[breaks] = meets | (ends[breaks] == size)
    joined, at_breaks = np.flatnonzero(joins).tolist(), breaks.tolist()
    found, k, linked = [], 0, False
    while k < n:
        if not linked:
            later = bisect_left(joined, k)
            if later == len(joined):
                break
            k = joined[later]
        b = bisect_left(at_breaks, k)
        last = at_breaks[b]
        found.append((k, last))
        linked = bool(meets[b])
        following = int(after[b])
        if not joins[last]:  # no header follows: damage after this record, or in it
            inside = bisect_left(joined, last + 1)
            cut = inside < len(joined) and joined[inside] < following
            if cut or ends[last] > size:
                found[-1] = (k, last - 1)
            following = joined[inside] if cut else following
        k = following
    return np.concatenate([np.arange(0), *(np.arange(first, last + 1) for first, last in found)])


def _gather(data: Bytes, starts: IndexArray, layout: np.dtype[Any], offset: int = 0) -> NDArray[Any]:
    """Return the values at `offset` bytes after each of `starts`, read as `layout`."""
    taken = data[starts[:, None] + np.arange(offset, offset + layout.itemsize)]
    return taken.view(layout)[:, 0] if len(starts) else np.empty(0, layout)


def _decoded(data: Bytes, kind: _Kind, starts: IndexArray) -> Records:
    """Return the records of a kind that begin at the bytes `starts` (n,)."""
    fields: dict[str, Any] = {}
    offset = RECORD_HEADER_BYTES
    for name, letter in zip(kind.columns, kind.letters, strict=False):
        layout = np.dtype(LETTERS.get(letter, "V1"))
        if letter not in LETTERS or offset + layout.itemsize > kind.length:
            break  # a field of an unknown letter has no known length, so the next has no known start
        if layout.kind == "S":
            texts = _gather(data, starts, layout, offset)
            fields[name] = np.array([text.decode("latin-1") for text in texts], str)
        elif layout.kind != "V":
            numbers = _gather(data, starts, layout, offset).astype(np.float64)
            fields[name] = numbers / OWN_SCALE.get(letter, 1.0)
        offset += layout.itemsize
    return Records(starts, fields)


TEXT_TYPES = frozenset("nNZaM")


def read_text(path: Path, wanted: Collection[str]) -> Flash:
    """Return the records of a text log; `wanted` lists the kinds to read."""
    described: dict[str, tuple[str, list[str]]] = {}
    rows: dict[str, dict[int, list[str]]] = {}
    skipped = 0
    with path.open(encoding="latin-1", newline="\n") as file:
        for k, line in enumerate(file):
            name, *parts = [part.strip() for part in line.split(",")]
            if name == "FMT" and len(parts) > 4:
                described[parts[2]] = parts[3], parts[4:]
            elif name not in described:
                skipped += (name, *parts) != ("",)
            elif len(parts) != len(described[name][1]):
                skipped += name in wanted
            elif name in wanted:
                rows.setdefault(name, {})[k] = parts
    records: dict[str, Records] = {}
    letters: dict[tuple[str, str], str] = {}
    for name, lines in rows.items():
        fields: dict[str, Any] = {}
        for column, letter, *texts in zip(
            described[name][1], described[name][0], *lines.values(), strict=False
        ):
            letters[name, column] = letter
            fields[column] = np.array(texts if letter in TEXT_TYPES else [number_of(text) for text in texts])
        records[name] = Records(np.array([*lines], dtype=np.intp), fields)
    return Flash(records, letters, skipped)
