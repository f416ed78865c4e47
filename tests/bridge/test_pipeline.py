"""Test a bridge without ports: its log after a restart, its input values, and its log corrected again."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from math import cos, inf, isfinite, isnan, nan, pi, sin
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from fed import fed, logged, named, received, texts
from small import START, small_bridge

from magbridge import logs
from magbridge.bridge.events import Event, HostClock, StartEvent, clock_step, standstill
from magbridge.bridge.pipeline import Pipeline
from magbridge.bridge.run import SAVE_US, Keeper
from magbridge.bridge.run import load_state as kept
from magbridge.calibration.file import load as load_calibration
from magbridge.calibration.model import Parameter
from magbridge.columns import CORRECTED
from magbridge.config import Align, load
from magbridge.correction import Correction
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import Codec, Message
from magbridge.mavlink.enums import MAV_PARAM_TYPE
from magbridge.records import Channel, Quality
from magbridge.rows import correct_rows
from sitl.replay.own_log import Recorded, is_own_log, runs
from sitl.replay.run import agreement, summary

BOOT = START - 77_000_000


def events(pipeline: Pipeline, begin: int, end: int) -> Iterator[Event]:
    """Yield events: 20 samples/s, 30 ms old on arrival, and telemetry of a moving mass at 5 Hz."""
    autopilot = Codec(1, 1)
    for k in range(begin, end):
        t_us = START + 50_000 * k
        turn = 2 * pi * k / 400
        line = f"{20_000 * cos(turn):.2f} {20_000 * sin(turn):.2f} 45000 4.0 {(50 * k - 30) / 1e3} {k}\n"
        yield Event(t_us, Channel.SENSOR, line.encode())
        if k % 4 == 0:
            battpos = {"time_boot_ms": (t_us - BOOT) // 1000 - 25, "value": sin(k / 90), "name": "battpos"}
            yield Event(t_us + 4_000, Channel.LINK, autopilot.pack("NAMED_VALUE_FLOAT", **battpos))
        clock = pipeline.component.vehicle.clock
        while asked := [ts1 for ts1 in clock._asked if ts1 // 1000 > t_us - 50_000]:
            answer = {"tc1": (t_us + 5_000 - BOOT) * 1000, "ts1": asked[0]}
            yield Event(t_us + 8_000, Channel.LINK, autopilot.pack("TIMESYNC", **answer))


def test_a_log_after_a_loss_is_replayed_as_far_as_it_can_be(tmp_path: Path) -> None:
    pipeline = small_bridge(tmp_path, start=StartEvent(START, {"MB_GAP_FACTOR": 2.0}))
    folder, aside = tmp_path / "logs", tmp_path / "aside"
    now = {"MB_GAP_FACTOR": 3.0}
    with closing(TlogWriter(folder, beginning=pipeline.beginning(now), max_size=0.05)) as log:

        def play(begin: int, end: int) -> None:
            for event in events(pipeline, begin, end):
                pipeline.feed(event)
                log.extend(pipeline.recorder.drain())
            while log.records + log.lost < pipeline.recorder.count:
                time.sleep(0.002)

        play(0, 400)
        whole = sorted(folder.iterdir())
        folder.rename(aside)
        folder.write_text("no folder")
        play(400, 800)
        folder.unlink()
        aside.rename(folder)
        play(800, 1600)
    assert log.lost
    files = sorted(folder.iterdir())
    first, second = runs(files)
    assert is_own_log(second[0])
    assert first[: len(whole)] == whole

    recorded = Recorded(second)
    assert recorded.start.parameters == now
    assert 15.0 < recorded.late < 45.0
    again = small_bridge(tmp_path, start=recorded.start)
    published = bytearray(b"".join(f for event in recorded.events() for _, f in again.feed(event)))
    result = agreement(published, recorded)
    assert result["samples"] > 500
    assert result["same_samples"] > 0.9 * result["samples"]
    assert agreement(published, Recorded(first)) == {"late_s": 0.0}
    more = {"files": second, "messages": recorded.messages, "bytes": 1, "seconds": 1.0, "same_config": True}
    more |= {"identical": False, "is_cut": False, "first_difference": 0, "beyond": 0, "damages": 0}
    words = summary({"runs": [result | more]})
    assert f"begins {recorded.late:.1f} s into the run" in words


# ---- Parameters set over the link are kept on the disk, which the sensor must not wait for too often -----


def test_a_flood_of_parameters_is_kept_once_a_second(tmp_path: Path) -> None:
    pipeline = small_bridge(tmp_path, [])
    keeper, file = Keeper(load(tmp_path / "bridge.toml")), tmp_path / "bridge.parameters.json"
    values = [2.0 + 0.125 * k for k in range(10)]
    on_disk = []
    for k, value in enumerate(values):
        assert pipeline.component.parameters.set("MB_GAP_FACTOR", value)
        keeper.save_changes(pipeline, START + k * SAVE_US // 5)
        on_disk.append(kept(file).parameters["MB_GAP_FACTOR"])
    assert on_disk == 5 * [values[0]] + 5 * [values[5]]
    keeper.save_changes(pipeline, START + 2 * SAVE_US)
    assert kept(file).parameters["MB_GAP_FACTOR"] == values[-1]


# ---- No number that a sensor or an autopilot may say stops the bridge, or comes out as a good sample -----


WILD = ("1e300", "-1e39", "1e20", "99999999999999999999", "3e9", "-32768", "0", "1e-320", "nan", "inf", "x")
DOUBTFUL = int(Quality.STALE_TELEMETRY | Quality.EXTRAPOLATED | Quality.MOVING)
BATTERY = Parameter("battpos", "", -0.4, 0.6, 0.1, 0.5)
TELEMETRY = (-9999.0, 65535.0, 1e9, 1e15, 3.4e38, -3.4e38, nan, inf)


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    published = ["MAG_RAW", "MAG_FIELD", "HIGHRES_IMU", "NAMED_VALUE_FLOAT", "DEBUG_VECT"]
    return small_bridge(tmp_path, published, battery=BATTERY)


@pytest.mark.parametrize("column", range(6))
def test_in_a_line_of_the_sensor(pipeline: Pipeline, column: int) -> None:
    battery = Codec(1, 1).pack("NAMED_VALUE_FLOAT", name="battpos", value=0.1)
    pipeline.feed(Event(START, Channel.LINK, battery))
    for k, wild in enumerate((*WILD, None)):
        words = ["20000", "-100", "40000", "4", str(0.1 * k), str(k)]
        words[column] = wild or words[column]
        line = f"{' '.join(words)}\n".encode()
        sent = fields(pipeline.feed(Event(START + 100_000 * (k + 1), Channel.SENSOR, line)))
        for one in sent:
            assert one["total_field_sigma"] >= 1.0
    assert len(sent) == 1  # the last line was a good one
    assert sent[0]["total_field_sigma"] < 1e4


@pytest.mark.parametrize("value", TELEMETRY)
def test_in_the_telemetry(pipeline: Pipeline, value: float) -> None:
    autopilot = Codec(1, 1)
    for k, battery in enumerate((0.1, value, value, 0.1, value, 0.1, 0.1)):
        at_us = START + 1_000_000 * k
        frame = autopilot.pack("NAMED_VALUE_FLOAT", name="battpos", value=battery)
        pipeline.feed(Event(at_us, Channel.LINK, frame))
        line = f"20000 -100 40000 4 {k} {k}\n".encode()
        (one,) = fields(pipeline.feed(Event(at_us + 4, Channel.SENSOR, line)))
        if isnan(one["total_field"]) or battery != 0.1:
            assert one["flags"] & DOUBTFUL
            assert one["total_field_sigma"] > 1e3 or not isfinite(value)  # then the last value holds a while
        assert one["total_field_sigma"] >= 1.0


def fields(sent: list[tuple[int, bytes]]) -> list[Message]:
    """Return each sent MAG_FIELD."""
    return named(received(sent), "MAG_FIELD")


def test_of_a_host_whose_clock_was_never_set(tmp_path: Path) -> None:
    """The clock begins in 1970, and a filter's delay leads to earlier times: one message, no main field."""
    published = ["MAG_RAW", "MAG_FIELD", "HIGHRES_IMU", "DEBUG_VECT"]
    pipeline = small_bridge(tmp_path, published, StartEvent(0), BATTERY)
    settings = Align(filter_delay=0.5)
    pipeline._correction.aligner.tune(settings, {})
    autopilot = Codec(1, 1)
    sent: list[tuple[int, bytes]] = []
    for k in range(20):
        frame = autopilot.pack("NAMED_VALUE_FLOAT", name="battpos", value=0.1)
        frame += autopilot.pack("GLOBAL_POSITION_INT", lat=495_000_000, lon=-579_000_000)
        sent += pipeline.feed(Event(100_000 * k, Channel.LINK, frame))
        line = f"20000 -100 40000 4 {0.1 * k:.1f} {k}\n".encode()
        sent += pipeline.feed(Event(100_000 * k + 4, Channel.SENSOR, line))
    samples = fields(sent)
    assert [one["time_usec"] for one in samples[:3]] == [0, 0, 0]
    assert all(isnan(one["anomaly"]) for one in samples)
    assert [text for text in texts(received(sent)) if "clock" in text] == [
        "host clock was never set: no date, no main field"
    ]
    step = clock_step(3_000_000, START)
    set_it, later = Event(3_000_000, Channel.STATE, step), Event(4_000_000, Channel.STATE, b"")
    assert "host clock is set" in texts(fed(pipeline, set_it, later))


