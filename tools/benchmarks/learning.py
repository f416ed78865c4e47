"""What learning in flight adds: processor time a sample at 100 Hz, time to the first heartbeat, memory."""

from __future__ import annotations

import gc
import time
from functools import partial
from pathlib import Path
from statistics import median

from benchmarks.latency import bridge_command, resident, started
from benchmarks.measure import processor_time
from benchmarks.processor import Edge
from benchmarks.row import Row
from benchmarks.workload import BEGIN_US, Feed, write_config

from magbridge.bridge.drive import set_up
from magbridge.bridge.events import Start
from magbridge.bridge.pipeline import Pipeline
from magbridge.config import load

__all__ = ["learning"]

HERTZ = 100
SECONDS = 20
"""Simulated, in one repetition."""
LEARNING = "[learning]\nenabled = true\n"
LIVE = 6.0
"""s of a running bridge before its memory is read: some samples are learned from."""


def learning(folder: Path, repetitions: int) -> list[Row]:
    """Measure a bridge that learns and one that does not."""
    return [*_processor(folder, repetitions), *_running(folder, repetitions)]


def _processor(folder: Path, repetitions: int) -> list[Row]:
    pipelines = {}
    for more in ("", LEARNING):
        path = write_config(folder, more=more)
        pipelines[more] = set_up(load(path), Start(BEGIN_US))
    feed, times = Feed(), {more: list[float]() for more in pipelines}
    longest: list[float] = []
    gc.collect()
    gc.freeze()
    for repetition in range(repetitions + 1):
        events = list(feed.events(SECONDS, HERTZ, BEGIN_US + repetition * SECONDS * 1_000_000))
        for more, pipeline in pipelines.items():
            slow = longest if more and repetition else []
            seconds = processor_time(partial(_drive, pipeline, Edge(events), slow))
            if repetition:  # the first one warms up
                times[more].append(1e6 * seconds / (SECONDS * HERTZ))
    gc.unfreeze()
    learner = pipelines[LEARNING].learning
    assert learner is not None
    added = [a - b for a, b in zip(times[LEARNING], times[""], strict=True)]
    return [
        Row("learning, processor time more a sample", median(added), "us", median(times[""]),
            "without learning", ratio=median(added), most=60.0,
            detail={"learned_from": learner.learner.samples}),
        Row("the longest event of a second", median(longest), "ms", detail={"most": max(longest)}),
    ]  # fmt: skip


def _drive(pipeline: Pipeline, edge: Edge, longest: list[float]) -> None:
    """Feed a bridge; append the ms that the longest event of each second took."""
    worst, second = 0.0, 0
    for event in edge.events(lambda: 0):
        begun = time.perf_counter()
        pipeline.feed(event)
        pipeline.recorder.drain()
        worst = max(worst, 1e3 * (time.perf_counter() - begun))
        if event.time_us // 1_000_000 != second:
            if second:
                longest.append(worst)
            worst, second = 0.0, event.time_us // 1_000_000


def _running(folder: Path, repetitions: int) -> list[Row]:
    first: dict[str, list[float]] = {"": [], LEARNING: []}
    memory: dict[str, list[float]] = {"": [], LEARNING: []}
    for _ in range(repetitions):
        for more in ("", LEARNING):
            with started(bridge_command(folder, more)) as live:
                first[more].append(live.seconds)
                feed = Feed()
                for _ in range(round(LIVE * HERTZ)):
                    live.link.sendto(feed.message(time.time_ns() // 1000), live.peer)
                    live.write(feed.reading(HERTZ))
                    time.sleep(1.0 / HERTZ)
                memory[more].append(resident(live.process.pid)["VmRSS"])
    extra = median([a - b for a, b in zip(memory[LEARNING], memory[""], strict=True)])
    ratio = median([a / b for a, b in zip(first[LEARNING], first[""], strict=True)])
    without = "without learning"
    return [
        Row("learning, to the first heartbeat", median(first[LEARNING]), "s", median(first[""]), without,
            ratio=ratio),
        Row("learning, resident", median(memory[LEARNING]), "MB", median(memory[""]), without, ratio=extra,
            most=15.0),
    ]  # fmt: skip
