"""Logs read to their end, whatever happened to them."""

from __future__ import annotations

import io
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil

from magbridge.mavlink import Codec, LogReader, pack_record

START = 1_700_000_000_000_000


def records(count: int) -> list[bytes]:
    codec = Codec(1, 191)
    return [
        pack_record(START + 4 * i, i % 4, codec.pack("ATTITUDE", time_boot_ms=i, roll=0.1 * i))
        for i in range(count)
    ]


def read(data: bytes) -> tuple[list[bytes], LogReader]:
    reader = LogReader(io.BytesIO(data))
    return [pack_record(one.time_us, one.channel, one.frame) for one in reader], reader


def test_round_trip() -> None:
    found, reader = read(b"".join(records(1000)))
    assert found == records(1000)
    assert (reader.records, reader.bytes_skipped, reader.damages) == (1000, 0, 0)
    (one,) = LogReader(io.BytesIO(records(3)[2]))
    assert (one.time_us, one.channel, one.message["time_boot_ms"]) == (START + 8, 2, 2)


def test_chunks_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    data = b"".join(records(200))
    damaged = data[:3000] + data[3010:5000] + b"\xfd\x00" * 30 + data[5000:-7]
    whole = read(damaged)[0]
    for size in (1, 7, 64, 1000):
        monkeypatch.setattr("magbridge.mavlink.tlog.CHUNK", size)
        assert read(damaged)[0] == whole


@given(st.binary(max_size=300))
def test_any_bytes(data: bytes) -> None:
    found, reader = read(data)
    assert sum(map(len, found)) + reader.bytes_skipped == len(data)


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
    assert sum(map(len, found)) + reader.bytes_skipped == len(whole) - len(
        whole[begin : begin + length]
    ) + len(noise)


def test_a_log_cut_anywhere_reads_to_its_last_whole_record() -> None:
    all_records = records(5)
    data = b"".join(all_records)
    for end in range(len(data)):
        found, reader = read(data[:end])
        assert found == all_records[: len(found)]
        assert reader.bytes_skipped == end - sum(map(len, found)) < len(all_records[1])


def test_a_megabyte_of_garbage_is_passed_over() -> None:
    noise = random.Random(3).randbytes(1_500_000)
    found, reader = read(noise + b"".join(records(5)))
    assert found[-5:] == records(5)
    assert reader.damages <= 1 + reader.records - 5


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
