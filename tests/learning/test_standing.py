"""The state of an alarm: its reports, and when its cause is learned."""

from __future__ import annotations

from magbridge.learning.alarms import (
    LOG_RATIO_PER_CAUSE,
    MIN_GROWTH,
    SILENT_SAMPLES,
    AlarmState,
    LearningAlarm,
)


def alarm(strength: float, *causes: str) -> LearningAlarm:
    return LearningAlarm(causes, ("",) * len(causes), since=0.0, size=5.0, strength=strength)


def standing(*alarms: LearningAlarm, telling: int = 0) -> AlarmState:
    """Return how it stands after these, and so many telling samples and as many that are not."""
    one = AlarmState()
    for each in alarms:
        one.update(each)
    return counted(one, telling)


def counted(one: AlarmState, telling: int, error: float = 0.0) -> AlarmState:
    """Return it after so many telling samples, predicted within `error` (nT), and as many that are not."""
    for _ in range(telling):
        one.count(error, 1.0, informative=True)
        one.count(0.0, 1.0, informative=False)
    return one


def test_it_is_learned_sooner_the_fewer_causes_fit() -> None:
    """One more cause asks for as much more evidence."""
    two = "offset_drift", "temperature_offset"
    first = alarm(20.0, *two)
    assert not standing(first, alarm(20.1 + MIN_GROWTH, *two)).is_certain
    assert standing(first, alarm(20.1 + MIN_GROWTH + LOG_RATIO_PER_CAUSE, *two)).is_certain
    assert standing(first, alarm(20.1 + MIN_GROWTH, "offset_drift")).is_certain
    assert standing(first).update(alarm(22.0, "offset_drift")) == ""  # its cause is reported at its end


def relapsed() -> AlarmState:
    """Return one whose cause was learned, and mistaken: errors of 30 nT were seen."""
    one = standing(alarm(20.0, "offset_step"))
    one.try_cause()
    assert one.variance == 25.0  # until it is confirmed
    assert one.confirm()
    counted(one, SILENT_SAMPLES - 1, 30.0)
    assert one.update(alarm(19.0, "offset_drift")) == "unexplained still: 5 nT, offset drift"
    return one


def test_a_learned_change_with_another_alarm_was_mistaken() -> None:
    """The alarm stays the same, sigma includes the seen error, and the next threshold is higher."""
    one = relapsed()
    assert (one.relapses, one.alarm and one.alarm.since) == (1, 0.0)
    assert 28.0 < one.variance**0.5 < 30.0
    assert one.update(alarm(19.0 + 2 * MIN_GROWTH, "offset_step")) == ""
    assert not one.is_certain
    one.update(alarm(20.0 + 4 * MIN_GROWTH, "offset_step"))
    assert one.is_certain


def test_a_relapsed_alarm_ends_when_the_learned_change_has_explained_many_samples() -> None:
    """Without a message before; a significant error restarts its count."""
    one = relapsed()
    one.try_cause()
    assert not one.confirm()
    assert one.is_tried
    assert not one.is_certain
    counted(one, SILENT_SAMPLES, 0.0)
    counted(one, 1, 5.0)
    assert not one.is_silent
    assert one.flags
    assert counted(one, SILENT_SAMPLES + 1).is_silent


def test_the_next_alarm_after_a_long_time_is_another() -> None:
    """The learned change has explained the data, so it was not a mistake."""
    one = standing(alarm(20.0, "offset_step"))
    one.try_cause()
    one.confirm()
    counted(one, SILENT_SAMPLES + 1)
    assert one.update(alarm(19.0, "offset_drift")) == "unexplained: 5 nT, offset drift"
    assert one.relapses == 0
    one.mark_mistaken()  # rolled back meanwhile: on trial
    assert (one.relapses, one.is_tried) == (1, True)
