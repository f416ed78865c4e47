"""Conversion between bytes and messages of one link, with signatures.

Notes
-----
The signature is a link id, a time stamp ``t`` (48 bit, units of 10 µs since 2015-01-01) and the first 6 bytes
of ``SHA-256(key + frame + link id + t)`` (MAVLink guide, 'Message Signing').

A time stamp must be later than the last accepted stamp of its stream (system, component, link id). Two last
stamps are stored for each stream: one for stamps at most a minute ahead of our clock, and one for later
stamps. So, once a wrong clock is corrected, stamps of the correct time are accepted again. A stamp is stored
only if its hash is correct. Otherwise one forged packet with a future stamp would block every later genuine
packet, as in pymavlink 2.4.50.

According to the guide, every received stamp advances the receiver's own. Here only the autopilot's stamps do,
which a computer without a battery-backed clock needs. They advance it by at most `FOLLOW` beyond a clock that
has been set.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20.all import MAVLink, MAVLink_message, MAVLinkSigning, x25crc

from magbridge.errors import FormatError
from magbridge.files import contents
from magbridge.mavlink.messages import (
    BAD_DATA,
    NEEDS_MORE,
    REFUSED,
    SECRET,
    SIGNED,
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
"""Origin of time stamps, 2015-01-01, in µs of UNIX time."""
STAMPS_PER_SECOND = 100_000
"""Time stamps count units of 10 µs."""
MINUTE = 60 * STAMPS_PER_SECOND
FOLLOW = 7 * 24 * 60 * MINUTE
"""Largest lead over our clock to which the autopilot's stamps advance ours, in units of 10 µs."""
SET = (1_672_531_200_000_000 - EPOCH_US) // 10
"""Time stamp of 2023-01-01; a clock that shows an earlier time was never set."""
MAX_STAMP = (1 << 48) - 1
STREAMS = 1024
"""Most streams whose last stamp is stored; a further stream displaces the oldest."""
NOT_SIGNED = "not signed"
"""Reason for the rejection of a frame without a signature."""
FOLLOW_UNSET = 10 * 365 * 24 * 60 * MINUTE
"""Limit in place of `FOLLOW` if no earlier run has stored a stamp, in units of 10 µs."""
NEED_NO_SIGNATURE = frozenset({109})
"""Ids of messages accepted without signature: RADIO_STATUS, which radios without a key send."""

Stream = tuple[int, int, int, bool, int]
"""Link id, system, component, True for stamps over a minute ahead of our clock, and last accepted stamp."""


