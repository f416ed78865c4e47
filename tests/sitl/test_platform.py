"""The simulated vehicle's magnetic masses."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.platform import MOUNTINGS, Mass, Vehicle, draw_vehicle

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
