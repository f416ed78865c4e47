"""Test that dead reckoning uses only telemetry that does not contain the bridge's own fixes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from passages import AIRCRAFT, PLACE, hills
from vehicle import ARDUPILOT, PX4, Bench

from magbridge.bridge.motion import MotionSource, rotate
from magbridge.field.geodesy import offset, separation
from magbridge.field.igrf import total_field
from magbridge.navigate import Record
from magbridge.navigate.gnss import GnssState
from magbridge.records import Corrected


def made(kind: str = "GLOBAL_POSITION_SENSOR", stack: int = PX4) -> Bench:
    """Return a bench with a known position."""
    bench = Bench(kind)
    bench.receive("HEARTBEAT", autopilot=stack)
    bench.navigation.navigator.fix(bench.now_us, *PLACE, 5.0)
    return bench


def moved(bench: Bench) -> tuple[float, float]:
    """Return the displacement by dead reckoning, m north and east."""
    return separation(*PLACE, *bench.navigation.navigator.reckoned(bench.now_us))


def source(bench: Bench) -> MotionSource:
    return bench.navigation.motion.source


def local(bench: Bench, seconds: int, x: float, vx: float = 1.0, **fields: Any) -> None:
    bench.to(seconds)
    bench.receive("LOCAL_POSITION_NED", x=x, vx=vx, **fields)


def test_speed_is_preferred_to_the_autopilots_position() -> None:
    bench = made()
    for k in range(1, 11):
        local(bench, k, 50.0 * k, vx=50.0)
        bench.receive("ATTITUDE", yaw=np.pi / 2)
        bench.receive("VFR_HUD", airspeed=2.0)
    assert source(bench) is MotionSource.SPEED
    assert moved(bench) == pytest.approx((0.0, 18.0), abs=1.0)


def test_the_autopilots_position_until_a_fix_is_sent_then_the_last_speed() -> None:
    bench = made()
    for k in range(1, 11):
        local(bench, k, float(k))
        bench.receive("ATTITUDE", yaw=0.0)
    assert source(bench) is MotionSource.TRACK
    assert moved(bench)[0] == pytest.approx(9.0, abs=0.1)
    bench.fix()
    for k in range(11, 21):
        local(bench, k, 40.0 * k, vx=40.0)  # the fix comes back
        bench.receive("ATTITUDE", yaw=0.0)
    assert source(bench) is MotionSource.LAST
    assert moved(bench)[0] == pytest.approx(18.0, abs=1.5)
    assert bench.texts_with("dead reckoning by") == [
        "dead reckoning by the autopilot's position",
        "dead reckoning by heading and the last known speed: no other is sent",
    ]


def test_a_reset_leaves_ardupilots_velocity_alone() -> None:
    bench = made("EXTERNAL_POSITION_ESTIMATE", ARDUPILOT)
    for k in range(1, 11):
        local(bench, k, float(k) + 100.0 * (k > 5))
        bench.fix()
    assert source(bench) is MotionSource.TRACK
    assert moved(bench)[0] == pytest.approx(9.0, abs=0.1)


def test_gps_that_held_cleans_the_autopilots_position() -> None:
    bench = made()
    local(bench, 1, 1.0)
    bench.fix()
    assert bench.navigation.motion.fed_back
    for k in range(2, 70):
        bench.to(k)
        bench.receive("GPS_RAW_INT", fix_type=3, lat=round(PLACE[0] * 1e7), lon=round(PLACE[1] * 1e7))
        assert bench.navigation.motion.fed_back == (k <= 62)


def test_the_position_of_another_component_stays() -> None:
    bench = made()
    for k in range(1, 11):
        bench.to(k)
        bench.receive(
            "ODOMETRY", component=197, x=2.0 * k, q=(1.0, 0.0, 0.0, 0.0), frame_id=1, child_frame_id=12
        )
        bench.receive("LOCAL_POSITION_NED", x=500.0 * k, vx=500.0)
        bench.fix()
    assert source(bench) is MotionSource.OTHER
    assert moved(bench)[0] == pytest.approx(18.0, abs=0.1)


def test_two_streams_are_not_mixed() -> None:
    bench = made()
    for k in range(1, 6):
        local(bench, k, float(k))
        bench.receive("ODOMETRY", x=1000.0 + k, q=(1.0, 0.0, 0.0, 0.0), child_frame_id=12, vx=1.0)
    assert moved(bench)[0] == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("counted", [True, False])
def test_a_jump_is_not_a_motion(counted: bool) -> None:
    """A jump is announced in ODOMETRY, or detected because the velocity does not explain it."""
    bench = made()
    for k in range(1, 11):
        bench.to(k)
        x = 2.0 * k + 300.0 * (k > 5)
        fields: dict[str, Any] = {"vx": 0.0 if counted else 2.0, "reset_counter": int(counted and k > 5)}
        bench.receive("ODOMETRY", x=x, q=(1.0, 0.0, 0.0, 0.0), child_frame_id=12, **fields)
    assert moved(bench)[0] == pytest.approx(16.0 if counted else 18.0, abs=0.1)


def test_a_velocity_in_the_body_is_turned() -> None:
    yaw = 0.7
    q = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    assert rotate(q, (2.0, 1.0, 0.5)) == pytest.approx(
        (2.0 * np.cos(yaw) - np.sin(yaw), 2.0 * np.sin(yaw) + np.cos(yaw), 0.5)
    )


def test_speed_that_ends_is_not_followed_for_ever() -> None:
    bench = made()
    bench.receive("ATTITUDE", yaw=0.0)
    bench.receive("VFR_HUD", airspeed=1.5)
    for k in range(1, 60):
        bench.to(k)
        bench.receive("ATTITUDE", yaw=0.0)
        bench.receive("VFR_HUD", airspeed=0.0)  # not measured
    assert source(bench) is MotionSource.LAST
    assert moved(bench)[0] == pytest.approx(1.5 * 59, abs=3.0)


def test_without_any_motion_no_fix_is_sent() -> None:
    bench = made()
    bench.receive("GLOBAL_POSITION_INT", alt=-1000)
    assert source(bench) is MotionSource.NONE


def test_depth_counts_from_the_sea_on_high_ground() -> None:
    bench = made()
    bench.receive("LOCAL_POSITION_NED", z=4.0)
    bench.to(1)
    bench.receive("GPS_GLOBAL_ORIGIN", latitude=1, longitude=1, altitude=350_000)
    bench.receive("LOCAL_POSITION_NED", z=4.0)
    assert bench.navigation.motion._frame.depth(bench.now_us) == pytest.approx(-346.0)
    bench.receive("GLOBAL_POSITION_INT", alt=347_000)
    assert bench.navigation.motion._frame.depth(bench.now_us) == pytest.approx(-347.0)


def test_an_airspeed_that_is_the_speed_over_ground_is_not_used() -> None:
    """ArduPilot's Rover and Sub without an airspeed sensor: VFR_HUD repeats GPS_RAW_INT.vel."""
    bench = made("EXTERNAL_POSITION_ESTIMATE", ARDUPILOT)
    bench.receive("ATTITUDE", yaw=0.0)
    for k in range(1, 11):
        bench.to(k)
        bench.receive("GPS_RAW_INT", fix_type=1, vel=331)
        bench.receive("VFR_HUD", airspeed=3.3125, groundspeed=3.2)
        bench.receive("VFR_HUD", airspeed=3.2, groundspeed=3.2)
    assert source(bench) is MotionSource.NONE
    bench.to(12)
    assert bench.texts_with("airspeed") == ["VFR_HUD.airspeed is the speed over ground: not used"]
    bench.receive("VFR_HUD", airspeed=2.9, groundspeed=3.2)
    assert source(bench) is MotionSource.SPEED


