"""Test the detection of a wrong mounting, which the total field does not show."""

from collections.abc import Iterator
from math import nan

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.health.direction import DirectionCheck
from magbridge.records import Quality

NED = np.array([17_000.0, -5_500.0, 48_500.0])
"""Main field off Newfoundland, nT: inclination 70 deg, declination -18 deg."""


def flight(n: int = 400, seed: int = 1) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Yield time (µs), true attitude (roll, pitch, yaw) and field in body axes, in turns and dives."""
    rng = np.random.default_rng(seed)
    for k in range(n):
        attitude = np.array([rng.normal(0.0, 5.0), 25.0 * np.sign(np.sin(k / 50)), (0.7 * k) % 360.0])
        to_ned = Rotation.from_euler("ZYX", attitude[::-1], degrees=True)
        yield k * 4_000_000, np.radians(attitude), to_ned.inv().apply(NED)


def judge(
    wrong: FloatArray, attitude_error: FloatArray | None = None, field: FloatArray = NED
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Return flags and sigma of each sample and the messages, for a vector multiplied by `wrong` (3, 3)."""
    one, flags, sigma = DirectionCheck(), [], []
    one.expect(*field.tolist())
    rng = np.random.default_rng(2)
    for time_us, attitude, body in flight():
        reported = attitude + rng.normal(0.0, np.radians(1.5), 3)
        one.attitude(time_us, *(reported + (0.0 if attitude_error is None else attitude_error)).tolist())
        sigma.append(one.check(time_us, *(wrong @ body).tolist()) ** 0.5)
        flags.append(one.flags)
    return np.array(flags), np.array(sigma), one.messages


def test_a_right_vector_is_left_alone_and_so_is_one_without_position_or_attitude() -> None:
    compass = np.radians([0.0, 0.0, 15.0])
    for field, off in ((NED, None), (NED, compass), (NED * nan, None), (NED, compass * nan)):
        flags, sigma, reported = judge(np.eye(3), off, field)
        assert not flags.any()
        assert not sigma.any()
        assert reported == []


