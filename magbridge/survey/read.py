"""Readers of a survey's samples from logs and tables, corrected here or by other software.

Samples of a scalar magnetometer also hold the heading, velocity and terms that its alignment needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.calibration.correct import correct
from magbridge.calibration.figure_of_merit import BoxFlight, box_flight
from magbridge.calibration.fitting.observe import at_one_time
from magbridge.calibration.fitting.scalar_log import compensate, moved_to_sensor, scalar_reading
from magbridge.calibration.fitting.uncertainty import apart_from_level
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS, require
from magbridge.correction import Correction
from magbridge.diagnostics import Diagnostic
from magbridge.errors import DataError, FormatError
from magbridge.field.geodesy import separation
from magbridge.field.igrf import magnitude
from magbridge.field.reference import (
    UNRECORDED_SIGMA_NT,
    main_field,
    placed,
    positions,
    require_date,
    variation_level_sigma,
)
from magbridge.records import Quality
from magbridge.rows import correct_rows
from magbridge.survey.samples import Samples
from magbridge.wording import counted

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from magbridge.calibration.fitting.result import Creep

__all__ = [
    "COMPENSATION", "ScalarRows", "corrected_by_others", "from_vector", "is_table", "joined", "located",
    "read_points", "read_table", "scalar_rows", "without_creep",
]  # fmt: skip

ANOMALY_COLUMNS = (
    "anomaly", "total_field_anomaly_nt", "total_field_anomaly", "mag_anomaly", "magnetic_anomaly", "tfa"
)  # fmt: skip
"""Names of the anomaly in third-party tables."""
HEIGHT = ("height", "altitude", "height_m", "height_ell_m", "altitude_m", "elevation")
TABLE_SUFFIXES = (".csv", ".csv.gz", ".csv.xz", ".csv.bz2")
MODES, FAINT = 24, 0.05
"""Largest number of a calibration's modes, and smallest RMS effect of a mode that is used, nT."""
MIN_LOCATED_SAMPLES = 10
"""Smallest number of usable samples of a table or a log."""
THINNED = 2_000
"""Approximate number of samples from which the modes are determined."""


def is_table(path: Path) -> bool:
    """Return True if a file is a CSV table with an anomaly or total field, but without vector and time."""
    if not path.name.lower().endswith(TABLE_SUFFIXES):
        return False
    names = set(_table(path, rows=0).columns)
    return (
        not names & set(CHANNELS) and "time" not in names and bool(names & {*ANOMALY_COLUMNS, "total_field"})
    )


TIE = "TIE", "1", "1.0"
"""Cells of ``line_type`` that mark a tie line."""


def read_table(path: Path) -> Samples:
    """Read the samples of a table: longitude, latitude (deg), anomaly (nT).

    The columns height (m), line and line_type are optional. FormatError: a column is missing or is not
    numeric, or there are too few rows.
    """
    table = _table(path)
    names = (name for name in ANOMALY_COLUMNS if name in table)
    value = _numbers(path, table, next(names, ANOMALY_COLUMNS[0]))
    longitude, latitude, depth = _places(path, table)
    depth = np.zeros(len(value)) if depth is None else depth
    lines = next((name for name in ("line", "line_number", "line_no") if name in table), None)
    line, line_names = _labels(np.zeros(len(value), int))
    if lines:  # an empty cell is a line of its own
        line, line_names = _labels(table[lines].astype(str).fillna("").to_numpy(str))
    kind = table["line_type"].astype(str).str.upper() if "line_type" in table else None
    tie = np.zeros(len(value), bool) if kind is None else kind.isin(TIE).to_numpy()
    known = np.isfinite(value) & np.isfinite(longitude) & np.isfinite(latitude)
    if known.sum() < MIN_LOCATED_SAMPLES:
        raise FormatError(
            path, f"only {counted(int(known.sum()), 'row')} with longitude, latitude and anomaly"
        )
    origin = float(np.median(latitude[known])), float(np.median(longitude[known]))
    place = np.stack(separation(*origin, latitude, longitude), axis=1)
    no_time = np.full(len(value), np.nan)
    samples = Samples(place, depth, no_time, value, line, tie, origin, line_names=line_names)
    return replace(samples.part(known), level_sigma=UNRECORDED_SIGMA_NT)


def read_points(
    path: Path, origin: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray | None, FloatArray]:
    """Read points of a table: longitude, latitude (n,), deg, depth (n,), m, or None, and place (n, 2).

    The place is in m north and east of `origin`. FormatError: a column is missing or is not numeric, or a row
    has no position.
    """
    table = _table(path)
    longitude, latitude, depth = _places(path, table)
    if wrong := int((~np.isfinite(longitude + latitude)).sum()):
        raise FormatError(path, f"expected longitude and latitude in every row, {wrong} lack one")
    return longitude, latitude, depth, np.stack(separation(*origin, latitude, longitude), axis=1)


