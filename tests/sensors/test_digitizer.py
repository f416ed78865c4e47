"""Test the digitizer's frame, byte for byte, against its description."""

import ast
from math import isnan
from pathlib import Path
from random import Random
from struct import pack
from zlib import crc32

import pytest

from magbridge.errors import MagbridgeError
from magbridge.records import Reading
from magbridge.sensors import open_driver
from magbridge.sensors.digitizer import EXAMPLE
from magbridge.sensors.framing import cobs_encode

MESSAGE = bytes.fromhex("01240700030040420F00E0C81000804F1200A901800E00ABAA2A0000F0555555")
OPTIONS = {"sensitivity": 5e-5}
SOURCE = Path(__file__).parents[2] / "magbridge/sensors/digitizer.py"


def framed(message: bytes) -> bytes:
    return cobs_encode(message + crc32(message).to_bytes(4, "little")) + b"\0"


def read(*frames: bytes, **options: float) -> list[Reading]:
    return open_driver("digitizer", OPTIONS | options).feed(b"".join(frames))


def test_the_worked_example() -> None:
    assert framed(MESSAGE) == EXAMPLE
    description = ast.get_docstring(ast.parse(SOURCE.read_text(encoding="utf-8")))
    assert MESSAGE.hex(" ").upper() in " ".join(description.split())
    (reading,) = read(EXAMPLE)
    assert reading.counts == (2796203, -1048576, 5592405)
    # 2796203 / 2^23 * 2.5 V / 5e-5 V/nT
    assert reading.field == pytest.approx((16666.668653, -6250.0, 33333.331347), abs=1e-6)
    assert (reading.sequence, reading.power_cycle, reading.saturated) == (7, 3, False)
    assert reading.device_time == pytest.approx(1.0)
    assert reading.channel_delay == pytest.approx((0.0, 0.1, 0.2))
    assert (reading.temperature, reading.supply) == pytest.approx((4.25, 3.712))


def test_gain_and_reference_scale_the_field() -> None:
    (plain,), (other,) = read(EXAMPLE), read(EXAMPLE, reference_voltage=5.0, gain=4.0)
    assert other.field == pytest.approx([value / 2 for value in plain.field])
    assert other.counts == plain.counts


