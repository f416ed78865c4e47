"""Replay as fast as it goes, against what pymavlink's codec alone would take for the same messages.

There are two processes, the bridge and the stage that feeds it and listens. The wall clock is right where
both have a core of their own; the bridge is the slower one, so on a busy machine its processor time says
the same.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from statistics import median

import numpy as np
import xarray as xr
from benchmarks.latency import processor_time
from benchmarks.peer import Peer
from benchmarks.row import Row
from benchmarks.workload import write_config

from magbridge.bridge.events import Start
from magbridge.config import load
from magbridge.records import Channel
from sitl.replay.emulation import emulate, start_us
from sitl.replay.listener import Listener
from sitl.replay.stage import Stage

__all__ = ["replay"]

MONTH = 30 * 86_400.0
LEAST = 0.6
CASES = {"0.25 Hz": (4.0, 5400), "100 Hz": (0.01, 20_000)}
"""Seconds between rows, and rows."""


def deployment(step: float, rows: int) -> xr.Dataset:
    """Return a glider's log: masses that move now and then, attitude, position."""
    t = np.arange(rows) * step
    battery = np.where(t % 600.0 < 30.0, np.sin(t / 5.0), 0.3)
    columns = {
        "mag_x": 30_000.0 * np.sin(t / 40.0), "mag_y": 30_000.0 * np.cos(t / 40.0),
        "mag_z": 40_000.0 + 0.0 * t, "battpos": battery, "ballast": 200.0 + 150.0 * battery,
        "sensor_temperature": 8.0 + 0.0 * t, "roll": 5.0 * np.sin(t / 9.0), "pitch": -20.0 + 0.0 * t,
        "heading": t / 40.0 % 360.0, "latitude": 49.5 + 1e-7 * t, "longitude": -57.8 + 0.0 * t,
        "depth": 50.0 + 40.0 * np.sin(t / 300.0),
    }  # fmt: skip
    return xr.Dataset(
        {name: ("time", values) for name, values in columns.items()}, {"time": 1_750_000_000.0 + t}
    )


def replay(folder: Path, repetitions: int) -> list[Row]:
    """Measure a slow log, in which the once-a-second messages are most, and a fast one."""
    return [row for name, case in CASES.items() for row in _measure(folder, repetitions, name, *case)]


def _measure(folder: Path, repetitions: int, name: str, step: float, rows: int) -> list[Row]:
    config = write_config(folder)
    log = deployment(step, rows)
    events = list(emulate(log, load(config)))
    received = [event.data for event in events if event.channel is Channel.LINK]
    peer = Peer()
    walls, floors, bare, bridges = [], [], [], []
    for _ in range(repetitions):
        seconds, bridge, published = _play(folder, config, log)
        walls.append(seconds)
        bridges.append(bridge)
        messages = peer.arguments(published)
        begun, used = time.perf_counter(), time.process_time()
        peer.decode(received)
        peer.encode(messages)
        floors.append(time.perf_counter() - begun)
        bare.append(time.process_time() - used)
    each = 1e6 / rows
    codec = "pymavlink's codec"
    faster = [floor / wall for floor, wall in zip(floors, walls, strict=True)]
    lighter = [floor / bridge for floor, bridge in zip(bare, bridges, strict=True)]
    detail = {"messages_in": len(received) / rows, "messages_out": len(messages) / rows, "wall_s": walls}
    month = MONTH / step * median(walls) / rows / 60.0
    return [
        Row(f"replay of {name} data, a row", median(walls) * each, "us", median(floors) * each, codec,
            median(faster), least=LEAST, detail=detail),
        Row(f"the same, processor time of the bridge ({name})", median(bridges) * each, "us",
            median(bare) * each, codec, median(lighter), least=LEAST),
        Row(f"a month of {name} data", month, "min", most=2.0 if name == "0.25 Hz" else None),
    ]  # fmt: skip


def _play(folder: Path, config: Path, log: xr.Dataset) -> tuple[float, float, bytes]:
    """Return wall clock (s) of the replay, processor time (s) of the bridge, and its output."""
    listener, published = Listener(), bytearray()

    def receive(data: bytes) -> None:
        published.extend(data)
        listener.receive(data)

    stage = Stage(config, receive, folder / "replayed")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    starting = processor_time(stage._bridge.pid)  # noqa: SLF001 - what it took to start is another figure
    begun = time.perf_counter()
    stage.play(Start(start_us(log)), emulate(log, load(config)))
    seconds = time.perf_counter() - begun
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, used - starting, bytes(published)
