"""Ground station on its own UDP socket, which also requests files."""

from __future__ import annotations

import time
from contextlib import suppress

from devices import udp_socket

from magbridge.link.files import FTP_HEADER
from magbridge.mavlink import Codec, Message, Signing

__all__ = ["Ear", "ftp"]


def ftp(opcode: int, data: bytes, sequence: int, size: int = 0, offset: int = 0) -> dict[str, object]:
    """Return the fields of an FTP request to the bridge."""
    header = FTP_HEADER.pack(sequence, 0, opcode, size or len(data), 0, 0, offset)
    return {"target_system": 1, "target_component": 191, "payload": (header + data).ljust(251, b"\0")}


class Ear:
    """Ground station that stores what it receives; it sends to `peer`, or to the latest sender."""

    def __init__(self, system: int, key: bytes | None = None, peer: tuple[str, int] | None = None) -> None:
        self.codec, self.ear = Codec(system, 190, Signing(key) if key else None), Codec(0, 0)
        self.line, self.peer = udp_socket(0.0), peer
        self.received: list[Message] = []

    def send_message(self, name: str, **fields: object) -> None:
        """Send a message, if the peer is known."""
        self.codec.now_us = time.time_ns() // 1000
        if self.peer is not None:
            self.line.sendto(self.codec.pack(name, **fields), self.peer)

    def of(self, name: str, mark: int = 0) -> list[Message]:
        """Receive what has arrived; return the messages `name` received since `mark`."""
        with suppress(BlockingIOError):
            while True:
                data, self.peer = self.line.recvfrom(65536)
                self.received += self.ear.parse(data)
        return [one for one in self.received[mark:] if one.name == name]
