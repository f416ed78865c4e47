"""Bytes to messages and back, for one link, with signatures: without port, clock and global state.

Notes
-----
The signature is a link id, a time stamp ``t`` (48 bit, units of 10 µs since 2015-01-01) and the first 6 bytes
of ``SHA-256(key + frame + link id + t)`` (MAVLink guide, 'Message Signing').

Each stream (system, component, link id) has floors of its own, and a stamp must lie above its floor: one for
stamps that are at most a minute ahead of our clock, and one for stamps further ahead. So a clock that was
wrong, its owner's or ours, refuses nothing once it is right again, and neither a key holder that lies about
the time nor a restart of ours refuses other senders. A stamp counts only once its hash has proved right:
otherwise one forged packet from the future would lock out every genuine one that follows, as it does in
pymavlink 2.4.50.

The guide lets every stamp received raise our own. Here only the autopilot's do, which a computer without a
clock of its own needs, and no further than `FOLLOW` ahead of a clock that has been set.
"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20.all import MAVLink, MAVLink_message, MAVLinkSigning

from magbridge.errors import FormatError
from magbridge.files import contents
from magbridge.mavlink.messages import (
    BAD_DATA,
    NEEDS_MORE,
    REFUSED,
    SECRET,
    Message,
    Spec,
    find_magic,
    frame_end,
    is_signed,
    message,
    spec,
    without_secret,
    without_secrets,
)

__all__ = [
    "NOT_SIGNED", "Codec", "FrameLogReader", "FrameLogWriter", "Signing", "Stream", "load_key",
    "readable_by_all",
]  # fmt: skip

EPOCH_US = 1_420_070_400_000_000
"""2015-01-01 in µs of UNIX time."""
STAMPS_PER_SECOND = 100_000
"""in units of 10 µs"""
MINUTE = 60 * STAMPS_PER_SECOND
FOLLOW = 7 * 24 * 60 * MINUTE
"""How far ahead of our clock the autopilot's stamps may take ours."""
SET = (1_672_531_200_000_000 - EPOCH_US) // 10
"""2023-01-01: a clock that shows less was never set."""
MAX_STAMP = (1 << 48) - 1
STREAMS = 1024
"""Most floors that are kept; of more, those of the streams heard first are forgotten."""
NOT_SIGNED = "not signed"
"""Reason for the refusal of a frame without a signature."""
FOLLOW_UNSET = 10 * 365 * 24 * 60 * MINUTE
"""How far the autopilot's stamps may take ours in a run that has no stamp of an earlier run."""
NEED_NO_SIGNATURE = frozenset({109})
"""RADIO_STATUS: radios put it on the link, and they have no key."""

Stream = tuple[int, int, int, bool, int]
"""Link id, system, component, whether the stamps were ahead of our clock, and the last stamp accepted."""


