"""Feed randomly damaged inputs to every parser and reader; each must give a result or a magbridge error.

    python tools/fuzz.py mavlink digitizer -n 1000000 -o fuzz
    python tools/fuzz.py --kind file --seconds 600 -o fuzz
    python tools/fuzz.py bridge -n 2000           a million events with extreme values

The undamaged inputs come from magbridge's writers and the emulators. The tool changes bits, bytes and
numbers, and moves, doubles or cuts off pieces. Input k of a seed is equal in every run. The output folder
receives each failing input with its traceback.
"""

from __future__ import annotations

import hashlib
import random
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from extremes import events, feed, make_bridge
from small import bridge_text, polynomial

sys.path.append(str(Path(__file__).parents[1] / "tests" / "harness"))

import grids
import numpy as np
import xarray as xr
from flash import Log
from segments import segment
from studies import command_line, show, table
from ulogs import ulog_of

from magbridge import config, logs
from magbridge.bridge.run import FileServer
from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.model import CalibratedSensor, Parameter, Run
from magbridge.errors import MagbridgeError
from magbridge.field import read
from magbridge.field.grid import AnomalyGrid
from magbridge.mavlink import BAD_DATA, Codec
from magbridge.mavlink.tlog import LogReader
from magbridge.parts import OptionalParts
from magbridge.records import Reading
from magbridge.sensors import open_driver
from sitl.fluxgate import open_encoder

MAX_SECONDS = 10.0
"""Maximum processor time for an input, s; all inputs are far smaller than 10 MB."""
NUMBERS = [0, 1, 2, 3, 4, 7, 8, 127, 128, 254, 255]
WORDS = [
    b"nan", b"inf", b"-1", b"1e400", b"-9999", b"0", b",", b"\n", b"\0", b'"', b"\xff\xfe", b"\xef\xbb\xbf",
]  # fmt: skip

Read = Callable[[bytes], object]


class Target(NamedTuple):
    """Parser under test: its kind, and functions that return a reader and the seeds, given a folder."""

    kind: str
    open: Callable[[Path], Read]
    seeds: Callable[[Path], list[bytes]]


# ---- targets of bytes --------------------------------------------------------------------------------------


def _driver(name: str, **options: Any) -> Target:
    """Return the target of a sensor driver, which gets the bytes in two chunks."""

    def read(data: bytes) -> object:
        driver = open_driver(name, options)
        half = len(data) // 2
        return [driver.feed(data[:half]), driver.feed(data[half:])]

    def seeds(_: Path) -> list[bytes]:
        encoder = open_encoder(name, options, rate=10.0)
        answers = b"".join(encoder.feed(command) for command in open_driver(name, options).start())
        readings = [Reading((2e4 + k, -3e3 * k, 4.5e4), device_time=0.1 * k) for k in range(5)]
        return [answers + b"".join(encoder.encode(reading) for reading in readings), b"", b"\0" * 64]

    return Target("bytes", lambda _: read, seeds)


def _mavlink(data: bytes) -> object:
    """Parse MAVLink in two chunks; assert that each byte is in a message, counted as skipped, or pending."""
    codec = Codec(1, 191)
    half = len(data) // 2
    messages = [*codec.parse(data[:half]), *codec.parse(data[half:])]
    skipped = sum(len(one.frame) for one in messages if one.id == BAD_DATA)
    if b"".join(one.frame for one in messages) + codec.pending != data:
        raise AssertionError("messages and pending bytes are not the bytes received")
    if skipped != codec.bytes_skipped or codec.frames != sum(one.id != BAD_DATA for one in messages):
        raise AssertionError("messages or skipped bytes are not counted")
    return [one.fields for one in messages if one.known]


def _frames(_: Path) -> list[bytes]:
    codec = Codec(1, 1)
    frames = [
        codec.pack("HEARTBEAT", type=12),
        codec.pack("ATTITUDE", time_boot_ms=1000, roll=0.1, yaw=2.0),
        codec.pack("NAMED_VALUE_FLOAT", name="battpos", value=0.3),
        codec.pack("PARAM_SET", param_id="MB_OFFSET", param_value=1.0),
        codec.pack("MAG_FIELD", time_usec=5, total_field=50_000.0),
    ]
    return [b"".join(frames), *frames]


def _frame_log(folder: Path) -> list[bytes]:
    return [
        b"".join(struct.pack(">Q", 1_700_000_000_000_000 + k) + f for k, f in enumerate(_frames(folder)[1:]))
    ]


