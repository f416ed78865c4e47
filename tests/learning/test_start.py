"""Test the start without a calibration, from the class of the vehicle only."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from worlds import FIELD, MASS, World, calibration, error_of, learn

from magbridge.calibration.correct import Corrector
from magbridge.calibration.model import Calibration
from magbridge.learning import Learner
from magbridge.learning.estimator import FIRST_FIT_SAMPLES, class_prior

HARD_IRON = np.array([2500.0, -1800.0, 3000.0])


def vehicle() -> Calibration:
    """Return a vehicle with thousands of nanotesla of hard iron."""
    known = calibration()
    coefficients = known.coefficients.copy()
    coefficients[6:9] += HARD_IRON
    return replace(known, coefficients=coefficients)


def test_a_vehicle_without_a_calibration_gets_one() -> None:
    """The error without bias approaches the noise, and sigma includes the unobservable bias."""
    world = World(vehicle(), 2100)
    learner = Learner(class_prior((MASS,), FIELD))
    assert learner.calibration.method == "none"
    learn(learner, world)
    learned = learner.calibration
    assert re.fullmatch(r"learned [0-9a-f]{8} from nothing", learner.notices[0].text)
    assert learned.method == "learned"
    assert error_of(learned, world) < 1.5
    assert 0.8 < learned.noise.sensor < 1.2
    A, T = learned.matrices(world.mass[:, None])
    total = np.linalg.norm(np.matmul(A, (world.field - T)[:, :, None])[:, :, 0], axis=1)
    assert abs(np.mean(total - world.total)) < 2.0 * 145.0


def test_no_way_that_is_flown_tells_the_level() -> None:
    """Some crustal fields are larger than a survey: after 20 km they are as unknown as at first."""
    world, learner = World(vehicle(), 5000), Learner(class_prior((MASS,), FIELD))
    learn(learner, world)
    x, y, z = world.field[-1].tolist()
    (_, sigma, *_), _ = Corrector(learner.calibration).numbers(0, (x, y, z), (float(world.mass[-1]),), 0)
    assert 0.9 * 145.0 < sigma < 2.0 * 145.0
    assert learner.calibration.reference.level_sigma == pytest.approx(sigma, rel=0.02)


def test_nothing_is_published_before_all_samples_were_fitted() -> None:
    """A filter that is linearised at the prior of the class may predict well with a large error."""
    world, learner = World(vehicle(), 60), Learner(class_prior((MASS,), FIELD))
    published = []
    learn(learner, world, seen=lambda _: published.append(learner.calibration.method))
    assert "learned" not in published[:FIRST_FIT_SAMPLES]


def test_a_jump_that_a_young_calibration_made_is_over_with_the_next_fit() -> None:
    """A field that is right again is not flagged for hours."""
    world, learner = World(vehicle(), 700), Learner(class_prior((MASS,), FIELD))
    renewed: dict[Calibration, bool] = {}

    def seen(_: int) -> None:
        renewed.setdefault(learner.calibration, learner.renewed)

    learn(learner, world, seen=seen)
    values = list(renewed.values())
    assert values.count(False) >= 4  # nothing, published, and fitted again at 128, 256 and 512 samples
    assert True in values


def test_what_was_learned_from_nothing_can_be_forgotten() -> None:
    """After the reset, the learner begins without a calibration again."""
    learner = Learner(class_prior((MASS,), FIELD))
    learn(learner, World(vehicle(), 300))
    assert learner.calibration.method == "learned"
    learner.forget()
    assert learner.calibration.method == "none"
    assert learner.samples == 0
    assert learner.learned().level == ()  # of no sample, not NaN


def test_a_class_is_as_unknown_as_physics_lets_it_be() -> None:
    """Thousands of nanotesla of hard iron, a percent of soft iron, and less with every power."""
    prior = class_prior((MASS,), FIELD)
    sigma = np.sqrt(np.diag(prior.covariance)).reshape(-1, 9)
    assert 3000.0 < sigma[0, 6] < 6000.0
    assert 500.0 < sigma[0, 0] < 4000.0
    assert sigma[1, 6] > sigma[2, 6] > sigma[3, 6]


def test_the_level_that_is_kept_is_as_unsure_as_it_differs_from_what_was_learned() -> None:
    """The published field keeps its first level; its sigma spans both."""
    learner = Learner(class_prior((MASS,), FIELD))
    learn(learner, World(vehicle(), 300))
    publication, best = learner._publication, learner._knowledge.bank.best
    publication.coefficients = best.coefficients.copy()
    publication.coefficients[6:9] += 300.0
    made = publication.made(best, 300, learner.calibration.noise)
    coefficients, covariance = learner._model.coefficients(made)
    by = float(best._mean @ (coefficients - best.coefficients))
    assert abs(by) > 20.0
    more = covariance - best.covariance
    assert best._mean @ more @ best._mean == pytest.approx(by * by)
