"""The file of the state between runs: changed parameters, and time stamps of signed streams."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from magbridge.errors import FormatError
from magbridge.files import atomic_path

__all__ = ["StoredState", "load", "save"]


Byte = Annotated[int, Meta(ge=0, le=255)]


class StoredState(msgspec.Struct, frozen=True):
    """The contents of the file."""

    parameters: dict[str, Annotated[float, Meta(ge=-3e38, le=3e38)]] = {}
    """Values that differ from the configuration's."""
    signing_timestamp: Annotated[int, Meta(ge=0, lt=1 << 47)] = 0
    """The last that may have been used (10 µs since 2015-01-01); 48 bits on the link."""
    signing_streams: list[tuple[Byte, Byte, Byte, bool, Annotated[int, Meta(ge=0, lt=1 << 48)]]] = []
    """The last time stamp accepted of each stream."""


def load(path: str | Path) -> StoredState:
    """Read the file; return an empty state if it does not exist.

    FormatError: it is not what :func:`save` wrote.
    """
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=StoredState)
    except FileNotFoundError:
        return StoredState()
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FormatError(path, f"kept parameters as JSON: {error}") from error


def save(path: str | Path, kept: StoredState) -> None:
    """Write the file, whole or not at all, and sync it to the disk: power may be cut at any moment."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(kept), indent=2))
