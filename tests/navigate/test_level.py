"""Test that an unknown reference bias is treated as one bias, not as noise."""

from __future__ import annotations

from dataclasses import replace

import pytest

from magbridge.calibration.model import Noise, Reference, identity
from magbridge.navigate.options import NavigationOptions, informed


def test_level_is_a_bias_that_lasts() -> None:
    """It widens the bias, whose changes stay as large as before: 2 sigma²/tau."""
    plain = replace(identity(), noise=Noise(1.0))
    levelled = replace(plain, reference=Reference(50_000.0, "IGRF", 0.0, 145.0, 150.0))
    without = informed(NavigationOptions(), plain, 2.0)
    known = informed(NavigationOptions(), levelled, (2.0**2 + 150.0**2) ** 0.5)
    assert known.noise == without.noise
    assert known.bias_sigma == pytest.approx((without.bias_sigma**2 + 150.0**2) ** 0.5)
    assert known.bias_sigma**2 / known.bias_time == pytest.approx(without.bias_sigma**2 / without.bias_time)