def corrected_by_others(ds: xr.Dataset) -> Samples:
    """Return the samples of a log with positions and a corrected ``total_field`` or ``anomaly``, nT.

    FormatError: the log has neither, or no position.
    """
    require(ds, ("latitude", "longitude"))
    if "anomaly" in ds:
        value = ds["anomaly"].to_numpy().astype(float)
    elif "total_field" in ds:
        value = ds["total_field"].to_numpy().astype(float) - magnitude(main_field(ds))
    else:
        source = ds.attrs.get("source", "the log")
        raise FormatError(source, "expected mag_x mag_y mag_z, total_field or anomaly")
    samples, known = _unflagged(ds, ds, value)
    level_sigma = float(ds["level_sigma"].median()) if "level_sigma" in ds else 0.0
    return replace(samples.part(known), level_sigma=hypot(samples.level_sigma, level_sigma))


def from_vector(ds: xr.Dataset, calibration: Calibration) -> Samples:
    """Return the unflagged samples of a log, corrected with a calibration, whose uncertainty is in `modes`.

    FormatError: the log has no position.
    """
    require(ds, ("latitude", "longitude"))
    ds = at_one_time(ds)
    corrected = correct_rows(Correction(calibration), ds)
    samples, known = _unflagged(ds, corrected, corrected["anomaly"].to_numpy())
    field = np.stack([ds[name].to_numpy() for name in CHANNELS], axis=1)[known]
    channels = [
        ds[name].to_numpy() if name in ds else np.full(len(known), np.nan) for name in calibration.channels
    ]
    read = np.stack(channels, axis=1)[known] if channels else np.empty((len(field), 0))
    noise = calibration.noise
    return replace(
        samples.part(known),
        # autocorrelation of successive samples; with warnings it is the crust's
        rho=None if calibration.warnings else (1.0 - noise.white) * noise.autocorrelation,
        modes=_modes(apart_from_level(calibration), field, read, samples.time[known]),
        level_sigma=hypot(samples.level_sigma, calibration.reference.level_sigma),
    )


def located(ds: xr.Dataset, value: FloatArray, name: str = "a field") -> tuple[Samples, BoolArray]:
    """Return all rows of a log as samples, and a mask (n,) of the rows with a value and a position.

    `value` (n,) is the anomaly, nT, NaN where unknown; `name` is its name in the error. The log's ``line``
    and ``line_type`` divide it into lines. FormatError: fewer than ten usable rows.
    """
    longitude, latitude, depth = positions(ds)
    known = np.isfinite(value) & np.isfinite(latitude) & placed(ds)
    if (many := int(known.sum())) < MIN_LOCATED_SAMPLES:
        source = ds.attrs.get("source", "the log")
        raise FormatError(source, f"only {counted(many, 'sample')} with {name} and a position")
    origin = float(np.median(latitude[known])), float(np.median(longitude[known]))
    place = np.stack(separation(*origin, latitude, longitude), axis=1)
    line, tie = np.zeros(len(value), int), np.zeros(len(value), bool)
    line_names: tuple[str, ...] = ()
    if "line" in ds:
        names = ds["line"].to_numpy()
        names = names.astype(str) if names.dtype.kind == "O" else names
        line, line_names = _labels(names)
        if "line_type" in ds:
            tie = np.isin(np.char.upper(ds["line_type"].to_numpy().astype(str)), TIE)
    time = np.asarray(ds["time"].to_numpy(), float)
    level_sigma = variation_level_sigma(ds) if "daily_variation" in ds else UNRECORDED_SIGMA_NT
    samples = Samples(
        place, depth, time, value, line, tie, origin, level_sigma=level_sigma, line_names=line_names
    )
    return samples, known


def _labels(names: NDArray[Any]) -> tuple[IndexArray, tuple[str, ...]]:
    """Return the label (n,) of the line of each sample, and the text of each label's number or name."""
    found, line = np.unique(names, return_inverse=True)
    return line.ravel(), tuple(f"{one:g}" if isinstance(one, float) else str(one) for one in found.tolist())


