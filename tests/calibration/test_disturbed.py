"""A compass among motors: its disturbance is not a crustal field, but a spatial field would fit it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations

EARTH = np.array([21_000.0, 1_500.0, 43_000.0])


def circles(disturbed: float) -> Observations:
    """Return a flight in turns that crosses its own track, with motors that disturb it slowly."""
    rng = np.random.default_rng(3)
    n = 600
    angle = np.linspace(0.0, 8.0 * np.pi, n)
    heading, roll, pitch = (
        angle + 0.3 * np.sin(5 * angle),
        0.5 * np.sin(angle * 1.7),
        0.4 * np.sin(angle * 2.3),
    )
    turned = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).inv().apply(EARTH)
    slow = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    slow = disturbed * slow / slow.std(axis=0)
    place = [300.0 * np.sin(2.1 * angle), 300.0 * np.sin(3.3 * angle), np.zeros(n)]
    return Observations(
        field=turned + np.array([800.0, -300.0, 500.0]) + slow + rng.normal(0.0, 20.0, (n, 3)),
        reference=np.full(n, np.linalg.norm(EARTH)), parameters=np.empty((n, 0)),
        time=0.2 * np.arange(float(n)), attitude=np.column_stack([roll, pitch, heading]),
        reference_ned=np.tile(EARTH, (n, 1)), place=np.column_stack(place), unmapped=np.ones(n),
    )  # fmt: skip


@pytest.mark.parametrize(("disturbed", "methods"), [(0.0, {"survey"}), (1500.0, {"auto", "nominal"})])
def test_the_field_of_motors_is_not_taken_for_a_crustal_field(disturbed: float, methods: set[str]) -> None:
    assert fit(circles(disturbed)).calibration.method in methods