def timestamp(t_us: int) -> int:
    """Return the signing time stamp of a UNIX time in µs."""
    return min(max(t_us - EPOCH_US, 0) // 10, MAX_STAMP)


def load_key(path: str | Path) -> bytes:
    """Read a signing key: a file of 32 bytes.

    FormatError: the file cannot be read or has another length.
    """
    key = contents(path)
    if len(key) != 32:
        raise FormatError(path, f"expected a signing key of 32 bytes, not {len(key)}")
    return key


def readable_by_all(path: str | Path) -> bool:
    """Return True if every user of this computer may read the key; raises OSError if the file is missing."""
    return bool(Path(path).stat().st_mode & 0o004)


class Signing(MAVLinkSigning):  # type: ignore[misc] # it has no annotations
    """State of signing: pymavlink signs with it; it verifies, in event time.

    The verification replaces pymavlink's ``check_signature``, which stores a stamp before it has verified the
    hash (ArduPilot/pymavlink#961).

    Parameters
    ----------
    key : bytes
        32 bytes.
    last : int
        The last time stamp that the run before may have used, so that ours increase even if the clock was
        set back.
    streams : iterable of Stream
        The floors of the run before, as `streams` gave them.
    follow : (int, int) or None
        System and component whose stamps raise ours: the autopilot's.

    Attributes
    ----------
    last : int
        The last time stamp used in what we sent.
    followed_days : float
        By how many days the autopilot's last stamp was ahead of our clock.
    refused : int
        Frames that were unsigned, wrongly signed or old.
    refusals : dict of str to tuple of 2 int
        Why frames were refused, and the first system and component whose frame was refused for that.
    """

    def __init__(
        self, key: bytes, last: int = 0, streams: Iterable[Stream] = (), follow: tuple[int, int] | None = None
    ) -> None:
        super().__init__()
        self.secret_key, self.sign_outgoing, self._key, self._follow = key, True, key, follow
        self.last = last
        self.followed_days = 0.0
        self._follow_limit = FOLLOW if last else FOLLOW_UNSET
        self.refused = 0
        self.refusals: dict[str, tuple[int, int]] = {}
        self._floors = {(link, system, sender, ahead): s for link, system, sender, ahead, s in streams}

    @property
    def streams(self) -> list[Stream]:
        """The floors, to be kept for the next run."""
        return [(*key, stamp) for key, stamp in self._floors.items()]

    def set_clock(self, t_us: int) -> None:
        """Choose the stamp of the next frame that pymavlink signs, at the UNIX time `t_us` (µs)."""
        self.last = self.timestamp = min(max(self.last + 1, timestamp(t_us)), MAX_STAMP)

    def skip(self, count: int, t_us: int) -> None:
        """Use up the stamps that signing `count` frames would: a replay does not have these frames."""
        self.last = min(max(self.last + 1, timestamp(t_us)) + count - 1, MAX_STAMP)

    def reserved(self, t_us: int, margin: int) -> int:
        """Return a stamp below which all stay that are used within the next `margin` (units of 10 µs).

        Stamps follow the clock, and count up by one a frame while they are ahead of it. The next run begins
        here if this one does not end in good order; it would drift ahead of the clock, restart by restart,
        if `margin` were simply added to the last stamp.
        """
        return min(max(self.last + STAMPS_PER_SECOND, timestamp(t_us) + margin), MAX_STAMP)

    def accept(self, frame: bytes, stream: tuple[int, int], number: int, t_us: int) -> bool:
        """Return True if a frame of the `stream` (system, component) is genuine and new."""
        why = "" if number in NEED_NO_SIGNATURE else NOT_SIGNED
        if is_signed(frame):
            why = self._doubt(frame, stream, t_us)
        if why:
            self.refused += 1
            self.refusals.setdefault(why, stream)
        return not why

    def _doubt(self, frame: bytes, stream: tuple[int, int], t_us: int) -> str:
        """Return the fault of a signature; empty where it is genuine and new."""
        if sha256(self._key + frame[:-6]).digest()[:6] != frame[-6:]:
            return "signed with another key"
        stamp, now = int.from_bytes(frame[-12:-6], "little"), timestamp(t_us)
        key = frame[-13], stream[0], stream[1], stamp > now + MINUTE
        floor = self._floors.get(key)
        if floor is None and stamp <= now - MINUTE:  # it may be a recording that is sent again
            return "a time stamp behind our clock"
        if floor is not None and stamp <= floor:
            return "an old time stamp"
        self._floors[key] = stamp
        if len(self._floors) > STREAMS:
            del self._floors[next(iter(self._floors))]
        if stream == self._follow and stamp < (now + self._follow_limit if now > SET else MAX_STAMP // 2):
            self.last = max(self.last, stamp)
            self.followed_days = max(0.0, (stamp - now) / (24 * 60 * MINUTE))
        return ""


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
        self._mav = MAVLink(None, system, component)
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
            packer = self._packers[layout.id] = MAVLink_message(layout.id, layout.name)
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
