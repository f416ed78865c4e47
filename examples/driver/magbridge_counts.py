"""``counts``: an instrument that sends lines such as ``M 16204 -5013 49187``.

A driver is a parser: it takes bytes and returns readings. It never touches the port, so a test feeds it
bytes, and a replay feeds it those of a log.
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
    """Keys of ``[sensor.options]``; ``magbridge drivers counts`` shows them."""

    nt_per_count: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    """nT per count."""
    full_scale: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Counts at which a channel saturates; 0 where it does not."""


class Counts(Driver):
    """Parser of the lines; the bytes may come in any pieces."""

    Options: ClassVar = CountsOptions

    def __init__(self, options: CountsOptions) -> None:
        self.nt_per_count = options.nt_per_count
        self._full_scale = options.full_scale or inf
        self.range_nt = self._full_scale * options.nt_per_count
        self._rest = b""
        self._skipped = self._bad = 0

    @property
    def bytes_skipped(self) -> int:
        """Bytes that belonged to no line."""
        return self._skipped

    @property
    def frames_bad(self) -> int:
        """Lines that held no reading."""
        return self._bad

    def start(self) -> tuple[bytes, ...]:
        """Forget half a line of before; this instrument needs no command to begin."""
        self._rest = b""
        return ()

    def feed(self, data: bytes) -> list[Reading]:
        """Parse bytes in any pieces; return the readings that they complete."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST:  # noise without an end of a line
            self._skipped += len(self._rest)
            self._rest = b""
        return [reading for line in lines if (reading := self._reading(line))]

    def _reading(self, line: bytes) -> Reading | None:
        """Return the reading in a line, or count the line as bad."""
        try:
            mark, x, y, z = line.split()
            counts = (int(x), int(y), int(z))
        except ValueError:
            mark = b""
        if mark != b"M":
            self._bad += 1
            self._skipped += len(line)
            return None
        scale = self.nt_per_count
        return Reading(
            (counts[0] * scale, counts[1] * scale, counts[2] * scale),
            counts,
            saturated=max(map(abs, counts)) >= self._full_scale,
        )
