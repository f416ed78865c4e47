"""Export a calibration as compass parameters of ArduPilot and PX4, as far as their models allow.

Both correct by a symmetric matrix and an offset, and by a vector times the battery's current::

    ArduPilot  b = M (h + OFS) + MOT I                      mG, mG/A
    PX4        b = M (h + COMP I - OFF)                     G, G/kA

Ours is ``b = R A(x) (h - T(x))``. So ``M = A``, ``OFS = -T``; a parameter in ampere whose field is linear
gives ``MOT = -A dT/dI``. The autopilot cannot represent moving masses, effects, and the boresight R; the
export reports the resulting error.

References
----------
ArduPilot, AP_Compass_Backend::correct_field; PX4, sensor_calibration/Magnetometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Calibration
from magbridge.columns import NT_PER_UNIT, usual

__all__ = ["Compass", "ardupilot", "compass_of", "matrix_and_offset", "px4"]

AUTOPILOT_AXES = "X", "Y", "Z"
OFF = (0, 1), (0, 2), (1, 2)
FLOAT, INTEGER = 9, 6
"""MAV_PARAM_TYPE of a QGroundControl parameter file."""
MAX_OFFSET_MG = 1_800.0
"""mG: ArduPilot refuses to arm with longer offsets (COMPASS_OFFS_MAX)."""


@dataclass(frozen=True)
class Compass:
    """The part of a calibration that an autopilot's compass model can represent."""

    matrix: FloatArray
    """(3, 3): Symmetric."""
    offset: FloatArray
    """(3,), nT, T at the middle of each parameter's range, at no current."""
    current: FloatArray | None
    """(3,), nT/A, dT/dI."""
    lost: tuple[str, ...]
    """Parts of the calibration that the format cannot represent, with the resulting error."""


def compass_of(calibration: Calibration) -> Compass:
    """Return the part of a calibration that an autopilot's compass model can represent."""
    kernel = calibration.kernel
    currents = [k for k, one in enumerate(calibration.parameters) if usual(one.unit) == "A"][:1]
    # expand about the middle of each range, and about no current: T(I) = T + I dT/dI
    middle = np.array([0.5 * (one.low + one.high) for one in calibration.parameters])
    middle[currents] = 0.0
    matrix, offset = matrix_and_offset(calibration, middle)
    current = None
    if currents:
        step = np.zeros(len(middle))
        step[currents] = 1.0
        current = matrix_and_offset(calibration, middle + step)[1] - offset
    lost = []
    # the error of that expansion is largest at the corners of the ranges
    corners = product(*((one.low, one.high) for one in calibration.parameters))
    field = kernel.field * np.eye(3)
    worst = 0.0
    for corner in corners:
        there, shift = matrix_and_offset(calibration, np.array(corner))
        held = offset + (current * corner[currents[0]] if current is not None else 0.0)
        worst = max(worst, float(np.linalg.norm(shift - held) + np.linalg.norm((there - matrix) @ field, 2)))
    if worst > 1.0:
        names = ", ".join(one.name for k, one in enumerate(calibration.parameters) if k not in currents)
        what = f"the field of {names or 'the current beyond its first order'}"
        lost.append(f"{what}: up to {worst:.0f} nT at the ends of its range")
    lost += [f"an effect: {type(one).__name__}" for one in calibration.effects]
    if calibration.boresight is not None:
        angle = float(np.degrees(np.linalg.norm(calibration.boresight.rotation)))
        lost.append(f"the boresight, a turn of {angle:.1f} deg: set the compass' orientation")
    lost.append("uncertainties and flags")
    return Compass(matrix, offset, current, tuple(lost))


def matrix_and_offset(calibration: Calibration, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return A (3, 3) and T (3,), nT, at the parameters' values."""
    kernel = calibration.kernel
    phi = np.array(kernel.monomials(values.tolist(), 1.0))
    xx, yy, zz, xy, xz, yz, *shift = phi @ kernel.position_weights
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), np.array(shift)


def ardupilot(compass: Compass, number: int = 0) -> tuple[str, list[str]]:
    """Return the text of a ``.param`` file for compass `number` (from 0), and warnings."""
    mG = NT_PER_UNIT["mG"]
    n = "" if number == 0 else str(number + 1)
    # ArduPilot: corrected = ODI (raw + OFS) + MOT I, in mG
    offset = -compass.offset / mG
    values = {f"COMPASS_OFS{n}_{axis}": offset[k] for k, axis in enumerate(AUTOPILOT_AXES)}
    values |= {f"COMPASS_DIA{n}_{axis}": compass.matrix[k, k] for k, axis in enumerate(AUTOPILOT_AXES)}
    values |= {
        f"COMPASS_ODI{n}_{axis}": compass.matrix[pair] for axis, pair in zip(AUTOPILOT_AXES, OFF, strict=True)
    }
    values[f"COMPASS_SCALE{n}"] = 1.0
    if compass.current is not None:
        # the current is compensated after the matrix
        motor = -(compass.matrix @ compass.current) / mG
        values |= {"COMPASS_MOTCT": 2.0} | {
            f"COMPASS_MOT{n}_{axis}": motor[k] for k, axis in enumerate(AUTOPILOT_AXES)
        }
    text = "".join(f"{name},{float(value):.9g}\n" for name, value in values.items())
    length = float(np.linalg.norm(offset))
    long = [
        f"offsets of {length:.0f} mG: ArduPilot does not arm beyond COMPASS_OFFS_MAX, {MAX_OFFSET_MG:.0f}"
    ]
    return text, long if length > MAX_OFFSET_MG else []


def px4(compass: Compass, number: int = 0) -> str:
    """Return the text of a QGroundControl parameter file for PX4's compass `number` (from 0)."""
    G = NT_PER_UNIT["G"]
    # PX4: corrected = SCALE (raw - OFF), in G; the current in kA
    values = {f"CAL_MAG{number}_{axis}OFF": compass.offset[k] / G for k, axis in enumerate(AUTOPILOT_AXES)}
    values |= {f"CAL_MAG{number}_{axis}SCALE": compass.matrix[k, k] for k, axis in enumerate(AUTOPILOT_AXES)}
    values |= {
        f"CAL_MAG{number}_{axis}ODIAG": compass.matrix[pair]
        for axis, pair in zip(AUTOPILOT_AXES, OFF, strict=True)
    }
    lines = ["# Vehicle-Id Component-Id Name Value Type"]
    if compass.current is not None:
        values |= {
            f"CAL_MAG{number}_{axis}COMP": -1e3 * compass.current[k] / G
            for k, axis in enumerate(AUTOPILOT_AXES)
        }
        lines.append(f"1\t1\tCAL_MAG_COMP_TYP\t2\t{INTEGER}")
    lines += [f"1\t1\t{name}\t{float(value):.9g}\t{FLOAT}" for name, value in values.items()]
    return "\n".join(lines) + "\n"
