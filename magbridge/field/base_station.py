"""Time variation of the Earth's field from a base station: an observatory or a stationary sensor.

Over a day the field varies by tens of nT, in a storm by hundreds, nearly the same over a hundred kilometres.
A survey's log, or a calibration's, gets it as the column ``daily_variation``: the station's field minus its
median.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNELS
from magbridge.errors import DataError, FormatError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["separate_observatories", "with_daily_variation"]

MAX_EXTRAPOLATION_S = 600.0
"""s beyond the station's log, for which its last value is held."""


def separate_observatories(logs: Sequence[xr.Dataset]) -> tuple[list[xr.Dataset], list[xr.Dataset]]:
    """Separate the vehicle's logs from those of an observatory."""
    own = [log for log in logs if "observatory" not in log.attrs]
    return own, [log for log in logs if "observatory" in log.attrs]


def with_daily_variation(logs: Sequence[xr.Dataset], base: xr.Dataset) -> list[xr.Dataset]:
    """Return the logs with a base station's variation as ``daily_variation``, nT.

    Parameters
    ----------
    logs : sequence of Dataset
        Of the vehicle.
    base : Dataset
        The base station's, with ``total_field`` (nT) or ``reference_field``, or a raw vector.

    Raises
    ------
    FormatError
        It has none of them.
    DataError
        It does not cover the logs' time.
    """
    total = _total(base)
    known = np.isfinite(total)
    time = base["time"].to_numpy()[known]
    varied = total[known] - np.median(total[known]) if known.any() else total[known]
    found = []
    for log in logs:
        t = log["time"].to_numpy()
        if not len(time) or t[0] < time[0] - MAX_EXTRAPOLATION_S or t[-1] > time[-1] + MAX_EXTRAPOLATION_S:
            source = base.attrs.get("source", "the base station's log")
            raise DataError(f"{source}: does not cover the time of {log.attrs.get('source', 'the log')}")
        found.append(log.assign(daily_variation=("time", np.interp(t, time, varied), {"units": "nT"})))
    return found


def _total(base: xr.Dataset) -> FloatArray:
    for name in ("total_field", "reference_field"):
        if name in base:
            return np.asarray(base[name].to_numpy(), float)
    if all(name in base for name in CHANNELS):
        return np.asarray(np.sqrt(sum(base[name].to_numpy() ** 2 for name in CHANNELS)))
    raise FormatError(
        base.attrs.get("source", "the base station's log"), "expected total_field, or mag_x mag_y mag_z"
    )
