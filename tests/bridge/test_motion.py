"""Test which telemetry dead reckoning uses, and when and how the bridge sends fixes to the autopilot."""

from typing import Any

import numpy as np
import pytest
from passages import AIRCRAFT, PLACE, hills
from vehicle import ACK, ARDUPILOT, PX4, Bench

from magbridge.bridge.motion import MotionSource, rotate
from magbridge.field.geodesy import offset, separation
from magbridge.field.igrf import total_field
from magbridge.navigate import Record
from magbridge.navigate.gnss import GnssState
from magbridge.records import Corrected

PLACE_E7 = {"lat": round(PLACE[0] * 1e7), "lon": round(PLACE[1] * 1e7)}
ONE: dict[str, Any] = {"q": (1.0, 0.0, 0.0, 0.0), "child_frame_id": 12}
"""Fields of an ODOMETRY in the axes of the body, without a turn."""


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
        bench.receive("GPS_RAW_INT", fix_type=3, **PLACE_E7)
        assert bench.navigation.motion.fed_back == (k <= 62)


def test_the_position_of_another_component_stays() -> None:
    bench = made()
    for k in range(1, 11):
        bench.to(k)
        bench.receive("ODOMETRY", component=197, x=2.0 * k, **ONE)
        bench.receive("LOCAL_POSITION_NED", x=500.0 * k, vx=500.0)
        bench.fix()
    assert source(bench) is MotionSource.OTHER
    assert moved(bench)[0] == pytest.approx(18.0, abs=0.1)


def test_two_streams_are_not_mixed() -> None:
    bench = made()
    for k in range(1, 6):
        local(bench, k, float(k))
        bench.receive("ODOMETRY", x=1000.0 + k, vx=1.0, **ONE)
    assert moved(bench)[0] == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("counted", [True, False])
def test_a_jump_is_not_a_motion(counted: bool) -> None:
    """A jump is announced in ODOMETRY, or detected because the velocity does not explain it."""
    bench = made()
    for k in range(1, 11):
        bench.to(k)
        x = 2.0 * k + 300.0 * (k > 5)
        fields: dict[str, Any] = {"vx": 0.0 if counted else 2.0, "reset_counter": int(counted and k > 5)}
        bench.receive("ODOMETRY", x=x, **ONE, **fields)
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


@pytest.mark.parametrize(("sinks", "expected"), [(0.2, MotionSource.GLIDE), (0.0, MotionSource.LAST)])
def test_a_vehicle_that_is_steep_at_one_depth_does_not_glide(sinks: float, expected: MotionSource) -> None:
    """A real ArduSub pitches by 10 deg when it accelerates at the surface: no pitch then tells its speed."""
    bench = made("EXTERNAL_POSITION_ESTIMATE", ARDUPILOT)
    local(bench, 0, 0.0, vx=1.2)
    bench.navigation.motion.gps_trusted = False  # the autopilot's velocity is not used
    for k in range(1, 61):
        bench.to(k)
        bench.receive("LOCAL_POSITION_NED", z=10.0 + sinks * k)
        bench.receive("ATTITUDE", yaw=0.0, pitch=-0.4)
    assert source(bench) is expected


def test_the_last_known_speed_is_uncertain_by_itself() -> None:
    bench = made("EXTERNAL_POSITION_ESTIMATE", ARDUPILOT)
    local(bench, 0, 0.0, vx=1.2)
    bench.navigation.motion.gps_trusted = False
    bench.navigation.navigator.fix(bench.now_us, *PLACE, 5.0)
    for k in range(1, 41):
        bench.to(k)
        bench.receive("ATTITUDE", yaw=0.0)
        sample(bench, *offset(*PLACE, 1.2 * k, 0.0))
    assert source(bench) is MotionSource.LAST
    assert np.sqrt(bench.navigation.navigator.estimate.P[2, 2]) > 0.8


