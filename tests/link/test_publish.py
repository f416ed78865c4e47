"""Test the messages of samples and of fixes that a station or an autopilot receives."""

import random
from collections.abc import Iterable
from math import isfinite, isnan, nan
from typing import Any

import numpy as np
import pytest
from line import Line, MakeLine
from msgspec.structs import replace
from scipy.linalg import solve_continuous_are

from magbridge.align import Sample
from magbridge.link.estimates import FIX_MESSAGES, WALK, Fix, Pose, widened
from magbridge.link.output import FOREVER, Output, Rate
from magbridge.mavlink import Codec, Message
from magbridge.records import Corrected, Quality, Reading

START = 1_700_000_000_000_000
ALL = {"MAG_RAW": 0.0, "MAG_FIELD": 0.0, "HIGHRES_IMU": 0.0, "NAMED_VALUE_FLOAT": 0.0, "DEBUG_VECT": 0.0}
READING = Reading(
    (12345.678, -23456.5, 43210.25),
    counts=(1000, -2000, 8_000_000),
    sequence=70_000,
    channel_delay=(0.0, 0.01, 0.02),
    temperature=12.5,
    power_cycle=3,
    saturated=True,
)
CORRECTED = Corrected(
    50_123.456789, 1.5, (20_000.0, -1000.0, 45_000.0), (1.0, 2.0, 3.0), int(Quality.MOVING | Quality.GAP)
)


def sample(t_us: int = START, reading: Reading = READING, age: float = nan) -> Sample:
    dated = replace(reading, time_us=t_us + 4000)
    return Sample(dated, t_us, reading.field, (), age, 0, 0.0, ())


def publish(link: Line, one: Sample, corrected: Corrected = CORRECTED, anomaly: float = nan) -> list[Any]:
    link.component.publisher.publish(one, corrected, anomaly)
    return link.receive()


@pytest.fixture
def line(make_link: MakeLine) -> Line:
    line = make_link(publish=ALL, calibration_id=0xDEADBEEF)
    line.to(0.1)
    return line


def test_raw(line: Line) -> None:
    (raw,) = line.only(publish(line, sample()), "MAG_RAW")
    assert raw.time_usec == START + 4000
    assert (raw.x, raw.y, raw.z) == pytest.approx(READING.field, abs=0.002)
    assert (raw.count_x, raw.count_y, raw.count_z) == READING.counts
    assert (raw.delay_x, raw.delay_y, raw.delay_z) == (0, 10_000, 20_000)
    assert (raw.temperature, raw.power_cycle, raw.sequence) == (12.5, 3, 70_000)
    assert raw.supply != raw.supply  # NaN: not known
    assert raw.flags == 1 | 2 | 4 | 8
    plain = sample(reading=Reading((1.0, 2.0, 3.0)))  # of an instrument that sends little
    (raw,) = line.only(publish(line, plain), "MAG_RAW")
    assert raw.flags == 0
    assert (raw.count_x, raw.sequence, raw.power_cycle) == (0, 0, 0)


def test_field(line: Line) -> None:
    (field,) = line.only(publish(line, sample(age=0.25), anomaly=-12.5), "MAG_FIELD")
    assert field.total_field == CORRECTED.total_field  # double: not rounded
    assert (field.x, field.y, field.z) == CORRECTED.field
    assert (field.sigma_x, field.sigma_y, field.sigma_z) == CORRECTED.field_sigma
    assert (field.flags, field.calibration_id, field.sequence) == (CORRECTED.quality, 0xDEADBEEF, 1)
    assert (field.telemetry_age, field.anomaly, field.total_field_sigma) == (0.25, -12.5, 1.5)
    assert field.latency == pytest.approx(0.1)
    nothing = Corrected(nan, nan, (nan,) * 3, (nan,) * 3, 16)
    (field,) = line.only(publish(line, sample(), nothing), "MAG_FIELD")
    assert field.total_field != field.total_field


def test_standard_messages(line: Line) -> None:
    received = publish(line, sample())
    (imu,) = line.only(received, "HIGHRES_IMU")
    assert (imu.xmag, imu.ymag, imu.zmag) == pytest.approx((0.2, -0.01, 0.45), rel=1e-6)
    assert (imu.fields_updated, imu.time_usec, imu.xacc) == (0x1C0, START, 0)
    (vector,) = line.only(received, "DEBUG_VECT")
    assert (vector.name, vector.x, vector.y, vector.z) == ("mag_field", *CORRECTED.field)
    named = line.only(received, "NAMED_VALUE_FLOAT")
    values = {one.name: one.value for one in named}
    assert values == pytest.approx({"mag_total": 50_123.456789, "mag_sigma": 1.5})
    named = line.only(publish(line, sample(START + 2_500_000), anomaly=-3.0), "NAMED_VALUE_FLOAT")
    assert {one.name for one in named} == {"mag_total", "mag_sigma", "mag_anom"}
    assert {one.time_boot_ms for one in named} == {2500}


