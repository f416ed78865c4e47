"""Test the component from the point of view of a ground station."""

from line import Line, MakeLine

from magbridge.mavlink import Codec
from magbridge.mavlink.enums import MAG_PORT_STATE

START = 1_700_000_000_000_000
NOW = START + 100_000


def test_heartbeat_once_a_second_at_its_own_time(link: Line) -> None:
    link.to(10.05)
    beats = [at for at, frame in link.sent if frame[7] == 0]
    assert beats == [START + i * 1_000_000 for i in range(11)]
    (beat,) = link.only(link.to(11.0), "HEARTBEAT")
    assert (beat.type, beat.autopilot, beat.mavlink_version) == (18, 8, 3)
    assert (beat.get_srcSystem(), beat.get_srcComponent()) == (1, 191)
    assert beat.system_status == 5  # critical: no sensor


def test_next_deadline_is_when_something_is_sent(link: Line) -> None:
    for _ in range(20):
        deadline = link.component.output.next_deadline
        link.component.output.advance(deadline - 4)
        assert not link.component.output.drain()
        link.component.output.advance(deadline)
        assert {at for at, _ in link.component.output.drain()} == {deadline}


def test_status(make_link: MakeLine) -> None:
    status = {"samples": 5, "sensor_state": MAG_PORT_STATE.OK, "log_records": 3}
    link = make_link(calibration_id=7, status=lambda: status)
    link.to(0)
    link.give(b"garbage" + link.autopilot.pack("HEARTBEAT", type=12, autopilot=3))
    received = link.to(3)
    sent = link.only(received, "MAG_STATUS")[-1]
    assert (sent.samples, sent.calibration_id, sent.uptime, sent.link_frames) == (5, 7, 3, 1)
    assert (sent.link_bytes_skipped, sent.log_records) == (7, 3)
    assert sent.autopilot_state == MAG_PORT_STATE.OK
    assert link.only(received, "HEARTBEAT")[-1].system_status == 4


def test_telemetry_only_of_our_vehicle(link: Line) -> None:
    link.fly("ATTITUDE", roll=0.5)
    assert [message["roll"] for message in link.telemetry] == [0.5]
    for codec in (Codec(2, 1), Codec(1, 191)):
        link.give(codec.pack("ATTITUDE", roll=1))
        assert link.telemetry == []


def test_every_received_message_is_kept_for_the_log(link: Line) -> None:
    frame = link.autopilot.pack("ATTITUDE", roll=0.5)
    inside = link.autopilot.pack("MAG_LINK_BYTES", length=1, data=b"x")
    noise = bytes(range(250)) * 2
    link.give(frame + noise + inside + frame)
    assert link.component.received[0] == link.component.received[-1] == frame
    kept = Codec(1, 1).parse(b"".join(link.component.received[1:-1]) + frame)[:-1]
    assert {message.name for message in kept} == {"MAG_LINK_BYTES"}
    assert b"".join(message["data"][: message["length"]] for message in kept) == noise + inside


def test_timesync_is_answered_to_the_asker(link: Line) -> None:
    (answer,) = link.only(link.send_message("timesync", 0, 123456789), "TIMESYNC")
    assert (answer.tc1, answer.ts1) == (NOW * 1000, 123456789)
    mine = link.fly("TIMESYNC", ts1=5, target_system=1, target_component=158)
    assert not link.only(mine, "TIMESYNC")


def test_the_status_is_dated_by_the_clock_as_it_was_set(link: Line) -> None:
    """The autopilot's clock is 1,000 s; ours, set to be right, changes and its own does not."""
    (ask,) = [m for m in link.to(0.6) if m.get_type() == "TIMESYNC"]
    link.fly("TIMESYNC", tc1=1000 * 10**9, ts1=ask.ts1)
    before = link.only(link.to(1.0), "MAG_STATUS")[-1]
    assert before.time_usec == link.now
    link.component.codec.utc_offset_us = -3_600_000_000
    after = link.only(link.to(2.0), "MAG_STATUS")[-1]
    assert after.time_usec == link.now - 3_600_000_000
    assert after.vehicle_clock_offset - before.vehicle_clock_offset == 3_600_000_000
