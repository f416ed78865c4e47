"""The independent check of ``tools/measured.py``: it finds the eddy currents that are there."""

from __future__ import annotations

import numpy as np
import pytest
from measured import held_out_error, tolles_lawson


@pytest.mark.parametrize("eddy", [0.0, 30.0])
def test_least_squares_finds_eddy_currents_where_they_are(eddy: float) -> None:
    rng = np.random.default_rng(11)
    n = 2000
    t = np.arange(n)
    u = np.stack([np.sin(t / 31.0), np.cos(t / 47.0), 1.0 + 0.5 * np.sin(t / 13.0)], axis=1)
    u /= np.linalg.norm(u, axis=1)[:, None]
    time = np.linspace(0.0, 0.5 * (n - 1), n)
    still, turning = tolles_lawson(u, time, np.full(n, 5e4))
    assert still.shape == turning.shape == (n, 9)
    field = 20.0 * still[:, 0] - 15.0 * still[:, 4]
    field = field + eddy * turning[:, 1] / np.std(turning[:, 1]) + rng.normal(size=n)
    plain, whole = held_out_error(still, field), held_out_error(np.hstack([still, turning]), field)
    assert whole == pytest.approx(1.0, abs=0.1)
    assert plain > 0.5 * eddy
