"""How a doubt stands: what is news of it, and when what is behind it is learned."""

from __future__ import annotations

from magbridge.learning.doubt import Alarm
from magbridge.learning.standing import COMPETING, PATIENCE, QUIET, SURE, Standing
from magbridge.records import Quality


def alarm(strength: float, *causes: str) -> Alarm:
    return Alarm(causes, ("",) * len(causes), since=0.0, size=5.0, strength=strength)


def standing(*alarms: Alarm, telling: int = 0) -> Standing:
    """Return how it stands after these, and so many telling samples and as many that are not."""
    one = Standing()
    for each in alarms:
        one.raised(each)
    for _ in range(telling):
        one.count(telling=True)
        one.count(telling=False)
    return one


def test_it_is_learned_sooner_the_fewer_causes_fit() -> None:
    """One more cause asks for as much more evidence."""
    two = "offset_drift", "temperature_offset"
    first = alarm(20.0, *two)
    assert not standing(first, alarm(20.1 + SURE, *two)).ripe
    assert standing(first, alarm(20.1 + SURE + COMPETING, *two)).ripe
    assert standing(first, alarm(20.1 + SURE, "offset_drift")).ripe
    assert standing(first).raised(alarm(22.0, "offset_drift")) == "unexplained: it is offset drift"


def test_patience_is_for_each_cause_and_of_telling_samples() -> None:
    """What tells nothing does not count."""
    assert not standing(alarm(20.0, "offset_drift"), telling=PATIENCE).ripe
    assert standing(alarm(20.0, "offset_drift"), telling=PATIENCE + 1).ripe
    two = alarm(20.0, "offset_drift", "temperature_offset")
    assert not standing(two, telling=2 * PATIENCE).ripe
    assert standing(two, telling=2 * PATIENCE + 1).ripe


def test_an_alarm_that_is_not_news_for_long_is_gone() -> None:
    """One that grows by less than what makes it news is the same still; flag and sigma stand with it."""
    first = alarm(20.0, "offset_step")
    assert Standing().raised(first) == "unexplained: 5 nT, offset step"
    assert standing(first).raised(alarm(21.0, "offset_step")) == ""
    assert not standing(first, telling=QUIET).gone
    gone = standing(first, telling=QUIET + 1)
    assert gone.gone
    assert (gone.flags, gone.variance) == (int(Quality.UNEXPLAINED), 25.0)
    gone.end()
    assert (gone.alarm, gone.flags, gone.variance) == (None, 0, 0.0)
    assert not Standing().ripe
