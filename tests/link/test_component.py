"""Test the component from the point of view of a ground station."""

import random
from math import inf, nan
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from line import Line, MakeLine

from magbridge.config import Align, Link
from magbridge.link.component import Component
from magbridge.link.parameters import alignment
from magbridge.mavlink import Codec, FrameLogReader, Signing, spec
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
    link = make_link(
        calibration_id=7,
        status=lambda: {"samples": 5, "sensor_state": MAG_PORT_STATE.OK, "log_records": 3},
    )
    link.to(0)
    link.give(b"garbage" + link.autopilot.pack("HEARTBEAT", type=12, autopilot=3))
    received = link.to(3)
    status = link.only(received, "MAG_STATUS")[-1]
    assert (status.samples, status.calibration_id, status.uptime, status.link_frames) == (5, 7, 3, 1)
    assert (status.link_bytes_skipped, status.log_records) == (7, 3)
    assert status.autopilot_state == MAG_PORT_STATE.OK
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


def test_replaying_what_was_received_gives_the_same_bytes(make_link: MakeLine) -> None:
    """Garbage, requests, time synchronisation, cut at random: the log's frames bring it all back."""
    rng = random.Random(5)
    first, second = make_link(), make_link()
    log: list[tuple[int, bytes]] = []
    for i in range(400):
        first.now += 4 * rng.randrange(20_000)
        first.component.output.advance(first.now)
        data = rng.choice(
            [
                rng.randbytes(rng.randrange(60)),
                first.autopilot.pack("ATTITUDE", time_boot_ms=10 * i, roll=0.1 * i),
                first.autopilot.pack("HEARTBEAT", type=12, autopilot=3),
                Codec(255, 190).pack("PARAM_REQUEST_LIST", target_system=1, target_component=191),
                Codec(255, 190).pack(
                    "PARAM_SET", target_system=1, target_component=191, param_id="MB_GAP_FACTOR",
                    param_value=rng.uniform(-1, 10), param_type=9,
                ),
            ]
        )  # fmt: skip
        first.component.receive(data, first.now)
        log += [(first.now, frame) for frame in first.component.received]
        first.component.received.clear()
    first.to(40)
    frame_log = FrameLogReader()
    for at, frame in log:
        second.component.output.advance(at)
        second.component.receive(frame_log.data(frame), at)
    second.to(40)
    assert len(first.sent) > 200
    assert second.sent == first.sent
    assert first.component.codec.bytes_skipped == second.component.codec.bytes_skipped > 1000


def test_timesync_is_answered_to_the_asker(link: Line) -> None:
    (answer,) = link.only(link.send_message("timesync", 0, 123456789), "TIMESYNC")
    assert (answer.tc1, answer.ts1) == (NOW * 1000, 123456789)
    mine = link.fly("TIMESYNC", ts1=5, target_system=1, target_component=158)
    assert not link.only(mine, "TIMESYNC")


def test_signed_both_ways(make_link: MakeLine) -> None:
    key = bytes(range(32))
    signing = Signing(key)
    link = make_link(signing=signing)
    link.station.signing.secret_key = key
    link.station.signing.sign_outgoing = True
    link.station.signing.timestamp = (START - 1_420_070_400_000_000) // 10
    link.to(0.1)
    values = link.send_message("param_request_read", 1, 191, b"", 0)
    assert [message.get_signed() for message in values] == [True]
    link.fly("PARAM_REQUEST_READ", target_system=1, target_component=191, param_index=0)
    assert signing.refused == 1
    (status,) = link.only(link.to(1), "MAG_STATUS")
    assert status.link_refused == 1


SPECIAL = [nan, inf, -inf, 0.0, -0.0, -1.0, 1e38, 3.4e38, 1e-40, 1e9, 60101.0, 511.5]
BITS = (8, 16, 32, 64)
VALUES = {
    "f": st.one_of(st.sampled_from(SPECIAL), st.floats(width=32)),
    "d": st.floats(),
    **{code: st.integers(-(1 << n - 1), (1 << n - 1) - 1) for code, n in zip("bhiq", BITS, strict=True)},
    **{code: st.integers(0, (1 << n) - 1) for code, n in zip("BHIQ", BITS, strict=True)},
}  # fmt: skip
ANSWERED = [
    "COMMAND_INT", "COMMAND_LONG", "HEARTBEAT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET",
    "SYSTEM_TIME", "TIMESYNC",
]  # fmt: skip
COMMANDS = [510, 511, 512, 519, 520, 42424]


@st.composite
def message(draw: st.DrawFn) -> bytes:
    """Return the bytes of a message to which the component reacts, with any values."""
    layout = spec(draw(st.sampled_from(ANSWERED)))
    fields: dict[str, Any] = {
        name: draw(VALUES[field.code]) for name, field in layout.fields.items() if field.code != "s"
    }
    fields["target_system"], fields["target_component"] = 1, draw(st.sampled_from([0, 191]))
    if "param_id" in layout.fields:
        fields["param_id"] = draw(st.sampled_from(["MB_R_HEARTBEAT", "MB_GAP_FACTOR", b"\xff" * 16]))
    if "command" in layout.fields:
        fields["command"] = draw(st.sampled_from(COMMANDS))
    known = {name: value for name, value in fields.items() if name in layout.fields}
    return Codec(*draw(st.sampled_from([(1, 1), (1, 191), (255, 190), (2, 1)]))).pack(layout.name, **known)


@given(st.lists(st.one_of(message(), st.binary(max_size=30)), max_size=15))
def test_it_continues_after_any_message(chunks: list[bytes]) -> None:
    component = Component(Link("u"), {"HIGHRES_IMU": 1.0}, alignment(Align()), start_us=START)
    for i, chunk in enumerate(chunks):
        now = START + i * 300_000
        component.output.advance(now)
        component.receive(chunk, now)
        assert len(component.output.drain()) < 50  # no message makes it send without end
    component.output.advance(START + 10_000_000)
    rows = component.parameters.table.values()
    assert all(row.low <= component.parameters[row.name] <= row.high * 1.0001 for row in rows)
    beats = [1 for _, frame in component.output.drain() if frame[7:10] == b"\0\0\0"]
    assert len(beats) >= 1


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
