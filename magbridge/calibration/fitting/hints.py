"""What a fit suggests was not declared: a column that moves the field."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Calibration

__all__ = ["undeclared", "worths"]

PARTS, BLOCKS = 8, 32
"""Parts of a log, of which each is left out in turn; and the blocks of neighbours that they are dealt. A mass
that nearly always moves with a declared one is known only by a few: no part may have them all."""
BETTER = 0.8
"""Share of the residual that must be left on the parts left out, for a column to be named."""
LEAST = 2.0
"""nT, below which nothing is said."""
NAMED = 3
"""Columns that are named at most, each beside those before it: what only resembles a mass is not a second."""
WORTHY = 0.5
"""Share of the first one's worth that another must have: a mass's higher powers leave what anything fits."""


def undeclared(calibration: Calibration, data: Observations, columns: Mapping[str, FloatArray]) -> list[str]:
    """Return a line for each column that explains the residual of a fit although it is no parameter of it.

    Parameters
    ----------
    calibration : Calibration
        Fitted to `data`.
    data : Observations
        Whose sensor's channels are exactly the calibration's parameters.
    columns : mapping of str to (n,) array
        Telemetry at the samples of `data`.

    Notes
    -----
    A mass at c adds a field ``d(c)`` to the vector, and ``d(c) . u`` to the total field, u its direction: the
    residual is regressed on ``u, c u, c^2 u`` beside the same of each declared parameter, which without c
    may have taken some of its part; what c adds is measured on parts left out.
    """
    lines: list[str] = []
    conditional_on: tuple[str, ...] = ()
    first = 0.0
    while len(conditional_on) < NAMED and (
        found := worths(calibration, data, columns, conditional_on=conditional_on)
    ):
        name = max(found, key=lambda one: found[one])
        if found[name] < WORTHY * first:
            break
        first = first or found[name]
        conditional_on = (*conditional_on, name)
        lines.append(
            f"column {name!r} is not declared and moves the field, by about {found[name]:.0f} nT here: "
            f"--parameter {name}"
        )
    return lines


def worths(
    calibration: Calibration,
    data: Observations,
    columns: Mapping[str, FloatArray],
    better: float = BETTER,
    conditional_on: tuple[str, ...] = (),
) -> dict[str, float]:
    """Return what each column (n,) explains of a residual on parts left out, nT; see :func:`undeclared`.

    `columns` are (n,), at the n samples. Those that leave more than the share `better` of it are left out,
    and so are those that the others are `conditional_on`.
    """
    if set(calibration.channels) != set(data.names) or len(data) < 10 * PARTS:
        return {}
    corrected = correct(calibration, data.field, data.parameters, data.time)
    residual = corrected.total - data.reference
    direction = corrected.vector / corrected.total[:, None]
    found: dict[str, float] = {}
    for name, column in columns.items():
        known = np.isfinite(column) & np.isfinite(residual)
        c = column[known]
        if name in conditional_on or known.sum() < 10 * PARTS or not np.ptp(c) > 0.0:
            continue
        declared = [_moved(one, direction[known], 3) for one in data.parameters[known].T]
        given = [_moved(np.nan_to_num(columns[one][known]), direction[known], 2) for one in conditional_on]
        plain = np.column_stack([direction[known], np.ones(len(c)), *declared, *given])
        without = _left_out(plain, residual[known])
        # a mass that was in two places has no second power to tell
        powers = (np.column_stack([plain, _moved(c, direction[known], order)]) for order in (1, 2))
        left = min(_left_out(design, residual[known]) for design in powers)
        worth = float(np.sqrt(max(without**2 - left**2, 0.0)))
        if left < better * without and worth > LEAST:
            found[name] = worth
    return found


def _moved(c: FloatArray, direction: FloatArray, order: int) -> FloatArray:
    """Return powers of positions c (n,), scaled to -1 to 1, times the field's direction (n, 3)."""
    c = (c - c.min()) / (0.5 * np.ptp(c) or 1.0) - 1.0
    return np.column_stack([(c**k)[:, None] * direction for k in range(1, order + 1)])


def _left_out(design: FloatArray, residual: FloatArray) -> float:
    """Return the RMS of (n,) `residual` less what (n, m) `design` explains of it, on parts left out."""
    part = np.arange(len(residual)) * BLOCKS // len(residual) % PARTS
    rest = residual.copy()
    for k in range(PARTS):
        out = part == k
        solution, *_ = np.linalg.lstsq(design[~out], residual[~out], rcond=None)
        rest[out] -= design[out] @ solution
    return float(np.sqrt(np.mean(rest**2)))
