"""Feed the bridge valid frames and sensor lines with extreme values; no event may raise.

    python tools/extremes.py --events 1000000 [--seed 1]

Every message of the dialect comes from the autopilot, from another component and from a station. Half of the
fields hold plausible values, the others NaN, infinities, denormals and the limits of their type. The bridge
learns and navigates, and its optional parts may not hide an exception.
"""

from __future__ import annotations

import argparse
import random
import struct
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from small import START, small_bridge

from magbridge.bridge.events import Event, Start
from magbridge.bridge.pipeline import Pipeline
from magbridge.calibration.model import Parameter
from magbridge.field.grid import AnomalyGrid
from magbridge.field.grid_netcdf import write as write_grid
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.messages import MESSAGES
from magbridge.parts import OptionalParts
from magbridge.records import Channel

__all__ = ["events", "make_bridge"]

CONFIG = """NAMED_VALUE_FLOAT = 1
[telemetry.current]
message = "SYS_STATUS"
field = "current_battery"
scale = 0.01
unit = "A"
[learning]
enabled = true
[navigation]
map = "grid.nc"
"""
FLOATS = (
    float("nan"), float("inf"), float("-inf"), 0.0, -0.0, 1e-45, -1e-45, 3.4e38, -3.4e38, 1e30, 1.0, -1.0,
)  # fmt: skip
TEXTS = b"", b"battpos", b"\xff\xfe\x00\x01", b"heading", b"MB_LEARN", b"\x00" * 8
CELLS = (
    "nan", "0", "-0", "1e-320", "1e308", "-1e308", "1e9", "inf", "-inf", "9" * 300, "-1", "4294967296", "",
)  # fmt: skip
PLAUSIBLE = {
    "lat": 495_000_000, "lon": -579_000_000, "alt": -10_000, "fix_type": 3, "h_acc": 2000, "value": 0.3,
    "roll": 0.1, "pitch": -0.4, "yaw": 1.0, "vx": 0.3, "vy": 0.1, "vz": 0.0, "airspeed": 0.5,
}  # fmt: skip
SENDERS = (1, 1), (1, 1), (1, 1), (1, 25), (255, 190), (2, 1)


def make_bridge(folder: Path) -> Pipeline:
    """Return a bridge in `folder` that corrects, learns and navigates."""
    longitude, latitude = np.linspace(-58.2, -57.6, 61), np.linspace(49.2, 49.8, 61)
    anomaly = 100.0 * np.sin(longitude[None] * 90.0) * np.cos(latitude[:, None] * 70.0)
    write_grid(AnomalyGrid(longitude, latitude, anomaly), folder / "grid.nc")
    battery = Parameter("battpos", "", -1.0, 1.0, 0.0, 1.0)
    return small_bridge(folder, Start(START), battery, ("MAG_FIELD", "MAG_RAW", "HIGHRES_IMU"), CONFIG)


def _number(code: str, rng: random.Random) -> float | int:
    """Return an extreme number of a struct code."""
    if code in "fd":
        return rng.choice(FLOATS)
    size = 8 * struct.calcsize(code)
    low, high = (-(1 << size - 1), (1 << size - 1) - 1) if code.islower() else (0, (1 << size) - 1)
    return rng.choice((low, high, low + 1, high - 1, 0, 1, rng.randint(low, high)))


def _frame(codecs: dict[tuple[int, int], Codec], rng: random.Random) -> bytes:
    """Return a valid frame of any message with extreme and plausible fields."""
    layout = spec(rng.choice(tuple(MESSAGES)))
    values: dict[str, object] = {}
    for name, field in layout.fields.items():
        plausible = PLAUSIBLE.get(name)
        usable = plausible is not None and not field.count and (field.code in "fd" or type(plausible) is int)
        if usable and rng.random() < 0.5:
            values[name] = plausible
        if name == "name" and field.code == "s" and rng.random() < 0.5:
            values[name] = b"battpos"
        if name in values or rng.random() < 0.2:
            continue
        if field.code == "s":
            values[name] = rng.choice(TEXTS)[: field.count or 1]
        elif field.count and field.code == "B":
            values[name] = rng.randbytes(field.count)
        elif field.count:
            values[name] = [_number(field.code, rng) for _ in range(field.count)]
        else:
            values[name] = _number(field.code, rng)
    return codecs[rng.choice(SENDERS)].pack(layout.name, **values)


def _line(step: int, rng: random.Random) -> bytes:
    """Return a sensor's line: mostly a plausible reading, else extreme cells."""
    cells = [
        f"{rng.gauss(1000.0, 50.0):.1f}",
        f"{rng.gauss(2000.0, 50.0):.1f}",
        f"{rng.gauss(5e4, 50.0):.1f}",
    ]
    cells += ["4.0", f"{step * 0.1:.1f}", str(step)]
    if rng.random() < 0.3:
        for place in rng.sample(range(6), rng.randint(1, 6)):
            cells[place] = rng.choice(CELLS)
    return " ".join(cells).encode() + b"\n"


def events(count: int, seed: int) -> list[Event]:
    """Return seeded events: link frames, sensor lines, and pauses of up to an hour."""
    rng = random.Random(seed)
    codecs = {sender: Codec(*sender) for sender in SENDERS}
    time_us, out = START, []
    for step in range(count):
        time_us += rng.choice((0, 4, 1000, 100_000, 1_000_000))
        if rng.random() < 0.001:
            time_us += 3_600_000_000
        if rng.random() < 0.4:
            out.append(Event(time_us, Channel.SENSOR, _line(step, rng)))
        else:
            out.append(Event(time_us, Channel.LINK, _frame(codecs, rng)))
    return out


def main() -> None:
    """Feed the events; print the first that raises."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    OptionalParts.propagate = True
    begun, fed = time.monotonic(), 0
    while fed < given.events:
        with tempfile.TemporaryDirectory() as folder:
            bridge = make_bridge(Path(folder))
            for index, event in enumerate(events(min(20_000, given.events - fed), given.seed + fed)):
                try:
                    bridge.feed(event)
                except Exception:
                    print(f"seed {given.seed + fed}, event {index}: {event.channel!r} {event.data!r}")
                    raise
                fed += 1
                if fed % 1000 == 0:
                    bridge.recorder.drain()
    print(f"{fed} events in {time.monotonic() - begun:.0f} s: no exception", file=sys.stderr)


if __name__ == "__main__":
    main()