def without_creep(ds: xr.Dataset, creep: Creep | None) -> xr.Dataset:
    """Return a log minus the slow drift of the sensor's offset that was fitted with the calibration."""
    if creep is None or not set(CHANNELS) <= set(ds):
        return ds
    offset = creep.offset_at(ds["time"].to_numpy().astype(float))
    return ds.assign({name: ds[name] - one for name, one in zip(CHANNELS, offset.T, strict=True)})


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several logs as one, about the first origin; lines and modes stay separate."""
    origin = parts[0].origin
    places, lines, first = [], [], 0
    names: list[str] = []
    for one in parts:
        shift = separation(*origin, *one.origin)
        places.append(one.place + np.array(shift))
        lines.append(one.line + first)
        labels = int(one.line.max()) + 1
        names += one.line_names[:labels] or map(str, range(first, first + labels))
        first += labels
    many = sum(one.modes.shape[1] for one in parts)
    modes = np.zeros((sum(len(one.value) for one in parts), many))
    row = column = 0
    # Block diagonal: the modes of one log do not affect another log.
    for one in parts:
        n, r = one.modes.shape
        modes[row : row + n, column : column + r] = one.modes
        row, column = row + n, column + r
    rho = [one.rho for one in parts if one.rho is not None]
    depth, time, value, tie, weight = (
        np.concatenate([getattr(one, name) for one in parts])
        for name in ("depth", "time", "value", "tie", "weight")
    )
    return Samples(
        np.concatenate(places), depth, time, value, np.concatenate(lines), tie, origin, weight,
        max(rho) if len(rho) == len(parts) else None, modes, max(one.level_sigma for one in parts),
        tuple(reason for one in parts for reason in one.left_out), tuple(names),
    )  # fmt: skip


def _unflagged(ds: xr.Dataset, corrected: xr.Dataset, value: FloatArray) -> tuple[Samples, BoolArray]:
    """Return the rows of a log and a mask as :func:`located` does, without flags that may affect the field.

    `value` (n,) is the anomaly, nT, with the daily variation; `corrected` has the flags, if there are any.
    """
    quality = np.nan_to_num(np.asarray(corrected.get("quality", np.zeros(len(value))), float)).astype(int)
    flags = [flag for flag in Quality if flag != Quality.NO_BORESIGHT]
    counts = {flag.names(): int((quality & flag != 0).sum()) for flag in flags}
    doubtful = quality & int(~Quality.NO_BORESIGHT) != 0
    reasons: tuple[Diagnostic, ...] = ()
    if doubtful.any():
        named = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
        values = {"count": int(doubtful.sum()), "samples": len(value), "flags": named}
        reasons = (Diagnostic("flagged_samples", values),)
    try:
        samples, known = located(ds, np.where(doubtful, np.nan, value - _daily(ds)))
    except FormatError as error:
        raise FormatError(error.file, "; ".join([error.expected, *(one.text for one in reasons)])) from error
    return replace(samples, left_out=reasons), known


def _daily(ds: xr.Dataset) -> FloatArray | float:
    """Return the daily variation (n,), nT, from a base station; 0 without a base station."""
    return ds["daily_variation"].to_numpy() if "daily_variation" in ds else 0.0


def _modes(calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray) -> FloatArray:
    """Return the change (n, r), nT, of the samples with 1-sigma of each uncertain coefficient combination."""

    def total(calibration: Calibration, rows: slice) -> FloatArray:
        return correct(calibration, field[rows], channels[rows], time[rows]).total

    def moved(step: FloatArray, rows: slice, unmoved: FloatArray) -> FloatArray:
        shifted = replace(calibration, coefficients=calibration.coefficients + step)
        return np.nan_to_num(total(shifted, rows) - unmoved)

    # Directions of the coefficients' covariance, scaled to 1-sigma; the largest effects are kept by SVD.
    values, vectors = np.linalg.eigh(calibration.covariance)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))
    few = slice(None, None, max(len(field) // THINNED, 1))
    here = total(calibration, few)
    seen = np.stack([moved(root, few, here) for root in roots.T], axis=1)
    _, sizes, turned = np.linalg.svd(seen, full_matrices=False)
    kept = [k for k in range(min(MODES, len(sizes))) if sizes[k] / np.sqrt(len(seen)) > FAINT]
    every = slice(None)
    here = total(calibration, every)
    columns = [moved(roots @ turned[k], every, here) for k in kept]
    return np.stack(columns, axis=1) if columns else np.empty((len(field), 0))


def _table(path: Path, rows: int | None = None) -> pd.DataFrame:
    import pandas as pd  # noqa: PLC0415 - slow to import

    try:
        table = pd.read_csv(path, nrows=rows, comment="#")
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(path, f"expected a table with a header row: {error}") from error
    return table.rename(columns=lambda name: str(name).partition("[")[0].strip().lower())


def _places(path: Path, table: pd.DataFrame) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return longitude and latitude (n,), deg, and the depth (n,), m; None without depth or height."""
    longitude, latitude = (_numbers(path, table, name) for name in ("longitude", "latitude"))
    if "depth" in table:
        return longitude, latitude, _numbers(path, table, "depth")
    height = next((name for name in HEIGHT if name in table), None)
    return longitude, latitude, None if height is None else -_numbers(path, table, height)


