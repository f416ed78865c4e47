"""Check arguments that enter from Python, and convert Datasets.

Readers of files return Datasets in standard units with increasing times; other programs may not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.columns import (
    COLUMNS,
    HEIGHT_GUESS,
    absent,
    factor,
    is_height,
    time_columns,
    unit_of_height,
)  # fmt: skip
from magbridge.errors import FormatError, WrongUse

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "YEAR_10000", "conversion", "disorder", "disordered", "expect", "expect_number", "expected_time",
    "in_standard_units", "increasing", "standard_log", "with_depth", "with_guesses",
]  # fmt: skip

YEAR_10000 = 253_402_300_800.0
"""Start of the year 10000, s since 1970; a later time is in another unit."""
HEIGHTS = {
    "altitude", "height_above_geopotential_datum", "height_above_mean_sea_level",
    "height_above_reference_ellipsoid",
}  # fmt: skip
"""Standard names of the CF Conventions for heights above the sea; ``height`` is one above the ground."""


def expect(name: str, value: object, kind: type, origin: str) -> None:
    """Check that an argument is a `kind`, which the expression `origin` returns; WrongUse: it is not."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        got = type(value).__name__
        raise WrongUse(f"{name}: expected {article} {kind.__name__}, as {origin} returns, got {got}")


def expect_number(name: str, value: object, low: float, high: float, kind: type = Real) -> None:
    """Check that an argument is a number from `low` to `high`; WrongUse: it is not."""
    if not (isinstance(value, kind) and isinstance(value, Real) and low <= float(value) <= high):
        what = "a whole number" if kind is Integral else "a number"
        raise WrongUse(f"{name}: expected {what} from {low:g} to {high:g}, got {value!r}")


def standard_log(log: xr.Dataset) -> xr.Dataset:
    """Return a log in standard units, as :func:`in_standard_units`, after a check that its times increase.

    FormatError: they do not; the message names the first wrong row, counted from 1.
    """
    log = in_standard_units(log)
    increasing(log.attrs.get("source", "the deployment"), log["time"].to_numpy())
    return log


def in_standard_units(log: xr.Dataset) -> xr.Dataset:
    """Return a log with its columns converted to the units of :data:`~magbridge.columns.COLUMNS`.

    Times may be ``datetime64``, or numbers of s since 1970-01-01 UTC or of a unit ``... since ...``. A height
    becomes the depth (:func:`with_depth`).

    WrongUse: `log` is not a Dataset. FormatError: the times are missing, or are neither numbers nor
    ``datetime64``; a unit does not fit its column.
    """
    if not hasattr(log, "data_vars"):
        remedy = "; convert it with magbridge.from_frame" * hasattr(log, "iloc")
        raise WrongUse(f"log: expected an xarray.Dataset, got {type(log).__name__}{remedy}")
    source = log.attrs.get("source", "the deployment")
    if "time" not in log.coords and "time" in log:
        log = log.set_coords("time")
    if "time" not in log.variables:
        raise FormatError(source, absent("time", map(str, log.variables)), column="time")
    for name, given in time_columns(log).items():
        time = _moments(source, given) if " since " in str(given.attrs.get("units", "")) else given
        if time.dtype.kind in "Mm":  # xarray reads numbers of the unit s as timedelta64
            zero = np.datetime64(0, "ns") if time.dtype.kind == "M" else np.timedelta64(0, "ns")
            seconds = (time.values - zero) / np.timedelta64(1, "s")
            values = np.where(time.isnull(), np.nan, seconds)
            log = log.assign({name: (time.dims, values, time.attrs | COLUMNS[name]._asdict())})
            if time.dtype.kind == "M":
                log.attrs.setdefault("time_reference", "utc")
        elif time.dtype.kind not in "iuf":
            raise FormatError(source, f"expected numbers or datetime64, got {time.dtype}", column=name)
    for key, column in log.variables.items():
        name, unit = str(key), str(column.attrs.get("units", ""))
        if (scale := conversion(source, name, unit)) != 1.0:
            wanted = COLUMNS[name].units if name in COLUMNS else "nT"
            scaled = column.dims, column.to_numpy() * scale, column.attrs | {"units": wanted}
            log = log.assign({name: scaled})
    return with_depth(log)


