"""What the bridge needs of a port: bytes in and out, never blocking, and a clear error when it is gone.

A port that is gone raises :class:`PortError` once and is closed; :meth:`Port.open` may then be tried again.
Writing never blocks: what a slow reader does not take waits while it is new, then is dropped and counted.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

from magbridge.errors import PortError

__all__ = ["CHUNK", "Port"]

CHUNK = 65536
"""Bytes read at once."""


class Port(ABC):
    """What the bridge needs of a port."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.dropped = 0
        """Bytes that could not be written."""
        self.overrun = 0
        """Those of the `dropped` bytes for which an open port had no room, because it is too slow."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether bytes can come and go."""

    @abstractmethod
    def open(self) -> None:
        """Open it; raises :class:`PortError`."""

    def tend(self) -> None:  # noqa: B027 - most ports need nothing
        """Do now and then, while it is open, what may take long; called by the thread that opens it."""

    @abstractmethod
    def fds(self) -> list[int]:
        """Return the file descriptors to wait for."""

    @abstractmethod
    def read(self) -> bytes:
        """Return what has come, when a descriptor is ready; raises :class:`PortError` when the port is gone.

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
        """Whether something waits that a slow line had no room for."""
        return False

    def flush(self) -> None:  # noqa: B027 - most ports keep nothing
        """Go on sending what is waiting; raises :class:`PortError` when the port is gone."""

    def blocked(self) -> list[int]:
        """Return the file descriptors that take more of what is waiting once they are writable."""
        return []

    def credit(self, frames: Iterable[bytes]) -> None:  # noqa: B027 - most ports have one peer
        """Learn which frames that were read last are signed by someone who has the key."""

    def notice(self) -> str:
        """Return something to tell about the peers, once; empty where there is nothing."""
        return ""

    def write_all(self, data: bytes) -> None:
        """Send `data` whole, waiting for a slow reader; for a replay, which has no deadline."""
        self.write(data)

    @abstractmethod
    def close(self) -> None:
        """Close it; harmless when it is closed."""

    def overran(self, data: bytes) -> None:
        """Count `data` as dropped because the line is too slow."""
        self.dropped += len(data)
        self.overrun += len(data)

    def lost(self, reason: object) -> PortError:
        """Close the port and return the error to raise."""
        self.close()
        return PortError(self.name, str(reason))
