"""Checks and limits that the fault tests share."""

import os
from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path

import numpy as np
from rig import Rig

from magbridge.mavlink import Codec, LogReader, TlogRecord

Measured = Callable[..., None]
"""Function that records the values that a fault test measured: times in s, losses in messages or bytes."""
NOISE = np.random.default_rng(1).integers(0, 256, 4000, dtype=np.uint8).tobytes()


def soon(limit: float) -> float:
    """Return the time limit (s) on this machine for an action that takes `limit` (s) on an idle machine."""
    return 2.0 * limit * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def records(path: Path) -> list[TlogRecord]:
    """Return the records of an undamaged log."""
    with path.open("rb") as file:
        reader = LogReader(file)
        found = list(reader)
    assert reader.damages == 0, path
    return found


def replays(rig: Rig) -> None:
    """Stop the bridge; assert that its replayed log gives the same bytes and holds the received frames."""
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
    """Return the fields of the first pair of messages in which two streams differ; None if there is none."""
    pairs = zip_longest(*(Codec(0, 0).parse(bytes(stream)) for stream in (one, other)))
    different = ((this and this.fields, that and that.fields) for this, that in pairs if this != that)
    return next(different, None)
