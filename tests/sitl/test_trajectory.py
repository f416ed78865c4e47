"""Missions and the path, attitude and mass positions that the vehicle makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.errors import OutOfRange
from magbridge.field.geodesy import separation
from sitl.mission import LIMITS, TABLE_1, CrissCross, Leg, Legs, Run, Spirals
from sitl.trajectory import Motion, Track, fly

START = (1386763200.0, 49.52, -57.87)
CALM = Motion(wander=(0.0, 0.0, 0.0))
GLIDER = {name: LIMITS[name] for name in ("battpos", "ballast")}


def fly_legs(*legs: Leg, motion: Motion = CALM, step: float = 0.5) -> Track:
    return fly(legs, START, step, np.random.default_rng(0), motion)


def test_a_leg_converges_to_the_command() -> None:
    track = fly_legs(Leg(duration=300, pitch=-26, roll=5), Leg(duration=300, pitch=26, roll=-5))
    assert track.pitch[590] == pytest.approx(-26, abs=0.01)
    assert track.roll[-1] == pytest.approx(-5, abs=0.01)
    # the way between takes the vehicle's time: two thirds after one settling time
    assert track.pitch[600 + 30] == pytest.approx(26 - 52 * np.exp(-1), abs=1)


def test_a_clockwise_spiral_turns_to_starboard_and_ends_where_it_began() -> None:
    track = fly_legs(Leg(duration=900, pitch=-20, turn=0.8))
    assert track.heading[-1] - track.heading[0] == pytest.approx(720, rel=0.03)
    north, east = separation(*START[1:], track.latitude, track.longitude)
    assert np.hypot(north, east).max() < 2.2 * 0.35 / np.radians(0.8)  # the diameter of the turn
    assert east[100:200].mean() > 0


def test_depth_follows_the_path() -> None:
    track = fly_legs(Leg(duration=600, pitch=-26))
    assert track.depth[-1] == pytest.approx(600 * 0.35 * np.sin(np.radians(29)), rel=0.01)
    climb = fly_legs(Leg(duration=300, pitch=-26), Leg(duration=900, pitch=26))
    assert climb.depth.min() == 0
    assert climb.depth[-1] == 0


def test_in_a_month_it_meets_the_thermocline_as_often_late_as_early() -> None:
    legs = CrissCross(hours=720.0, pitch=(25.0, 2.5)).legs(np.random.default_rng(3), GLIDER)
    depth = fly(legs, START, 4.0, np.random.default_rng(4)).depth
    shallow = [np.mean(third < 40.0) for third in np.array_split(depth, 3)]
    assert min(shallow) > 0.08


def test_a_current_carries_the_vehicle() -> None:
    drift = Motion(wander=(0.0, 0.0, 0.0), current=(0.1, -0.2))
    still, carried = (
        fly_legs(Leg(duration=600, pitch=-26)),
        fly_legs(Leg(duration=600, pitch=-26), motion=drift),
    )
    north, east = separation(still.latitude[-1], still.longitude[-1], carried.latitude, carried.longitude)
    assert (north[-1], east[-1]) == pytest.approx((60, -120), abs=0.5)


def test_masses_move_as_fast_as_they_can_and_then_rest() -> None:
    track = fly_legs(
        Leg(duration=100, pitch=-26, parameters={"battpos": 0.5, "ballast": -200}),
        Leg(duration=100, pitch=26, parameters={"battpos": -0.5}),
    )
    battery = track.parameters["battpos"]
    assert set(battery[:200]) == {0.5}
    assert np.abs(np.diff(battery)).max() == pytest.approx(0.5 * LIMITS["battpos"].rate)
    assert set(np.round(battery[-100:], 9)) == {-0.5}
    assert set(track.parameters["ballast"]) == {-200.0}
    assert set(track.parameters["rollpos"]) == {0.0}


@pytest.mark.parametrize(("name", "value"), [("battpos", 1.2), ("ballast", -231.0), ("keel", 0.0)])
def test_what_the_vehicle_cannot_do_is_refused(name: str, value: float) -> None:
    with pytest.raises(OutOfRange, match=name):
        fly_legs(Leg(duration=10, pitch=0, parameters={name: value}))


def test_the_vehicle_wanders_as_much_as_asked_without_jitter() -> None:
    motion = Motion(wander=(0.5, 0.4, 1.0), wander_memory=60.0, settle=0.0)
    track = fly_legs(Leg(duration=40_000, pitch=-26), motion=motion, step=1.0)
    assert np.std(track.roll) == pytest.approx(0.5, rel=0.15)
    assert np.std(np.diff(track.roll)) < 0.03 * 0.5 * 2


def test_table_1_is_flown_as_printed() -> None:
    for trial in (1, 2):
        legs = Spirals(trial=trial).legs(np.random.default_rng(0), GLIDER)
        assert [leg.pitch for leg in legs] == [row[1] for row in TABLE_1]
        assert [leg.parameters["battpos"] for leg in legs] == [row[1 + trial] for row in TABLE_1]
        assert [leg.parameters["ballast"] for leg in legs] == [-200.0, 200.0] * 5
        assert all(leg.turn > 0 for leg in legs)
        assert sum(leg.duration for leg in legs) / 4 == 2250  # samples


def test_the_survey_goes_out_and_comes_back() -> None:
    legs = CrissCross(hours=6.0).legs(np.random.default_rng(1), GLIDER)
    assert sum(leg.duration for leg in legs) == 6 * 3600
    track = fly(legs, START, 1.0, np.random.default_rng(2))
    north, east = separation(*START[1:], track.latitude, track.longitude)
    away = np.hypot(north, east)
    assert away.max() > 1500
    assert away[-1] < 0.4 * away.max()
    pitch = np.array([leg.pitch for leg in legs])
    assert np.all(np.sign(pitch) == [-1, 1] * (len(legs) // 2))


def test_a_planners_runs_are_flown_in_place_of_the_table() -> None:
    wanted = (Run(pitch=-20, roll=-8, parameters={"battpos": 0.1, "ballast": 120}), Run(pitch=20))
    banked, free = Spirals(runs=wanted, turns=2, duration=600).legs(np.random.default_rng(0), GLIDER)
    assert (banked.pitch, banked.roll, banked.turn) == (-20, -8, 1.2)
    assert banked.parameters == {"battpos": 0.1, "ballast": 120}
    assert 2 < free.roll < 10
    assert not free.parameters


def test_a_planners_list_is_flown_as_it_is() -> None:
    wanted = (Leg(duration=60, pitch=-10, segment="a"), Leg(duration=60, pitch=10, segment="b"))
    assert Legs(runs=wanted).legs(np.random.default_rng(0), GLIDER) == [*wanted]
    assert fly_legs(*wanted).segments == (("a", 0.0, 60.0), ("b", 60.0, 120.0))
