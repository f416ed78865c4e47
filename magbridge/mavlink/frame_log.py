"""Every byte of a link as frames in a log, and back again.

A log must be readable by any MAVLink tool and still hold every byte received: frames are logged as they are,
bytes that belong to none are wrapped in MAG_LINK_BYTES. Where the parser needed bytes beyond the frame that
it returned, to see that something before it was not a frame, these bytes are logged as well, marked *ahead*:
with them, a replay's parser returns the same messages at the same time.
"""

from __future__ import annotations

from collections.abc import Iterable

from magbridge.mavlink.codec import Codec
from magbridge.mavlink.framing import message
from magbridge.mavlink.messages import BAD_DATA, Message, spec
from magbridge.mavlink.secrets import without_secrets

__all__ = ["FrameLogReader", "FrameLogWriter"]

WRAPPER = spec("MAG_LINK_BYTES")
WRAPPED_BYTES = WRAPPER.fields["data"].count


class FrameLogWriter:
    """Turns the messages that a codec returned into frames for the log."""

    def __init__(self, system: int, component: int) -> None:
        self._codec = Codec(system, component)

    def frames(self, messages: Iterable[Message], pending: bytes) -> list[bytes]:
        """Return the frames to log for one call of :meth:`Codec.parse`, and the bytes pending after it."""
        frames: list[bytes] = []
        in_doubt = False
        for one in messages:
            if one.id in (BAD_DATA, WRAPPER.id):
                frames += self._wrap(one.frame, sequence_offset=0)
            else:
                frames.append(one.frame)
            in_doubt |= one.id == BAD_DATA or not one.known
        return frames + self._wrap(pending, sequence_offset=1) if in_doubt else frames

    def _wrap(self, data: bytes, sequence_offset: int) -> list[bytes]:
        data = without_secrets(data)
        pieces = [data[i : i + WRAPPED_BYTES] for i in range(0, len(data), WRAPPED_BYTES)]
        return [
            self._codec.pack(WRAPPER.name, ahead=sequence_offset, length=len(piece), data=piece)
            for piece in pieces
        ]


class FrameLogReader:
    """The inverse of :class:`FrameLogWriter`: frames of a log to the bytes received at that moment."""

    def __init__(self) -> None:
        self._fed = 0  # bytes given out beyond the last record that was not ahead
        self._seen = 0  # bytes of records ahead since then

    def data(self, frame: bytes) -> bytes:
        """Return the bytes that `frame` adds to the stream."""
        one = message(frame)
        wrapped = one.id == WRAPPER.id
        data = one["data"][: one["length"]] if wrapped else frame
        if wrapped and one["ahead"]:
            new = data[max(self._fed - self._seen, 0) :]
            self._seen += len(data)
            self._fed = max(self._fed, self._seen)
        else:
            new = data[self._fed :]
            self._fed, self._seen = max(self._fed - len(data), 0), 0
        return new
