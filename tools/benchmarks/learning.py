"""Measure the processor time that in-flight calibration adds to a sample at 100 Hz."""

from __future__ import annotations

import gc
import time
from functools import partial
from pathlib import Path
from statistics import median

from benchmarks.processor import Edge
from benchmarks.row import Row, processor_time
from benchmarks.workload import BEGIN_US, Feed, write_config

from magbridge.bridge.drive import set_up
from magbridge.bridge.events import StartEvent
from magbridge.bridge.pipeline import Pipeline
from magbridge.config import load

__all__ = ["learning"]

HERTZ = 100
SECONDS = 20
"""Simulated, in one repetition."""
LEARNING = "[learning]\nenabled = true\n"


def learning(folder: Path, repetitions: int) -> list[Row]:
    """Measure a bridge that learns and one that does not."""
    pipelines = {}
    for more in ("", LEARNING):
        path = write_config(folder, more=more)
        pipelines[more] = set_up(load(path), StartEvent(BEGIN_US))
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
    added = [a - b for a, b in zip(times[LEARNING], times[""], strict=True)]
    return [
        Row("learning, processor time more a sample", median(added), "us", median(times[""]),
            "without learning", ratio=median(added), most=60.0),
        Row("the longest event of a second", median(longest), "ms"),
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
