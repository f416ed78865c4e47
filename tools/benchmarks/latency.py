"""Measure the real programs as processes: latency and start of ``magbridge run``, time of commands.

Latency is the time from writing the last byte of a frame to the pty until the datagram arrives.

One thread of this process acts as fluxgate, autopilot and station. It writes a frame, then polls the socket
until the next frame is due, so that its own wake-up does not add to the latency. The floor, a process
that copies bytes (:data:`ECHO`), is measured in the same way.
"""

from __future__ import annotations

import os
import pty
import re
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from benchmarks.row import Row, alternating
from benchmarks.workload import OPTIONS, TELEMETRY_HZ, Feed, write_config

from magbridge.arrays import FloatArray
from magbridge.logs import write
from magbridge.mavlink import Codec, spec
from magbridge.sensors import open_driver
from sitl import load, simulate

ECHO = """
import os, select, socket, sys
tty = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.connect(("127.0.0.1", int(sys.argv[2])))
link.send(b"ready")
while True:
    ready = select.select([tty, link], [], [])[0]
    if link in ready:
        link.recv(65536)
    if tty in ready:
        link.send(os.read(tty, 65536))
"""
"""Floor of the latency: a process that copies bytes from a pty to a UDP socket."""
RATES = (100, 1000)
SECONDS = 5.0
"""Duration of one repetition."""
GRACE = 1.0
"""Time without a sample after which a repetition ends, s."""
WARM_UP = 0.5
"""Time at the beginning that is not measured, s: caches fill, and the IGRF is computed first."""
RAW, FIELD = spec("MAG_RAW").id, spec("MAG_FIELD").id
BIN = Path(sys.executable).parent
START_FLOOR = "import numpy, msgspec, serial"
"""Imports that any bridge needs; the bridge also imports cyclopts (the command line) and magbridge."""
SETTLE_S = 3.0
"""Time with readings and telemetry before the memory is read, s."""
START_HZ = 100
ROWS = 2250
LIBRARIES = "import numpy, cyclopts, pandas, xarray, scipy.linalg, scipy.optimize"
"""Imports with which a program would read the file, fit, and parse the command line."""


class Running(NamedTuple):
    """Process that runs between a pty and a socket."""

    process: subprocess.Popen[bytes]
    master: int
    link: socket.socket
    peer: tuple[str, int]
    seconds: float
    """Time from the start of the process to its first datagram, s."""
    first: bytes
    """First datagram of the process."""


@contextmanager
def started(command: Callable[[str, int], list[str]]) -> Iterator[Running]:
    """Start a process between a new pty and a new socket; `command` takes the tty's name and the port."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    link.bind(("127.0.0.1", 0))
    link.settimeout(30.0)
    line = command(os.ttyname(slave), link.getsockname()[1])
    begun = time.perf_counter()
    process = subprocess.Popen(line, stderr=subprocess.DEVNULL)  # discard the bridge's messages
    try:
        first, peer = link.recvfrom(65536)
        link.setblocking(False)
        yield Running(process, master, link, peer, time.perf_counter() - begun, first)
    finally:
        process.terminate()
        process.wait(10.0)
        link.close()
        os.close(master)
        os.close(slave)


def bridge_command(folder: Path, device: str, port: int) -> list[str]:
    """Return the command that starts the bridge of the workload."""
    config = write_config(folder, device, f"udpout:127.0.0.1:{port}")
    return [str(BIN / "magbridge"), "run", "--config", str(config)]


def latency(folder: Path, repetitions: int) -> list[Row]:
    """Measure the latency of bridge and echo in turn, at each sample rate."""
    rows = []
    for hertz in RATES:
        bridge, echo = [], []
        with (
            started(partial(bridge_command, folder)) as live,
            started(lambda device, port: [sys.executable, "-c", ECHO, device, str(port)]) as bare,
        ):
            feed, other = Feed(), Feed()
            for _ in range(repetitions):
                bridge.append(play(live, feed, hertz, sequences_of_messages()))
                echo.append(play(bare, other, hertz, _sequences_of_frames()))
        for name, q, most in (("p50", 50.0, 0.5), ("p99", 99.0, 1.0)):
            ours, floor = (median(np.nanpercentile(late, q) for late, _ in runs) for runs in (bridge, echo))
            rows.append(Row(f"latency at {hertz:,} Hz, {name}", ours, "ms", floor, "echo", most=most))
        late = np.concatenate([late for late, _ in bridge])
        lost = int(np.isnan(late).sum())
        rows.append(Row(f"lost at {hertz:,} Hz, of {len(late):,}", lost, "samples", most=0))
        ours, floor = (median(cpu for _, cpu in runs) / (hertz * SECONDS) * 1e6 for runs in (bridge, echo))
        what = f"processor time at {hertz:,} Hz, kernel and log included"
        rows.append(Row(what, ours, "us", floor, "echo"))
    return rows


def play(
    running: Running, feed: Feed, hertz: int, sequences: Callable[[bytes], list[int]]
) -> tuple[FloatArray, float]:
    """Send readings and telemetry for `SECONDS`; match the datagrams to the frames by sequence number.

    Return the latency of each frame, ms (NaN if it was lost), and the processor time of all threads and the
    kernel, s.
    """
    clock, send, recv = time.perf_counter, running.link.sendto, running.link.recv
    received: list[tuple[float, bytes]] = []
    written: dict[int, float] = {}
    driver = open_driver("digitizer", OPTIONS)

    def listen(until: float) -> None:
        """Receive datagrams until `until`, and then those that still wait: this process may be late, too."""
        is_empty = False
        while (now := clock()) < until or not is_empty:
            try:
                received.append((now, recv(65536)))
            except BlockingIOError:
                is_empty = True

    cpu = processor_time(running.process.pid)
    begun = clock() + 0.01
    messages, every = 0, hertz // TELEMETRY_HZ
    for sample in range(round(hertz * SECONDS)):
        frame = feed.reading(hertz)
        sequence = driver.feed(frame)[0].sequence
        due = begun + sample / hertz
        if sample % every == every // 2:
            listen(due - 0.5 / hertz)
            send(feed.message(time.time_ns() // 1000), running.peer)
            messages += 1
            if messages % TELEMETRY_HZ == 0:
                send(feed.heartbeat(), running.peer)
        listen(due)
        written[sequence or 0] = clock()
        os.write(running.master, frame)
    came: dict[int, float] = {}
    parsed, before = 0, -1
    while before < len(came) < len(written):  # a bridge that is late on a busy computer has lost nothing
        before = len(came)
        listen(clock() + GRACE)
        for when, data in received[parsed:]:
            for sequence in sequences(data):
                came.setdefault(sequence, when)
        parsed = len(received)
    cpu = processor_time(running.process.pid) - cpu
    late = [1e3 * (came.get(sequence, np.nan) - when) for sequence, when in written.items()]
    return np.array(late[round(WARM_UP * hertz) :]), cpu


def sequences_of_messages() -> Callable[[bytes], list[int]]:
    codec = Codec(255, 190)

    def sequences(data: bytes) -> list[int]:
        messages = codec.parse(data)
        raw = [message["sequence"] for message in messages if message.id == RAW]
        # a raw reading without its corrected field does not count
        return raw if any(message.id == FIELD for message in messages) else []

    return sequences


def _sequences_of_frames() -> Callable[[bytes], list[int]]:
    driver = open_driver("digitizer", OPTIONS)
    return lambda data: [reading.sequence or 0 for reading in driver.feed(data)]


def processor_time(pid: int) -> float:
    """Return the processor time (s) of a process until now, with all threads and the kernel."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) * 1e-9


