"""GPS time, which knows no leap seconds, and UTC."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["GPS_EPOCH", "WEEK", "leap_seconds"]

GPS_EPOCH = 315_964_800.0
"""s since 1970 of 1980-01-06, where GPS weeks begin."""
WEEK = 604_800.0
"""Length of a GPS week, s."""
LEAPS = (
    (1_483_228_800, 18),
    (1_435_708_800, 17),
    (1_341_100_800, 16),
    (1_230_768_000, 15),
    (1_136_073_600, 14),
    (0, 13),
)
"""From when on (s since 1970) GPS time is ahead of UTC by how many s; IERS Bulletin C 52, from 1999 on."""


def leap_seconds(gps: FloatArray) -> FloatArray:
    """Return by how many s GPS time is ahead of UTC, (n,).

    Parameters
    ----------
    gps : (n,) array
        GPS time, in s since 1970.
    """
    leap = np.zeros(len(gps))
    for since, ahead in reversed(LEAPS):
        leap[gps - ahead >= since] = ahead
    return leap
