"""A log in several files: it replays as one; after a loss its replay reports the missing part."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from math import cos, pi, sin
from pathlib import Path

from small import START, small_bridge

from magbridge.bridge.events import Event, StartEvent, declarations
from magbridge.bridge.pipeline import Pipeline
from magbridge.calibration.model import Parameter
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import Codec
from magbridge.records import Channel
from sitl.replay.own_log import Recorded, is_own_log, runs
from sitl.replay.run import agreement
from sitl.replay.summary import summary

BOOT = START - 77_000_000


def bridge(folder: Path, start: StartEvent) -> Pipeline:
    return small_bridge(folder, start, Parameter("battpos", "", -1.0, 1.0, 0.0, 1.0), ["MAG_FIELD"])


def events(pipeline: Pipeline, begin: int, end: int) -> Iterator[Event]:
    """20 samples/s, each 30 ms old on arrival; a mass that always moves, told at 5 Hz by the boot clock."""
    autopilot = Codec(1, 1)
    for k in range(begin, end):
        t_us = START + 50_000 * k
        turn = 2 * pi * k / 400
        line = f"{20_000 * cos(turn):.2f} {20_000 * sin(turn):.2f} 45000 4.0 {(50 * k - 30) / 1e3} {k}\n"
        yield Event(t_us, Channel.SENSOR, line.encode())
        if k % 4 == 0:
            battpos = {"time_boot_ms": (t_us - BOOT) // 1000 - 25, "value": sin(k / 90), "name": "battpos"}
            yield Event(t_us + 4_000, Channel.LINK, autopilot.pack("NAMED_VALUE_FLOAT", **battpos))
        while asked := [
            ts1 for ts1 in pipeline.component.vehicle.clock._asked if ts1 // 1000 > t_us - 50_000
        ]:
            answer = {"tc1": (t_us + 5_000 - BOOT) * 1000, "ts1": asked[0]}
            yield Event(t_us + 8_000, Channel.LINK, autopilot.pack("TIMESYNC", **answer))


def test_a_log_after_a_loss_is_replayed_as_far_as_it_can_be(tmp_path: Path) -> None:
    pipeline = bridge(tmp_path, StartEvent(START, {"MB_GAP_FACTOR": 2.0}))
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
    again = bridge(tmp_path, recorded.start)
    published = bytearray(b"".join(f for event in recorded.events() for _, f in again.feed(event)))
    result = agreement(published, recorded)
    assert result["samples"] > 500
    assert result["same_samples"] > 0.9 * result["samples"]
    assert agreement(published, Recorded(first)) == {"late_s": 0.0}
    more = {"files": second, "messages": recorded.messages, "bytes": 1, "seconds": 1.0, "same_config": True}
    texts = summary(
        {"runs": [result | more | {"identical": False, "first_difference": 0, "beyond": 0, "damages": 0}]}
    )
    assert f"begins {recorded.late:.1f} s into the run" in texts


def test_a_file_may_end_in_the_middle_of_what_came_at_once(tmp_path: Path) -> None:
    """As after a bridge stood still: the sensor's bytes of a second, in one read, are many records."""
    pipeline = bridge(tmp_path, StartEvent(START))
    fed = list(events(pipeline, 0, 60))
    lines = b"".join(event.data for event in fed if event.channel == Channel.SENSOR)
    header = declarations(1, 191, pipeline._config.telemetry, 0.0)
    with closing(TlogWriter(tmp_path / "logs", header=header, max_size=1e-3)) as log:
        sent = pipeline.feed(Event(fed[-1].time_us, Channel.SENSOR, lines))
        log.extend(pipeline.recorder.drain())
    files = sorted((tmp_path / "logs").iterdir())
    assert len(files) > 2
    recorded = Recorded(files)
    assert [event.data for event in recorded.events() if event.data] == [lines]
    again = bridge(tmp_path, recorded.start)
    assert [frame for event in recorded.events() for frame in again.feed(event)] == sent
