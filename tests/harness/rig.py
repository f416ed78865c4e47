"""A bridge on the bench: the real ``magbridge run`` as a process, between a fluxgate and an autopilot.

The fluxgate sends into a pty, the autopilot on a UDP or TCP socket or a pty of its own. Both are played
by the caller of :meth:`Rig.until`: nothing happens in the background, so a test states in order what
goes wrong when.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from devices import SENSOR_HZ, TRUTH, TURN, Autopilot, Fluxgate
from small import aligned, polynomial
from standstill import standstill

from magbridge.calibration.file import save
from magbridge.calibration.model import CalibratedSensor, Calibration, Parameter
from magbridge.config import load
from magbridge.mavlink import Codec, Message, Signing
from magbridge.records import Quality
from sitl.replay.own_log import Recorded
from sitl.replay.stage import Stage

CONFIG = """\
[sensor]
driver = "{driver}"
port = "{port}"
timeout = 0.5
[sensor.options]
{options}
[link]
url = "{url}"
{signing}
[telemetry.battpos]
message = "NAMED_VALUE_FLOAT"
match = {{name = "battpos"}}
field = "value"
unit = "in"
max_age = 0.5
[calibration]
file = "cal.json"
[publish]
MAG_FIELD = 0
MAG_RAW = 10
HIGHRES_IMU = 10
NAMED_VALUE_FLOAT = 10
MAG_STATUS = 10
HEARTBEAT = 5
[log]
directory = "logs"
"""


OPTIONS = "sensitivity = 5e-5\nreference_voltage = 5.0"
STALE_BY = 0.2
"""s that the machine may stand still, of the last second, before telemetry can be stale for it: 0.5 s
is `max_age`."""

PATIENCE = 60.0
"""s that an event is waited for: on a busy machine a bridge takes many to start."""


class Received(NamedTuple):
    """A message of the bridge, and when it came (s, monotonic)."""

    when: float
    message: Message


class Rig:
    """A bridge, its sensor and its autopilot.

    Parameters
    ----------
    folder : Path
        Empty; holds the configuration, the log and the sensor's device.
    link : str
        ``udpout``, ``udpin``, ``tcp`` or ``serial``.
    key : bytes or None
        The signing key.
    stepped : bool
        The bridge sees a clock that :meth:`step` sets.
    more : str
        Further lines of the configuration.
    sensor : (str, str), optional
        Another driver, and its options.
    hz : float
        Of the sensor.
    """

    def __init__(
        self,
        folder: Path,
        link: str = "udpout",
        *,
        key: bytes | None = None,
        stepped: bool = False,
        more: str = "",
        sensor: tuple[str, str] = ("digitizer", OPTIONS),
        hz: float = SENSOR_HZ,
    ) -> None:
        self.folder, self.normal = folder, 0
        self.machine = standstill()
        self.received: list[Received] = []
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            place = f"127.0.0.1:{probe.getsockname()[1]}"
        self.url = f"serial:{folder / 'autopilot'}" if link == "serial" else f"{link}:{place}"
        (folder / "dev").mkdir()
        self.config = folder / "bridge.toml"
        self._sensor = sensor
        self.config.write_text(self.settings(self.url, key is not None) + more)
        save(calibration(), folder / "cal.json")
        if key is not None:
            (folder / "key.bin").write_bytes(key)
        self.offset = folder / "offset"
        self.offset.write_text("0")
        clock = [sys.executable, str(Path(__file__).with_name("stepped.py")), str(self.offset)]
        self._launch = clock if stepped else [str(Path(sys.executable).with_name("magbridge"))]
        options = load(self.config).sensor.options
        self.fluxgate = Fluxgate(folder / "dev", options, sensor[0], hz)
        self.autopilot = Autopilot(self.url, Codec(1, 1, Signing(key) if key else None))
        self.process: subprocess.Popen[bytes] | None = None

    def settings(self, url: str, signs: bool = False) -> str:
        """Return a configuration."""
        signing = 'signing_key = "key.bin"' if signs else ""
        driver, options = self._sensor
        port = self.folder / "dev" / "ttyUSB*"
        return CONFIG.format(driver=driver, options=options, port=port, url=url, signing=signing)

    def start(self) -> float:
        """Plug everything in and start the bridge; return the s until all is well."""
        if not list(self.fluxgate.folder.iterdir()):
            self.fluxgate.plug()
        self.autopilot.up()
        return self.restart()

    def restart(self) -> float:
        """Start the bridge; return the s until all is well."""
        begun, self.process = time.monotonic(), self.spawn(self.config)
        self.until_well()
        return self.since(begun)

    def spawn(self, config: Path) -> subprocess.Popen[bytes]:
        """Start a bridge."""
        return subprocess.Popen([*self._launch, "run", "--config", str(config)])

    def stop(self) -> int:
        """End the bridge as a user would; return its exit code."""
        assert self.process is not None
        self.process.terminate()
        return self.process.wait(10)

    def close(self) -> None:
        """End everything, in whatever state it is."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.autopilot.down()

    def step(self, seconds: float) -> None:
        """Set the clock that the bridge sees."""
        temporary = self.offset.with_suffix(".new")
        temporary.write_text(str(int(self.offset.read_text()) + round(seconds * 1e6)))
        temporary.replace(self.offset)

    @property
    def mark(self) -> int:
        """The present position in the stream of received messages."""
        return len(self.received)

    def since(self, begun: float, end: float | None = None) -> float:
        """Return the s from `begun` to `end` or now (monotonic) in which this machine did not stand still."""
        end = time.monotonic() if end is None else end
        return end - begun - self.machine.seconds(begun, end)

    def until(self, condition: Callable[[], object], timeout: float = PATIENCE) -> float:
        """Play sensor and autopilot until `condition` holds; return the s it took, as in :meth:`since`."""
        begun = time.monotonic()
        while not condition():
            if self.since(begun) > timeout:
                recent = "; ".join(self.texts())[-1500:]
                raise AssertionError(f"not within {timeout} s; said: {recent}; {self.status}")
            self.fluxgate.turn()
            now = time.monotonic()
            self.received += [Received(now, message) for message in self.autopilot.turn()]
            time.sleep(TURN)
        return self.since(begun)

    def run(self, seconds: float) -> None:
        """Advance the time."""
        begun = time.monotonic()
        self.until(lambda: self.since(begun) >= seconds, seconds + 5)

    def until_answered(self) -> None:
        """Ask the bridge for a parameter, and wait for the answer."""
        mark = self.mark
        self.autopilot.send_message(
            "PARAM_REQUEST_READ", target_system=1, target_component=191, param_index=0
        )
        self.until(lambda: self.of("PARAM_VALUE", mark))

    def until_well(self) -> float:
        """Wait for a run of good samples, a sensor and an autopilot; return the s to the first of the run.

        The first run counts: while the rest is waited for, a busy machine may be late with a sample.
        """
        begun, mark = time.monotonic(), self.mark

        def run() -> float | None:
            """Return when the first of five good samples on end came (s, monotonic)."""
            fields = [one for one in self.received[mark:] if one.message.name == "MAG_FIELD"]
            good = [one.message["flags"] == self.normal for one in fields]
            return next(
                (one.when for k, one in enumerate(fields) if len(good) > k + 4 and all(good[k : k + 5])), None
            )

        def well() -> bool:
            state = self.of("MAG_STATUS", mark)
            lines = bool(state) and state[-1]["sensor_state"] == state[-1]["autopilot_state"] == 1
            return lines and run() is not None

        self.until(well)
        return self.since(begun, run())

    def until_status(self, condition: Callable[[Message], object], timeout: float = PATIENCE) -> Message:
        """Wait for a MAG_STATUS from now on for which `condition` holds; return it."""
        mark = self.mark
        self.until(lambda: any(map(condition, self.of("MAG_STATUS", mark))), timeout)
        return next(status for status in self.of("MAG_STATUS", mark) if condition(status))

    def until_reported(self, text: str, mark: int, timeout: float = PATIENCE) -> float:
        """Wait until a STATUSTEXT since `mark` contains `text`; return the s that it took."""
        return self.until(lambda: any(text in line for line in self.texts(mark)), timeout)

    def of(self, name: str, mark: int = 0) -> list[Message]:
        """Return the messages of one kind heard since `mark`."""
        return [message for _, message in self.received[mark:] if message.name == name]

    def texts(self, mark: int = 0) -> list[str]:
        """Return the STATUSTEXTs since `mark`, put together again."""
        lines: list[str] = []
        for message in self.of("STATUSTEXT", mark):
            if message["chunk_seq"] and lines:
                lines[-1] += message["text"]
            else:
                lines.append(message["text"])
        return lines

    def flags(self, mark: int) -> str:
        """Return the names of all flags published since `mark`."""
        seen = 0
        for message in self.of("MAG_FIELD", mark):
            seen |= message["flags"]
        return Quality(seen & ~self.normal).names()

    def undue_flags(self, mark: int) -> str:
        """Return the same without those of late telemetry, where the machine or we stood still."""
        seen = 0
        for when, message in self.received[mark:]:
            if message.name == "MAG_FIELD":
                late = self.machine.seconds(when - 1.0, when) > STALE_BY or self.untold(when) > STALE_BY
                seen |= message["flags"] & ~(Quality.STALE_TELEMETRY if late else 0)
        seen &= ~Quality.LATE_JOIN  # a busy machine holds the process up; it has a test of its own
        return Quality(seen & ~self.normal).names()

    def untold(self, when: float) -> float:
        """Return the longest time (s) in which we sent no telemetry, of the second before `when`."""
        sent = [t for t in self.autopilot.reported if when - 1.0 < t < when]
        return max(after - before for before, after in pairwise([when - 1.0, *sent, when]))

    @property
    def status(self) -> dict[str, Any]:
        """The latest MAG_STATUS, fresh."""
        found = self.of("MAG_STATUS")
        return found[-1].fields if found else {}

    def fresh_status(self) -> dict[str, Any]:
        """Wait for the next MAG_STATUS."""
        return self.until_status(lambda _: True).fields

    @property
    def logs(self) -> list[Path]:
        """The log's files, in order."""
        return sorted((self.folder / "logs").glob("*.tlog"))

    def replay(self, files: list[Path] | None = None) -> tuple[Recorded, bytes]:
        """Replay the log through another bridge; return the recorded and the new output."""
        recorded, published = Recorded(files or self.logs), bytearray()
        Stage(self.config, published.extend).play(recorded.start, recorded.events())
        return recorded, bytes(published)


def calibration(slope: tuple[float, float, float] = (30.0, -20.0, 10.0)) -> Calibration:
    """A calibration with one moving mass, which changes nothing at its centre.

    `slope` is the nT by which the offset changes as the mass goes from there to the end of its range.
    """
    return polynomial(
        np.array([0.0] * 15 + [*slope]),
        Parameter("battpos", "in", -1.0, 2.0, 0.5, 1.5),
        field_nt=float(np.linalg.norm(TRUTH)),
        sensor=CalibratedSensor("digitizer"),
        boresight=aligned(),
    )
