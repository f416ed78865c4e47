"""The comparison of predictions: a learned calibration must be better by more than a calibration error."""

from __future__ import annotations

import numpy as np

from magbridge.calibration.model import Noise
from magbridge.learning.judge import FIRST, LEARNED, Judge
from magbridge.learning.nuisance import Nuisance


def judged(error: float, samples: int) -> Judge:
    """Return it after so many samples that the first predicts by ± `error` (sigmas) worse than the other."""
    rng = np.random.default_rng(5)
    nuisance = Nuisance(Noise(1.0), 1e-3)
    judge, still = Judge(nuisance), nuisance.transition(0.0, 0.0)
    for k in range(samples):
        noise = float(rng.normal())
        judge.judge(*still, noise + error * (-1) ** k, 1.0, noise, nuisance.white_variance)
    return judge


def test_a_small_advantage_is_none_however_long_it_lasts() -> None:
    """0.1 sigma is 50 log units in 10,000 samples, of which the margin leaves nothing; 0.2 sigma counts."""
    assert not judged(0.1, 10_000).adopt
    assert judged(0.2, 10_000).adopt


def test_it_is_rolled_back_without_a_margin() -> None:
    """The first calibration need only predict significantly better, and not in a few samples."""
    rng = np.random.default_rng(6)
    nuisance = Nuisance(Noise(1.0), 1e-3)
    judge, still = Judge(nuisance), nuisance.transition(0.0, 0.0)
    for k in range(10_000):
        noise = float(rng.normal())
        judge.judge(*still, noise, 1.0, noise + 0.1 * (-1) ** k, nuisance.white_variance)
        if k == 100:
            assert not judge.roll_back
    assert judge.roll_back
    assert not judge.adopt
    assert judge.mean_square[FIRST] < judge.mean_square[LEARNED]
