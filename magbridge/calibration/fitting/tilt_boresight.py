"""The boresight from roll and pitch alone, without headings.

Notes
-----
A scalar fit leaves one rotation R of the corrected vectors b free. Roll and pitch give the direction of
gravity in body axes, ``down = (-sin theta, sin phi cos theta, cos phi cos theta)``, and the reference gives
the field's vertical part ``F sin I``. A vehicle that dives, climbs and turns determines R from

    e_i = (down_i . R b_i - F_i sin(I_i + dI)) / (H_i sigma_w)

with dI, a common error of the inclination, normal about 0 with :data:`INCLINATION_SIGMA_DEG`. An error of the
tilt of sigma_w (rad) moves ``down . v`` by ``H sigma_w``, hence the weight. One row sees the rotation about
magnetic east only: its derivative is ``R b x down``. A full circle at one pitch gives ``(1 - down down^T)/2``
a row, whose smallest eigenvalue is ``sin^2(pitch)/2``, so a level vehicle cannot find the third angle.

The accelerometers' offsets differ between runs and do not average out within one. With t_i, the derivative of
e_i by roll and pitch, the covariance is the sandwich

    C = N^-1 (s^2 N + sum_r (sum_(i in r) J_i^T t_i) diag(sigma_t^2) (...)^T) N^-1

N the information of the rows, s^2 their measured variance, and sigma_t = :data:`RUN_TILT_SIGMA_DEG`. An
estimate from the scatter between a few runs would be far too small: it is not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray, IndexArray
from magbridge.errors import CalibrationError

__all__ = ["TiltBoresight", "boresight_from_tilt", "down_in_body"]

INCLINATION_SIGMA_DEG = 0.2
"""deg, 1-sigma of a main-field model's inclination (Chulliat et al. 2020, table 14)."""
RUN_TILT_SIGMA_DEG = 0.2
"""deg, 1-sigma of the offset of roll and of pitch in one run."""
MIN_TILT_SIGMA_DEG = 0.02
"""deg, smallest 1-sigma of the tilt's noise that is believed."""
MAX_ITERATIONS = 50
CONVERGED_RAD = 1e-8
MIN_SAMPLES = 30
SEARCH_SAMPLES = 400
MAX_STEP_RAD = 0.5
"""rad, longest step: the residual is linear in the rotation over that at most."""
LEAST_INFORMATION = 3.0 / np.pi**2
"""1/rad^2, of an angle of which nothing is known: it is uniform over a full turn."""
DAMPING = 1e-9
"""Fraction of the information's trace that keeps an angle which the rows do not see where it is."""
AXIS_ANGLES = ("roll", "pitch", "heading")
"""Name of the mounting angle about each body axis."""


@dataclass(frozen=True, eq=False)
class TiltBoresight:
    """A boresight, its covariance, and what the fit left."""

    rotation: FloatArray
    """(3,), rad, rotation vector from corrected sensor axes to body axes."""
    covariance: FloatArray
    """(3, 3), rad^2, of a small rotation about the body axes."""
    inclination_shift: float
    """deg, by which the field dips more steeply than the reference."""
    tilt_sigma: float
    """deg, standard deviation of the tilt that explains the residual."""

    @property
    def open_angle(self) -> tuple[str, float]:
        """The body axis about which the rotation is known least, and that axis' 1-sigma in deg."""
        sigma = np.degrees(np.sqrt(np.diag(self.covariance)))
        axis = int(np.argmax(sigma))
        return AXIS_ANGLES[axis], float(sigma[axis])


def down_in_body(roll: FloatArray, pitch: FloatArray) -> FloatArray:
    """Return the unit vector of gravity in body axes, (n, 3), from roll and pitch (n,), rad."""
    return np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], axis=1)


