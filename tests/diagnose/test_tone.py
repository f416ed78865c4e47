"""Tones: their frequency is found between those of a discrete spectrum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import right

from magbridge.diagnose.causes.instrument import InterferenceTone


@pytest.mark.parametrize("place", [700.0, 700.5, 2048.0])
def test_a_tone_between_two_frequencies_is_found_there(place: float) -> None:
    """Half a bin off it would have lost a tenth of its power; the last bin has one neighbour only."""
    quiet = right(1800)
    t = quiet.survey.time
    f = place / 4096 / 4.0
    noise = np.random.default_rng(3).normal(size=len(t))
    residual = 10.0 * quiet.jacobian[:, 6] * np.cos(2.0 * np.pi * f * (t - t[0])) + 0.1 * noise
    first = InterferenceTone().candidates(replace(quiet, residual=residual))[0]
    assert 1.0 / first.point.shape["period"][0] == pytest.approx(f, abs=0.1 / 4096 / 4.0)
