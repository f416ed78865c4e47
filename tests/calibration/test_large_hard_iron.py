"""Hard iron beyond twice the field: accepted if the attitudes separate it from a scale, else refused."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.calibration.fitting.solve import check_scales
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import ResidualSamples


def samples(directions: np.ndarray, offset: float) -> ResidualSamples:
    field = 5e4 * directions + np.array([0.0, 0.0, offset])
    reference = np.full(len(field), 5e4)
    return ResidualSamples(field, reference, np.ones((len(field), 1)), np.ones(len(field)), 5e4)


def test_it_is_the_attitudes_that_decide() -> None:
    rng = np.random.default_rng(0)
    around = rng.normal(size=(800, 3))
    around /= np.linalg.norm(around, axis=1)[:, None]
    turn = rng.uniform(0.0, 2.0 * np.pi, 800)
    level = np.column_stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), np.full(800, np.sqrt(0.75))])
    fit = np.zeros(9)
    fit[8] = 1.1e5
    check_scales(samples(around, 1.1e5), fit)
    with pytest.raises(CalibrationError, match="too few attitudes"):
        check_scales(samples(level, 1.1e5), fit)
