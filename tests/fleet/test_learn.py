"""Test that changed deployments are reported, and do not move the predictions of healthy vehicles."""

import numpy as np
import pytest

from magbridge.calibration.model import Parameter
from magbridge.estimation.information import GaussianInformation
from magbridge.fleet.learn import REFERENCE_FIELD_NT, Fleet, Lesson, history, learn_fleet

BATTPOS = (Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0),)
HARD_IRON = slice(6, 9)
POWER_UP_NT, NOISE_NT = 20.0, 5.0


def deployments(vehicle: str, count: int, seed: int) -> list[Lesson]:
    """Return deployments of a vehicle without an overhaul; each determines all 18 coefficients."""
    rng = np.random.default_rng(seed)
    iron = rng.normal(0.0, np.repeat([1000.0, 300.0], 9))
    J = np.eye(18) / NOISE_NT**2
    return [
        Lesson(
            vehicle, "spring", f"d{k}", 1e6 * k, BATTPOS, ((0,), (1,)), REFERENCE_FIELD_NT, 2.0,
            GaussianInformation(J, J @ (iron + rng.normal(0.0, np.hypot(POWER_UP_NT, NOISE_NT), 18))),
        )
        for k in range(count)
    ]  # fmt: skip


def moved(lesson: Lesson, by: float, coefficients: slice = slice(6, 8)) -> Lesson:
    """Return a deployment with coefficients changed by `by`, nT; by default the hard iron of x and y."""
    change = np.zeros(18)
    change[coefficients] = by
    precision, vector = lesson.information.precision, lesson.information.vector
    return lesson._replace(information=GaussianInformation(precision, vector + precision @ change))


HEALTHY = [one for seed in range(6) for one in deployments(f"v{seed}", 4, seed)]


def prediction(fleet: Fleet) -> tuple[np.ndarray, np.ndarray]:
    """Return the prediction of the hard iron of v0, and its 1-sigma, nT."""
    known = fleet.known("v0", "spring")
    return known.mean[HARD_IRON], np.sqrt(np.diag(known.covariance)[HARD_IRON])


def test_a_broken_vehicle_does_not_widen_the_predictions_of_the_others() -> None:
    broken = deployments("broken", 4, 7)
    healthy, whole = learn_fleet(HEALTHY), learn_fleet([*HEALTHY, *broken])
    with_it = learn_fleet([*HEALTHY, *broken[:3], moved(broken[3], 4000.0)])
    assert healthy.changed == whole.changed == frozenset()
    assert [with_it.lessons[k].vehicle for k in with_it.changed] == ["broken"]
    (mean, sigma), (other, wider) = prediction(whole), prediction(with_it)
    assert (np.abs(other - mean) < 0.1 * sigma).all()
    assert (np.abs(wider / sigma - 1.0) < 0.1).all()
    assert [one.omitted for one in history(with_it, "broken").deployments] == [False, False, False, True]


def test_a_change_that_lasts_and_its_repair_are_each_reported_once() -> None:
    vehicle = deployments("changing", 7, 8)
    vehicle[2:5] = [moved(one, 600.0) for one in vehicle[2:5]]
    found = history(learn_fleet([*HEALTHY, *vehicle]), "changing").deployments
    assert [one.omitted for one in found] == [False, False, True, True, True, False, False]
    reported = [{change.what for change in one.changes} for one in found]
    iron = {"hard iron, x", "hard iron, y"}
    assert reported == [set(), set(), iron, set(), set(), iron, set()]


def test_a_changed_gain_and_more_noise_are_reported() -> None:
    vehicle = deployments("changing", 4, 9)
    vehicle[3] = moved(vehicle[3], 0.02 * REFERENCE_FIELD_NT, slice(1))._replace(noise=20.0)
    found = [one.changes for one in history(learn_fleet([*HEALTHY, *vehicle]), "changing").deployments]
    assert [change.what for change in found[3]] == ["soft iron, xx", "noise"]
    assert found[3][0].by_nT == pytest.approx(1000.0, abs=100.0)
    assert found[3][1].by_nT == 18.0
    assert not any(found[:3])
