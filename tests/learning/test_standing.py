"""The state of an alarm: its reports, and when its cause is learned."""

from __future__ import annotations

from magbridge.learning.alarms import (
    LOG_RATIO_PER_CAUSE,
    QUIET,
    SURE,
    AlarmState,
    LearningAlarm,
)


def alarm(strength: float, *causes: str) -> LearningAlarm:
    return LearningAlarm(causes, ("",) * len(causes), since=0.0, size=5.0, strength=strength)


def standing(*alarms: LearningAlarm, telling: int = 0) -> AlarmState:
    """Return how it stands after these, and so many telling samples and as many that are not."""
    one = AlarmState()
    for each in alarms:
        one.raised(each)
    return counted(one, telling)


def counted(one: AlarmState, telling: int, error: float = 0.0) -> AlarmState:
    """Return it after so many telling samples, predicted within `error` (nT), and as many that are not."""
    for _ in range(telling):
        one.count(error, 1.0, telling=True)
        one.count(0.0, 1.0, telling=False)
    return one


def test_it_is_learned_sooner_the_fewer_causes_fit() -> None:
    """One more cause asks for as much more evidence."""
    two = "offset_drift", "temperature_offset"
    first = alarm(20.0, *two)
    assert not standing(first, alarm(20.1 + SURE, *two)).ripe
    assert standing(first, alarm(20.1 + SURE + LOG_RATIO_PER_CAUSE, *two)).ripe
    assert standing(first, alarm(20.1 + SURE, "offset_drift")).ripe
    assert standing(first).raised(alarm(22.0, "offset_drift")) == ""  # its cause is reported at its end


def relapsed() -> AlarmState:
    """Return one whose cause was learned, and mistaken: errors of 30 nT were seen."""
    one = standing(alarm(20.0, "offset_step"))
    one.take_up()
    assert one.variance == 25.0  # until it is confirmed
    assert one.confirmed()
    counted(one, QUIET - 1, 30.0)
    assert one.raised(alarm(19.0, "offset_drift")) == "unexplained still: 5 nT, offset drift"
    return one


def test_a_learned_change_with_another_alarm_was_mistaken() -> None:
    """The alarm stays the same, sigma includes the seen error, and the next threshold is higher."""
    one = relapsed()
    assert (one.relapses, one.alarm and one.alarm.since) == (1, 0.0)
    assert 28.0 < one.variance**0.5 < 30.0
    assert one.raised(alarm(19.0 + 2 * SURE, "offset_step")) == ""
    assert not one.ripe
    one.raised(alarm(20.0 + 4 * SURE, "offset_step"))
    assert one.ripe


def test_a_relapsed_alarm_ends_when_the_learned_change_has_explained_many_samples() -> None:
    """Without a message before; a significant error restarts its count."""
    one = relapsed()
    one.take_up()
    assert not one.confirmed()
    assert one.tried
    assert not one.ripe
    counted(one, QUIET, 0.0)
    counted(one, 1, 5.0)
    assert not one.gone
    assert one.flags
    assert counted(one, QUIET + 1).gone


def test_the_next_alarm_after_a_long_time_is_another() -> None:
    """The learned change has explained the data, so it was not a mistake."""
    one = standing(alarm(20.0, "offset_step"))
    one.take_up()
    one.confirmed()
    counted(one, QUIET + 1)
    assert one.raised(alarm(19.0, "offset_drift")) == "unexplained: 5 nT, offset drift"
    assert one.relapses == 0
    one.mistaken()  # rolled back meanwhile: on trial
    assert (one.relapses, one.tried) == (1, True)
