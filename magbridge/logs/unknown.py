"""Numbers that programs without NaN write for "not known"."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError
from magbridge.logs.deployment import with_losses

__all__ = ["EXPECTED_VALUE", "known", "unknown"]

EXPECTED_VALUE = "expected a value, or nothing where it is not known, not "

CODES = np.outer([-1.0, 1.0], [
    9999.0, 99999.0, 999999.0, 9999.9, 99999.9, 99999.99, 999.25, 88888.0, 88888.88, 32767.0, 32768.0,
    2_147_483_647.0, 69_696_969.0, 999.0, 999.9, 999.99,
])  # fmt: skip
"""As they are met, with either sign."""
ONLY_AMONG_OTHERS = 1_000.0
"""Smaller codes count only where the column has other values, too."""
MIN_FILL_VALUE = 1e30
"""A larger number is one, too, whatever it measures: 1e31, 1e34, 9.97e36."""


def unknown(columns: dict[str, FloatArray]) -> dict[str, BoolArray]:
    """Return which values of some columns, (n,) each, stand for "not known", without being declared.

    They are huge, or one of :data:`CODES` that lies beyond all others by half their range. A field whose
    three axes are 0, or the same code, is none, nor is a place at 0, 0: a receiver without a fix writes it.
    """
    found = {name: _is_code(values) for name, values in columns.items() if name not in {"time", "quality"}}
    for together in (CHANNELS, ("latitude", "longitude")):
        if set(together) <= set(columns):
            first, *others = (columns[name] for name in together)
            alike = np.all([first == other for other in others], axis=0)
            alike &= (first == 0.0) | np.isin(first, CODES)
            found |= {name: found[name] | alike for name in together}
    return {name: wrong for name, wrong in found.items() if wrong.any()}


def _is_code(values: FloatArray) -> BoolArray:
    wrong: BoolArray = np.abs(values) > MIN_FILL_VALUE
    codes = np.isin(values, CODES)
    others = values[np.isfinite(values) & ~codes & ~wrong]
    if not len(others):
        codes &= np.abs(values) >= ONLY_AMONG_OTHERS
    if codes.any():
        low, high = (others.min(), others.max()) if len(others) else (0.0, 0.0)
        wrong |= codes & (np.maximum(low - values, values - high) > max(0.5 * (high - low), 1.0))
    return wrong


def known(path: Path, dataset: xr.Dataset) -> xr.Dataset:
    """Return a deployment of another program without what stands for "not known": counted, and named."""
    codes = unknown({str(name): column.to_numpy() for name, column in dataset.data_vars.items()})
    lines = []
    for name, wrong in codes.items():
        values = dataset[name].to_numpy()
        lines.append(str(FormatError(path, f"{EXPECTED_VALUE}{float(values[wrong][0])!r}", column=name)))
        dataset = dataset.assign({name: dataset[name].copy(data=np.where(wrong, np.nan, values))})
    return with_losses(dataset, {"values_dropped": sum(int(wrong.sum()) for wrong in codes.values())}, lines)
