"""Test the live heading: its computation from the corrected vector, and its messages."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from functools import reduce
from math import atan2, degrees, hypot, nan, radians, sqrt
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from devices import serial_line, udp_socket
from fed import fed, named
from small import START, aligned, polynomial, write_bridge

from magbridge.bridge.check import findings
from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.pipeline import set_up
from magbridge.config import load
from magbridge.field.igrf import igrf
from magbridge.link.estimates import NO_ATTITUDE, nmea_sentences
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel, Quality

PLACE = (49.5, -57.9)
ROLL, PITCH, YAW = radians(8.0), radians(-20.0), radians(130.0)
ARDUPILOT, PX4 = 3, 12
MAIN = igrf(PLACE[1], PLACE[0], 0.0, START * 1e-6)[0]


def body_field(roll: float = ROLL, pitch: float = PITCH, yaw: float = YAW) -> np.ndarray:
    """Return the main field in body axes, nT."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(one), np.cos(one)) for one in (roll, pitch, yaw))
    to_level = np.array([[cp, sr * sp, cr * sp], [0.0, cr, -sr], [-sp, sr * cp, cr * cp]])
    turn = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((turn @ to_level).T @ MAIN)


def bridge_with(
    folder: Path, heading: str = "", *, boresight: bool = True, port: str = "/dev/null",
    link: str = "udpout:127.0.0.1:14550",
) -> Path:  # fmt: skip
    """Write a configuration with a calibration that changes nothing; return its path."""
    turn = aligned(radians(0.2) ** 2) if boresight else None
    known = polynomial(np.zeros(9), variance=1e-4, noise_nt=5.0, method="nominal", boresight=turn)
    return write_bridge(
        folder, known, options='columns = ["x", "y", "z", "time"]', port=port, url=link, masses={},
        log=False, publish={"MAG_FIELD": 0, "ATTITUDE_QUATERNION_COV": 0}, more=f"[heading]\n{heading}\n",
    )  # fmt: skip


def attitude(time_us: int, **fields: float) -> Event:
    values = {"roll": ROLL, "pitch": PITCH, "yaw": 0.3} | fields
    return Event(time_us, Channel.LINK, Codec(1, 1).pack("ATTITUDE", **values))


def begin(stack: int = ARDUPILOT) -> list[Event]:
    place = {"lat": round(PLACE[0] * 1e7), "lon": round(PLACE[1] * 1e7)}
    frame = Codec(1, 1).pack("GLOBAL_POSITION_INT", **place)
    beat = Codec(1, 1).pack("HEARTBEAT", autopilot=stack, type=1)
    return [Event(START, Channel.LINK, frame), Event(START, Channel.LINK, beat)]


def sample(time_us: int, field: np.ndarray) -> Event:
    line = b"%.2f %.2f %.2f %.6f\r\n" % (*field.tolist(), (time_us - START) * 1e-6)
    return Event(time_us, Channel.SENSOR, line)


def last(messages: list[Message], name: str) -> Message:
    return named(messages, name)[-1]


def level_flight(stack: int = ARDUPILOT, seconds: int = 3) -> list[Event]:
    events = begin(stack)
    for tenth in range(1, 10 * seconds):
        time_us = START + 100_000 * tenth
        events += [attitude(time_us - 10_000), sample(time_us, body_field())]
    return events


def test_heading_of_the_corrected_field_whatever_the_autopilots_yaw(tmp_path: Path) -> None:
    bridge = set_up(load(bridge_with(tmp_path)), StartEvent(START))
    messages = fed(bridge, *level_flight())
    field = last(messages, "MAG_FIELD")
    declination = degrees(atan2(MAIN[1], MAIN[0]))
    assert field["heading"] == pytest.approx(130.0, abs=0.05)
    assert field["magnetic_heading"] == pytest.approx(130.0 - declination, abs=0.05)
    assert 0.4 < field["heading_sigma"] < 3.0
    pose = last(messages, "ATTITUDE_QUATERNION_COV")
    assert pose["q"][0] ** 2 + pose["q"][3] ** 2 < 1.0
    assert sqrt(pose["covariance"][8]) == pytest.approx(radians(field["heading_sigma"]), rel=1e-5)


