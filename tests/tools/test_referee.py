"""Test that the emulated autopilots keep the real rules, and that the bridge does not diverge with them."""

from functools import cache, partial
from math import nan
from typing import Any

import numpy as np
import pytest
from closed_loop import rms
from passages import BACK, LAST, LOST, OPTIONS, PLACE, hills, passage
from referee import ArduPilot, Autopilot, Px4, Truth
from referee.ardupilot import COPTER_RATES_HZ, PLANE_RATES_HZ
from referee.autopilot import PositionFilter
from referee.loop import Run, sail
from referee.px4 import PX4_RATES_HZ

from magbridge.bridge.motion import Motion
from magbridge.config import Link
from magbridge.link.component import Component
from magbridge.link.estimates import Kind
from magbridge.link.telemetry import needed_rates
from magbridge.mavlink import Codec, spec

BRIDGE = Codec(1, 191)
FIXED_WING = 1
"""MAV_TYPE of a fixed-wing aircraft."""
ORIGIN = (*PLACE, 0.0)
START_US = 1_780_000_000_000_000
POSE = {
    "frame_id": 20, "child_frame_id": 12, "x": 30.0, "y": 0.0, "z": 0.0, "q": (1.0, 0.0, 0.0, 0.0),
    "pose_covariance": (4.0,) * 21, "quality": 100,
}  # fmt: skip
HERE = {"lat": round(PLACE[0] * 1e7) + 2700, "lon": round(PLACE[1] * 1e7), "eph": 5.0, "id": 1}
"""Position 30 m north of `PLACE`, in 1e-7 deg."""


STACKS: dict[str, type[Autopilot]] = {"ArduPilot": ArduPilot, "Px4": Px4}


def flown(make: type[Autopilot], gps_lost: int, **settings: Any) -> tuple[Autopilot, int]:
    """Return an autopilot at rest that had GPS for 30 s and has none for `gps_lost` s, and the time."""
    autopilot = make(ORIGIN, START_US, **settings)
    for k in range(30 + gps_lost):
        autopilot.step(START_US + k * 1_000_000, Truth(PLACE, 0.0, 0.0, 0.0, 0.0, PLACE if k < 30 else None))
    return autopilot, START_US + (30 + gps_lost) * 1_000_000


def external(autopilot: Autopilot, time_us: int, **fields: Any) -> int:
    """Send EXTERNAL_POSITION_ESTIMATE 30 m north; return the result."""
    given = {"param2": 0.0, "param3": 7.0, "x": HERE["lat"], "y": HERE["lon"], "frame": 0, "command": 43003}
    answer = autopilot.receive(BRIDGE.pack("COMMAND_INT", **{**given, **fields}), time_us)
    return int(Codec(255, 1).parse(answer)[0]["result"])


def test_ardupilot_answers_as_its_filter_does() -> None:
    autopilot, now_us = flown(ArduPilot, 0)
    assert external(autopilot, now_us - 500_000) == 4, "GPS aids"
    autopilot, now_us = flown(ArduPilot, 5)
    assert external(autopilot, now_us, frame=1) == 2
    assert external(autopilot, now_us) == 0
    assert autopilot.filter.position == pytest.approx((30.0, 0.0), abs=0.1)
    assert autopilot.filter.sigma == pytest.approx(7.0)
    assert external(autopilot, now_us, param3=nan) == 0
    assert autopilot.filter.sigma == pytest.approx(0.5), "a sigma that is none is the least"
    rover, now_us = flown(ArduPilot, 10, airspeed=False)
    assert external(rover, now_us) == 0
    rover, now_us = flown(ArduPilot, 20, airspeed=False)
    assert external(rover, now_us) == 4, "after 15 s nothing aids it"


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        ({}, "fused"),
        ({"frame_id": 1}, "dropped: frame"),
        ({"child_frame_id": 8}, "dropped: frame"),
        ({"z": nan}, "dropped: pose"),
        ({"q": (nan,) * 4}, "dropped: pose"),
        ({"quality": -1}, "dropped: quality"),
    ],
)
def test_ardupilot_takes_odometry_in_one_form_only(change: dict[str, Any], outcome: str) -> None:
    autopilot, now_us = flown(ArduPilot, 5)
    autopilot.receive(BRIDGE.pack("ODOMETRY", **{**POSE, **change}), now_us)
    assert dict(autopilot.taken) == {outcome: 1}


def test_px4_takes_its_sensor_by_id_and_believes_a_nan_to_a_metre() -> None:
    autopilot, now_us = flown(Px4, 5)
    for change in ({"id": 0}, {"id": 2}):
        autopilot.receive(BRIDGE.pack("GLOBAL_POSITION_SENSOR", **{**HERE, **change}), now_us)
    assert dict(autopilot.taken) == {"dropped: id": 2}
    before = autopilot.filter.position[0]
    autopilot.receive(BRIDGE.pack("GLOBAL_POSITION_SENSOR", **{**HERE, "eph": nan}), now_us + 60_000_000)
    assert autopilot.filter.position[0] > before + 25.0
    assert autopilot.filter.sigma < 1.0


