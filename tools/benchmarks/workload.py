"""Make the bridge's input for every benchmark: one configuration, one calibration, one stream of events.

The corrected field is the Earth's at the vehicle's position, plus noise. Another field would make the bridge
treat the sensor as faulty.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from math import atan2, cos, sin
from pathlib import Path
from random import Random

import numpy as np
from small import aligned, polynomial, write_bridge

from magbridge.bridge.events import Event
from magbridge.calibration.model import Boresight, Calibration, Parameter
from magbridge.mavlink import Codec
from magbridge.records import Channel, Reading
from sitl.fluxgate import Encoder, open_encoder

BEGIN_US = 1_750_000_000_000_000
TELEMETRY_HZ = 20
TELEMETRY = ("battpos",) * 8 + ("ballast",) * 8 + ("ATTITUDE",) * 3 + ("GLOBAL_POSITION_INT",)
"""Messages of one second, in addition to the autopilot's heartbeat."""
HORIZONTAL, VERTICAL, NOISE = 19_000.0, 48_640.0, 0.5
"""Horizontal and vertical field at 49.5 N, 57.8 W, and noise of an axis, nT."""
IRON_NT = 0.02
"""Standard deviation of the coefficients, nT; larger values would be a fault, as the input has no iron."""
DECLINATION = -0.32
"""Magnetic declination, rad."""
OPTIONS = {"sensitivity": 5e-5, "reference_voltage": 5.0}


def calibration() -> Calibration:
    """Return a full cubic calibration in two masses: 90 coefficients with a full covariance."""
    random = np.random.default_rng(1)
    size = 90
    root = random.normal(size=(size, size))
    return polynomial(
        random.normal(size=size) * IRON_NT,
        Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0),
        Parameter("ballast", "cm3", 0.0, 400.0, 200.0, 200.0),
        field_nt=52_217.0,
        covariance=root @ root.T / size,
        boresight=Boresight((0.01, -0.02, 0.03), aligned().covariance),
    )


def write_config(
    folder: Path, port: str = "/dev/null", url: str = "udpout:127.0.0.1:14550", more: str = ""
) -> Path:
    """Write ``cal.json``, and ``bridge.toml`` with `more` text, to `folder`; return the latter's path."""
    return write_bridge(
        folder,
        calibration(),
        driver="digitizer",
        options=", ".join(f"{name} = {value}" for name, value in OPTIONS.items()),
        port=port,
        url=url,
        masses={"battpos": "in", "ballast": "cm3"},
        publish={"MAG_RAW": 0, "MAG_FIELD": 0, "HIGHRES_IMU": 0, "NAMED_VALUE_FLOAT": 1},
        more=more,
    )


class Feed:
    """Source of a digitizer's and an autopilot's bytes; unless `moving`, masses rest 9 s of 10."""

    def __init__(self, *, moving: bool = False) -> None:
        self._moving = moving
        self._autopilot = Codec(1, 1)
        self._fluxgate: Encoder = open_encoder("digitizer", OPTIONS)
        self._messages = count()
        self._samples = count()
        self._random = Random(1)

    def events(self, seconds: int, hertz: int, begin_us: int) -> Iterator[Event]:
        """Yield the events of `seconds`: `hertz` readings and 20 messages a second, and the heartbeat."""
        for second in range(seconds):
            start_us = begin_us + second * 1_000_000
            due = [(start_us, Channel.LINK, -1)]
            first_us, step_us = start_us + 500, 1_000_000 // TELEMETRY_HZ
            due += [(first_us + i * step_us, Channel.LINK, i) for i in range(TELEMETRY_HZ)]
            due += [(start_us + i * 1_000_000 // hertz + 3000, Channel.SENSOR, i) for i in range(hertz)]
            for time_us, channel, index in sorted(due):
                data = self.reading(hertz) if channel is Channel.SENSOR else self.message(time_us)
                yield Event(time_us & ~3, channel, self.heartbeat() if index < 0 else data)

    def reading(self, hertz: int) -> bytes:
        """Return the next frame of the digitizer, at a sample rate of `hertz`."""
        t = next(self._samples) / hertz
        noise = self._random.gauss
        x = HORIZONTAL * sin(0.1 * t) + noise(0.0, NOISE)
        y = HORIZONTAL * cos(0.1 * t) + noise(0.0, NOISE)
        z = VERTICAL + noise(0.0, NOISE)
        delay = 0.1 / hertz
        delays = 0.0, delay, 2 * delay
        one = Reading((x, y, z), device_time=t, channel_delay=delays, temperature=12.5, supply=3.7)
        return self._fluxgate.encode(one)

    def heartbeat(self) -> bytes:
        """Return the frame of the autopilot's heartbeat."""
        return self._autopilot.pack("HEARTBEAT", type=12, autopilot=0, system_status=4, mavlink_version=3)

    def message(self, time_us: int) -> bytes:
        """Return the frame of the autopilot's next telemetry message."""
        number = next(self._messages)
        name = TELEMETRY[number * 7 % TELEMETRY_HZ]
        boot_ms = (time_us - BEGIN_US) // 1000 % (1 << 32)
        t = number / TELEMETRY_HZ
        if name == "ATTITUDE":
            yaw = DECLINATION + atan2(-cos(0.1 * t), sin(0.1 * t))
            return self._autopilot.pack(name, time_boot_ms=boot_ms, roll=0.02 * sin(t), pitch=-0.03, yaw=yaw)
        if name == "GLOBAL_POSITION_INT":
            place = {"lat": 495_000_000 + number, "lon": -578_000_000, "alt": -50_000}
            return self._autopilot.pack(name, time_boot_ms=boot_ms, **place)
        travel = sin(t) if self._moving or t % 10.0 > 9.0 else 0.3 + 1e-4 * (number % 3)
        value = travel if name == "battpos" else 200.0 + 150.0 * travel
        return self._autopilot.pack("NAMED_VALUE_FLOAT", time_boot_ms=boot_ms, value=value, name=name)
