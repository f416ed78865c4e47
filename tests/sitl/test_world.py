"""The simulated Earth field, crustal field and water."""

from __future__ import annotations

import choclo
import numpy as np
import pytest

from sitl.platform import MOUNTINGS, Mass, Vehicle, draw_vehicle
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


EARTH = np.array([17000.0, -6000.0, 49600.0])


def test_a_mass_that_moves_changes_the_reading_and_a_vehicle_without_masses_does_not_care() -> None:
    vehicle = draw_vehicle(np.random.default_rng(2))
    battery, ballast = np.linspace(-0.5, 0.5, 50), np.full(50, 200.0)
    ambient = np.tile(EARTH, (50, 1))
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
