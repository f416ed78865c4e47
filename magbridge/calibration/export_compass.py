"""Export the part of a calibration that ArduPilot, PX4 or a Seaglider can represent as compass parameters.

The autopilots correct with a symmetric matrix, an offset, and a vector times the battery's current::

    ArduPilot  b = M (h + OFS) + MOT I                      mG, mG/A
    PX4        b = M (h + COMP I - OFF)                     G, G/kA

magbridge corrects with ``b = R A(x) (h - T(x))``. So ``M = A`` and ``OFS = -T``, and a parameter in ampere
gives ``MOT = -A dT/dI``, where T is the best straight line over the calibrated range of the current. The
autopilot cannot represent moving masses, curved T(I), effects and the boresight R; the export reports it.

A Seaglider corrects counts of its compass in axes with y and z reversed, and levels the result with roll and
pitch::

    m = (x, -y, -z),    p = soft (m - hard),    psi = atan2(p_y', p_x')

With ``S = diag(1, -1, -1)`` and c nT per count, ``hard = S T / c`` and ``soft = S R A S`` give the heading of
magbridge at the middle of each parameter's range. :func:`heading_cost` computes the heading error elsewhere.

References
----------
iop-apl-uw/basestation3, BaseMagCal.py (``compassTransform``) and Magcal.py (``hard0`` and ``soft0``).
ArduPilot, AP_Compass_Backend::correct_field; PX4, sensor_calibration/Magnetometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct, forward
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.heading import heading
from magbridge.calibration.model import Calibration
from magbridge.columns import NT_PER_UNIT, usual
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms

OFF = np.array([0, 0, 1]), np.array([1, 2, 2])
"""Rows and columns of the entries of a symmetric matrix off its diagonal."""
FLOAT, INTEGER = 9, 6
"""Values of MAV_PARAM_TYPE in a QGroundControl parameter file: REAL32 and INT32."""
RANGE_POINTS = 41
"""Number of currents at which the straight line is fitted."""
MAX_OFFSET_MG = 1_800.0
"""Largest length of the offset with which ArduPilot arms (COMPASS_OFFS_MAX), mG."""


@dataclass(frozen=True)
class Compass:
    """Part of a calibration that an autopilot's compass model can represent."""

    matrix: FloatArray
    """(3, 3): Symmetric matrix A at the middle of each parameter's range, averaged over the current's."""
    offset: FloatArray
    """(3,): T at the middle of each parameter's range, by its straight line at zero current, nT."""
    current: FloatArray | None
    """(3,): Slope dT/dI of the straight line, nT/A; None if no parameter is a current."""
    lost: tuple[str, ...]
    """Description of each part that the format cannot represent, with the resulting error if it is known."""


def compass_of(calibration: Calibration) -> Compass:
    """Return the part of a calibration that an autopilot's compass model can represent."""
    currents = [k for k, one in enumerate(calibration.parameters) if usual(one.unit) == "A"][:1]
    # T(I) = T + I dT/dI, the best line over the calibrated range: the tangent at no current would extrapolate
    along = np.tile(_middle(calibration), (RANGE_POINTS, 1))
    for k in currents:
        along[:, k] = np.linspace(calibration.parameters[k].low, calibration.parameters[k].high, RANGE_POINTS)
    A, T = calibration.matrices(along)
    matrix = A.mean(axis=0)
    columns = np.column_stack([np.ones(RANGE_POINTS), along[:, currents]])
    offset, *slopes = np.linalg.lstsq(columns, T, rcond=None)[0]
    lost = []
    # the error of this line, along the current and at the ends of the other ranges
    ranges = (
        np.linspace(one.low, one.high, RANGE_POINTS if k in currents else 2)
        for k, one in enumerate(calibration.parameters)
    )
    points = np.array(list(product(*ranges)))
    A, T = calibration.matrices(points)
    held = offset + points[:, currents] @ np.reshape(slopes, (-1, 3))
    field = calibration.reference.field * (A - matrix)
    worst = float((np.linalg.norm(T - held, axis=1) + np.linalg.norm(field, 2, axis=(1, 2))).max())
    if worst > 1.0:
        names = ", ".join(one.name for k, one in enumerate(calibration.parameters) if k not in currents)
        what = f"the field of {names or 'the current beyond a straight line'}"
        lost.append(f"{what}: up to {worst:.0f} nT in its range")
    lost += [f"an effect: {type(one).__name__}" for one in calibration.effects]
    if calibration.boresight is not None:
        angle = float(np.degrees(np.linalg.norm(calibration.boresight.rotation)))
        lost.append(f"the boresight, a turn of {angle:.1f} deg: set the compass' orientation")
    lost.append("uncertainties and flags")
    return Compass(matrix, offset, slopes[0] if slopes else None, tuple(lost))


