"""Make valid frames and sensor lines with extreme values, and a bridge that gets them (``fuzz.py bridge``).

Autopilot, another component and a station send every message of the dialect. Some fields have plausible
values; the others are NaN, infinities, denormals and the limits of their type. The bridge calibrates in
flight and navigates.
"""

from __future__ import annotations

import random
import struct
from pathlib import Path

import numpy as np
from small import START, small_bridge

from magbridge.bridge.events import Event
from magbridge.bridge.pipeline import Pipeline
from magbridge.bridge.run import FileServer
from magbridge.calibration.model import Boresight, Parameter
from magbridge.field.grid import AnomalyGrid
from magbridge.field.grid_netcdf import write as write_grid
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.messages import MESSAGES
from magbridge.records import Channel

CONFIG = """NAMED_VALUE_FLOAT = 1
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
    b"",
    b"battpos",
    b"\xff\xfe\x00\x01",
    b"heading",
    b"MB_LEARN_CMD",
    b"MB_AGE_BATTPOS",
    b"MB_R_FIELD",
    b"\x00" * 8,
)
CELLS = (
    "nan", "0", "-0", "1e-320", "1e308", "-1e308", "1e9", "inf", "-inf", "9" * 300, "-1", "4294967296", "",
)  # fmt: skip
PLAUSIBLE = {
    "alt": -10_000, "h_acc": 2000, "value": 0.3, "altitude": 5000, "current_battery": 150,
    "roll": 0.1, "pitch": -0.4, "yaw": 0.0, "vx": 0.4, "vy": 0.0, "vz": 0.0, "airspeed": 0.5,
    "groundspeed": 0.6, "autopilot": 3, "system_status": 4, "flags": 831, "target_system": 1,
    "target_component": 191, "tc1": 0, "frame_id": 20, "child_frame_id": 12, "param_index": -1,
    "param_type": 9, "jamming_state": 1, "spoofing_state": 1, "z": 5.0,
}  # fmt: skip
BORESIGHT = Boresight((0.0, 0.0, 0.0), ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)))
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
ANY = tuple(MESSAGES)
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
    battery = Parameter("battpos", "", -1.0, 1.0, 0.0, 1.0)
    more = CONFIG.format(**VARIANTS[seed % len(VARIANTS)])
    publish = "MAG_FIELD", "MAG_RAW", "MAG_NAVIGATION", "HIGHRES_IMU"
    return small_bridge(folder, publish, battery=battery, more=more, boresight=BORESIGHT)


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


def _plausible(name: str, step: int) -> float | None:
    """Return a plausible value of the field `name` at a step, or None if no value is defined for it."""
    if name in ("lat", "latitude"):
        return 495_000_000 + 2 * step
    if name in ("lon", "longitude"):
        return -579_000_000
    if name == "x":
        return 0.022 * step
    if name == "time_boot_ms":
        return 50 * step
    if name == "fix_type":
        return 1 if step // GPS_PERIOD % 2 else 3
    return PLAUSIBLE.get(name)


def _frame(codecs: dict[tuple[int, int], Codec], rng: random.Random, step: int, extreme: float) -> bytes:
    """Return a valid frame in which a fraction `extreme` of the fields has an extreme value."""
    layout = spec(rng.choice(HANDLED) if rng.random() < 0.9 else rng.choice(ANY))
    values: dict[str, object] = {}
    for name, field in layout.fields.items():
        value = _plausible(name, step)
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
    cells = [
        f"{rng.gauss(15_000.0, 50.0):.1f}",
        f"{rng.gauss(2000.0, 50.0):.1f}",
        f"{rng.gauss(47_600.0, 50.0):.1f}",
    ]
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
    bridge.streams[0].line.to_send.clear()
    bridge.recorder.drain()
