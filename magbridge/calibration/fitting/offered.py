"""Which of a log's columns are worth being parameters: chosen by what each buys on parts left out.

A drone's motors move its field in proportion to their currents, and its log holds battery and motor
currents, throttles and servos, most of which say the same. So they are added one by one: first that which
explains most of the residual of the fit so far (:mod:`.hints`), as long as a fit with it predicts the parts
left out better, and the later parts of the log from the earlier ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.hints import worths
from magbridge.calibration.fitting.observe import observations
from magbridge.errors import CalibrationError

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.field.grid import AnomalyGrid

__all__ = ["AUTO", "Offer", "best_parameters", "lines"]

AUTO = "auto"
"""``--parameter auto``."""
MOST = 3
"""Parameters at most: each of several currents is in part the sum of the others."""
FAILURES = 2
"""Columns in a row that were not worth it, after which no more are tried."""
BETTER = 0.95
"""Share of the error on parts left out that may be left, for a column to be worth its coefficients."""
HINTED = 0.98
"""Share of the residual that may be left, for a column to be tried."""


@dataclass(frozen=True)
class Offer:
    """A column that was tried as a parameter."""

    name: str
    without: float
    left_out: float
    """`without`, `left_out`: nT, RMS on parts left out of the fit without it, and with it."""
    taken: bool


def best_parameters(
    deployment: xr.Dataset, offered: Sequence[str], *, grid: AnomalyGrid | None = None, **options: Any
) -> tuple[tuple[str, ...], list[Offer]]:
    """Return the columns that are worth being parameters, and what each that was tried is worth.

    Parameters
    ----------
    deployment : Dataset
        As :func:`~.observe.observations` takes it.
    offered : sequence of str
        Columns that may move the field.
    grid : AnomalyGrid, optional
        Added to the IGRF.
    **options
        Of :func:`~.fit.fit`.

    Raises
    ------
    CalibrationError
        The data do not support a fit without parameters.
    """
    taken: tuple[str, ...] = ()
    found = fit(observations(deployment, taken, grid=grid), **options)
    offers: list[Offer] = []
    failures = 0
    while len(taken) < MOST and failures < FAILURES:
        name = _most_promising(deployment, found, taken, [*offered], {one.name for one in offers}, grid)
        if name is None:
            break
        without = float(found.details["left_out_nT"])
        try:
            further = fit(observations(deployment, (*taken, name), grid=grid), **options)
        except CalibrationError:  # a position that cannot be, or too few samples that have it
            offers.append(Offer(name, without, np.inf, taken=False))
            failures += 1
            continue
        left = float(further.details["left_out_nT"])
        worth_it = left < BETTER * without and bool(further.calibration.channels)
        if {"forward_nT"} <= found.details.keys() & further.details.keys():
            worth_it = worth_it and further.details["forward_nT"] < found.details["forward_nT"]
        offers.append(Offer(name, without, left, worth_it))
        if worth_it:
            found, taken, failures = further, (*taken, name), 0
        else:
            failures += 1
    return taken, offers


def lines(offers: Sequence[Offer]) -> list[str]:
    """Return a line for each column that was tried: what it buys on parts left out."""
    return [
        f"--parameter {one.name}: {one.without:.0f} nT on parts left out without it, "
        f"{one.left_out:.0f} with it: {'taken' if one.taken else 'not worth it'}"
        for one in offers
    ]


def _most_promising(
    deployment: xr.Dataset,
    found: Fit,
    taken: tuple[str, ...],
    offered: Sequence[str],
    tried: set[str],
    grid: AnomalyGrid | None,
) -> str | None:
    """Return the column that explains most of what a fit leaves."""
    data = observations(deployment, taken, grid=grid)
    rows = np.searchsorted(deployment["time"].to_numpy(), data.time)
    columns = {name: deployment[name].to_numpy()[rows] for name in offered if name not in tried}
    explained = worths(found.calibration, data, columns, HINTED)
    return max(explained, key=explained.__getitem__, default=None)
