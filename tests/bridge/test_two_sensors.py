"""Test a bridge with two sensors: ids, messages, comparison, and compensation of a scalar sensor."""

import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from devices import Ear, open_line
from fed import FedBridge, named
from msgspec.structs import replace
from small import START, aligned, polynomial

from magbridge.bridge import events
from magbridge.bridge.check import findings
from magbridge.bridge.events import StartEvent, port_number
from magbridge.bridge.pipeline import set_up
from magbridge.calibration.file import save
from magbridge.calibration.model import CalibratedSensor, Calibration
from magbridge.calibration.scalar import (
    PLATFORM_TERMS,
    ScalarChannel,
    ScalarNoise,
    ScalarSensor,
    ScalarSeries,
    correct_scalar,
)
from magbridge.config import load
from magbridge.errors import ConfigError
from magbridge.logs import read
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel, Quality
from sitl.replay.own_log import Recorded
from sitl.replay.stage import Stage

FIELD_NT = 50_000.0
PATIENCE_S = 60.0
"""Time limit for the bridge to start and publish, s."""
CONFIG = """\
[sensor.flux]
driver = "ascii"
port = "/dev/null"
calibration = "flux.json"
[sensor.flux.options]
columns = ["x", "y", "z", "time"]
[sensor.{name}]
driver = "ascii"
port = "/dev/null"
{settings}
[sensor.{name}.options]
columns = {columns}
[link]
url = "udpout:127.0.0.1:14550"
[publish]
MAG_FIELD = 0
[align]
reference_sigma = 30.0
[log]
directory = "logs"
"""


def scalar() -> ScalarSensor:
    """Return a compensation with a permanent, an induced and an eddy-current part."""
    size = PLATFORM_TERMS + 1
    coefficients = np.zeros(size)
    coefficients[:3] = 30.0, -20.0, 10.0
    coefficients[3:6] = 5.0, -3.0, 2.0
    coefficients[9] = 4.0
    return ScalarSensor(
        kind="scalar",
        column="tail",
        directions_from="mag",
        reference_field=FIELD_NT,
        channels=(),
        coefficients=tuple(coefficients.tolist()),
        covariance=tuple(map(tuple, (np.eye(size) * 0.01).tolist())),
        prior_sigma=(30.0,) * size,
        noise=ScalarNoise(0.05, 0.1),
        fitted_from=START * 1e-6,
        fitted_until=START * 1e-6,
    )


def calibration(*sensors: ScalarSensor) -> Calibration:
    """Return a calibration that changes nothing."""
    return polynomial(
        np.zeros(9), sensor=CalibratedSensor("ascii"), boresight=aligned(), sensors=sensors, field_nt=FIELD_NT
    )


class Bench(FedBridge):
    """Bridge with two sensors, and the messages that it sent."""

    def __init__(
        self, folder: Path, name: str, columns: str, settings: str, *sensors: ScalarSensor, more: str = ""
    ) -> None:
        save(calibration(*sensors), folder / "flux.json")
        save(calibration(), folder / "other.json")
        self.config = folder / "bridge.toml"
        text = CONFIG.format(name=name, columns=columns, settings=settings) + more
        self.config.write_text(text, encoding="utf-8")
        super().__init__(set_up(load(self.config), StartEvent(START)))
        for sensor_id in (0, 1):
            self.feed(0.0, Channel.STATE, events.port_state(port_number(sensor_id)))

    def vector(self, seconds: float, x: float, y: float, z: float, sensor_id: int = 0) -> None:
        """Send a line of a vector sensor."""
        line = b"%.3f %.3f %.3f %.6f\n" % (x, y, z, seconds)
        self.feed(seconds, Channel.SENSOR, line, sensor_id)

    def turn(self, samples: int, wrong: int, jump_at: int) -> None:
        """Send the lines of a vehicle that turns; the sensor `wrong` jumps by 300 nT at a sample."""
        random = np.random.default_rng(1)
        for k in range(samples):
            for sensor_id in (0, 1):
                total = FIELD_NT + (300.0 if sensor_id == wrong and k >= jump_at else 0.0)
                x, y, z = attitude(np.array([0.1 * k]))[0] * total / FIELD_NT + random.normal(size=3)
                self.vector(0.1 * k + 0.02 * sensor_id, x, y, z, sensor_id)

    def field(self, sensor_id: int) -> list[Message]:
        """Return the MAG_FIELDs of a sensor."""
        return [one for one in named(self.messages, "MAG_FIELD") if one["sensor_id"] == sensor_id]


