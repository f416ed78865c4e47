"""Merge several logs to one sorted in time, or add a vehicle's telemetry to the log of a sensor.

A fluxgate with its own logger records the field, but neither attitude nor position; the vehicle's logs have
both, on another time base. The sensor's rows remain unchanged. A column of the vehicle on a circle
(heading, roll, longitude) is interpolated along the shorter arc; one with few integer values (a switch, a
mode, a counter of dives) is held until its next value; any other is interpolated linearly.

A column is NaN in a gap: an interval longer than `MIN_GAP_S` and than `GAP_INTERVALS` median intervals of the
column. Rows outside the vehicle's logs, and rows in gaps of these logs, remain and are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import chain

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNEL_TIMES, CHANNELS, COLUMNS, counts_from_boot
from magbridge.errors import FormatError, WrongUse
from magbridge.logs.clocks import BETWEEN_RUNS_S
from magbridge.logs.compasses import COMPASSES_ATTRIBUTE, further
from magbridge.logs.deployment import (
    FROM_BOOT,
    join,
    join_attrs,
    same_columns,
    shifted,
    sliced,
    uncounted,
    with_losses,
    with_notes,
)  # fmt: skip
from magbridge.logs.fields import CIRCLES, latest, linear

Open = Callable[[int], Iterator[xr.Dataset]]
MAX_BUFFERED_BYTES = 1 << 28
"""Largest size of the first pieces that are kept while further logs are opened, bytes."""
MIN_GAP_S = 30.0
"""Shortest gap between two values of a column, s, across which it is not interpolated."""
GAP_INTERVALS = 4.0
"""Shortest gap in median intervals of a column, for columns that are updated rarely."""
MAX_STATES = 8
"""Largest number of different integers in a column that is held like a switch, not interpolated."""
SCALAR_COLUMN, POSITION = "total_field", {"latitude", "longitude"}
MAGNETIC_COLUMNS = {name for name, column in COLUMNS.items() if column.units == "nT"}


def merge(
    sources: Sequence[Open], rows: int, named: Sequence[bool] = (), clock_offset_s: float = 0.0
) -> Iterator[xr.Dataset]:
    """Yield the logs that `sources` open as one deployment in pieces, sorted in time, with the same columns.

    The first piece of each log gives its start and its columns. A log is in memory while the merged rows are
    between its start and its end. Empty logs are left out. If sensors' own logs are combined with a
    vehicle's, all logs are in memory. `named`, `clock_offset_s`: as for :func:`combine`.
    """
    firsts: list[xr.Dataset] = []
    opened: list[Callable[[], Iterator[xr.Dataset]]] = []
    declared = []
    room = MAX_BUFFERED_BYTES
    for k, source in enumerate(sources):
        pieces = source(rows)
        if (first := next(pieces, None)) is None:
            continue
        firsts.append(first.isel(time=slice(0, 1)).copy(deep=True))
        declared.append(k < len(named) and named[k])
        room -= first.nbytes
        # if the memory for first pieces is full, the log is opened again later
        opened.append(partial(chain, [first], pieces) if room > 0 else partial(source, rows))
    if _sensor_logs(firsts, declared)[0] or sum(map(_is_from_boot, firsts)) > 1:
        logs = [join([*pieces()]) for pieces in opened]
        yield from sliced(join(combine(logs, declared, clock_offset_s)), rows)
        return
    refuse_offset(clock_offset_s)
    whole = join(firsts)  # also checks units and references
    columns = {str(name): dict(whole[name].attrs) for name in whole.data_vars}
    # a file's attributes are those of the first piece, and must name all sources
    meaning = {key: whole.attrs[key] for key in ("source", "heading_reference") if key in whole.attrs}
    starts = [float(first["time"].values[0]) for first in firsts]
    order = sorted(range(len(firsts)), key=starts.__getitem__)
    parts: list[xr.Dataset] = []
    count = 0
    for k, following in zip(order, [*order[1:], None], strict=True):
        for piece in opened[k]():
            parts.append(piece)
            count += piece.sizes["time"]
        end = np.inf if following is None else starts[following]
        if following is not None and count < rows:
            continue
        held = same_columns(join(parts), columns).assign_attrs(meaning)
        n = int(np.searchsorted(held["time"].values, end))
        if n:
            yield from sliced(held.isel(time=slice(0, n)), rows)
            held = uncounted(held)
        count = held.sizes["time"] - n
        parts = [held.isel(time=slice(n, None))] if count else []


def combine(logs: Sequence[xr.Dataset], named: Sequence[bool], clock_offset_s: float) -> list[xr.Dataset]:
    """Return the sensors' own logs with the vehicle's telemetry, and the logs that need no telemetry.

    `named`: True for each log that the user declares as a sensor's. `clock_offset_s`: added to the sensors'
    times, s. FormatError: no time in common, or only the times of one kind of log count from 1970; or several
    sensors' logs count from different boots.
    """
    sensors, vehicles = _sensor_logs(logs, named)
    if not sensors:
        refuse_offset(clock_offset_s)
        return _in_runs(logs)
    own = [logs[k] for k in sensors]
    for log, run in zip(own, _in_runs(own), strict=True):
        if run is not log:
            ways = "each with the vehicle's logs and its own --clock-offset"
            raise FormatError(
                log.attrs["source"], f"counts from another boot than the log before: read {ways}"
            )
    vehicle = join([logs[k] for k in vehicles])
    combined = []
    covered = [np.empty(0)]
    for k, log in enumerate(logs):
        if k in sensors:
            sensor = _on_clock_of(vehicle, log, clock_offset_s)
            combined.append(_with_telemetry(sensor, vehicle, is_first=k == sensors[0]))
            time, limits = sensor["time"].to_numpy(), vehicle["time"].to_numpy()[[0, -1]]
            covered.append(time[(time >= limits[0]) & (time <= limits[1])])
        elif k not in vehicles:
            combined.append(log)
    source = ", ".join(dict.fromkeys(str(logs[k].attrs.get("source", "")) for k in sensors))
    note = _note(source, vehicle, np.concatenate(covered), clock_offset_s)
    return [with_notes(combined[0], [note]), *combined[1:]]


def _is_from_boot(log: xr.Dataset) -> bool:
    return FROM_BOOT in log.attrs or counts_from_boot(log)


def _in_runs(logs: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return the logs; one that counts from another boot than those before becomes a run after them."""
    placed: list[xr.Dataset] = []
    for log in logs:
        before = [one for one in placed if _is_from_boot(one)] if _is_from_boot(log) else []
        if any(_contradict(one, log) for one in before):
            end = max(float(one["time"].values[-1]) for one in before)
            note = f"{log.attrs['source']}: counts from another boot than the logs before: a run after them"
            moved = shifted(log, end + BETWEEN_RUNS_S - float(log["time"].values[0]))
            placed.append(with_notes(moved, [note]))
        else:
            placed.append(log)
    return placed


