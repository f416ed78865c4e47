"""The rotation that a scalar fit leaves free, from attitude telemetry and the reference's direction.

Notes
-----
Corrected vectors b (sensor axes) and the Earth's field in body axes ``v = R(attitude)^T H_ned`` differ by
one rotation: ``v = R b`` (Wahba's problem; scipy solves it). Attitude errors vary slowly, so successive
samples are not independent: the covariance is estimated from the scatter between whole runs (sandwich
estimate)::

    I = sum (|v|^2 E - v v^T),   s_r = sum_(i in run r) v_i x (R b_i - v_i),   C = I^-1 (sum_r s_r s_r^T) I^-1
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.tilt_boresight import boresight_from_tilt
from magbridge.calibration.model import Boresight, Calibration
from magbridge.errors import CalibrationError

__all__ = ["choose_boresight", "field_body", "find_boresight", "magnetic_headings"]

MAX_OPEN_ANGLE_DEG = 2.0
"""deg, 1-sigma of the angle that roll and pitch determine least, above which headings are used."""
MIN_BORESIGHT_SAMPLES = 30
"""Samples with attitude and direction that a boresight takes."""
MISMATCH = 10.0
"""deg, median angle that no rotation removes: masses leave less, a reversed channel or angle more."""
NEAR, LEAST = 2.0, 0.5
"""deg, within which angles are the same; and the least mismatch, of a compass, that one is compared with."""
COMPASS_SIGMA = np.radians(0.5)
"""rad, compass error common to all runs, which their scatter does not show."""


def field_body(attitude: FloatArray, field_ned: FloatArray) -> FloatArray:
    """Turn a field from world to body axes.

    Parameters
    ----------
    attitude : (n, 3) array
        rad, roll, pitch, heading (3-2-1).
    field_ned : (n, 3) array
        nT, north-east-down.
    """
    body_to_world = Rotation.from_euler("ZYX", attitude[:, ::-1])
    return np.asarray(body_to_world.inv().apply(np.array(field_ned)))


def _vectors(calibration: Calibration, data: Observations) -> FloatArray:
    """Return the corrected vectors (n, 3) in sensor axes, nT."""
    k = len(calibration.parameters)
    return correct(replace(calibration, boresight=None), data.field, data.parameters[:, :k], data.time).vector


def _wahba(v: FloatArray, b: FloatArray) -> tuple[Rotation, float]:
    """Return the rotation of vectors b to v, (n, 3) each, and the median angle that it leaves, deg."""
    # Wahba's problem: the rotation that minimises the sum of |v - R b|^2
    rotation, _ = Rotation.align_vectors(v, b)
    turned = rotation.apply(b)
    # angles by the arctangent, which is accurate for small ones
    left = np.arctan2(np.linalg.norm(np.cross(v, turned), axis=1), np.sum(v * turned, axis=1))
    return rotation, float(np.degrees(np.median(left)))


def magnetic_headings(calibration: Calibration, data: Observations) -> str:
    """Return a warning if headings seem to be measured from magnetic north; else "".

    Notes
    -----
    Headings short of the declination D turn every vector by D about the vertical. For a vehicle that stays
    level that is a boresight of D, and the mounting looks turned. For one that dives and climbs at a pitch p
    it is not a rotation of the sensor: the best one is ``D cos p cos^2 I / (cos^2 p cos^2 I + sin^2 p (1 +
    sin^2 I) / 2)`` about z, I the inclination (7.4 deg of 17.6 at p = 24 and I = 70 deg), and leaves angles
    that a correct heading does not.
    """
    known, attitude, reference_ned = data.directed()
    if known.sum() < MIN_BORESIGHT_SAMPLES or calibration.effects:
        return ""
    # compare two boresights: with the headings as they are, and with the declination added
    declination = np.arctan2(reference_ned[:, 1], reference_ned[:, 0])
    D = float(np.degrees(np.arctan2(np.sin(declination).mean(), np.cos(declination).mean())))
    b = _vectors(calibration, data.part(known))
    yawed = attitude + np.column_stack([np.zeros((len(b), 2)), declination])
    as_read, left = _wahba(field_body(attitude, reference_ned), b)
    as_true, rest = _wahba(field_body(yawed, reference_ned), b)
    turn, rest_turn = np.degrees([as_read.magnitude(), as_true.magnitude()])
    level = abs(turn - abs(D)) < NEAR and rest_turn < NEAR
    if abs(D) < 2.0 * NEAR or not (left > 2.0 * max(rest, LEAST) or level):
        return ""
    return (
        f"the headings look magnetic: with the declination of {D:+.1f} degrees added, the sensor is turned "
        f"by {rest_turn:.1f} degrees and not by {turn:.1f}, and {rest:.1f} not {left:.1f} are left "
        "(--heading-reference magnetic)"
    )


def choose_boresight(calibration: Calibration, data: Observations) -> Boresight | None:
    """Return the boresight from roll and pitch alone where they determine it, else one that uses headings.

    A heading that comes from the magnetometer itself contains the error that the boresight is to remove.

    Raises
    ------
    CalibrationError
        As :func:`find_boresight`: headings are used to notice a reversed channel or angle in any case.
    """
    with_headings = find_boresight(calibration, data)
    if data.attitude is None or data.reference_ned is None or calibration.effects:
        return with_headings
    known = np.asarray(np.isfinite(np.hstack([data.attitude[:, :2], data.reference_ned])).all(axis=1))
    if known.sum() < MIN_BORESIGHT_SAMPLES:
        return with_headings
    part = data.part(known)
    assert part.attitude is not None
    assert part.reference_ned is not None
    # tilt needs the size and the inclination of the field, not the heading
    total = np.linalg.norm(part.reference_ned, axis=1)
    inclination = np.arcsin(part.reference_ned[:, 2] / total)
    _, runs = np.unique(part.runs, return_inverse=True)
    found = boresight_from_tilt(
        _vectors(calibration, part), part.attitude[:, 0], part.attitude[:, 1], total, inclination, runs
    )
    if found.open_angle[1] > MAX_OPEN_ANGLE_DEG:
        return with_headings
    x, y, z = found.rotation.tolist()
    first, second, third = ((x, y, z) for x, y, z in found.covariance.tolist())
    return Boresight((x, y, z), (first, second, third))


def find_boresight(calibration: Calibration, data: Observations) -> Boresight | None:
    """Find the rotation from corrected sensor axes to body axes.

    Returns
    -------
    Boresight or None
        None if too few samples have both attitude and reference direction, or the calibration has effects.

    Raises
    ------
    CalibrationError
        No rotation takes the corrected vectors to where attitude and main field say they point.
    """
    known, attitude, reference_ned = data.directed()
    if known.sum() < MIN_BORESIGHT_SAMPLES or calibration.effects:
        return None
    part = data.part(known)
    v, b = field_body(attitude, reference_ned), _vectors(calibration, part)
    rotation, angle = _wahba(v, b)
    turned = rotation.apply(b)
    # the derivative of the misfit by a small rotation, for each sample
    score = np.cross(v, turned - v)
    if angle > MISMATCH:
        raise CalibrationError(
            f"however the sensor is turned, the field lies {angle:.0f} degrees (median) from where roll, "
            "pitch, heading and IGRF say: a channel or an angle has the other sign, two are swapped, angles "
            "are not in degrees, or the place is another; no boresight, so the vector stays in sensor axes"
        )
    # Sandwich covariance: attitude errors last as long as a run, so the scores are summed within runs, and
    # the scatter of these sums takes the place of the noise (Liang & Zeger 1986, Biometrika 73:13).
    information = np.sum(v * v) * np.eye(3) - v.T @ v
    _, which = np.unique(part.runs, return_inverse=True)
    between = np.stack([np.bincount(which, column) for column in score.T], axis=1)
    runs = len(between)
    inverse = np.linalg.inv(information)
    spread = between.T @ between * (runs / max(runs - 1, 1))
    covariance = inverse @ spread @ inverse + COMPASS_SIGMA**2 * np.eye(3)
    x, y, z = rotation.as_rotvec().tolist()
    first, second, third = ((x, y, z) for x, y, z in (0.5 * (covariance + covariance.T)).tolist())
    return Boresight((x, y, z), (first, second, third))
