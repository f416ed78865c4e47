"""The rotation from sensor to body axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gliders import codes
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.boresight import field_body, find_boresight, magnetic_headings
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import identity


def test_boresight_is_found_and_makes_the_vector_right() -> None:
    rng = np.random.default_rng(0)
    n = 400
    attitude = np.column_stack([rng.normal(0, 0.1, n), rng.normal(0, 0.4, n), rng.uniform(0, 2 * np.pi, n)])
    ned = np.tile([16e3, -5e3, 49e3], (n, 1))
    tilt = Rotation.from_rotvec([0.02, -0.03, 0.05])
    body = field_body(attitude, ned)
    data = Observations(
        tilt.inv().apply(body) + rng.normal(0, 1, (n, 3)), np.linalg.norm(ned, axis=1), np.empty((n, 0)),
        runs=np.arange(n) // 100, attitude=attitude, reference_ned=ned,
    )  # fmt: skip
    found = find_boresight(identity(), data)
    np.testing.assert_allclose(found.rotation, tilt.as_rotvec(), atol=1e-4)
    np.testing.assert_allclose(found.matrix(), Rotation.from_rotvec(found.rotation).as_matrix(), atol=1e-12)
    vector = correct(replace(identity(), boresight=found), data.field, data.parameters, data.time).vector
    np.testing.assert_allclose(vector, body, atol=12.0)
    assert find_boresight(identity(), replace(data, attitude=None)) is None


@pytest.mark.parametrize(("pitch", "turn"), [(0.0, 17.4), (24.0, 7.4)])
def test_magnetic_headings_that_are_taken_for_true_are_reported(pitch: float, turn: float) -> None:
    """A level vehicle's mounting looks turned by the declination; a glider's by less than half of it."""
    rng = np.random.default_rng(2)
    n = 2000
    north, east, _ = ned = np.array([16e3, -5e3, 46e3])
    attitude = np.radians(
        np.column_stack([rng.normal(0, 1, n), rng.choice([-pitch, pitch], n), rng.uniform(0, 360, n)])
    )
    field = field_body(attitude, np.tile(ned, (n, 1))) + rng.normal(0, 1, (n, 3))
    right = Observations(
        field, np.full(n, np.linalg.norm(ned)), np.empty((n, 0)), runs=np.arange(n) // 100,
        attitude=attitude, reference_ned=np.tile(ned, (n, 1)),
    )  # fmt: skip
    read = attitude - [0.0, 0.0, np.arctan2(east, north)]
    assert magnetic_headings(identity(), right) is None
    warning = magnetic_headings(identity(), replace(right, attitude=read))
    assert warning is not None
    assert warning.values["declination"] == pytest.approx(-17.4, abs=0.05)
    found = np.degrees(np.linalg.norm(find_boresight(identity(), replace(right, attitude=read)).rotation))
    assert found == pytest.approx(turn, abs=0.7)
    assert "magnetic_headings" in codes(fit(replace(right, attitude=read), "nominal"))
    assert "magnetic_headings" not in codes(fit(right, "nominal"))
    # a mounting that is turned by about as much as D, of a glider, leaves no mismatch, and no message
    turned = replace(right, field=Rotation.from_euler("z", 10.0, degrees=True).apply(field))
    assert magnetic_headings(identity(), turned) is None


def test_a_reversed_channel_gets_no_boresight_and_is_reported() -> None:
    rng = np.random.default_rng(1)
    n = 400
    attitude = np.column_stack([rng.normal(0, 0.1, n), rng.normal(0, 0.4, n), rng.uniform(0, 2 * np.pi, n)])
    ned = np.tile([16e3, -5e3, 49e3], (n, 1))
    field = field_body(attitude, ned) * [1.0, 1.0, -1.0] + rng.normal(0, 1, (n, 3))
    data = Observations(
        field, np.linalg.norm(ned, axis=1), np.empty((n, 0)), attitude=attitude, reference_ned=ned
    )
    found = fit(data, "nominal")
    assert found.calibration.boresight is None
    assert "no_boresight" in codes(found)
    assert found.supported  # the total field does not depend on it
