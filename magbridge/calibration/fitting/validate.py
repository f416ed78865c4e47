"""How well a calibration corrects a run, counted in the sensor's own nT."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Calibration

__all__ = ["in_sensor_units"]


def in_sensor_units(calibration: Calibration, data: Observations) -> tuple[FloatArray, FloatArray]:
    """Return the error of the total field over ``|A^T u|`` (n,), nT of the sensor; and over its sigma (n,).

    A fit that shrinks A shrinks every error of the corrected field, but gains nothing in the sensor's units.
    """
    got = correct(calibration, data.field, data.channels(calibration), data.time)
    A, T = calibration.matrices(data.parameters[:, : len(calibration.parameters)])
    b = np.matmul(A, (data.field - T)[:, :, None])
    size = np.linalg.norm(np.matmul(A, b)[:, :, 0], axis=1) / got.total
    error = got.total - data.reference
    return error / size, error / got.sigma