def _calibration(_: Path) -> list[bytes]:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(27, 27))
    made = polynomial(
        rng.normal(size=27) * 100.0,
        Parameter("battpos", "in", -0.4, 0.5, 0.05, 0.45),
        covariance=root @ root.T,
        sensor=CalibratedSensor("digitizer", 3),
        runs=(Run("1", 225, 1.1, (0.3,)),),
        inputs={"a.csv": "00"},
        software="magbridge 0.1.0",
    )
    return [encode_calibration(made)]


def _bridge(folder: Path) -> Read:
    """Return a function that feeds a bridge with 500 events of extreme values, which the bytes seed."""

    def read(data: bytes) -> object:
        OptionalParts.propagate = True
        seed = int.from_bytes(hashlib.sha256(data).digest()[:4], "big")
        bridge = make_bridge(folder, seed)
        files = FileServer(bridge.component.metadata, folder, lambda: 1e9, lambda _: None)
        for event in events(500, seed):
            feed(bridge, files, event)
        files.close()
        return bridge

    return read


# ---- targets of files --------------------------------------------------------------------------------------


def _file(name: str, function: Callable[[Path], object], *writers: Callable[[Path], object]) -> Target:
    """Return a target that reads a file of the damaged bytes; `writers` write the seeds to a path."""

    def opened(folder: Path) -> Read:
        path = folder / name

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return function(path)

        return run

    def seeds(folder: Path) -> list[bytes]:
        path, made = folder / f"seed{Path(name).suffix}", []
        for write in writers:
            write(path)
            made.append(path.read_bytes())
        return made

    return Target("file", opened, seeds)


def _log() -> xr.Dataset:
    t = 1.7e9 + 4.0 * np.arange(60)
    columns = {
        name: ("time", 2e4 + 100.0 * np.sin(t / 50.0 + k))
        for k, name in enumerate(("mag_x", "mag_y", "mag_z"))
    }
    more = {
        "roll": 5.0 * np.sin(t / 30.0),
        "latitude": 54.0 + (t - t[0]) * 1e-6,
        "longitude": 10.0 + 0.0 * t,
        "battpos": np.where(t % 40 < 20, 0.1, 0.4),
    }
    return xr.Dataset(
        {**columns, **{k: ("time", v) for k, v in more.items()}}, {"time": t}, {"source": "fuzz"}
    )


def _write_ardupilot(path: Path) -> None:
    log = Log()
    for k in range(20):
        log.mag(100_000 * k, 0, (100 + k, 20, -300))
    path.write_bytes(log.data)


def _write_px4(path: Path) -> None:
    topics = {"sensor_mag": ("uint64_t timestamp;float x;float y;float z;", "<Q3f")}
    rows = [("sensor_mag", 0, (1000 * k, 0.2, 0.01 * k, -0.4)) for k in range(20)]
    path.write_bytes(ulog_of(topics, {}, rows))


def _write_slocum(path: Path) -> None:
    t = 4.0 * np.arange(20)
    segment(path, {"m_present_time": 1.7e9 + t, "m_roll": 0.03 * t, "m_battpos": 0.3 + 0.0 * t})


def _write_log(path: Path) -> None:
    logs.write(_log(), path)


TARGETS: dict[str, Target] = {
    "digitizer": _driver("digitizer", sensitivity=5e-5),
    "hmr2300": _driver("hmr2300", output="ascii"),
    "hmr2300-binary": _driver("hmr2300", output="binary"),
    "twinleaf": _driver("twinleaf", temperature="therm"),
    "ascii": _driver("ascii", columns=["x", "y", "z", "temperature"], unit="G"),
    "nmea": _driver(
        "ascii", prefix="$PMAG,", separator=",", columns=["time", "x", "y", "z"], checksum="nmea"
    ),
    "mavlink": Target("bytes", lambda _: _mavlink, _frames),
    "frame_log": Target(
        "bytes", lambda _: lambda data: [(one, one.message) for one in LogReader(BytesIO(data))], _frame_log
    ),
    "calibration": Target("bytes", lambda _: decode_calibration, _calibration),
    "bridge": Target("events", _bridge, lambda _: [bytes(64)]),
    "config": _file(
        "bridge.toml",
        config.load,
        lambda path: path.write_text(bridge_text(calibration=False, publish={"MAG_FIELD": 0})),
    ),
    "polygon": _file(
        "mask.csv",
        read.read_polygon,
        lambda path: path.write_text("longitude,latitude\n10.1,54.1\n10.4,54.1\n10.2,54.3\n"),
    ),
    "csv": _file("log.csv", logs.read, _write_log),
    "tlog": _file("log.tlog", logs.read, _write_log),
    "netcdf": _file("log.nc", logs.read, _write_log),
    "parquet": _file("log.parquet", logs.read, _write_log),
    "ardupilot": _file("log.BIN", logs.read, _write_ardupilot),
    "px4": _file("log.ulg", logs.read, _write_px4),
    "slocum": _file("log.dbd", logs.read, _write_slocum),
    "table": _file("grid.csv", read.read_grid, grids.table),
    "esri": _file("grid.asc", read.read_grid, grids.esri),
    "surfer": _file("grid.grd", read.read_grid, grids.surfer_text, grids.surfer_6, grids.surfer_7),
    "geosoft": _file(
        "grid.grd", read.read_grid, grids.geosoft, lambda path: grids.geosoft(path, compressed=True)
    ),
    "geotiff": _file("grid.tif", read.read_grid, grids.geotiff),
    "grid-netcdf": _file(
        "grid.nc", read.read_grid, AnomalyGrid(grids.LON, grids.LAT, grids.MAP, 1.0, 300.0).save
    ),
}  # fmt: skip


