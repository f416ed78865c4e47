"""Boresight: the rotation from sensor to body axes, from attitude telemetry and the reference's direction.

Notes
-----
A fit to the magnitude does not determine this rotation R. Corrected vectors b (sensor axes) and the Earth's
field in body axes ``v = R(attitude)^T H_ned`` differ by it: ``v = R b`` (Wahba's problem; scipy solves it).
Attitude errors vary slowly, so successive samples are not independent. The covariance is therefore estimated
from the scatter between whole runs (sandwich estimate)::

    I = sum (|v|^2 E - v v^T),   s_r = sum_(i in run r) v_i x (R b_i - v_i),   C = I^-1 (sum_r s_r s_r^T) I^-1

**From roll and pitch alone.** Roll and pitch give the direction of
gravity in body axes, ``down = (-sin theta, sin phi cos theta, cos phi cos theta)``, and the reference gives
the field's vertical part ``F sin I``. A vehicle that dives, climbs and turns determines R from

    e_i = (down_i . R b_i - F_i sin(I_i + dI)) / (H_i sigma_w)

with dI a common error of the inclination, normal about 0 with :data:`INCLINATION_SIGMA_DEG`. A tilt error of
sigma_w (rad) changes ``down . v`` by ``H sigma_w``, with H the horizontal field; hence the weight. The
derivative of one row by the rotation is ``R b x down``, so the row depends only on the rotation about
magnetic east. A full circle at one pitch gives the information ``(1 - down down^T)/2`` per row. Its smallest
eigenvalue is ``sin^2(pitch)/2``, so a level vehicle does not determine the third angle.

The accelerometers' offsets differ between runs and do not average out within one. With t_i, the derivative of
e_i by roll and pitch, the covariance is the sandwich

    C = N^-1 (s^2 N + sum_r (sum_(i in r) J_i^T t_i) diag(sigma_t^2) (...)^T) N^-1

with N the information of the rows and s^2 their measured variance. A few runs hardly determine sigma_t, so
sigma_t^2 is its posterior mean. Its prior is the inverse gamma distribution about :data:`RUN_TILT_SIGMA_DEG`
with the weight of :data:`RUN_TILT_PRIOR_COUNT` observations. Within a run, e has the covariance
``s^2 I + sigma_t^2 T T^T``, T the rows t_i. Its eigenvectors give independent z_k of the variance
``s^2 + sigma_t^2 l_k``, l_k an eigenvalue of ``T^T T``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.heading import DEFAULT_TILT_SIGMA_DEG
from magbridge.calibration.model import Boresight, Calibration
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError

INCLINATION_SIGMA_DEG = 0.2
"""1-sigma of a main-field model's inclination (error model of the World Magnetic Model 2025), deg."""
RUN_TILT_SIGMA_DEG = 0.2
"""Expected 1-sigma of the offset of roll and of pitch in one run, deg."""
RUN_TILT_PRIOR_COUNT = 2.0
"""Weight of the prior :data:`RUN_TILT_SIGMA_DEG`, as a number of observations."""
MAX_RUN_TILT_SIGMA_DEG = 10.0
"""Largest 1-sigma of the offset of roll and of pitch that the fit considers, deg."""
MIN_SQUARED_LEVER = 1e-12
"""Lower limit of a run's eigenvalues l_k, which avoids a division by zero."""
MIN_TILT_SIGMA_DEG = 0.02
"""Smallest 1-sigma of the tilt's noise, deg."""
MAX_ITERATIONS = 50
CONVERGED_RAD = 1e-8
"""Length of a Gauss-Newton step below which the iterations have converged, rad."""
SEARCH_SAMPLES = 400
"""Largest number of samples with which the search for the best start runs."""
MAX_STEP_RAD = 0.5
"""Longest step over which the residual counts as linear in the rotation, rad."""
LEAST_INFORMATION = 3.0 / np.pi**2
"""Information about an angle that is uniform over a full turn, 1/rad^2."""
DAMPING = 1e-9
"""Damping of a step as a fraction of the information's trace: it fixes angles that no row determines."""
MAX_OPEN_ANGLE_DEG = 2.0
"""1-sigma of the least determined angle above which the boresight uses headings, deg."""
MIN_BORESIGHT_SAMPLES = 30
"""Smallest number of samples with attitude and reference direction for a boresight."""
MISMATCH = 10.0
"""Largest accepted median angle between the directions after the best rotation, deg. Masses cause a smaller
angle, a reversed channel or angle a larger one."""
NEAR, LEAST = 2.0, 0.5
"""Difference below which two angles count as equal, and lower limit of the mismatch to compare with, deg."""
COMPASS_SIGMA = np.radians(0.5)
"""1-sigma of a compass error that is common to all runs and does not show in their scatter, rad."""


