"""Driver ``counts`` for an instrument that sends lines such as ``M 16204 -5013 49187``.

A driver is a parser: it takes bytes and returns readings. It never opens the port, so a test or a replay
can feed it recorded bytes.
"""

from __future__ import annotations

from math import inf
from typing import Annotated, ClassVar

import msgspec

from magbridge.records import Reading
from magbridge.sensors import Driver

__all__ = ["Counts", "CountsOptions"]

LONGEST = 64
"""Maximum number of bytes of a line."""


class CountsOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver in ``[sensor.options]``; ``magbridge drivers counts`` lists them."""

    nt_per_count: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    """Scale of all three channels, nT per count."""
    full_scale: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Absolute value at which a channel saturates, counts; 0 for a channel that never saturates."""


class Counts(Driver):
    """Parser of the instrument's lines; it accepts bytes in pieces of any length."""

    Options: ClassVar = CountsOptions

    def __init__(self, options: CountsOptions) -> None:
        self.nt_per_count = options.nt_per_count
        self._full_scale = options.full_scale or inf
        self.range_nt = self._full_scale * options.nt_per_count
        self._rest = b""
        self._skipped = self._bad = 0

    @property
    def bytes_skipped(self) -> int:
        """Number of bytes that were not part of a valid line."""
        return self._skipped

    @property
    def frames_bad(self) -> int:
        """Number of lines that could not be parsed as a reading."""
        return self._bad

    def start(self) -> tuple[bytes, ...]:
        """Discard a partial line and return the start commands, of which this instrument needs none."""
        self._rest = b""
        return ()

    def feed(self, data: bytes) -> list[Reading]:
        """Parse bytes in pieces of any length; return the readings of the lines that they complete."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        # Of noise without an end of a line, keep as much as shows that it is too long.
        self._skipped += len(self._rest[LONGEST + 1 :])
        self._rest = self._rest[: LONGEST + 1]
        return [reading for line in lines if (reading := self._reading(line))]

    def _reading(self, line: bytes) -> Reading | None:
        """Return the reading of a line, or count the line as bad and return None."""
        try:
            mark, x, y, z = line.split()
            counts = (int(x), int(y), int(z))
        except ValueError:
            mark = b""
        if mark != b"M" or len(line) > LONGEST:
            self._bad += 1
            self._skipped += len(line)
            return None
        scale = self.nt_per_count
        return Reading(
            (counts[0] * scale, counts[1] * scale, counts[2] * scale),
            counts,
            saturated=max(map(abs, counts)) >= self._full_scale,
        )
