"""The paper's view of a calibration: rotation M, scale S, translation T.

Notes
-----
The paper writes ``H_r = H_e^-1 S M H_c + T`` (eq. 2) and inverts it as ``H_c = H_e S^-1 M^-1 (H_r - T)``
(eq. 3). With eq. 2's order M drops out of ``|H_c|``; with eq. 3's the corrected vector is in the
ellipsoid's own axes. ``A = H_e M S^-1 M^T`` is the same ellipsoid and leaves the vector in sensor axes: the
columns of M are the ellipsoid's axes, and S the lengths of its semi-axes (nT) in a field of H_e.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Calibration

__all__ = ["facts", "to_paper"]


def to_paper(A: FloatArray, field: float) -> tuple[FloatArray, FloatArray]:
    """Return rotation M (3, 3) and scale S (3,), nT, of a symmetric positive ``A``; `field` is H_e, nT.

    The axes are ordered and signed so that M is as near to I as possible.
    """
    values, axes = np.linalg.eigh(A)
    order = max(permutations(range(3)), key=lambda p: sum(abs(axes[i, k]) for i, k in enumerate(p)))
    axes, values = axes[:, order], values[list(order)]
    axes = axes * np.where(np.diag(axes) < 0.0, -1.0, 1.0)
    if np.linalg.det(axes) < 0.0:
        axes[:, np.argmin(np.abs(np.diag(axes)))] *= -1.0
    return axes, field / values


def facts(calibration: Calibration) -> dict[str, Any]:
    """Return M, S and T (nT) of the terms, at the middle of each parameter's range, as plain values."""
    middle = {parameter.name: parameter.centre for parameter in calibration.parameters}
    A, T = calibration.matrices(np.array([[*middle.values()]]))
    M, S = to_paper(A[0], calibration.reference.field)
    return {"at": middle, "M": M.tolist(), "S_nT": S.tolist(), "T_nT": T[0].tolist()}
