"""Test TIO packets that the tests build from the public description of the protocol."""

from struct import pack
from typing import Any
from zlib import crc32

import pytest

from magbridge.sensors import Driver, open_driver
from magbridge.sensors.clock import DeviceClock

F32, I24, U16 = 0x42, 0x31, 0x20


def on_the_line(kind: int, payload: bytes, routing: bytes = b"") -> bytes:
    packet = pack("<BBH", kind, len(routing), len(payload)) + payload + routing
    packet += pack("<I", crc32(packet))
    escaped = b"".join({0xC0: b"\xdb\xdc", 0xDB: b"\xdb\xdd"}.get(byte, bytes([byte])) for byte in packet)
    return escaped + b"\xc0"


def generation_2(columns: list[tuple[int, str, str]], stream: int = 1, segment: int = 5) -> bytes:
    """Return the descriptors of a stream of 200 Hz / 4."""
    size = sum(kind >> 4 for kind, _, _ in columns)
    records = [
        (1, pack("<BBIBBB", 9, 3, 0xABCD, 0, 0, 1) + b"VMR"),
        (2, pack("<BBBBHHB", 9, stream, len(columns), 8, size, 100, 6) + b"vector"),
        (3, pack("<BBBBBBIIIIfB", 27, stream, segment, 3, 1, 4, 0xABCD, 1000, 200, 4, 10.0, 1) + b"1234"),
    ]
    for index, (kind, name, unit) in enumerate(columns):
        # a byte more than we know
        header = pack("<BBBBBBBB", 8, stream, index, kind, len(name), len(unit), 3, 99)
        records.append((4, header + name.encode() + unit.encode() + b"any"))
    return b"".join(on_the_line(11, bytes([kind, 1]) + record) for kind, record in records)


VECTOR = [(F32, "vector.x", "nT"), (F32, "vector.y", "nT"), (F32, "vector.z", "nT")]


def samples_2(number: int, *values: float, stream: int = 1, segment: int = 5) -> bytes:
    header = number.to_bytes(3, "little") + bytes([segment])
    return on_the_line(128 + stream, header + pack(f"<{len(values)}f", *values))


def driver(**options: Any) -> Driver:
    return open_driver("twinleaf", options)


@pytest.fixture
def twinleaf() -> Driver:
    """Return a driver that knows the columns of a stream of the second generation."""
    one = driver()
    one.feed(generation_2(VECTOR))
    return one


def test_generation_2() -> None:
    twinleaf = driver()
    assert twinleaf.feed(samples_2(6, 1.0, 2.0, 3.0)) == []  # not described yet: counted
    assert (twinleaf.bytes_skipped, twinleaf.frames_bad) == (16, 0)
    twinleaf.feed(generation_2(VECTOR))
    first, second = twinleaf.feed(samples_2(7, 20_000.0, -3_000.0, 41_000.5, 20_001.0, -3_001.0, 41_001.5))
    assert first.field == (20_000.0, -3_000.0, 41_000.5)
    assert second.field == (20_001.0, -3_001.0, 41_001.5)
    assert (first.device_time, second.device_time) == pytest.approx((1000.14, 1000.16))
    assert (first.sequence, second.sequence) == (50_007, 50_008)
    assert first.power_cycle == 0xABCD
    assert not first.saturated


def test_generation_2_other_columns_units_and_types() -> None:
    columns = [(I24, "raw", "count"), (U16, "therm", "C")]
    columns += [(F32, name, "uT") for name in ("z", "pad", "x", "y")]
    twinleaf = driver(columns=["x", "y", "z"], temperature="therm", range=25_000.0)
    twinleaf.feed(generation_2(columns, stream=3))
    payload = (9).to_bytes(3, "little") + b"\x05" + b"abc" + pack("<Hffff", 21, 41.5, 9.0, 20.5, -3.25)
    (reading,) = twinleaf.feed(on_the_line(131, payload))
    assert reading.field == (20_500.0, -3_250.0, 41_500.0)
    assert (reading.temperature, reading.saturated) == (21.0, True)