def _middle(calibration: Calibration) -> FloatArray:
    """Return the middle of each parameter's range, (k,)."""
    return np.array([0.5 * (one.low + one.high) for one in calibration.parameters])


def _by_axis(pattern: str, values: FloatArray) -> dict[str, float]:
    """Return the parameters of the three axes, whose names follow `pattern`, with their values (3,)."""
    return {pattern.format(axis): value for axis, value in zip("XYZ", values.tolist(), strict=True)}


def ardupilot(compass: Compass, number: int = 0) -> tuple[str, list[str]]:
    """Return the text of an ArduPilot ``.param`` file for compass `number` (from 0), and warnings."""
    mG = NT_PER_UNIT["mG"]
    n = "" if number == 0 else str(number + 1)
    # ArduPilot: corrected = ODI (raw + OFS) + MOT I, in mG
    offset = -compass.offset / mG
    values = _by_axis(f"COMPASS_OFS{n}_{{}}", offset)
    values |= _by_axis(f"COMPASS_DIA{n}_{{}}", np.diag(compass.matrix))
    values |= _by_axis(f"COMPASS_ODI{n}_{{}}", compass.matrix[OFF])
    values[f"COMPASS_SCALE{n}"] = 1.0
    if compass.current is not None:
        # the current is compensated after the matrix
        values["COMPASS_MOTCT"] = 2.0
        values |= _by_axis(f"COMPASS_MOT{n}_{{}}", -(compass.matrix @ compass.current) / mG)
    text = "".join(f"{name},{value:.9g}\n" for name, value in values.items())
    if (length := float(np.linalg.norm(offset))) <= MAX_OFFSET_MG:
        return text, []
    limit = f"ArduPilot does not arm beyond COMPASS_OFFS_MAX, {MAX_OFFSET_MG:.0f}"
    return text, [f"offsets of {length:.0f} mG: {limit}"]


def px4(compass: Compass, number: int = 0) -> str:
    """Return the text of a QGroundControl parameter file for PX4's compass `number` (from 0)."""
    G = NT_PER_UNIT["G"]
    # PX4: corrected = SCALE (raw - OFF), in G; the current in kA
    values = _by_axis(f"CAL_MAG{number}_{{}}OFF", compass.offset / G)
    values |= _by_axis(f"CAL_MAG{number}_{{}}SCALE", np.diag(compass.matrix))
    values |= _by_axis(f"CAL_MAG{number}_{{}}ODIAG", compass.matrix[OFF])
    lines = ["# Vehicle-Id Component-Id Name Value Type"]
    if compass.current is not None:
        values |= _by_axis(f"CAL_MAG{number}_{{}}COMP", -1e3 * compass.current / G)
        lines.append(f"1\t1\tCAL_MAG_COMP_TYP\t2\t{INTEGER}")
    lines += [f"1\t1\t{name}\t{value:.9g}\t{FLOAT}" for name, value in values.items()]
    return "\n".join(lines) + "\n"


TO_SEAGLIDER_AXES = np.diag([1.0, -1.0, -1.0])
"""Matrix S from body axes to the axes of a Seaglider's compass."""
TABLE_POSITIONS = 11
"""Number of positions of the mass in a table."""
PITCHES_DEG = -25.0, 0.0, 25.0
"""Pitch angles of a glider at which heading errors are computed, deg."""
HEADINGS_DEG = np.arange(0.0, 360.0, 15.0)


@dataclass(frozen=True)
class HeadingCost:
    """Heading error of a calibration that ignores the motion of a parameter, or of all parameters."""

    name: str
    """Name of the parameter; empty for all parameters together."""
    rms: float
    largest: float
    """`rms`, `largest`: RMS and largest absolute heading error, deg."""


