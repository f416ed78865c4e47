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
from collections.abc import Collection, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import FloatArray, IndexArray

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
FORMAT_LAYOUT = np.dtype([("", "u1", RECORD_HEADER_BYTES),
                          *zip(("type", "length", "name", "letters", "columns"),
                                           ("u1", "u1", "S4", "S16", "S64"), strict=True)])  # fmt: skip


class Records(NamedTuple):
    """Records of one kind."""

    at: IndexArray
    """(n,): Position of each record in the file, increasing: its first byte, or its line in a text."""
    fields: dict[str, FloatArray]
    """Numbers by field, (n,) each, in the unit of the field."""
    texts: dict[str, list[str]]
    """Texts by field, n each."""


class Flash(NamedTuple):
    """Records read from a log."""

    records: dict[str, Records]
    """Name of the kind -> its records."""
    letters: dict[tuple[str, str], str]
    """Kind and field -> letter of the field's type."""
    skipped: int
    """Number of bytes, or lines, that do not belong to a record."""


class _Kind(NamedTuple):
    """A kind of record, as an ``FMT`` record at byte `at` describes it."""

    at: int
    number: int
    length: int
    name: str
    letters: str
    columns: tuple[str, ...]


def read_binary(path: Path, wanted: Mapping[str, Collection[str]]) -> Flash:
    """Return the records of a binary log; `wanted` lists the kinds to read, and the fields of each."""
    data = np.memmap(path, dtype=np.uint8, mode="r")
    found = []
    for start in range(0, data.size - 2, PASS):
        stop = min(start + PASS, data.size - 2)
        is_header = (data[start:stop] == 0xA3) & (data[start + 1 : stop + 1] == 0x95)
        found.append(start + np.flatnonzero(is_header))
    headers = np.concatenate(found) if found else np.empty(0, dtype=np.intp)
    kinds = _kinds(data, headers)
    lengths = _lengths(data, headers, kinds)
    headers, lengths = headers[lengths > 0], lengths[lengths > 0]
    believed = _chained(headers, headers + lengths, data.size)
    at = headers[believed]
    numbers = data[at + 2]
    records: dict[str, Records] = {}
    letters: dict[tuple[str, str], str] = {}
    for kind, first, last in _spans(kinds):
        if kind.name not in wanted:
            continue
        here = at[numbers == kind.number]
        here = here[slice(*np.searchsorted(here, (first, last)))]
        if len(here):
            fields = zip(kind.columns, kind.letters, strict=False)
            letters |= {(kind.name, name): letter for name, letter in fields}
            decoded = _decoded(data, kind, here, wanted[kind.name])
            before = records.get(kind.name)
            records[kind.name] = decoded if before is None else _joined(before, decoded)
    return Flash(records, letters, int(data.size - lengths[believed].sum()))


def _kinds(data: Bytes, headers: IndexArray) -> list[_Kind]:
    """Return the kinds of record that a log describes, in file order, without contradictory descriptions."""
    at = headers[(headers <= data.size - FORMAT_LAYOUT.itemsize)]
    at = at[data[at + 2] == FMT]
    kinds = []
    for start, one in zip(at, _gather(data, at, FORMAT_LAYOUT), strict=True):
        name, letters, columns = (one[field].decode("latin-1") for field in ("name", "letters", "columns"))
        size = int(one["length"])
        known = all(letter in LETTERS for letter in letters)
        sizes = [np.dtype(LETTERS[letter]).itemsize for letter in letters] if known else []
        is_sound = not known or RECORD_HEADER_BYTES + sum(sizes) == size
        if is_sound and size > RECORD_HEADER_BYTES and name.isalnum():
            names = tuple(columns.split(","))
            kinds.append(_Kind(int(start), int(one["type"]), size, name, letters, names))
    return kinds