def test_depth_counts_from_the_sea_on_high_ground() -> None:
    bench = made()
    bench.receive("LOCAL_POSITION_NED", z=4.0)
    bench.to(1)
    bench.receive("GPS_GLOBAL_ORIGIN", latitude=1, longitude=1, altitude=350_000)
    bench.receive("LOCAL_POSITION_NED", z=4.0)
    assert bench.navigation.motion._autopilot.depth(bench.now_us) == pytest.approx(-346.0)
    bench.receive("GLOBAL_POSITION_INT", lat=495_000_000, lon=-579_000_000, alt=347_000)
    assert bench.navigation.motion._autopilot.depth(bench.now_us) == pytest.approx(-347.0)


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
    ("kind", "stack", "used"),
    [(10, PX4, False), (11, ARDUPILOT, False), (11, PX4, True), (12, ARDUPILOT, True)],
    ids=["rover", "boat of ArduPilot", "other boat", "submarine"],
)  # fmt: skip
def test_the_airspeed_of_a_rover_is_wind(kind: int, stack: int, used: bool) -> None:
    """A real ArduPilot Rover at rest in a wind of 4 m/s moved by dead reckoning; a right GPS was rejected."""
    bench = made("EXTERNAL_POSITION_ESTIMATE", stack)
    bench.receive("HEARTBEAT", autopilot=stack, type=kind)
    bench.receive("ATTITUDE", yaw=0.0)
    bench.receive("VFR_HUD", airspeed=4.0, groundspeed=0.1)
    assert (source(bench) is MotionSource.SPEED) == used


@pytest.mark.parametrize(
    ("stack", "sensors", "used"), [(ARDUPILOT, 15, False), (ARDUPILOT, 31, True), (PX4, 15, True)]
)
def test_an_ardupilot_without_an_airspeed_sensor_sends_no_airspeed(
    stack: int, sensors: int, used: bool
) -> None:
    """A real ArduSub: VFR_HUD had an older GPS speed than GPS_RAW_INT; a right GPS was rejected for 380 s."""
    bench = made("EXTERNAL_POSITION_ESTIMATE", stack)
    bench.receive("HEARTBEAT", autopilot=stack, type=12)
    bench.receive("ATTITUDE", yaw=0.0)
    bench.receive("VFR_HUD", airspeed=1.2, groundspeed=1.1)
    assert source(bench) is MotionSource.SPEED
    bench.receive("SYS_STATUS", onboard_control_sensors_present=sensors)
    bench.receive("LOCAL_POSITION_NED", vx=1.0, vy=0.5)
    bench.receive("VFR_HUD", airspeed=1.2, groundspeed=1.1)
    assert source(bench) is (MotionSource.SPEED if used else MotionSource.TRACK)


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


def aircraft(bench: Bench, yaw: float, airspeed: float, groundspeed: float, **state: int) -> None:
    """Deliver what an aircraft sends of itself, and its landed state if it is given."""
    bench.receive("HEARTBEAT", autopilot=ARDUPILOT, type=1, base_mode=state.get("base_mode", 128))
    if "landed_state" in state:
        bench.receive("EXTENDED_SYS_STATE", landed_state=state["landed_state"])
    bench.receive("ATTITUDE", yaw=yaw)
    bench.receive("VFR_HUD", airspeed=airspeed, groundspeed=groundspeed)


def is_good(bench: Bench) -> bool:
    return bench.navigation.navigator.gnss.state in (GnssState.NONE, GnssState.GOOD)


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
        state = {"base_mode": 128 * (k > 50)} | ({"landed_state": 1 + flying} if reports else {})
        aircraft(bench, np.pi / 2, speed or 6.0, speed + 0.1, **state)
        north, east = north + 5.0 * flying, east + speed
        latitude, longitude = offset(*PLACE, north, east)
        place = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7)}
        bench.receive("GPS_RAW_INT", fix_type=3, h_acc=1000, **place)
        sample(bench, latitude, longitude)
        if reports or k > 270:
            assert is_good(bench), k
    assert bench.navigation.navigator.gnss.state is GnssState.GOOD


@pytest.mark.parametrize("seed", range(3))
def test_wind_that_grows_with_height_does_not_reject_gps_in_the_climb(seed: int) -> None:
    """An aircraft climbs to 100 m in 10 s, through wind that grows from 0 to 8 m/s."""
    bench, rng = Bench("EXTERNAL_POSITION_ESTIMATE", AIRCRAFT), np.random.default_rng(seed)
    position, wind = np.array([-1500.0, -1500.0]), np.array([4.8, -6.4])
    for k in range(1, 241):
        along = 0.5 * np.pi * np.clip((k - 160) / 8.0, 0.0, 1.0)  # a turn after the climb
        flying, height = k > 130, 100.0 * np.clip((k - 140) / 20.0, 0.0, 1.0)
        speed = 22.0 * np.clip((k - 120) / 20.0, 0.0, 1.0)
        moved = speed * np.array([np.cos(along), np.sin(along)])
        moved += wind * height / 100.0
        position = position + 0.5 * moved
        bench.to(0.5 * k)
        aircraft(bench, along, speed, np.hypot(*moved) + 0.1, landed_state=1 + flying)
        latitude, longitude = offset(*PLACE, *(position + rng.normal(0.0, 0.5, 2)).tolist())
        place = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7), "alt": round(1e3 * height)}
        bench.receive("GLOBAL_POSITION_INT", **place)
        bench.receive("GPS_RAW_INT", fix_type=3, h_acc=1000, **place)
        sample(bench, latitude, longitude)
        assert is_good(bench), k


