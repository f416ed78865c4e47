"""Run a bridge for simulated hours at 1 kHz with random faults; check counts, memory and flags.

    python3 tools/soak.py                    2 minutes of the instrument's time
    python3 tools/soak.py --minutes 1440     a day: some hours of a core

The tool feeds the bytes of an emulated digitizer and of an autopilot to the bridge's pipeline. In the end,
readings made = samples + lost, as counted by MAG_STATUS. At most 0.3 % of the samples without a flag have an
error above three sigmas, as a Gaussian error has. The process's peak memory equals the peak at half
time. The tool prints a line for each hour of the instrument's time.
"""

from __future__ import annotations

import gc
import resource
import sys
import tempfile
from pathlib import Path

import numpy as np
from small import polynomial, write_bridge
from studies import command_line

from magbridge.bridge import events
from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.pipeline import set_up
from magbridge.calibration.model import CalibratedSensor, Calibration, Parameter
from magbridge.config import load
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel, Quality, Reading
from sitl.fluxgate import open_encoder

BEGIN_US = 1_780_000_000_000_000
TRUTH = np.array([20_000.0, 1_000.0, 40_000.0])
"""True field in sensor axes, nT."""
SLOPE = np.array([300.0, -200.0, 100.0])
"""Change of the field by a motion of the mass from 0 to 1, nT."""
FAULTS = ("unplugged", "damaged", "twice", "standstill", "spike", "moves")
EVERY = 5_000
"""Mean number of readings between two faults."""

MOST_WRONG = 0.003
"""Maximum fraction of the samples without a flag beyond 3 sigma; a Gaussian error has 0.0027."""
MOST_GROWN = 1000
"""Maximum growth of the process's peak memory in the second half, kB."""
HOUR = 3_600_000
"""Number of readings in an hour."""


def calibration() -> Calibration:
    """Return the exact calibration for a mass whose field is `SLOPE` times its position."""
    return polynomial(
        np.array([0.0] * 15 + [*SLOPE]),
        Parameter("battpos", "", -1.0, 1.0, 0.0, 1.0),
        field_nt=float(np.linalg.norm(TRUTH)),
        sensor=CalibratedSensor("digitizer"),
    )


class Soak:
    """Bridge with emulated instrument and autopilot, and counts of all readings."""

    def __init__(self, folder: Path, seed: int) -> None:
        options = "sensitivity = 5e-5, reference_voltage = 5.0"
        config = load(write_bridge(folder, calibration(), driver="digitizer", options=options, log=False))
        self.pipeline = set_up(config, StartEvent(BEGIN_US))
        self.encoder = open_encoder("digitizer", config.sensor.options)
        self.rng = np.random.default_rng(seed)
        self.made = self.published = self.wrong = self.flagged = 0
        self.done = dict.fromkeys(FAULTS, 0)
        self.position = 0.0
        self.later_us = 0
        self.status: Message | None = None
        self._ear, self._autopilot = Codec(0, 0), Codec(1, 1)

    def reading(self, extra: float = 0.0) -> bytes:
        """Return the bytes of the next reading, with `extra` nT on z; count the reading as made."""
        self.made += 1
        field = TRUTH + SLOPE * self.position + self.rng.normal(0.0, 1.0, 3) + [0.0, 0.0, extra]
        x, y, z = field.tolist()
        return self.encoder.encode(Reading((x, y, z), device_time=self.made * 1e-3 % 4294.967296, supply=3.7))

    def feed(self, channel: Channel, data: bytes) -> None:
        """Feed bytes to the bridge now, and check the messages that it sends."""
        event = Event(BEGIN_US + self.made * 1000 + 400 + self.later_us, channel, data)
        for _, frame in self.pipeline.feed(event):
            for message in self._ear.parse(frame):
                if message.name == "MAG_STATUS":
                    self.status = message
                if message.name != "MAG_FIELD":
                    continue
                self.published += 1
                flags = message["flags"] & ~Quality.NO_BORESIGHT
                error = abs(message["total_field"] - float(np.linalg.norm(TRUTH)))
                self.flagged += flags != 0
                self.wrong += flags == 0 and not error <= 3.0 * message["total_field_sigma"]

    def account(self) -> str:
        """Return a text with the numbers of flagged samples and of wrong samples without a flag."""
        return f"flagged {self.flagged}, wrong without a flag {self.wrong}"

    def telemetry(self) -> None:
        """Feed a message with the mass's position to the bridge."""
        frame = self._autopilot.pack("NAMED_VALUE_FLOAT", name="battpos", value=self.position)
        self.feed(Channel.LINK, frame)

    def fault(self) -> None:
        """Cause a random fault."""
        which = FAULTS[self.rng.integers(len(FAULTS))]
        self.done[which] += 1
        if which == "unplugged":  # mostly for seconds, at times for three turns of the counter
            for _ in range(int(10 ** self.rng.uniform(0.0, 5.3))):
                self.made += 1
                self.encoder.sequence += 1
            self.telemetry()
        elif which == "damaged":
            self.feed(Channel.SENSOR, self.reading()[:20] + b"\xff\x00")
        elif which == "twice":
            self.feed(Channel.SENSOR, self.reading())
            self.feed(Channel.LINK, b"\xfd\x00noise")
        elif which == "standstill":
            count = int(self.rng.integers(500, 3000))
            waited = b"".join([self.reading() for _ in range(count)])
            end_us = BEGIN_US + self.made * 1000 + 400
            self.feed(Channel.STATE, events.standstill(end_us, count * 1000))
            self.telemetry()
            self.feed(Channel.SENSOR, waited)
        elif which == "spike":
            self.feed(Channel.SENSOR, self.reading(extra=500.0))
        else:
            self.telemetry()
            self.position = float(self.rng.uniform(-1.0, 1.0))
            self.telemetry()


def peak() -> int:
    """Return the peak memory of this process so far, kB."""
    gc.collect()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> int:
    chosen = command_line(__doc__, minutes=2.0, seed=1)
    with tempfile.TemporaryDirectory() as name:
        soak = Soak(Path(name), chosen.seed)
        last = round(chosen.minutes * 60_000)
        half = told = 0
        while soak.made < last:
            if soak.made % 100 == 0:
                soak.telemetry()
            soak.feed(Channel.SENSOR, soak.reading())
            if soak.rng.random() < 1.0 / EVERY and soak.made > 20_000:
                soak.fault()
            if soak.made >= told + HOUR:
                told = soak.made
                print(f"{told / HOUR:.1f} h: {soak.account()}, {peak()} kB", flush=True)
            if not half and soak.made > last // 2:  # the caches are full by now
                half = peak()
        for _ in range(3):
            soak.feed(Channel.SENSOR, soak.reading())
        grown = peak() - half
        soak.later_us = 2_000_000
        soak.feed(Channel.STATE, b"")  # to receive the last status
        assert soak.status is not None
        lost, samples = soak.status["samples_lost"], soak.status["samples"]
    print(f"made {soak.made}, published {samples}, lost {lost}: difference {soak.made - samples - lost}")
    print(f"{soak.account()}, memory's peak {half} kB at half time, grown by {grown} kB")
    print(", ".join(f"{what} {count}" for what, count in soak.done.items()))
    plain = soak.published - soak.flagged
    print(f"beyond 3 sigma {100 * soak.wrong / max(plain, 1):.2f} % of {plain}")
    return int(soak.made != samples + lost or soak.wrong > MOST_WRONG * plain or grown > MOST_GROWN)


if __name__ == "__main__":
    sys.exit(main())
