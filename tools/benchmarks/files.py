"""A station downloads a whole log by MAVLink FTP while samples come at 1,000 Hz: what that costs them."""

from __future__ import annotations

from math import inf
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
from benchmarks.latency import Sent, bridge_command, play, sequences_of_messages, started
from benchmarks.row import Row
from benchmarks.workload import Feed

from magbridge.link.ftp import DATA, FTP_HEADER, Opcode
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAV_PARAM_TYPE

__all__ = ["files"]

HERTZ = 1000
SIZE = 50_000_000
USUAL, RATE = 250.0, 2_000.0
"""kB/s: ``MB_FILE_RATE`` unless set, and as set here."""
PATIENCE = 20
"""Repetitions after which a download counts as stuck."""
NAME = "20250101T000000Z_0001.tlog"
FTP = spec("FILE_TRANSFER_PROTOCOL")


class Download:
    """A station that asks for burst after burst."""

    def __init__(self) -> None:
        self.received = self._sequence = 0
        self.done = inf
        self._codec, self._ear = Codec(255, 190), Codec(0, 0)

    def ask(self, opcode: int, data: bytes = b"") -> bytes:
        """Return a request."""
        self._sequence = self._sequence + 1000 & 0xFFFF
        header = FTP_HEADER.pack(self._sequence, 0, opcode, len(data) or DATA, 0, 0, self.received)
        payload = (header + data).ljust(FTP_HEADER.size + DATA, b"\0")
        return self._codec.pack(FTP.name, target_system=1, target_component=191, payload=payload)

    def set(self, name: str, value: float) -> bytes:
        """Return a request to set a parameter."""
        real = MAV_PARAM_TYPE.REAL32
        to = {"target_system": 1, "target_component": 191}
        return self._codec.pack("PARAM_SET", param_id=name, param_value=value, param_type=real, **to)

    def receive(self, data: bytes) -> bytes:
        """Take a datagram; return the next request at the end of a burst."""
        if data[7:10] != FTP.id.to_bytes(3, "little"):
            return b""
        complete = False
        for message in self._ear.parse(data):
            _, _, opcode, size, asked, last, _ = FTP_HEADER.unpack_from(message["payload"])
            if asked == Opcode.BURST and opcode == Opcode.ACK:
                self.received += size
            complete |= bool(last) or asked == Opcode.OPEN_READ
        if self.received >= SIZE:
            self.done = min(self.done, perf_counter())
            return b""
        return self.ask(Opcode.BURST) if complete else b""


def files(folder: Path, repetitions: int) -> list[Row]:
    """Measure without a download, during a whole one at eight times the usual rate, and without again."""
    logs = folder / "logs"
    logs.mkdir()
    with (logs / NAME).open("wb") as file:
        file.truncate(SIZE)
    alone: list[Sent] = []
    downloading: list[Sent] = []
    station = Download()
    with started(bridge_command(folder)) as live:
        feed = Feed()
        sequences = sequences_of_messages()
        alone += [play(live, feed, HERTZ, sequences) for _ in range(repetitions)]
        live.link.sendto(station.set("MB_FILE_RATE", RATE), live.peer)
        live.link.sendto(station.ask(Opcode.OPEN_READ, f"logs/{NAME}".encode()), live.peer)
        begun = perf_counter()
        while station.received < SIZE and len(downloading) < PATIENCE:
            downloading.append(play(live, feed, HERTZ, sequences, station.receive))
        seconds = station.done - begun
        alone += [play(live, feed, HERTZ, sequences) for _ in range(repetitions)]
    rows = []
    for name, q, most in (("p50", 50.0, None), ("p99", 99.0, 2.0)):
        with_it, without = late(downloading, q), late(alone, q)
        what = f"latency during a download, {name}"
        rows.append(Row(what, with_it, "ms", without, "without", with_it / without, most=most))
    samples = sum(len(run.latency) for run in downloading)
    lost = sum(int(np.isnan(run.latency).sum()) for run in downloading)
    return [
        *rows,
        Row(f"lost at {HERTZ:,} Hz, of {samples:,}", lost, "samples", most=0),
        Row(f"download of {SIZE / 1e6:.0f} MB", station.received / seconds / 1e3, "kB/s", least=USUAL),
    ]


def late(runs: list[Sent], q: float) -> float:
    """Return a quantile of the latency in ms, the median of the runs."""
    return median([float(np.nanpercentile(run.latency, q)) for run in runs])
