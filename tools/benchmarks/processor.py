"""Measure the processor time of the live path and of in-flight calibration, for each sample.

The floor is pymavlink's codec alone: it decodes the received frames, encodes the sent frames, and encodes the
messages in which the log stores the sensor's bytes.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

from benchmarks.row import Row, processor_time
from benchmarks.workload import BEGIN_US, Feed, write_config

from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.pipeline import Pipeline, drive, set_up
from magbridge.config import load
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink.definitions import write_definitions
from magbridge.records import Channel

HERTZ = 100
SECONDS = 10
"""Simulated time of one repetition of the live path, s."""
MAX_RATIO = 2.5
"""Maximum ratio of the processor time to that of pymavlink's codec."""
LEARNING_S = 20
"""Simulated time of one repetition with in-flight calibration, s."""
LEARNING = "[learning]\nenabled = true\n"


class Peer:
    """pymavlink's codec for the dialect, which decodes the bridge's input and encodes its output."""

    def __init__(self, folder: Path) -> None:
        write_definitions(folder)
        with patch("sys.path", [str(folder), *sys.path]):
            self._dialect = import_module("magbridge_dialect")
        self._in = self._dialect.MAVLink(None)
        self._in.robust_parsing = True
        self._out = self._dialect.MAVLink(None, srcSystem=1, srcComponent=191)

    def decode(self, pieces: Iterable[bytes]) -> int:
        """Decode bytes in pieces; return the number of messages."""
        return sum(len(self._in.parse_buffer(piece) or ()) for piece in pieces)

    def arguments(self, published: bytes) -> list[tuple[type, tuple[Any, ...]]]:
        """Return class and arguments of each message of a stream, for :meth:`encode`."""
        messages = self._dialect.MAVLink(None).parse_buffer(published) or []
        return [(type(one), tuple(self._argument(one, name) for name in one.fieldnames)) for one in messages]

    def sensor_bytes(self, data: bytes) -> tuple[type, tuple[Any, ...]]:
        """Return class and arguments of the log's message that stores the bytes of a sensor."""
        return self._dialect.MAVLink_mag_sensor_bytes_message, (0, len(data), list(data.ljust(253, b"\0")))

    @staticmethod
    def _argument(message: Any, name: str) -> Any:
        value = getattr(message, name)
        return value.encode() if isinstance(value, str) else value

    def encode(self, messages: Iterable[tuple[type, tuple[Any, ...]]]) -> int:
        """Construct and pack messages; return the number of bytes."""
        out = self._out
        return sum(len(kind(*arguments).pack(out)) for kind, arguments in messages)


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
    rows = []
    for state, moving in (("at rest", False), ("in motion", True)):
        times = _times(folder, repetitions, moving=moving)
        floors = [sum(one) for one in zip(times["decode"], times["encode"], times["encode_log"], strict=True)]
        ratio = median(bridge / floor for bridge, floor in zip(times["bridge"], floors, strict=True))
        rows.append(
            Row(f"processor time a sample, masses {state}", median(times["bridge"]), "us", median(floors),
                "pymavlink, link and log", ratio, most=MAX_RATIO)
        )  # fmt: skip
    return rows


def _times(folder: Path, repetitions: int, *, moving: bool) -> dict[str, list[float]]:
    """Return the processor time of a sample in each repetition, µs, by kind of work."""
    pipeline = set_up(load(write_config(folder)), StartEvent(BEGIN_US))
    feed, peer, log = Feed(moving=moving), Peer(folder), TlogWriter(folder / "logs")
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
    configs = {more: load(write_config(folder, more=more)) for more in ("", LEARNING)}
    pipelines = {more: set_up(config, StartEvent(BEGIN_US)) for more, config in configs.items()}
    feed, times = Feed(), {more: list[float]() for more in pipelines}
    gc.collect()
    gc.freeze()
    for repetition in range(repetitions + 1):
        events = list(feed.events(LEARNING_S, HERTZ, BEGIN_US + repetition * LEARNING_S * 1_000_000))
        for more, pipeline in pipelines.items():
            seconds = processor_time(partial(_drive, pipeline, events))
            if repetition:  # the first repetition fills the caches
                times[more].append(1e6 * seconds / (LEARNING_S * HERTZ))
    gc.unfreeze()
    added = [a - b for a, b in zip(times[LEARNING], times[""], strict=True)]
    return [
        Row("learning, processor time more a sample", median(added), "us", median(times[""]),
            "without learning", ratio=median(added), most=60.0),
    ]  # fmt: skip


def _drive(pipeline: Pipeline, events: Sequence[Event]) -> None:
    """Feed events to a bridge, and discard its log."""
    for event in events:
        pipeline.feed(event)
        pipeline.recorder.drain()