def test_every_damaged_bit_is_seen() -> None:
    driver = open_driver("digitizer", OPTIONS)
    for bit in range(8 * (len(EXAMPLE) - 1)):
        frame = bytearray(EXAMPLE)
        frame[bit // 8] ^= 1 << bit % 8
        assert driver.feed(bytes(frame)) == []
    assert driver.frames_bad >= 8 * (len(EXAMPLE) - 1)
    assert len(driver.feed(EXAMPLE)) == 1


def test_channels_sampled_across_the_wrap_of_the_clock() -> None:
    times = (2**32 - 50_000).to_bytes(4, "little") + (50_000).to_bytes(4, "little")
    (reading,) = read(framed(MESSAGE[:6] + times + (2**32 - 60_000).to_bytes(4, "little") + MESSAGE[18:]))
    assert reading.channel_delay == pytest.approx((0.0, 0.1, -0.01))


@pytest.mark.parametrize("counts", ["FFFF7F", "000080"])
def test_the_ends_of_the_converter_saturate(counts: str) -> None:
    (reading,) = read(framed(MESSAGE[:-3] + bytes.fromhex(counts)))
    assert reading.saturated


def test_overload_and_the_fluxgate_s_own_range_saturate() -> None:
    assert read(framed(MESSAGE[:22] + b"\x02" + MESSAGE[23:]))[0].saturated
    assert read(EXAMPLE, full_scale=33_000.0)[0].saturated
    driver = open_driver("digitizer", OPTIONS | {"full_scale": 40_000.0})
    assert driver.range_nt == pytest.approx(40_000.0, abs=0.01)
    assert not driver.feed(EXAMPLE)[0].saturated


def test_unknown_temperature_and_supply_are_nan() -> None:
    (reading,) = read(framed(MESSAGE[:18] + bytes.fromhex("0080FFFF") + MESSAGE[22:]))
    assert isnan(reading.temperature)
    assert isnan(reading.supply)


def test_later_firmware_may_say_more() -> None:
    longer = bytes([1, 40]) + MESSAGE[2:] + b"more"
    status = bytes([2, 12]) + b"status"
    driver = open_driver("digitizer", OPTIONS)
    (reading,) = driver.feed(framed(longer) + framed(status + bytes(24))[:-1] + b"\0")
    assert reading.sequence == 7
    assert driver.frames_bad == 1  # the status says 12 bytes and has 36
    assert driver.feed(framed(bytes([2, 36]) + bytes(30))) == []
    assert driver.frames_bad == 1


@pytest.mark.parametrize("value", [float("inf"), 5e-324, 1e308])
@pytest.mark.parametrize("option", ["full_scale", "reference_voltage", "gain", "sensitivity"])
def test_options_without_finite_counts_are_refused(option: str, value: float) -> None:
    with pytest.raises(MagbridgeError, match=option):
        open_driver("digitizer", OPTIONS | {option: value})


# ---- the HMR2300's outputs, and finding the frame in a stream whose delimiter may be data ------------------


def frame(x: int, y: int, z: int) -> bytes:
    return pack(">hhh", x, y, z) + b"\r"


def test_the_data_sheet_s_values() -> None:
    driver = open_driver("hmr2300", {})
    hexes = ("7530 57E4 3A98", "1D4C 0000 E2B4", "C568 A81C 8AD0", "1D4C 0000 E2B4", "1D4C 0000 E2B4")
    readings = driver.feed(b"".join(bytes.fromhex(text) + b"\r" for text in hexes))
    counts = [reading.counts for reading in readings[:3]]
    assert counts == [(30_000, 22_500, 15_000), (7_500, 0, -7_500), (-15_000, -22_500, -30_000)]
    assert readings[0].field == pytest.approx((200_000.0, 150_000.0, 100_000.0))
    assert [reading.saturated for reading in readings] == [True, False, True, False, False]


def test_ascii_lines() -> None:
    driver = open_driver("hmr2300", {"output": "ascii"})
    lines = (
        b"ASCII ON\r",
        b" 15,000  - 7,500        0  \r",
        b"-30,000    1,234  -    56  \r",
        b" 1x,000    1,234  -    56  \r",
        b" 15,000  - 7,500        0\r",
    )
    readings = driver.feed(b"".join(lines))
    counts = [reading.counts for reading in readings]
    assert counts == [(15_000, -7_500, 0), (-30_000, 1_234, -56), (15_000, -7_500, 0)]
    assert driver.frames_bad == 1


def test_start_up_commands() -> None:
    commands = b"\x1b", b"*99WE\r", b"*99B\r", b"*99WE\r", b"*99R=100\r", b"*99C\r"
    assert open_driver("hmr2300", {"rate": 100}).start() == commands
    assert open_driver("hmr2300", {"output": "ascii", "device": 7}).start()[2] == b"*07A\r"
    assert open_driver("hmr2300", {"rate": 100}).period == 0.01


@pytest.mark.parametrize("cut", range(7))
@pytest.mark.parametrize("high", [0, 1, 2])
def test_a_steady_0d_in_the_data_does_not_mislead(cut: int, high: int) -> None:
    # 0x0D as a high byte that never changes is just as periodic as the terminator
    driver = open_driver("hmr2300", {})
    sent = []
    for k in range(50):
        counts = [4000 + 3 * k, -2000 - 5 * k, 9000 + (k * 7919) % 13]
        counts[high] = 0x0D00 + (k * 104_729) % 200
        sent.append(tuple(counts))
    data = b"".join(frame(*counts) for counts in sent)[cut:]
    assert [reading.counts for reading in driver.feed(data)] == sent[1 if cut else 0 :]


def test_a_lost_byte_costs_one_reading() -> None:
    random = Random(1)
    sent = [(3000, -1500, 8000)]
    for _ in range(60):
        sent.append(tuple(value + random.randint(-30, 30) for value in sent[-1]))  # type: ignore[arg-type]
    stream = b"".join(frame(*one) for one in sent)
    for at in range(7 * 4, len(stream) - 7 * 6):
        driver = open_driver("hmr2300", {})
        got = [reading.counts for reading in driver.feed(stream[:at] + stream[at + 1 :])]
        # a byte lost that happens to leave a carriage return in its place makes one reading wrong instead
        assert len(set(sent) - set(got)) <= 2
        assert len(set(got) - set(sent)) <= 1
        assert driver.frames_bad == 1


def test_replies_before_the_stream_are_skipped() -> None:
    driver = open_driver("hmr2300", {})
    replies = b"OK\rBINARY ON\rOK\r"
    frames = b"".join(frame(100 + k, 200 - k, 300) for k in range(10))
    assert len(driver.feed(replies + frames)) == 10
    assert driver.bytes_skipped == len(replies)


def test_halves_of_two_frames_give_no_reading() -> None:
    """The line was pulled out after three bytes of a frame, and opened again before the last four of one."""
    driver = open_driver("hmr2300", {})
    before, after = frame(1000, 2000, 3000), frame(-9000, -8000, -7000)
    driver.feed(before * 6 + before[:3])
    driver.start()
    assert [reading.counts for reading in driver.feed(after[3:] + after * 6)] == [(-9000, -8000, -7000)] * 6
    assert driver.bytes_skipped == 7