def test_the_heading_of_an_implausible_sample_is_unknown(tmp_path: Path) -> None:
    """The sensor fails; ATTITUDE_QUATERNION_COV has no flags that would say so."""
    bridge = set_up(load(bridge_with(tmp_path)), StartEvent(START))
    fed(bridge, *level_flight())
    time_us = START + 4_000_000
    messages = fed(bridge, attitude(time_us - 10_000), sample(time_us, 2.0 * body_field()))
    assert last(messages, "MAG_FIELD")["flags"] & Quality.IMPLAUSIBLE
    assert last(messages, "MAG_FIELD")["heading_sigma"] > 100.0
    assert sqrt(last(messages, "ATTITUDE_QUATERNION_COV")["covariance"][8]) > radians(100.0)


def test_heading_sigma_covers_errors_of_tilt(tmp_path: Path) -> None:
    bridge = set_up(load(bridge_with(tmp_path, "tilt_sigma = 0.5")), StartEvent(START))
    rng, ratios = np.random.default_rng(4), []
    fed(bridge, *begin())
    for tenth in range(400):
        time_us = START + 4_000_000 + 100_000 * tenth
        wrong = rng.normal(size=2) * radians(0.5)
        tilted = attitude(time_us - 1000, roll=ROLL + wrong[0], pitch=PITCH + wrong[1], yaw=YAW)
        field = last(fed(bridge, tilted, sample(time_us, body_field())), "MAG_FIELD")
        error = (field["heading"] - 130.0 + 180.0) % 360.0 - 180.0
        ratios.append(error / field["heading_sigma"])
    # the sigma also contains declination and boresight, which do not change here
    assert 0.4 < np.std(ratios) < 1.1


def test_no_heading_without_attitude_or_with_an_old_one(tmp_path: Path) -> None:
    bridge = set_up(load(bridge_with(tmp_path)), StartEvent(START))
    field = last(fed(bridge, *begin(), sample(START + 100_000, body_field())), "MAG_FIELD")
    assert field["heading_sigma"] == 0.0
    known = last(fed(bridge, attitude(START + 150_000), sample(START + 200_000, body_field())), "MAG_FIELD")
    assert known["heading_sigma"] > 0.0
    stale = last(fed(bridge, sample(START + 2_500_000, body_field())), "MAG_FIELD")
    assert stale["heading_sigma"] == 0.0


def test_a_turning_vehicle_is_levelled_at_the_time_of_the_sample(tmp_path: Path) -> None:
    bridge = set_up(load(bridge_with(tmp_path)), StartEvent(START))
    fed(bridge, *level_flight())
    rate, late = radians(30.0), 0.2
    events = [attitude(START + 4_000_000, rollspeed=rate)]
    events.append(sample(START + 4_200_000, body_field(roll=ROLL + rate * late)))
    field = last(fed(bridge, *events), "MAG_FIELD")
    assert field["heading"] == pytest.approx(130.0, abs=0.1)
    assert field["heading_sigma"] > 2.0  # half of an extrapolation by 6 deg is not known


def test_magnetic_heading_alone_where_the_position_is_unknown(tmp_path: Path) -> None:
    bridge = set_up(load(bridge_with(tmp_path)), StartEvent(START))
    field = last(fed(bridge, *level_flight()[1:]), "MAG_FIELD")
    assert field["heading"] != field["heading"]
    assert field["magnetic_heading"] == pytest.approx(130.0 - degrees(atan2(MAIN[1], MAIN[0])), abs=0.05)


