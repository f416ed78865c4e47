"""Heading from the corrected field, roll and pitch, with its standard deviation.

Notes
-----
Roll phi and pitch theta turn the corrected vector b (body axes: forward, starboard, down) into level axes.
Its horizontal part then gives the angle from magnetic north (Denne 1979, Magnetic Compass Deviation and
Correction, chapter 2); D is the declination::

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
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.constants import DECLINATION_SIGMA_DEG, DECLINATION_SIGMA_NT_DEG
from magbridge.errors import CalibrationError
from magbridge.records import Quality

Components = Sequence[Any]
"""Components of a vector or matrix: numbers for one sample, arrays (n,) for n samples."""


DEFAULT_TILT_SIGMA_DEG = 0.3
"""1-sigma of roll and of pitch where the log does not state one, deg."""
UNIFORM_SIGMA_DEG = 180.0 / sqrt(3.0)
"""Standard deviation of an unknown angle, uniform over a full turn, deg."""
NO_HEADING_FLAGS = int(Quality.SATURATED | Quality.UNCALIBRATED | Quality.IMPLAUSIBLE | Quality.NO_BORESIGHT)
"""Flags of samples whose heading is unknown: its sigma is that of a uniform angle."""
MAX_ADDED_VARIANCE = 1e12
"""Largest variance that checks and moving masses may add to each axis, nT^2."""


@dataclass(frozen=True, eq=False)
class Heading:
    """Headings of n samples, clockwise from north, deg."""

    magnetic: FloatArray
    """(n,): Heading from magnetic north, 0 to 360 deg; NaN if the vector, roll or pitch is unknown."""
    true: FloatArray
    """(n,): Heading from true north, 0 to 360 deg; NaN if `magnetic` or the declination is unknown."""
    sigma: FloatArray
    """(n,): 1-sigma of `true`, deg; of `magnetic` if the declination is unknown; infinite if it is NaN."""


def _level(b: Components, turn: Components) -> Components:
    """Return b in level axes, ``h = R_y(pitch) R_x(roll) b``; `turn`: sine and cosine of roll, then pitch."""
    (x, y, z), (sin_roll, cos_roll, sin_pitch, cos_pitch) = b, turn
    z_rolled = sin_roll * y + cos_roll * z
    return (
        cos_pitch * x + sin_pitch * z_rolled,
        cos_roll * y - sin_roll * z,
        cos_pitch * z_rolled - sin_pitch * x,
    )


def _variance(
    b: Components,
    h: Components,
    turn: Components,
    covariance: Components,
    boresight: Components,
    added_variance: Any,
    tilt_sigma: Any,
) -> Any:
    """Return the variance of the magnetic heading, rad^2, by the equations in the module's notes.

    `b`, `h`: vector in body and in level axes, nT. `covariance`, `boresight`: V and Omega, nT^2 and rad^2.
    """
    (x, y, z), (h_x, h_y, h_z), (sin_roll, cos_roll, sin_pitch, cos_pitch) = b, h, turn
    horizontal_squared = h_x * h_x + h_y * h_y
    # g = L^T (h_y, -h_x, 0) / H^2, the rows of L written out
    along, across = h_y / horizontal_squared, -h_x / horizontal_squared
    g = (
        cos_pitch * along,
        sin_pitch * sin_roll * along + cos_roll * across,
        sin_pitch * cos_roll * along - sin_roll * across,
    )
    w = (y * g[2] - z * g[1], z * g[0] - x * g[2], x * g[1] - y * g[0])  # w = b x g
    variance = _quadratic_form(covariance, g) + added_variance * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    variance = variance + _quadratic_form(boresight, w)
    # dpsi/dphi and dpsi/dtheta
    by_roll = along * sin_pitch * h_y - across * (sin_roll * y + cos_roll * z)
    by_pitch = along * h_z
    return variance + (by_roll * by_roll + by_pitch * by_pitch) * tilt_sigma * tilt_sigma


def _excess(b: Components, covariance: Components, boresight: Components, published: Any) -> Any:
    """Return the variance of each axis, nT^2, that checks and moving masses add to the calibration's."""
    # its direction is unknown: each axis gets a third of what exceeds tr V + tr Omega |b|^2 - b^T Omega b
    trace = boresight[0] + boresight[4] + boresight[8]
    known = covariance[0] + covariance[4] + covariance[8] - _quadratic_form(boresight, b)
    return (published - known - trace * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2])) / 3.0


