"""Test that logs are read to their end, whatever their damage."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink import mavutil

from magbridge.mavlink import Codec, FrameLogReader, FrameLogWriter, LogReader, pack_record
from magbridge.mavlink.tlog import BLOCK_BYTES, blocks

START = 1_700_000_000_000_000


def records(count: int) -> list[bytes]:
    codec = Codec(1, 191)
    frames = [codec.pack("ATTITUDE", time_boot_ms=i, roll=0.1 * i) for i in range(count)]
    return [pack_record(START + 4 * i, i % 4, frame) for i, frame in enumerate(frames)]


def several_messages() -> bytes:
    """Return 24 records of several messages, whose payloads are cut to different lengths."""
    codec = Codec(1, 1)
    names = ("RAW_IMU", "ATTITUDE", "NAMED_VALUE_FLOAT", "HEARTBEAT")
    fields = ({"xmag": 5}, {"yaw": 1.5}, {"name": "battpos", "value": 2.0}, {"type": 12})
    frames = [codec.pack(names[k % 4], **fields[k % 4]) for k in range(24)]
    return b"".join(pack_record(START + 4 * k, k % 4, frame) for k, frame in enumerate(frames))


def read(data: bytes, block_bytes: int = BLOCK_BYTES) -> tuple[list[bytes], LogReader]:
    reader = LogReader(io.BytesIO(data), block_bytes)
    return [pack_record(one.time_us, one.channel, one.frame) for one in reader], reader


def test_round_trip() -> None:
    found, reader = read(b"".join(records(1000)))
    assert found == records(1000)
    assert (reader.records, reader.bytes_skipped, reader.damages) == (1000, 0, 0)
    (one,) = LogReader(io.BytesIO(records(3)[2]))
    assert (one.time_us, one.channel, one.message["time_boot_ms"]) == (START + 8, 2, 2)


@given(
    at=st.integers(0, 1200),
    junk=st.binary(max_size=80),
    cut=st.integers(0, 80),
    size=st.sampled_from([1, 7, 64, 330, 999]),
)
@settings(max_examples=100, deadline=None)
def test_damage_across_the_blocks_that_are_read(at: int, junk: bytes, cut: int, size: int) -> None:
    data = several_messages()
    at %= len(data)
    damaged = data[:at] + junk + data[at + cut :]
    (found, reader), (whole, all_at_once) = read(damaged, size), read(damaged)
    assert found == whole
    assert (reader.bytes_skipped, reader.damages) == (all_at_once.bytes_skipped, all_at_once.damages)


def test_payloads_have_the_zeros_that_were_cut() -> None:
    (block, *_) = [one for one in blocks(io.BytesIO(several_messages())) if len(one.number)]
    which = np.flatnonzero(block.number == 27)  # RAW_IMU
    assert (np.diff(block.end[which] - block.payload[which]) == 0).all()
    for row, k in zip(block.payloads(which), which, strict=True):
        assert bytes(row) == block.message(int(k)).payload


@given(st.data())
def test_damage_costs_only_the_records_it_touches(data: st.DataObject) -> None:
    all_records = records(30)
    whole = b"".join(all_records)
    begin = data.draw(st.integers(0, len(whole)))
    length = data.draw(st.integers(1, 60))
    noise = data.draw(st.binary(max_size=60))
    found, reader = read(whole[:begin] + noise + whole[begin + length :])
    size = len(all_records[5])
    touched = (begin + length - 1) // size - begin // size + 1
    # a stamp cannot be checked: noise that happens to end in a plausible one may stand before a good frame
    assert len(set(found) & set(all_records)) >= 30 - touched - 3
    removed = len(whole[begin : begin + length])
    assert sum(map(len, found)) + reader.bytes_skipped == len(whole) - removed + len(noise)


def test_a_log_cut_anywhere_reads_to_its_last_whole_record() -> None:
    all_records = records(5)
    data = b"".join(all_records)
    for end in range(len(data)):
        found, reader = read(data[:end])
        assert found == all_records[: len(found)]
        assert reader.bytes_skipped == end - sum(map(len, found)) < len(all_records[1])


@pytest.mark.real
@pytest.mark.parametrize(("name", "count", "damages"), [("small", 35912, 4), ("damaged", 50136, 1961)])
def test_measured_logs_read_as_pymavlink_reads_them(
    real_data: Path, name: str, count: int, damages: int
) -> None:
    path = real_data / "ardusub" / f"{name}.tlog"
    with path.open("rb") as file:
        reader = LogReader(file)
        ours = list(reader)
    assert (len(ours), reader.damages) == (count, damages)
    assert sum(len(one.frame) + 8 for one in ours) + reader.bytes_skipped == path.stat().st_size
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    theirs = []
    while (message := log.recv_msg()) is not None:
        if message.get_type() != "BAD_DATA":
            theirs.append(message)
    log.close()
    assert [one.message.name for one in ours] == [message.get_type() for message in theirs]
    for one, message in zip(ours[::97], theirs[::97], strict=True):
        assert one.frame == bytes(message.get_msgbuf())


# ---- a link's bytes through a log and back -----------------------------------------------------------------


GENUINE = [
    Codec(1, 1).pack("ATTITUDE", time_boot_ms=1, roll=0.1, yawspeed=1.0),
    Codec(1, 1).pack("HEARTBEAT", type=12, autopilot=3),
    Codec(1, 1).pack("MAG_LINK_BYTES", length=3, data=b"abc"),
    b"\xfd\x03\x00\x00\x09\x01\x01\x5f\xea\x00abc\x12\x34",  # an unknown message
]
CHUNKS = st.lists(
    st.lists(
        st.one_of(
            st.sampled_from(GENUINE),
            st.sampled_from(GENUINE).flatmap(
                lambda frame: st.integers(1, len(frame)).map(lambda n: frame[:n])
            ),
            st.binary(max_size=10),
            st.sampled_from([b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00", b"\xfd", bytes(3000)]),
        ),
        max_size=4,
    ).map(b"".join),
    max_size=12,
)


@given(CHUNKS)
@example([b"\xfd\x30\x00\x00\x00\x01\x01\x00\x00\x00", GENUINE[0] + b"\xfd" * 9, GENUINE[1]])
@example(
    [b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00" + GENUINE[0], b"\xfd" * 260, b"\xfd\xff" * 300, GENUINE[1]]
)
def test_the_log_brings_about_the_same_messages_at_the_same_moments(chunks: list[bytes]) -> None:
    live, again = Codec(1, 191), Codec(1, 191)
    writer, reader = FrameLogWriter(1, 191), FrameLogReader()
    for chunk in chunks:
        messages = live.parse(chunk)
        frames = writer.frames(messages, live.pending)
        replayed = [message for frame in frames for message in again.parse(reader.data(frame))]
        believed = [message.frame for message in messages if message.known]
        assert [message.frame for message in replayed if message.known] == believed
        assert again.bytes_skipped == live.bytes_skipped
        assert Codec(1, 1).parse(b"".join(frames) + GENUINE[0])[-1].known  # any tool reads the log
