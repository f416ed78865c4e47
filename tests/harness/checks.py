"""Checks that all tests of faults have in common."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import zip_longest

import numpy as np
from rig import Rig

from magbridge.mavlink import Codec

Row = Callable[[str, str, str, str], None]
"""Takes a row of the table of faults."""
NOISE = np.random.default_rng(1).integers(0, 256, 4000, dtype=np.uint8).tobytes()


def seconds(value: float) -> str:
    """Return a time as the table tells it."""
    return f"{value:.2f} s"


def soon(limit: float) -> float:
    """Return how long what takes `limit` (s) on a quiet machine may take on this one, as busy as it is."""
    return 2.0 * limit * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def replays(rig: Rig) -> None:
    """Stop the bridge; its replayed log publishes the same bytes, and has the received frames in order."""
    assert rig.stop() == 0
    recorded, published = rig.replay()
    assert recorded.damages == 0
    assert recorded.messages > 20
    assert first_difference(published, recorded.published) is None
    at = 0
    for _, message in rig.received:
        at = published.find(message.frame, at)
        assert at >= 0, message.fields
        at += len(message.frame)


def first_difference(one: bytes | bytearray, other: bytes | bytearray) -> tuple[object, object] | None:
    """Return the first two messages in which two streams differ."""
    pairs = zip_longest(*(Codec(0, 0).parse(bytes(stream)) for stream in (one, other)))
    different = ((this and this.fields, that and that.fields) for this, that in pairs if this != that)
    return next(different, None)