def test_rates(make_link: MakeLine) -> None:
    line = make_link(publish={"MAG_FIELD": 0.0, "HIGHRES_IMU": 3.0})
    received = []
    for i in range(1000):  # 10 Hz
        received += publish(line, sample(START + i * 100_000))
    assert len(line.only(received, "MAG_FIELD")) == 1000
    assert len(line.only(received, "HIGHRES_IMU")) == pytest.approx(300, abs=1)
    assert len(received) == pytest.approx(1300, abs=1)
    line.command(511, 105, -1)
    line.command(511, 60101, 1_000_000)
    received = []
    for i in range(1000, 2000):
        received += publish(line, sample(START + i * 100_000))
    assert {one.get_type() for one in received} == {"MAG_FIELD"}
    assert len(received) == pytest.approx(100, abs=1)


# ---- Rates, timers and announcements in event time -------------------------------------------------------


def passed(rate: Rate, times: Iterable[int]) -> list[int]:
    return [t for t in times if rate.due(t)]


def test_a_jittering_stream_at_just_the_rate_passes_whole() -> None:
    rng = random.Random(2)
    times = [START + 100_000 * i + rng.randrange(-20_000, 20_000) for i in range(1000)]
    assert len(passed(Rate(10), times)) == pytest.approx(1000, abs=2)


def test_timers_fire_in_order_at_their_own_times() -> None:
    output = Output(Codec(1, 191))
    fired: list[tuple[str, int]] = []
    output.every("a", 300, lambda _: fired.append(("a", output.codec.now_us)), 0)
    output.every("b", 500, lambda t: fired.append(("b", t)), 100)
    output.run_once("c", 600, lambda t: output.run_once("d", t + 1, lambda t: fired.append(("d", t))))
    output.advance(1000)
    assert fired == [("a", 0), ("b", 100), ("a", 300), ("a", 600), ("b", 600), ("d", 601), ("a", 900)]
    assert output.next_deadline == 1100
    for name in ("a", "b", "never"):
        output.cancel(name)
    assert output.next_deadline == FOREVER


@pytest.mark.parametrize("length", [12, 50, 51, 99, 100, 150, 151])
def test_a_text_is_sent_whole_or_in_pieces(link: Line, length: int) -> None:
    text = "".join(chr(97 + i % 26) for i in range(length))
    for _ in range(2):
        link.component.output.send_statustext(text)
        messages = link.receive()
        assert "".join(message.text for message in messages) == text
        assert {message.severity for message in messages} == {6}
        if length <= 50:
            assert [message.id for message in messages] == [0]
        else:
            assert len({message.id for message in messages}) == 1
            assert messages[0].id > 0
            assert [message.chunk_seq for message in messages] == list(range(len(messages)))
            assert len(messages[-1].text) < 50  # else the receiver waits for more
    link.component.output.send_statustext("5 µT")
    assert link.receive()[0].text == "5 ?T"


def test_a_flapping_text_is_sent_once_a_second_and_its_last_state_always(link: Line) -> None:
    texts = []
    for i in range(201):  # 100 Hz for 2 s, ends on "up"
        texts += link.texts(link.to(1 + i / 100))
        link.component.output.announce("link", "up" if i % 2 == 0 else "down")
    texts += link.texts(link.to(10))
    assert 2 <= len(texts) <= 4
    assert texts[-1] == "up"


# ---- Each decoded fix is the original position, in the frame and units of its message ----------------------


NOW = 1_780_000_123_456_000
POSE = Pose(120.5, -40.25, 7.75, (0.5, -0.5, 0.5, 0.5))
FIX = Fix(NOW, 49.5123456, -57.9876543, 400.0, 120.0, 100.0, -3.5, POSE, 300)
"""North is known half as well as east, and the reset counter has gone round."""


def decoded(kind: str, fix: Fix = FIX) -> Message:
    output = Output(Codec(1, 191))
    FIX_MESSAGES[kind].send(output, fix, 3, 4)
    ((_, frame),) = output.drain()
    return Codec(255, 190).parse(frame)[0]