def field_body(attitude: FloatArray, field_ned: FloatArray) -> FloatArray:
    """Return a field in body axes, (n, 3), nT.

    `attitude` (n, 3): roll, pitch, heading (3-2-1), rad. `field_ned` (n, 3): north-east-down, nT.
    """
    body_to_world = Rotation.from_euler("ZYX", attitude[:, ::-1])
    return np.asarray(body_to_world.inv().apply(np.array(field_ned)))


def choose_boresight(calibration: Calibration, data: Observations) -> Boresight | None:
    """Return the boresight from roll and pitch if they determine it, else the boresight from headings.

    Headings are the second choice, because a heading from the magnetometer itself contains the error that the
    boresight should remove. None: as for :func:`find_boresight`.

    CalibrationError: as for :func:`find_boresight`, which always checks the headings.
    """
    with_headings = find_boresight(calibration, data)
    found = find_tilt_boresight(calibration, data)
    if found is None:
        return with_headings
    least_known = np.degrees(np.sqrt(np.diag(found.covariance))).max()
    return with_headings if least_known > MAX_OPEN_ANGLE_DEG else found


# ---- From roll and pitch alone ----


def find_tilt_boresight(calibration: Calibration, data: Observations) -> Boresight | None:
    """Return the boresight from roll and pitch alone; None: as for :func:`find_boresight`."""
    if data.attitude is None or data.reference_ned is None or calibration.effects:
        return None
    known = np.asarray(np.isfinite(np.hstack([data.attitude[:, :2], data.reference_ned])).all(axis=1))
    if known.sum() < MIN_BORESIGHT_SAMPLES:
        return None
    vector, ned = _vectors(calibration, data.part(known)), data.reference_ned[known]
    roll, pitch, _ = data.attitude[known].T
    # the tilt method needs the magnitude and inclination of the field, but no heading
    total = np.linalg.norm(ned, axis=1)
    return boresight_from_tilt(vector, roll, pitch, total, np.arcsin(ned[:, 2] / total), data.runs[known])


