"""Errors of a corrected run: total field in nT of the sensor, and heading in deg."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct, vector_covariance
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.heading import DEFAULT_TILT_SIGMA_DEG, heading, published_covariance
from magbridge.calibration.model import Calibration

__all__ = ["expected_heading_sigma", "in_sensor_units"]


def in_sensor_units(calibration: Calibration, data: Observations) -> tuple[FloatArray, FloatArray]:
    """Return the error of the total field over ``|A^T u|`` (n,), nT of the sensor; and over its sigma (n,).

    A fit that shrinks A shrinks every error of the corrected field, but gains nothing in the sensor's units.
    """
    got = correct(calibration, data.field, data.channels(calibration), data.time)
    A, T = calibration.matrices(data.parameters[:, : len(calibration.parameters)])
    b = np.matmul(A, (data.field - T)[:, :, None])
    # |A^T u|: nT of the corrected field for one of the sensor
    size = np.linalg.norm(np.matmul(A, b)[:, :, 0], axis=1) / got.total
    error = got.total - data.reference
    return error / size, error / got.sigma


def expected_heading_sigma(calibration: Calibration, data: Observations) -> float:
    """Return the RMS over the samples of the magnetic heading's standard deviation, deg.

    Roll and pitch count as known to :data:`~magbridge.calibration.heading.DEFAULT_TILT_SIGMA_DEG`. The
    declination is not part of it. NaN without a boresight, or without roll and pitch.
    """
    if calibration.boresight is None or data.attitude is None:
        return float("nan")
    channels, turn = data.channels(calibration), np.array(calibration.boresight.covariance)
    corrected = correct(calibration, data.field, channels, data.time)
    stated = vector_covariance(calibration, data.field, channels, data.time)
    covariance = published_covariance(stated, turn, corrected.vector, (corrected.vector_sigma**2).sum(axis=1))
    roll, pitch = data.attitude[:, 0], data.attitude[:, 1]
    found = heading(
        corrected.vector, roll, pitch, covariance=covariance, boresight_covariance=turn,
        tilt_sigma_deg=DEFAULT_TILT_SIGMA_DEG,
    )  # fmt: skip
    known = found.sigma[np.isfinite(found.sigma)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