def test_the_first_height_of_an_airfield_does_not_reject_gps() -> None:
    """On an airfield at 1,500 m, GPS is good 5 s before the autopilot's origin: 38 nT of the main field."""
    bench = Bench("EXTERNAL_POSITION_ESTIMATE", AIRCRAFT)
    rng, anomaly = np.random.default_rng(1), hills().look_up(PLACE[1], PLACE[0], 0.0).anomaly
    for k in range(1, 301):
        bench.to(0.2 * k)
        aircraft(bench, 0.0, 0.3, 0.05, base_mode=0, landed_state=1)
        if k % 5 == 0:
            bench.receive("GLOBAL_POSITION_INT", **(PLACE_E7 | {"alt": 1_500_000} if k > 50 else {}))
        if k > 25 and k % 5 == 0:
            bench.receive("GPS_RAW_INT", fix_type=3, h_acc=1000, alt=1_500_000, **PLACE_E7)
        field = total_field(PLACE[1], PLACE[0], -1500.0, bench.now_us * 1e-6).item() + anomaly + rng.normal()
        bench.navigation.sample(bench.now_us, Corrected(field, 1.0, (field, 0.0, 0.0), (1.0, 1.0, 1.0), 0))
        assert is_good(bench), k


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
    where = PLACE_E7 | {"h_acc": 1000, "fix_type": 3}
    bench.receive("GPS_RAW_INT", vel=4000, cog=9000, **where)
    bench.receive("GPS_RAW_INT", vel=65535, cog=65535, **where)
    moved_on, as_measured = seen
    assert separation(*PLACE, *moved_on[:2]) == pytest.approx((0.0, 6.0), abs=0.05)
    assert moved_on[2] == pytest.approx(np.hypot(1.0, 4.0))
    assert separation(*PLACE, *as_measured[:2]) == pytest.approx((0.0, 0.0), abs=0.05)
    assert as_measured[2] == 1.0
    # a clock of the vehicle known to 1.2 s / sqrt(12): the age is as uncertain
    clock = bench.navigation._component.vehicle.clock
    clock.answer(5_600_000_000, clock.ask(bench.now_us), bench.now_us + 1_200_000)
    bench.receive("GPS_RAW_INT", vel=4000, cog=9000, time_usec=5_000_000, **where)
    assert seen[-1][2] == pytest.approx(np.hypot(1.0, 40.0 * np.hypot(0.1, 1.2 / np.sqrt(12.0))), rel=0.01)


@pytest.mark.parametrize(
    ("name", "field"), [("EKF_STATUS_REPORT", "velocity_variance"), ("ESTIMATOR_STATUS", "mag_ratio")]
)
def test_an_autopilot_that_contradicts_its_sensors_has_an_uncertain_heading(name: str, field: str) -> None:
    """A real ArduPlane under a jammed receiver had headings wrong by 20 to 40 deg."""
    sigma = {}
    for ratio in (0.1, 5.0):
        bench = Bench("EXTERNAL_POSITION_ESTIMATE", AIRCRAFT)
        bench.navigation.navigator.fix(bench.now_us, *PLACE, 5.0)
        for k in range(1, 32):
            bench.to(k)
            aircraft(bench, np.pi / 2, 20.0, 24.0)
            status: dict[str, Any] = {"flags": 831, field: ratio}
            bench.receive(name, **status)
            sample(bench, *offset(*PLACE, 0.0, 20.0 * k))
        sigma[ratio] = float(np.sqrt(bench.navigation.navigator.estimate.P[2, 2]))
    assert sigma[5.0] > 1.5 * sigma[0.1]


# ---- When the bridge sends fixes to the autopilot, and the content of their messages -----------------------


