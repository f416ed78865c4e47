"""Find the columns of a log that change the field, to report them or to use them as parameters.

:func:`best_parameters` adds columns one by one. It first tries the column that explains most of the residual
of the present fit. It keeps the column if a fit with it predicts held-out parts better, and also later parts
of the log from earlier parts. For example, the field of a drone's motors is proportional to their currents,
and its log has currents, throttles and servos, most of which are collinear.
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
"""Number of held-out parts of a log, and number of blocks of successive samples that the parts share. A mass
that rarely moves then moves in several parts."""
MAX_REMAINING_FRACTION = 0.8
"""Largest ratio of held-out errors with and without a column at which the column is reported."""
MIN_IMPROVEMENT_NT = 2.0
"""Smallest improvement that is reported, nT."""
MAX_REPORTED_COLUMNS = 3
"""Largest number of reported columns, each given the previous ones."""
WORTHY = 0.5
"""Smallest improvement by a further column that is reported, as a fraction of the first improvement."""


def undeclared(calibration: Calibration, data: Observations, columns: Mapping[str, FloatArray]) -> list[str]:
    """Return a message for each column that explains the residual of a fit but is not its parameter.

    `data`: samples of the fit. `columns`: telemetry (n,) at these samples, by column name.

    Notes
    -----
    A mass at position c adds a field ``d(c)`` to the vector, and ``d(c) . u`` to the total field, with u the
    field's direction. The residual is regressed on ``u, c u, c^2 u``, and on the same functions of each
    declared parameter, which may have absorbed a part of it. Held-out parts show the improvement by c.
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
    """Return the reduction (nT) of the held-out residual by each useful column, by name.

    The regression is that of :func:`undeclared`. A column is useful if the ratio of held-out errors with and
    without it is below `better`. `conditional_on`: columns that are part of both regressions.
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
        # a mass at two positions does not determine a second power: use the better of both orders
        powers = (np.column_stack([plain, _moved(c, direction[known], order)]) for order in (1, 2))
        left = min(_left_out(design, residual[known]) for design in powers)
        worth = float(np.sqrt(max(without**2 - left**2, 0.0)))
        if left < better * without and worth > MIN_IMPROVEMENT_NT:
            found[name] = worth
    return found


def _moved(c: FloatArray, direction: FloatArray, order: int) -> FloatArray:
    """Return the powers 1 to `order` of c (n,), scaled to [-1, 1], times the direction: (n, 3 order)."""
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
"""Largest number of parameters; more are not useful, because several currents are collinear."""
FAILURES = 2
"""Number of successive rejected columns after which the search ends."""
MAX_HELD_OUT_ERROR_RATIO = 0.95
"""Largest ratio of held-out errors with and without a column at which the column becomes a parameter."""
MAX_PRODUCT_OF_RATIOS = 0.25
"""Largest product of the ratios for held-out and later parts at which later parts may be predicted worse."""
SCREENING_SAMPLES = 20_000
"""Largest number of samples with which columns are chosen."""
USUAL_DEPARTURE = 0.15
"""Usual departure of a sensor's scale from 1. A column that increases the departure beyond this value is
rejected: it correlates with the attitude, and its coefficients have absorbed a part of the scales."""
HINTED = 0.98
"""Largest ratio of held-out residuals with and without a column at which a fit with the column is tried."""


@dataclass(frozen=True)
class Offer:
    """Column that was tried as a parameter, with its held-out errors."""

    name: str
    without: float
    left_out: float
    """`without`, `left_out`: RMS error on held-out parts of fits without and with the column, nT."""
    taken: bool
    """True if the column became a parameter."""


def best_parameters(
    deployment: xr.Dataset, offered: Sequence[str], *, grid: AnomalyGrid | None = None, **options: Any
) -> tuple[tuple[str, ...], list[Offer]]:
    """Return the columns to use as parameters, and the held-out errors of each column that was tried.

    `offered`: candidate columns. `grid`: anomaly map to add to the IGRF. `options`: as for :func:`~.fit.fit`.

    CalibrationError: the data do not support a fit without parameters.
    """

    def screened(names: tuple[str, ...]) -> Observations:
        return observations(deployment, names, grid=grid).thinned(SCREENING_SAMPLES)

    def fitted(names: tuple[str, ...]) -> Fit | None:
        try:
            return fit(screened(names), **options)
        except CalibrationError:  # implausible positions, or too few samples with a value
            return None

    def most_useful(found: Fit, names: tuple[str, ...], tried: set[str]) -> str | None:
        data = screened(names)
        rows = np.searchsorted(deployment["time"].to_numpy(), data.time)
        columns = {name: deployment[name].to_numpy()[rows] for name in offered if name not in tried}
        explained = worths(found.calibration, data, columns, HINTED)
        # The coefficients of a mass that moves with another one may contain the other's effect: if no
        # column explains the residual, fits decide.
        return max(explained, key=explained.__getitem__, default=next(iter(columns), None))

    taken: tuple[str, ...] = ()
    found = fit(screened(taken), **options)
    offers: list[Offer] = []
    failed: set[str] = set()
    # Forward selection: try the column that explains most of the residual; keep it if a new fit predicts
    # held-out parts better, and also later parts from earlier parts.
    while len(taken) < MAX_PARAMETERS and len(failed) < FAILURES:
        name = most_useful(found, taken, {*taken, *failed})
        if name is None:
            break
        further = fitted((*taken, name))
        tries = [(name, further, found)]
        if further is not None and _is_distorted(further, found) and len(taken) + 1 < MAX_PARAMETERS:
            # Of two masses that move together with the attitude, one alone distorts the scales: try both.
            partner = most_useful(further, (*taken, name), {*taken, *failed, name})
            both = None if partner is None else fitted((*taken, name, partner))
            if partner is not None and both is not None and _predicts_better(both, further):
                tries.append((partner, both, further))
        _, last, _ = tries[-1]
        better = last is not None and _predicts_better(last, found) and not _is_distorted(last, found)
        for one, after, before in tries:
            left_out = np.inf if after is None else float(after.details["left_out_nT"])
            offers.append(Offer(one, float(before.details["left_out_nT"]), left_out, better))
        if better and last is not None:
            taken, found = (*taken, *(one for one, _, _ in tries)), last
            failed.clear()
        else:
            failed.add(name)
    return taken, offers


def _predicts_better(further: Fit, found: Fit) -> bool:
    """Return True if further columns improve the prediction of held-out and of later parts of the log."""
    # later parts may have positions of a mass that earlier parts lack: their error may grow if that of
    # held-out parts falls by a far larger factor
    known = {"left_out_nT", "forward_nT"} & found.details.keys() & further.details.keys()
    ratios = {name: further.details[name] / found.details[name] for name in known}
    left_out, forward = ratios["left_out_nT"], ratios.get("forward_nT", 0.0)
    carries = forward < MAX_HELD_OUT_ERROR_RATIO or left_out * forward < MAX_PRODUCT_OF_RATIOS
    return left_out < MAX_HELD_OUT_ERROR_RATIO and carries and bool(further.calibration.channels)


def _is_distorted(further: Fit, found: Fit) -> bool:
    """Return True if further columns, which correlate with the attitude, have changed the scales."""
    departure, before = (max(abs(scale - 1.0) for scale in one.scales) for one in (further, found))
    return departure > max(before, USUAL_DEPARTURE)


def lines(offers: Sequence[Offer]) -> list[str]:
    """Return a message for each column that was tried, with its held-out errors."""
    return [
        f"--parameter {one.name}: {one.without:.3g} nT on parts left out without it, "
        f"{one.left_out:.3g} with it: {'taken' if one.taken else 'not worth it'}"
        for one in offers
    ]
