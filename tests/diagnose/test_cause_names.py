"""One vocabulary of causes: what learns in flight has the names of the diagnosis."""

from __future__ import annotations

from magbridge.diagnose.causes import CAUSES
from magbridge.learning import causes


def test_a_cause_learned_in_flight_has_a_name_of_the_diagnosis() -> None:
    assert set(causes.CAUSE_UNITS) <= set(CAUSES)
    assert set(causes.FROM_ZERO) <= set(causes.CAUSE_UNITS)