VECTOR = '["x", "y", "z", "time"]', 'calibration = "other.json"'


def attitude(seconds: np.ndarray) -> np.ndarray:
    """Return the field (n, 3), nT, in the axes of a vehicle that turns."""
    yaw, tilt = 0.3 * seconds, 0.3 * np.sin(0.5 * seconds)
    axes = np.stack([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)], axis=1)
    return FIELD_NT * axes


def test_each_sensor_has_its_id_its_messages_and_its_state(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "tail", *VECTOR)
    for k in range(40):
        bench.vector(0.5 * k, 20_000.0 + k, 0.0, 40_000.0)
        bench.vector(0.5 * k + 0.1, 0.0, 20_000.0, 40_000.0 + k, sensor_id=1)
    assert len(bench.field(0)) == len(bench.field(1)) == 39  # the first line may have been half a line
    assert bench.field(1)[0]["y"] == pytest.approx(20_000.0)
    states_sent = named(bench.messages, "MAG_SENSOR")
    last = {(one["sensor_id"], one["name"], one["state"]) for one in states_sent[-2:]}
    assert last == {(0, "flux", 1), (1, "tail", 1)}
    assert states_sent[-1]["sample_rate"] == pytest.approx(2.0, rel=0.01)
    assert "tail sends readings" in "\n".join(bench.texts)


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_sensor_that_jumps_is_named_and_its_sigma_grows(tmp_path: Path, wrong: int) -> None:
    bench = Bench(tmp_path, "tail", *VECTOR)
    bench.turn(1200, wrong, jump_at=600)
    names = ["flux", "tail"]
    assert f"{names[wrong]} is wrong: " in "\n".join(bench.texts)
    last = [bench.field(0)[-1], bench.field(1)[-1]]
    assert last[wrong]["flags"] & Quality.IMPLAUSIBLE
    assert last[wrong]["total_field_sigma"] == pytest.approx(300.0, rel=0.1)
    assert not last[1 - wrong]["flags"] & Quality.IMPLAUSIBLE
    assert last[1 - wrong]["total_field_sigma"] < 5.0
    good = [one for one in bench.field(1 - wrong) if one["total_field_sigma"] > 5.0]
    assert len(good) < 60


@pytest.mark.parametrize(("jump_at", "is_used"), [(0, False), (600, True)])
def test_the_learner_does_not_use_samples_that_another_sensor_contradicts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump_at: int, is_used: bool
) -> None:
    """The sensor in the tail is wrong: a jump identifies it; without a jump, either sensor may be wrong."""
    bench = Bench(tmp_path, "tail", *VECTOR, more="[learning]\n")
    assert bench.bridge.learning is not None
    faulty: list[bool] = []
    learner = bench.bridge.learning.learner
    monkeypatch.setattr(learner, "sample", lambda *_, **values: faulty.append(values["faulty"]))
    bench.turn(jump_at + 200, 1, jump_at)
    assert set(faulty[-100:]) == {not is_used}


def test_a_scalar_needs_the_current_of_its_compensation(tmp_path: Path) -> None:
    size = PLATFORM_TERMS + 4
    needy = replace(
        scalar(),
        channels=(ScalarChannel("motor", 5.0, (0.0, 10.0), 0.0, 10.0, "A"),),
        coefficients=(0.0,) * size,
        covariance=tuple(map(tuple, np.eye(size).tolist())),
        prior_sigma=(30.0,) * size,
    )
    columns = '["total_field", "time"]'
    with pytest.raises(ConfigError, match=r"telemetry\.motor: missing"):
        Bench(tmp_path, "tail", columns, "", needy)
    motor = '[telemetry.motor]\nmessage = "NAMED_VALUE_FLOAT"\nfield = "value"\nunit = "'
    with pytest.raises(ConfigError, match="expected 'A'"):
        Bench(tmp_path, "tail", columns, "", needy, more=motor + 'deg"\n')
    Bench(tmp_path, "tail", columns, "", needy, more=motor + 'A"\n')
    Bench(tmp_path, "tail", columns, "")  # no calibration has the scalar: it is sent as read


