"""Processor time of the whole live path for one sample, beside that of pymavlink's codec alone.

Two floors: decoding what comes over the link and encoding what goes out over it; and, because the log's
frames are outputs too, that and encoding the message in which the log keeps the sensor's bytes.
"""

from __future__ import annotations

import gc
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median

from benchmarks.apart import spent
from benchmarks.peer import Peer
from benchmarks.row import Row
from benchmarks.workload import BEGIN_US, Feed, write_config

from magbridge.bridge.events import Event, Start
from magbridge.bridge.run import drive, set_up
from magbridge.config import load
from magbridge.logs.tlog import TlogWriter
from magbridge.records import Channel

__all__ = ["processor"]

HERTZ = 100
SECONDS = 10
"""Simulated, in one repetition."""
BUDGET = 1.8


class Edge:
    """Events from memory, output to memory."""

    def __init__(self, events: Sequence[Event]) -> None:
        self._events = events
        self.sent = bytearray()

    def events(self, _deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield them."""
        yield from self._events

    def send(self, channel: Channel, data: bytes) -> None:
        """Keep what goes to the link."""
        if channel is Channel.LINK:
            self.sent += data


def processor(folder: Path, repetitions: int) -> list[Row]:
    """Measure with masses that are mostly at rest, and with masses that always move."""
    return [row for moving in (False, True) for row in _measure(folder, repetitions, moving=moving)]


def _measure(folder: Path, repetitions: int, *, moving: bool) -> list[Row]:
    pipeline = set_up(load(write_config(folder)), Start(BEGIN_US))
    feed, peer, log = Feed(moving=moving), Peer(), TlogWriter(folder / "logs")
    bridge, decode, encode, logged = [], [], [], []
    gc.collect()
    gc.freeze()
    put = 0

    def live(edge: Edge) -> None:
        """Feed the bridge, and wait until the log's thread has written every record."""
        nonlocal put
        drive(pipeline, edge, log, lambda _: None)
        put = pipeline.journal.count
        while log.records + log.lost < put:
            time.sleep(0.01)

    counts: Counter[str] = Counter()
    for repetition in range(repetitions + 1):
        events = list(feed.events(SECONDS, HERTZ, BEGIN_US + repetition * SECONDS * 1_000_000))
        heard = [event.data for event in events if event.channel is Channel.LINK]
        edge = Edge(events)
        bridge.append(spent(lambda edge=edge: live(edge)))
        decode.append(spent(lambda heard=heard: peer.decode(heard)))
        messages = peer.arguments(bytes(edge.sent))
        encode.append(spent(lambda messages=messages: peer.encode(messages)))
        kept = [peer.sensor_bytes(event.data) for event in events if event.channel is Channel.SENSOR]
        logged.append(spent(lambda kept=kept: peer.encode(kept)))
        counts.update(kind.__name__ for kind, _ in messages)
    log.close()
    gc.unfreeze()
    state = "masses in motion" if moving else "masses at rest"
    link = [d + e for d, e in zip(decode, encode, strict=True)]
    floors = {
        "pymavlink, link": link,
        "pymavlink, link and log": [one + more for one, more in zip(link, logged, strict=True)],
    }
    each = 1e6 / (SECONDS * HERTZ)
    return [
        Row(
            f"processor time a sample, {state}",
            median(bridge[1:]) * each,  # the first repetition warms up
            "us",
            median(floor[1:]) * each,
            name,
            median([b / f for b, f in zip(bridge[1:], floor[1:], strict=True)]),
            most=BUDGET,
            detail={
                "decode_us": median(decode[1:]) * each,
                "encode_us": median(encode[1:]) * each,
                "encode_log_us": median(logged[1:]) * each,
                "messages_out": sum(counts.values()) / (SECONDS * HERTZ * (repetitions + 1)),
            },
        )
        for name, floor in floors.items()
    ]
