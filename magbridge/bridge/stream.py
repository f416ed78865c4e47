"""What is sent on a line that carries only so much: whole messages, and none that is old."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from magbridge.bridge.port import Port
from magbridge.link.message_rates import LIMITS
from magbridge.mavlink import spec
from magbridge.mavlink.framing import SIGNATURE, V2, is_signed

__all__ = ["MAX_WAITING_MESSAGES", "MAX_WAIT_S", "PacedPort", "cut"]

MAX_WAIT_S = 0.1
"""s after which a message that waits is dropped, if a newer one of its kind waits as well."""
MAX_WAITING_MESSAGES = 512
"""Messages that may wait."""
RENEWED = {spec(name).id for name in LIMITS}
"""Messages that are sent again and again: a newer one makes an older one worthless."""
NAMED, NAME = spec("NAMED_VALUE_FLOAT").id, 8
"""The one of them of which each name is a kind of its own, and where in its payload the name begins."""
HEADER, CHECKSUM = 10, 2
"""Bytes of a frame before its payload, and after it."""


class PacedPort(Port):
    """A port whose line may carry less than is to be sent.

    What the line has no room for waits here, where it can still be dropped, and not in the system's buffers,
    which would send it seconds late. The order is kept, since signatures and sequence numbers depend on it.

    Parameters
    ----------
    name : str
    piece : int
        Bytes that are handed to the system at once, and what completes a message.
    """

    def __init__(self, name: str, piece: int) -> None:
        super().__init__(name)
        self._piece = piece
        self._waiting: deque[_Waiting] = deque()
        self._begun = bytearray()

    def write(self, data: bytes) -> None:
        """Send messages, each whole or not at all; the others wait until the line takes them."""
        free = not self.waiting and len(data) <= self._piece
        if free and self._room():  # as on most lines at most times: nothing need be cut into messages
            self._begun += data[self._put(data) :]
            return
        now = time.monotonic()
        self._waiting.extend(_Waiting(now, _kind(frame), frame) for frame in cut(data))
        self.flush()
        if len(self._waiting) > MAX_WAITING_MESSAGES:
            self._thin(now)
            while len(self._waiting) > MAX_WAITING_MESSAGES // 2:
                self.overran(self._waiting.popleft().frame)

    @property
    def waiting(self) -> bool:
        """Whether a message, or the rest of one, waits for room."""
        return bool(self._begun or self._waiting)

    def flush(self) -> None:
        """Send of what waits as much as there is room for."""
        while self.waiting and self._room():
            if not self._begun:
                self._begin()
            del self._begun[: self._put(self._begun)]

    def blocked(self) -> list[int]:
        """Return the descriptor that takes more once it is writable."""
        return self.fds()[-1:]

    @abstractmethod
    def _room(self) -> bool:
        """Say whether what is handed to the system now leaves soon."""

    @abstractmethod
    def _put(self, data: bytes | bytearray) -> int:
        """Hand `data` to the system; return how many bytes it took. Raises :class:`PortError`."""

    def _forget(self) -> None:
        """Forget what waits: the line is gone."""
        self._waiting.clear()
        self._begun.clear()

    def _begin(self) -> None:
        """Take the next piece of what waits."""
        late = time.monotonic() - MAX_WAIT_S
        if self._waiting[0].since < late:
            self._thin(late)
        while self._waiting and len(self._begun) < self._piece:
            self._begun += self._waiting.popleft().frame

    def _thin(self, late: float) -> None:
        """Drop the messages from before `late` of which a newer one waits."""
        newer: set[bytes] = set()
        kept: deque[_Waiting] = deque()
        for one in reversed(self._waiting):
            if one.kind in newer and one.since < late:
                self.overran(one.frame)
                continue
            kept.appendleft(one)
            if one.kind is not None:
                newer.add(one.kind)
        self._waiting = kept


class _Waiting(NamedTuple):
    """A message: since when it waits (s, monotonic), the kind of which only the newest counts, its bytes."""

    since: float
    kind: bytes | None
    frame: bytes


def cut(data: bytes) -> Iterator[bytes]:
    """Cut `data` into MAVLink frames; a command to a sensor stays in one piece."""
    while data:
        size = len(data)
        if data[0] == V2 and size > HEADER:
            size = HEADER + data[1] + CHECKSUM + (SIGNATURE if is_signed(data) else 0)
        yield data[:size]
        data = data[size:]


def _kind(frame: bytes) -> bytes | None:
    """Return what the messages share that supersede each other; None where each of them counts."""
    number = int.from_bytes(frame[7:10], "little")
    if frame[0] != V2 or number not in RENEWED:
        return None
    return frame[7:10] + (frame[HEADER + NAME : HEADER + frame[1]] if number == NAMED else b"")