def _contradict(log: xr.Dataset, like: xr.Dataset) -> bool:
    """Return True if logs overlap in time and most of their columns are the same, but not their values."""
    names = [name for name in log.data_vars if name in like]
    if not log.sizes["time"] or not like.sizes["time"]:
        return False
    (begin, end), (start, stop) = log["time"].values[[0, -1]], like["time"].values[[0, -1]]
    if 2 * len(names) <= min(len(log.data_vars), len(like.data_vars)) or start > end or begin > stop:
        return False
    counts = join([uncounted(log[names]), uncounted(like[names])]).attrs
    return bool(counts.get("contradictory_rows", 0) >= counts.get("duplicate_rows", 0))


def refuse_offset(clock_offset_s: float) -> None:
    """Raise WrongUse if a clock offset is given without a sensor's log next to a vehicle's."""
    if clock_offset_s:
        raise WrongUse("--clock-offset: expected a sensor's log next to a vehicle's logs; see --sensor-log")


def _sensor_logs(logs: Sequence[xr.Dataset], named: Sequence[bool]) -> tuple[list[int], list[int]]:
    """Return the indices of the sensors' own logs and of the vehicle's logs; both empty if a kind is missing.

    `named`: True for each log that the user declares as a sensor's. If none is, a log with field but without
    position is a sensor's, and a log without magnetic column a vehicle's.
    FormatError: a named log has no field.
    """
    if any(named):
        sensors = [k for k, is_named in enumerate(named) if is_named]
        vehicles = [k for k, is_named in enumerate(named) if not is_named]
        for k in sensors:
            if not _has_field(logs[k]):
                source = logs[k].attrs.get("source", "the sensor's log")
                raise FormatError(source, "expected mag_x mag_y mag_z, or total_field, in a sensor's log")
    else:
        sensors = [k for k, log in enumerate(logs) if _has_field(log) and not set(log.data_vars) >= POSITION]
        vehicles = [k for k, log in enumerate(logs) if not MAGNETIC_COLUMNS & set(log.data_vars)]
    return (sensors, vehicles) if sensors and vehicles else ([], [])


