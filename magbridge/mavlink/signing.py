"""Message signing: it proves who wrote a frame, and that it is not an old one sent again.

Notes
-----
The signature is a link id, a time stamp ``t`` (48 bit, units of 10 µs since 2015-01-01) and the first 6 bytes
of ``SHA-256(key + frame + link id + t)`` (MAVLink guide, 'Message Signing').

Each stream (system, component, link id) has floors of its own, and a stamp must lie above its floor: one for
stamps that are at most a minute ahead of our clock, and one for stamps further ahead. So a clock that was
wrong, its owner's or ours, refuses nothing once it is right again, and neither a key holder that lies about
the time nor a restart of ours refuses anybody else. A stamp counts only once its hash has proved right:
otherwise one forged packet from the future would lock out every genuine one that follows, as it does in
pymavlink 2.4.50.

The guide lets every stamp received raise our own. Here only the autopilot's do, which a computer without a
clock of its own needs, and no further than `FOLLOW` ahead of a clock that has been set.
"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path

from magbridge.errors import FormatError
from magbridge.files import contents
from magbridge.mavlink.dialect import MAVLinkSigning
from magbridge.mavlink.framing import is_signed

__all__ = ["NOT_SIGNED", "Signing", "Stream", "load_key", "readable_by_all", "timestamp"]

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


class Signing(MAVLinkSigning):
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
