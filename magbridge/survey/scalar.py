"""Logs with a scalar magnetometer to the samples of a survey, before lag and heading error are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.figure_of_merit import BoxFlight, box_flight
from magbridge.calibration.fitting.scalar_log import compensate, moved_to_sensor, scalar_reading
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS, require
from magbridge.correction import Correction
from magbridge.errors import DataError, FormatError
from magbridge.field.igrf import magnitude
from magbridge.field.reference import main_field, require_date
from magbridge.rows import correct_rows
from magbridge.survey.read import joined, located
from magbridge.survey.samples import Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["COMPENSATION", "AlignmentTerm", "BoxRows", "ScalarRows", "scalar_rows"]

COMPENSATION = "compensation"
"""Name of the term that holds the uncertain combinations of a calibration's coefficients."""
SPEED_SMOOTHING_S = 2.0
"""Time over which the velocity is averaged, s."""
MAX_SPEED_GAP_INTERVALS = 3.0
"""Intervals without a sample after which the velocity starts again."""


class AlignmentTerm(NamedTuple):
    """A disturbance whose effect is fitted."""

    name: str
    columns: FloatArray
    """Effect of each unknown on each sample, nT, (n, r)."""


class BoxRows(NamedTuple):
    """A box flight within a survey, which is not fitted."""

    box: BoxFlight
    heading: FloatArray
    """Heading of each of the log's samples, rad."""
    raw: FloatArray
    """Anomaly as read, nT."""
    value: FloatArray
    """Anomaly after compensation by the calibration, nT."""
    terms: tuple[AlignmentTerm, ...]


@dataclass(frozen=True, eq=False)
class ScalarRows:
    """The samples of one or several logs with a scalar magnetometer, before alignment."""

    column: str
    samples: Samples
    """At the places of the positions; `value` is compensated where the calibration has the sensor."""
    raw: FloatArray
    """Anomaly as read, nT, (n,)."""
    heading: FloatArray
    """Heading, or course where no heading is known, rad, (n,)."""
    velocity: FloatArray
    """North and east, m/s, (n, 2)."""
    terms: tuple[AlignmentTerm, ...]
    """Channels, or uncertain combinations of the compensation's coefficients."""
    compensated: dict[str, float]
    """Standard deviation of each part of the calibration's compensation, nT."""
    boxes: tuple[BoxRows, ...] = ()


def scalar_rows(
    logs: Sequence[xr.Dataset],
    column: str,
    names: Sequence[str] = (),
    calibrations: Sequence[Calibration] = (),
    lever: tuple[float, float, float] | None = None,
) -> ScalarRows:
    """Return the samples of logs with a scalar magnetometer; arguments as of :func:`.run.scalar_survey`.

    FormatError: a column is missing, or fewer than ten samples have a reading and a position. DataError: the
    reading is not nT, or the number of calibrations is neither one nor that of the logs.
    """
    known: list[Calibration | None] = list(calibrations) or [None]
    if len(known) not in (1, len(logs)):
        raise DataError(
            f"{len(logs)} logs with {column}, and {len(known)} calibrations: give one for all, or one each"
        )
    known = known * len(logs) if len(known) == 1 else known
    pairs = zip(logs, known, strict=True)
    parts = [_log_rows(log, column, names, calibration, lever) for log, calibration in pairs]
    return parts[0] if len(parts) == 1 else _joined(parts)


def _joined(parts: Sequence[ScalarRows]) -> ScalarRows:
    """Join the samples of several logs; a term of the same name and size is one term."""
    # Terms of one name share their coefficients across logs; rows of other logs are zero.
    edges = np.cumsum([0, *(len(part.raw) for part in parts)])
    blocks: dict[tuple[str, int], FloatArray] = {}
    for part, first in zip(parts, edges[:-1].tolist(), strict=True):
        for name, columns in part.terms:
            key = name, columns.shape[1]
            whole = blocks.setdefault(key, np.zeros((int(edges[-1]), columns.shape[1])))
            whole[first : first + len(columns)] = columns
    return ScalarRows(
        parts[0].column,
        joined([part.samples for part in parts]),
        np.concatenate([part.raw for part in parts]),
        np.concatenate([part.heading for part in parts]),
        np.concatenate([part.velocity for part in parts]),
        tuple(AlignmentTerm(name, columns) for (name, _), columns in blocks.items()),
        parts[0].compensated,
        tuple(box for part in parts for box in part.boxes),
    )


