"""Test an autopilot that appears, disappears and reboots, several autopilots, and its clock."""

import random
from collections.abc import Iterable
from itertools import count
from math import isnan

import pytest
from line import Line

from magbridge.link.vehicle import VehicleClock
from magbridge.mavlink import Codec, spec

START = 1_700_000_000_000_000


def test_found_vanished_found(link: Line) -> None:
    beat = {"type": 12, "autopilot": 3}
    assert link.texts(link.fly("HEARTBEAT", **beat)) == ["autopilot 1:1 found"]
    assert link.texts(link.to(4)) == []
    assert link.texts(link.fly("HEARTBEAT", **beat)) == []
    assert link.texts(link.to(8.9)) == []
    assert link.texts(link.to(9.1)) == ["autopilot 1:1 is silent"]
    assert link.texts(link.to(60)) == []
    assert link.texts(link.fly("HEARTBEAT", **beat)) == ["autopilot 1:1 found"]


def boots(link: Line, codec: Codec, times: Iterable[int]) -> list[str]:
    texts = []
    for i, boot_ms in enumerate(times):
        texts += link.texts(link.to(1 + i * 0.1))
        texts += link.texts(link.give(codec.pack("ATTITUDE", time_boot_ms=boot_ms)))
    return texts


END = (1 << 32) - 1000
BURST = (500_000, 500_010, 500_020, 500_030, 3_000, 3_010, 3_020, 3_030)
REBOOTED, TWO = ["autopilot 1:1 rebooted"], ["two autopilots send as 1:1"]


@pytest.mark.parametrize(
    ("times", "texts", "reboots"),
    [
        ([*range(100_000, 101_000, 100), *range(500, 1500, 100)], REBOOTED, 1),
        ([*range(3000, 8000, 500), *range(500, 3000, 500)], REBOOTED, 1),
        ([END + k for k in (0, 100, 100, -20_000, 200, -100, 300)] + [*range(0, 1000, 100)], [], 0),
        ([boot + 200 * i for i in range(20) for boot in (500_000, 3_000)], TWO, 0),
    ],
    ids=["reboot", "soon after a boot", "late, repeated, wrapped", "two autopilots"],
)
def test_a_reboot_is_distinguished_from_late_messages_and_from_two_autopilots(
    link: Line, times: list[int], texts: list[str], reboots: int
) -> None:
    assert boots(link, link.autopilot, times) == texts
    assert link.component.vehicle.reboots == reboots


def test_two_autopilots_in_bursts(link: Line) -> None:
    times = [boot + 100 * i for i in range(12) for boot in BURST]
    assert boots(link, link.autopilot, times) == [*REBOOTED, *TWO]


@pytest.mark.parametrize("interval", [5, 50])
@pytest.mark.parametrize("other_ms", [-40_000, 20_000, 5_000_000, 1_764_000_000_000])
@pytest.mark.parametrize("burst", [1, 4])
def test_a_second_clock_causes_no_reboots(link: Line, interval: int, other_ms: int, burst: int) -> None:
    """Attitudes at 10 Hz, and in each `interval` some named values with the time of another clock."""
    texts = []
    for i in range(600):
        texts += link.texts(link.to(1 + i * 0.1))
        now_ms = 1_000_000 + 100 * i
        texts += link.texts(link.fly("ATTITUDE", time_boot_ms=now_ms))
        if i % interval == 0:
            stamp = {"time_boot_ms": (now_ms + other_ms) % (1 << 32)}
            texts += link.texts(link.give(link.autopilot.pack("NAMED_VALUE_FLOAT", **stamp) * burst))
    reboots = link.component.vehicle.reboots
    is_behind = other_ms % (1 << 32) > 1 << 31
    assert reboots <= (is_behind and burst > 1)  # the first time, it looks like a reboot
    assert texts == REBOOTED * reboots + TWO * (interval == 5)
    texts = []
    for i in range(10):  # the autopilot reboots
        texts += link.texts(link.to(62 + i * 0.1))
        texts += link.texts(link.fly("ATTITUDE", time_boot_ms=1000 + 100 * i))
    assert texts == REBOOTED