def resident(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    return int(re.findall(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())[0]) / 1024.0


def start(folder: Path, repetitions: int) -> list[Row]:
    """Time the start of the bridge and of an interpreter with the necessary imports."""
    bridge, bare, memory = [], [], 0.0
    for _ in range(repetitions):
        with started(partial(bridge_command, folder)) as live:
            names = [message.name for message in Codec(255, 190).parse(live.first)]
            if "HEARTBEAT" not in names:
                raise RuntimeError(f"the first datagram was {names}")
            bridge.append(live.seconds)
            feed = Feed()
            for _ in range(round(SETTLE_S * START_HZ)):
                live.link.sendto(feed.message(time.time_ns() // 1000), live.peer)
                os.write(live.master, feed.reading(START_HZ))
                time.sleep(1.0 / START_HZ)
            memory = resident(live.process.pid)
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", START_FLOOR], check=True)
        bare.append(time.perf_counter() - begun)
    return [
        Row("magbridge run to the first heartbeat", median(bridge), "s", median(bare), START_FLOOR, most=0.3),
        Row("resident, calibrating, logging and with a position", memory, "MB", most=65.0),
    ]  # fmt: skip


def commands(folder: Path, repetitions: int) -> list[Row]:
    """Time commands, and an interpreter that only imports the libraries that the commands need."""
    write(simulate(load("demo"), 1).isel(time=slice(ROWS)), folder / "runs.csv")
    asked = ("--parameter", "battpos", "--parameter", "ballast", "-o", str(folder / "cal.json"))
    measured: dict[str, tuple[list[str], str, float]] = {
        "processor time: magbridge --help": (
            [str(BIN / "magbridge"), "--help"], "import cyclopts, rich.console", 0.3
        ),
        f"processor time: calibrate, a CSV of {ROWS} rows": (
            [str(BIN / "magbridge"), "calibrate", str(folder / "runs.csv"), *asked], LIBRARIES, 1.5
        ),
    }  # fmt: skip
    rows = []
    for what, (command, floor, most) in measured.items():
        bare = [sys.executable, "-c", floor]
        ours, floors = alternating(repetitions, partial(_spent, command), partial(_spent, bare))
        rows.append(Row(what, median(ours), "s", median(floors), floor, most=most))
    return rows


def _spent(command: list[str]) -> float:
    """Return the processor time (s) of a command from its start to its end."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, _, used = os.wait4(process.pid, 0)
    process.returncode = 0
    return used.ru_utime + used.ru_stime
