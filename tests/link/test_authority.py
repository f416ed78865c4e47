"""Who may change what the bridge does, and whose telemetry counts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from line import Line
from small import START, small_bridge

from magbridge.bridge.events import Event, StartEvent
from magbridge.calibration.model import Parameter
from magbridge.config import Telemetry
from magbridge.link.output import Announcer, Outbox, Timers
from magbridge.link.telemetry import Sources
from magbridge.mavlink import Codec
from magbridge.mavlink.enums import MAV_CMD, MAV_RESULT
from magbridge.records import Channel

GCS, QUADROTOR, ONBOARD = 6, 2, 18


def spoken(link: Line, frames: bytes) -> tuple[list[Any], str]:
    received = link.give(frames)
    return received, "".join(link.texts(received))


def texts_by(system: int, component: int, kind: int | None, name: str, **fields: object) -> bytes:
    """Return what a component says after a heartbeat of that kind, or without one."""
    codec = Codec(system, component)
    beat = b"" if kind is None else codec.pack("HEARTBEAT", type=kind)
    return beat + codec.pack(name, target_system=1, target_component=191, **fields)


@pytest.mark.parametrize(
    ("system", "component", "kind", "may"),
    [
        (1, 1, QUADROTOR, True),  # the autopilot
        (255, 190, GCS, True),
        (255, 190, None, True),  # a script that sends no heartbeat
        (1, 190, GCS, True),  # a station on board
        (1, 99, None, False),
        (1, 99, ONBOARD, False),
        (2, 1, QUADROTOR, False),  # another vehicle
    ],
)
def test_who_may_change_parameters_and_rates(
    link: Line, system: int, component: int, kind: int | None, may: bool
) -> None:
    fields = {"param_id": "MB_AGE_BATTPOS", "param_value": 1e6, "param_type": 9}
    received, text = spoken(link, texts_by(system, component, kind, "PARAM_SET", **fields))
    age = 1e6 if may else 30.0
    assert [v.param_value for v in link.only(received, "PARAM_VALUE") if v.param_id == "MB_AGE_BATTPOS"] == [
        age
    ]
    assert link.component.parameters["MB_AGE_BATTPOS"] == age
    assert f"{system}:{component}" in text
    interval = {"command": MAV_CMD.SET_MESSAGE_INTERVAL, "param1": 60101, "param2": -1}
    received, text = spoken(link, texts_by(system, component, kind, "COMMAND_LONG", **interval))
    (ack,) = link.only(received, "COMMAND_ACK")
    assert ack.result == (MAV_RESULT.ACCEPTED if may else MAV_RESULT.DENIED)
    assert link.component.rates["MAG_FIELD"].hertz == (-1.0 if may else 0.0)
    assert (f"{system}:{component} may not set a rate" in text) is not may


def sources(**what: Any) -> tuple[Sources, Announcer]:
    announcer = Announcer(Outbox(Codec(1, 191)), Timers())
    telemetry = {"battpos": Telemetry("NAMED_VALUE_FLOAT", "value", max_age=2.0, **what)}
    return Sources(telemetry, 1, 1, announcer), announcer


@pytest.mark.parametrize(
    ("wanted", "order", "admitted"),
    [
        (None, [(0, 1), (0, 99), (1, 1), (1, 99)], [True, False, True, False]),
        (None, [(0, 99), (0, 1), (1, 99), (1, 1)], [True, True, False, True]),  # the autopilot goes first
        (None, [(0, 25), (1, 99), (2, 25), (3, 99)], [True, False, True, False]),
        (None, [(0, 25), (5, 99), (6, 25)], [True, True, False]),  # it had become stale
        (25, [(0, 99), (0, 1), (0, 25), (9, 99)], [False, False, True, False]),
    ],
)
def test_two_sources_of_one_parameter(
    wanted: int | None, order: list[tuple[int, int]], admitted: list[bool]
) -> None:
    both, announcer = sources(component=wanted)
    assert [both.admit("battpos", who, s * 1_000_000) for s, who in order] == admitted
    reported = [text for _, text in announcer.texts]
    refused = {who for (_, who), good in zip(order, admitted, strict=True) if not good}
    assert {who for who in refused if f"battpos also from 1:{who}: not used" in reported} == refused


def test_another_component_s_value_changes_no_sample(tmp_path: Path) -> None:
    pipeline = small_bridge(tmp_path, StartEvent(START), Parameter("battpos", "", -0.4, 0.6, 0.1, 0.5), [])
    for component, value in ((1, 0.25), (99, 9.0)):
        frame = Codec(1, component).pack("NAMED_VALUE_FLOAT", name="battpos", value=value)
        pipeline.feed(Event(START + component * 1000, Channel.LINK, frame))
    assert pipeline._correction.aligner.by_name["battpos"].last == 0.25
    assert "battpos also from 1:99: not used" in [text for _, text in pipeline.component.announcer.texts]


@pytest.mark.parametrize(
    "number", [MAV_CMD.DO_START_MAG_CAL, MAV_CMD.DO_CANCEL_MAG_CAL, MAV_CMD.FIXED_MAG_CAL_YAW]
)
def test_a_calibration_is_refused_in_words_and_left_to_the_autopilot(link: Line, number: MAV_CMD) -> None:
    received = link.command(number, 0.0)
    (ack,) = link.only(received, "COMMAND_ACK")
    assert ack.result == MAV_RESULT.UNSUPPORTED
    assert "magbridge calibrate" in "".join(link.texts(received))
    assert link.command(number, 0.0, target=(1, 0)) == []
    assert link.command(number, 0.0, target=(1, 1)) == []


def beat(link: Line, component: int = 190, kind: int = GCS) -> None:
    link.give(Codec(255, component).pack("HEARTBEAT", type=kind))


def values(link: Line, until: float) -> list[Any]:
    return link.only(link.to(until), "PARAM_VALUE")


def test_a_station_that_never_asks_gets_the_parameters_twice(link: Line) -> None:
    names = link.component.parameters.names
    assert not values(link, 1.0)
    received = []
    for second in range(1, 60):
        beat(link)
        received += values(link, 1.0 + second)
    times = [at for at, frame in link.sent if frame[7:10] == b"\x16\0\0"]
    assert times[len(names)] - times[0] == 10_000_000
    for one in (received[: len(names)], received[len(names) :]):
        assert [value.param_id for value in one] == names
        assert [value.param_index for value in one] == list(range(len(names)))
        assert {value.param_count for value in one} == {len(names)}
    beat(link, kind=ONBOARD, component=1)
    assert not values(link, 75.0)


def test_a_crowd_of_stations_is_not_a_flood(link: Line) -> None:
    """Two thousand names in ten seconds; a station that comes then still gets its two lists."""
    for k in range(200):
        for component in range(10):
            link.give(Codec(200 + k % 50, component + 1).pack("HEARTBEAT", type=GCS))
        link.to(0.1 + 0.05 * k)
    before = len([1 for _, frame in link.sent if frame[7:10] == b"\x16\0\0"])
    names = len(link.component.parameters.names)
    assert before <= 2 * names
    assert len(values(link, 45.0)) == 2 * names


def test_requests_without_end_do_not_keep_the_list_from_its_end(link: Line) -> None:
    received = []
    for k in range(40):
        link.send_message("param_request_list", 1, 191)
        received += values(link, 1.0 + 0.1 * k)
    assert {value.param_id for value in received} == set(link.component.parameters.names)
