"""The timetable of a replay: which bytes came through the pty and the socket, and when.

The bytes themselves go through the pty and the socket, as real devices would send them. *When* they came
cannot: a pty keeps no time. So the times go separately, through a pipe, as the timetable: one entry per
event, which channel, how many bytes, at what time. The bridge under replay reads its ports in that order and
takes those times for its clock; everything behind its ports is the same code as at sea.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable, Iterator

from magbridge.bridge.events import Event
from magbridge.records import Channel

__all__ = ["Entry", "pace", "read_entries"]

Entry = struct.Struct("<QIB")
"""Stamp (µs, channel in the low two bits), number of bytes, sensor id; a ``STATE`` entry is followed by its
bytes."""


def read_entries(read: Callable[[], bytes]) -> Iterator[tuple[int, Channel, int, int, bytes]]:
    """Yield the entries: time in µs, channel, sensor id, number of bytes, and bytes of a ``STATE`` entry.

    `read` returns the next bytes of the timetable, and none at its end.
    """
    buffer = bytearray()
    channels = tuple(Channel)
    while True:
        position = 0
        while len(buffer) - position >= Entry.size:
            stamp, size, sensor_id = Entry.unpack_from(buffer, position)
            channel = channels[stamp & 3]
            inline = size if channel is Channel.STATE else 0
            if len(buffer) - position < Entry.size + inline:
                break
            position += Entry.size
            data = bytes(buffer[position : position + inline])
            position += inline
            yield stamp & ~3, channel, sensor_id, size, data
        del buffer[:position]
        chunk = read()
        if not chunk:
            return
        buffer += chunk


def pace(events: Iterable[Event], speed: float) -> Iterator[tuple[float, Event]]:
    """Yield how long to wait before each event, in s (negative: it is late), and the event.

    The events, in order of time, are played `speed` times faster than they happened; ``inf`` waits for
    nothing.
    """
    begun = time.monotonic()
    first_us: int | None = None
    for event in events:
        if first_us is None:
            first_us = event.time_us
        yield begun + (event.time_us - first_us) * 1e-6 / speed - time.monotonic(), event