def _has_field(log: xr.Dataset) -> bool:
    vector = all(name in log for name in CHANNELS)
    return (vector or SCALAR_COLUMN in log) and "observatory" not in log.attrs


def _with_telemetry(sensor: xr.Dataset, vehicle: xr.Dataset, *, is_first: bool) -> xr.Dataset:
    """Return a sensor's log with the vehicle's columns and, for the first log, the vehicle's losses."""
    time, known = sensor["time"].to_numpy(), vehicle["time"].to_numpy()
    if set(CHANNELS) <= set(sensor.data_vars):
        vehicle = further(vehicle)
    columns = {
        str(name): ("time", _interpolated(time, known, str(name), column.to_numpy()), dict(column.attrs))
        for name, column in vehicle.data_vars.items()
        if name not in sensor and name not in CHANNEL_TIMES
    }
    outside = (time < known[0]) | (time > known[-1])
    right = np.minimum(np.clip(np.searchsorted(known, time), 1, None), len(known) - 1)
    widths = np.diff(known, prepend=known[0])[right]
    in_gaps = ~outside & (widths > _max_gap(known)) & ~np.isin(time, known)
    combined = sensor.assign(columns)
    combined.attrs = join_attrs([sensor, vehicle if is_first else uncounted(vehicle)])
    combined.attrs.pop(COMPASSES_ATTRIBUTE, None)
    return with_losses(combined, {"rows_outside": int(outside.sum()), "rows_in_gaps": int(in_gaps.sum())})


def _note(source: str, vehicle: xr.Dataset, covered: FloatArray, clock_offset_s: float) -> str:
    """Return a note on how the sensors' logs `source` and the vehicle's were combined.

    `covered` (n,): the sensors' times, s, within the vehicle's. FormatError: it is empty.
    """
    names = str(vehicle.attrs.get("source", "the vehicle's logs")).split(", ")
    called = " and ".join(names) if len(names) < 3 else f"{names[0]} to {names[-1]} ({len(names)} logs)"
    first, last = (_moment(vehicle, time) for time in vehicle["time"].to_numpy()[[0, -1]])
    if not len(covered):
        raise FormatError(
            source,
            f"expected times from {first} to {last}, those of {called}; "
            "--clock-offset S adds S seconds to the sensor's times",
        )
    clocks = f"with {clock_offset_s:+g} s on the sensor's clock (--clock-offset)"
    if not clock_offset_s:
        clocks = "the clocks are assumed to agree (--clock-offset S shifts the sensor's)"
    common = f"{covered.max() - covered.min():.0f} s in common"
    return f"{source}: with the telemetry of {called}, from {first} to {last}; {common}; {clocks}"


def _on_clock_of(vehicle: xr.Dataset, sensor: xr.Dataset, offset_s: float) -> xr.Dataset:
    """Return a sensor's log with `offset_s` (s) added to its times.

    FormatError: only one of the logs has UTC, and `offset_s` is 0.
    """
    from_boot, vehicle_from_boot = counts_from_boot(sensor), counts_from_boot(vehicle)
    if offset_s:
        sensor = shifted(sensor, offset_s)
        if from_boot and not vehicle_from_boot:
            sensor.attrs["time_reference"] = "utc"
    elif from_boot != vehicle_from_boot:
        which = "the sensor's" if from_boot else "the vehicle's"
        raise FormatError(
            sensor.attrs.get("source", "the sensor's log"),
            f"{which} times count from a start that the log does not state: "
            "--clock-offset S is added to the sensor's times",
        )
    return sensor


def _interpolated(target: FloatArray, time: FloatArray, name: str, values: FloatArray) -> FloatArray:
    """Return values (m,) at `time` (m,), s, brought to `target` (n,), s: states held, others interpolated."""
    known = np.isfinite(values)
    time, values = time[known], values[known]
    distinct = np.unique(values)
    is_state = len(distinct) <= MAX_STATES and bool((distinct == np.round(distinct)).all())
    if name not in CIRCLES and is_state:
        return latest(target, time, values, _max_gap(time))
    return linear(target, time, values, _max_gap(time), name)


def _max_gap(time: FloatArray) -> float:
    """Return the longest interval between times (m,), s, that does not count as a gap, s."""
    steps = np.diff(time)
    return max(MIN_GAP_S, GAP_INTERVALS * float(np.median(steps)) if len(steps) else 0.0)


def _moment(log: xr.Dataset, time: float) -> str:
    if counts_from_boot(log):
        return f"{time:.1f} s"
    return f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M:%S} UTC"
