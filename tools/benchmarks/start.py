"""From ``magbridge run`` to its first heartbeat, its imports, and the memory that it takes."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from benchmarks.latency import BIN, bridge_command, processor_time, resident, started
from benchmarks.row import Row
from benchmarks.workload import Feed, write_config

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
    imported = imports(folder)
    return [
        Row("magbridge run to the first heartbeat", median(bridge), "s", median(bare), FLOOR, most=0.8,
            detail={"best": min(bridge)}),
        Row("processor time of that", median(used), "s"),
        Row("resident, calibrating, logging and with a position", memory["VmRSS"], "MB", most=90.0),
        Row("resident, at most", memory["VmHWM"], "MB", most=90.0, detail={"imported": imported}),
    ]  # fmt: skip


def imports(folder: Path) -> list[str]:
    """Return the packages outside the standard library that a running bridge has imported."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.settimeout(30.0)
        config = write_config(folder, "/dev/null", f"udpout:127.0.0.1:{link.getsockname()[1]}")
        command = [sys.executable, "-X", "importtime", str(BIN / "magbridge"), "run", "--config", str(config)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            link.recv(65536)
        finally:
            process.terminate()
        listing = process.communicate()[1]
    names = {
        name.partition(".")[0] for name in re.findall(r"^import time:.*\| +(\S+)$", listing, re.MULTILINE)
    }
    return sorted(name for name in names - sys.stdlib_module_names if not name.startswith("_"))
