"""Find frames in bytes of a link; pymavlink computes their checksums and decodes them.

This replaces pymavlink's ``parse_char``. After a wrong checksum, that method skips as many bytes as the
header claimed, so that garbage that looks like a header swallows valid frames (ArduPilot/pymavlink#387).
"""

from __future__ import annotations

import re
from typing import Final

from magbridge.mavlink.dialect import (
    MAVLINK_IFLAG_SIGNED,
    MAVLINK_SIGNATURE_BLOCK_LEN,
    PROTOCOL_MARKER_V1,
    PROTOCOL_MARKER_V2,
    x25crc,
)
from magbridge.mavlink.messages import MESSAGES, Message, spec

__all__ = [
    "EXTRA", "MAX_MESSAGE_ID", "NEEDS_MORE", "NOT_A_FRAME", "SECRET", "SIGNATURE", "SIGNED", "V1", "V2",
    "checksum", "find_magic", "frame_end", "is_signed", "message", "without_secret", "without_secrets",
]  # fmt: skip

V1: Final = PROTOCOL_MARKER_V1
V2: Final = PROTOCOL_MARKER_V2
SIGNED: Final = MAVLINK_IFLAG_SIGNED
SIGNATURE: Final = MAVLINK_SIGNATURE_BLOCK_LEN
"""Length of a signature, bytes: link id, 6 of time stamp, 6 of hash."""
NOT_A_FRAME: Final = 0
NEEDS_MORE: Final = -1
MAX_MESSAGE_ID: Final = 0xFFFF
"""The last message id that a message outside the dialect may have."""
EXTRA: Final = {number: bytes((layout.crc_extra,)) for number, layout in MESSAGES.items()}
"""CRC_EXTRA of each message, the last byte that its checksum covers."""


def checksum(data: bytes, extra: bytes) -> int:
    """Return the checksum of a frame's bytes after the magic byte, and of its CRC_EXTRA."""
    crc: int = x25crc(data + extra).crc
    return crc


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


def frame_end(data: bytes, start: int, stop: int, *, last: bool = False) -> int:
    """Return where the frame ends that begins at ``data[start]``.

    The checksum of a message outside the dialect cannot be checked; it is believed when its header is
    plausible and another frame begins at its end, or when it ends with the data. A random
    header hardly ever is plausible, so that garbage does not delay the frames behind it.

    Parameters
    ----------
    data : bytes
        Bytes received; ``data[start]`` is a magic byte.
    start, stop : int
        Look at no more than ``data[start:stop]``.
    last : bool
        Nothing comes after `stop`.

    Returns
    -------
    int
        The end, or `NOT_A_FRAME`, or `NEEDS_MORE` if the bytes from `stop` on are needed to decide.
    """
    available = stop - start
    header = 10 if data[start] == V2 else 6
    flags = data[start + 2] if header == 10 and available > 2 else 0
    # an incompatibility flag that we do not know: by the standard, not to be read
    if flags > SIGNED or available < header:
        return NOT_A_FRAME if flags > SIGNED else NEEDS_MORE
    number = data[start + 5] if header == 6 else _number(data, start)
    extra = EXTRA.get(number)
    if extra is None and (header == 6 or data[start + 3] or number > MAX_MESSAGE_ID):
        return NOT_A_FRAME
    body_end = start + header + data[start + 1]
    end = body_end + 2 + (SIGNATURE if flags else 0)
    if end > stop:
        return NEEDS_MORE
    if extra is not None:
        right = checksum(data[start + 1 : body_end], extra)
        return end if right == data[body_end] | data[body_end + 1] << 8 else NOT_A_FRAME
    if end >= stop:
        return end if last else NEEDS_MORE
    return end if data[end] in (V1, V2) else NOT_A_FRAME


def message(frame: bytes) -> Message:
    """Parse a frame that :func:`frame_end` has accepted."""
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
    """Return True if a frame carries a signature."""
    return frame[0] == V2 and bool(frame[2] & SIGNED)


def _number(data: bytes, start: int) -> int:
    """Return the id of the message whose version 2 frame begins at ``data[start]``."""
    return data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16


SECRET = frozenset(
    spec(name).id for name in ("SETUP_SIGNING", "AUTH_KEY", "CHANGE_OPERATOR_CONTROL", "WIFI_CONFIG_AP")
)
"""Ids of the messages with a key, a passkey or a password in them. The bridge accepts none over the link, so
that a log or the memory keeps only the fact that they came."""
SECRET_HEADER = re.compile(
    rb"\xfd.{6}(?:" + b"|".join(re.escape(number.to_bytes(3, "little")) for number in SECRET) + rb")",
    re.DOTALL,
)


def without_secret(frame: bytes) -> bytes:
    """Return a frame of such a message with zeros for its payload, and the checksum that belongs to it."""
    header = 10 if frame[0] == V2 else 6
    number = int.from_bytes(frame[7:10], "little") if header == 10 else frame[5]
    body = frame[1:header] + bytes(frame[1])
    end = header + frame[1]
    right = checksum(body, EXTRA[number])
    return frame[:1] + body + right.to_bytes(2, "little") + frame[end + 2 :]


def without_secrets(data: bytes) -> bytes:
    """Return bytes that are not a whole frame, with zeros wherever the payload of such a message may be."""
    for match in SECRET_HEADER.finditer(data):
        begin = match.end()
        end = min(begin + data[match.start() + 1], len(data))
        data = data[:begin] + bytes(end - begin) + data[end:]
    return data
