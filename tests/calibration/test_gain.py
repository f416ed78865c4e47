"""A sensor whose gain is far from 1: found where the attitudes show it, refused where they do not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations

EARTH_NED = (18_000.0, 0.0, 50_000.0)
"""nT, the field at the site."""


def turned(gain: float, tilt: float, noise: float = 100.0, n: int = 1200) -> Observations:
    """Return turns with roll and pitch of up to `tilt` deg, read by a sensor of this gain."""
    time = np.arange(n, dtype=float)
    angles = time * 3.0, tilt * np.sin(time / 37.0), tilt * np.sin(time / 23.0)
    body = Rotation.from_euler("ZYX", np.column_stack(angles), degrees=True).inv().apply(EARTH_NED)
    noises = noise * np.random.default_rng(0).standard_normal((n, 3))
    reading = gain * body + (300.0, -200.0, 400.0) + noises
    return Observations(reading, np.full(n, np.linalg.norm(EARTH_NED)), np.empty((n, 0)))


@pytest.mark.parametrize("gain", [0.6, 0.8, 1.25])
def test_a_gain_that_the_attitudes_show_is_found(gain: float) -> None:
    found = fit(turned(gain, tilt=60.0), "nominal")
    assert np.allclose(found.scales, 1.0 / gain, rtol=0.01)
    assert found.supported


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_a_gain_that_the_attitudes_do_not_show_is_refused(gain: float) -> None:
    """The prior of a usual gain decides, and the fit takes the rest of the field for an offset."""
    found = fit(turned(gain, tilt=5.0), "nominal")
    assert not found.supported
    assert any("separate it from the offset" in text for text in found.calibration.warnings)
    assert fit(turned(1.0, tilt=5.0), "nominal").supported
