"""Measure the time from ``magbridge run`` to its first heartbeat, and the memory of the bridge."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from benchmarks.latency import bridge_command, processor_time, resident, started
from benchmarks.row import Row
from benchmarks.workload import Feed

from magbridge.mavlink import Codec

__all__ = ["start"]

FLOOR = "import numpy, msgspec, serial"
"""The imports that any bridge needs; cyclopts (the command line) and our own modules come on top."""
SETTLE = 3.0
"""s of readings and telemetry before the memory is read."""
HERTZ = 100


def start(folder: Path, repetitions: int) -> list[Row]:
    """Start the bridge repeatedly, and an interpreter with the necessary imports."""
    bridge, bare, used = [], [], []
    memory: dict[str, float] = {}
    for _ in range(repetitions):
        with started(bridge_command(folder)) as live:
            names = [message.name for message in Codec(255, 190).parse(live.first)]
            if "HEARTBEAT" not in names:
                raise RuntimeError(f"the first datagram was {names}")
            bridge.append(live.seconds)
            used.append(processor_time(live.process.pid))
            feed = Feed()
            for _ in range(round(SETTLE * HERTZ)):
                live.link.sendto(feed.message(time.time_ns() // 1000), live.peer)
                live.write(feed.reading(HERTZ))
                time.sleep(1.0 / HERTZ)
            memory = resident(live.process.pid)
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", FLOOR], check=True)
        bare.append(time.perf_counter() - begun)
    return [
        Row("magbridge run to the first heartbeat", median(bridge), "s", median(bare), FLOOR, most=0.3),
        Row("processor time of that", median(used), "s"),
        Row("resident, calibrating, logging and with a position", memory["VmRSS"], "MB", most=65.0),
        Row("resident, at most", memory["VmHWM"], "MB", most=65.0),
    ]  # fmt: skip
