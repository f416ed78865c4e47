"""What kind of quantity a telemetry series is, and that no name contradicts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import calibrated, surveyed, walk

from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.compare.kinds import ANY, kinds_of
from magbridge.diagnose.compare.problem import pose
from magbridge.diagnose.compare.survey import Channel


@pytest.mark.parametrize(
    ("name", "unit", "kinds"),
    [
        ("throttle", "", ("current", "position")),
        ("throttle", "%", ("current", "position")),
        ("servo3", "us", ("current", "position")),
        ("esc1_rpm", "rpm", ("current", "position")),
        ("battery_voltage", "V", ("current", "position")),
        ("motor_temperature", "", ("temperature",)),
        ("m_veh_temp", "degC", ("temperature",)),
        ("m_coulomb_current", "A", ("current",)),
        ("esc2_current", "", ("current",)),
        ("depth", "m", ("pressure",)),
        ("height", "m", ("pressure",)),
        ("battpos", "in", ("position",)),
        ("battpos", "m", ("position",)),
        ("vbdCC", "", ("position",)),
        ("descent", "", ANY),
        ("attempts", "1", ANY),
        ("q7", "", ANY),
    ],
)
def test_unit_and_name_give_a_series_its_kind(name: str, unit: str, kinds: tuple[str, ...]) -> None:
    assert kinds_of(name, unit) == kinds


def test_no_cause_is_put_forward_for_a_series_whose_kind_contradicts_it() -> None:
    """And several motors are one candidate, with one common size, beside each by itself."""
    rng = np.random.default_rng(4)
    n = 400
    motors = {name: rng.uniform(size=n) for name in ("throttle", "esc1_current")}
    survey = surveyed(walk(n, rng), np.sin(np.arange(n) / 30.0))
    channels = survey.channels | {
        name: Channel(values, "", kinds_of(name, "")) for name, values in motors.items()
    }
    problem = pose(replace(survey, channels=channels), calibrated(np.zeros(18)))
    made = {cause: {one.channel for one in row.candidates(problem)} for cause, row in CAUSES.items()}
    assert made["temperature_offset"] == made["temperature_scale"] == made["pressure_offset"] == set()
    assert made["unmodelled_actuator"] == {"throttle"}
    assert made["current_field"] == {"throttle", "esc1_current", None}
    (together,) = (one for one in CAUSES["current_field"].candidates(problem) if one.channel is None)
    assert together.size == 6
    assert together.freedom == 1
    assert {name for effect in together.effects for name in effect.channels()} == set(motors)
