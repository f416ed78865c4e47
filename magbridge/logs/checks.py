"""What no deployment can hold: a time that does not increase, and values beyond what nature has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNEL_TIMES, usual
from magbridge.errors import FormatError

__all__ = ["checked", "increasing"]

YEAR_10000 = 253_402_300_800.0
"""s since 1970: a later time is in another unit, and no calendar goes beyond it."""
MOST = {"latitude": 90.0, **dict.fromkeys(("longitude", "roll", "pitch", "heading"), 540.0), "depth": 1e5}
"""Largest magnitude, deg or m, of these columns; 4952.3 is degrees and minutes written together."""
LEAST = {
    "degC": -273.15,
    "K": 0.0,
    "Pa": -101325.0,
    "hPa": -1013.25,
    "mbar": -1013.25,
    "kPa": -101.325,
    "bar": -1.01325,
    "dbar": -10.1325,
}
"""Lowest temperatures and pressures, also of a pressure relative to the surface's: -9999 is a code for
"not known"."""
FIELDS = 1e3, 1e6
"""nT, between which every reference field lies: 5e-05 is in tesla, and -9999 a code for "not known"."""
APART = 60.0
"""s by which a channel's sampling time may differ from its row's time."""


def increasing(
    file: str | Path, time: FloatArray, rows: Sequence[int] | None = None, *, after: float = -np.inf
) -> None:
    """Check that `time` (n,), s, is finite and increases, also from `after`, the last time before it.

    Raises
    ------
    FormatError
        Names the first row that does not fit: its number in `rows`, or counted from 1.
    """
    steps = np.diff(time, prepend=after)
    wrong = np.flatnonzero(~((steps > 0) & (np.abs(time) < YEAR_10000)))
    if not len(wrong):
        return
    k = int(wrong[0])
    before = float(time[k - 1]) if k else after
    expected = f"expected a time after {before!r}" if np.isfinite(before) else "expected a finite time"
    if YEAR_10000 <= abs(time[k]) < np.inf:
        expected = "expected seconds since 1970"
    raise FormatError(
        file, f"{expected}, not {float(time[k])!r}", row=rows[k] if rows else k + 1, column="time"
    )


def checked(file: str | Path, pieces: Iterable[tuple[xr.Dataset, Sequence[int]]]) -> Iterator[xr.Dataset]:
    """Yield the pieces of a deployment, each given with the numbers of its rows in the file.

    Raises
    ------
    FormatError
        Names the first row at which time does not increase, or whose temperature, pressure, angle, position,
        depth, reference or channel time is impossible.
    """
    last = -np.inf
    for dataset, rows in pieces:
        increasing(file, dataset["time"].values, rows, after=last)
        _plausible(file, dataset, rows)
        last = float(dataset["time"][-1])
        yield dataset


def _plausible(file: str | Path, dataset: xr.Dataset, rows: Sequence[int]) -> None:
    time = dataset["time"].values
    for name, column in dataset.data_vars.items():
        values, unit = column.values, usual(column.attrs.get("units", ""))
        if name in MOST:
            wrong, expected = np.abs(values) > MOST[str(name)], f"{unit}, at most {MOST[str(name)]:g}"
        elif name == "reference_field":
            wrong = (values < FIELDS[0]) | (values > FIELDS[1])
            expected = f"{FIELDS[0]:g} to {FIELDS[1]:g} nT, or nothing where it is not known"
        elif name in CHANNEL_TIMES:
            wrong, expected = np.abs(values - time) > APART, f"a time within {APART:g} s of the row's"
        elif unit in LEAST:
            wrong = values < LEAST[unit]
            expected = f"at least {LEAST[unit]:g} {unit}, or nothing where it is not known"
        else:
            continue
        if wrong.any():
            k = int(wrong.argmax())
            raise FormatError(
                file, f"expected {expected}, not {float(values[k])!r}", row=rows[k], column=str(name)
            )
