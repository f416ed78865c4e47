"""Convert deployments from and to pandas data frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
import xarray as xr

from magbridge.columns import in_seconds
from magbridge.errors import FormatError
from magbridge.logs.deployment import deployment
from magbridge.logs.headings import split

__all__ = ["from_frame", "to_frame"]

NAME = "the data frame"


def from_frame(frame: pd.DataFrame, units: Mapping[str, str] | None = None, **attrs: Any) -> xr.Dataset:
    """Return a data frame as a deployment; every function that accepts a log accepts it.

    Parameters
    ----------
    frame : DataFrame
        A column of ours is called as ours; others are telemetry. A heading may hold a unit: ``mag_x [uT]``.
        Time is the column ``time`` or the index: moments (UTC where they do not say), or s since 1970.
    units : mapping of str to str, optional
        Units of columns; those of our table are converted to the table's.
    **attrs
        Of the whole, as ``heading_reference="magnetic"``.

    Raises
    ------
    FormatError
        It has no time; a column does not hold numbers; a unit does not fit.
    """
    named = dict(split(str(name)) for name in frame.columns)
    frame = frame.set_axis(list(named), axis=1)
    if "time" not in frame and isinstance(frame.index, pd.RangeIndex):
        raise FormatError(NAME, "expected a column or an index of times", column="time")
    time = frame.pop("time") if "time" in frame else frame.index.to_series()
    columns = {}
    for name in map(str, frame):
        if not pd.api.types.is_numeric_dtype(frame[name]):
            raise FormatError(NAME, f"expected numbers, not {frame[name].dtype}", column=name)
        columns[name] = frame[name].to_numpy(float)
    return deployment(NAME, _seconds(time), columns, {**named, **(units or {})}, attrs)


def to_frame(log: xr.Dataset) -> pd.DataFrame:
    """Return a deployment as a data frame, indexed by moments in UTC; units are in ``frame.attrs``."""
    log = in_seconds(log)
    frame = log.to_dataframe()
    frame.index = pd.to_datetime(log["time"].to_numpy(), unit="s", utc=True).rename("time")
    frame.attrs = {str(name): log[name].attrs.get("units", "") for name in log}
    return frame


def _seconds(time: pd.Series) -> Any:
    """Return moments as s since 1970 UTC; numbers are such already."""
    if pd.api.types.is_numeric_dtype(time):
        return time.to_numpy(float)
    moments = pd.to_datetime(time, utc=True)
    return ((moments - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)).to_numpy(float)