def rotation(calibration: Calibration) -> FloatArray:
    """Return the rotation matrix (3, 3) of the boresight; CalibrationError: the calibration lacks one."""
    if calibration.boresight is None:
        raise CalibrationError(
            "no boresight: the matrix of a compass needs one; calibrate with roll and pitch in the log, at "
            "several pitch angles"
        )
    return calibration.boresight.matrix()


def seaglider(calibration: Calibration, nT_per_count: float) -> str:
    """Return the text of a Seaglider's ``tcm2mat.cal``; CalibrationError: the boresight is missing."""
    S = TO_SEAGLIDER_AXES
    A, T = calibration.matrices(_middle(calibration)[None])
    hard = S @ T[0] / nT_per_count
    soft = S @ rotation(calibration) @ A[0] @ S
    hard_text = " ".join(f"{value:.1f}" for value in hard)
    soft_text = " ".join(f"{value:.5f}" for value in soft.ravel())
    return f'hard0="{hard_text}"\nsoft0="{soft_text}"\n'


def heading_cost(calibration: Calibration, dip_deg: float) -> list[HeadingCost]:
    """Return the heading error of a constant offset and matrix at the ends of the parameters' ranges.

    In the first entry all parameters are at the ends of their ranges, in each further entry a single
    parameter. `dip_deg`: inclination of the Earth's field, which determines its horizontal part; the error is
    inversely proportional to this part.
    """
    rotation(calibration)  # the error of a missing boresight
    ends: list[tuple[float, ...]] = [(one.low, one.high) for one in calibration.parameters]
    if not ends:
        return []
    cases = [("", ends)]  # all parameters, then each alone with the others at the middle
    if len(ends) > 1:
        fixed = [(middle,) for middle in _middle(calibration).tolist()]
        for k, one in enumerate(calibration.parameters):
            cases.append((one.name, [*fixed[:k], ends[k], *fixed[k + 1 :]]))
    costs = []
    for name, ranges in cases:
        errors = np.concatenate([_errors(calibration, np.array(one), dip_deg) for one in product(*ranges)])
        costs.append(HeadingCost(name, rms(errors), float(np.abs(errors).max())))
    return costs


def _errors(calibration: Calibration, positions: FloatArray, dip_deg: float) -> FloatArray:
    """Return heading errors, deg, at several headings and pitches, with masses at `positions` (k,)."""
    pitch, psi = np.array(list(product(np.radians(PITCHES_DEG), np.radians(HEADINGS_DEG)))).T
    level = np.zeros(len(psi))
    dip = np.radians(dip_deg)
    earth = calibration.reference.field * np.array([np.cos(dip), 0.0, np.sin(dip)])
    body = field_body(np.column_stack([level, pitch, psi]), np.tile(earth, (len(psi), 1)))
    # the sensor's readings in these attitudes, and their correction at the middle of the ranges
    model = calibration.without_effects()
    reading = forward(model, body, np.tile(positions, (len(psi), 1)), level)
    corrected = correct(model, reading, np.tile(_middle(calibration), (len(psi), 1)), level).vector
    found = heading(corrected, 0.0, pitch).magnetic
    return np.asarray((found - np.degrees(psi) + 180.0) % 360.0 - 180.0)


def position_table(calibration: Calibration, parameter: str) -> str:
    """Return a CSV table of offset (nT) and matrix M against one parameter, the others at the middle.

    The corrected field is ``b = M (h - offset)``, body axes. CalibrationError: no parameter or boresight.
    """
    names = [one.name for one in calibration.parameters]
    if parameter not in names:
        raise CalibrationError(f"parameter {parameter!r}: expected one of {', '.join(names) or 'none'}")
    k, R = names.index(parameter), rotation(calibration)
    one = calibration.parameters[k]
    axes = "xyz"
    header = [f"{parameter} [{one.unit or 1}]", *(f"offset_{axis} [nT]" for axis in axes)]
    header += [f"matrix_{row}{column}" for row in axes for column in axes]
    positions = np.tile(_middle(calibration), (TABLE_POSITIONS, 1))
    positions[:, k] = np.linspace(one.low, one.high, TABLE_POSITIONS)
    A, T = calibration.matrices(positions)
    table = np.column_stack([positions[:, k], T, (R @ A).reshape(TABLE_POSITIONS, 9)])
    lines = [",".join(header), *(",".join(f"{value:.9g}" for value in row) for row in table)]
    return "\n".join(lines) + "\n"
