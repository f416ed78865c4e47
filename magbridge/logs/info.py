"""Describe a log: its columns, and the commands that can use it."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from msgspec import to_builtins

from magbridge.arrays import FloatArray
from magbridge.columns import AGE, CHANNELS, COLUMNS, HEIGHT_GUESS, counts_from_boot, is_height, usual
from magbridge.datasets import in_standard_units
from magbridge.field.igrf import magnitude
from magbridge.logs.checks import states_validity
from magbridge.logs.compasses import compasses_in
from magbridge.logs.deployment import MEANING, named_losses, noted, passed_over
from magbridge.logs.naming import earthly_units

HORIZONTAL_POSITION = ("latitude", "longitude")
ATTITUDE = ("roll", "pitch", "heading")
RECKONING: tuple[tuple[str, ...], ...] = (
    ("velocity_north", "velocity_east"),
    ("water_speed", "heading"),
    ("local_north", "local_east"),
    ("dr_latitude", "dr_longitude"),
    ("depth", "pitch", "heading"),
)
Needs = tuple[tuple[tuple[str, ...], ...], ...]
REFERENCE: tuple[tuple[str, ...], ...] = (("reference_field",), HORIZONTAL_POSITION)
USES: dict[str, Needs] = {
    "calibrate": ((CHANNELS,), REFERENCE),
    "correct": ((CHANNELS,),),
    "diagnose": ((CHANNELS,), REFERENCE),
    "navigate": ((CHANNELS, ("total_field",)), (*RECKONING, HORIZONTAL_POSITION)),
    "survey": ((CHANNELS, ("total_field",), ("anomaly",)), (HORIZONTAL_POSITION,)),
    "plan --mission": ((ATTITUDE,), (HORIZONTAL_POSITION,)),
    "replay": ((CHANNELS,),),
    "simulate --trajectory-from": ((ATTITUDE,), (HORIZONTAL_POSITION,)),
}
"""Command -> groups of alternative sets of columns; the command needs one set of each group."""
INFO_GAP_INTERVALS = 2.5
"""A pause longer than this many sampling intervals is a gap."""
ABOVE = 2.0
"""Height above the surface, m, beyond which a column ``depth`` probably counts upwards."""
CONDITION_COLUMNS = "sensor_temperature", "depth"
"""Standard columns that may be regressors of a calibration."""
CONDITION_UNITS = {"degC", "K", "Pa", "hPa", "kPa", "mbar", "bar", "dbar"}
"""Units of temperatures and pressures."""
STATES = {*(*CONDITION_UNITS, "inHg", "V", "s", "m", "m/s", "nT", "arcmin")}
"""Units of quantities that do not move iron or drive currents: temperatures, pressures, voltages, speeds."""


def info(log: xr.Dataset) -> dict[str, Any]:
    """Return the description of a log as a dictionary for JSON.

    Parameters
    ----------
    log : Dataset (time)
        As :func:`magbridge.logs.read` returns it.

    Returns
    -------
    dict
        ``rows``, ``start``, ``end`` (s since 1970), ``interval_s``, ``rate_hz``, ``gaps``, ``longest_gap_s``,
        ``references`` (what heading and time refer to), ``guessed``, ``skipped``,
        ``losses`` (a line each), ``notes``, ``compasses``, ``columns`` (name, unit, meaning, fraction known,
        lowest, highest, interval between changes), ``uses`` (command -> missing columns) and ``hints``.
    """
    log = in_standard_units(log)
    time = log["time"].to_numpy().astype(float)
    steps = np.diff(time)
    interval = float(np.median(steps)) if len(steps) else None
    gaps = steps[steps > INFO_GAP_INTERVALS * interval] if interval else steps
    columns = [_column(str(name), log[name], time) for name in log.data_vars]
    return {
        "source": str(log.attrs.get("source", "")),
        "rows": len(time),
        "start": float(time[0]) if len(time) else None,
        "end": float(time[-1]) if len(time) else None,
        "interval_s": interval,
        "rate_hz": 1.0 / interval if interval else None,
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max()) if len(gaps) else None,
        "references": {name: str(log.attrs.get(name, default)) for name, default in MEANING.items()}
        | ({"time_reference": "boot"} if counts_from_boot(log) else {}),
        "guessed": [part for part in str(log.attrs.get("guessed", "")).split("; ") if part],
        "skipped": passed_over(log.attrs),
        "compasses": [to_builtins(one) for one in compasses_in(log)],
        "losses": named_losses(log.attrs),
        "notes": noted(log.attrs),
        "columns": columns,
        "uses": {command: lacking(log, needs) for command, needs in USES.items()},
        "hints": _hints(log, columns),
    }


def lacking(log: xr.Dataset, needs: Needs) -> list[str]:
    """Return, for each group of `needs` that a log does not meet, the missing columns as ``a b, or c``."""
    there = {str(name) for name in log.data_vars if bool(log[name].notnull().any())}
    return [
        ", or ".join(" ".join(name for name in one if name not in there) for one in alternatives)
        for alternatives in needs
        if not any(set(one) <= there for one in alternatives)
    ]


def telemetry(log: xr.Dataset) -> list[str]:
    """Return the columns that may be regressors of a calibration: telemetry that varies."""
    names = [str(name) for name in log.data_vars]
    return [
        name
        for name in names
        if name not in COLUMNS
        and not name.startswith((AGE, "truth_", "mag"))
        and name not in {"run", "dive", "power_cycle", "line", "line_type"}
        and _varies(log, name)
    ]


def _varies(log: xr.Dataset, name: str) -> bool:
    return name in log and float(log[name].max()) > float(log[name].min())


def movers(log: xr.Dataset) -> list[str]:
    """Return the telemetry that may change the field, such as currents, throttles and actuator positions."""
    reckoned = {name for names in RECKONING for name in names}
    return [
        name
        for name in telemetry(log)
        if name not in reckoned and usual(log[name].attrs.get("units", "1")) not in STATES
        if not states_validity(name) and not _counts(log[name].to_numpy())
    ]


def conditions(log: xr.Dataset) -> list[str]:
    """Return the columns of temperature, pressure and depth that vary, and so may change the field."""
    named = [name for name in CONDITION_COLUMNS if _varies(log, name)]
    return named + [
        name for name in telemetry(log) if usual(log[name].attrs.get("units", "1")) in CONDITION_UNITS
    ]


def _counts(values: FloatArray) -> bool:
    """Return True if a column grows by the same step in every row, as a counter or a clock does."""
    steps = np.diff(values.astype(float))
    return len(steps) > 1 and bool(steps[0]) and bool(np.ptp(steps) <= 1e-6 * abs(steps[0]))


def _column(name: str, column: xr.DataArray, time: FloatArray) -> dict[str, Any]:
    values = column.to_numpy()
    known = np.isfinite(values)
    changed = np.flatnonzero(np.diff(values[known]) != 0.0) + 1
    since = np.diff(time[known][changed])
    return {
        "name": name,
        "unit": str(column.attrs.get("units", "")),
        "meaning": str(column.attrs.get("long_name", "")),
        "known": float(known.mean()) if len(values) else 0.0,
        "lowest": float(values[known].min()) if known.any() else None,
        "highest": float(values[known].max()) if known.any() else None,
        "changes_every_s": float(np.median(since)) if len(since) else None,
    }


def _hints(log: xr.Dataset, columns: list[dict[str, Any]]) -> list[str]:
    hints = []
    if set(CHANNELS) <= set(log.data_vars):
        lengths = magnitude(log[list(CHANNELS)].to_array().to_numpy().T)
        length = float(np.median(lengths)) if len(lengths := lengths[np.isfinite(lengths)]) else 0.0
        if length and "nT" not in (fitting := earthly_units(length)):
            hint = f"the vector's length is {length:.4g} nT (median)"
            if fitting:
                declared = f'--column mag_x="THEIRS [{fitting[0]}]" and so on'
                hint += f"; in {fitting[0]} it would be the Earth's: {declared}"
            hints.append(hint)
    if counts_from_boot(log):
        hints.append("times count from a start that the log does not tell: --date says when it was")
    if "heading" in log and "heading_reference" not in log.attrs:
        hints.append("heading is taken as true: say --heading-reference magnetic if it is a compass")
    depth = log["depth"].dropna("time").to_numpy() if "depth" in log else np.empty(0)
    heights = [one["name"] for one in columns if is_height(one["name"])]
    if "depth" not in log and heights:
        hints.append(f'{heights[0]} is not used: as height above the sea, --column depth="{heights[0]}"')
    negated = HEIGHT_GUESS.partition("{")[0] in str(log.attrs.get("guessed", ""))
    if len(depth) and (middle := float(np.median(depth))) < -ABOVE and not negated:
        hints.append(f"depth is {middle:.4g} m (median): if it counts upwards, scale = -1 in columns.toml")
    if moving := movers(log):
        hints.append(f"may move the field, for --parameter: {' '.join(moving)} (auto: those that do)")
    if any(lacking(log, needs) for needs in USES.values()):
        hints.append('a missing column may have another name: --column NAME="THEIRS [unit]"')
    empty = [one["name"] for one in columns if not one["known"]]
    if empty:
        hints.append(f"never known: {' '.join(empty)}")
    return hints
