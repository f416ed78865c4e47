"""Encode and decode MAVLink by the classes that pymavlink generates: the floor of the benchmarks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20.all import MAVLink

from magbridge.mavlink.messages import MESSAGES, spec  # adds the project's messages to pymavlink's decoder


class Peer:
    """pymavlink's codec, which decodes the bridge's input and encodes its output."""

    def __init__(self) -> None:
        self._in = MAVLink(None)
        self._in.robust_parsing = True
        self._out = MAVLink(None, srcSystem=1, srcComponent=191)

    def decode(self, pieces: Iterable[bytes]) -> int:
        """Decode bytes in pieces; return the number of messages."""
        return sum(len(self._in.parse_buffer(piece) or ()) for piece in pieces)

    def arguments(self, published: bytes) -> list[tuple[type, tuple[Any, ...]]]:
        """Return class and arguments of each message of a stream, for :meth:`encode`."""
        messages = MAVLink(None).parse_buffer(published) or []
        return [(type(one), tuple(self._argument(one, name) for name in one.fieldnames)) for one in messages]

    def sensor_bytes(self, data: bytes) -> tuple[type, tuple[Any, ...]]:
        """Return class and arguments of the log's message that stores the bytes of a sensor."""
        return MESSAGES[spec("MAG_SENSOR_BYTES").id], (0, len(data), list(data.ljust(253, b"\0")))

    @staticmethod
    def _argument(message: Any, name: str) -> Any:
        value = getattr(message, name)
        return value.encode() if isinstance(value, str) else value

    def encode(self, messages: Iterable[tuple[type, tuple[Any, ...]]]) -> int:
        """Construct and pack messages; return the number of bytes."""
        out = self._out
        return sum(len(kind(*arguments).pack(out)) for kind, arguments in messages)
