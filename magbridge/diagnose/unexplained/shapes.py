"""The functions of which descriptions without a name are made, and their prior widths.

Arguments are histories of the log's n samples, (n,) or (n, 3); the result is a block of columns,
(m, k) of m rows: :mod:`magbridge.diagnose.compare.design_columns`. Whole histories of a long log fill the
memory: what can be computed row by row is not kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import lagged, powers
from magbridge.calibration.memory_effects import play
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import pieces

__all__ = [
    "bends", "crossing", "curve", "delayed", "direction", "hysteresis", "lower_end", "near_surface",
    "repeated", "response", "spectra", "swings",
]  # fmt: skip

BEND = 32
"""Order of the polynomials of an axis' response: fine enough for a converter's coarsest steps."""
PLAYS = (0.3, 0.8)
"""Widths of the play operators that describe a channel's past, in half ranges."""
HULL_LAGS_S = (0.0, 300.0, 1000.0, 3000.0, 10000.0)
"""s, lags with which the inside of a hull follows: heat, water that seeps, stress that relaxes."""
SWAYS = (0.0, 10.0, 30.0)
"""s, lags with which something loose, or on a line, follows a turn."""
SKIN = (5.0, 20.0)
"""m, depths over which light, warmth and waves fade."""
REPEATED = 8
"""Half waves per dive of what repeats with every dive."""
ZERO = (500.0, 1000.0, 2000.0)
"""Widths, nT, of errors where an axis reads zero."""
JACOBIAN = (0.0, 0.1, 0.2)
"""Sines of the angles at which a loose object in the hull starts to slide."""


def spectra(count: int, axes: int) -> tuple[tuple[str, FloatArray], ...]:
    """Prior widths of half waves for an exponential correlation (relaxation, switching), by kind.

    The k-th has ``1 / sqrt(1 + (k / k_0)^2)``, k_0 the corner of the kind.
    """
    k = np.repeat(np.arange(1, count + 1), axes)
    corners = {"drift": 1.0, "switching": 8.0}
    return tuple((kind, 10.0 / np.sqrt(1.0 + (k / corner) ** 2)) for kind, corner in corners.items())


def direction(body: Columns) -> Columns:
    """Functions up to quartic of the field's direction in the body, that of `body` (m, 3)."""
    exponents = [(i, j, d - i - j) for d in (1, 2, 3, 4) for i in range(d + 1) for j in range(d + 1 - i)]

    def columns(rows: slice) -> FloatArray:
        part = body(rows)
        part = (part / np.linalg.norm(part, axis=1)[:, None]).T
        table = np.stack([np.ones(part.shape), *powers(part, 4)])
        return np.stack([table[i, 0] * table[j, 1] * table[k, 2] for i, j, k in exponents]).T

    return columns


def response(reading: FloatArray, jacobian: Columns) -> Columns:
    """Each axis' error as any smooth function of its own reading (n, 3): Chebyshev polynomials.

    `jacobian` (m, 3) are what one nT in each axis adds to the residual.
    """
    axes = [_scaled(axis) for axis in reading.T]

    def columns(rows: slice) -> FloatArray:
        x = np.clip([axis(rows) for axis in axes], -1.0, 1.0)
        turning = x + 1j * np.sqrt(1.0 - x**2)  # cos k theta = T_k(x), with x = cos theta
        waves = np.stack(powers(turning, BEND), 1).real
        return np.asarray((jacobian(rows).T[:, None] * waves).reshape(3 * BEND, -1).T)

    return columns


def bends() -> tuple[tuple[str, FloatArray], ...]:
    """Prior widths (3 BEND,) of a response's polynomials: of one with steps, with a corner, or smooth."""
    k = np.arange(1.0, BEND + 1.0)
    return tuple(
        ("broadband", np.tile(30.0 / width, 3)) for width in (np.sqrt(1.0 + (k / 8.0) ** 2), k**2, k**3)
    )


def crossing(reading: FloatArray, jacobian: Columns) -> Columns:
    """Each axis' error where it passes zero (Hermite's functions); arguments as of :func:`response`.

    There the feedback current changes sign, or a converter's first bit flips.
    """

    def columns(rows: slice) -> FloatArray:
        x = reading[rows].T[:, None] / np.array(ZERO)[:, None]
        odd = x * np.exp(-0.5 * x * x)
        return np.asarray((jacobian(rows).T[:, None] * odd).reshape(3 * len(ZERO), -1).T)

    return columns