def test_odometry_is_what_ardupilot_takes() -> None:
    got = decoded("ODOMETRY")
    assert (got.name, got["time_usec"]) == ("ODOMETRY", NOW)
    assert (got["frame_id"], got["child_frame_id"]) == (20, 12), "LOCAL_FRD and BODY_FRD, or it is dropped"
    assert (got["x"], got["y"], got["z"]) == POSE[:3]
    assert got["q"] == POSE.attitude
    assert (got["reset_counter"], got["quality"]) == (300 % 256, 100)
    covariance = got["pose_covariance"]
    assert (covariance[0], covariance[1], covariance[6]) == (400.0, 120.0, 100.0)
    assert all(isfinite(entry) for entry in covariance), "a NaN is an internal error of the autopilot"
    assert min(covariance[k] for k in (0, 6, 11, 15, 18, 20)) > 0.0
    assert isnan(got["vx"]), "the velocity is not ours to tell"
    assert isnan(got["velocity_covariance"][0])


def test_the_sensor_is_what_px4_takes() -> None:
    got = decoded("GLOBAL_POSITION_SENSOR")
    assert (got["target_system"], got["target_component"], got["id"], got["source"]) == (3, 4, 1, 5)
    assert (got["lat"], got["lon"]) == (495_123_456, -579_876_543)
    assert (got["time_usec"], got["processing_time"]) == (NOW, 0)
    assert (got["alt"], got["eph"]) == pytest.approx((-3.5, FIX.sigma))
    assert isnan(decoded("GLOBAL_POSITION_SENSOR", replace(FIX, altitude=nan))["alt"])


def test_the_command_is_what_both_take() -> None:
    got = decoded("EXTERNAL_POSITION_ESTIMATE")
    assert (got.name, got["command"], got["frame"]) == ("COMMAND_INT", 43003, 0)
    assert (got["target_system"], got["target_component"]) == (3, 4)
    assert (got["x"], got["y"]) == (495_123_456, -579_876_543)
    assert got["param1"] == pytest.approx(NOW * 1e-6 % 1e5, abs=0.01)
    assert (got["param2"], got["param3"]) == pytest.approx((0.0, FIX.sigma))


def test_a_circle_stands_for_the_ellipse() -> None:
    """Errors drawn from the ellipse, over the sigma of the circle, have a mean square of 1."""
    drawn = np.random.default_rng(1).multivariate_normal((0, 0), [[400.0, 120.0], [120.0, 100.0]], 20_000)
    assert np.mean(np.square(drawn / FIX.sigma)) == pytest.approx(1.0, abs=0.03)


def test_across_the_antimeridian() -> None:
    there = replace(FIX, longitude=180.00001)
    assert decoded("GLOBAL_POSITION_SENSOR", there)["lon"] == -1_799_999_900
    assert decoded("EXTERNAL_POSITION_ESTIMATE", there)["y"] == -1_799_999_900


@pytest.mark.parametrize("seconds", [0.2, 1.0, 10.0])
@pytest.mark.parametrize("sigma", [5.0, 20.0, 80.0])
def test_a_filter_that_fuses_widened_fixes_claims_what_they_are_worth(sigma: float, seconds: float) -> None:
    """The filter's steady-state variance (Riccati equation) equals the variance of the original fix."""
    fix = replace(FIX, covariance_nn=sigma**2, covariance_ne=0.0, covariance_ee=sigma**2)
    sent = widened(fix, seconds)
    density = sent.covariance_nn * seconds
    wanders = np.array([[0.0, 1.0], [0.0, 0.0]])
    P = solve_continuous_are(wanders.T, np.array([[1.0], [0.0]]), np.diag([0.0, WALK]), [[density]])
    assert P[0, 0] ** 0.5 == pytest.approx(sigma, rel=1e-6)
    assert sent.covariance_ee == sent.covariance_nn


def test_what_comes_rarely_is_not_widened() -> None:
    assert widened(FIX, 3600.0) == FIX
    assert widened(FIX, float("inf")) == FIX
    ratio = widened(FIX, 0.2).covariance_nn / FIX.covariance_nn
    assert widened(FIX, 0.2).covariance_ne == pytest.approx(ratio * FIX.covariance_ne)
    assert widened(FIX, 0.2).covariance_nn == pytest.approx(5.0 * widened(FIX, 1.0).covariance_nn)
