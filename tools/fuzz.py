"""Feed randomly damaged inputs to every parser and reader; each must give a result or a magbridge error.

    python tools/fuzz.py mavlink digitizer -n 1000000 -o fuzz
    python tools/fuzz.py --kind file --seconds 600 -o fuzz
    python tools/fuzz.py bridge -n 500            a million events with extreme values

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

from small import START, aligned, bridge_text, polynomial, small_bridge

sys.path.append(str(Path(__file__).parents[1] / "tests" / "harness"))

import grids
import numpy as np
import xarray as xr
from log_files import Log, segment, ulog_of
from studies import command_line, show, table

from magbridge import MagbridgeError, config, logs
from magbridge.bridge.events import Event
from magbridge.bridge.pipeline import Pipeline
from magbridge.bridge.run import FileServer
from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.model import CalibratedSensor, Parameter, Run
from magbridge.field import read
from magbridge.field.grid import AnomalyGrid
from magbridge.field.grid_netcdf import write as write_grid
from magbridge.mavlink import BAD_DATA, Codec, spec
from magbridge.mavlink.messages import EXTRA
from magbridge.mavlink.tlog import LogReader
from magbridge.parts import OptionalParts
from magbridge.records import Channel, Reading
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
    begin_us, frames = 1_700_000_000_000_000, _frames(folder)[1:]
    return [b"".join(struct.pack(">Q", begin_us + k) + frame for k, frame in enumerate(frames))]


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


# ---- events with extreme values ----------------------------------------------------------------------------

# Autopilot, another component and a station send every message of the dialect. Some fields have plausible
# values; the others are NaN, infinities, denormals and the limits of their type.

BRIDGE = """NAMED_VALUE_FLOAT = 1
[telemetry.current]
message = "SYS_STATUS"
field = "current_battery"
scale = 0.01
unit = "A"
[telemetry.motor]
message = "ESC_TELEMETRY_1_TO_4"
field = "rpm[1]"
delay = 0.3
[heading]
send = "{heading}"
nmea = "udp:127.0.0.1:10110"
[learning]
enabled = true
[navigation]
map = "grid.nc"
fix = "{fix}"
"""
VARIANTS = (
    {"heading": "odometry", "fix": "EXTERNAL_POSITION_ESTIMATE"},
    {"heading": "vision_position_estimate", "fix": "ODOMETRY"},
    {"heading": "odometry", "fix": "GLOBAL_POSITION_SENSOR"},
)
"""Settings of the bridge; the seed selects one."""
FLOATS = (
    float("nan"), float("inf"), float("-inf"), 0.0, -0.0, 1e-45, -1e-45, 3.4e38, -3.4e38, 1e30, 1.0, -1.0,
)  # fmt: skip
TEXTS = (
    b"", b"battpos", b"\xff\xfe\x00\x01", b"heading", b"MB_LEARN_CMD", b"MB_AGE_BATTPOS", b"MB_R_FIELD",
    bytes(8),
)  # fmt: skip
CELLS = (
    "nan", "0", "-0", "1e-320", "1e308", "-1e308", "1e9", "inf", "-inf", "9" * 300, "-1", "4294967296", "",
)  # fmt: skip
PLAUSIBLE = {
    "alt": -10_000, "h_acc": 2000, "value": 0.3, "altitude": 5000, "current_battery": 150,
    "roll": 0.1, "pitch": -0.4, "yaw": 0.0, "vx": 0.4, "vy": 0.0, "vz": 0.0, "airspeed": 0.5,
    "groundspeed": 0.6, "autopilot": 3, "system_status": 4, "flags": 831, "target_system": 1,
    "target_component": 191, "tc1": 0, "frame_id": 20, "child_frame_id": 12, "param_index": -1,
    "param_type": 9, "jamming_state": 1, "spoofing_state": 1, "z": 5.0, "lon": -579_000_000,
    "longitude": -579_000_000,
}  # fmt: skip
MOVING: dict[str, Callable[[int], float]] = {
    "lat": lambda step: 495_000_000 + 2 * step,
    "latitude": lambda step: 495_000_000 + 2 * step,
    "x": lambda step: 0.022 * step,
    "time_boot_ms": lambda step: 50 * step,
    "fix_type": lambda step: 1 if step // GPS_PERIOD % 2 else 3,
}
"""Plausible values of fields, and functions of the step that return them."""
COMMANDS = 0, 400, 410, 511, 512, 520, 42424, 43003
HANDLED = (
    "ATTITUDE", "AUTOPILOT_VERSION", "COMMAND_ACK", "COMMAND_INT", "COMMAND_LONG", "EKF_STATUS_REPORT",
    "ESC_TELEMETRY_1_TO_4", "ESTIMATOR_STATUS", "FILE_TRANSFER_PROTOCOL", "GLOBAL_POSITION_INT",
    "GNSS_INTEGRITY", "GPS_GLOBAL_ORIGIN", "GPS_RAW_INT", "HEARTBEAT", "LOCAL_POSITION_NED", "LOG_ERASE",
    "LOG_REQUEST_DATA", "LOG_REQUEST_END", "LOG_REQUEST_LIST", "NAMED_VALUE_FLOAT", "ODOMETRY",
    "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "SETUP_SIGNING", "SYS_STATUS", "TIMESYNC",
    "VFR_HUD", *("ATTITUDE", "GLOBAL_POSITION_INT", "GPS_RAW_INT", "NAMED_VALUE_FLOAT", "VFR_HUD") * 6,
)  # fmt: skip
"""Messages that the bridge evaluates: nine of ten frames are from this list."""
ANY = tuple(EXTRA)
SENDERS = (1, 1), (1, 1), (1, 1), (1, 25), (255, 190), (2, 1)
STRETCH = 500
"""Events with a constant fraction of extreme values; a bridge without plausible fixes does not navigate."""
GPS_PERIOD = 100
"""Number of events after which the plausible GPS is lost, or returns."""
SHARES = 0.0, 0.02, 0.3, 0.8


def make_bridge(folder: Path, seed: int = 0) -> Pipeline:
    """Return a bridge in `folder` that corrects, learns, sends a heading and navigates."""
    longitude, latitude = np.linspace(-58.2, -57.6, 61), np.linspace(49.2, 49.8, 61)
    anomaly = 100.0 * np.sin(longitude[None] * 90.0) * np.cos(latitude[:, None] * 70.0)
    write_grid(AnomalyGrid(longitude, latitude, anomaly), folder / "grid.nc")
    more = BRIDGE.format(**VARIANTS[seed % len(VARIANTS)])
    publish = "MAG_FIELD", "MAG_RAW", "MAG_NAVIGATION", "HIGHRES_IMU"
    return small_bridge(folder, publish, more=more, boresight=aligned(1e-4))


def _number(code: str, rng: random.Random) -> float | int:
    """Return an extreme number of the type of a struct code."""
    if code in "fd":
        return rng.choice(FLOATS)
    low, high = _limits(code)
    return rng.choice((low, high, low + 1, high - 1, 0, 1, rng.randint(low, high)))


def _limits(code: str) -> tuple[int, int]:
    """Return the lowest and the highest integer of the type of a struct code."""
    size = 8 * struct.calcsize(code)
    return (-(1 << size - 1), (1 << size - 1) - 1) if code.islower() else (0, (1 << size) - 1)


def _frame(codecs: dict[tuple[int, int], Codec], rng: random.Random, step: int, extreme: float) -> bytes:
    """Return a valid frame in which a fraction `extreme` of the fields has an extreme value."""
    layout = spec(rng.choice(HANDLED) if rng.random() < 0.9 else rng.choice(ANY))
    values: dict[str, object] = {}
    for name, field in layout.fields.items():
        value = MOVING[name](step) if name in MOVING else PLAUSIBLE.get(name)
        single = not field.count and field.code != "s"
        if value is not None and single and rng.random() >= extreme:
            low, high = _limits(field.code)
            values[name] = value if field.code in "fd" else int(min(max(value, low), high))
        elif name == "command" and not field.count and rng.random() < 0.8:
            values[name] = rng.choice(COMMANDS)
        elif name == "name" and field.code == "s" and rng.random() < 0.5:
            values[name] = b"battpos"
        elif field.code == "s":
            values[name] = rng.choice(TEXTS)[: field.count or 1]
        elif field.count and field.code == "B":
            values[name] = rng.randbytes(field.count)
        elif field.count:
            values[name] = [_number(field.code, rng) for _ in range(field.count)]
        elif rng.random() < 0.8:
            values[name] = _number(field.code, rng)
    sender = (1, 1) if rng.random() >= extreme else rng.choice(SENDERS)
    return codecs[sender].pack(layout.name, **values)


def _line(step: int, rng: random.Random, extreme: float) -> bytes:
    """Return a sensor's line: a plausible reading, or with probability `extreme` one with extreme cells."""
    cells = [f"{rng.gauss(mean, 50.0):.1f}" for mean in (15_000.0, 2000.0, 47_600.0)]
    cells += ["4.0", f"{step * 0.1:.1f}", str(step)]
    if rng.random() < extreme:
        for place in rng.sample(range(6), rng.randint(1, 6)):
            cells[place] = rng.choice(CELLS)
    return " ".join(cells).encode() + b"\n"


