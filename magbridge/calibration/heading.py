"""Heading from the corrected field, roll and pitch, with its standard deviation.

Notes
-----
The corrected vector b (body axes: forward, starboard, down) is levelled with roll phi and pitch theta, and
the horizontal part gives the angle from magnetic north (Denne 1979, Magnetic Compass Deviation and
Correction, chapter 2)::

    h = R_y(theta) R_x(phi) b,     psi_m = atan2(-h_y, h_x),     psi = psi_m + D

With ``L = R_y R_x`` and ``H^2 = h_x^2 + h_y^2``, the heading changes with the vector as
``g = L^T (h_y, -h_x, 0) / H^2``, with a rotation of the vector (an error of the boresight) as ``w = b x g``,
and with the tilt as

    dpsi/dphi   = (h_y sin(theta) y_r + h_x z_r) / H^2,     (x_r, y_r, z_r) = R_x(phi) b
    dpsi/dtheta = h_y h_z / H^2

so that, for independent errors,

    sigma^2 = g^T V g + w^T Omega w + ((dpsi/dphi)^2 + (dpsi/dtheta)^2) sigma_tilt^2 + sigma_D^2

V is the whole covariance of the vector. Its diagonal alone misses the heading's variance, because the errors
of the three components are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, inf, isnan, nan, radians, sin, sqrt

import numpy as np

from magbridge.arrays import FloatArray

__all__ = [
    "DEFAULT_TILT_SIGMA_DEG",
    "Heading",
    "heading",
    "heading_of_sample",
    "level_vector",
    "model_declination_sigma",
    "published_covariance",
]

DEFAULT_TILT_SIGMA_DEG = 0.3
"""1-sigma of roll and of pitch where the log does not state one, deg."""
MODEL_DECLINATION_SIGMA_DEG = 0.26
"""1-sigma of a main-field model's declination where the horizontal field is large, deg; error model of the
World Magnetic Model 2020 (Chulliat et al. 2020, section 3.4): ``sqrt(0.26^2 + (5417 nT / H)^2)``."""
MODEL_DECLINATION_SIGMA_NT_DEG = 5417.0
"""deg nT, the part of the same error model that falls with the horizontal field."""
UNIFORM_SIGMA_DEG = 180.0 / sqrt(3.0)
"""Standard deviation of an angle of which nothing is known, deg."""
MAX_ADDED_VARIANCE = 1e12
"""nT^2, largest variance that the published one adds to that of the calibration."""


@dataclass(frozen=True, eq=False)
class Heading:
    """Headings of n samples, clockwise from north, deg."""

    magnetic: FloatArray
    """(n,), from magnetic north, 0 to 360 deg; NaN where vector or tilt is unknown."""
    true: FloatArray
    """(n,), from true north, 0 to 360 deg; NaN where the declination is unknown, too."""
    sigma: FloatArray
    """(n,), standard deviation of `true`, deg; infinite where `magnetic` is NaN. Where only the declination
    is unknown it is that of `magnetic`."""


def level_vector(vector: FloatArray, roll: FloatArray, pitch: FloatArray) -> FloatArray:
    """Return vectors (n, 3) in level axes: forward and starboard in the horizontal plane, and down.

    `vector` (n, 3): body axes, any unit. `roll`, `pitch` (n,): rad.
    """
    x, y, z = vector.T
    # h = R_y(pitch) R_x(roll) b
    y_rolled = np.cos(roll) * y - np.sin(roll) * z
    z_rolled = np.sin(roll) * y + np.cos(roll) * z
    forward = np.cos(pitch) * x + np.sin(pitch) * z_rolled
    down = -np.sin(pitch) * x + np.cos(pitch) * z_rolled
    return np.stack([forward, y_rolled, down], axis=1)


def heading(
    vector: FloatArray,
    roll: FloatArray | float,
    pitch: FloatArray | float,
    declination: FloatArray | float = 0.0,
    *,
    covariance: FloatArray | None = None,
    boresight_covariance: FloatArray | None = None,
    tilt_sigma_deg: FloatArray | float = DEFAULT_TILT_SIGMA_DEG,
    declination_sigma_deg: FloatArray | float = 0.0,
) -> Heading:
    """Compute the heading of every sample and its standard deviation.

    Parameters
    ----------
    vector : (n, 3) array
        nT, corrected field in body axes.
    roll, pitch : (n,) array or float
        rad.
    declination : (n,) array or float
        deg, east positive; NaN where unknown.
    covariance : (n, 3, 3) array, optional
        nT^2, of `vector` without the boresight's part; zero if not given.
    boresight_covariance : (3, 3) array, optional
        rad^2, of the boresight's rotation vector in body axes; zero if not given.
    tilt_sigma_deg : (n,) array or float
        deg, 1-sigma of roll and of pitch, independent of each other.
    declination_sigma_deg : (n,) array or float
        deg, 1-sigma of the declination.

    Returns
    -------
    Heading
        Where the horizontal field is not larger than its own standard deviation, a heading does not exist:
        sigma there is that of a uniform angle, 180 / sqrt(3) deg.
    """
    vector = np.asarray(vector, float).reshape(-1, 3)
    roll = np.broadcast_to(np.asarray(roll, float), len(vector))
    pitch = np.broadcast_to(np.asarray(pitch, float), len(vector))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        h_x, h_y, h_z = level_vector(vector, roll, pitch).T
        horizontal_squared = h_x * h_x + h_y * h_y
        magnetic = np.degrees(np.arctan2(-h_y, h_x)) % 360.0
        # g = L^T (h_y, -h_x, 0) / H^2, the rows of L written out
        along, across = h_y / horizontal_squared, -h_x / horizontal_squared
        gradient = np.stack(
            [
                np.cos(pitch) * along,
                np.sin(pitch) * np.sin(roll) * along + np.cos(roll) * across,
                np.sin(pitch) * np.cos(roll) * along - np.sin(roll) * across,
            ],
            axis=1,
        )
        # sigma^2 = g^T V g + w^T Omega w + tilt + declination, all in rad^2 until the declination.
        variance = np.zeros(len(vector))
        if covariance is not None:
            variance += np.einsum("ni,nij,nj->n", gradient, covariance, gradient)
        if boresight_covariance is not None:
            turn = np.cross(vector, gradient)  # w = b x g
            variance += np.einsum("ni,ij,nj->n", turn, boresight_covariance, turn)
        # dpsi/dphi and dpsi/dtheta
        z_rolled = np.sin(roll) * vector[:, 1] + np.cos(roll) * vector[:, 2]
        by_roll = along * np.sin(pitch) * h_y - across * z_rolled
        by_pitch = along * h_z
        variance += (by_roll**2 + by_pitch**2) * np.radians(tilt_sigma_deg) ** 2
        sigma = np.degrees(np.sqrt(variance))
        sigma = np.hypot(sigma, np.nan_to_num(declination_sigma_deg))
        # Nothing is worse known than a uniform angle.
        sigma = np.minimum(np.where(np.isnan(sigma), np.inf, sigma), UNIFORM_SIGMA_DEG)
    unknown = np.isnan(magnetic)
    return Heading(magnetic, (magnetic + declination) % 360.0, np.where(unknown, np.inf, sigma))


def heading_of_sample(
    vector: tuple[float, float, float],
    roll: float,
    pitch: float,
    declination: float,
    covariance: Sequence[float],
    boresight_covariance: Sequence[float],
    published_variance: float,
    *,
    tilt_sigma_deg: float,
    declination_sigma_deg: float,
) -> tuple[float, float, float]:
    """Return :func:`heading` of one sample with :func:`published_covariance`, without arrays.

    `vector`: nT, corrected field in body axes. `roll`, `pitch`: rad. `declination`: deg, east positive; NaN
    where unknown. `covariance`: nT^2, by the calibration alone, row by row. `boresight_covariance`: rad^2,
    of the boresight's rotation vector in body axes, row by row. `published_variance`: nT^2, sum of the three
    components' published variances. `tilt_sigma_deg`, `declination_sigma_deg`: deg, 1-sigma of roll and of
    pitch, and of the declination. Returns `magnetic, true, sigma`: deg, as in :class:`Heading`.
    """
    x, y, z = vector
    sin_roll, cos_roll, sin_pitch, cos_pitch = sin(roll), cos(roll), sin(pitch), cos(pitch)
    # h = R_y R_x b
    z_rolled = sin_roll * y + cos_roll * z
    h_x, h_y = cos_pitch * x + sin_pitch * z_rolled, cos_roll * y - sin_roll * z
    h_z = cos_pitch * z_rolled - sin_pitch * x
    horizontal_squared = h_x * h_x + h_y * h_y
    if isnan(horizontal_squared):
        return nan, nan, inf
    magnetic = degrees(atan2(-h_y, h_x)) % 360.0
    true = (magnetic + declination) % 360.0
    if horizontal_squared == 0.0:
        return magnetic, true, UNIFORM_SIGMA_DEG
    # g = L^T (h_y, -h_x, 0) / H^2
    along, across = h_y / horizontal_squared, -h_x / horizontal_squared
    g = (
        cos_pitch * along,
        sin_pitch * sin_roll * along + cos_roll * across,
        sin_pitch * cos_roll * along - sin_roll * across,
    )
    w = (y * g[2] - z * g[1], z * g[0] - x * g[2], x * g[1] - y * g[0])  # w = b x g
    # a third of the published variance beyond tr(V) + tr(Omega) |b|^2 - b^T Omega b goes to each axis
    trace = boresight_covariance[0] + boresight_covariance[4] + boresight_covariance[8]
    known = covariance[0] + covariance[4] + covariance[8] + trace * (x * x + y * y + z * z)
    known -= _quadratic_form(boresight_covariance, vector)
    more = min(max(published_variance - known, 0.0) / 3.0, MAX_ADDED_VARIANCE)
    variance = _quadratic_form(covariance, g) + more * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    variance += _quadratic_form(boresight_covariance, w)
    # dpsi/dphi and dpsi/dtheta
    by_roll, by_pitch = along * sin_pitch * h_y - across * z_rolled, along * h_z
    tilt_sigma = radians(tilt_sigma_deg)
    variance += (by_roll * by_roll + by_pitch * by_pitch) * tilt_sigma * tilt_sigma
    if not variance >= 0.0:
        return magnetic, true, UNIFORM_SIGMA_DEG
    sigma = hypot(degrees(sqrt(variance)), 0.0 if isnan(declination_sigma_deg) else declination_sigma_deg)
    return magnetic, true, min(sigma, UNIFORM_SIGMA_DEG)


def _quadratic_form(matrix: Sequence[float], v: tuple[float, float, float]) -> float:
    """Return ``v^T M v`` of a matrix (9 numbers, row by row)."""
    a, b, c = v
    m = matrix
    return (
        a * (m[0] * a + m[1] * b + m[2] * c)
        + b * (m[3] * a + m[4] * b + m[5] * c)
        + c * (m[6] * a + m[7] * b + m[8] * c)
    )


def published_covariance(
    stated: FloatArray, turn: FloatArray, vector: FloatArray, variance: FloatArray
) -> FloatArray:
    """Return the covariance of published vectors without the boresight's part, (n, 3, 3) nT^2.

    Checks and moving masses increase the published variances. That increase has no direction, so each
    axis gets a third of it.

    `stated` (n, 3, 3): nT^2, by the calibration alone (:func:`.correct.vector_covariance`). `turn` (3, 3):
    rad^2, covariance of the boresight's rotation vector. `vector` (n, 3): nT, corrected field in body axes.
    `variance` (n,): nT^2, sum of the three components' published variances.
    """
    # trace of the boresight's part: tr(Omega) |b|^2 - b^T Omega b
    # A third of the excess to each axis: excess = tr(published) - tr(V) - tr(boresight's part).
    length = np.einsum("ni,ni->n", vector, vector)
    known = np.trace(stated, axis1=1, axis2=2)
    known = known + np.trace(turn) * length - np.einsum("ni,ij,nj->n", vector, turn, vector)
    more = np.nan_to_num(np.maximum(variance - known, 0.0) / 3.0, posinf=MAX_ADDED_VARIANCE)
    return np.asarray(stated + more[:, None, None] * np.eye(3))


def model_declination_sigma(horizontal: FloatArray, crustal_sigma: float = 0.0) -> FloatArray:
    """Return the standard deviation of a main-field model's declination, deg.

    `horizontal` (n,): nT, horizontal part of the main field. `crustal_sigma`: nT, 1-sigma of the crustal
    field's total. Its component across the meridian is about ``crustal_sigma / sqrt(2)``, which turns north
    by that over H.

    Notes
    -----
    ``sigma_D^2 = 0.26^2 + (5417 / H)^2 + (180/pi crustal_sigma / (sqrt(2) H))^2`` (Chulliat et al. 2020).
    """
    with np.errstate(divide="ignore"):
        model = np.hypot(MODEL_DECLINATION_SIGMA_DEG, MODEL_DECLINATION_SIGMA_NT_DEG / horizontal)
        crustal = np.degrees(crustal_sigma / (np.sqrt(2.0) * horizontal))
    return np.asarray(np.minimum(np.hypot(model, crustal), UNIFORM_SIGMA_DEG))