GOOD = {"fix_type": 3, "lat": 495000000, "lon": -579000000, "h_acc": 2000}


def test_none_while_gps_is_good_and_none_from_the_moment_it_is_back() -> None:
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    bench.receive("GPS_RAW_INT", **GOOD)
    assert bench.fix() == []
    bench.to(2)
    bench.receive("GPS_RAW_INT", fix_type=1)
    assert [one.name for one in bench.fix()] == ["COMMAND_INT"], "lost as soon as it reports it"
    bench.to(4)
    bench.receive("GPS_RAW_INT", **GOOD)
    assert bench.fix() == []
    bench.to(10)
    assert bench.texts_with("fixes") == [
        "no fixes to the autopilot: GPS is good",
        "fixes go to the autopilot: GPS is lost",
        "no fixes to the autopilot: GPS is good",
    ]


def test_a_silent_gps_is_lost_but_a_slow_one_is_not() -> None:
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    for k in range(5):
        bench.to(k)
        bench.receive("GPS_RAW_INT", **GOOD)
    bench.to(8.9)
    assert bench.fix() == []
    bench.to(9.1)
    assert bench.fix()
    for k in (20, 40, 60):
        bench.to(k)
        bench.receive("GPS_RAW_INT", **GOOD)
    bench.to(90)
    assert bench.fix() == []
    bench.to(121)
    assert bench.fix()


def test_odometry_waits_for_origin_attitude_and_height() -> None:
    bench = Bench("ODOMETRY")
    asked = [one for k in range(11) for one in bench.to(k)]
    assert {one.name for one in asked} == {"COMMAND_LONG"}
    assert [(one["command"], one["param1"]) for one in asked] == [(512, 49.0)] * 3, "every 5 s"
    assert bench.fix() == []
    bench.receive("GPS_GLOBAL_ORIGIN", latitude=0, longitude=0)  # not set yet
    bench.receive("GPS_GLOBAL_ORIGIN", latitude=495_000_000, longitude=-579_000_000, altitude=5000)
    bench.to(12)
    assert bench.fix() == []
    bench.receive("ATTITUDE", yaw=0.5)
    bench.to(14)
    assert bench.fix() == []
    bench.receive("GLOBAL_POSITION_INT", lat=495_000_000, lon=-579_000_000, alt=-2000)
    bench.to(16)
    (sent,) = bench.fix()
    assert sent["z"] == pytest.approx(7.0), "2 m under the sea is 7 m under the origin"
    assert bench.texts_with("fixes to") == [
        "no fixes to the autopilot: no origin of the autopilot's frame",
        "no fixes to the autopilot: no attitude from the autopilot",
        "no fixes to the autopilot: no height from the autopilot",
    ]
    bench.to(30)
    bench.receive("GLOBAL_POSITION_INT", lat=495_000_000, lon=-579_000_000, alt=-2000)
    assert bench.fix() == [], "that attitude is old"
    assert not any(one.name == "COMMAND_LONG" for one in bench.to(60)), "the origin is known"


def test_a_reboot_takes_the_origin_with_it() -> None:
    bench = Bench("ODOMETRY")
    bench.receive("GPS_GLOBAL_ORIGIN", latitude=495_000_000, longitude=-579_000_000)
    bench.to(20)
    for boot_ms in (100_000, 101_000, 500, 600, 700, 800):
        bench.receive("ATTITUDE", time_boot_ms=boot_ms)
    assert any(one["command"] == 512 for one in bench.to(26) if one.name == "COMMAND_LONG")


@pytest.mark.parametrize(
    ("kind", "stack", "reason"),
    [
        ("ODOMETRY", PX4, "PX4 makes a bias of ODOMETRY: use GLOBAL_POSITION_SENSOR"),
        (
            "GLOBAL_POSITION_SENSOR",
            ARDUPILOT,
            "ArduPilot ignores this message: use EXTERNAL_POSITION_ESTIMATE",
        ),
    ],
)
def test_what_an_autopilot_cannot_use_is_not_sent(kind: str, stack: int, reason: str) -> None:
    bench = Bench(kind)
    bench.receive("HEARTBEAT", autopilot=stack)
    for k in range(5):
        bench.to(2 * k)
        assert bench.fix() == []
    assert bench.texts_with("fixes") == [f"no fixes to the autopilot: {reason}"]


