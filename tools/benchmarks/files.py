"""A station downloads a log by MAVLink FTP while samples come at 1,000 Hz: what that costs the samples."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import numpy as np
from benchmarks.latency import SECONDS, Sent, bridge_command, play, sequences_of_messages, started
from benchmarks.row import Row
from benchmarks.workload import Feed

from magbridge.link.ftp import DATA, HEADER, Opcode
from magbridge.mavlink import Codec, spec

__all__ = ["files"]

HERTZ = 1000
SIZE = 50_000_000
NAME = "20250101T000000Z_0001.tlog"
FTP = spec("FILE_TRANSFER_PROTOCOL")


class Download:
    """A station that asks for burst after burst."""

    def __init__(self) -> None:
        self.received = self._sequence = 0
        self._codec, self._ear = Codec(255, 190), Codec(0, 0)

    def ask(self, opcode: int, data: bytes = b"") -> bytes:
        """Return a request."""
        self._sequence = self._sequence + 1000 & 0xFFFF
        head = HEADER.pack(self._sequence, 0, opcode, len(data) or DATA, 0, 0, self.received % SIZE)
        payload = (head + data).ljust(HEADER.size + DATA, b"\0")
        return self._codec.pack(FTP.name, target_system=1, target_component=191, payload=payload)

    def hear(self, data: bytes) -> bytes:
        """Take a datagram; return the next request at the end of a burst."""
        if data[7:10] != FTP.number:
            return b""
        complete = False
        for message in self._ear.parse(data):
            _, _, opcode, size, asked, last, _ = HEADER.unpack_from(message["payload"])
            if asked == Opcode.BURST and opcode == Opcode.ACK:
                self.received += size
            complete |= bool(last) or asked == Opcode.OPEN_READ
        return self.ask(Opcode.BURST) if complete else b""


def files(folder: Path, repetitions: int) -> list[Row]:
    """Measure without and with a download, in turn."""
    logs = folder / "logs"
    logs.mkdir()
    with (logs / NAME).open("wb") as file:
        file.truncate(SIZE)
    alone, beside, station = [], [], Download()
    with started(bridge_command(folder)) as live:
        feed = Feed()
        for _ in range(repetitions):
            alone.append(play(live, feed, HERTZ, sequences_of_messages()))
            live.link.sendto(station.ask(Opcode.OPEN_READ, f"logs/{NAME}".encode()), live.peer)
            beside.append(play(live, feed, HERTZ, sequences_of_messages(), station.hear))
            live.link.sendto(station.ask(Opcode.RESET), live.peer)
    rows = []
    for name, q, most in (("p50", 50.0, None), ("p99", 99.0, 2.0)):
        with_it, without = late(beside, q), late(alone, q)
        what = f"latency beside a download, {name}"
        rows.append(Row(what, with_it, "ms", without, "without", with_it / without, most=most))
    lost = sum(int(np.isnan(run.latency).sum()) for run in beside)
    speed = station.received / (repetitions * SECONDS) / 1e3
    return [
        *rows,
        Row(f"lost at {HERTZ:,} Hz beside a download", lost, "samples", most=0),
        Row(f"download ({SIZE / speed / 1e3:.0f} s for 50 MB)", speed, "kB/s"),
    ]


def late(runs: list[Sent], q: float) -> float:
    """Return a quantile of the latency in ms, the median of the runs."""
    return median([float(np.nanpercentile(run.latency, q)) for run in runs])