def events(count: int, seed: int) -> list[Event]:
    """Return `count` random events: link frames, sensor lines, and pauses of an hour."""
    rng = random.Random(seed)
    codecs = {sender: Codec(*sender) for sender in SENDERS}
    time_us, out = START, []
    for step in range(count):
        if step % STRETCH == 0:
            extreme = rng.choice(SHARES) if step else 0.0
        time_us += rng.choice((0, 4, 1000, 50_000, 200_000))
        if rng.random() < 0.001 * extreme:
            time_us += 3_600_000_000
        if rng.random() < 0.4:
            out.append(Event(time_us, Channel.SENSOR, _line(step, rng, extreme)))
        else:
            out.append(Event(time_us, Channel.LINK, _frame(codecs, rng, step, extreme)))
    return out


def feed(bridge: Pipeline, files: FileServer, event: Event) -> None:
    """Feed an event to the bridge, and empty its queues as ``magbridge run`` does."""
    bridge.feed(event)
    while bridge.component.file_requests:
        files.ask(bridge.component.file_requests.popleft())
    if replies := files.drain()[1]:
        bridge.interleaved(replies)
    bridge.streams[0].to_send.clear()
    bridge.recorder.drain()


def _bridge(folder: Path) -> Read:
    """Return a function that feeds a bridge with 2,000 events, most of them extreme; the bytes seed them."""

    def read(data: bytes) -> object:
        OptionalParts.propagate = True
        seed = int.from_bytes(hashlib.sha256(data).digest()[:4], "big")
        bridge = make_bridge(folder, seed)
        files = FileServer(bridge.component.metadata, folder, lambda: 1e9, lambda _: None)
        for event in events(2000, seed):
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
    columns = {f"mag_{axis}": 2e4 + 100.0 * np.sin(t / 50.0 + k) for k, axis in enumerate("xyz")}
    columns |= {
        "roll": 5.0 * np.sin(t / 30.0), "latitude": 54.0 + (t - t[0]) * 1e-6, "longitude": 10.0 + 0.0 * t,
        "battpos": np.where(t % 40 < 20, 0.1, 0.4),
    }  # fmt: skip
    return xr.Dataset({k: ("time", v) for k, v in columns.items()}, {"time": t}, {"source": "fuzz"})


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
