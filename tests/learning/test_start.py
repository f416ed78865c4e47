"""From nothing: a vehicle of which only the class is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from worlds import FIELD, MASS, World, calibration, error_of, learn

from magbridge.calibration.model import Calibration
from magbridge.learning import Learner
from magbridge.learning.start import class_prior

HARD_IRON = np.array([2500.0, -1800.0, 3000.0])


def vehicle() -> Calibration:
    """Return one with thousands of nanotesla of hard iron."""
    known = calibration()
    coefficients = known.coefficients.copy()
    coefficients[6:9] += HARD_IRON
    return replace(known, coefficients=coefficients)


def test_a_vehicle_without_a_calibration_gets_one() -> None:
    """Its error about the mean comes near the noise, and its sigma covers the level that nobody sees."""
    world = World(vehicle(), 2100)
    learner = Learner(class_prior((MASS,), FIELD))
    assert learner.calibration.method == "none"
    learn(learner, world)
    learned = learner.calibration
    assert learned.method == "learned"
    assert error_of(learned, world) < 1.5
    assert 0.8 < learned.noise.sensor < 1.2
    A, T = learned.matrices(world.mass[:, None])
    total = np.linalg.norm(np.matmul(A, (world.field - T)[:, :, None])[:, :, 0], axis=1)
    assert abs(np.mean(total - world.total)) < 2.0 * 145.0


def test_what_was_learned_from_nothing_can_be_forgotten() -> None:
    """It then begins with nothing again."""
    learner = Learner(class_prior((MASS,), FIELD))
    learn(learner, World(vehicle(), 300))
    assert learner.calibration.method == "learned"
    learner.forget()
    assert learner.calibration.method == "none"
    assert learner.samples == 0


def test_a_class_is_as_unknown_as_physics_lets_it_be() -> None:
    """Thousands of nanotesla of hard iron, a percent of soft iron, and less with every power."""
    prior = class_prior((MASS,), FIELD)
    sigma = np.sqrt(np.diag(prior.covariance)).reshape(-1, 9)
    assert 3000.0 < sigma[0, 6] < 6000.0
    assert 500.0 < sigma[0, 0] < 4000.0
    assert sigma[1, 6] > sigma[2, 6] > sigma[3, 6]
