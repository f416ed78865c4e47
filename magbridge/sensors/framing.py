"""What several protocols share: frames between delimiters, COBS, the end of a range."""

from __future__ import annotations

from functools import reduce
from operator import xor

__all__ = ["CRC32_RESIDUE", "Framer", "cobs_decode", "cobs_encode", "nmea_checksum", "saturated"]

CRC32_RESIDUE = 0x2144DF1C
"""CRC-32 (IEEE 802.3) of any message followed by its own CRC-32 in little-endian order."""


class Framer:
    """Cuts a byte stream at a delimiter; a frame longer than `limit` bytes is skipped, not kept.

    Parameters
    ----------
    delimiter : bytes
        One byte.
    limit : int
        Longest frame, without its delimiter.

    Attributes
    ----------
    skipped : int
        Bytes of frames that were too long; the driver adds those of frames that it rejects.
    """

    __slots__ = ("_delimiter", "_limit", "_overlong", "_rest", "skipped")

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._delimiter = delimiter
        self._limit = limit
        self._rest = b""
        self._overlong = False
        self.skipped = 0

    def begin(self, *, inside: bool) -> None:
        """Restart: bytes that wait for their delimiter are skipped.

        Parameters
        ----------
        inside : bool
            The next byte may be in the middle of a frame: all up to the first delimiter is skipped.
        """
        self.skipped += len(self._rest)
        self._rest, self._overlong = b"", inside

    def split(self, data: bytes) -> list[bytes]:
        """Process bytes; return the frames that they complete, empty ones left out."""
        pieces = (self._rest + data).split(self._delimiter)
        rest = pieces.pop()
        if pieces and self._overlong:
            self.skipped += len(pieces[0])
            pieces[0] = b""
            self._overlong = False
        if self._overlong or len(rest) > self._limit:
            self.skipped += len(rest)
            self._overlong = True
            rest = b""
        self._rest = rest
        frames = []
        for piece in pieces:
            if len(piece) > self._limit:
                self.skipped += len(piece)
            elif piece:
                frames.append(piece)
        return frames


def cobs_encode(data: bytes) -> bytes:
    """Return `data`, at most 253 bytes, without zeros and one byte longer (delimiter not included).

    Notes
    -----
    Consistent Overhead Byte Stuffing (Cheshire & Baker 1999): a leading byte says how far it is to the first
    zero, each zero is replaced by the distance to the next one, the last by the distance to the end. Up to
    this length the code 255 ("no zero follows") is never needed.
    """
    stuffed = bytearray(b"\0" + data + b"\0")
    at = 0
    while (zero := stuffed.find(0, at + 1)) > 0:
        stuffed[at] = zero - at
        at = zero
    return bytes(stuffed[:-1])


def cobs_decode(frame: bytes) -> bytes:
    """Return the data of a frame of :func:`cobs_encode`; empty where it is not one."""
    pieces: list[bytes] = []  # between the zeros
    at, end = 0, len(frame)
    while at < end:
        step = frame[at]
        if not step:
            return b""
        pieces.append(frame[at + 1 : at + step])
        at += step
    return b"\0".join(pieces) if at == end else b""


def nmea_checksum(text: bytes) -> int:
    """Return the exclusive or of all bytes but the first, the ``$``."""
    return reduce(xor, text[1:], 0)


def saturated(x: float, y: float, z: float, limit: float) -> bool:
    """Return True if a channel is at the end of its range, or beyond: ``|channel| >= limit``, in one unit.

    The channels are numbers: a driver has counted a reading with a NaN as bad before it asks.
    """
    return not (-limit < x < limit and -limit < y < limit and -limit < z < limit)
