"""What a fit suggests was not declared: a column that moves the field."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Calibration

__all__ = ["undeclared", "worths"]

PARTS = 8
"""Parts of a log, of which each is left out in turn."""
BETTER = 0.8
"""Share of the residual that must be left on the parts left out, for a column to be named."""
LEAST = 2.0
"""nT, below which nothing is said."""


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
    found = worths(calibration, data, columns)
    strongest = sorted(found, key=lambda name: -found[name])[:3]
    return [
        f"column {name!r} is not declared and moves the field, by about {found[name]:.0f} nT here: "
        f"--parameter {name}"
        for name in strongest
    ]


def worths(
    calibration: Calibration, data: Observations, columns: Mapping[str, FloatArray], better: float = BETTER
) -> dict[str, float]:
    """Return what each column explains of a fit's residual on parts left out, nT; see :func:`undeclared`.

    Columns that leave more than the share `better` of it are left out.
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
        if known.sum() < 10 * PARTS or not np.ptp(c) > 0.0:
            continue
        declared = [_moved(one, direction[known], 3) for one in data.parameters[known].T]
        plain = np.column_stack([direction[known], np.ones(len(c)), *declared])
        without = _left_out(plain, residual[known])
        left = _left_out(np.column_stack([plain, _moved(c, direction[known], 2)]), residual[known])
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
    part = np.arange(len(residual)) * PARTS // len(residual)
    rest = residual.copy()
    for k in range(PARTS):
        out = part == k
        solution, *_ = np.linalg.lstsq(design[~out], residual[~out], rcond=None)
        rest[out] -= design[out] @ solution
    return float(np.sqrt(np.mean(rest**2)))