def test_a_reply_to_the_metadata_request_describes_as_well(twinleaf: Driver) -> None:
    asked = driver()
    frames = generation_2(VECTOR).split(b"\xc0")[:-1]
    bodies = [f.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")[4:-4] for f in frames]
    reply = b"".join(bytes([body[0], len(body) - 2]) + body[2:] for body in bodies)
    asked.feed(on_the_line(3, pack("<H", 2) + reply))
    assert asked.feed(samples_2(1, 1.0, 2.0, 3.0)) == twinleaf.feed(samples_2(1, 1.0, 2.0, 3.0)) != []


def test_generation_2_sample_numbers_wrap_and_segments_follow(twinleaf: Driver) -> None:
    times = [twinleaf.feed(samples_2(n, 1.0, 2.0, 3.0))[0].device_time for n in (2**24 - 2, 2**24 - 1, 0, 1)]
    assert times == pytest.approx([1000 + 0.02 * (2**24 + k) for k in (-2, -1, 0, 1)])
    assert twinleaf.feed(samples_2(0, 1.0, 2.0, 3.0, segment=6)) == []
    twinleaf.feed(generation_2(VECTOR, segment=6))
    assert twinleaf.feed(samples_2(0, 1.0, 2.0, 3.0, segment=6))[0].device_time == 1000.0


def generation_1(unit: str = "nT") -> list[bytes]:
    return [
        on_the_line(6, pack("<HBBQIIIf", 3, 1, 1, 0, 1000, 1, 1, 0.0) + bytes(16)),
        on_the_line(
            7, pack("<HHIIiHHB", 8, 3, 1, 0, 0, 0, 3, F32) + f"vector\tx,y,z\tField\t{unit}".encode()
        ),
        on_the_line(7, pack("<HHIIiHHB", 9, 3, 10, 0, 0, 0, 1, F32) + b"therm\t\tTemperature\tC"),
        on_the_line(
            8,
            pack("<HHIIQHH", 0, 3, 10, 0, 77, 2, 0) + pack("<HHII", 8, 0, 1, 0) + pack("<HHII", 9, 0, 10, 0),
        ),
    ]


def test_generation_1_in_any_order_with_a_slower_component() -> None:
    twinleaf = driver(temperature="therm")
    for packet in reversed(generation_1("uT")):
        assert twinleaf.feed(packet) == []
    (reading,) = twinleaf.feed(on_the_line(128, pack("<Iffff", 250, 20.0, -3.0, 41.0, 12.5)))
    assert reading.field == (20_000.0, -3_000.0, 41_000.0)
    assert (reading.sequence, reading.temperature) == (250, 12.5)
    assert reading.device_time == pytest.approx(2.5)  # 1000 µs * 10 * 250


def test_generation_1_samples_without_the_slower_component() -> None:
    twinleaf = driver()
    twinleaf.feed(b"".join(generation_1()))
    (reading,) = twinleaf.feed(on_the_line(128, pack("<Ifff", 251, 20.0, -3.0, 41.0)))
    assert (reading.field, reading.sequence) == ((20.0, -3.0, 41.0), 251)


def test_only_the_wanted_device_of_a_tree_is_read() -> None:
    twinleaf = driver(route="/0/2")
    for packet in generation_1():
        twinleaf.feed(packet)  # from the root
    samples = pack("<Ifff", 1, 20.0, -3.0, 41.0)
    assert twinleaf.feed(on_the_line(128, samples)) == []
    assert (twinleaf.bytes_skipped, twinleaf.frames_bad) == (0, 0)
    assert twinleaf.feed(on_the_line(128, samples, b"\x02\x00")) == []
    assert twinleaf.bytes_skipped == len(samples)


def test_a_new_session_is_a_power_cycle(twinleaf: Driver) -> None:
    twinleaf.feed(on_the_line(5, pack("<I", 0xBEEF)))
    assert twinleaf.feed(samples_2(1, 1.0, 2.0, 3.0))[0].power_cycle == 0xBEEF


def test_requests_at_the_start() -> None:
    (request,) = driver(route="/1").start()
    heartbeat, send_all, metadata, rest = request.lstrip(b"\xc0").split(b"\xc0")
    assert rest == b""
    assert heartbeat[:5] == bytes([5, 1, 0, 0, 1])
    assert send_all[4:8] == pack("<HH", 1, 0x8000 | 13)
    assert b"data.send_all\x01" in send_all
    assert b"dev.metadata\x01" in metadata


@pytest.mark.parametrize(
    "payload",
    [
        (11, b""),
        (11, b"\x04\x01"),
        (11, b"\x03\x01" + bytes(5)),
        (6, bytes(10)),
        (7, bytes(10)),
        (8, pack("<HHIIQHH", 0, 0, 0, 0, 0, 500, 0)),
        (129, b"\x01"),
        (129, (1).to_bytes(3, "little") + b"\x05" + bytes(11)),
    ],
)
def test_packets_with_a_right_checksum_and_wrong_content_are_bad(
    twinleaf: Driver, payload: tuple[int, bytes]
) -> None:
    assert twinleaf.feed(on_the_line(*payload)) == []
    assert twinleaf.frames_bad == 1


def test_descriptors_do_not_pile_up() -> None:
    twinleaf = driver()
    for number in range(2000):
        twinleaf.feed(on_the_line(7, pack("<HHIIiHHB", number, 3, 1, 0, 0, 0, 3, F32) + b"a\tx,y,z\t\tnT"))
    assert len(twinleaf._device._known) <= 1024  # type: ignore[attr-defined]


def test_an_unknown_unit_is_not_guessed() -> None:
    twinleaf, known = driver(), driver(unit="pT")
    for one in (twinleaf, known):
        one.feed(generation_2([(F32, name, "furlong") for _, name, _ in VECTOR]))
    assert twinleaf.feed(samples_2(1, 1.0, 2.0, 3.0)) == []
    assert twinleaf.frames_bad == 1
    assert known.feed(samples_2(1, 1.0, 2.0, 3.0))[0].field == pytest.approx((1e-3, 2e-3, 3e-3))


def test_a_nan_is_a_lost_sample_and_not_a_saturated_one(twinleaf: Driver) -> None:
    nan = float("nan")
    readings = twinleaf.feed(samples_2(7, 1.0, 2.0, 3.0, 1.0, nan, 3.0, 4.0, 5.0, 6.0))
    assert [reading.field for reading in readings] == [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    assert [reading.saturated for reading in readings] == [False, False]
    assert twinleaf.frames_bad == 1
    stamps = DeviceClock.for_driver(twinleaf).stamp(readings, 10**15)
    assert [stamp.missing for stamp in stamps] == [0, 1]