def test_a_scalar_is_compensated_by_the_vector_of_its_time(tmp_path: Path) -> None:
    sensor = scalar()
    bench = Bench(tmp_path, "tail", '["total_field", "time"]', "", sensor)
    vector_times, scalar_times = np.arange(0.0, 60.0, 0.05), np.arange(0.51, 59.0, 0.1)
    vectors = attitude(scalar_times)
    known = ScalarSeries(
        START * 1e-6 + scalar_times, np.full(len(scalar_times), FIELD_NT), vectors,
        np.full(len(scalar_times), np.nan), np.zeros((len(scalar_times), 0)),
        np.full(len(scalar_times), np.nan),
    )  # fmt: skip
    disturbance = FIELD_NT - correct_scalar(sensor, known).field
    assert np.ptp(disturbance) > 50.0
    readings = FIELD_NT + disturbance
    events = sorted(
        [(t, 0, v) for t, v in zip(vector_times, attitude(vector_times), strict=True)]
        + [(t, 1, s) for t, s in zip(scalar_times, readings, strict=True)],
        key=lambda event: event[0],
    )
    for seconds, sensor_id, value in events:
        if sensor_id == 0:
            bench.vector(seconds, *value)
        else:
            bench.feed(seconds, Channel.SENSOR, b"%.4f %.6f\n" % (value, seconds), 1)
    fields = bench.field(1)[2:]
    assert len(fields) > 570
    error = np.array([one["total_field"] for one in fields]) - FIELD_NT
    assert np.abs(error).max() < 0.1
    assert all(one["flags"] == 0 and 0.05 < one["total_field_sigma"] < 2.0 for one in fields)
    assert all(np.isnan(one["x"]) for one in fields)
    assert max(one["latency"] for one in fields) < 0.25


def test_a_scalar_alone_needs_no_calibration(tmp_path: Path) -> None:
    path = tmp_path / "bridge.toml"
    text = (
        '[sensor]\ndriver = "ascii"\nport = "/dev/null"\nsigma = 0.5\n'
        '[sensor.options]\ncolumns = ["total_field"]\n[link]\nurl = "udpout:127.0.0.1:14550"\n'
    )
    path.write_text(text, encoding="utf-8")
    assert [fault for fault in findings(path) if fault.fatal] == []
    bridge = FedBridge(set_up(load(path), StartEvent(START)))
    for k in range(20):
        bridge.feed(k, Channel.SENSOR, b"%.4f\n" % (50_000.1234 + 0.1 * (k % 3)))
    fields = named(bridge.messages, "MAG_FIELD")
    assert fields[-1]["total_field"] == pytest.approx(50_000.2234, abs=1e-6)
    assert fields[-1]["total_field_sigma"] == pytest.approx(0.5)
    assert fields[-1]["flags"] == 0


def test_the_log_of_two_lines_and_a_socket_replays_to_the_same_bytes(tmp_path: Path) -> None:
    save(calibration(), tmp_path / "flux.json")
    save(calibration(), tmp_path / "other.json")
    (tmp_path / "dev").mkdir()
    lines = [open_line(tmp_path / "dev" / name)[0] for name in ("flux", "tail")]
    ear = Ear(255)
    with closing(ear.line):
        settings = "sigma = 0.2"
        text = CONFIG.format(name="tail", columns='["total_field"]', settings=settings)
        for name in ("flux", "tail"):
            text = text.replace("/dev/null", str(tmp_path / "dev" / name), 1)
        text = text.replace("14550", str(ear.line.getsockname()[1]))
        config = tmp_path / "bridge.toml"
        config.write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "magbridge", "run", "--config", str(config)]
        bridge = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        begun, sent = time.monotonic(), 0
        while len({one["sensor_id"] for one in ear.of("MAG_FIELD")}) < 2 or len(ear.of("MAG_FIELD")) < 80:
            assert time.monotonic() - begun < PATIENCE_S
            os.write(lines[0], b"20000.0 0.0 %d.0 %.3f\n" % (40_000 + sent % 3, time.monotonic()))
            os.write(lines[1], b"%.4f\n" % (44_721.3596 + 0.1 * (sent % 3)))
            sent += 1
            time.sleep(0.02)
        bridge.terminate()
        assert bridge.wait(10) == 0
    (log,) = (tmp_path / "logs").glob("*.tlog")
    recorded, published = Recorded([log]), bytearray()
    Stage(config, published.extend).play(recorded.start, recorded.events())
    assert bytes(published) == bytes(recorded.published)
    replayed = [one for one in Codec(0, 0).parse(bytes(published)) if one.name == "MAG_FIELD"]
    assert {one["sensor_id"] for one in replayed} == {0, 1}
    rows = read([log])
    known = rows["tail"].dropna("time").to_numpy()
    assert len(known) > 10
    assert 44_721.3 < known.min() <= known.max() < 44_721.6
    assert "tail_time" not in rows
    assert float(rows["mag_z"].max()) == 40_002.0
