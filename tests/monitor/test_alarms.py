"""Begin, end and repetition of an alarm, and its acknowledgement."""

from __future__ import annotations

import pytest

from magbridge.mavlink import Codec
from magbridge.monitor.history import MAX_ALARMS, Alarms
from magbridge.monitor.link import ReceivedBridges
from magbridge.monitor.words import learned_worth
from magbridge.records import Quality


def test_an_alarm_stands_until_it_is_acknowledged_and_returns_when_it_begins_again() -> None:
    alarms = Alarms()
    alarms.update({"gap": "Samples are missing"}, 1.0)
    alarms.update({"gap": "Samples are missing"}, 2.0)
    (one,) = alarms
    assert (one.since, one.last, one.count, one.active, alarms.unseen) == (1.0, 2.0, 1, True, 1)
    alarms.update({}, 3.0)
    (one,) = alarms
    assert (one.active, alarms.unseen) == (False, 1)  # it was active, and not yet acknowledged
    alarms.acknowledge("sensor")
    assert alarms.unseen == 0
    alarms.update({"gap": "Samples are missing"}, 5.0)
    (one,) = alarms
    assert (one.since, one.count, one.active, alarms.unseen) == (5.0, 2, True, 1)


def test_alarms_are_bounded_and_newest_first() -> None:
    alarms = Alarms()
    for k in range(1000):
        alarms.announce(f"text: {k}", str(k), float(k))
    assert [alarm.text for alarm in alarms][:2] == ["999", "998"]
    assert len(list(alarms)) == MAX_ALARMS
    alarms.acknowledge()
    assert alarms.unseen == 0


def test_which_received_messages_raise_an_alarm() -> None:
    """A moving mass raises no alarm; a stale parameter, a lost sensor, an error and silence do."""
    fleet, bridge = ReceivedBridges(), Codec(1, 191)

    def feed(now: float, name: str, **fields: object) -> None:
        for message in Codec(255, 190).parse(bridge.pack(name, **fields)):
            fleet.receive(message, now)
        fleet.due(now)

    feed(0.0, "MAG_FIELD", flags=int(Quality.MOVING | Quality.NO_BORESIGHT))
    alarms = fleet.states[1, 191].alarms
    assert list(alarms) == []
    feed(1.0, "MAG_FIELD", flags=int(Quality.STALE_TELEMETRY))
    feed(2.0, "MAG_STATUS", sensor_state=3, autopilot_state=0, log_state=1)
    feed(3.0, "STATUSTEXT", severity=3, text="log failed: disk full")
    feed(3.1, "STATUSTEXT", severity=4, text="only a warning")
    fleet.due(20.0)
    assert {alarm.key for alarm in alarms} == {
        "stale_telemetry",
        "Sensor",
        "text: log failed: disk full",
        "silence",
    }


def test_alarms_of_one_cause_are_one_group() -> None:
    alarms = Alarms()
    alarms.announce("text: hmr2300 lost: unplugged", "hmr2300 lost: unplugged", 1.0)
    alarms.update({"gap": "Samples are missing", "Sensor": "Sensor: lost", "Log": "Log: failed"}, 2.0)
    assert {group.cause: len(group.alarms) for group in alarms.groups} == {"sensor": 3, "log": 1}
    assert alarms.unseen == 2
    sensor = next(group for group in alarms.groups if group.cause == "sensor")
    assert sensor.text == "Samples are missing; Sensor: lost; hmr2300 lost: unplugged"
    alarms.acknowledge("sensor")
    assert alarms.unseen == 1
    assert {group.cause: group.acknowledged for group in alarms.groups} == {"sensor": True, "log": False}


@pytest.mark.parametrize(
    ("first", "published", "samples", "better", "words", "good"),
    [
        (12.0, 3.0, 2000, 20.0, "12.00 nT ...: 0.25 times (95 %: 0.23 to 0.27, over 500", True),
        (10.0, 9.8, 100, 1.0, "0.98 times (95 %: 0.81 to 1.19, over 100 samples). It is not shown", False),
        (10.0, 5.0, 2000, -3.0, "favour the first calibration", False),
        (0.0, 0.0, 0, 0.0, "not known yet", False),
    ],
)
def test_what_an_accepted_calibration_is_worth(
    first: float, published: float, samples: int, better: float, words: str, good: bool
) -> None:
    learning = {"calibration_id": 1, "first_calibration_id": 2, "rms_first": first, "samples": samples}
    text, is_good = learned_worth({**learning, "rms_published": published, "better": better})
    assert is_good == good
    assert all(part in text for part in words.split(" ..."))
    text, is_good = learned_worth({**learning, "calibration_id": 2})
    assert is_good
    assert "only acknowledges" in text