def _numbers(path: Path, table: pd.DataFrame, name: str) -> FloatArray:
    import pandas as pd  # noqa: PLC0415 - slow to import

    if name not in table:
        raise FormatError(
            path, f"expected this column; there are: {' '.join(map(str, table.columns))}", column=name
        )
    try:
        return np.asarray(pd.to_numeric(table[name]), float)
    except (ValueError, TypeError) as error:
        raise FormatError(path, f"expected numbers: {error}", column=name) from error


COMPENSATION = "compensation"
"""Name of the term that holds the uncertain combinations of a calibration's coefficients."""
SPEED_SMOOTHING_S = 2.0
"""Time over which the velocity is averaged, s."""
MAX_SPEED_GAP_INTERVALS = 3.0
"""Longest gap between samples across which a velocity is computed, in median intervals."""


class AlignmentTerm(NamedTuple):
    """Disturbance of the scalar whose r unknown coefficients are fitted with the survey."""

    name: str
    columns: FloatArray
    """Effect (n, r), nT, on each sample of a unit of each coefficient."""


class BoxRows(NamedTuple):
    """Box flight within a survey, which is left out of the fit and tests its result."""

    box: BoxFlight
    heading: FloatArray
    """Heading (n,) of each of the log's samples, rad."""
    raw: FloatArray
    """Anomaly (n,) as read, nT."""
    value: FloatArray
    """Anomaly (n,) after compensation by the calibration, nT."""
    terms: tuple[AlignmentTerm, ...]


@dataclass(frozen=True, eq=False)
class ScalarRows:
    """Samples of a scalar magnetometer from one or several logs, before alignment."""

    column: str
    samples: Samples
    """Samples at the logged positions; `value` is compensated if a calibration has the sensor."""
    raw: FloatArray
    """Anomaly (n,) as read, nT."""
    heading: FloatArray
    """Heading (n,), or course where the heading is unknown, rad."""
    velocity: FloatArray
    """Velocity (n, 2), north and east, m/s."""
    terms: tuple[AlignmentTerm, ...]
    """Terms of the telemetry channels, or of the compensation's uncertain coefficient combinations."""
    compensated: dict[str, float]
    """Standard deviation of each term of the calibration's compensation, nT."""
    boxes: tuple[BoxRows, ...] = ()


def scalar_rows(
    logs: Sequence[xr.Dataset],
    column: str,
    names: Sequence[str] = (),
    calibrations: Sequence[Calibration] = (),
    lever: tuple[float, float, float] | None = None,
) -> ScalarRows:
    """Return a scalar magnetometer's samples from logs; arguments are those of :func:`.run.scalar_survey`.

    FormatError: a column is missing, or fewer than ten samples have a reading and a position. DataError: the
    reading is not in nT, or the number of calibrations is neither one nor that of the logs.
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
    """Return the samples of several logs as one; terms of equal name and size become one term."""
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
    """Return a scalar magnetometer's samples from one log."""
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
    expected = magnitude(main_field(log)) + _daily(log)
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
    left_out: tuple[Diagnostic, ...] = ()
    for box_rows in boxes:
        inside = box_rows.box.rows(len(known))
        values = {"count": int((known & inside).sum()), "samples": len(known)}
        left_out, known = (Diagnostic("box_samples", values),), known & ~inside
    samples = replace(samples, rho=None, left_out=left_out).part(known)
    used = tuple(AlignmentTerm(name, columns[known]) for name, columns in terms)
    return ScalarRows(column, samples, raw[known], heading[known], velocity[known], used, compensated, boxes)


def _velocity(time: FloatArray, place: FloatArray) -> FloatArray:
    """Return the velocity (n, 2), north and east, m/s, averaged over seconds but not across a gap."""
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
    """Return the log's box flight as a tuple of one, or () if the log has none."""
    if not {"roll", "pitch", "heading"} <= set(log.variables):
        return ()
    roll, pitch = (log[name].to_numpy().astype(float) for name in ("roll", "pitch"))
    box = box_flight(time, roll, pitch, np.degrees(heading))
    return () if box is None else (BoxRows(box, heading, raw, value, terms),)


def _channel_terms(log: xr.Dataset, names: Sequence[str]) -> tuple[AlignmentTerm, ...]:
    """Return a term for each channel: its value, and with a heading also times cosine and sine of it.

    The value is centred and divided by the channel's swing (2 to 98 % quantile).
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
