"""Run ``magbridge run`` as a process between a simulated fluxgate and a simulated autopilot.

The fluxgate uses a pty; the autopilot uses a UDP socket, a TCP socket or a second pty. Both run only
within :meth:`Rig.until`. Nothing happens in the background, so a test states its faults in the order
in which they occur.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from devices import SENSOR_HZ, TRUTH, TURN, Autopilot, Fluxgate, udp_socket
from machine import standstill
from small import aligned, polynomial

from magbridge.calibration.file import save
from magbridge.calibration.model import CalibratedSensor, Calibration, Parameter
from magbridge.config import load
from magbridge.mavlink import Codec, Message, Signing
from magbridge.mavlink.enums import MAV_PARAM_TYPE
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
"""Pause of the machine (s, in the last second) above which telemetry may be late, as `max_age` is 0.5 s."""

PATIENCE = 60.0
"""Default time limit for an event, s: on a busy machine a bridge needs many seconds to start."""


class Received(NamedTuple):
    """Message of the bridge and its time of arrival (s, monotonic)."""

    when: float
    message: Message


class Rig:
    """Bridge process with its simulated sensor and autopilot.

    Parameters
    ----------
    folder : Path
        Empty folder for the configuration, the log and the sensor's device.
    link : str
        ``udpout``, ``udpin``, ``tcp`` or ``serial``.
    key : bytes or None
        The signing key.
    stepped : bool
        True if the bridge uses a clock that :meth:`step` can shift.
    more : str
        Text that is appended to the configuration.
    sensor : (str, str), optional
        Name of the sensor's driver, and its options.
    hz : float
         Sample rate of the sensor, Hz.
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
        with udp_socket() as probe:
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
        """Return the text of a configuration with the link `url`, and with a signing key if it `signs`."""
        signing = 'signing_key = "key.bin"' if signs else ""
        driver, options = self._sensor
        port = self.folder / "dev" / "ttyUSB*"
        return CONFIG.format(driver=driver, options=options, port=port, url=url, signing=signing)

    def start(self) -> float:
        """Connect sensor and autopilot and start the bridge; return the s until the output is normal."""
        if not list(self.fluxgate.folder.iterdir()):
            self.fluxgate.plug()
        self.autopilot.up()
        return self.restart()

    def start_alone(self) -> None:
        """Connect the sensor and start the bridge for a third-party peer in place of the autopilot."""
        self.fluxgate.plug()
        self.process = self.spawn(self.config)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter of the bridge as a station does."""
        fields = {"param_id": name, "param_value": value, "param_type": MAV_PARAM_TYPE.REAL32}
        self.autopilot.send_message("PARAM_SET", target_system=1, target_component=191, **fields)

    def restart(self) -> float:
        """Start the bridge process; return the s until the output is normal."""
        begun, self.process = time.monotonic(), self.spawn(self.config)
        self.until_well()
        return self.since(begun)

    def spawn(self, config: Path) -> subprocess.Popen[bytes]:
        """Start a bridge process with a configuration file."""
        return subprocess.Popen([*self._launch, "run", "--config", str(config)])

    def stop(self) -> int:
        """Send SIGTERM to the bridge; return its exit code."""
        assert self.process is not None
        self.process.terminate()
        return self.process.wait(10)

    def close(self) -> None:
        """Kill the bridge if it runs, and close the autopilot's link."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.autopilot.down()

    def step(self, seconds: float) -> None:
        """Advance the bridge's clock by `seconds`."""
        temporary = self.offset.with_suffix(".new")
        temporary.write_text(str(int(self.offset.read_text()) + round(seconds * 1e6)))
        temporary.replace(self.offset)

    @property
    def port(self) -> int:
        """Number of the link's UDP or TCP port."""
        return int(self.url.rpartition(":")[2])

    @property
    def mark(self) -> int:
        """Number of messages received until now."""
        return len(self.received)

    def since(self, begun: float, end: float | None = None) -> float:
        """Return the s from `begun` to `end` or now (monotonic), without pauses of this machine."""
        end = time.monotonic() if end is None else end
        return end - begun - self.machine.seconds(begun, end)

    def until(self, condition: Callable[[], object], timeout: float = PATIENCE) -> float:
        """Run sensor and autopilot until `condition` holds; return the s it took, as in :meth:`since`."""
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
        """Run sensor and autopilot for `seconds`."""
        begun = time.monotonic()
        self.until(lambda: self.since(begun) >= seconds, seconds + 5)

    def until_answered(self) -> None:
        """Request a parameter from the bridge, and wait for its reply."""
        mark = self.mark
        self.autopilot.send_message(
            "PARAM_REQUEST_READ", target_system=1, target_component=191, param_index=0
        )
        self.until(lambda: self.of("PARAM_VALUE", mark))

    def until_well(self) -> float:
        """Wait for five normal samples in a row and both lines up; return the s to the first of the samples.

        The first such run counts: a busy machine may deliver a later sample late.
        """
        begun, mark = time.monotonic(), self.mark

        def run() -> float | None:
            """Return the arrival (s, monotonic) of the first of five normal samples in a row, or None."""
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
        """Wait for a new MAG_STATUS for which `condition` holds; return the message."""
        mark = self.mark
        self.until(lambda: any(map(condition, self.of("MAG_STATUS", mark))), timeout)
        return next(status for status in self.of("MAG_STATUS", mark) if condition(status))

    def until_reported(self, text: str, mark: int, timeout: float = PATIENCE) -> float:
        """Wait until a STATUSTEXT since `mark` contains `text`; return the s that it took."""
        return self.until(lambda: any(text in line for line in self.texts(mark)), timeout)

    def of(self, name: str, mark: int = 0) -> list[Message]:
        """Return the messages `name` received since `mark`."""
        return [message for _, message in self.received[mark:] if message.name == name]

    def texts(self, mark: int = 0) -> list[str]:
        """Return the STATUSTEXTs since `mark`, each joined from its chunks."""
        lines: list[str] = []
        for message in self.of("STATUSTEXT", mark):
            if message["chunk_seq"] and lines:
                lines[-1] += message["text"]
            else:
                lines.append(message["text"])
        return lines

    def flags(self, mark: int) -> str:
        """Return the names of all abnormal flags published since `mark`."""
        seen = 0
        for message in self.of("MAG_FIELD", mark):
            seen |= message["flags"]
        return Quality(seen & ~self.normal).names()

    def undue_flags(self, mark: int) -> str:
        """Return :meth:`flags` without the flags that a pause of the machine or of this process explains."""
        seen = 0
        for when, message in self.received[mark:]:
            if message.name == "MAG_FIELD":
                late = self.machine.seconds(when - 1.0, when) > STALE_BY or self.untold(when) > STALE_BY
                seen |= message["flags"] & ~(Quality.STALE_TELEMETRY if late else 0)
        seen &= ~Quality.LATE_JOIN  # a busy machine causes it; another test covers this flag
        return Quality(seen & ~self.normal).names()

    def untold(self, when: float) -> float:
        """Return the longest gap (s) between telemetry messages in the second before `when`, s, monotonic."""
        sent = [t for t in self.autopilot.reported if when - 1.0 < t < when]
        return max(after - before for before, after in pairwise([when - 1.0, *sent, when]))

    @property
    def status(self) -> dict[str, Any]:
        """Fields of the latest received MAG_STATUS; empty if there is none."""
        found = self.of("MAG_STATUS")
        return found[-1].fields if found else {}

    def fresh_status(self) -> dict[str, Any]:
        """Wait for the next MAG_STATUS; return its fields."""
        return self.until_status(lambda _: True).fields

    @property
    def logs(self) -> list[Path]:
        """Log files in order of time."""
        return sorted((self.folder / "logs").glob("*.tlog"))

    def replay(self, files: list[Path] | None = None) -> tuple[Recorded, bytes]:
        """Replay the log files through a new bridge; return the recorded log and the new output."""
        recorded, published = Recorded(files or self.logs), bytearray()
        Stage(self.config, published.extend).play(recorded.start, recorded.events())
        return recorded, bytes(published)


def calibration(slope: tuple[float, float, float] = (30.0, -20.0, 10.0)) -> Calibration:
    """Return a calibration with one moving mass that corrects nothing if the mass is at its centre.

    `slope` is the change of the offset (nT) as the mass moves from its centre to the end of its range.
    """
    return polynomial(
        np.array([0.0] * 15 + [*slope]),
        Parameter("battpos", "in", -1.0, 2.0, 0.5, 1.5),
        field_nt=float(np.linalg.norm(TRUTH)),
        sensor=CalibratedSensor("digitizer"),
        boresight=aligned(),
    )