def test_telemetry_that_is_sent_long_after_it_was_stamped_is_not_a_reboot(link: Line) -> None:
    """Three positions at once, 1.5 s old, as from a controller that sends them on; attitudes are fresh."""
    link.fly("TIMESYNC", tc1=50_000_000_000, ts1=link.only(link.to(0.6), "TIMESYNC")[0].ts1)
    texts = []
    for i in range(100):
        texts += link.texts(link.to(1 + i * 0.1))
        texts += link.texts(link.fly("ATTITUDE", time_boot_ms=50_000 + 100 * i))
        if i % 5 == 0:
            late = link.autopilot.pack("NAMED_VALUE_FLOAT", time_boot_ms=48_500 + 100 * i, value=0.5)
            texts += link.texts(link.give(late * 3))
    assert texts == []
    assert link.component.vehicle.reboots == 0
    assert link.component.vehicle.clock.known


def test_a_ground_station_is_not_a_vehicle(link: Line) -> None:
    assert link.texts(link.send_message("heartbeat", 6, 8, 0, 0, 0, 3)) == []


@pytest.mark.parametrize(
    ("order", "lost"),
    [
        ([*range(100), *range(107, 410), *range(405, 600)], 7),
        (
            [four + i for four in range(0, 400, 4) for i in (2, 0, 3, 1) if four + i not in (0, 1, 101, 203)],
            2,
        ),
    ],
    ids=["lost and repeated", "late"],
)
def test_lost_frames_are_counted(link: Line, order: list[int], lost: int) -> None:
    frames = [link.autopilot.pack("ATTITUDE", time_boot_ms=i) for i in range(600)]
    link.give(b"".join(frames[i] for i in order))
    assert link.component.vehicle.frames_lost == lost


