"""Test the simulated Earth field, crustal field and water."""

import choclo
import numpy as np
import pytest

from magbridge.errors import OutOfRange
from magbridge.field.geodesy import separation
from sitl.mission import LIMITS, TABLE_1, CrissCross, Leg, Legs, Run, Spirals
from sitl.platform import MOUNTINGS, Mass, Vehicle, draw_vehicle
from sitl.trajectory import Motion, Track, fly
from sitl.world import Geology, Rock, Water, World, dipole_field

MAIN = np.array([17000.0, -6000.0, 49600.0])
WINTER = 1386763200.0  # s, 2013-12-11T12:00Z
GEOLOGY = Geology(sources=60, extent=3000.0, rms=80.0)


def draw_world(seed: int = 1) -> World:
    return World.draw((49.52, -57.87), WINTER, GEOLOGY, Water(), np.random.default_rng(seed))


def test_a_dipole_is_choclos_dipole() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        r, m = rng.normal(0, 1, 3), rng.normal(0, 1, 3)
        # choclo: east, north, up and tesla
        enu = choclo.dipole.magnetic_field(r[1], r[0], -r[2], 0.0, 0.0, 0.0, m[1], m[0], -m[2])
        expected = 1e9 * np.array([enu[1], enu[0], -enu[2]])
        np.testing.assert_allclose(dipole_field(r, m), expected, rtol=1e-9)


def test_rocks_field_has_neither_sources_nor_curl_where_the_vehicle_swims() -> None:
    rock = Rock.draw(GEOLOGY, MAIN, np.random.default_rng(4))
    place, h = np.array([120.0, -340.0, 90.0]), 0.5
    gradient = np.column_stack(
        [(rock.field(place[None] + h * e) - rock.field(place[None] - h * e))[0] / (2 * h) for e in np.eye(3)]
    )
    largest = np.abs(gradient).max()
    assert abs(np.trace(gradient)) < 1e-5 * largest
    assert np.abs(gradient - gradient.T).max() < 1e-5 * largest


def test_crustal_field_is_as_rough_as_asked_and_rougher_below() -> None:
    rock = Rock.draw(GEOLOGY, MAIN, np.random.default_rng(5))
    side = np.linspace(-1500, 1500, 40)

    def anomaly(depth: float) -> float:
        grid = np.stack(np.meshgrid(side, side, [depth]), axis=-1).reshape(-1, 3)
        return float(np.std(rock.field(grid) @ MAIN / np.linalg.norm(MAIN)))

    assert anomaly(0.0) == pytest.approx(80.0)
    assert anomaly(150.0) > anomaly(0.0) > anomaly(-90.0)


def test_upward_continuation_loses_the_fine_structure_first() -> None:
    world = draw_world()
    low, high = (world.anomaly_map(WINTER, altitude, 1500.0, 50.0).anomaly for altitude in (0.0, 300.0))
    roughness = [np.std(np.diff(grid, axis=1)) / np.std(grid) for grid in (low, high)]
    assert roughness[1] < 0.8 * roughness[0]
    assert np.std(high) < np.std(low)


def test_without_crustal_field_there_is_only_the_main_field() -> None:
    world = World.draw((49.52, -57.87), WINTER, Geology(sources=0), Water(), np.random.default_rng(0))
    field = world.field(np.full(2, WINTER), np.array([49.52, 49.53]), np.full(2, -57.87), np.zeros(2))
    assert 52_500 < np.linalg.norm(field[0]) < 53_200  # nT, ppigrf: 52 880
    np.testing.assert_allclose(world.anomaly_map(WINTER, 90.0, 500.0, 250.0).anomaly, 0.0, atol=1e-9)


# ---- the simulated vehicle's magnetic masses ---------------------------------------------------------------


def test_a_mass_that_moves_changes_the_reading_and_a_vehicle_without_masses_does_not_care() -> None:
    vehicle = draw_vehicle(np.random.default_rng(2))
    battery, ballast = np.linspace(-0.5, 0.5, 50), np.full(50, 200.0)
    ambient = np.tile(MAIN, (50, 1))
    reading = vehicle.field(ambient, {"battpos": battery, "ballast": ballast})
    assert np.ptp(reading, axis=0).max() > 20
    bare = Vehicle(vehicle.hard_iron, vehicle.soft_iron)
    assert np.ptp(bare.field(ambient, {"battpos": battery}), axis=0).max() == 0


def test_an_induced_moment_follows_the_field() -> None:
    mass = Mass(
        at=(0.0, 0.0, 1.0), travel=(0.0, 0.0, 0.01), moment=(0.0, 0.0, 0.0), volume=(1e-3, 1e-3, 1e-3)
    )
    ambient = np.array([[0.0, 0.0, 50_000.0], [0.0, 0.0, -50_000.0]])
    field = mass.field(ambient, np.zeros(2))
    # a sphere of susceptibility volume V below the sensor: B_z = 2 V B / (4 pi r^3)
    np.testing.assert_allclose(field[:, 2], 2 * 1e-3 * ambient[:, 2] / (4 * np.pi))


def test_vehicles_are_drawn_from_the_seed_with_the_masses_asked_for() -> None:
    for masses in (("battpos",), ("battpos", "ballast"), tuple(MOUNTINGS)):
        vehicle = draw_vehicle(np.random.default_rng(7), masses)
        assert vehicle == draw_vehicle(np.random.default_rng(7), masses)
        assert vehicle != draw_vehicle(np.random.default_rng(8), masses)
        assert tuple(vehicle.mass) == masses
    assert np.linalg.norm(vehicle.mass["battpos"].at) == pytest.approx(0.5, abs=0.2)


# ---- Missions and the path, attitude and mass positions that the vehicle makes of them -------------------


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
