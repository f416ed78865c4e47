"""Commands, acknowledged to the asker."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import pytest
from line import Line

from magbridge.mavlink import Codec

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
FIELD, HEARTBEAT, STATUS, HIGHRES_IMU, VERSION, METADATA = 60101, 0, 60102, 105, 148, 397
GET, SET, REQUEST, CAPABILITIES, START_MAG_CAL = 510, 511, 512, 520, 42424


def result(link: Line, messages: list[Any]) -> int:
    (ack,) = link.only(messages, "COMMAND_ACK")
    assert (ack.get_srcComponent(), ack.command) == (191, link.asked)
    number: int = ack.result
    return number


def test_request_message(link: Line) -> None:
    received = link.command(REQUEST, STATUS)
    assert result(link, received) == ACCEPTED
    assert len(link.only(received, "MAG_STATUS")) == 1
    assert result(link, link.command(REQUEST, FIELD)) == TEMPORARILY_REJECTED  # no sample yet
    assert result(link, link.command(REQUEST, 24)) == DENIED
    assert result(link, link.command(REQUEST, nan)) == DENIED
    assert result(link, link.command(REQUEST, inf)) == DENIED


def test_version(link: Line) -> None:
    for number, param in ((REQUEST, VERSION), (CAPABILITIES, 1)):
        received = link.command(number, param)
        assert result(link, received) == ACCEPTED
        (version,) = link.only(received, "AUTOPILOT_VERSION")
        assert version.flight_sw_version == 0x010203FF
        assert version.capabilities == 2 | 8 | 32 | 8192 | 131072


def test_intervals(link: Line) -> None:
    received = link.command(SET, HIGHRES_IMU, 100_000)
    assert result(link, received) == ACCEPTED
    (value,) = link.only(received, "PARAM_VALUE")  # a parameter changed: stations want to know
    assert (value.param_id, value.param_value) == ("MB_R_HIGHRES_IMU", 10.0)
    received = link.command(GET, HIGHRES_IMU)
    assert link.only(received, "MESSAGE_INTERVAL")[0].interval_us == 100_000
    assert result(link, link.command(SET, HIGHRES_IMU, -1)) == ACCEPTED
    assert link.only(link.command(GET, HIGHRES_IMU), "MESSAGE_INTERVAL")[0].interval_us == -1
    assert result(link, link.command(SET, HEARTBEAT, 200_000)) == ACCEPTED
    assert len(link.only(link.to(10.05), "HEARTBEAT")) == pytest.approx(50, abs=1)
    assert result(link, link.command(SET, HEARTBEAT, 0)) == ACCEPTED
    assert len(link.only(link.to(20.05), "HEARTBEAT")) == pytest.approx(10, abs=1)


@pytest.mark.parametrize(
    ("message", "interval"),
    [
        (HEARTBEAT, -1),
        (HEARTBEAT, 1e9),
        (FIELD, 10),
        (FIELD, -2),
        (FIELD, nan),
        (24, 1000),
        (-1, 0),
        (1e30, 0),
    ],
)
def test_intervals_that_are_refused(link: Line, message: float, interval: float) -> None:
    before = dict(link.component.parameters.changed())
    assert result(link, link.command(SET, message, interval)) == DENIED
    assert link.component.parameters.changed() == before


@pytest.mark.parametrize("message", [HIGHRES_IMU, STATUS])
def test_an_interval_of_an_age_is_kept(link: Line, message: int) -> None:
    """MESSAGE_INTERVAL holds 36 minutes."""
    assert result(link, link.command(SET, message, 1e38)) == ACCEPTED
    assert link.only(link.command(GET, message), "MESSAGE_INTERVAL")[0].interval_us == 0x7FFFFFFF


def test_an_interval_is_a_message_that_can_be_requested(link: Line) -> None:
    """MAVLink has deprecated GET_MESSAGE_INTERVAL in favour of this."""
    assert result(link, link.command(SET, HIGHRES_IMU, 100_000)) == ACCEPTED
    received = link.command(REQUEST, 244, HIGHRES_IMU)
    assert result(link, received) == ACCEPTED
    assert link.only(received, "MESSAGE_INTERVAL")[0].interval_us == 100_000


def test_interval_of_a_message_we_do_not_send(link: Line) -> None:
    assert link.only(link.command(GET, 24), "MESSAGE_INTERVAL")[0].interval_us == 0
    assert result(link, link.command(GET, 70_000)) == DENIED


def test_unknown_commands_are_unsupported_but_not_for_others(link: Line) -> None:
    assert result(link, link.command(400, 1)) == UNSUPPORTED
    assert link.command(400, 1, target=(1, 1)) == []
    assert link.command(400, 1, target=(2, 191)) == []


def test_to_everybody_we_do_only_what_only_we_can(link: Line) -> None:
    assert link.command(START_MAG_CAL, 1, target=(1, 0)) == []
    assert link.command(REQUEST, VERSION, target=(1, 0)) == []
    assert link.command(SET, HIGHRES_IMU, 1000, target=(0, 0)) == []
    received = link.command(REQUEST, STATUS, target=(1, 0))
    assert result(link, received) == ACCEPTED
    assert len(link.only(received, "MAG_STATUS")) == 1


def test_command_int(link: Line) -> None:
    link.asked = REQUEST
    received = link.send_message("command_int", 1, 191, 0, REQUEST, 0, 0, STATUS, 0, 0, 0, 0, 0, 0)
    assert result(link, received) == ACCEPTED


def test_the_acknowledgement_is_addressed(link: Line) -> None:
    (ack,) = link.only(link.command(400), "COMMAND_ACK")
    frame = next(frame for _, frame in reversed(link.sent) if frame[7] == 77)
    assert ack.result == UNSUPPORTED
    assert frame[10 + 8 : 10 + 10] == bytes((255, 190))  # target_system, target_component


def test_a_flood_is_rejected_and_reported_once_and_costs_no_other_peer(link: Line) -> None:
    """Of metadata, say: the first hundred of a second are answered."""
    results = [result(link, link.command(REQUEST, METADATA)) for _ in range(300)]
    assert results == [ACCEPTED] * 100 + [TEMPORARILY_REJECTED] * 200
    others = Codec(255, 191)
    ask = {"target_system": 1, "target_component": 191, "command": REQUEST, "param1": METADATA}
    received = link.give(others.pack("COMMAND_LONG", **ask))
    assert [one.result for one in link.only(received, "COMMAND_ACK")] == [ACCEPTED]
    reported = [text for _, text in link.component.announcer.texts if "commands a second" in text]
    assert reported == ["more than 100 commands a second from 255:190"]
    link.to(2.0)
    assert result(link, link.command(REQUEST, METADATA)) == ACCEPTED
