"""Combine a sensor's own log with a vehicle's logs: the vehicle's telemetry at the sensor's times.

A fluxgate with a logger of its own records the field, but neither attitude nor position; the vehicle's logs
have these, on another time base. The sensor's rows stay as they are. Each column of the vehicle is brought to
them by the rule for its kind:

- a column on a circle (heading, roll, longitude) is interpolated along the shorter arc;
- a column with few integer values (a switch, a mode, a counter of dives) is held until its next value;
- any other column is interpolated linearly.

A column has no value in a gap: an interval longer than `MIN_GAP_S` and than `GAP_INTERVALS` of its usual
intervals. Rows outside the vehicle's logs, and rows in gaps of these logs, stay and are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNEL_TIMES, CHANNELS, COLUMNS, counts_from_boot
from magbridge.errors import FormatError, WrongUse
from magbridge.logs.compasses import COMPASSES_ATTRIBUTE, further
from magbridge.logs.deployment import NOTES, join, join_attrs, noted, uncounted, with_losses
from magbridge.logs.fields import CIRCLES, latest, linear

__all__ = ["VehicleTelemetry", "combine", "refuse_offset", "sensor_logs", "with_note"]

MIN_GAP_S = 30.0
"""Shortest gap between two values of a column, s, across which it is not interpolated."""
GAP_INTERVALS = 4.0
"""Shortest gap in median intervals of the column, for columns that are updated rarely."""
MAX_STATES = 8
"""Largest number of different integers in a column that is taken for a switch, and held."""
SCALAR_COLUMN = "total_field"
MAGNETIC_COLUMNS = {name for name, column in COLUMNS.items() if column.units == "nT"}


def sensor_logs(logs: Sequence[xr.Dataset], named: Sequence[bool]) -> tuple[list[int], list[int]]:
    """Return the indices of the sensors' own logs, and of the vehicle's logs that belong to them.

    Parameters
    ----------
    logs : sequence of Dataset (time)
        One for each file, or its first rows.
    named : sequence of bool
        Which of them the user calls a sensor's log. If none: a log with the field and without a position is a
        sensor's, a log without any magnetic column is the vehicle's.

    Returns
    -------
    tuple of list of int
        Indices of the sensors' and of the vehicle's logs; both empty where there are not both.

    Raises
    ------
    FormatError
        The user calls a log a sensor's that has no field.
    """
    if any(named):
        sensors = [k for k, is_named in enumerate(named) if is_named]
        vehicles = [k for k, is_named in enumerate(named) if not is_named]
        for k in sensors:
            if not _has_field(logs[k]):
                source = logs[k].attrs.get("source", "the sensor's log")
                raise FormatError(source, "expected mag_x mag_y mag_z, or total_field, in a sensor's log")
    else:
        sensors = [k for k, log in enumerate(logs) if _has_field(log) and not _is_placed(log)]
        vehicles = [k for k, log in enumerate(logs) if not MAGNETIC_COLUMNS & set(log.data_vars)]
    return (sensors, vehicles) if sensors and vehicles else ([], [])


def _has_field(log: xr.Dataset) -> bool:
    vector = all(name in log for name in CHANNELS)
    return (vector or SCALAR_COLUMN in log) and "observatory" not in log.attrs


def _is_placed(log: xr.Dataset) -> bool:
    return "latitude" in log and "longitude" in log


class VehicleTelemetry:
    """A vehicle's telemetry, interpolated to the times of sensors' logs, in pieces.

    Parameters
    ----------
    vehicle : Dataset (time)
        The vehicle's logs, joined.
    clock_offset_s : float
        Added to the sensors' times, s: how far the sensor's clock is behind the vehicle's.
    """

    def __init__(self, vehicle: xr.Dataset, clock_offset_s: float) -> None:
        self._vehicle, self._offset_s = vehicle, clock_offset_s
        self._time = vehicle["time"].to_numpy()
        self._max_gap_s = _max_gap(self._time)
        self._start, self._end = np.inf, -np.inf  # of the rows with telemetry

    def add_to(self, sensor: xr.Dataset, *, is_first: bool) -> xr.Dataset:
        """Return a piece of a sensor's log with the vehicle's columns that it lacks.

        Parameters
        ----------
        sensor : Dataset (time)
            A piece of a sensor's log.
        is_first : bool
            Losses of the vehicle's logs are counted with this piece.

        Raises
        ------
        FormatError
            The sensor's times count from a boot and the vehicle's do not, or the other way round.
        """
        sensor = self._shifted(sensor)
        time = sensor["time"].to_numpy()
        vehicle = further(self._vehicle) if set(CHANNELS) <= set(sensor.data_vars) else self._vehicle
        columns = {
            str(name): (
                "time",
                _interpolated(time, self._time, str(name), column.to_numpy()),
                dict(column.attrs),
            )
            for name, column in vehicle.data_vars.items()
            if name not in sensor and name not in CHANNEL_TIMES
        }
        outside = (time < self._time[0]) | (time > self._time[-1])
        right = np.clip(np.searchsorted(self._time, time), 1, max(len(self._time) - 1, 1))
        widths = np.diff(self._time, prepend=self._time[0])[np.minimum(right, len(self._time) - 1)]
        in_gaps = ~outside & (widths > self._max_gap_s) & ~np.isin(time, self._time)
        covered = time[~outside]
        if len(covered):
            self._start, self._end = min(self._start, covered[0]), max(self._end, covered[-1])
        attrs = join_attrs([sensor, vehicle if is_first else uncounted(vehicle)])
        attrs.pop(COMPASSES_ATTRIBUTE, None)
        counts = {"rows_outside": int(outside.sum()), "rows_in_gaps": int(in_gaps.sum())}
        combined = sensor.assign(columns)
        combined.attrs = attrs
        return with_losses(combined, counts)

    def opener(
        self, source: Callable[[int], Iterator[xr.Dataset]], *, is_first: bool
    ) -> Callable[[int], Iterator[xr.Dataset]]:
        """Return a function that opens a sensor's log as `source` does, with the vehicle's columns."""

        def combined(rows: int) -> Iterator[xr.Dataset]:
            for k, piece in enumerate(source(rows)):
                yield self.add_to(piece, is_first=is_first and not k)

        return combined

    def note(self, source: str) -> str:
        """Return a note for the user on how the logs were combined.

        Raises
        ------
        FormatError
            The sensor's and the vehicle's logs have no time in common.
        """
        vehicle = _shortened(str(self._vehicle.attrs.get("source", "the vehicle's logs")))
        first, last = (_moment(self._vehicle, time) for time in self._time[[0, -1]])
        if self._end < self._start:
            raise FormatError(
                source,
                f"expected times from {first} to {last}, those of {vehicle}; "
                "--clock-offset S adds S seconds to the sensor's times",
            )
        clocks = f"with {self._offset_s:+g} s on the sensor's clock (--clock-offset)"
        if not self._offset_s:
            clocks = "the clocks are assumed to agree (--clock-offset S shifts the sensor's)"
        return (
            f"{source}: with the telemetry of {vehicle}, from {first} to {last}; "
            f"{self._end - self._start:.0f} s in common; {clocks}"
        )

    def _shifted(self, sensor: xr.Dataset) -> xr.Dataset:
        """Return a sensor's log on the vehicle's clock."""
        from_boot, vehicle_from_boot = counts_from_boot(sensor), counts_from_boot(self._vehicle)
        if self._offset_s:
            sensor = sensor.assign_coords(time=sensor["time"].copy(data=sensor["time"] + self._offset_s))
            for name in set(CHANNEL_TIMES) & set(sensor.data_vars):
                sensor[name] = sensor[name].copy(data=sensor[name] + self._offset_s)
            if from_boot and not vehicle_from_boot:
                sensor.attrs.pop("time_reference", None)
        elif from_boot != vehicle_from_boot:
            which = "the sensor's" if from_boot else "the vehicle's"
            raise FormatError(
                sensor.attrs.get("source", "the sensor's log"),
                f"{which} times count from a start that the log does not state: "
                "--clock-offset S is added to the sensor's times",
            )
        return sensor


def combine(logs: Sequence[xr.Dataset], named: Sequence[bool], clock_offset_s: float) -> list[xr.Dataset]:
    """Return the sensors' logs among `logs` with the vehicle's telemetry, and the logs that have both.

    Parameters
    ----------
    logs : sequence of Dataset (time)
        One or more for each file.
    named : sequence of bool
        Which of them the user calls a sensor's log.
    clock_offset_s : float
        Added to the sensors' times, s.

    Raises
    ------
    FormatError
        No time in common; times of which only one kind counts from 1970.
    WrongUse
        A clock offset is given, but no sensor's log next to a vehicle's.
    """
    sensors, vehicles = sensor_logs(logs, named)
    if not sensors:
        refuse_offset(clock_offset_s)
        return list(logs)
    telemetry = VehicleTelemetry(join([logs[k] for k in vehicles]), clock_offset_s)
    combined = []
    for k, log in enumerate(logs):
        if k in sensors:
            combined.append(telemetry.add_to(log, is_first=k == sensors[0]))
        elif k not in vehicles:
            combined.append(log)
    sources = ", ".join(dict.fromkeys(str(logs[k].attrs.get("source", "")) for k in sensors))
    return [with_note(combined[0], telemetry.note(sources)), *combined[1:]]


def refuse_offset(clock_offset_s: float) -> None:
    """Raise WrongUse if a clock offset is given without a sensor's log next to a vehicle's."""
    if clock_offset_s:
        raise WrongUse("--clock-offset: expected a sensor's log next to a vehicle's logs; see --sensor-log")


def with_note(log: xr.Dataset, note: str) -> xr.Dataset:
    """Return a deployment with one more note for the user."""
    return log.assign_attrs({NOTES: "\n".join([*noted(log.attrs), note])})


def _interpolated(target: FloatArray, time: FloatArray, name: str, values: FloatArray) -> FloatArray:
    """Interpolate a column (m,) from `time` (m,), s, to `target` (n,), s, by the rule for its kind."""
    known = np.isfinite(values)
    time, values = time[known], values[known]
    max_gap_s = _max_gap(time)
    if name not in CIRCLES and _is_state(values):
        return latest(target, time, values, max_gap_s)
    return linear(target, time, values, max_gap_s, name)


def _is_state(values: FloatArray) -> bool:
    """Return True if values (m,) are a few integers, such as those of a switch or a mode."""
    distinct = np.unique(values)
    return len(distinct) <= MAX_STATES and bool((distinct == np.round(distinct)).all())


def _max_gap(time: FloatArray) -> float:
    """Return the longest interval, s, of times (m,), s, that is not a gap."""
    steps = np.diff(time)
    return max(MIN_GAP_S, GAP_INTERVALS * float(np.median(steps)) if len(steps) else 0.0)


def _shortened(sources: str) -> str:
    """Return the names of the first log and, of more than two, of the last."""
    names = sources.split(", ")
    return f"{names[0]} to {names[-1]} ({len(names)} logs)" if len(names) > 2 else " and ".join(names)


def _moment(log: xr.Dataset, time: float) -> str:
    if counts_from_boot(log):
        return f"{time:.1f} s"
    return f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M:%S} UTC"