def test_whose_frames_are_lost_is_reported(link: Line) -> None:
    """One report for each component and occurrence, and another when it occurs again."""
    payload, tenths = Codec(1, 25), count((link.now - START) // 100_000 + 1)

    def ten_seconds(lost: int) -> list[str]:
        texts = []
        for k in range(100):
            frame = payload.pack("NAMED_VALUE_FLOAT", name="battpos", value=k)
            texts += link.texts(link.give(link.autopilot.pack("ATTITUDE") + (frame if k >= lost else b"")))
            texts += link.texts(link.to(0.1 * next(tenths)))
        return [text for text in texts if "frames missing" in text]

    reported = ["1:25: over 1% of its frames missing, or for others"]
    reports = [ten_seconds(lost) for lost in (0, 2, 3, 20, 1, 0, 5, 0)]
    assert reports == [[], [], reported, [], [], [], reported, []]
    assert link.component.vehicle.frames_lost == 0, "the autopilot's"


def exchange(
    clock: VehicleClock,
    rng: random.Random,
    now_us: int,
    offset_us: float,
    slow: float = 300.0,
    drift_ppm: float = 0.0,
    queue_us: float = 0.0,
) -> None:
    """Update the clock with a request and its reply over a link with a random delay each way.

    `queue_us`: further delay of the request.
    """
    there, back = (slow + rng.expovariate(1 / 2000) for _ in range(2))
    there += queue_us
    asked = clock.ask(now_us)
    vehicle_us = now_us + there + offset_us + drift_ppm * 1e-6 * (now_us - START)
    clock.answer(round(vehicle_us * 1000), asked, round(now_us + there + back))


@pytest.mark.parametrize("drift_ppm", [0.0, 40.0, -100.0])
def test_offset_through_jitter(drift_ppm: float) -> None:
    rng, clock, offset = random.Random(4), VehicleClock(), -START + 5_000_000
    errors = []
    for i in range(300):
        now = START + i * 1_000_000
        exchange(clock, rng, now, offset, drift_ppm=drift_ppm)
        if i >= 10:
            errors.append(clock.offset_us(now) - offset - drift_ppm * i)
    errors.sort(key=abs)
    assert abs(errors[len(errors) // 2]) < 300  # us; a single exchange is wrong by 1400 (median)
    assert abs(errors[-1]) < 3000
    assert abs(clock.drift_ppm - drift_ppm) < 30
    assert clock.sigma < 1e-3


@pytest.mark.parametrize("fast", [60, 0])
def test_a_link_that_is_slow_one_way_for_minutes(fast: int) -> None:
    """A full radio delays requests by up to 1.5 s: the earlier fast exchanges hold, and sigma is honest."""
    rng, clock, offset, drift_ppm = random.Random(4), VehicleClock(), 3_000_000, 20.0
    errors, normalised = [], []
    for i in range(500):
        now = START + 1_000_000 * i
        exchange(clock, rng, now, offset, 300.0, drift_ppm, rng.uniform(3e5, 1.5e6) if i >= fast else 0.0)
        if i >= 30:
            errors.append(abs(clock.offset_us(now) - offset - drift_ppm * i))
            normalised.append(errors[-1] * 1e-6 / clock.sigma)
    assert max(errors) < (5_000 if fast else 500_000)
    assert max(normalised) < 4.0


def test_foreign_and_old_answers_are_ignored() -> None:
    clock = VehicleClock()
    clock.ask(START)
    clock.answer(5, 77, START + 10)
    assert not clock.known
    assert isnan(clock.sigma)
    for i in range(20):
        clock.ask(START + i)
    clock.answer(5, START * 1000, START + 100)
    assert not clock.known


def test_reboot_resets_the_clock(link: Line) -> None:
    for i in range(5):
        for message in link.only(link.to(1 + i), "TIMESYNC"):
            link.fly("TIMESYNC", ts1=message.ts1, tc1=(50 + i) * 10**9)
    assert link.component.vehicle.clock.known
    boots(link, link.autopilot, [100_000, 100, 200, 300])
    assert not link.component.vehicle.clock.known


@pytest.mark.parametrize("now", [12_000_000, 6_700_000])
def test_a_clock_that_was_set_is_learned_again_at_once(now: int) -> None:
    rng, clock = random.Random(4), VehicleClock()
    for i in range(10):
        exchange(clock, rng, START + i * 1_000_000, 7_000_000)
    exchange(clock, rng, START + 10_000_000, now)
    assert clock.offset_us(START + 10_000_000) == pytest.approx(now, abs=20_000)
    exchange(clock, rng, START + 11_000_000, now, slow=300_000.0)  # a slow one does not count as a step
    assert clock.offset_us(START + 11_000_000) == pytest.approx(now, abs=20_000)


def test_a_contradiction_within_the_stated_error_does_not_reset_the_clock() -> None:
    """Slow exchanges leave 0.3 s of uncertainty; one that differs by little more than its half trip stays."""
    clock = VehicleClock()
    for i, late in enumerate([0, 0, 0, 0, 1_300_000]):
        now = START + i * 1_000_000
        asked = clock.ask(now)
        clock.answer(1000 * (now + 7_000_000 + 250_000 + late), asked, now + 500_000 + late // 2)
    assert len(clock._exchanges) == 5


def test_frames_of_unknown_messages_are_not_lost(link: Line) -> None:
    """An autopilot sends messages that the dialect lacks; they count as received."""
    autopilot = Codec(1, 1)
    beat = spec("HEARTBEAT")
    for second in range(40):
        frames = [autopilot.frame(beat, beat.payload(type=1, autopilot=12)) for _ in range(19)]
        unknown = bytearray(autopilot.frame(beat, beat.payload(type=1)))
        unknown[7:10] = (59_000).to_bytes(3, "little")
        for frame in (*frames[:9], bytes(unknown), *frames[9:]):
            link.give(frame)
        link.to(second + 1.0)
    assert not any("frames missing" in text for _, text in link.component.output.texts)