def _spans(kinds: list[_Kind]) -> Iterator[tuple[_Kind, int, int]]:
    """Yield each description with the range of bytes in which it holds, up to a new layout of the kind."""
    for number in sorted({kind.number for kind in kinds}):
        mine = [kind for kind in kinds if kind.number == number]
        new = [mine[0], *(b for a, b in pairwise(mine) if a[2:] != b[2:])]
        starts = [0, *(kind.at for kind in new[1:]), np.iinfo(np.intp).max]
        yield from zip(new, starts, starts[1:], strict=False)


def _lengths(data: Bytes, headers: IndexArray, kinds: list[_Kind]) -> IndexArray:
    """Return the length (n,), bytes, of the record that each header begins; 0 for an undescribed kind."""
    numbers = data[headers + 2]
    spans = list(_spans(kinds))
    table = np.zeros(256, dtype=np.intp)
    for kind, first, _ in spans:
        if not first:
            table[kind.number] = kind.length
    lengths = table[numbers]
    for kind, first, _ in spans:
        if first:  # described again, as after a boot with other firmware
            lengths[(numbers == kind.number) & (headers >= first)] = kind.length
    return lengths


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


def _decoded(data: Bytes, kind: _Kind, starts: IndexArray, wanted: Collection[str]) -> Records:
    fields, texts, offset = {}, {}, RECORD_HEADER_BYTES
    for name, letter in zip(kind.columns, kind.letters, strict=False):
        layout = np.dtype(LETTERS.get(letter, "V1"))
        if letter not in LETTERS or offset + layout.itemsize > kind.length:
            break  # a field of an unknown letter has no known length, so the next has no known start
        if name in wanted and layout.kind in "iuf":
            numbers = _gather(data, starts, layout, offset).astype(np.float64)
            fields[name] = numbers / OWN_SCALE.get(letter, 1.0)
        elif name in wanted and layout.kind == "S":
            texts[name] = [text.decode("latin-1") for text in _gather(data, starts, layout, offset)]
        offset += layout.itemsize
    return Records(starts, fields, texts)


def _joined(first: Records, second: Records) -> Records:
    """Return two sets of records of one kind, which was described twice, as one with their common fields."""
    return Records(
        np.concatenate([first.at, second.at]),
        {name: np.concatenate([first.fields[name], second.fields[name]])
         for name in first.fields if name in second.fields},
        {name: first.texts[name] + second.texts[name] for name in first.texts if name in second.texts},
    )  # fmt: skip


def number_of(text: str) -> float:
    """Return the number in a text; NaN if the text is damaged."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


TEXT_TYPES = frozenset("nNZaM")


def read_text(path: Path, wanted: Mapping[str, Collection[str]]) -> Flash:
    """Return the records of a text log; `wanted` lists the kinds to read, and the fields of each."""
    described: dict[str, tuple[str, tuple[str, ...]]] = {}
    lines: dict[str, list[list[str]]] = {}
    at: dict[str, list[int]] = {}
    skipped = 0
    with path.open(encoding="latin-1", newline="\n") as file:
        for k, line in enumerate(file):
            parts = [part.strip() for part in line.split(",")]
            if parts[0] == "FMT" and len(parts) > 5:
                described[parts[3]] = parts[4], tuple(parts[5:])
            elif parts[0] not in described:
                skipped += parts != [""]
            elif parts[0] in wanted:
                if len(parts) - 1 == len(described[parts[0]][1]):
                    lines.setdefault(parts[0], []).append(parts[1:])
                    at.setdefault(parts[0], []).append(k)
                else:
                    skipped += 1
    records: dict[str, Records] = {}
    kept: dict[tuple[str, str], str] = {}
    for name, rows in lines.items():
        letters, columns = described[name]
        kept |= {(name, one): letter for one, letter in zip(columns, letters, strict=False)}
        records[name] = Records(np.array(at[name], dtype=np.intp), {}, {})
        for column, letter, values in zip(columns, letters, zip(*rows, strict=True), strict=False):
            if column in wanted[name] and letter in TEXT_TYPES:
                records[name].texts[column] = list(values)
            elif column in wanted[name]:
                records[name].fields[column] = np.array([number_of(value) for value in values])
    return Flash(records, kept, skipped)
