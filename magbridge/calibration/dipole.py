"""Field of a dipole that travels along a line, as a power series in its position.

Notes
-----
A mass at ``r(p) = r_0 + t p`` from the sensor has a permanent moment m and susceptibilities chi along the
body's axes. It changes the field at the sensor as follows (r-hat is the unit vector; Blakely 1995, eq. 4.14;
m includes mu_0/4pi)::

    G(r) = (3 r-hat r-hat^T - I) / |r|^3,   T += G(r) m,   H -> (I + G(r) chi) H

To first order, A therefore decreases by the symmetric part of ``G(r) chi``. The second order, ``(G chi)^2``,
depends on p alone, so a polynomial can represent it. Moments are given as the field that they cause at the
sensor, in nT: ``m / |r_0|^3`` and ``chi F_0 / |r_0|^3``. If the travel is short compared with the distance,
the power series of G in p converges fast.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import PAIRS


def dipole_tensor(r: FloatArray) -> FloatArray:
    """Return the tensor ``G(r)`` of dipoles at positions `r` (..., 3), m, from the sensor.

    Returns (..., 3, 3), m^-3: ``G m`` is the field (nT) of a moment m (nT m³, mu_0/4pi included).
    """
    # G(r) = (3 u u^T - I) / r^3 with u = r / |r|
    distance = np.linalg.norm(r, axis=-1)[..., None, None]
    unit = r[..., :, None] / distance
    return np.asarray((3.0 * unit * np.swapaxes(unit, -1, -2) - np.eye(3)) / distance**3)


def dipole_columns(r: FloatArray, moment: FloatArray, induced: FloatArray, r_0: float) -> FloatArray:
    """Return the contribution of one unit of each dipole coefficient to the nine slots of A and T.

    `r` (n, 3): position of the mass from the sensor, m. `moment`, `induced` (3,): moments about which the
    displacement is linearised, as a field at the sensor, nT. `r_0`: distance to which these fields refer, m.
    Returns (9, n, 9): moment x, y, z; induced x, y, z; displacement x, y, z (nT per m).
    """
    columns = np.zeros((9, len(r), 9))

    def put(rows: FloatArray, G: FloatArray, moments: FloatArray, chi: FloatArray) -> None:
        # Permanent moment: T = G m. Induced moment: H_r = B + G diag(chi) B, so a = -G diag(chi).
        rows[:, 6:] = G @ moments
        pulled = G * chi  # G diag(chi); only the symmetric part of A changes the magnitude
        rows[:, :6] = np.stack([-0.5 * (pulled[:, i, j] + pulled[:, j, i]) for i, j in PAIRS], axis=1)

    G = dipole_tensor(r) * r_0**3
    nothing = np.zeros(3)
    for k, axis in enumerate(np.eye(3)):
        put(columns[k], G, axis, nothing)
        put(columns[3 + k], G, nothing, axis)
        h = 1e-5 * r_0 * axis  # a symmetric difference over 1e-5 of the distance has an error of 1e-10
        slope = (dipole_tensor(r + h) - dipole_tensor(r - h)) * r_0**3 / (2e-5 * r_0)
        put(columns[6 + k], slope, moment, induced)
    return columns


def expand_dipole(values: FloatArray, order: int) -> FloatArray:
    """Return power series coefficients (..., order + 1, s) of functions sampled at Chebyshev nodes.

    `values` (..., n, s): the s functions at the n nodes of ``chebpts1`` in [-1, 1], ascending; n > order.
    `order`: the highest power.
    """
    # least squares at these nodes is the truncated Chebyshev series
    nodes = chebyshev.chebpts1(values.shape[-2])
    return np.asarray(np.linalg.pinv(np.vander(nodes, order + 1, increasing=True)) @ values)