def _quadratic_form(m: Components, v: Components) -> Any:
    """Return ``v^T M v`` of a vector v and a matrix M, given as 9 components row by row."""
    a, b, c = v
    return (
        a * (m[0] * a + m[1] * b + m[2] * c)
        + b * (m[3] * a + m[4] * b + m[5] * c)
        + c * (m[6] * a + m[7] * b + m[8] * c)
    )


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
        Corrected field in body axes, nT.
    roll, pitch : (n,) array or float
        Roll and pitch, rad.
    declination : (n,) array or float
        Declination, deg, east positive; NaN where unknown.
    covariance : (n, 3, 3) array, optional
        Covariance of `vector` without the error of the boresight, nT^2; zero if not given.
    boresight_covariance : (3, 3) array, optional
        Covariance of the boresight's rotation vector in body axes, rad^2; zero if not given.
    tilt_sigma_deg : (n,) array or float
        1-sigma of roll and of pitch, independent of each other, deg.
    declination_sigma_deg : (n,) array or float
        1-sigma of the declination, deg.

    Returns
    -------
    Heading
        Its sigma is at most that of a uniform angle, 180 / sqrt(3) deg: a heading does not exist if the
        horizontal field is smaller than its own standard deviation.

    Raises
    ------
    CalibrationError
        `vector` has another shape.
    """
    field = np.asarray(vector, float)
    if field.shape[-1:] != (3,) or field.ndim > 2:
        raise CalibrationError(f"vector: expected shape (n, 3), got {field.shape}")
    b = tuple(field.reshape(-1, 3).T)
    V, Omega = (
        tuple(np.zeros(9) if given is None else np.reshape(given, (-1, 9)).T)
        for given in (covariance, boresight_covariance)
    )
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        turn = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
        h = _level(b, turn)
        magnetic = np.degrees(np.arctan2(-h[1], h[0])) % 360.0
        sigma = np.degrees(np.sqrt(_variance(b, h, turn, V, Omega, 0.0, np.radians(tilt_sigma_deg))))
        sigma = np.hypot(sigma, np.nan_to_num(declination_sigma_deg))
        # The largest possible uncertainty is that of a uniform angle.
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
    """Return magnetic heading, true heading and sigma of one sample, deg, as in :class:`Heading`.

    The result equals that of :func:`heading` with :func:`published_covariance`, but the function uses no
    arrays. `vector`: corrected field in body axes, nT. `roll`, `pitch`: rad. `declination`: deg, east
    positive; NaN if unknown. `covariance`: of the vector by the calibration alone, row by row, nT^2.
    `boresight_covariance`: of the boresight's rotation vector in body axes, row by row, rad^2.
    `published_variance`: sum of the three components' published variances, nT^2. `tilt_sigma_deg`: 1-sigma of
    roll and of pitch. `declination_sigma_deg`: 1-sigma of the declination.
    """
    turn = sin(roll), cos(roll), sin(pitch), cos(pitch)
    h = _level(vector, turn)
    if isnan(h[0] + h[1]):
        return nan, nan, inf
    magnetic = degrees(atan2(-h[1], h[0])) % 360.0
    true = (magnetic + declination) % 360.0
    if h[0] == h[1] == 0.0:
        return magnetic, true, UNIFORM_SIGMA_DEG
    added = _excess(vector, covariance, boresight_covariance, published_variance)
    added = min(max(added, 0.0), MAX_ADDED_VARIANCE)
    tilt = radians(tilt_sigma_deg)
    variance = _variance(vector, h, turn, covariance, boresight_covariance, added, tilt)
    if not variance >= 0.0:
        return magnetic, true, UNIFORM_SIGMA_DEG
    sigma = hypot(degrees(sqrt(variance)), 0.0 if isnan(declination_sigma_deg) else declination_sigma_deg)
    return magnetic, true, min(sigma, UNIFORM_SIGMA_DEG)


def published_covariance(
    stated: FloatArray, turn: FloatArray, vector: FloatArray, variance: FloatArray
) -> FloatArray:
    """Return the covariance (n, 3, 3), nT^2, of published vectors without the error of the boresight.

    `stated` (n, 3, 3): covariance by the calibration alone, nT^2 (:func:`.correct.vector_covariance`). `turn`
    (3, 3): covariance of the boresight's rotation vector, rad^2. `vector` (n, 3): corrected field in body
    axes, nT. `variance` (n,): sum of the three components' published variances, nT^2.
    """
    more = _excess(tuple(vector.T), tuple(stated.reshape(-1, 9).T), tuple(np.ravel(turn)), variance)
    more = np.nan_to_num(np.maximum(more, 0.0), posinf=MAX_ADDED_VARIANCE)
    return np.asarray(stated + more[:, None, None] * np.eye(3))


def model_declination_sigma(horizontal: FloatArray, crustal_sigma: float = 0.0) -> FloatArray:
    """Return the standard deviation (n,) of a main-field model's declination, deg.

    `horizontal` (n,): horizontal part H of the main field, nT. `crustal_sigma`: 1-sigma of the crustal
    anomaly of the total field, nT. The 1-sigma of the crustal component across the meridian is about
    ``crustal_sigma / sqrt(2)``; divided by H it is the angle by which it turns magnetic north.

    Notes
    -----
    ``sigma_D^2 = 0.26^2 + (5417 / H)^2 + (180/pi crustal_sigma / (sqrt(2) H))^2``; the first two terms are
    those of WMM2025.
    """
    with np.errstate(divide="ignore"):
        model = np.hypot(DECLINATION_SIGMA_DEG, DECLINATION_SIGMA_NT_DEG / horizontal)
        crustal = np.degrees(crustal_sigma / (np.sqrt(2.0) * horizontal))
    return np.asarray(np.minimum(np.hypot(model, crustal), UNIFORM_SIGMA_DEG))