def curve(values: FloatArray) -> Columns:
    """Powers of a channel (n,)."""
    y = _scaled(values)
    return _centred(lambda rows: np.stack(powers(y(rows), 4)).T, len(values))


def hysteresis(values: FloatArray) -> Columns:
    """Functions of a channel's past (n,): curved branches of hysteresis, narrow and wide; its direction."""
    scaled = _scaled(values)
    y = scaled(slice(None))
    plays = [play(y, width) for width in PLAYS]
    change = np.diff(y, prepend=y[0])
    way = np.where(np.abs(change) > 1e-3, np.sign(change), 0.0).astype(np.int8)

    def columns(rows: slice) -> FloatArray:
        v, w = scaled(rows), way[rows]
        branches = [np.stack(powers(x[rows], 3)) - np.stack(powers(v, 3)) for x in plays]
        return np.concatenate([*branches, [w, w * v]]).T

    return _centred(columns, len(values))


def delayed(time: FloatArray, values: FloatArray) -> Columns:
    """Return a channel (n,) with each of :data:`HULL_LAGS_S`: mixed, they make any smooth response to it."""
    return _centred(_followed(time, _scaled(values)(slice(None))[None], HULL_LAGS_S), len(values))


def swings(time: FloatArray, rate: FloatArray) -> Columns:
    """Return functions of a turn's rate (n,), with lags: the rate; its square, the same to either side."""
    low, high = np.quantile(rate, (0.001, 0.999))  # a jump of the telemetry is not a turn
    y = np.clip(rate, low, high) / max(high, -low, 1e-12)
    swung = _followed(time, y[None], SWAYS)
    return _centred(lambda rows: np.reshape(powers(swung(rows).T, 2), (2 * len(SWAYS), -1)).T, len(rate))


def near_surface(time: FloatArray, depth: FloatArray) -> Columns:
    """Return effects of the surface that fade with depth (n,), m, and, with lags, afterwards."""
    near = np.exp(-(depth - depth.min()) / np.array(SKIN)[:, None])
    return _centred(_followed(time, near, HULL_LAGS_S[:-1]), len(depth))


def repeated(problem: Problem) -> Columns:
    """Half waves in the course of a dive, the same in all."""
    dive, time = problem.survey.dive, problem.survey.time
    start = np.flatnonzero(np.diff(dive, prepend=dive[0] - 1))
    since = time - np.repeat(time[start], np.diff([*start, len(dive)]))
    # the median: a long last dive must not stretch the others
    usual = max(float(np.median([since[end - 1] for end in [*start[1:], len(dive)]])), 1.0)
    u = np.minimum(since / usual, 1.0)
    return _centred(lambda rows: np.stack(powers(np.exp(1j * np.pi * u[rows]), REPEATED)).real.T, len(u))


def lower_end(down: FloatArray) -> Columns:
    """Return the end of the hull at which a loose object lies: the lower one, once tilted by so much.

    `down` (n,) is the sine of the tilt; :data:`JACOBIAN` are those at which it starts to slide.
    """
    place = np.arange(len(down))
    sides = []
    for slope in JACOBIAN:
        last = np.maximum.accumulate(np.where(np.abs(down) > slope, place, 0))
        sides.append(np.sign(down[last]).astype(np.int8))
    return _centred(lambda rows: np.stack([side[rows] for side in sides]).T.astype(float), len(down))


def _followed(time: FloatArray, values: FloatArray, lags: Sequence[float]) -> Columns:
    """Each of `values` (k, n) with each lag; in single precision, since of a month they fill the memory."""
    followed = np.stack([lagged(time, y, lag).astype(np.float32) for y in values for lag in lags])
    return lambda rows: followed[:, rows].T.astype(float)


def _centred(columns: Columns, n: int) -> Columns:
    mean = sum(columns(rows).sum(axis=0) for rows in pieces(n)) / n
    return lambda rows: columns(rows) - mean


def _scaled(values: FloatArray) -> Columns:
    """Values (n,) moved to the range -1 to 1, (m,) of m rows."""
    low, span = values.min(), max(float(np.ptp(values)), 1e-12)
    return lambda rows: np.asarray(2.0 * (values[rows] - low) / span - 1.0)