# ---- the one clock, made of the host's two -----------------------------------------------------------------


LOOKS = """
from magbridge.bridge.events import HostClock
clock = HostClock()
print("begun", flush=True)
end_us = clock.now_us() + 2_300_000
steps = []
while clock.now_us() < end_us:
    if step := clock.step_us():
        steps.append(step)
print(steps)
"""


def test_a_process_that_is_held_up_tells_no_step() -> None:
    """Pause the process repeatedly for longer than the threshold, at random points of its clock readings."""
    with subprocess.Popen([sys.executable, "-c", LOOKS], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stdout.readline() == "begun\n"
        for _ in range(25):
            os.kill(process.pid, signal.SIGSTOP)
            time.sleep(1.4e-6 * HostClock.THRESHOLD_US)
            os.kill(process.pid, signal.SIGCONT)
            time.sleep(0.005)
        assert process.stdout.readline() == "[]\n"


@pytest.mark.parametrize("held", ["before", "after"])
def test_a_process_that_is_stopped_near_a_look_at_utc(monkeypatch: pytest.MonkeyPatch, held: str) -> None:
    clock, host, offset_us = HostClock(), time.time_ns, [0]
    waits = [1.4e-6 * HostClock.THRESHOLD_US, 0.0]

    def slow() -> int:
        wait = waits.pop(0) if waits else 0.0
        if held == "before":
            time.sleep(wait)
        utc = host() + 1000 * offset_us[0]
        if held == "after":
            time.sleep(wait)
        return utc

    for offset_us[0], expected in ((0, 0), (-3_600_000_000, -3_600_000_000), (-3_600_000_000, 0)):
        waits[:] = [1.4e-6 * HostClock.THRESHOLD_US, 0.0]
        monkeypatch.setattr(time, "time_ns", slow)
        assert clock.step_us() == pytest.approx(expected, abs=HostClock.AT_ONCE_US)
        assert not waits
        monkeypatch.undo()


@pytest.mark.parametrize("silence_s", [0, 8])
def test_an_overloaded_bridge_omits_only_optional_work(tmp_path: Path, silence_s: int) -> None:
    """Passes of the event loop that last 1 s each; the omitted messages depend only on the log.

    The overload ends while all ports are silent, or while they send.
    """

    def overloaded(pipeline: Pipeline) -> Iterator[Event]:
        for second in range(40):
            if 10 <= second < 20:
                stalled_us = START + 1_000_000 * second
                yield Event(stalled_us, Channel.STATE, standstill(stalled_us, 900_000))
            if 20 <= second < 20 + silence_s:
                for k in range(20 * second, 20 * second + 20):
                    yield Event(START + 50_000 * k, Channel.STATE, b"")
            else:
                yield from events(pipeline, 20 * second, 20 * (second + 1))

    messages = ["MAG_FIELD", "HIGHRES_IMU"]
    pipeline = small_bridge(tmp_path, messages)
    sent = logged(pipeline, overloaded(pipeline), tmp_path / "logs")
    came = received(sent)
    told = [text.partition(":")[0] for text in texts(came) if "overload" in text]
    assert told == ["overload", "overload is over"]
    assert len(named(came, "MAG_FIELD")) == 800 - 20 * silence_s
    # from the 4th stall to 5 s after the last one, a message is sent with every 4th sample
    omitted = len(named(came, "MAG_FIELD")) - len(named(came, "HIGHRES_IMU"))
    assert omitted == pytest.approx(15 * (7 if silence_s else 11), abs=5)
    recorded = Recorded(sorted((tmp_path / "logs").iterdir()))
    again = small_bridge(tmp_path, messages, recorded.start)
    assert [frame for event in recorded.events() for frame in again.feed(event)] == sent


# ---- magbridge correct on the bridge's own log gives the published field, sigmas and flags -----------------


KEPT = {"MB_AGE_BATTPOS": 3.0, "MB_SETTLE_TIME": 4.0, "MB_STALE_GROW": 20.0}
"""Parameters that an earlier run set over the link."""


def second(k: int, *frames: bytes) -> Iterator[Event]:
    """Yield the events of second `k`: frames of the link 0.4 s before a reading."""
    for frame in frames:
        yield Event(START + k * 1_000_000 - 400_000, Channel.LINK, frame)
    yield Event(START + k * 1_000_000, Channel.SENSOR, b"12340.5 43210.9 -234.5 4.0 %d 7\r\n" % k)


def battery(position: float) -> bytes:
    return Codec(1, 1).pack("NAMED_VALUE_FLOAT", name="battpos", value=position)


@pytest.mark.parametrize("suffix", ["nc", "csv", "tlog"])
def test_what_was_set_in_the_course_of_the_log_is_reported(
    tmp_path: Path, suffix: str, command: Command
) -> None:
    """The correction repeats neither rejected values nor the rate of a message."""
    station, log = Codec(1, 1), tmp_path / f"converted.{suffix}"
    asked = {10: ("MB_SETTLE_TIME", 4.0), 20: ("MB_SETTLE_TIME", -1.0), 30: ("MB_R_HIGHRES_IMU", 1.0)}
    to = {"target_system": 1, "target_component": 191, "param_type": MAV_PARAM_TYPE.REAL32}

    def events() -> Iterator[Event]:
        for k in range(40):
            sets = [asked[k]] if k in asked else []
            frames = [station.pack("PARAM_SET", param_id=n, param_value=v, **to) for n, v in sets]
            yield from second(k, *frames)

    logged(small_bridge(tmp_path), events(), tmp_path / "logs")
    logs.write(logs.read(sorted((tmp_path / "logs").iterdir())), log)
    reported = command("correct", log, "--calibration", "cal.json", "-o", "out.nc").err
    assert "MB_* parameters were set once in the course of the log" in reported


@pytest.mark.parametrize(("suffix", "precision"), [("nc", 1e-7), ("csv", 1e-7), ("tlog", 1e-6)])
def test_flags_and_sigmas_are_those_of_the_bridge(tmp_path: Path, suffix: str, precision: float) -> None:
    """Telemetry arrives every few seconds, is missing for a minute once, and is unknown once.

    Between reports that are farther apart than ``max_age`` (8 s), only the correction knows the next one.
    """
    rng = np.random.default_rng(1)

    def events() -> Iterator[Event]:
        for k in range(400):
            position = np.nan if 300 <= k < 310 else 0.1 * (k // 50)
            is_sent = rng.random() < 0.4 and not 200 <= k < 260
            yield from second(k, *([battery(position)] if is_sent else []))

    start = StartEvent(START, KEPT | {"MB_AGE_BATTPOS": 8.0})
    logged(small_bridge(tmp_path, start=start), events(), tmp_path / "logs")
    rows = logs.read(sorted((tmp_path / "logs").iterdir()))
    logs.write(rows, tmp_path / f"converted.{suffix}")
    converted = logs.read(tmp_path / f"converted.{suffix}")
    again = correct_rows(Correction(load_calibration(tmp_path / "cal.json")), converted)
    seen = {flag for flag in Quality for quality in rows["quality"].to_numpy() if int(quality) & flag}
    assert {Quality.STALE_TELEMETRY, Quality.MOVING} <= seen
    reported = (converted["time"] - converted["age_battpos"]).to_numpy()
    reported = np.maximum.accumulate(np.nan_to_num(reported))
    following = np.append(reported, np.inf)[np.searchsorted(reported, reported + 0.1)]
    known = following - reported < 7.9
    assert 0.6 < known.mean() < 0.9
    for name in set(CORRECTED) - {"anomaly", "quality"}:
        # after the minute, the bridge's sigma contains a jump
        same = known & (np.arange(400) < (200 if "sigma" in name else 400))
        np.testing.assert_allclose(again[name][same], rows[name][same], rtol=precision, err_msg=name)
    before, after = (one["quality"].to_numpy().astype(int)[known] for one in (rows, again))
    more = before != after
    assert (after[more] == before[more] + Quality.MOVING).all()
    assert (before[np.flatnonzero(more) + 1] & Quality.MOVING != 0).all()
    # the last sample before each of seven motions, but where both are of one time
    assert 3 <= more.sum() <= 7


def test_what_a_bridge_has_flagged_as_late_stays_so(tmp_path: Path) -> None:
    """The rows of a log do not show that the bridge paused for 5 s while the mass moved."""

    def events() -> Iterator[Event]:
        for k in range(20):
            if k == 10:
                stall = standstill(START + k * 1_000_000, 5_000_000)
                yield Event(START + k * 1_000_000 - 400_000, Channel.STATE, stall)
            yield from second(k, battery(0.9 if k >= 10 else 0.0))

    logged(small_bridge(tmp_path), events(), tmp_path / "logs")
    rows = logs.read(sorted((tmp_path / "logs").iterdir()))
    again = correct_rows(Correction(load_calibration(tmp_path / "cal.json")), rows)
    late = rows["quality"].to_numpy().astype(int) & Quality.LATE_JOIN != 0
    assert late.any()
    assert ((again["quality"].to_numpy().astype(int) & Quality.LATE_JOIN != 0) == late).all()
    assert (again["total_field_sigma"].to_numpy()[late] >= rows["total_field_sigma"].to_numpy()[late]).all()