def boresight_from_tilt(
    vector: FloatArray,
    roll: FloatArray,
    pitch: FloatArray,
    total: FloatArray,
    inclination: FloatArray,
    runs: IndexArray,
) -> TiltBoresight:
    """Estimate the rotation from corrected sensor axes to body axes from roll and pitch alone.

    Parameters
    ----------
    vector : (n, 3) array
        nT, corrected field in sensor axes.
    roll, pitch : (n,) array
        rad.
    total : (n,) array
        nT, reference total field.
    inclination : (n,) array
        rad, of the reference field, positive downwards.
    runs : (n,) array of int
        Run of each sample: the tilt's offset is common to a run.

    Raises
    ------
    CalibrationError
        Fewer than :data:`MIN_SAMPLES` samples, or the iteration does not converge.
    """
    if len(vector) < MIN_SAMPLES:
        raise CalibrationError(
            f"boresight: expected at least {MIN_SAMPLES} samples with roll, pitch and reference, "
            f"got {len(vector)}"
        )
    horizontal = total * np.cos(inclination)
    down = down_in_body(roll, pitch)
    prior = np.zeros((4, 4))
    prior[3, 3] = 1.0 / np.radians(INCLINATION_SIGMA_DEG) ** 2
    problem = _Problem(vector, down, total, inclination, horizontal, prior)
    # The cost has several minima: search from the 24 orientations of a cube on a few samples.
    few = problem.part(np.linspace(0, len(vector) - 1, min(len(vector), SEARCH_SAMPLES)).astype(int))
    searched = [_gauss_newton(few, start) for start in Rotation.create_group("O")]
    start = min(searched, key=lambda result: result[2])[0]
    rotation, shift, _ = _gauss_newton(problem, start)
    turned = rotation.apply(vector)
    e, J = problem.rows(rotation, shift)
    tilt_sigma = max(float(np.sqrt(np.mean(e * e))), np.radians(MIN_TILT_SIGMA_DEG))
    # derivative of gravity's direction by roll and by pitch; t_i is what they do to the row
    by_roll = np.stack([np.zeros(len(roll)), np.cos(roll) * np.cos(pitch), -np.sin(roll) * np.cos(pitch)], 1)
    by_pitch = np.stack(
        [-np.cos(pitch), -np.sin(roll) * np.sin(pitch), -np.cos(roll) * np.sin(pitch)], axis=1
    )
    offsets = np.stack([(turned * by_roll).sum(1), (turned * by_pitch).sum(1)], axis=1) / horizontal[:, None]
    # Noise of the tilt moves J, too, and looks like a change of attitude: take its part out of N.
    noise = sum(
        turn.T @ turn for turn in (np.cross(turned, d) / horizontal[:, None] for d in (by_roll, by_pitch))
    )
    N = J.T @ J / tilt_sigma**2 + prior
    N[:3, :3] -= noise
    values, axes = np.linalg.eigh(N)
    N = (axes * np.maximum(values, LEAST_INFORMATION)) @ axes.T
    _, run = np.unique(runs, return_inverse=True)
    meat = N.copy()
    for index in range(int(run.max()) + 1):
        rows = run == index
        lever = J[rows].T @ offsets[rows] / tilt_sigma**2  # (4, 2)
        meat += np.radians(RUN_TILT_SIGMA_DEG) ** 2 * lever @ lever.T
    inverse = np.linalg.inv(N)
    covariance = (inverse @ meat @ inverse)[:3, :3]
    return TiltBoresight(
        rotation.as_rotvec(), 0.5 * (covariance + covariance.T), float(np.degrees(shift)),
        float(np.degrees(tilt_sigma)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Problem:
    """The samples and the prior; shapes as for :func:`boresight_from_tilt`."""

    vector: FloatArray
    down: FloatArray
    total: FloatArray
    inclination: FloatArray
    horizontal: FloatArray
    prior: FloatArray

    def part(self, rows: IndexArray) -> _Problem:
        """Return the problem of some of the samples."""
        return _Problem(
            self.vector[rows], self.down[rows], self.total[rows], self.inclination[rows],
            self.horizontal[rows], self.prior,
        )  # fmt: skip

    def rows(self, rotation: Rotation, shift: float) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (n,), rad of tilt, and their derivatives (n, 4) by the rotation and by dI."""
        turned, inclination = rotation.apply(self.vector), self.inclination + shift
        e = ((self.down * turned).sum(axis=1) - self.total * np.sin(inclination)) / self.horizontal
        J = np.empty((len(e), 4))
        J[:, :3] = np.cross(turned, self.down) / self.horizontal[:, None]  # d (down . (delta x v)) / d delta
        J[:, 3] = -self.total * np.cos(inclination) / self.horizontal
        return e, J


def _gauss_newton(problem: _Problem, rotation: Rotation) -> tuple[Rotation, float, float]:
    """Iterate from one start; return the rotation, dI (rad) and the cost."""
    shift, sigma, cost = 0.0, np.radians(RUN_TILT_SIGMA_DEG), np.inf
    for _ in range(MAX_ITERATIONS):
        e, J = problem.rows(rotation, shift)
        hessian = J.T @ J / sigma**2 + problem.prior
        gradient = J.T @ e / sigma**2 + problem.prior @ np.array([0.0, 0.0, 0.0, shift])
        hessian += DAMPING * np.trace(hessian) * np.eye(4)
        step = -np.linalg.solve(hessian, gradient)
        length = np.linalg.norm(step[:3])
        if length > MAX_STEP_RAD:
            step *= MAX_STEP_RAD / length
        rotation = Rotation.from_rotvec(step[:3]) * rotation
        shift += float(step[3])
        if np.linalg.norm(step) < CONVERGED_RAD:
            break
    e, _ = problem.rows(rotation, shift)
    cost = float(e @ e) / sigma**2 + problem.prior[3, 3] * shift**2
    return rotation, shift, cost
