"""Measure the processor time of the live path and of in-flight calibration, for each sample.

The floor is pymavlink's codec alone: it decodes the received frames, encodes the sent frames, and encodes the
messages in which the log stores the sensor's bytes.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median

from benchmarks.peer import Peer
from benchmarks.row import Row, processor_time
from benchmarks.workload import BEGIN_US, Feed, write_config

from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.pipeline import Pipeline, drive, set_up
from magbridge.config import load
from magbridge.logs.tlog import TlogWriter
from magbridge.records import Channel

HERTZ = 100
SECONDS = 10
"""Simulated time of one repetition of the live path, s."""
MAX_RATIO = 2.5
"""Maximum ratio of the processor time to that of pymavlink's codec."""
LEARNING_S = 20
"""Simulated time of one repetition with in-flight calibration, s."""
LEARNING = "[learning]\nenabled = true\n"


class Edge:
    """Adapter that reads events from memory and writes the output to memory."""

    def __init__(self, events: Sequence[Event]) -> None:
        self._events = events
        self.sent = bytearray()

    def events(self, _deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield the events."""
        yield from self._events

    def credit(self, frames: list[bytes]) -> None:
        """Do nothing: no frame is signed."""

    def send(self, number: int, data: bytes) -> None:
        """Append the bytes for the link to `sent`, and discard other output."""
        if number == Channel.LINK:
            self.sent += data


def processor(folder: Path, repetitions: int) -> list[Row]:
    """Measure the live path with masses mostly at rest, and with masses that always move."""
    return [row for moving in (False, True) for row in _measure(folder, repetitions, moving=moving)]


def _measure(folder: Path, repetitions: int, *, moving: bool) -> list[Row]:
    state = "masses in motion" if moving else "masses at rest"
    times = _times(folder, repetitions, moving=moving)
    floor = [sum(parts) for parts in zip(times["decode"], times["encode"], times["encode_log"], strict=True)]
    ratios = [bridge / least for bridge, least in zip(times["bridge"], floor, strict=True)]
    return [
        Row(
            f"processor time a sample, {state}",
            median(times["bridge"]),
            "us",
            median(floor),
            "pymavlink, link and log",
            median(ratios),
            most=MAX_RATIO,
        )
    ]


def _times(folder: Path, repetitions: int, *, moving: bool) -> dict[str, list[float]]:
    """Return the processor time of a sample in each repetition, µs, by kind of work."""
    pipeline = set_up(load(write_config(folder)), StartEvent(BEGIN_US))
    feed, peer, log = Feed(moving=moving), Peer(), TlogWriter(folder / "logs")
    samples = SECONDS * HERTZ
    times: dict[str, list[float]] = {"bridge": [], "decode": [], "encode": [], "encode_log": []}

    def live(edge: Edge) -> None:
        """Feed the events to the bridge, and wait until the log's thread has written every record."""
        drive(pipeline, edge, log, lambda _: None)
        while log.records + log.lost < pipeline.recorder.count:
            time.sleep(0.01)

    gc.collect()
    gc.freeze()
    for repetition in range(repetitions + 1):
        events = list(feed.events(SECONDS, HERTZ, BEGIN_US + repetition * SECONDS * 1_000_000))
        edge = Edge(events)
        bridge = processor_time(partial(live, edge))
        received = [event.data for event in events if event.channel is Channel.LINK]
        sent = peer.arguments(bytes(edge.sent))
        kept = [peer.sensor_bytes(event.data) for event in events if event.channel is Channel.SENSOR]
        floors = (partial(peer.decode, received), partial(peer.encode, sent), partial(peer.encode, kept))
        if repetition:  # the first repetition fills the caches
            for name, seconds in zip(times, (bridge, *map(processor_time, floors)), strict=True):
                times[name].append(1e6 * seconds / samples)
    log.close()
    gc.unfreeze()
    return times


def learning(folder: Path, repetitions: int) -> list[Row]:
    """Measure a bridge with and a bridge without in-flight calibration."""
    pipelines = {}
    for more in ("", LEARNING):
        path = write_config(folder, more=more)
        pipelines[more] = set_up(load(path), StartEvent(BEGIN_US))
    feed, times = Feed(), {more: list[float]() for more in pipelines}
    longest: list[float] = []
    gc.collect()
    gc.freeze()
    for repetition in range(repetitions + 1):
        events = list(feed.events(LEARNING_S, HERTZ, BEGIN_US + repetition * LEARNING_S * 1_000_000))
        for more, pipeline in pipelines.items():
            slow = longest if more and repetition else []
            seconds = processor_time(partial(_drive, pipeline, Edge(events), slow))
            if repetition:  # the first repetition fills the caches
                times[more].append(1e6 * seconds / (LEARNING_S * HERTZ))
    gc.unfreeze()
    added = [a - b for a, b in zip(times[LEARNING], times[""], strict=True)]
    return [
        Row("learning, processor time more a sample", median(added), "us", median(times[""]),
            "without learning", ratio=median(added), most=60.0),
        Row("the longest event of a second", median(longest), "ms"),
    ]  # fmt: skip


def _drive(pipeline: Pipeline, edge: Edge, longest: list[float]) -> None:
    """Feed events to a bridge; append the duration (ms) of the longest event in each second to `longest`."""
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