def _log_rows(
    log: xr.Dataset,
    column: str,
    names: Sequence[str],
    calibration: Calibration | None,
    lever: tuple[float, float, float] | None,
) -> ScalarRows:
    """Return the samples of one log."""
    require(log, ("latitude", "longitude", column, *names))
    require_date(log)
    # A calibration of the sensor compensates it and leaves its uncertain combinations as terms; without one,
    # the telemetry channels are the terms.
    sensors = calibration.sensors if calibration is not None else ()
    sensor = next((known for known in sensors if known.column == column), None)
    compensated: dict[str, float] = {}
    if calibration is not None and sensor is not None:
        require(log, CHANNELS)
        corrected = correct_rows(Correction(calibration), log)
        log = log.sel(time=corrected["time"]) if log.sizes["time"] != corrected.sizes["time"] else log
        # The calibration removes the platform; its uncertain combinations are fitted with the survey.
        found = compensate(corrected, log, sensor)
        value, compensated = found.field, found.contribution
        terms: tuple[AlignmentTerm, ...] = (AlignmentTerm(COMPENSATION, found.modes),)
    else:
        value, terms = scalar_reading(log, column), _channel_terms(log, names)
    log = moved_to_sensor(log, lever) if lever else log
    expected = magnitude(main_field(log))
    if "daily_variation" in log:
        expected = expected + log["daily_variation"].to_numpy()
    # Anomalies: minus the main field and the daily variation.
    raw, value = scalar_reading(log, column) - expected, value - expected
    samples, known = located(log, value, column)
    for term in terms:
        known &= np.isfinite(term.columns).all(axis=1)
    # Without a heading, the course over ground stands for it.
    velocity = _velocity(samples.time, samples.place)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    if "heading" in log:
        own = np.radians(log["heading"].to_numpy().astype(float))
        heading = np.where(np.isfinite(own), own, heading)
    boxes = _boxes(log, samples.time, heading, raw, value, terms)
    # Manoeuvres of a box are not fitted: they test the result.
    for box_rows in boxes:
        known &= ~box_rows.box.rows(len(known))
    samples = replace(samples, rho=None).part(known)
    used = tuple(AlignmentTerm(name, columns[known]) for name, columns in terms)
    return ScalarRows(column, samples, raw[known], heading[known], velocity[known], used, compensated, boxes)


def _velocity(time: FloatArray, place: FloatArray) -> FloatArray:
    """Return the velocity north and east (n, 2), m/s, over some seconds, never across a gap of the log."""
    interval = max(float(np.median(np.diff(time))), 1e-3)
    half = max(1, round(0.5 * SPEED_SMOOTHING_S / interval))
    # Central difference over the smoothing time, cut at the ends of a stretch without gaps.
    stretch = np.cumsum(np.diff(time, prepend=time[0]) > MAX_SPEED_GAP_INTERVALS * interval)
    first, last = np.searchsorted(stretch, stretch), np.searchsorted(stretch, stretch, "right") - 1
    rows = np.arange(len(time))
    before, after = np.maximum(rows - half, first), np.minimum(rows + half, last)
    duration = np.maximum(time[after] - time[before], 1e-9)
    return np.asarray((place[after] - place[before]) / duration[:, None])


def _boxes(
    log: xr.Dataset,
    time: FloatArray,
    heading: FloatArray,
    raw: FloatArray,
    value: FloatArray,
    terms: tuple[AlignmentTerm, ...],
) -> tuple[BoxRows, ...]:
    """Return the log's box flight, if it holds one."""
    if not {"roll", "pitch", "heading"} <= set(log.variables):
        return ()
    roll, pitch = (log[name].to_numpy().astype(float) for name in ("roll", "pitch"))
    box = box_flight(time, roll, pitch, np.degrees(heading))
    return () if box is None else (BoxRows(box, heading, raw, value, terms),)


def _channel_terms(log: xr.Dataset, names: Sequence[str]) -> tuple[AlignmentTerm, ...]:
    """Return each channel's columns: its value, and times cosine and sine of the heading where that is known.

    A channel is centred and divided by its swing (2 to 98 %).
    """
    terms = []
    for name in names:
        values = log[name].to_numpy().astype(float)
        if not np.isfinite(values).any():
            raise FormatError(log.attrs.get("source", "the log"), "expected numbers, got none", column=name)
        # Centre and swing, so that one prior width serves channels in any unit.
        low, middle, high = np.nanquantile(values, [0.02, 0.5, 0.98]).tolist()
        z = (values - middle) / max(high - low, 1e-12)
        # A channel's field turns with the vehicle: its value, and times cosine and sine of the heading.
        columns = [z]
        if "heading" in log:
            angle = np.radians(log["heading"].to_numpy().astype(float))
            columns += [z * np.cos(angle), z * np.sin(angle)]
        terms.append(AlignmentTerm(name, np.stack(columns, axis=1)))
    return tuple(terms)
