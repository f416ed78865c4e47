"""The HMR2300's outputs, and finding the frame in a stream whose delimiter may be data."""

from __future__ import annotations

from random import Random
from struct import pack

import pytest

from magbridge.sensors import open_driver


def frame(x: int, y: int, z: int) -> bytes:
    return pack(">hhh", x, y, z) + b"\r"


def test_the_data_sheet_s_values() -> None:
    driver = open_driver("hmr2300", {})
    hexes = ("7530 57E4 3A98", "1D4C 0000 E2B4", "C568 A81C 8AD0", "1D4C 0000 E2B4", "1D4C 0000 E2B4")
    readings = driver.feed(b"".join(bytes.fromhex(text) + b"\r" for text in hexes))
    assert [reading.counts for reading in readings[:3]] == [
        (30_000, 22_500, 15_000),
        (7_500, 0, -7_500),
        (-15_000, -22_500, -30_000),
    ]
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
    assert [reading.counts for reading in readings] == [
        (15_000, -7_500, 0),
        (-30_000, 1_234, -56),
        (15_000, -7_500, 0),
    ]
    assert driver.frames_bad == 1


def test_start_up_commands() -> None:
    assert open_driver("hmr2300", {"rate": 100}).start() == (
        b"\x1b",
        b"*99WE\r",
        b"*99B\r",
        b"*99WE\r",
        b"*99R=100\r",
        b"*99C\r",
    )
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
