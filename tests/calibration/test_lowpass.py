"""The anti-alias filter and what a turn makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from magbridge.calibration.fitting.observations import Observations, unfiltered
from magbridge.errors import CalibrationError

CORNER = 0.33


@pytest.mark.parametrize(("step", "noise"), [(4.0, 0.0), (1.0, 0.0), (0.1, 0.5)])
def test_a_turning_field_has_its_length_again(step: float, noise: float) -> None:
    """A spiral of four minutes a turn, RC-filtered: short by tau^2 |dx/dt|^2 / 2 |x|, then no more."""
    fine, tau, turn = 0.02, 1.0 / (2.0 * np.pi * CORNER), 2.0 * np.pi / 240.0
    t = np.arange(0.0, 2400.0, fine)
    true = np.column_stack(
        [18_000.0 * np.cos(turn * t), 18_000.0 * np.sin(turn * t), np.full(len(t), 48_000.0)]
    )
    share = 1.0 - np.exp(-fine / tau)
    slow = lfilter([share], [1.0, share - 1.0], true - true[0], axis=0) + true[0]
    rows = slice(round(20.0 / fine), None, round(step / fine))
    field = slow[rows] + np.random.default_rng(0).normal(0.0, noise, slow[rows].shape)
    F = float(np.linalg.norm(true[0]))
    data = Observations(
        field=field, reference=np.full(len(field), F), parameters=np.empty((len(field), 0)), time=t[rows]
    )
    inside = slice(60, -60)
    before, after = (
        np.linalg.norm(part.field, axis=1)[inside] - F for part in (data, unfiltered(data, CORNER))
    )
    if not noise:
        assert before.mean() == pytest.approx(-((tau * turn * 18_000.0) ** 2) / (2.0 * F), rel=0.1)
    assert abs(after.mean()) < 0.1 * abs(before.mean()) + noise / 50.0
    assert after.std() < 1.1 * before.std() + 0.05


def test_slopes_stay_within_their_run() -> None:
    field = np.tile([[20_000.0, 0.0, 45_000.0]], (40, 1))
    field[20:, 0] *= -1.0
    data = Observations(
        field=field, reference=np.full(40, 49_244.0), parameters=np.empty((40, 0)), runs=np.arange(40) // 20
    )
    assert np.array_equal(unfiltered(data, CORNER).field, field)


@pytest.mark.parametrize("corner", [1e-320, 1e-9, 0.004])
def test_a_filter_slower_than_the_data_is_refused(corner: float) -> None:
    field = np.tile([[20_000.0, 0.0, 45_000.0]], (40, 1))
    data = Observations(field=field, reference=np.full(40, 49_244.0), parameters=np.empty((40, 0)))
    with pytest.raises(CalibrationError, match=r"is longer than the data \(39 s\)"):
        unfiltered(data, corner)
