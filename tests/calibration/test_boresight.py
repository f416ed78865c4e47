"""The rotation from sensor to body axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.boresight import field_body, find_boresight
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


def test_a_reversed_channel_gets_no_boresight_and_is_said() -> None:
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
    assert [text for text in found.warnings if "a channel or an angle has the other sign" in text]
    assert found.supported  # the total field does not depend on it
