"""Test that wrong samples have a flag, for each fault of sensor, telemetry and computer in a survey."""

import pytest
from faults import FAULTS, Flight, prepare, score, stalls

HALF_A_PERCENT = 4
"""Samples of 900 that may be wrong without a flag: 0.3 % are 2.7 of them, as chance has it."""
HUMS = {"hum of 30 nT, 37 s", "hum of 10 nT, 90 s"}
UNSEEN = HUMS | {
    "hum of 10 nT, 150 s",
    "gain of x +2 %",
    "gain of y +2 %",
    "offset of x +100 nT with a motion",
    "drift of z, 20 nT/h",
}
"""On a steady course the fault is a constant or a slope, like the crustal field."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    return prepare(tmp_path_factory.mktemp("flight"), 1, 1.0)


@pytest.mark.parametrize("fault", sorted(FAULTS.keys() - UNSEEN))
def test_what_is_wrong_is_flagged_or_its_sigma_grows(flight: Flight, fault: str) -> None:
    found = score(flight, FAULTS[fault](flight.survey))
    assert found.wrong <= HALF_A_PERCENT
    assert found.samples == 900
    if fault in ("none", "telemetry 2 s late"):
        assert found.flagged < 0.05 * found.samples
        assert found.sigma < 3.0


@pytest.mark.parametrize("seconds", [1.5, 8.0])
def test_what_waited_while_the_process_stood_still(flight: Flight, seconds: float) -> None:
    found = score(flight, flight.survey, stalls(round(seconds * 1e6), 100_000_000))
    assert found.wrong <= HALF_A_PERCENT
    assert found.flagged < 0.15 * found.samples


def test_another_glider_s_calibration(tmp_path_factory: pytest.TempPathFactory) -> None:
    other = prepare(tmp_path_factory.mktemp("other"), 1, 0.5, calibrated_by=101)
    assert score(other, other.survey).wrong <= HALF_A_PERCENT


@pytest.mark.parametrize("fault", sorted(HUMS))
def test_a_hum_is_learned_within_some_of_its_periods(flight: Flight, fault: str) -> None:
    found = score(flight, FAULTS[fault](flight.survey))
    assert found.wrong < 0.03 * found.samples
    assert found.sigma > 5.0 or found.flagged > 0.3 * found.samples


def test_a_gain_of_one_axis_is_seen_when_the_dive_becomes_a_climb(
    flight: Flight, tmp_path_factory: pytest.TempPathFactory
) -> None:
    # of five gliders, two see the jump for gains of 1.5 to 3 %; the sigma of the others covers the error
    clear = prepare(tmp_path_factory.mktemp("clear"), 4, 1.0)
    found = score(clear, FAULTS["gain of x +2 %"](clear.survey))
    assert found.worst < 100.0
    assert found.flagged > 0.7 * found.samples
    assert score(flight, FAULTS["gain of x +2 %"](flight.survey)).wrong < 0.05 * found.samples


def test_a_gain_across_the_field_is_seen_before_the_course_changes(flight: Flight) -> None:
    found = score(flight, FAULTS["gain of y +2 %"](flight.survey))
    assert found.wrong < 0.1 * found.samples
    assert found.sigma > 50.0