# ---- fuzzing -----------------------------------------------------------------------------------------------


def damaged(seeds: Sequence[bytes], rng: random.Random) -> bytes:
    """Return a random seed with one to eight random changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        length = min(rng.choice((1, 2, 4, 8, 32, 256)), len(data) - at)
        match rng.randrange(9):
            case 0 if length:
                data[at] ^= 1 << rng.randrange(8)
            case 1 if length:
                data[at] = rng.choice(NUMBERS)
            case 2:
                data[at : at + length] = rng.randbytes(length)
            case 3:
                data[at:at] = rng.randbytes(length)
            case 4:
                del data[at : at + length]
            case 5:
                data[at:at] = data[at : at + length] * rng.choice((1, 2, 50))
            case 6:
                data[at : at + length] = rng.choice(WORDS)
            case 7:
                other = rng.choice(seeds)
                data[at:] = other[rng.randrange(len(other) + 1) :]
            case 8 if rng.random() < 0.3:
                del data[at:]
    return bytes(data)


class Counts:
    """Counts of the outcomes of one target; its folder receives the failing inputs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tried = self.read = self.refused = self.found = 0
        self.slowest = 0.0

    def run(self, read: Read, data: bytes) -> None:
        """Feed one input to the reader and count its outcome."""
        began, problem = time.process_time(), ""
        try:
            read(data)
            self.read += 1
        except MagbridgeError as error:
            self.refused += 1
            if "\n" in str(error) or "cannot be read, damaged?" in str(error):  # the reader did not expect it
                problem = f"{error}\n" + "\n".join(getattr(error, "__notes__", []))
        except Exception:  # noqa: BLE001 - any other exception is a fault
            problem = traceback.format_exc()
        took = time.process_time() - began
        self.slowest = max(self.slowest, took)
        self.tried += 1
        if took > MAX_SECONDS:
            problem = problem or f"took {took:.1f} s\n"
        if problem:
            self._keep(data, problem)

    def _keep(self, data: bytes, problem: str) -> None:
        """Store a failing input if the last lines of its traceback are new."""
        lines = [line for line in problem.splitlines() if line.strip().startswith(("File", "took"))]
        text = "".join(lines[-2:] or [problem[:80]])
        kind = hashlib.sha1(text.encode(), usedforsecurity=False).hexdigest()[:10]
        if not (self.folder / f"{kind}.txt").exists():
            self.found += 1
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / kind).write_bytes(data)
            (self.folder / f"{kind}.txt").write_text(problem)


def main() -> int:
    """Fuzz each target in turn; print the outcomes and return the exit code."""
    kinds = ["bytes", "file", "events"]
    chosen = command_line(
        __doc__, TARGETS, kind=kinds, n=10_000, seconds=float("inf"), seed=0, o=Path("fuzz")
    )
    shown = table("Fuzzing", "target", "tried", "read", "refused", "faults", "slowest, s", left=("target",))
    faults = 0
    for name in (name for name in chosen.names if TARGETS[name].kind in chosen.kind):
        memory = Path("/dev/shm")
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as made:
            counts, folder = Counts(chosen.o / name), Path(made)
            read, seeds = TARGETS[name].open(folder), TARGETS[name].seeds(folder)
            until = time.monotonic() + chosen.seconds
            for k in range(chosen.n):
                counts.run(read, damaged(seeds, random.Random(f"{chosen.seed} {k}")))
                if time.monotonic() > until:
                    break
        faults += counts.found
        numbers = (f"{count:,}" for count in (counts.tried, counts.read, counts.refused, counts.found))
        shown.add_row(name, *numbers, f"{counts.slowest:.2f}")
    show(shown)
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
