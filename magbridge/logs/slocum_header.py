"""What dbdreader takes for granted of a Slocum's file: a whole header, and a list of sensors as it should be.

Without the one it never ends, without the other it fails with the number of a system error.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from magbridge.errors import FormatError

__all__ = ["check_header"]

TAG = re.compile(rb"(\w+):\s*(.*)")
SENSOR_LINE = re.compile(rb"s:\s+[TF]\s+-?\d+\s+-?\d+\s+[1248]\s+[!-~]+\s+[!-~]+\s*")
"""``s: T 0 0 4 m_roll rad``: whether it is logged, two indices, bytes, name, unit."""
MAX_HEADER_BYTES = 1 << 16
"""Bytes, more than any header has."""
CACHES = ".", "cac", "cache", "../cac", "../cache"
"""Folders, seen from a file's, in which its list of sensors may be."""


def check_header(path: Path) -> list[Path]:
    """Check the header of a Slocum's file, and the list of its sensors; return where that list may be.

    FormatError: the header is cut off, or a line of the ``.cac`` is damaged. A compressed file is not looked
    into.
    """
    with path.open("rb") as file:
        lines = file.read(MAX_HEADER_BYTES).split(b"\n")
    if not lines[0].startswith(b"dbd_label:"):
        return list(_caches(path))
    tags = {found[1]: found[2].strip() for line in lines[:40] if (found := TAG.fullmatch(line))}
    count = tags.get(b"num_ascii_tags", b"")
    if not count.isdigit() or not 3 <= int(count) < len(lines):
        raise FormatError(path, "the header is cut off or damaged")
    if tags.get(b"sensor_list_factored") == b"0":
        return []
    crc = tags.get(b"sensor_list_crc", b"").decode("ascii", "replace").lower()
    lists = [cache for cache in _caches(path) if cache.stem.lower() == crc][:1]
    for cache in lists:
        _check_cache(cache)
    return lists


def _caches(path: Path) -> Iterator[Path]:
    for folder in CACHES:
        yield from (path.parent / folder).glob("*.[cC][aA][cC]")


def _check_cache(cache: Path) -> None:
    for row, line in enumerate(cache.read_bytes().splitlines(), 1):
        if not SENSOR_LINE.fullmatch(line) and line.strip():
            what = line[:40].decode("ascii", "backslashreplace")
            raise FormatError(cache, f"expected a sensor, not {what!r}: damaged", row=row)
