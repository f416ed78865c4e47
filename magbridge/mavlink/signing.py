"""Message signing: it proves who wrote a frame, and that it is not an old one sent again.

Notes
-----
The signature is a link id, a time stamp ``t`` (48 bit, units of 10 µs since 2015-01-01) and the first 6 bytes
of ``SHA-256(key + frame + link id + t)``. Stamps of one stream (link id, system, component) must increase. A
stamp counts only once its hash has proved right: otherwise one forged packet from the future would lock out
every genuine one that follows, as it does in pymavlink 2.4.50.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from magbridge.errors import ConfigError

__all__ = ["Signing", "load_key", "timestamp"]

EPOCH_US = 1_420_070_400_000_000
"""2015-01-01 in µs of UNIX time."""
MINUTE = 6_000_000
"""in units of 10 µs"""
LIMIT = (1 << 48) - 1
NEED_NO_SIGNATURE = frozenset({109})
"""RADIO_STATUS: radios put it on the link, and they have no key."""


def timestamp(t_us: int) -> int:
    """Return the signing time stamp of a UNIX time in µs."""
    return min(max(t_us - EPOCH_US, 0) // 10, LIMIT)


def load_key(path: str | Path) -> bytes:
    """Read a signing key: a file of 32 bytes.

    Raises
    ------
    ConfigError
        The file cannot be read or has another length.
    """
    try:
        key = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(path, "", error.strerror or str(error)) from error
    if len(key) != 32:
        raise ConfigError(path, "", f"a signing key has 32 bytes, not {len(key)}")
    return key


class Signing:
    """Signs and verifies, in event time.

    Parameters
    ----------
    key : bytes
        32 bytes.
    last : int
        The last time stamp used in the run before, so that ours increase even if the clock was set back.

    Attributes
    ----------
    refused : int
        Frames that were unsigned, wrongly signed or old.
    refusals : dict of str to tuple of 2 int
        Why frames were refused, and the first system and component whose frame was refused for that.
    """

    def __init__(self, key: bytes, last: int = 0) -> None:
        self._key = key
        self.last = last
        self.refused = 0
        self.refusals: dict[str, tuple[int, int]] = {}
        self._streams: dict[tuple[int, int, int], int] = {}

    def sign(self, frame: bytes, t_us: int) -> bytes:
        """Return `frame` with its signature."""
        self.last = min(max(self.last + 1, timestamp(t_us)), LIMIT)
        signed = frame + b"\0" + self.last.to_bytes(6, "little")
        return signed + sha256(self._key + signed).digest()[:6]

    def accept(self, frame: bytes, stream: tuple[int, int], number: int, t_us: int) -> bool:
        """Say whether a frame of the `stream` (system, component) is genuine and new."""
        why = "" if number in NEED_NO_SIGNATURE else "not signed"
        if frame[0] == 0xFD and frame[2] & 1:
            why = self._doubt(frame, stream, t_us)
        if why:
            self.refused += 1
            self.refusals.setdefault(why, stream)
        return not why

    def _doubt(self, frame: bytes, stream: tuple[int, int], t_us: int) -> str:
        """Return what is wrong with a signature; nothing where it is genuine and new."""
        if sha256(self._key + frame[:-6]).digest()[:6] != frame[-6:]:
            return "signed with another key"
        stamp = int.from_bytes(frame[-12:-6], "little")
        key = (frame[-13], *stream)
        # a new stream may be a minute behind; an older one may be a recording that is sent again
        floor = self._streams.get(key, max(self.last, timestamp(t_us)) - MINUTE)
        if stamp <= floor:
            return "an old time stamp"
        self._streams[key] = stamp
        self.last = max(self.last, stamp)
        return ""
