"""Contribution of each log to a fit, and a test whether one calibration fits all logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit
from magbridge.columns import CHANNELS
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms, robust_scale

if TYPE_CHECKING:
    import xarray as xr

MAX_JOINT_RMS_RATIO = 3.0
"""RMS of a fit to all logs over that of separate fits, above which the logs are not of one vehicle."""
JUDGED = 10
"""Largest number of logs that are fitted separately; the largest logs are taken."""


def source_of(logs: Sequence[xr.Dataset], time: FloatArray) -> IndexArray:
    """Return the index (n,) of the log with a complete sample at each `time` (n,), s; -1 if no log has one.

    If several logs have a complete sample at this time, the first log counts.
    """
    # from the last log to the first, so that the first one wins
    which = np.full(len(time), -1)
    for k in reversed(range(len(logs))):
        which[np.isin(time, _sampled(logs[k]))] = k
    return which


def unused_logs(logs: Sequence[xr.Dataset], data: Observations) -> Iterator[Diagnostic]:
    """Yield a warning for each of `logs` that adds no sample to `data`."""
    which = source_of(logs, data.time)
    for k, log in enumerate(logs):
        sampled = _sampled(log)
        if (which == k).any() or (not len(sampled) and np.isin(log["time"].values, data.time).any()):
            continue
        numbers = {
            name: int(log[name].notnull().sum()) if name in log else 0 for name in (*CHANNELS, *data.names)
        }
        reasons = [f"{name!r} has no number" for name, count in numbers.items() if not count]
        others = [other.attrs["source"] for other in logs[:k] if np.isin(sampled, _sampled(other)).any()]
        if not reasons and others:
            reasons = [f"{others[0]} has samples at the same times, and the first counts"]
        why = ", ".join(reasons) or "no row has every value and a reference"
        yield Diagnostic("unused_log", {"log": log.attrs["source"], "reason": why})


def heterogeneous_logs(
    logs: Sequence[xr.Dataset], data: Observations, found: Fit | None, refit: Callable[[Observations], Fit]
) -> Diagnostic | None:
    """Return a warning if logs are not from one vehicle in one state; else None.

    `data`: samples of the fit. `found`: the fit to all logs; None if it collapsed. `refit`: function that
    fits a part of the data in the same way.
    """
    if len(logs) < 2:
        return None
    if found and found.rms < MAX_JOINT_RMS_RATIO * robust_scale(np.diff(found.residual)) / 2.0**0.5:
        return None  # the residuals are noise from one sample to the next, as white noise is
    # compare the residual of one common fit with those of a fit to each of the largest logs
    which = source_of(logs, data.time)
    count = np.bincount(which[which >= 0], minlength=len(logs))
    alone: list[tuple[int, float]] = []
    for k in np.argsort(-count, kind="stable")[:JUDGED].tolist():
        try:
            alone.append((k, refit(_moving(data.part(which == k))).rms))
        except CalibrationError:  # too little in it for a fit of its own
            continue
    judged = [k for k, _ in alone]
    # RMS of the separate fits, weighted by samples
    own = float(np.sqrt(np.average([one**2 for _, one in alone], weights=count[judged]))) if alone else 0.0
    if len(alone) < 2 or (found and rms(found.residual[np.isin(which, judged)]) < MAX_JOINT_RMS_RATIO * own):
        return None
    fits = ", ".join(f"{logs[k].attrs['source']} {one:.3g}" for k, one in sorted(alone)[:3])
    more = f" and {len(alone) - 3} more" if len(alone) > 3 else ""
    together = f"{found.rms:.3g} nT RMS together" if found else "together the fit collapses"
    return Diagnostic("several_vehicles", {"together": together, "fits": fits + more})


def _sampled(log: xr.Dataset) -> FloatArray:
    """Return the times (n,), s, at which a log has all channels of the magnetometer."""
    if not all(name in log for name in CHANNELS):
        return np.empty(0)
    whole = np.logical_and.reduce([log[name].notnull().to_numpy() for name in CHANNELS])
    return np.asarray(log["time"].to_numpy()[whole], float)


def _moving(data: Observations) -> Observations:
    """Return the data without the parameters that are constant in them."""
    span = np.ptp(data.parameters, axis=0) if len(data) else np.zeros(len(data.names))
    moves = span > 1e-9 * np.abs(data.parameters).max(axis=0, initial=0.0)
    names, units = (tuple(compress(one, moves)) for one in (data.names, data.units))
    return replace(data, parameters=data.parameters[:, moves], names=names, units=units)