@pytest.mark.parametrize(
    ("report", "flags"),
    [("EKF_STATUS_REPORT", 1 | 128), ("ESTIMATOR_STATUS", 2 | 128), ("ESTIMATOR_STATUS", 1)],
)
def test_a_velocity_that_the_autopilot_does_not_vouch_for_is_not_used(report: str, flags: int) -> None:
    bench = made()
    bench.receive(report, flags=flags)
    local(bench, 1, 1.0)
    assert source(bench) is MotionSource.NONE
    bench.receive(report, flags=1 | 2 | 8)
    local(bench, 2, 2.0)
    assert source(bench) is MotionSource.TRACK


def test_a_turn_between_two_reports_is_averaged_and_uncertain() -> None:
    """22 m/s, reports once a second, a turn of 90 degrees in 4 s: the error of a held heading adds up."""
    bench = made("EXTERNAL_POSITION_ESTIMATE", ARDUPILOT)
    north = east = 0.0
    for k in range(11):
        bench.to(k)
        bench.receive("ATTITUDE", yaw=np.radians(np.clip(22.5 * (k - 3), 0.0, 90.0)))
        bench.receive("VFR_HUD", airspeed=22.0)
    for step in np.arange(0.0, 10.0, 0.001) + 0.0005:
        along = np.radians(np.clip(22.5 * (step - 3.0), 0.0, 90.0))
        north, east = north + 0.022 * np.cos(along), east + 0.022 * np.sin(along)
    assert moved(bench) == pytest.approx((north, east), abs=1.0)
    noise = bench.navigation.navigator._reckoning.noise
    assert 1.0 < noise.nn + noise.ee < 50.0
    assert noise.turns == pytest.approx(2.0 * 22.0**2, rel=0.7)


