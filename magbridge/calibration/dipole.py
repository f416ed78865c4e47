"""A moving dipole: permanent and induced moment on a mass that travels along a line.

Notes
-----
A mass at ``r(p) = r_0 + t p``, seen from the sensor, with permanent moment m and susceptibilities chi along
the body's axes adds to the field at the sensor (r-hat the unit vector; Blakely 1995, eq. 4.14; m includes
mu_0/4pi)::

    G(r) = (3 r-hat r-hat^T - I) / |r|^3,   T += G(r) m,   H -> (I + G(r) chi) H

so that to first order ``A -= G(r) chi``, symmetric part. The second order, ``(G chi)^2``, depends on p
alone and is left to the polynomial term. Moments are stored as the field they make at the sensor, in
nT: ``m / |r_0|^3`` and ``chi F_0 / |r_0|^3``.

Along a line that is short against the distance, G is a rapidly converging power series in p. So the term is
expanded into a polynomial (order :data:`SERIES_ORDER`) and costs no more than one.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.polynomial import chebyshev

from magbridge.arrays import FloatArray
from magbridge.calibration.terms import Expansion, Parameter, PositionTerm
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS
from magbridge.wording import one_of

Vector = tuple[float, float, float]

SERIES_ORDER = 8
"""With a travel of a fifth of the distance either way the series is good to 1e-4; with a tenth, to 1e-7."""


def dipole_tensor(r: FloatArray) -> FloatArray:
    """Return ``G(r)`` of dipoles at `r` from the sensor.

    `r` (..., 3): m. Returns (..., 3, 3): m^-3; times a moment (nT m³, with mu_0/4pi in it) it is the field
    at the sensor, nT.
    """
    # G(r) = (3 u u^T - I) / r^3 with u = r / |r|
    distance = np.linalg.norm(r, axis=-1)[..., None, None]
    unit = r[..., :, None] / distance
    return np.asarray((3.0 * unit * np.swapaxes(unit, -1, -2) - np.eye(3)) / distance**3)


def dipole_columns(r: FloatArray, moment: FloatArray, induced: FloatArray, r_0: float) -> FloatArray:
    """Return the contribution of each of a dipole's nine numbers to the nine coefficients, at `r`.

    `r` (n, 3): m, where the mass is. `moment`, `induced` (3,): nT at the sensor, as :class:`Dipole` keeps
    them; the displacement's three columns are linear in them. `r_0`: m, the distance at which moments are
    given as a field. Returns (9, n, 9): moment x, y, z; induced x, y, z; displacement x, y, z (nT per m).
    """
    columns = np.zeros((9, len(r), 9))

    def put(rows: FloatArray, G: FloatArray, moments: FloatArray, chi: FloatArray) -> None:
        # Permanent moment: T = G m. Induced moment: H_r = B + G diag(chi) B, so a = -G diag(chi).
        rows[:, 6:] = G @ moments
        pulled = G * chi  # G diag(chi); of an unsymmetric A only the symmetric part shows in the magnitude
        rows[:, :6] = np.stack([-0.5 * (pulled[:, i, j] + pulled[:, j, i]) for i, j in PAIRS], axis=1)

    G = dipole_tensor(r) * r_0**3
    nothing = np.zeros(3)
    for k, axis in enumerate(np.eye(3)):
        put(columns[k], G, axis, nothing)
        put(columns[3 + k], G, nothing, axis)
        h = 1e-5 * r_0 * axis  # a symmetric difference over 1e-5 of the distance is good to 1e-10
        slope = (dipole_tensor(r + h) - dipole_tensor(r - h)) * r_0**3 / (2e-5 * r_0)
        put(columns[6 + k], slope, moment, induced)
    return columns


def expand_dipole(values: FloatArray, order: int) -> FloatArray:
    """Return the power series coefficients of functions given at the Chebyshev nodes of [-1, 1].

    `values` (..., n, s): at ``cos(pi (i + 1/2) / n)``, n > order. `order`: of the highest power. The result
    is (..., order + 1, s).
    """
    # Interpolate by Chebyshev polynomials (well conditioned), then convert to powers.
    n = values.shape[-2]
    nodes = chebyshev.chebpts1(n)
    fit = np.linalg.pinv(chebyshev.chebvander(nodes, order))
    powers = np.zeros((order + 1, order + 1))
    for degree in range(order + 1):
        powers[: degree + 1, degree] = chebyshev.cheb2poly(np.eye(order + 1)[degree])[: degree + 1]
    return np.asarray((powers @ fit) @ values)


class Dipole(PositionTerm, frozen=True, kw_only=True):
    """One mass as a dipole; coefficients: moment (3, nT), induced moment (3, nT), displacement (3, m)."""

    kind: ClassVar[str] = "dipole"
    parameter: str
    """Which parameter moves it."""
    at: Vector
    """Position of the mass where the parameter is 0, in the body frame from the sensor, m."""
    travel: Vector
    """m per unit of the parameter."""
    at_sigma: float = 0.0
    """1-sigma of `at`, m: the prior of the displacement."""
    moment: Vector = (0.0, 0.0, 0.0)
    """nT at the sensor: where the displacement's columns were linearised."""
    induced: Vector = (0.0, 0.0, 0.0)
    """Induced moment as a field at the sensor, nT."""

    @property
    def size(self) -> int:
        """Moment, induced moment, displacement."""
        return 9

    def check(self, parameters: tuple[str, ...]) -> None:
        """Require that the parameter exists and the mass is not in the sensor."""
        if self.parameter not in parameters:
            raise CalibrationError(f"dipole: parameter: {one_of(self.parameter, parameters)}")
        if not np.linalg.norm(self.at) > 0.0:
            raise CalibrationError("dipole: at: expected a place away from the sensor")

    def expand(self, parameters: tuple[Parameter, ...]) -> Expansion:
        """Return the dipole as a power series in its scaled parameter; CalibrationError: too near for one."""
        names = [parameter.name for parameter in parameters]
        k = names.index(self.parameter)
        parameter = parameters[k]
        # Places of the mass at the Chebyshev nodes of the travel.
        p = parameter.centre + parameter.scale * chebyshev.chebpts1(4 * SERIES_ORDER)
        r = np.array(self.at) + p[:, None] * np.array(self.travel)
        if np.linalg.norm(r, axis=1).min() < 3.0 * parameter.scale * np.linalg.norm(self.travel):
            raise CalibrationError(
                f"dipole on {self.parameter!r}: passes the sensor within three half-travels; "
                "no series stands for it there"
            )
        r_0 = float(np.linalg.norm(self.at))
        columns = dipole_columns(r, np.array(self.moment), np.array(self.induced), r_0)
        exponents = tuple(
            tuple(power if i == k else 0 for i in range(len(names))) for power in range(SERIES_ORDER + 1)
        )
        return Expansion(exponents, expand_dipole(columns, SERIES_ORDER))
