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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray, IndexArray
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
FORMAT_LAYOUT = np.dtype([("", "u1", RECORD_HEADER_BYTES),
                          *zip(("type", "length", "name", "letters", "columns"),
                                           ("u1", "u1", "S4", "S16", "S64"), strict=True)])  # fmt: skip


class Records(Mapping[str, Any]):
    """Records of one kind by field: numbers or texts (n,) in the unit of the field, decoded when asked for.

    `at` (n,): position of each record in the file, increasing: its first byte, or its line in a text.
    `decoders`: field -> function that returns the values at such positions.
    """

    def __init__(self, positions: IndexArray, decoders: Mapping[str, Callable[[IndexArray], Any]]) -> None:
        self.at, self._decoders = positions, decoders

    def __getitem__(self, field: str) -> Any:
        return self._decoders[field](self.at)

    def __iter__(self) -> Iterator[str]:
        return iter(self._decoders)

    def __len__(self) -> int:
        return len(self._decoders)

    def part(self, chosen: slice | BoolArray) -> Records:
        """Return some of the records."""
        return Records(self.at[chosen], self._decoders)

    def scaled(self, sources: Mapping[str, tuple[str, float]]) -> Records:
        """Return the records with further fields: name -> field that holds the numbers, and a factor."""
        further = {name: partial(_scaled, self._decoders[field], factor)
                   for name, (field, factor) in sources.items()}  # fmt: skip
        return Records(self.at, {**self._decoders, **further})


def _scaled(decoder: Callable[[IndexArray], Any], factor: float, starts: IndexArray) -> FloatArray:
    return np.asarray(factor * decoder(starts))


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
                pieces.setdefault(kind.name, []).append(Records(positions, _decoders(data, kind)))
                fields = zip(kind.columns, kind.letters, strict=False)
                letters |= {(kind.name, name): letter for name, letter in fields}
    records = {name: _joined(found) for name, found in pieces.items()}
    return Flash(records, letters, int(data.size - lengths[believed].sum()))


def _joined(pieces: Sequence[Records]) -> Records:
    """Return records of one kind that several descriptions read, with the fields that all of them have."""
    first, *others = pieces
    if not others:
        return first

    def values(field: str, starts: IndexArray) -> Any:
        chosen = [part.part(np.isin(part.at, starts)) for part in pieces]
        found = [[*part[field]] for part in chosen]
        order = np.argsort(np.concatenate([part.at for part in chosen]))
        together = [*chain(*found)]
        in_order = [together[k] for k in order.tolist()]
        return in_order if in_order and isinstance(in_order[0], str) else np.array(in_order, float)

    shared = [field for field in first if all(field in other for other in others)]
    positions = np.sort(np.concatenate([part.at for part in pieces]))
    return Records(positions, {field: partial(values, field) for field in shared})


def _kinds(data: Bytes, headers: IndexArray) -> dict[int, list[_Kind]]:
    """Return number -> layouts of a kind of record in file order, without contradictory descriptions.

    A log describes a kind again after a boot with other firmware. Each layout is then valid from its own
    description on.
    """
    at = headers[(headers <= data.size - FORMAT_LAYOUT.itemsize)]
    at = at[data[at + 2] == FMT]
    kinds: dict[int, list[_Kind]] = {}
    for start, one in zip(at.tolist(), _gather(data, at, FORMAT_LAYOUT), strict=True):
        name, letters, columns = (one[field].decode("latin-1") for field in ("name", "letters", "columns"))
        size = int(one["length"])
        known = all(letter in LETTERS for letter in letters)
        sizes = [np.dtype(LETTERS[letter]).itemsize for letter in letters] if known else []
        is_sound = not known or RECORD_HEADER_BYTES + sum(sizes) == size
        if is_sound and size > RECORD_HEADER_BYTES and name.isalnum():
            before = kinds.setdefault(int(one["type"]), [])
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


def _decoders(data: Bytes, kind: _Kind) -> dict[str, Callable[[IndexArray], Any]]:
    """Return field -> function that returns its values (n,) in the records that begin at given bytes."""
    found: dict[str, Callable[[IndexArray], Any]] = {}
    offset = RECORD_HEADER_BYTES
    for name, letter in zip(kind.columns, kind.letters, strict=False):
        layout = np.dtype(LETTERS.get(letter, "V1"))
        if letter not in LETTERS or offset + layout.itemsize > kind.length:
            break  # a field of an unknown letter has no known length, so the next has no known start
        if layout.kind != "V":
            found[name] = partial(_values, data, layout, offset, OWN_SCALE.get(letter, 1.0))
        offset += layout.itemsize
    return found


def _values(data: Bytes, layout: np.dtype[Any], offset: int, scale: float, starts: IndexArray) -> Any:
    found = _gather(data, starts, layout, offset)
    if layout.kind == "S":
        return [text.decode("latin-1") for text in found]
    return found.astype(np.float64) / scale


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
        fields = list(enumerate(zip(described[name][1], described[name][0], strict=False)))
        letters |= {(name, column): letter for _, (column, letter) in fields}
        decoders = {column: partial(_cells, lines, k, letter) for k, (column, letter) in fields}
        records[name] = Records(np.array([*lines], dtype=np.intp), decoders)
    return Flash(records, letters, skipped)


def _cells(lines: Mapping[int, Sequence[str]], k: int, letter: str, numbers: IndexArray) -> Any:
    """Return the values of field `k` in the rows with line `numbers` (n,)."""
    texts = [lines[number][k] for number in numbers.tolist()]
    return texts if letter in TEXT_TYPES else np.array([number_of(text) for text in texts])
