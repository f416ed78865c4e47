"""The alternative that the paper names: level the vectors by attitude telemetry, fit the horizontal circle.

Notes
-----
After Isezaki (1986) and Korenaga (1995): a vehicle with an attitude reference knows which part of its
corrected field is horizontal, and both parts have known sizes whatever the heading::

    l = R_y(pitch) R_x(roll) B (H_r - T),   |l_xy| = H_h,   l_z = Z

with a full matrix B: components, unlike a magnitude, show tilts, so all of the boresight but one angle is
found too. ``B = R A`` with A symmetric (polar decomposition); with J its derivative, a covariance C of B and
T becomes ``J C J^T`` of A and T. It is only as good as the attitude: a tilt of half a degree puts 0.9 % of Z
into H_h, 400 nT of 46,000 nT.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import polar
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.nominal import check_scales, nominal_samples
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.errors import CalibrationError
from magbridge.estimation.noise import estimate_noise
from magbridge.estimation.priors import SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA
from magbridge.estimation.residual import residuals_of
from magbridge.wording import counted

__all__ = ["fit_horizontal"]

FEWEST = 30
"""Samples that an ellipsoid's twelve unknowns need."""
STEP = 1e-6
"""Of B, and of T over the field: the symmetric difference over it is good to 1e-9."""
FIRST_NOISE = 1e-3
"""Share of the field: the noise that attitude errors make, before it is estimated."""


def fit_horizontal(data: Observations, order: int = 0) -> Fit:  # noqa: ARG001  (one ellipsoid has none)
    """Fit one ellipsoid by levelled components.

    CalibrationError: roll and pitch, or the reference's direction, are lacking.
    """
    if data.attitude is None or data.reference_ned is None:
        raise CalibrationError("horizontal: needs roll, pitch and a position (for the field's inclination)")
    known = np.isfinite(data.attitude[:, :2]).all(axis=1) & np.isfinite(data.reference_ned).all(axis=1)
    if known.sum() < FEWEST:
        raise CalibrationError(
            f"horizontal: only {counted(int(known.sum()), 'sample')} with roll, pitch and position"
        )
    data = data.part(np.asarray(known))
    assert data.attitude is not None
    assert data.reference_ned is not None
    samples = nominal_samples(data)
    F_0 = samples.F_0
    level = Rotation.from_euler("YX", data.attitude[:, 1::-1])
    ned = data.reference_ned
    horizontal, vertical = np.hypot(ned[:, 0], ned[:, 1]), ned[:, 2]
    widths = np.array([SOFT_IRON_SIGMA] * 9 + [WIDE_HARD_IRON_SIGMA] * 3)

    def misfit(x: FloatArray, sigma: float) -> FloatArray:
        B, T = np.eye(3) + x[:9].reshape(3, 3), F_0 * x[9:]
        l = level.apply((data.field - T) @ B.T)  # noqa: E741  (the notes' letter)
        parts = np.concatenate([np.hypot(l[:, 0], l[:, 1]) - horizontal, l[:, 2] - vertical])
        return np.concatenate([parts / sigma, x / widths])

    sigma, x = FIRST_NOISE * F_0, np.zeros(12)
    for _ in range(3):
        found = least_squares(misfit, x, args=(sigma,), loss="soft_l1", f_scale=3.0)
        x = found.x
        sigma = float(np.sqrt(np.mean((misfit(x, sigma)[:-12] * sigma) ** 2)))
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    steps = STEP * np.eye(12)
    J = np.array([_coefficients(x + h, F_0) - _coefficients(x - h, F_0) for h in steps]).T / (2.0 * STEP)
    coefficients = _coefficients(x, F_0)
    check_scales(samples, coefficients)
    noise = estimate_noise(residuals_of(samples, coefficients), samples.steps, 9.0)
    return assemble(
        data, samples, (), ((),), coefficients, J @ covariance @ J.T, noise, "horizontal",
        details={"attitude_noise_nT": sigma},
    )  # fmt: skip


def _coefficients(x: FloatArray, F_0: float) -> FloatArray:
    """Return the nine coefficients (nT) for B and T: A of ``B = R A``, and T."""
    _, A = polar(np.eye(3) + x[:9].reshape(3, 3))
    a = F_0 * (A - np.eye(3))
    return np.concatenate([a[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]], F_0 * x[9:]])
