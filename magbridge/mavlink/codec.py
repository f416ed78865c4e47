"""Bytes to messages and back, for one link: pymavlink's codec without port, clock and global state."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from magbridge.mavlink import dialect
from magbridge.mavlink.framing import (
    NEEDS_MORE,
    SECRET,
    find_magic,
    frame_end,
    message,
    without_secret,
    without_secrets,
)
from magbridge.mavlink.messages import BAD_DATA, REFUSED, Message, Spec, spec
from magbridge.mavlink.signing import Signing

__all__ = ["MAX_PENDING_BYTES", "Codec", "FrameLogReader", "FrameLogWriter"]

MAX_PENDING_BYTES: Final = 4096
"""Most bytes that are kept without a whole frame; then they are skipped, even if a frame may have begun in
them, so that memory stays bounded."""


class Codec:
    """MAVLink for one link, without global state, clock or port.

    Parameters
    ----------
    system, component : int
        Our own, in what we send.
    signing : Signing or None
        With it, every frame sent is signed, and frames without a valid signature are refused.

    Attributes
    ----------
    now_us, utc_offset_us : int
        Event time, which the caller sets before it parses or sends, and its offset to UNIX time: the change
        of the host's clock since the start.
    frames, bytes_skipped : int
        Messages accepted, bytes that belonged to no frame.
    """

    def __init__(self, system: int, component: int, signing: Signing | None = None) -> None:
        self.system, self.component = system, component
        self.signing = signing
        self.now_us = self.utc_offset_us = 0
        self._mav = dialect.MAVLink(None, system, component)
        if signing is not None:
            self._mav.signing = signing
        self._packers: dict[int, Any] = {}
        self.frames = self.bytes_skipped = 0
        self._rest = b""
        self._looked = 0

    @property
    def sequence(self) -> int:
        """Sequence number of the next frame."""
        number: int = self._mav.seq
        return number

    @sequence.setter
    def sequence(self, number: int) -> None:
        self._mav.seq = number

    @property
    def utc_us(self) -> int:
        """UNIX time, for signatures and in messages."""
        return self.now_us + self.utc_offset_us

    @property
    def pending(self) -> bytes:
        """Bytes that came but are not yet in any message."""
        return self._rest

    def parse(self, data: bytes, *, final: bool = False) -> list[Message]:
        """Process bytes as they come; return the messages that are complete with them.

        Any bytes, however cut, give the same messages. Bytes that belong to no frame come back as a
        message of id `BAD_DATA` just before the message that ended them (or every `WINDOW` bytes), so
        that a log which keeps every ``frame`` keeps every byte. A frame whose signature is not accepted
        has the id `REFUSED`, as has one that carries a secret, which is not kept.

        Parameters
        ----------
        data : bytes
            As they came.
        final : bool
            No frame continues in the next bytes: remaining bytes belong to none.
        """
        data = self._rest + data
        found: list[Message] = []
        begin, at = 0, self._looked  # begin: end of the last frame; at: no frame begins before
        while begin < len(data):
            stop = min(len(data), begin + MAX_PENDING_BYTES)
            start = find_magic(data, at, stop)
            last = final and stop == len(data)
            end = frame_end(data, start, stop, last=last) if start < stop else NEEDS_MORE
            if end > 0:
                if begin < start:
                    found.append(self._skip(data[begin:start]))
                found.append(self._accept(message(data[start:end])))
                begin = at = end
            elif end != NEEDS_MORE or (last and start < stop):
                at = start + 1
            elif stop == begin + MAX_PENDING_BYTES or last:
                found.append(self._skip(data[begin:stop]))
                begin = at = stop
            else:
                at = start
                break
        self._rest, self._looked = data[begin:], at - begin
        return found

    def pack(self, _name: str, **fields: Any) -> bytes:
        """Return the frame of a message; fields not named are zero."""
        layout = spec(_name)
        return self.frame(layout, layout.payload(**fields))

    def frame(self, layout: Spec, payload: bytes) -> bytes:
        """Return the frame of a packed payload (``layout.struct.pack(...)``): the cheapest way to send."""
        if self.signing is not None:
            self.signing.set_clock(self.utc_us)
        packer = self._packers.get(layout.id)
        if packer is None:
            packer = self._packers[layout.id] = dialect.MAVLink_message(layout.id, layout.name)
        frame: bytes = packer._pack(self._mav, layout.extra, payload)  # noqa: SLF001 - pymavlink's own packer
        self._mav.seq = self._mav.seq + 1 & 0xFF
        return frame

    def _skip(self, data: bytes) -> Message:
        self.bytes_skipped += len(data)
        return Message(BAD_DATA, 0, 0, 0, b"", data, known=False)

    def skip(self, count: int) -> None:
        """Go on as if `count` frames had been sent: a replay does not have these frames."""
        self._mav.seq = self._mav.seq + count & 0xFF
        if self.signing:
            self.signing.skip(count, self.utc_us)

    def _accept(self, message: Message) -> Message:
        if message.id in SECRET:
            frame = without_secret(message.frame)
            return Message(
                REFUSED, message.system, message.component, message.sequence, b"", frame, known=False
            )
        if self.signing and not self.signing.accept(
            message.frame, (message.system, message.component), message.id, self.utc_us
        ):
            return Message(
                REFUSED, message.system, message.component, message.sequence, b"", message.frame, known=False
            )
        self.frames += 1
        return message


WRAPPER = spec("MAG_LINK_BYTES")
WRAPPED_BYTES = WRAPPER.fields["data"].count


class FrameLogWriter:
    """Turn the messages that a codec returned into frames for the log.

    A log must be readable by any MAVLink tool and still hold every byte received. Frames are logged as they
    are; bytes that belong to none are wrapped in MAG_LINK_BYTES. Where the parser needed bytes beyond the
    frame that it returned, these bytes are logged as well, marked *ahead*: with them, the parser of a replay
    returns the same messages at the same time.
    """

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
    """Turn frames of a log into the bytes that were received, the inverse of :class:`FrameLogWriter`."""

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