def with_depth(log: xr.Dataset) -> xr.Dataset:
    """Return a log with a height above the sea as ``depth``, its opposite, if it has positions but no depth.

    The attributes ``guessed`` and ``history`` state it.
    """
    if "depth" in log.variables or "latitude" not in log.variables:
        return log
    place = log["latitude"]
    for name, column in ((str(key), column) for key, column in log.variables.items()):
        standard = column.attrs.get("standard_name")
        above_sea = standard in HEIGHTS if standard else is_height(name)
        if not above_sea or column.dims not in {(), place.dims}:
            continue
        unit = unit_of_height(name, str(column.attrs.get("units", "")))
        if scale := factor(unit, "depth"):
            values = np.broadcast_to(-scale * column.to_numpy(), place.shape)
            depth = place.dims, values, COLUMNS["depth"]._asdict()
            attrs = with_guesses(log.attrs.get("source", ""), log.attrs, [HEIGHT_GUESS.format(name)])
            return log.drop_vars(name).assign(depth=depth).assign_attrs(attrs)
    return log


def with_guesses(source: str, attrs: Mapping[Any, Any], guesses: Sequence[str]) -> dict[Any, Any]:
    """Return the attributes with `guesses`, the assumptions under which a log was read, also as history."""
    if not guesses:
        return dict(attrs)
    note = "; ".join(guesses)
    history = [str(attrs["history"])] if "history" in attrs else []
    history.append(f"{source} was read with: {note}")
    before = [str(attrs["guessed"])] if "guessed" in attrs else []
    return {**attrs, "guessed": "; ".join([*before, note]), "history": "\n".join(history)}


def _moments(source: str, time: xr.DataArray) -> xr.DataArray:
    """Return numbers of a unit ``... since ...`` as datetime64; FormatError: the unit cannot be read."""
    import xarray as xr  # noqa: PLC0415 - the live path runs without it

    try:
        return xr.decode_cf(time.to_dataset(name="moments"))["moments"]
    except ValueError:
        expected = f"expected seconds since 1970, not {time.attrs['units']!r}"
        raise FormatError(source, expected, column=str(time.name)) from None


def conversion(source: str | Path, name: str, unit: str) -> float:
    """Return the factor from a column's declared unit to its standard unit; FormatError: there is none."""
    scale = factor(unit, name)
    if scale is None:
        raise FormatError(source, f"expected {COLUMNS[name].units}, not {unit}", column=name)
    return scale


def increasing(file: str | Path, time: FloatArray, *, previous: float = -np.inf) -> None:
    """Check that `time` (n,), s, is finite and increases, also from `previous`, the last time before it.

    FormatError: it does not; the message names the first wrong row, counted from 1.
    """
    wrong = disordered(time, previous)
    if len(wrong):
        k = int(wrong[0])
        expected = disorder(time) or expected_time(float(time[k]), float(time[k - 1]) if k else previous)
        raise FormatError(file, expected, row=k + 1, column="time")


def disordered(time: FloatArray, previous: float) -> IndexArray:
    """Return the indices at which `time` (n,) is not a valid time, or does not increase from `previous`."""
    return np.flatnonzero(~((np.diff(time, prepend=previous) > 0) & (np.abs(time) < YEAR_10000)))


def disorder(time: FloatArray) -> str:
    """Return a message on the expected order if most times (n,) run backwards or are repeated; else ""."""
    steps = np.diff(time)
    if len(steps) > 1 and np.mean(steps < 0.0) > 0.5:
        return "expected times that increase, they run backwards: sort the rows by time"
    if len(steps) > 1 and np.mean(steps == 0.0) > 0.5:
        each = round(len(time) / len(np.unique(time)))
        remedy = 'if in whole seconds, give the rate, --column time="row [RATE Hz]"'
        return f"expected a time for each row, {each} have the same: {remedy}"
    return ""


def expected_time(time: float, previous: float, following: float = np.inf) -> str:
    """Return a message on the time expected between `previous` and `following`, s, instead of `time`."""
    if YEAR_10000 <= abs(time) < np.inf:
        return f"expected seconds since 1970, not {time!r}"
    if previous < time and following <= time:
        return f"expected a time before {following!r}, not {time!r}"
    wanted = f"time after {previous!r}" if np.isfinite(previous) else "finite time"
    return f"expected a {wanted}, not {time!r}"