def timestamp(t_us: int) -> int:
    """Return a UNIX time (µs) as a signing time stamp."""
    return min(max(t_us - EPOCH_US, 0) // 10, MAX_STAMP)


def load_key(path: str | Path) -> bytes:
    """Return the signing key in a file of 32 bytes.

    FormatError: the file cannot be read or has another length.
    """
    key = contents(path)
    if len(key) != 32:
        raise FormatError(path, f"expected a signing key of 32 bytes, not {len(key)}")
    return key


def readable_by_all(path: str | Path) -> bool:
    """Return True if every user of this computer may read the file; raise OSError if it does not exist."""
    return bool(Path(path).stat().st_mode & 0o004)


class Signing(MAVLinkSigning):  # type: ignore[misc] # it has no annotations
    """State of signing, with which pymavlink signs sent frames, and which verifies received frames.

    The verification replaces pymavlink's ``check_signature``, which stores a stamp before it has verified the
    hash (ArduPilot/pymavlink#961).

    `key`: key of 32 bytes.
    `streams`: last accepted stamps of the previous run, from the property `streams`.
    `follow`: system and component of the autopilot, whose stamps advance ours.
    `last`: last time stamp of a sent frame, or a later accepted stamp of the autopilot; first the stamp
        that the previous run may have used, so that stamps increase even if the clock was set back.
    `followed_days`: lead of the autopilot's last stamp over our clock, days.
    `refused`: number of frames rejected because they were unsigned, wrongly signed or old.
    `refusals`: reason of a rejection -> system and component of the first frame rejected for it.
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
        """Last accepted stamp of each stream, for storage until the next run."""
        return [(*key, stamp) for key, stamp in self._floors.items()]

    def set_clock(self, t_us: int) -> None:
        """Set the stamp of the next frame that pymavlink signs, at the UNIX time `t_us` (µs)."""
        self.last = self.timestamp = min(max(self.last + 1, timestamp(t_us)), MAX_STAMP)

    def skip(self, count: int, t_us: int) -> None:
        """Advance the stamp as if `count` frames were signed at `t_us` (µs), for a replay without them."""
        self.last = min(max(self.last + 1, timestamp(t_us)) + count - 1, MAX_STAMP)

    def reserved(self, t_us: int, margin: int) -> int:
        """Return an upper limit of the stamps that are used within the next `margin` (units of 10 µs).

        The next run begins at this limit if the present run ends without saving its last stamp. Stamps follow
        the clock, and increase by one per frame while they are ahead of it. A limit of the last stamp plus
        `margin` would move further ahead of the clock with every restart.
        """
        return min(max(self.last + STAMPS_PER_SECOND, timestamp(t_us) + margin), MAX_STAMP)

    def accept(self, frame: bytes, stream: tuple[int, int], number: int, t_us: int) -> bool:
        """Return True if a frame is correctly signed and new, or needs no signature; count a rejection.

        `stream`: system and component of the sender. `number`: message id. `t_us`: UNIX time, µs.
        """
        why = "" if number in NEED_NO_SIGNATURE else NOT_SIGNED
        if is_signed(frame):
            why = self._doubt(frame, stream, t_us)
        if why:
            self.refused += 1
            self.refusals.setdefault(why, stream)
        return not why

    def _doubt(self, frame: bytes, stream: tuple[int, int], t_us: int) -> str:
        """Return the fault of a frame's signature, empty for a correct and new one; store its time stamp."""
        if sha256(self._key + frame[:-6]).digest()[:6] != frame[-6:]:
            return "signed with another key"
        stamp, now = int.from_bytes(frame[-12:-6], "little"), timestamp(t_us)
        key = frame[-13], stream[0], stream[1], stamp > now + MINUTE
        floor = self._floors.get(key)
        if floor is None and stamp <= now - MINUTE:  # may be a replayed recording
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


class Packer(MAVLink_message):  # type: ignore[misc] # it has no annotations
    """Packer of the frames of one message type.

    The method replaces pymavlink's, which makes two header objects and two checksums for each frame; that is
    half of its time. The frames are equal: the header is pymavlink's with the length and sequence number of
    each frame.
    """

    def __init__(self, layout: Spec, mav: MAVLink) -> None:
        super().__init__(layout.id, layout.name)
        self._extra = bytes((layout.extra,))
        self._signs = mav.signing.sign_outgoing
        header = self._header
        header.srcSystem, header.srcComponent = mav.srcSystem, mav.srcComponent
        header.incompat_flags = SIGNED if self._signs else 0
        self._begin = bytearray(header.pack())
        self._checksum, self._initial = x25crc(), x25crc().crc

    def pack(self, mav: MAVLink, payload: bytes) -> bytes:
        """Return the frame of a full `payload`, with the sequence number and the signature of `mav`."""
        sent = payload.rstrip(b"\0") or payload[:1]  # MAVLink 2 omits the zeros at the end
        begin, checksum = self._begin, self._checksum
        begin[1], begin[4] = len(sent), mav.seq
        frame: bytes = bytes(begin) + sent
        checksum.crc = self._initial
        checksum.accumulate(frame[1:] + self._extra)
        frame += checksum.crc.to_bytes(2, "little")
        if not self._signs:
            return frame
        self._msgbuf = bytearray(frame)
        self.sign_packet(mav)
        return bytes(self._msgbuf)


MAX_PENDING_BYTES: Final = 4096
"""Most bytes that are stored until a frame is complete; the codec skips them if no frame completes within
this number, to limit memory."""


class Codec:
    """Parser and packer of MAVLink frames for one link, without global state, clock or port.

    `system`, `component`: our system id and component id in sent frames.
    `signing`: if given, every sent frame is signed, and received frames without a valid signature are
        rejected.
    `now_us`, `utc_offset_us`: event time (µs), which the caller sets before it parses or sends, and UNIX time
        minus event time (µs): the steps of the host's clock since the start.
    `frames`, `bytes_skipped`: number of accepted messages, and number of bytes that belonged to no frame.
    """

    def __init__(self, system: int, component: int, signing: Signing | None = None) -> None:
        self.system, self.component = system, component
        self.signing = signing
        self.now_us = self.utc_offset_us = 0
        self._mav = MAVLink(None, system, component)
        if signing is not None:
            self._mav.signing = signing
        self._packers: dict[int, Packer] = {}
        self.frames = self.bytes_skipped = 0
        self._rest = b""
        self._looked = 0

    @property
    def utc_us(self) -> int:
        """UNIX time for signatures and time fields of messages, µs."""
        return self.now_us + self.utc_offset_us

    @property
    def pending(self) -> bytes:
        """Received bytes of a frame that is not complete yet."""
        return self._rest

    def parse(self, data: bytes, *, final: bool = False) -> list[Message]:
        """Parse received bytes; return the messages that they complete.

        The messages do not depend on how the bytes are split into chunks. Bytes that belong to no frame are
        returned as a message of id `BAD_DATA` before the next message, or every `MAX_PENDING_BYTES`. So a
        log of every ``frame`` contains every byte. A frame without a valid signature has the id `REFUSED`. A
        frame that contains a secret has this id, too, and a payload of zeros.

        `data`: received bytes, which may begin or end within a frame.
        `final`: true if no frame continues in later bytes, so that an incomplete frame is returned as
            `BAD_DATA`.
        """
        data = self._rest + data
        found: list[Message] = []
        begin, at = 0, self._looked  # begin: end of the last frame; at: no frame begins before this place
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
        """Return the frame of the message `_name`; fields that are not given are zero."""
        layout = spec(_name)
        return self.frame(layout, layout.payload(**fields))

    def frame(self, layout: Spec, payload: bytes) -> bytes:
        """Return the frame of a payload packed by ``layout.struct.pack(...)``; faster than :meth:`pack`."""
        if self.signing is not None:
            self.signing.set_clock(self.utc_us)
        packer = self._packers.get(layout.id)
        if packer is None:
            packer = self._packers[layout.id] = Packer(layout, self._mav)
        frame = packer.pack(self._mav, payload)
        self._mav.seq = self._mav.seq + 1 & 0xFF
        return frame

    def _skip(self, data: bytes) -> Message:
        self.bytes_skipped += len(data)
        return Message(BAD_DATA, 0, 0, 0, b"", data, known=False)

    def skip(self, count: int) -> None:
        """Advance sequence number and signing stamp as if `count` frames had been sent, for a replay."""
        self._mav.seq = self._mav.seq + count & 0xFF
        if self.signing:
            self.signing.skip(count, self.utc_us)

    def _accept(self, message: Message) -> Message:
        sender, frame, signing = (message.system, message.component), message.frame, self.signing
        is_secret = message.id in SECRET
        if is_secret or (signing and not signing.accept(frame, sender, message.id, self.utc_us)):
            frame = without_secret(frame) if is_secret else frame
            return Message(REFUSED, *sender, message.sequence, b"", frame, known=False)
        self.frames += 1
        return message


WRAPPER = spec("MAG_LINK_BYTES")
WRAPPED_BYTES = WRAPPER.fields["data"].count


class FrameLogWriter:
    """Converter of the messages of a codec to frames for the log.

    A log must be readable by any MAVLink tool and contain every received byte. Frames are logged unchanged;
    bytes that belong to no frame are wrapped in MAG_LINK_BYTES. If the parser needed bytes beyond the frames
    that it returned, these bytes are logged, too, and marked *ahead*. With them, the parser of a replay
    returns the same messages at the same time.
    """

    def __init__(self, system: int, component: int) -> None:
        self._codec = Codec(system, component)

    def frames(self, messages: Iterable[Message], pending: bytes) -> list[bytes]:
        """Return the frames to log for the messages of one call of :meth:`Codec.parse`.

        `pending`: value of :attr:`Codec.pending` after this call.
        """
        frames: list[bytes] = []
        in_doubt = False
        for one in messages:
            if one.id in (BAD_DATA, WRAPPER.id):
                frames += self._wrap(one.frame, is_ahead=False)
            else:
                frames.append(one.frame)
            in_doubt |= one.id == BAD_DATA or not one.known
        return frames + self._wrap(pending, is_ahead=True) if in_doubt else frames

    def _wrap(self, data: bytes, *, is_ahead: bool) -> list[bytes]:
        data = without_secrets(data)
        pieces = [data[i : i + WRAPPED_BYTES] for i in range(0, len(data), WRAPPED_BYTES)]
        pack = partial(self._codec.pack, WRAPPER.name, ahead=int(is_ahead))
        return [pack(length=len(piece), data=piece) for piece in pieces]


class FrameLogReader:
    """Converter of a log's frames to the bytes that were received, the inverse of :class:`FrameLogWriter`."""

    def __init__(self) -> None:
        self._fed = 0  # bytes returned beyond the last record that was not marked ahead
        self._seen = 0  # bytes of records marked ahead since that record

    def data(self, frame: bytes) -> bytes:
        """Return the received bytes in `frame`, without those that an earlier call has returned."""
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