def test_px4_refuses_an_external_position_only_if_it_is_not_a_number() -> None:
    autopilot, now_us = flown(Px4, 0)
    now_us -= 500_000
    assert external(autopilot, now_us, param2=nan) == 1
    autopilot.filter.wind = 3.0, 0.0
    assert external(autopilot, now_us) == 0, "with GPS: a hard reset"
    assert autopilot.filter.wind == (0.0, 0.0)
    autopilot, now_us = flown(Px4, 60)
    for k in range(10):
        external(autopilot, now_us + k, param3=30.0)
    assert autopilot.filter.sigma < 15.0, "since December 2025 it is fused"


def test_ardupilot_reports_that_nothing_aids() -> None:
    rover, now_us = flown(ArduPilot, 20, airspeed=False)
    report = rover.step(now_us + 1_000_000, Truth(PLACE, 0.0, 0.0, 0.0, 0.0, None))
    flags = next(m["flags"] for m in Codec(255, 1).parse(report) if m.name == "EKF_STATUS_REPORT")
    assert flags & 128


@pytest.mark.parametrize(
    ("make", "rates", "before", "status"),
    [
        (ArduPilot, PLANE_RATES_HZ, 1.0, "EKF_STATUS_REPORT"),
        (ArduPilot, COPTER_RATES_HZ, 0.0, "EKF_STATUS_REPORT"),
        (Px4, PX4_RATES_HZ, 15.0, "ESTIMATOR_STATUS"),
    ],
)
def test_the_bridge_requests_the_rates_that_a_started_autopilot_does_not_send(
    make: type[Autopilot], rates: dict[str, float], before: float, status: str
) -> None:
    autopilot = make(ORIGIN, START_US, rates=rates, vehicle=FIXED_WING)
    needed = needed_rates(1, attitude=True, navigation=True)
    bridge = Component(Link("udpout:127.0.0.1:14550"), {}, start_us=START_US, streams=needed)
    measured, answers = [], b""
    for k in range(500):
        now_us = START_US + 100_000 * k
        bridge.output.advance(now_us)
        for _, frame in bridge.output.drain():
            answers += autopilot.receive(frame, now_us)
        bridge.receive(answers + autopilot.step(now_us, Truth(PLACE, 22.0, 0.0, 0.0, 0.0, PLACE)), now_us)
        answers = b""
        measured.append(dict(bridge.streams.measured))
    assert measured[120]["ATTITUDE"] == pytest.approx(min(before, 10.0), rel=0.1)  # the steps are 0.1 s
    rate = {spec(number).name: aircraft for (_, number), (aircraft, _) in needed.items()}
    rate[status] = rate.pop("EKF_STATUS_REPORT")
    if make is Px4:  # PX4 has no such message, and dead reckoning does without it
        assert "RAW_IMU" not in measured[-1]
        rate.pop("RAW_IMU")
    for name, wanted in rate.items():
        assert measured[-1][name] >= 0.9 * wanted, name
    assert bridge.streams.denied == {}


@pytest.mark.parametrize("airspeed", [True, False])
def test_px4_reports_whether_its_velocity_holds(airspeed: bool) -> None:
    autopilot, now_us = flown(Px4, 20, airspeed=airspeed)
    report = autopilot.step(now_us + 1_000_000, Truth(PLACE, 0.0, 0.0, 0.0, 0.0, None))
    (flags,) = [m["flags"] for m in Codec(255, 1).parse(report) if m.name == "ESTIMATOR_STATUS"]
    assert bool(flags & 2) is airspeed
    assert bool(flags & 128) is not airspeed
    assert not flags & 16, "no absolute position"


def test_px4_locks_gps_out_while_another_position_aids() -> None:
    """60 m off with 5 m claimed, five times a second: GPS comes back only once that ends."""
    autopilot, now_us = flown(Px4, 60)
    wrong = {**HERE, "lat": round(PLACE[0] * 1e7) + 5400}
    for k in range(60):
        for _ in range(5):
            autopilot.receive(BRIDGE.pack("GLOBAL_POSITION_SENSOR", **wrong), now_us)
        gps = PLACE if k > 20 else None
        autopilot.step(now_us := now_us + 1_000_000, Truth(PLACE, 0.0, 0.0, 0.0, 0.0, gps))
    assert autopilot.filter.position[0] > 40.0
    for _ in range(10):
        autopilot.step(now_us := now_us + 1_000_000, Truth(PLACE, 0.0, 0.0, 0.0, 0.0, PLACE))
    assert abs(autopilot.filter.position[0]) < 10.0


