"""A port: read bytes and write messages without blocking; raise an error when it is lost.

A port that is gone raises :class:`PortError` once and is closed; :meth:`Port.open` may then be tried again.
Writing never blocks: what a slow reader does not take waits while it is new, then is dropped and counted.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from magbridge.bridge.peers import Peers
from magbridge.errors import PortError
from magbridge.link.message_rates import LIMITS
from magbridge.mavlink import spec
from magbridge.mavlink.framing import SIGNATURE, V2, is_signed

__all__ = ["MAX_WAITING_MESSAGES", "MAX_WAIT_S", "READ_BYTES", "PacedPort", "Port", "cut"]

READ_BYTES = 65536
"""Bytes read at once."""
MAX_WAIT_S = 0.1
"""s after which a message that waits is dropped, if a newer one of its kind waits as well."""
MAX_WAITING_MESSAGES = 512
"""Messages that may wait."""
RENEWED = {spec(name).id for name in LIMITS}
"""Messages that are sent again and again: a newer one makes an older one worthless."""
NAMED, NAME = spec("NAMED_VALUE_FLOAT").id, 8
"""Message in which each name is a kind of its own, and the offset of the name in its payload."""
HEADER, CHECKSUM = 10, 2
"""Bytes of a frame before its payload, and after it."""


class Port(ABC):
    """Interface of a port."""

    def __init__(self, name: str, peers: Peers | None = None) -> None:
        self.name = name
        self._peers = peers
        self.dropped = 0
        """Bytes that could not be written."""
        self.overrun = 0
        """Number of the `dropped` bytes that an open port could not buffer, because it is too slow."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Return True if bytes can be read and written."""

    @abstractmethod
    def open(self) -> None:
        """Open it; raises :class:`PortError`."""

    def tend(self) -> None:  # noqa: B027 - most ports need nothing
        """Do periodic slow work while the port is open; called by the thread that opens it."""

    @abstractmethod
    def fds(self) -> list[int]:
        """Return the file descriptors to wait for."""

    @abstractmethod
    def read(self) -> bytes:
        """Return the received bytes, when a descriptor is ready; raises :class:`PortError` for a lost port.

        A serial line that is ready and yet has nothing is one that hung up, so do not ask when none is ready.
        """

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send each message in `data` whole or drop it; raises :class:`PortError` when the port is gone."""

    def write_to(self, sender: tuple[int, int], data: bytes) -> None:  # noqa: ARG002 - most ports have one peer
        """Send as :meth:`write` does, only to the peer from which a system and component was last heard."""
        self.write(data)

    @property
    def waiting(self) -> bool:
        """Return True if bytes wait that a slow line could not buffer."""
        return False

    def flush(self) -> None:  # noqa: B027 - most ports keep nothing
        """Continue to send the waiting bytes; raises :class:`PortError` when the port is gone."""

    def blocked(self) -> list[int]:
        """Return the file descriptors that accept more of the waiting bytes once they are writable."""
        return []

    def credit(self, frames: Iterable[bytes]) -> None:
        """Accept the peers that sent these frames as receivers: the frames are signed with the key."""
        if self._peers is not None:
            self._peers.credit(frames)

    def notice(self) -> str:
        """Return a new notice about the peers; empty without one."""
        return self._peers.notices.popleft() if self._peers is not None and self._peers.notices else ""

    def write_all(self, data: bytes) -> None:
        """Send `data` whole, waiting for a slow reader; for a replay, which has no deadline."""
        self.write(data)

    @abstractmethod
    def close(self) -> None:
        """Close the port; no effect on a closed port."""

    def overran(self, data: bytes) -> None:
        """Count `data` as dropped because the line is too slow."""
        self.dropped += len(data)
        self.overrun += len(data)

    def lost(self, reason: object) -> PortError:
        """Close the port and return the error to raise."""
        self.close()
        return PortError(self.name, str(reason))


class PacedPort(Port):
    """A port whose line may be slower than the data to send.

    What the line has no room for waits here, where it can still be dropped, and not in the system's buffers,
    which would send it seconds late. The order is kept, since signatures and sequence numbers depend on it.

    Parameters
    ----------
    name : str
    piece : int
        Bytes that are handed to the system at once, and what completes a message.
    share : int
        Bytes that are read at once.
    ended : str
        Reason of the :class:`PortError` at an end of file.
    """

    def __init__(self, name: str, piece: int, share: int, ended: str) -> None:
        super().__init__(name)
        self._piece, self._share, self._ended = piece, share, ended
        self._fd = -1  # set last when the port opens, which another thread may do
        self._waiting: deque[_Waiting] = deque()
        self._begun = bytearray()

    @property
    def is_open(self) -> bool:
        """Return True if there is a descriptor."""
        return self._fd >= 0

    def fds(self) -> list[int]:
        """Return the one descriptor, if open."""
        return [self._fd] if self._fd >= 0 else []

    def read(self) -> bytes:
        """Return the received bytes; an end of file or an error is a lost port."""
        try:
            data = os.read(self._fd, self._share)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self.lost(error.strerror) from error
        if not data:
            raise self.lost(self._ended)
        return data

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
        """Return True if a message, or the rest of one, waits."""
        return bool(self._begun or self._waiting)

    def flush(self) -> None:
        """Send as much pending data as the line accepts."""
        while self.waiting and self._room():
            if not self._begun:
                self._begin()
            del self._begun[: self._put(self._begun)]

    def blocked(self) -> list[int]:
        """Return the descriptor that takes more once it is writable."""
        return self.fds()

    @abstractmethod
    def _room(self) -> bool:
        """Return True if bytes handed to the system now leave soon."""

    def _put(self, data: bytes | bytearray) -> int:
        """Write `data`; return the number of bytes written. Raises :class:`PortError`."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self.lost(error.strerror) from error

    def _forget(self) -> None:
        """Discard the pending data of a lost line."""
        self._waiting.clear()
        self._begun.clear()

    def _begin(self) -> None:
        """Start to send the next piece of the waiting bytes."""
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
    """Return the key of messages that supersede each other; None for a message that must be sent."""
    number = int.from_bytes(frame[7:10], "little")
    if frame[0] != V2 or number not in RENEWED:
        return None
    return frame[7:10] + (frame[HEADER + NAME : HEADER + frame[1]] if number == NAMED else b"")