def sample(bench: Bench, latitude: float, longitude: float) -> None:
    """Feed the field of a place to the navigation."""
    field = total_field(longitude, latitude, 0.0, bench.now_us * 1e-6).item()
    field += hills().look_up(longitude, latitude, 0.0).anomaly
    bench.navigation.sample(bench.now_us, Corrected(field, 1.0, (field, 0.0, 0.0), (1.0, 1.0, 1.0), 0))


@pytest.mark.parametrize("reports", [True, False])
def test_wind_on_the_ground_does_not_reject_gps_after_the_take_off(reports: bool) -> None:
    """An aircraft measures 6 m/s of wind, rolls for 10 s, and flies in a cross wind from then on.

    Without a report of its landed state, it counts as flying when it is armed, before it rolls.
    """
    bench = Bench("EXTERNAL_POSITION_ESTIMATE", AIRCRAFT)
    north, east = -1500.0, -1500.0
    for k in range(1, 181 if reports else 301):
        flying, speed = k > 70, 22.0 * min(max(k - 60, 0) / 10.0, 1.0)
        bench.to(k)
        bench.receive("HEARTBEAT", autopilot=ARDUPILOT, type=1, base_mode=128 * (k > 50))
        if reports:
            bench.receive("EXTENDED_SYS_STATE", landed_state=2 if flying else 1)
        bench.receive("ATTITUDE", yaw=np.pi / 2)
        bench.receive("VFR_HUD", airspeed=speed or 6.0, groundspeed=speed + 0.1)
        north, east = north + 5.0 * flying, east + speed
        latitude, longitude = offset(*PLACE, north, east)
        place = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7)}
        bench.receive("GPS_RAW_INT", fix_type=3, h_acc=1000, **place)
        sample(bench, latitude, longitude)
        if reports or k > 270:
            assert bench.navigation.navigator.gnss.state in (GnssState.NONE, GnssState.GOOD), k
    assert bench.navigation.navigator.gnss.state is GnssState.GOOD


def test_a_position_of_the_receiver_is_moved_on_by_its_age() -> None:
    """At 40 m/s a position is about 6 m old when it arrives, and the error of that age is counted."""
    bench = made()
    seen: list[tuple[float, float, float | None]] = []
    navigator = bench.navigation.navigator
    use = navigator.gnss_position

    def record(time_us: int, latitude: float, longitude: float, sigma: float | None = None) -> Record | None:
        seen.append((latitude, longitude, sigma))
        return use(time_us, latitude, longitude, sigma)

    navigator.gnss_position = record  # type: ignore[method-assign]
    where = {"lat": round(PLACE[0] * 1e7), "lon": round(PLACE[1] * 1e7), "h_acc": 1000, "fix_type": 3}
    bench.receive("GPS_RAW_INT", vel=4000, cog=9000, **where)
    bench.receive("GPS_RAW_INT", vel=65535, cog=65535, **where)
    moved_on, as_measured = seen
    assert separation(*PLACE, *moved_on[:2]) == pytest.approx((0.0, 6.0), abs=0.05)
    assert moved_on[2] == pytest.approx(np.hypot(1.0, 4.0))
    assert separation(*PLACE, *as_measured[:2]) == pytest.approx((0.0, 0.0), abs=0.05)
    assert as_measured[2] == 1.0


@pytest.mark.parametrize(
    ("name", "field"), [("EKF_STATUS_REPORT", "velocity_variance"), ("ESTIMATOR_STATUS", "mag_ratio")]
)
def test_an_autopilot_that_contradicts_its_sensors_has_an_uncertain_heading(name: str, field: str) -> None:
    """A real ArduPlane under a jammed receiver had headings wrong by 20 to 40 deg."""
    sigma = {}
    for ratio in (0.1, 5.0):
        bench = Bench("EXTERNAL_POSITION_ESTIMATE", AIRCRAFT)
        bench.receive("HEARTBEAT", autopilot=ARDUPILOT, type=1, base_mode=128)
        bench.navigation.navigator.fix(bench.now_us, *PLACE, 5.0)
        for k in range(1, 32):
            bench.to(k)
            bench.receive("ATTITUDE", yaw=np.pi / 2)
            bench.receive("VFR_HUD", airspeed=20.0, groundspeed=24.0)
            status: dict[str, Any] = {"flags": 831, field: ratio}
            bench.receive(name, **status)
            sample(bench, *offset(*PLACE, 0.0, 20.0 * k))
        sigma[ratio] = float(np.sqrt(bench.navigation.navigator.estimate.P[2, 2]))
    assert sigma[5.0] > 1.5 * sigma[0.1]
