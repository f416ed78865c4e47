"""Attitude from rates and the field's direction while the autopilot's is wrong; gaps in telemetry."""

from __future__ import annotations

from math import atan2, cos, degrees, radians, sin, sqrt

import numpy as np
import pytest

from magbridge.navigate.attitude import AttitudeFilter, exponential, rotation
from magbridge.navigate.deadreckoning import DeadReckoning

MAIN = np.array([18_000.0, -5_000.0, 48_000.0])


def flown(*, wrong: bool) -> tuple[float, float, float]:
    """Return errors (deg) of the filter's and the autopilot's heading after two minutes, and the sigma (deg).

    The aircraft turns left and right. From 60 s on, the autopilot's bias and attitude are wrong if `wrong`.
    """
    rng = np.random.default_rng(4)
    attitude, filter_ = np.eye(3), AttitudeFilter()
    for tick in range(1200):
        time = 0.1 * tick
        rates = np.array([0.2 * sin(time), 0.1 * cos(0.7 * time), 0.15 * sin(0.2 * time)])
        attitude = attitude @ exponential(rates * 0.1)
        bad = wrong and time > 60.0
        bias = radians(3.0) * np.array([1.0, -1.0, 2.0]) if bad else np.zeros(3)
        tilt = rotation(radians(15.0), radians(-10.0), radians(40.0)) if bad else np.eye(3)
        claimed = tilt @ attitude
        angles = (
            atan2(claimed[2, 1], claimed[2, 2]),
            -np.arcsin(claimed[2, 0]),
            atan2(claimed[1, 0], claimed[0, 0]),
        )
        later = rates + np.array([0.2 * cos(time), -0.07 * sin(0.7 * time), 0.03 * cos(0.2 * time)]) * 0.05
        filter_.rotate(time, time, angles, later + bias, vouched=not bad)
        filter_.gyro(time + 0.05, later)
        filter_.direct(time, attitude.T @ MAIN + rng.normal(0.0, 100.0, 3), MAIN)
    true = atan2(attitude[1, 0], attitude[0, 0])
    own, autopilot = ((degrees(yaw - true) + 180.0) % 360.0 - 180.0 for yaw in (filter_.heading, angles[2]))
    assert filter_.agrees is not wrong
    return own, autopilot, degrees(filter_.heading_sigma)


def test_the_heading_holds_while_the_autopilot_is_wrong() -> None:
    own, autopilot, sigma = flown(wrong=True)
    assert abs(autopilot) > 25.0
    assert abs(own) < min(6.0, 3.0 * sigma)


def test_the_autopilot_is_used_while_it_is_right() -> None:
    own, autopilot, _ = flown(wrong=False)
    assert abs(autopilot) < 0.1
    assert abs(own) < 3.0


@pytest.mark.parametrize("reports", [1, 5])
def test_a_turn_during_a_gap_is_uncertain_by_the_speed_times_the_gap(reports: int) -> None:
    """Reports that have waited arrive at once; their changes belong to the gap."""
    where = DeadReckoning()
    where.telemetry(0.0, {"heading": 0.0, "speed": 20.0})
    where.telemetry(1.0, {"heading": 0.0, "speed": 20.0})
    for number in range(1, reports + 1):
        where.telemetry(6.0 + 0.01 * number, {"heading": 90.0 * number / reports, "speed": 20.0})
    noise = where.noise
    # the velocity changes by 20 sqrt(2) m/s at an unknown moment of 5 s
    assert sqrt(noise.nn + noise.ee) >= 0.95 * 20.0 * sqrt(2.0) * 5.0 / sqrt(12.0)
    assert sqrt(noise.nn + noise.ee) < 20.0 * 5.0
