"""Text files as they are, or compressed by gzip, bzip2 or xz, whatever they are called."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zlib
from pathlib import Path
from typing import IO, Any

__all__ = ["DECOMPRESSION_ERRORS", "is_packed", "opened"]

PACKERS: dict[bytes, Any] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\0": lzma.open}
"""First bytes -> how it is unpacked."""
DECOMPRESSION_ERRORS = EOFError, zlib.error, lzma.LZMAError
"""Errors of damaged ones, in addition to OSError."""


def is_packed(path: Path) -> bool:
    """Whether a file is compressed, by its first bytes."""
    with path.open("rb") as file:
        return file.read(6).startswith(tuple(PACKERS))


def opened(path: Path) -> IO[bytes]:
    """Open a file to read its bytes, unpacked."""
    with path.open("rb") as file:
        start = file.read(6)
    unpack = next((unpack for mark, unpack in PACKERS.items() if start.startswith(mark)), Path.open)
    opened_file: IO[bytes] = unpack(path, "rb")
    return opened_file
