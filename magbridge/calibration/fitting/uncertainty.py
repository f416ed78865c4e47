"""Error of a calibration: on data, over a mission, and the part that is a constant bias (the level).

Notes
-----
A part of a corrected sample's variance is common to all samples: the mean of the field at a site is only as
certain as its reference. This part is called the level; a survey determines the rest. With j the mean
derivative of the corrected field by the coefficients and P their covariance, the level's sigma is
``sqrt(j^T P j)``. A change of the level by this sigma moves the coefficients by ``P j / sqrt(j^T P j)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct, forward, vector_covariance
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.heading import heading, published_covariance
from magbridge.calibration.model import LEVEL_STEP_SIGMA, Calibration, Noise, Reference
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import ResidualSamples, jacobian, residual_scale, residuals

CONTRADICTS = 2.0
"""Largest accepted bias of the reference that a fit estimates, in prior sigmas of this bias."""
LEVEL_ROWS = 5_000
"""Approximate number of samples over which the mean derivative is computed."""


def with_level(
    calibration: Calibration, samples: ResidualSamples, bias: float, bias_sigma: float
) -> Calibration:
    """Return the calibration with the part of its covariance that is common to all samples (the level).

    If the estimated bias exceeds :data:`CONTRADICTS` sigmas of its prior, the fit has absorbed another effect
    into it. The bias is then 0, with the sigma of its prior, and the coefficients move back accordingly.

    `samples`: samples of the fit, with its effects subtracted. `bias`, `bias_sigma`: estimated bias of the
    reference, and its prior 1-sigma, nT.
    """
    direction, sigma = _level_direction(calibration, samples)
    if sigma and contradicts(bias, bias_sigma):
        # a step of `direction` changes the mean of the corrected field by `sigma`
        factor = max(bias_sigma / sigma, 1.0)
        calibration = replace(
            calibration,
            coefficients=calibration.coefficients - direction * (bias / sigma),
            covariance=calibration.covariance + (factor**2 - 1.0) * np.outer(direction, direction),
        )
        direction, sigma, bias = direction * factor, sigma * factor, 0.0
    known = calibration.reference
    reference = Reference(known.field, known.model, bias, bias_sigma, sigma)
    return replace(calibration, reference=reference, level=tuple(direction.tolist()))


def _level_direction(calibration: Calibration, samples: ResidualSamples) -> tuple[FloatArray, float]:
    """Return the change of the coefficients (K,) with the level's 1-sigma, and this 1-sigma, nT."""
    part = samples.part(slice(None, None, max(len(samples.field) // LEVEL_ROWS, 1)))
    position_terms = calibration.coefficients[: 9 * part.phi.shape[1]]
    # j: mean derivative of the corrected field, which is the residual times its scale s
    _, g = residuals(part, position_terms)
    slopes = jacobian(part.phi, g) * residual_scale(part, position_terms)[:, None]
    j = np.zeros(len(calibration.coefficients))
    j[: len(position_terms)] = slopes.mean(axis=0)
    Pj = calibration.covariance @ j
    sigma = float(np.sqrt(max(float(j @ Pj), 0.0)))
    return Pj / max(sigma, 1e-300), sigma


def contradicts(bias: float, bias_sigma: float) -> bool:
    """Return True if an estimated `bias` of the reference contradicts its prior 1-sigma `bias_sigma` (nT)."""
    return abs(bias) > CONTRADICTS * bias_sigma


def apart_from_level(calibration: Calibration) -> Calibration:
    """Return the calibration with its covariance for a known level: the level's part is subtracted."""
    if not calibration.level:
        return calibration
    w = np.zeros(len(calibration.coefficients))
    w[: len(calibration.level)] = calibration.level
    return replace(calibration, covariance=calibration.covariance - np.outer(w, w))


def level_of(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the part (n,), nT, of each corrected sample's sigma that is common to all samples (the level).

    Arguments as for :func:`~magbridge.calibration.correct.correct`.
    """
    if not calibration.level:
        return np.zeros(len(field))
    up, here = (correct(one, field, channels, time).total for one in (calibration.at_level(), calibration))
    return np.abs(up - here) / LEVEL_STEP_SIGMA


MISSION_SAMPLES = 600
"""Approximate number of samples that represent a mission."""
ROLL = 10.0
"""Angle by which a survey is assumed to roll further than the runs, deg."""


@dataclass(frozen=True, eq=False)
class Mission:
    """Fields and positions of a mission, over which the error of a calibration matters."""

    field_body: FloatArray
    """(n, 3): True field in body axes, nT."""
    parameters: FloatArray
    """(n, k): Value of each parameter at the same samples, in its unit."""

    @classmethod
    def from_observations(cls, data: Observations) -> Mission:
        """Return the mission with the attitudes and positions of a deployment.

        CalibrationError: attitude or place is missing.
        """
        # the true field in body axes needs attitude and direction
        known, attitude, reference_ned = data.directed()
        if not known.any():
            raise CalibrationError(
                "the mission has no sample with all of roll, pitch, heading, latitude and longitude"
            )
        part = slice(None, None, max(len(attitude) // MISSION_SAMPLES, 1))
        return cls(field_body(attitude[part], reference_ned[part]), data.parameters[known][part])


def nearby_mission(calibration: Calibration, data: Observations) -> Mission:
    """Return a mission with the attitudes and positions of `data`, on all headings and with 10 deg more roll.

    If the data have no attitude, which gives the vertical, the mission has only the headings of the runs.
    """
    rows = np.arange(0, len(data), max(3 * len(data) // MISSION_SAMPLES, 1))
    k = len(calibration.parameters)
    positions = data.parameters[rows, :k]
    b = correct(calibration, data.field[rows], positions, data.time[rows]).vector
    # roll a little further each way
    met = [Rotation.from_euler("X", angle, degrees=True).apply(b) for angle in (-ROLL, 0.0, ROLL)]
    places = [positions] * len(met)
    if data.attitude is not None:
        known = np.isfinite(data.attitude[rows]).all(axis=1)
        attitude = Rotation.from_euler("ZYX", data.attitude[rows[known], ::-1])
        # and turn about the vertical, by attitude
        down = attitude.apply([0.0, 0.0, 1.0], inverse=True)
        met += [
            Rotation.from_rotvec(np.radians(angle) * down).apply(b[known]) for angle in range(60, 360, 60)
        ]
        places += [positions[known]] * (len(met) - len(places))
    return Mission(np.concatenate(met), np.concatenate(places))


def expected_error(calibration: Calibration, mission: Mission) -> FloatArray:
    """Return the 1-sigma (n,), nT, of the corrected total field at a mission's points.

    It includes the covariance of the position terms only, without effects and noise.
    """
    # compute readings, then correct them: the resulting sigma is that of the position terms
    model = replace(calibration.without_effects(), noise=Noise(0.0), boresight=None)
    truth = mission.field_body
    if calibration.boresight is not None:
        truth = truth @ calibration.boresight.matrix()
    time = np.zeros(len(truth))
    reading = forward(model, truth, mission.parameters, time)
    return correct(model, reading, mission.parameters, time).sigma


def in_sensor_units(calibration: Calibration, data: Observations) -> tuple[FloatArray, FloatArray]:
    """Return the error of the total field over ``|A u|`` (n,), nT, and over its sigma (n,), dimensionless.

    u is the direction of the corrected field. The first is the error in nT as the sensor measures: unlike the
    error of the corrected field, a fit cannot reduce it by shrinking A.
    """
    got = correct(calibration, data.field, data.channels(calibration), data.time)
    A, T = calibration.matrices(data.parameters[:, : len(calibration.parameters)])
    b = np.matmul(A, (data.field - T)[:, :, None])
    # 1 nT of the sensor is |A^T u| nT of the corrected field; A is symmetric
    size = np.linalg.norm(np.matmul(A, b)[:, :, 0], axis=1) / got.total
    error = got.total - data.reference
    return error / size, error / got.sigma


def expected_heading_sigma(calibration: Calibration, data: Observations) -> float:
    """Return the RMS over the samples of the magnetic heading's standard deviation, deg.

    Roll and pitch have the `tilt_sigma` of the boresight; NaN without a boresight, or roll and pitch.
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
        tilt_sigma_deg=calibration.boresight.tilt_sigma,
    )  # fmt: skip
    known = found.sigma[np.isfinite(found.sigma)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