@pytest.mark.parametrize("stack", [ARDUPILOT, PX4])
@pytest.mark.parametrize("send", ["odometry", "vision_position_estimate"])
def test_autopilots_read_the_sigma_that_was_sent(tmp_path: Path, send: str, stack: int) -> None:
    """ArduPilot takes the cube root of a sum of squares (GCS_Common.cpp), PX4 entry 20 of the covariance."""
    bridge = set_up(load(bridge_with(tmp_path, f'send = "{send}"')), StartEvent(START))
    messages = fed(bridge, *level_flight(stack))
    message, sigma = last(messages, send.upper()), radians(last(messages, "MAG_FIELD")["heading_sigma"])
    is_odometry = send == "odometry"
    covariance = message["pose_covariance" if is_odometry else "covariance"]
    if stack == PX4:
        assert sqrt(covariance[20]) == pytest.approx(sigma, rel=1e-5)
        assert all(np.isfinite(covariance))
        unknown = [sqrt(covariance[k]) for k in (0, 6, 11, 15, 18)]  # of x, y, z, roll and pitch
        assert min(unknown) >= 100.0
    else:
        squares = covariance[15] ** 2 + covariance[18] ** 2 + covariance[20] ** 2
        assert np.cbrt(squares) == pytest.approx(sigma, rel=1e-5)
        assert (message["x"], message["y"], message["z"]) == (0.0, 0.0, 0.0)
    if is_odometry:
        w, x, y, z = message["q"]
        yaw = degrees(atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        assert (message["frame_id"], message["child_frame_id"]) == (1 if stack == PX4 else 20, 12)
    else:
        yaw = degrees(message["yaw"])
    assert yaw == pytest.approx(130.0, abs=0.1)
    assert 9 * 2 <= sum(one.name == send.upper() for one in messages) <= 10 * 3


def test_nothing_goes_to_the_autopilot_without_boresight(tmp_path: Path) -> None:
    path = bridge_with(tmp_path, 'send = "odometry"', boresight=False)
    messages = fed(set_up(load(path), StartEvent(START)), *level_flight())
    assert not any(one.name == "ODOMETRY" for one in messages)
    assert any("no boresight: no heading is sent" in one.text for one in findings(path))


def test_nmea_sentences() -> None:
    pose = NO_ATTITUDE._replace(
        magnetic=359.96, heading=341.3, sigma=0.75, declination=-18.66, roll=0.1, pitch=-0.2, tilt_sigma=0.005
    )
    sentences = nmea_sentences(pose, START + 250_000).decode().split("\r\n")
    assert [one.split("*")[0] for one in sentences[:2]] == ["$HCHDG,0.0,0.0,E,18.7,W", "$HCHDT,341.3,T"]
    fields = sentences[2].split("*")[0].split(",")
    assert fields[0] == "$PASHR"
    assert fields[1].endswith(".250")
    assert fields[2:] == ["341.30", "T", "+5.73", "-11.46", "", "0.286", "0.286", "0.750", "0", "0"]
    for sentence in sentences[:-1]:
        body, _, checksum = sentence[1:].partition("*")
        assert int(checksum, 16) == reduce(xor, body.encode())
    magnetic_only = nmea_sentences(pose._replace(heading=nan, declination=nan), START)
    assert magnetic_only.startswith(b"$HCHDG,0.0,0.0,E,,*")
    assert magnetic_only.count(b"$") == 1


def test_sentences_and_messages_through_real_sockets(tmp_path: Path) -> None:
    """The running program reads a pty, and sends the heading by MAVLink and by NMEA."""
    codec, seen, sentences = Codec(0, 0), set[str](), b""
    with serial_line() as (sensor, name), udp_socket(20.0) as link, udp_socket(0.0) as ear:
        path = bridge_with(
            tmp_path, f'send = "odometry"\nnmea = "udp:127.0.0.1:{ear.getsockname()[1]}"', port=name,
            link=f"udpout:127.0.0.1:{link.getsockname()[1]}",
        )  # fmt: skip
        process = subprocess.Popen([sys.executable, "-m", "magbridge", "run", "--config", str(path)])
        try:
            _, peer = link.recvfrom(2048)
            link.settimeout(0.05)
            for step in range(600):
                for event in (*begin(), attitude(START)):
                    link.sendto(event.data, peer)
                os.write(sensor, b"%.2f %.2f %.2f %.3f\r\n" % (*body_field().tolist(), 0.05 * step))
                with suppress(TimeoutError):
                    while data := link.recv(2048):
                        seen |= {one.name for one in codec.parse(data)}
                with suppress(BlockingIOError):
                    sentences += ear.recv(2048)
                if "ODOMETRY" in seen and b"$HCHDT" in sentences:
                    break
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0
    assert {"MAG_FIELD", "ATTITUDE_QUATERNION_COV", "ODOMETRY"} <= seen
    heading = float(sentences.split(b"$HCHDT,")[1].split(b",")[0])
    assert heading == pytest.approx(130.0, abs=0.3)
    assert hypot(*MAIN[:2]) > 10_000.0


@pytest.mark.parametrize(
    ("status", "field"), [("EKF_STATUS_REPORT", "velocity_variance"), ("ESTIMATOR_STATUS", "vel_ratio")]
)
def test_an_autopilot_that_contradicts_its_sensors_gives_no_good_heading(
    status: str, field: str, tmp_path: Path
) -> None:
    """Roll and pitch of a real ArduPlane under a jammed receiver were wrong by tens of degrees."""
    sigmas = []
    for ratio in (0.1, 5.0):
        bridge = set_up(load(bridge_with(tmp_path)), StartEvent(START))
        report = Event(START, Channel.LINK, Codec(1, 1).pack(status, **{field: ratio}))
        sent = fed(bridge, *[*begin(), report, *level_flight()])
        sigmas.append(last(sent, "MAG_FIELD")["heading_sigma"])
    assert sigmas[0] < 2.0
    assert sigmas[1] > 20.0
