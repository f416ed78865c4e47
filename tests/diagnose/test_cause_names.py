"""One vocabulary of causes: what learns in flight has the names of the diagnosis."""

from __future__ import annotations

from magbridge.diagnose.causes import CAUSES
from magbridge.learning import alarms


def test_a_cause_learned_in_flight_has_a_name_of_the_diagnosis() -> None:
    assert set(alarms.CAUSE_UNITS) <= set(CAUSES)
    assert set(alarms.FROM_ZERO) <= set(alarms.CAUSE_UNITS)
