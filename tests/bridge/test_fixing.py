"""Test when the bridge sends fixes to the autopilot, and the content of their messages."""

from __future__ import annotations

import pytest
from passages import PLACE
from vehicle import ACK, ARDUPILOT, PX4, Bench

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
    bench.receive("GLOBAL_POSITION_INT", alt=-2000)
    bench.to(16)
    (sent,) = bench.fix()
    assert sent["z"] == pytest.approx(7.0), "2 m under the sea is 7 m under the origin"
    assert bench.texts_with("fixes to") == [
        "no fixes to the autopilot: no origin of the autopilot's frame",
        "no fixes to the autopilot: no attitude from the autopilot",
        "no fixes to the autopilot: no height from the autopilot",
    ]
    bench.to(30)
    bench.receive("GLOBAL_POSITION_INT", alt=-2000)
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
    fixing = bench.navigation.fixing
    assert (fixing.sent, fixing.refused, fixing.accepted) == (13, 10, 3)
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


def test_a_fix_soon_after_another_is_widened_where_it_is_fused() -> None:
    bench = Bench("GLOBAL_POSITION_SENSOR")
    assert bench.fix(sigma=20.0)[0]["eph"] == pytest.approx(20.0), "the first is new"
    bench.to(1)
    soon = bench.fix(sigma=20.0)[0]["eph"]
    bench.to(5)
    later = bench.fix(sigma=20.0)[0]["eph"]
    assert soon == pytest.approx(2.0 * later)
    assert later > 20.0


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


@pytest.mark.parametrize(("version", "released"), [((4, 7), False), ((4, 8), True), (None, False)])
def test_a_later_ardupilot_fuses_and_accepts_both_messages(
    version: tuple[int, int] | None, released: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magbridge.bridge.navigation.ARDUPILOT_FUSES", (4, 8))
    for kind, field in (("GLOBAL_POSITION_SENSOR", "eph"), ("EXTERNAL_POSITION_ESTIMATE", "param3")):
        bench = Bench(kind)
        bench.receive("HEARTBEAT", autopilot=ARDUPILOT)
        if version:
            bench.receive("AUTOPILOT_VERSION", flight_sw_version=version[0] << 24 | version[1] << 16)
        first = bench.fix(sigma=20.0)
        assert bool(first) is (released or kind == "EXTERNAL_POSITION_ESTIMATE")
        bench.to(1)
        assert (sum(one[field] for one in bench.fix(sigma=20.0)) > 40.0) is released


def test_an_autopilot_that_does_not_use_the_fixes_is_reported() -> None:
    """An autopilot that ignores fixes flies on 600 m away; the bridge reports this within a minute."""
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    there = {"lat": round(PLACE[0] * 1e7) + 54_000, "lon": round(PLACE[1] * 1e7)}
    for k in range(60):
        bench.to(k)
        bench.fix()
        bench.receive("COMMAND_ACK", **ACK, result=0)
        bench.receive("GLOBAL_POSITION_INT", **there)
    assert bench.texts_with("not use") == ["the autopilot does not use the fixes: its position is 601 m off"]
    near = {**there, "lat": round(PLACE[0] * 1e7) + 100}
    for k in range(60, 130):
        bench.to(k)
        bench.fix()
        bench.receive("GLOBAL_POSITION_INT", **near)
    assert bench.texts_with("not use") == []
