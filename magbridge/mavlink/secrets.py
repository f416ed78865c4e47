"""Messages that carry a secret: a log or the memory keeps only the fact that they came.

The bridge accepts no key or password over the link, so their content is not needed.
"""

from __future__ import annotations

import re

from magbridge.mavlink.framing import EXTRA, V2, checksum
from magbridge.mavlink.messages import spec

__all__ = ["SECRET", "without_secret", "without_secrets"]

SECRET = frozenset(
    spec(name).id for name in ("SETUP_SIGNING", "AUTH_KEY", "CHANGE_OPERATOR_CONTROL", "WIFI_CONFIG_AP")
)
"""Ids of the messages with a key, a passkey or a password in them."""
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
