"""Which calibration predicts better: only samples that come after what was learned decide."""

from __future__ import annotations

import numpy as np

from magbridge.calibration.model import Noise
from magbridge.learning.estimator import Nuisance
from magbridge.learning.judge import CANDIDATE, FIRST, PUBLISHED, Coverage, Judge

LEG_SAMPLES = 200
STEP_M, STEP_S = 1.4, 4.0


def judged(hours: float, first: float, candidate: float, pulses: float = 0.0) -> Judge:
    """Return it after a glider's legs, each with errors (nT) that change sign at every dive and climb.

    `pulses` (nT) are added in two of every ten minutes, for both calibrations.
    """
    rng = np.random.default_rng(5)
    nuisance = Nuisance(Noise(1.0), 145.0)
    judge, F = Judge(nuisance), nuisance.transition(STEP_M, STEP_S)[0]
    for k in range(int(hours * 3600.0 / STEP_S)):
        sign = (-1.0) ** (k // LEG_SAMPLES)
        crust = 7.0 * np.sin(STEP_M * k / 500.0)
        seen = crust + rng.normal() + pulses * (k * STEP_S % 600.0 < 120.0)
        judge.is_due(STEP_M, STEP_S, np.array([0.4 * sign, 0.0, 0.9]))
        residuals = seen + first * sign, seen + first * sign, seen + candidate * sign
        judge.judge(F, residuals, 1.0)
    return judge


def test_a_candidate_with_smaller_errors_is_adopted_after_some_turns() -> None:
    assert not judged(0.5, 3.0, 0.0).adopt()
    assert judged(2.0, 3.0, 0.0).adopt()
    assert not judged(2.0, 3.0, 0.0).roll_back


def test_a_candidate_with_errors_of_its_own_is_not_adopted() -> None:
    """Not if its errors are as large as those of the first, and it is rolled back if they are larger."""
    equal = judged(3.0, 1.0, -1.0)
    assert (equal.adopt(), equal.roll_back) == (False, False)
    worse = judged(3.0, 0.0, 3.0)
    assert (worse.adopt(), worse.roll_back) == (False, True)
    assert worse.mean_square[FIRST] == worse.mean_square[PUBLISHED] < worse.mean_square[CANDIDATE]


def test_an_expected_change_is_adopted_after_one_turn() -> None:
    """As after an alarm whose cause explains the samples."""
    judge = judged(0.3, 3.0, 0.0)
    assert judge.adopt(expected=True)
    assert not judge.adopt()
    assert not judged(0.3, 0.0, 3.0).adopt(expected=True)


def test_pulses_that_no_calibration_explains_decide_nothing() -> None:
    judge = judged(3.0, 0.3, -0.3, pulses=20.0)
    assert (judge.adopt(), judge.roll_back) == (False, False)


def test_a_new_candidate_begins_with_the_level_of_the_last() -> None:
    judge = judged(2.0, 3.0, 0.0)
    better = judge.better
    judge.replace(CANDIDATE, 50.0, 1.0)
    F = np.eye(4)
    judge.judge(F, (0.0, 0.0, 50.0), 1.0)
    assert abs(judge.better - better) < 20.0  # 2,500 if the level counted


def test_a_change_is_significant_only_if_it_is_known_at_all_attitudes() -> None:
    """Of an offset that is known along two axes, but not along the third."""
    coverage, covariance = Coverage(3), np.diag([1.0, 1.0, 400.0])
    change = np.array([10.0, 10.0, 0.0])
    for direction in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)):
        unit = np.array(direction)
        assert not coverage.is_significant(change, covariance)
        coverage.add(unit, unit)
    assert coverage.is_significant(change, covariance)
    assert not coverage.is_significant(0.1 * change, covariance)
    for direction in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)):
        coverage.add(np.array(direction), np.array(direction))
    assert not coverage.is_significant(change, covariance)
