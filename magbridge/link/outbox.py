"""What is to be sent, with the event time that it belongs to."""

from __future__ import annotations

from typing import Any

from magbridge.mavlink import Codec, Spec

__all__ = ["Outbox"]


class Outbox:
    """Packs and queues what the services send; the bridge drains it.

    Attributes
    ----------
    codec : Codec
        Its ``now_us`` is the event time that the next frame gets.
    frames : list of (int, bytes)
        Event time in µs, frame; in the order in which to send.
    """

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self.frames: list[tuple[int, bytes]] = []

    def send(self, _name: str, **fields: Any) -> None:
        """Pack a message by name; fields not named are zero."""
        self.frames.append((self.codec.now_us, self.codec.pack(_name, **fields)))

    def put(self, layout: Spec, payload: bytes) -> None:
        """Send a packed payload (``layout.struct.pack(...)``): the cheapest way."""
        self.frames.append((self.codec.now_us, self.codec.frame(layout, payload)))

    def drain(self) -> list[tuple[int, bytes]]:
        """Return and clear the frames."""
        frames, self.frames = self.frames, []
        return frames
