"""Columns of a log that change the field: suggestions of a fit, and useful parameters.

The columns are added one by one: first the one which explains most of the residual of the fit so far, as long
as a fit with it predicts held-out parts better, and the later parts of the log from the earlier ones. A
drone's motors move its field in proportion to their currents, and its log holds battery and motor currents,
throttles and servos, most of which are collinear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.errors import CalibrationError

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.field.grid import AnomalyGrid

# ---- Columns that a fit suggests ----

PARTS, BLOCKS = 8, 32
"""Number of parts of a log, of which each is left out in turn, and of blocks of neighbours that they get: no
part may have all motions of a mass that rarely moves alone."""
MAX_REMAINING_FRACTION = 0.8
"""Fraction of the residual left on held-out parts, at most, for a column to be named."""
MIN_IMPROVEMENT_NT = 2.0
"""Least improvement that is reported, nT."""
MAX_REPORTED_COLUMNS = 3
"""Largest number of reported columns, each given the previous ones."""
WORTHY = 0.5
"""Improvement by a further column, as a fraction of the first one's, from which on it is reported."""


def undeclared(calibration: Calibration, data: Observations, columns: Mapping[str, FloatArray]) -> list[str]:
    """Return a line for each column that explains the residual of a fit without being its parameter.

    `data`: of the fit. `columns` (n,): telemetry at the samples of `data`.

    Notes ----- A mass at c adds a field ``d(c)`` to the vector, and ``d(c) . u`` to the total field, u its
    direction: the residual is regressed on ``u, c u, c^2 u`` and the same functions of each declared
    parameter, which may have absorbed part of it without c; the improvement by c is measured on held-out
    parts.
    """
    lines: list[str] = []
    conditional_on: tuple[str, ...] = ()
    first = 0.0
    while len(conditional_on) < MAX_REPORTED_COLUMNS and (
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
    better: float = MAX_REMAINING_FRACTION,
    conditional_on: tuple[str, ...] = (),
) -> dict[str, float]:
    """Return the reduction (nT) of a residual on held-out parts by each column (n,); see :func:`undeclared`.

    Omitted are columns that leave more than the fraction `better` of it, and those of `conditional_on`, which
    explain their part first.
    """
    if set(calibration.channels) != set(data.names) or len(data) < 10 * PARTS:
        return {}
    # regress the residual on u, c u, c^2 u with and without the column, and compare held-out errors
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
        if left < better * without and worth > MIN_IMPROVEMENT_NT:
            found[name] = worth
    return found


def _moved(c: FloatArray, direction: FloatArray, order: int) -> FloatArray:
    """Return powers of positions c (n,), scaled to -1 to 1, times the field's direction (n, 3)."""
    c = (c - c.min()) / (0.5 * np.ptp(c) or 1.0) - 1.0
    return np.column_stack([(c**k)[:, None] * direction for k in range(1, order + 1)])


def _left_out(design: FloatArray, residual: FloatArray) -> float:
    """Return the RMS of `residual` (n,) after subtracting the fit of `design` (n, m), on held-out parts."""
    part = np.arange(len(residual)) * BLOCKS // len(residual) % PARTS
    rest = residual.copy()
    for k in range(PARTS):
        out = part == k
        solution, *_ = np.linalg.lstsq(design[~out], residual[~out], rcond=None)
        rest[out] -= design[out] @ solution
    return float(np.sqrt(np.mean(rest**2)))


# ---- Columns that are worth being parameters ----

AUTO = "auto"
"""``--parameter auto``."""
MAX_PARAMETERS = 3
"""Largest number of parameters: each of several currents is in part the sum of the others."""
FAILURES = 2
"""Number of rejected columns in a row after which no more are tried."""
MAX_HELD_OUT_ERROR_RATIO = 0.95
"""Fraction of the error on held-out parts that a useful column may leave."""
SCREENING_SAMPLES = 20_000
"""Largest number of samples with which columns are chosen."""
USUAL_DEPARTURE = 0.15
"""Departure of a scale from 1 that sensors have. A parameter must not move the scales beyond it and further
away: it moved with the attitude then, and its coefficients have absorbed that."""
HINTED = 0.98
"""Fraction of the residual that may be left, for a column to be tried."""


@dataclass(frozen=True)
class Offer:
    """A column that was tried as a parameter."""

    name: str
    without: float
    left_out: float
    """`without`, `left_out`: RMS on held-out parts without it, and with it, nT."""
    taken: bool


def best_parameters(
    deployment: xr.Dataset, offered: Sequence[str], *, grid: AnomalyGrid | None = None, **options: Any
) -> tuple[tuple[str, ...], list[Offer]]:
    """Return the columns to use as parameters, and the improvement of each that was tried.

    `offered`: columns that may move the field. `grid`: added to the IGRF. `options`: of :func:`~.fit.fit`.

    CalibrationError: the data do not support a fit without parameters.
    """

    def screened(names: tuple[str, ...]) -> Observations:
        return observations(deployment, names, grid=grid).thinned(SCREENING_SAMPLES)

    taken: tuple[str, ...] = ()
    found = fit(screened(taken), **options)
    offers: list[Offer] = []
    failures = 0
    # Forward selection: offer the column that explains most of the residual; keep it if a new fit predicts
    # held-out parts better, both those between others and the later ones.
    while len(taken) < MAX_PARAMETERS and failures < FAILURES:
        data = screened(taken)
        rows = np.searchsorted(deployment["time"].to_numpy(), data.time)
        tried = {one.name for one in offers}
        columns = {name: deployment[name].to_numpy()[rows] for name in offered if name not in tried}
        explained = worths(found.calibration, data, columns, HINTED)
        name = max(explained, key=explained.__getitem__, default=None)
        if name is None:
            break
        without = float(found.details["left_out_nT"])
        try:
            further = fit(screened((*taken, name)), **options)
        except CalibrationError:  # a position that cannot be, or too few samples that have it
            offers.append(Offer(name, without, np.inf, taken=False))
            failures += 1
            continue
        left = float(further.details["left_out_nT"])
        worth_it = left < MAX_HELD_OUT_ERROR_RATIO * without and bool(further.calibration.channels)
        # a parameter must carry to later parts of the log as well
        if {"forward_nT"} <= found.details.keys() & further.details.keys():
            forward = further.details["forward_nT"] / found.details["forward_nT"]
            worth_it = worth_it and forward < MAX_HELD_OUT_ERROR_RATIO
        # a parameter that moves with the attitude absorbs it, and bends the scales instead
        worth_it = worth_it and _departure(further) <= max(_departure(found), USUAL_DEPARTURE)
        offers.append(Offer(name, without, left, worth_it))
        if worth_it:
            found, taken, failures = further, (*taken, name), 0
        else:
            failures += 1
    return taken, offers


def _departure(found: Fit) -> float:
    """Return the largest departure of a scale from 1."""
    return max(abs(scale - 1.0) for scale in found.scales)


def lines(offers: Sequence[Offer]) -> list[str]:
    """Return a line for each column that was tried, with its improvement on held-out parts."""
    return [
        f"--parameter {one.name}: {one.without:.0f} nT on parts left out without it, "
        f"{one.left_out:.0f} with it: {'taken' if one.taken else 'not worth it'}"
        for one in offers
    ]
