"""Where a MAVLink frame ends, and whether it is one; versions 1 and 2.

A frame is: a magic byte, a header with length and message id, the payload, a checksum (CRC-16/MCRF4XX) over
all but the magic byte, closed with a byte that depends on the message's layout, and perhaps a signature.
"""

from __future__ import annotations

from struct import Struct
from typing import Final

from fastcrc.crc16 import mcrf4xx

from magbridge.mavlink.dialect import MESSAGES
from magbridge.mavlink.messages import Message, spec

__all__ = [
    "AFTER", "BEFORE_V2", "EXTRA", "HEADER", "LAST", "MAGIC", "MORE", "NOT_A_FRAME", "SIGNATURE", "SIGNED",
    "V1", "V2", "find_magic", "frame_end", "is_signed", "message",
]  # fmt: skip

V1: Final = 0xFE
V2: Final = 0xFD
MAGIC = bytes((V1, V2))
SIGNED: Final = 1
SIGNATURE: Final = 13
"""bytes: link id, 6 of time stamp, 6 of hash."""
NOT_A_FRAME: Final = 0
MORE: Final = -1
LAST: Final = 0xFFFF
"""The last message id that a message outside the dialect may have."""
HEADER: Final = Struct("<BBBBBBB3s")
"""Of version 2: magic byte, length of the payload, flags of two sorts, sequence, sender, message."""
EXTRA: Final = {number: extra for number, (_, extra, _) in MESSAGES.items()}
AFTER: Final = [mcrf4xx(bytes((value,)), 0) for value in range(256)]
"""The checksum of each byte alone, from which that of any bytes follows, one by one."""
BEFORE_V2: Final = 0x3085
"""From here, the checksum of a frame with its magic byte is that without it, as it should be."""


def find_magic(data: bytes, start: int, stop: int) -> int:
    """Return where the first magic byte of ``data[start:stop]`` is; `stop` where there is none.

    A regular expression would take a hundred times as long for a long run of other bytes.
    """
    if start < stop and (data[start] == V2 or data[start] == V1):  # as almost always: right after a frame
        return start
    v2 = data.find(V2, start, stop)
    end = v2 if v2 >= 0 else stop
    v1 = data.find(V1, start, end)
    return v1 if v1 >= 0 else end


def frame_end(data: bytes, start: int, stop: int, gap: int = 0, *, last: bool = False) -> int:
    """Return where the frame ends that begins at ``data[start]``.

    The checksum of a message outside the dialect cannot be checked; it is believed when its header is
    plausible and another frame begins `gap` bytes after its end, or when it ends with the data. A random
    header hardly ever is plausible, so that garbage does not hold up what follows it.

    Parameters
    ----------
    data : bytes
        Bytes received; ``data[start]`` is a magic byte.
    start, stop : int
        Look at no more than ``data[start:stop]``.
    gap : int
        bytes between frames: 0 on a link, 8 in a log.
    last : bool
        Nothing comes after `stop`.

    Returns
    -------
    int
        The end, or `NOT_A_FRAME`, or `MORE` where it cannot be told without the bytes from `stop` on.
    """
    available = stop - start
    header = 10 if data[start] == V2 else 6
    flags = data[start + 2] if header == 10 and available > 2 else 0
    # an incompatibility flag that we do not know: by the standard, not to be read
    if flags > SIGNED or available < header:
        return NOT_A_FRAME if flags > SIGNED else MORE
    number = data[start + 5] if header == 6 else _number(data, start)
    extra = EXTRA.get(number)
    if extra is None and (header == 6 or data[start + 3] or number > LAST):
        return NOT_A_FRAME
    checksum = start + header + data[start + 1]
    end = checksum + 2 + (SIGNATURE if flags else 0)
    if end > stop:
        return MORE
    if extra is not None:
        right = closed(mcrf4xx(data[start + 1 : checksum]), extra)
        return end if right == data[checksum] | data[checksum + 1] << 8 else NOT_A_FRAME
    if end + gap >= stop:
        return end if last else MORE
    return end if data[end + gap] in (V1, V2) else NOT_A_FRAME


def message(frame: bytes) -> Message:
    """Take apart a frame that :func:`frame_end` has accepted."""
    header = 10 if frame[0] == V2 else 6
    number = frame[5] if header == 6 else _number(frame, 0)
    payload = frame[header : header + frame[1]]
    known = number in EXTRA
    if known:
        payload = payload.ljust(spec(number).size, b"\0")
    # the sequence, the sender's system and its component stand before the message's id
    sender = 4 if header == 10 else 2
    return Message(number, frame[sender + 1], frame[sender + 2], frame[sender], payload, frame, known)


def is_signed(frame: bytes) -> bool:
    """Say whether a frame carries a signature."""
    return frame[0] == V2 and bool(frame[2] & SIGNED)


def _number(data: bytes, start: int) -> int:
    """Return the id of the message whose version 2 frame begins at ``data[start]``."""
    return data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16


def closed(checksum: int, extra: int) -> int:
    """Return the checksum of bytes and a last one, `extra`, from that of the bytes."""
    return checksum >> 8 ^ AFTER[(checksum ^ extra) & 0xFF]
