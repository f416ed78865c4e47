"""The records of a log all at once, beside the reader that takes one after the other."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magbridge.mavlink import Codec, LogReader, pack_record
from magbridge.mavlink import blocks as module
from magbridge.mavlink.blocks import blocks

T0 = 1_700_000_000_000_000


def log(n: int = 60) -> bytes:
    """Return records of several messages, whose payloads are cut to different lengths."""
    codec = Codec(1, 1)
    names = ("RAW_IMU", "ATTITUDE", "NAMED_VALUE_FLOAT", "HEARTBEAT")
    fields = ({"xmag": 5}, {"yaw": 1.5}, {"name": "battpos", "value": 2.0}, {"type": 12})
    return b"".join(
        pack_record(T0 + 4 * k, k % 4, codec.pack(names[k % 4], **fields[k % 4])) for k in range(n)
    )


def same(data: bytes) -> int:
    """Compare both readers; return how many records there are."""
    reader = LogReader(BytesIO(data))
    expected, payloads = [], []
    for one in reader:
        message = one.message
        expected.append((one.time_us, one.channel, message.id, message.system, message.component))
        payloads.append(message.payload)
    found: list[tuple[int, ...]] = []
    cut: list[bytes] = []
    skipped = damages = 0
    for block in blocks(BytesIO(data)):
        skipped, damages = skipped + block.bytes_skipped, damages + block.damages
        columns = block.time_us, block.channel, block.number, block.system, block.component
        found += [tuple(map(int, row)) for row in zip(*columns, strict=True)]
        cut += [block.data[first:last] for first, last in zip(block.payload, block.end, strict=True)]
    assert found == expected
    assert all(full.startswith(one) for full, one in zip(payloads, cut, strict=True))
    assert (skipped, damages) == (reader.bytes_skipped, reader.damages)
    return len(found)


def test_a_whole_log() -> None:
    assert same(log()) == 60


@given(
    at=st.integers(0, 3000),
    junk=st.binary(max_size=80),
    cut=st.integers(0, 80),
    size=st.sampled_from([330, 999]),
)
@settings(max_examples=150, deadline=None)
def test_a_damaged_log(at: int, junk: bytes, cut: int, size: int) -> None:
    """Also where damage lies across the blocks that are read."""
    data = log()
    at %= len(data)
    before, module.SIZE = module.SIZE, size
    try:
        same(data[:at] + junk + data[at + cut :])
    finally:
        module.SIZE = before


@pytest.mark.real
@pytest.mark.parametrize("name", ["small.tlog", "damaged.tlog"])
def test_a_real_log(name: str, real_data: Path) -> None:
    assert same((real_data / "ardusub" / name).read_bytes()) > 30_000


def test_payloads_have_the_zeros_that_were_cut() -> None:
    (block, *_) = [one for one in blocks(BytesIO(log())) if len(one.number)]
    which = np.flatnonzero(block.number == 27)  # RAW_IMU
    assert (np.diff(block.end[which] - block.payload[which]) == 0).all()
    payloads = block.payloads(which)
    for row, k in zip(payloads, which, strict=True):
        assert bytes(row) == block.message(int(k)).payload
