"""A calibration as the compass coefficients of a Seaglider, and as a table by the position of a mass.

The glider corrects counts of its compass by an offset and a matrix, in axes with y and z reversed, and levels
the result with roll and pitch::

    m = (x, -y, -z),    p = soft (m - hard),    psi = atan2(p_y', p_x')

Ours is ``b = R A(x) (h - T(x))``. With ``S = diag(1, -1, -1)`` and c nT in a count, the same heading follows
from ``hard = S T / c`` and ``soft = S R A S``. The file has one offset and one matrix, those at the middle of
each parameter's range: it cannot hold moving masses, effects and uncertainties. :func:`heading_cost`
computes what that costs.

References
----------
iop-apl-uw/basestation3, BaseMagCal.py (``compassTransform``) and Magcal.py (``hard0`` and ``soft0``).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.export_autopilot import matrix_and_offset
from magbridge.calibration.heading import heading
from magbridge.calibration.model import Calibration
from magbridge.errors import CalibrationError

__all__ = ["HeadingCost", "heading_cost", "position_table", "seaglider"]

TO_SEAGLIDER_AXES = np.diag([1.0, -1.0, -1.0])
TABLE_POSITIONS = 11
"""Positions of the mass in a table."""
PITCHES_DEG = -25.0, 0.0, 25.0
"""Pitch angles of a glider at which the cost is computed."""
HEADINGS_DEG = np.arange(0.0, 360.0, 15.0)


@dataclass(frozen=True)
class HeadingCost:
    """Heading error (deg) that omitting a part of the calibration causes."""

    name: str
    """The parameter; empty for all together."""
    rms: float
    largest: float


def middle(calibration: Calibration) -> FloatArray:
    """Return the middle of each parameter's range, (k,)."""
    return np.array([0.5 * (one.low + one.high) for one in calibration.parameters])


def rotation(calibration: Calibration) -> FloatArray:
    """Return the boresight (3, 3); CalibrationError: there is none, and a heading needs one."""
    if calibration.boresight is None:
        raise CalibrationError(
            "no boresight: the matrix of a compass needs one; calibrate with roll and pitch in the log, at "
            "several pitch angles"
        )
    return calibration.boresight.matrix()


def seaglider(calibration: Calibration, nT_per_count: float) -> str:
    """Return the text of a ``tcm2mat.cal``.

    CalibrationError: the calibration has no boresight.
    """
    S = TO_SEAGLIDER_AXES
    A, T = matrix_and_offset(calibration, middle(calibration))
    hard = S @ T / nT_per_count
    soft = S @ rotation(calibration) @ A @ S
    hard_text = " ".join(f"{value:.1f}" for value in hard)
    soft_text = " ".join(f"{value:.5f}" for value in soft.ravel())
    return f'hard0="{hard_text}"\nsoft0="{soft_text}"\n'


def heading_cost(calibration: Calibration, dip_deg: float) -> list[HeadingCost]:
    """Return the heading error due to the moving masses if only one offset and one matrix are used.

    `calibration`: with a boresight. `dip_deg`: deg, inclination of the Earth's field: the error is inversely
    proportional to its horizontal part. Returns: With all parameters at the ends of their ranges; then with
    one at its ends, each.
    """
    ends = [(one.low, one.high) for one in calibration.parameters]
    centre = middle(calibration)
    R = rotation(calibration)
    costs = []
    for k in range(-1, len(ends) if len(ends) > 1 else 0):
        moved = list(product(*ends)) if k < 0 else [_moved_mass(centre, k, end) for end in ends[k]]
        errors = np.concatenate([_errors(calibration, R, np.array(one), dip_deg) for one in moved])
        name = calibration.parameters[k].name if k >= 0 else ""
        costs.append(HeadingCost(name, float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())))
    return costs if ends else []


def _moved_mass(centre: FloatArray, k: int, value: float) -> FloatArray:
    positions = centre.copy()
    positions[k] = value
    return positions


def _errors(calibration: Calibration, R: FloatArray, positions: FloatArray, dip_deg: float) -> FloatArray:
    """Return heading errors (deg), masses at `positions` and corrected as if at the middle."""
    A_0, T_0 = matrix_and_offset(calibration, middle(calibration))
    A, T = matrix_and_offset(calibration, positions)
    F, dip = calibration.reference.field, np.radians(dip_deg)
    errors = []
    for pitch in np.radians(PITCHES_DEG):
        psi = np.radians(HEADINGS_DEG)
        # the Earth's field in level axes, then in body axes of this pitch
        ahead, right = F * np.cos(dip) * np.cos(psi), -F * np.cos(dip) * np.sin(psi)
        down = np.full(len(psi), F * np.sin(dip))
        body = np.stack(
            [
                np.cos(pitch) * ahead - np.sin(pitch) * down,
                right,
                np.sin(pitch) * ahead + np.cos(pitch) * down,
            ],
            axis=1,
        )
        # what the sensor reads there: h = A^-1 R^T b + T
        raw = np.linalg.solve(A, (body @ R).T).T + T
        corrected = (raw - T_0) @ (R @ A_0).T
        found = heading(corrected, 0.0, np.full(len(psi), pitch)).magnetic
        errors.append((found - HEADINGS_DEG + 180.0) % 360.0 - 180.0)
    return np.concatenate(errors)


def position_table(calibration: Calibration, parameter: str) -> str:
    """Return a CSV of offset (nT) and matrix at positions of one mass, the others at the middle.

    ``b = M (h - offset)``, in body axes, x forward, y starboard, z down.

    CalibrationError: the calibration has no such parameter, or no boresight.
    """
    names = [one.name for one in calibration.parameters]
    if parameter not in names:
        raise CalibrationError(f"parameter {parameter!r}: expected one of {', '.join(names) or 'none'}")
    k, R = names.index(parameter), rotation(calibration)
    one = calibration.parameters[k]
    axes = "xyz"
    header = [f"{parameter} [{one.unit or 1}]", *(f"offset_{axis} [nT]" for axis in axes)]
    header += [f"matrix_{row}{column}" for row in axes for column in axes]
    lines = [",".join(header)]
    for position in np.linspace(one.low, one.high, TABLE_POSITIONS):
        A, T = matrix_and_offset(calibration, _moved_mass(middle(calibration), k, position))
        lines.append(",".join(f"{value:.9g}" for value in (position, *T, *(R @ A).ravel())))
    return "\n".join(lines) + "\n"