@pytest.mark.parametrize("axes", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_reversed_axes_are_seen_though_the_total_field_is_right(axes: tuple[int, ...]) -> None:
    signs = np.ones(3)
    signs[list(axes)] = -1.0
    flags, sigma, reported = judge(np.diag(signs))
    assert np.mean((flags == Quality.IMPLAUSIBLE) | (sigma > 10_000.0)) > 0.5
    assert reported


def test_exchanged_axes_and_a_mounting_that_is_pitched_are_flagged() -> None:
    pitched = Rotation.from_euler("y", 20.0, degrees=True).as_matrix()
    for wrong in (np.eye(3)[[1, 0, 2]], np.eye(3)[[0, 2, 1]], pitched):
        flags, sigma, reported = judge(wrong)
        assert np.mean((flags != 0) | (sigma > 5_000.0)) > 0.5
        assert len(reported) <= 2


def test_a_mounting_that_is_turned_is_reported_and_its_vector_s_sigma_spans_the_difference() -> None:
    turned = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    level = np.hypot(NED[0], NED[1])
    one = DirectionCheck()
    one.expect(*NED.tolist())
    for k in range(20):
        one.attitude(k * 1_000_000, 0.0, 0.0, 0.0)
        variance = one.check(k * 1_000_000, *(turned @ NED).tolist())
        assert (variance > 0.0) == (k >= 7)
    assert one.flags == 0, "the total field is right, and which of compass and vector is wrong is not known"
    assert variance**0.5 == pytest.approx(2.0**0.5 * level, rel=1e-6)
    assert one.messages == ["vector +90 deg off the heading: axes or compass wrong"]


def test_what_the_heading_of_a_vehicle_at_the_pole_is_does_not_matter() -> None:
    polar = np.array([3_000.0, 0.0, 57_000.0])
    one = DirectionCheck()
    one.expect(*polar.tolist())
    for k in range(20):
        one.attitude(k * 1_000_000, 0.0, 0.0, 3.0)
        assert one.check(k * 1_000_000, *polar.tolist()) == 0.0
    assert one.messages == []


def looks(
    tilts: list[float], every_us: int = 1_000_000, roll: float = 0.0
) -> tuple[list[int], DirectionCheck]:
    """Return the flags of looks at a vector that is tilted by so many degrees, of a banked vehicle."""
    one, flags = DirectionCheck(), []
    one.expect(*NED.tolist())
    for k, tilt in enumerate(tilts):
        attitude = np.radians([roll, 20.0, 30.0])
        one.attitude(k * every_us, *attitude.tolist())
        to_ned = Rotation.from_euler("ZYX", attitude[::-1])
        wrong = Rotation.from_rotvec(np.radians(tilt) * np.array([NED[1], -NED[0], 0.0]) / np.hypot(*NED[:2]))
        one.check(k * every_us, *to_ned.inv().apply(wrong.apply(NED)).tolist())
        flags.append(one.flags)
    return flags, one


@pytest.mark.parametrize("roll", [-50.0, 0.0, 40.0])
def test_the_inclination_may_be_ten_degrees_off_at_any_bank(roll: float) -> None:
    for tilt in (9.7, -9.7):
        assert not any(looks([tilt] * 30, roll=roll)[0])
    for tilt in (10.3, -10.3):
        flags, one = looks([tilt] * 30, roll=roll)
        assert flags == [0] * 7 + [int(Quality.IMPLAUSIBLE)] * 23
        assert one.messages == [f"inclination off by {tilt:+.0f} deg: axes or mounting wrong"]


def test_eight_looks_in_a_row_have_to_differ_one_a_second() -> None:
    assert not any(looks(([20.0] * 7 + [0.0]) * 5)[0])
    assert not any(looks([20.0] * 60 + [0.0] * 60, every_us=100_000)[0]), "six seconds"
    assert looks([20.0] * 90, every_us=100_000)[0][-1]
    one = DirectionCheck()
    one.expect(*NED.tolist())
    for k in range(60):  # the heading, too
        one.attitude(k * 1_000_000, 0.0, 0.0, 0.0 if k % 8 == 7 else 2.0)
        assert one.check(k * 1_000_000, *NED.tolist()) == 0.0


def test_what_was_seen_is_remembered_for_an_hour() -> None:
    flags, one = looks([20.0] * 10 + [0.0] * 3700)
    assert sum(flag != 0 for flag in flags) == pytest.approx(3602, abs=2)
    assert one.check(3710_000_000, *NED.tolist()) == 0.0
    _, one = looks([20.0] * 10 + [0.0] * 3500)
    tilted = 2.0 * np.linalg.norm(NED) * np.sin(np.radians(10.0))
    assert one.check(3510_000_000, *NED.tolist()) ** 0.5 == pytest.approx(tilted, rel=1e-3)


def test_attitudes_that_are_older_than_five_seconds_tell_nothing() -> None:
    one = DirectionCheck()
    one.expect(*NED.tolist())
    one.attitude(0, 0.0, 0.0, 0.0)
    for k in range(100):
        assert one.check(k * 1_000_000, 0.0, 0.0, -50_000.0) == 0.0
    assert one.flags == 0


def test_a_wrong_heading_and_a_wrong_inclination_are_each_told() -> None:
    one = DirectionCheck()
    one.expect(*NED.tolist())
    turned = Rotation.from_euler("z", 90.0, degrees=True).apply(NED)
    for k in range(40):
        one.attitude(k * 1_000_000, 0.0, 0.0, 0.0)
        one.check(k * 1_000_000, *(turned if k < 20 else NED * [1.0, 1.0, -1.0]).tolist())
    assert [text.split()[0] for text in one.messages] == ["vector", "inclination"]