def test_a_refusal_is_reported_once_and_so_is_its_end() -> None:
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    bench.receive("COMMAND_ACK", **ACK, result=2)
    assert bench.texts_with("refuses") == [], "nothing was asked of it yet"
    for k in range(10):
        bench.to(10 * k)
        bench.fix()
        bench.receive("COMMAND_ACK", **{**ACK, "command": 512}, result=4)
        bench.receive("COMMAND_ACK", **ACK, result=2)
    assert bench.texts_with("refuses") == ["the autopilot refuses fixes: DENIED"]
    for k in range(10, 13):
        bench.to(10 * k)
        bench.fix()
        bench.receive("COMMAND_ACK", **ACK, result=0)
    assert bench.texts_with("fixes") == ["the autopilot takes fixes"]
    bench.to(200)
    bench.fix()
    bench.receive("COMMAND_ACK", **ACK, result=4)
    assert "FAILED (it still uses GPS, has no origin, or nothing" in bench.texts_with("refuses")[0]
    bench.to(221)
    bench.receive("COMMAND_ACK", **ACK, result=77)
    assert bench.texts_with("refuses") == ["the autopilot refuses fixes: result 77"]


def test_an_autopilot_that_does_not_answer_is_reported() -> None:
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    for k in range(3):
        bench.to(10 * k)
        bench.fix()
    assert bench.texts_with("answer") == []
    bench.to(40)
    bench.fix()
    assert bench.texts_with("answer") == ["the autopilot does not answer fixes"]


def test_what_ardupilot_would_believe_too_much_is_not_sent() -> None:
    """Its EKF limits the claimed error to 10 m, and fuses five equal positions a second as independent."""
    bench = Bench("ODOMETRY")
    bench.receive("HEARTBEAT", autopilot=ARDUPILOT)
    bench.receive("GPS_GLOBAL_ORIGIN", latitude=495_000_000, longitude=-579_000_000)
    bench.receive("ATTITUDE")
    bench.receive("LOCAL_POSITION_NED", z=1.0)
    (first,) = bench.fix(sigma=1.5)
    bench.to(0.2)
    (second,) = bench.fix(sigma=1.5)
    assert first["pose_covariance"][0] == pytest.approx(1.5**2)
    assert 7.0 < second["pose_covariance"][0] ** 0.5 <= 10.0, "widened, as ArduPilot still takes it"
    for k, sigma in enumerate((1.7, 30.0, 150.0)):
        bench.to(0.4 + 0.2 * k)
        assert bench.fix(sigma=sigma) == []
    bench.to(5)
    assert bench.texts_with("claim") == [
        "no fixes to the autopilot: ArduPilot would claim to know it better: use EXTERNAL_POSITION_ESTIMATE"
    ]


@pytest.mark.parametrize(
    ("stack", "version", "widened"),
    [(PX4, None, True), (PX4, (1, 18), True), (PX4, (1, 16), False), (ARDUPILOT, (4, 7), False)],
)
def test_px4_fuses_an_external_position_since_december_2025(
    stack: int, version: tuple[int, int] | None, widened: bool
) -> None:
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    asked = bench.receive("HEARTBEAT", autopilot=stack)
    assert [(one["command"], one["param1"]) for one in asked] == [(512, 148.0)], "AUTOPILOT_VERSION"
    if version:
        bench.receive("AUTOPILOT_VERSION", flight_sw_version=version[0] << 24 | version[1] << 16)
    bench.fix(sigma=20.0)
    bench.to(1)
    assert (bench.fix(sigma=20.0)[0]["param3"] > 40.0) is widened


def test_an_autopilot_that_does_not_use_the_fixes_is_reported() -> None:
    """An autopilot that ignores fixes flies on 600 m away; the bridge reports this within a minute."""
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    there = PLACE_E7 | {"lat": PLACE_E7["lat"] + 54_000}
    for k in range(60):
        bench.to(k)
        bench.fix()
        bench.receive("COMMAND_ACK", **ACK, result=0)
        bench.receive("GLOBAL_POSITION_INT", **there)
    assert bench.texts_with("not use") == ["the autopilot does not use the fixes: its position is 601 m off"]
    near = PLACE_E7 | {"lat": PLACE_E7["lat"] + 100}
    for k in range(60, 130):
        bench.to(k)
        bench.fix()
        bench.receive("GLOBAL_POSITION_INT", **near)
    assert bench.texts_with("not use") == []