def boresight_from_tilt(
    vector: FloatArray,
    roll: FloatArray,
    pitch: FloatArray,
    total: FloatArray,
    inclination: FloatArray,
    runs: NDArray[np.generic],
) -> Boresight:
    """Estimate the rotation from corrected sensor axes to body axes from roll and pitch, without headings.

    `vector` (n, 3): corrected field in sensor axes, nT. `roll`, `pitch` (n,): rad. `total` (n,): reference of
    the total field, nT. `inclination` (n,): of the reference, rad, positive downwards. `runs` (n,): run of
    each sample; roll and pitch have one offset in each run.
    """
    horizontal = total * np.cos(inclination)
    zero, sin_roll, cos_roll, sin_pitch, cos_pitch = (
        np.zeros(len(roll)), np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    )  # fmt: skip
    # direction of gravity, and its derivatives by roll and by pitch
    down = np.stack([-sin_pitch, sin_roll * cos_pitch, cos_roll * cos_pitch], axis=1)
    by_roll = np.stack([zero, cos_roll * cos_pitch, -sin_roll * cos_pitch], axis=1)
    by_pitch = np.stack([-cos_pitch, -sin_roll * sin_pitch, -cos_roll * sin_pitch], axis=1)
    prior = np.diag([0.0, 0.0, 0.0, np.radians(INCLINATION_SIGMA_DEG) ** -2.0])

    def rows(x: FloatArray, start: Rotation, part: IndexArray | slice) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n,), as rad of tilt, and derivatives (n, 4) by the rotation and dI in x (4,)."""
        turned = (Rotation.from_rotvec(x[:3]) * start).apply(vector[part])
        steep = inclination[part] + x[3]
        e = ((down[part] * turned).sum(axis=1) - total[part] * np.sin(steep)) / horizontal[part]
        # d (down . (delta x v)) / d delta = v x down
        J = np.column_stack([np.cross(turned, down[part]), -total[part] * np.cos(steep)])
        return e, J / horizontal[part, None]

    # The cost has several minima: search from the 24 orientations of a cube on a few samples.
    few = np.linspace(0, len(vector) - 1, min(len(vector), SEARCH_SAMPLES)).astype(int)
    searched = [
        _gauss_newton(partial(rows, part=few), prior, start, 0.0) for start in Rotation.create_group("O")
    ]
    rotation, shift, _ = min(searched, key=lambda result: result[2])
    rotation, shift, _ = _gauss_newton(partial(rows, part=slice(None)), prior, rotation, shift)
    turned = rotation.apply(vector)
    e, J = rows(np.array([0.0, 0.0, 0.0, shift]), rotation, slice(None))
    tilt_sigma = max(float(np.sqrt(np.mean(e * e))), np.radians(MIN_TILT_SIGMA_DEG))
    # t_i, the derivatives of the row by roll and pitch
    offsets = np.stack([(turned * by_roll).sum(1), (turned * by_pitch).sum(1)], axis=1) / horizontal[:, None]
    N = J.T @ J / tilt_sigma**2 + prior
    # Noise of the tilt changes J as a change of attitude does, which inflates N: subtract its part.
    for by_angle in (by_roll, by_pitch):
        turn = np.cross(turned, by_angle) / horizontal[:, None]
        N[:3, :3] -= turn.T @ turn
    values, axes = np.linalg.eigh(N)
    N = (axes * np.maximum(values, LEAST_INFORMATION)) @ axes.T
    parts = [runs == label for label in np.unique(runs)]
    white, offset = _tilt_variances([e[part] for part in parts], [offsets[part] for part in parts])
    meat = N.copy()
    for part in parts:
        lever = J[part].T @ offsets[part] / tilt_sigma**2  # (4, 2)
        meat += offset * lever @ lever.T
    inverse = np.linalg.inv(N)
    covariance = (inverse @ meat @ inverse)[:3, :3]
    return to_boresight(rotation, covariance, float(np.degrees(np.sqrt(white + offset))))


def _tilt_variances(residuals: list[FloatArray], levers: list[FloatArray]) -> tuple[float, float]:
    """Return the variances s^2 and sigma_t^2 of the module's notes, rad^2.

    `residuals`, `levers`: e (m,), rad, and T (m, 2) of each run.
    """
    squares, eigenvalues, white = np.empty(0), np.empty(0), 0.0
    for e, T in zip(residuals, levers, strict=True):
        of_run, axes = np.linalg.eigh(T.T @ T)
        of_run = np.maximum(of_run, MIN_SQUARED_LEVER)
        z_squared = (axes.T @ (T.T @ e)) ** 2 / of_run
        squares, eigenvalues = np.append(squares, z_squared), np.append(eigenvalues, of_run)
        white += float(e @ e - z_squared.sum())
    count = sum(map(len, residuals)) - len(squares)
    white = max(white / max(count, 1), np.radians(MIN_TILT_SIGMA_DEG) ** 2)
    # the rotation took three of the values
    squares *= len(squares) / max(len(squares) - 3, 1)
    # posterior mean of sigma_t^2 over a grid: -2 log p = sum (log v_k + z_k^2 / v_k) - 2 log prior
    grid = np.radians(np.geomspace(MIN_TILT_SIGMA_DEG, MAX_RUN_TILT_SIGMA_DEG, 200)) ** 2
    variance = white + grid[:, None] * eigenvalues
    cost = (np.log(variance) + squares / variance).sum(axis=1)
    cost += RUN_TILT_PRIOR_COUNT * (np.log(grid) + np.radians(RUN_TILT_SIGMA_DEG) ** 2 / grid)
    weight = np.exp(-0.5 * (cost - cost.min()))
    return white, float(weight @ grid / weight.sum())


def _gauss_newton(
    rows: Callable[[FloatArray, Rotation], tuple[FloatArray, FloatArray]],
    prior: FloatArray,
    rotation: Rotation,
    shift: float,
) -> tuple[Rotation, float, float]:
    """Minimise the cost by Gauss-Newton steps from a start; return the rotation, dI (rad) and the cost."""
    sigma, x = np.radians(RUN_TILT_SIGMA_DEG), np.array([0.0, 0.0, 0.0, shift])
    for _ in range(MAX_ITERATIONS):
        e, J = rows(x, rotation)
        hessian = J.T @ J / sigma**2 + prior
        hessian += DAMPING * np.trace(hessian) * np.eye(4)
        step = -np.linalg.solve(hessian, J.T @ e / sigma**2 + prior @ x)
        step *= min(MAX_STEP_RAD / max(float(np.linalg.norm(step[:3])), 1e-300), 1.0)
        # apply the step to the start, so that the derivative is always taken at a zero rotation
        rotation, x[3] = Rotation.from_rotvec(step[:3]) * rotation, x[3] + step[3]
        if np.linalg.norm(step) < CONVERGED_RAD:
            break
    e, _ = rows(x, rotation)
    return rotation, float(x[3]), float(e @ e) / sigma**2 + prior[3, 3] * float(x[3]) ** 2


# ---- With headings ----


def find_boresight(calibration: Calibration, data: Observations) -> Boresight | None:
    """Return the rotation from corrected sensor axes to body axes, from roll, pitch and heading.

    None: too few samples have attitude and reference direction, or the calibration has effects.

    CalibrationError: after the best rotation, vectors and reference differ by more than :data:`MISMATCH`.
    """
    known, attitude, reference_ned = data.directed()
    if known.sum() < MIN_BORESIGHT_SAMPLES or calibration.effects:
        return None
    part = data.part(known)
    v, b = field_body(attitude, reference_ned), _vectors(calibration, part)
    rotation, angle = _wahba(v, b)
    if angle > MISMATCH:
        raise CalibrationError(
            f"however the sensor is turned, the field lies {angle:.0f} degrees (median) from where roll, "
            "pitch, heading and IGRF say: a channel or an angle has the other sign, two are swapped, angles "
            "are not in degrees, or the place is another; no boresight, so the vector stays in sensor axes"
        )
    # Sandwich covariance: attitude errors last as long as a run, so the scores (derivatives of the misfit by
    # a small rotation) are summed within runs, and the scatter of these sums takes the place of the noise
    # (Liang & Zeger 1986, Biometrika 73:13).
    score = np.cross(v, rotation.apply(b) - v)
    between = np.stack([score[part.runs == label].sum(axis=0) for label in np.unique(part.runs)])
    inverse = np.linalg.inv(np.sum(v * v) * np.eye(3) - v.T @ v)
    spread = between.T @ between * (len(between) / max(len(between) - 1, 1))
    # errors that all runs share do not scatter: of the headings about the vertical, of the tilt across it
    down = field_body(attitude, np.broadcast_to([0.0, 0.0, 1.0], attitude.shape)).mean(axis=0)
    down /= np.linalg.norm(down)
    tilt_variance = np.radians(RUN_TILT_SIGMA_DEG) ** 2
    shared = tilt_variance * np.eye(3) + (COMPASS_SIGMA**2 - tilt_variance) * np.outer(down, down)
    return to_boresight(rotation, inverse @ spread @ inverse + shared)


def magnetic_headings(calibration: Calibration, data: Observations) -> Diagnostic | None:
    """Return a warning if headings seem to be measured from magnetic north; else None.

    Notes
    -----
    Headings without the declination D turn every vector by D about the vertical. For a level vehicle this
    looks like a boresight of D. For a vehicle that dives and climbs at a pitch p, in a field of inclination
    I, the best rotation is ``D cos p cos^2 I / (cos^2 p cos^2 I + sin^2 p (1 + sin^2 I) / 2)`` about z. The
    remaining angles are then larger than with correct headings.
    """
    known, attitude, reference_ned = data.directed()
    if known.sum() < MIN_BORESIGHT_SAMPLES or calibration.effects:
        return None
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
        return None
    angles = {"declination": D, "true_turn": rest_turn, "turn": turn, "true_left": rest, "left": left}
    return Diagnostic("magnetic_headings", angles)


def _vectors(calibration: Calibration, data: Observations) -> FloatArray:
    """Return the corrected vectors of `data` (n, 3) in sensor axes, without a boresight, nT."""
    k = len(calibration.parameters)
    return correct(replace(calibration, boresight=None), data.field, data.parameters[:, :k], data.time).vector


def _wahba(v: FloatArray, b: FloatArray) -> tuple[Rotation, float]:
    """Return the best rotation R of vectors b to v, (n, 3) each, and the median angle from R b to v, deg."""
    # Wahba's problem: the rotation that minimises the sum of |v - R b|^2
    rotation, _ = Rotation.align_vectors(v, b)
    turned = rotation.apply(b)
    # angles by the arctangent, which is accurate for small ones
    left = np.arctan2(np.linalg.norm(np.cross(v, turned), axis=1), np.sum(v * turned, axis=1))
    return rotation, float(np.degrees(np.median(left)))


def to_boresight(
    rotation: Rotation, covariance: FloatArray, tilt_sigma: float = DEFAULT_TILT_SIGMA_DEG
) -> Boresight:
    """Return the boresight of a rotation; `covariance` (3, 3): rad^2; `tilt_sigma`: deg."""
    symmetric = 0.5 * (covariance + covariance.T)
    settings = {"rotation": rotation.as_rotvec().tolist(), "covariance": symmetric.tolist()}
    return msgspec.convert(settings | {"tilt_sigma": tilt_sigma}, Boresight)