def test_the_filter_is_kalmans() -> None:
    """Compare prediction, update and forced position with matrix equations."""
    q, R, dt = 1e-3, 9.0, 2.0
    made = PositionFilter(q)
    P, x = np.diag([1e6, 1.0]), np.zeros(2)
    F, H = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    for k in range(20):
        made.predict((1.0, 0.0), dt)
        x, P = F @ x + [dt, 0.0], F @ P @ F.T + Q
        place = 2.0 * k + (-1) ** k
        K = P @ H.T / (P[0, 0] + R)
        if k % 3 == 2:
            K[0] = 1.0
            made.force((place, 0.0), R)
        else:
            made.fuse((place, 0.0), R)
        x = x + K[:, 0] * (place - x[0])
        P = (np.eye(2) - K @ H) @ P @ (np.eye(2) - K @ H).T + R * K @ K.T
        assert (made.position[0], made.wind[0]) == pytest.approx(tuple(x), abs=1e-6)
        assert (made.pp, made.pw, made.ww) == pytest.approx((P[0, 0], P[0, 1], P[1, 1]), rel=1e-6, abs=1e-6)


# ---- closed loop ---------------------------------------------------------------------------------------


def sail_again(kind: str, stack: str, stream: str, *, obeys: bool = True) -> tuple[Run, Autopilot]:
    make = partial(STACKS[stack], streams=(stream,), obeys=obeys)
    run, autopilot, _ = sail(*passage(), hills(), OPTIONS, kind, make)
    return run, autopilot


sailed = cache(sail_again)


@pytest.mark.parametrize(
    ("kind", "stack", "stream"),
    [
        ("EXTERNAL_POSITION_ESTIMATE", "ArduPilot", "LOCAL_POSITION_NED"),
        ("EXTERNAL_POSITION_ESTIMATE", "Px4", "GLOBAL_POSITION_INT"),
        ("GLOBAL_POSITION_SENSOR", "Px4", "LOCAL_POSITION_NED"),
        ("GLOBAL_POSITION_SENSOR", "Px4", "VFR_HUD"),
    ],
)
def test_an_autopilot_that_uses_fixes_does_not_mislead_the_bridge(kind: str, stack: str, stream: str) -> None:
    run, autopilot = sailed(kind, stack, stream)
    alone, _ = sailed(kind, stack, stream, obeys=False)
    lost = (run.seconds > LOST) & (run.seconds < BACK)
    assert rms(run.error[lost]) <= 1.1 * rms(alone.error[lost])
    good = autopilot.taken["ACCEPTED"] + autopilot.taken["fused"]
    assert good >= 0.9 * autopilot.taken.total() >= 50
    assert (np.diff(run.sent)[run.seconds[1:] < LOST] == 0).all(), "none while GPS was good"
    assert (np.diff(run.sent)[run.seconds[:-1] > BACK + 1] == 0).all(), "none once it was back"
    late = (run.seconds > BACK - 100) & (run.seconds < BACK)
    if stack == "Px4":  # ArduPilot's wind walks less, and is right here without us
        assert rms(run.autopilot[late]) < 0.5 * rms(alone.autopilot[late])
    assert rms(run.autopilot[late] / run.claimed[late, None]) < 1.25
    assert rms(run.autopilot[run.seconds > LAST - 20]) < 3.0, "GPS is not locked out"


def test_ardupilot_is_not_made_to_believe_odometry_too_much() -> None:
    """ArduPilot would claim 1 m where the field gives 100 m: the bridge reports this and sends no fix."""
    run, autopilot = sailed("ODOMETRY", "ArduPilot", "ODOMETRY")
    assert not autopilot.taken
    assert any("ArduPilot would claim to know it better" in text for _, text in run.texts)


def test_sent_all_the_same_ardupilot_would_claim_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """The referee is one that would be led astray: what the bridge does against it is needed."""
    monkeypatch.setattr(Kind, "overrated", lambda *_: False)
    run, autopilot = sail_again("ODOMETRY", "ArduPilot", "ODOMETRY")
    late = (run.seconds > BACK - 100) & (run.seconds < BACK)
    assert autopilot.taken["fused"] > 0.9 * autopilot.taken.total() > 100
    assert rms(run.autopilot[late] / run.claimed[late, None]) > 2.0


def test_without_that_the_loop_runs_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """The referee is one that would be led astray: what the bridge does against it is needed."""
    honest, _ = sailed("GLOBAL_POSITION_SENSOR", "Px4", "LOCAL_POSITION_NED")
    monkeypatch.setattr(Motion, "fixes_sent", lambda _: None)
    astray, _ = sail_again("GLOBAL_POSITION_SENSOR", "Px4", "LOCAL_POSITION_NED")
    lost = (honest.seconds > LOST) & (honest.seconds < BACK)
    assert rms(astray.error[lost]) > 2.0 * rms(honest.error[lost])
