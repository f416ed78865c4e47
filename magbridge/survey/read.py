"""Logs and tables to the samples of a survey, corrected here or elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.observe import at_one_time
from magbridge.calibration.fitting.uncertainty import apart_from_level
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS, require
from magbridge.correction import Correction
from magbridge.errors import FormatError
from magbridge.field.geodesy import separation
from magbridge.field.igrf import magnitude
from magbridge.field.reference import main_field, placed, positions
from magbridge.records import Quality
from magbridge.rows import correct_rows
from magbridge.survey.samples import Samples
from magbridge.wording import counted

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from magbridge.calibration.fitting.result import Creep

__all__ = [
    "corrected_by_others", "from_vector", "is_table", "joined", "located", "read_points", "read_table",
    "without_creep",
]  # fmt: skip

ANOMALY_COLUMNS = (
    "anomaly", "total_field_anomaly_nt", "total_field_anomaly", "mag_anomaly", "magnetic_anomaly", "tfa"
)  # fmt: skip
"""Names of the anomaly in third-party tables."""
HEIGHT = ("height", "altitude", "height_m", "height_ell_m", "altitude_m", "elevation")
TABLE_SUFFIXES = (".csv", ".csv.gz", ".csv.xz", ".csv.bz2")
MODES, FAINT = 24, 0.05
"""Uncertain combinations of a calibration at most, and nT below which one does not matter."""
MIN_LOCATED_SAMPLES = 10
"""Samples of a table or a log, at least."""
THINNED = 2_000
"""Samples by which they are found."""


def is_table(path: Path) -> bool:
    """Return whether a file is a table of lines: positions and an anomaly, without a vector or a time."""
    if not path.name.lower().endswith(TABLE_SUFFIXES):
        return False
    names = set(_table(path, rows=0).columns)
    return (
        not names & set(CHANNELS) and "time" not in names and bool(names & {*ANOMALY_COLUMNS, "total_field"})
    )


def read_table(path: Path) -> Samples:
    """Read a table: longitude, latitude, anomaly (nT), and where there are any height, line, line_type.

    FormatError: a column is missing or holds something else than numbers.
    """
    table = _table(path)
    value = _numbers(path, table, _first(path, table, ANOMALY_COLUMNS))
    longitude, latitude = (_numbers(path, table, name) for name in ("longitude", "latitude"))
    heights = [name for name in HEIGHT if name in table]
    if "depth" in table:
        depth = _numbers(path, table, "depth")
    else:
        depth = -_numbers(path, table, heights[0]) if heights else np.zeros(len(value))
    lines = next((name for name in ("line", "line_number", "line_no") if name in table), None)
    line = np.zeros(len(value), int)
    if lines:  # an empty cell is a line of its own
        line = np.unique(table[lines].astype(str).fillna(""), return_inverse=True)[1]
    kind = table["line_type"].astype(str).str.upper() if "line_type" in table else None
    tie = np.zeros(len(value), bool) if kind is None else (kind == "TIE").to_numpy()
    known = np.isfinite(value) & np.isfinite(longitude) & np.isfinite(latitude)
    if known.sum() < MIN_LOCATED_SAMPLES:
        raise FormatError(
            path, f"only {counted(int(known.sum()), 'row')} with longitude, latitude and anomaly"
        )
    origin = float(np.median(latitude[known])), float(np.median(longitude[known]))
    north, east = separation(*origin, latitude, longitude)
    return Samples(
        np.stack([north, east], axis=1), depth, np.full(len(value), np.nan), value, line.ravel(), tie, origin
    ).part(known)


def read_points(
    path: Path, origin: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray | None, FloatArray]:
    """Read points: longitude and latitude (n,), deg, depth (n,), m, if known, and m north and east (n, 2).

    FormatError: a column is missing or holds something else than numbers, or a place is not known.
    """
    table = _table(path)
    longitude, latitude = (_numbers(path, table, name) for name in ("longitude", "latitude"))
    if wrong := int((~np.isfinite(longitude + latitude)).sum()):
        raise FormatError(path, f"expected longitude and latitude in every row, {wrong} lack one")
    heights = [name for name in HEIGHT if name in table]
    depth = -_numbers(path, table, heights[0]) if heights else None
    if "depth" in table:
        depth = _numbers(path, table, "depth")
    return longitude, latitude, depth, np.stack(separation(*origin, latitude, longitude), axis=1)


def corrected_by_others(ds: xr.Dataset) -> Samples:
    """Return the samples of a log with ``total_field`` or ``anomaly``, nT, and positions.

    FormatError: it has neither, or no position.
    """
    require(ds, ("latitude", "longitude"))
    if "anomaly" in ds:
        value = ds["anomaly"].to_numpy().astype(float)
    elif "total_field" in ds:
        value = ds["total_field"].to_numpy().astype(float) - magnitude(main_field(ds))
    else:
        source = ds.attrs.get("source", "the log")
        raise FormatError(source, "expected mag_x mag_y mag_z, total_field or anomaly")
    samples, known = located(ds, np.where(_doubtful(ds), np.nan, value - _daily(ds)))
    level_sigma = float(ds["level_sigma"].median()) if "level_sigma" in ds else 0.0
    return replace(samples.part(known), level_sigma=level_sigma)


def from_vector(ds: xr.Dataset, calibration: Calibration) -> Samples:
    """Correct a log with its calibration; flagged samples are left out, the calibration's sigma is kept.

    FormatError: it has no position.
    """
    require(ds, ("latitude", "longitude"))
    ds = at_one_time(ds)
    corrected = correct_rows(Correction(calibration), ds)
    value = np.where(_doubtful(corrected), np.nan, corrected["anomaly"].to_numpy() - _daily(ds))
    samples, known = located(ds, value, by_line=False)
    field = np.stack([ds[name].to_numpy() for name in CHANNELS], axis=1)[known]
    channels = [
        ds[name].to_numpy() if name in ds else np.full(len(value), np.nan) for name in calibration.channels
    ]
    read = np.stack(channels, axis=1)[known] if channels else np.empty((len(field), 0))
    return replace(
        samples.part(known),
        rho=None if calibration.warnings else calibration.noise.autocorrelation,  # else it is the crust
        modes=_modes(apart_from_level(calibration), field, read, samples.time[known]),
        level_sigma=calibration.reference.level_sigma,
    )


def located(
    ds: xr.Dataset, value: FloatArray, name: str = "a field", *, by_line: bool = True
) -> tuple[Samples, BoolArray]:
    """Return all rows of a log with anomalies (n,), nT, and which of them can be used, (n,).

    Parameters
    ----------
    ds : Dataset
        The log.
    value : (n,) array
        nT; NaN where it is not known.
    name : str
        Name of the value in the error.
    by_line : bool
        Whether the log's ``line`` and ``line_type`` divide it into lines.

    Raises
    ------
    FormatError
        Fewer than ten rows have a value and a position.
    """
    longitude, latitude, depth = positions(ds)
    known = np.isfinite(value) & np.isfinite(latitude) & placed(ds)
    if (many := int(known.sum())) < MIN_LOCATED_SAMPLES:
        source = ds.attrs.get("source", "the log")
        raise FormatError(source, f"only {counted(many, 'sample')} with {name} and a position")
    origin = float(np.median(latitude[known])), float(np.median(longitude[known]))
    place = np.stack(separation(*origin, latitude, longitude), axis=1)
    line, tie = np.zeros(len(value), int), np.zeros(len(value), bool)
    if by_line and "line" in ds:
        names = ds["line"].to_numpy()
        names = names.astype(str) if names.dtype.kind == "O" else names
        line = np.unique(names, return_inverse=True)[1].ravel()
        if "line_type" in ds:
            tie = np.char.upper(ds["line_type"].to_numpy().astype(str)) == "TIE"
    time = np.asarray(ds["time"].to_numpy(), float)
    return Samples(place, depth, time, value, line, tie, origin), known


def without_creep(ds: xr.Dataset, creep: Creep | None) -> xr.Dataset:
    """Return a log without the creep of its sensor's offset that was found together with the calibration."""
    if creep is None or not set(CHANNELS) <= set(ds):
        return ds
    offset = creep.offset_at(ds["time"].to_numpy().astype(float))
    return ds.assign({name: ds[name] - one for name, one in zip(CHANNELS, offset.T, strict=True)})


def joined(parts: Sequence[Samples]) -> Samples:
    """Join the samples of several logs about one origin: lines and modes stay each log's own."""
    origin = parts[0].origin
    places, lines, first = [], [], 0
    for one in parts:
        shift = separation(*origin, *one.origin)
        places.append(one.place + np.array(shift))
        lines.append(one.line + first)
        first += int(one.line.max()) + 1
    many = sum(one.modes.shape[1] for one in parts)
    modes = np.zeros((sum(len(one.value) for one in parts), many))
    row = column = 0
    # Block diagonal: the uncertain combinations of one log do not touch another log.
    for one in parts:
        n, r = one.modes.shape
        modes[row : row + n, column : column + r] = one.modes
        row, column = row + n, column + r
    depth, time, value, tie, weight = (
        np.concatenate([getattr(one, name) for one in parts])
        for name in ("depth", "time", "value", "tie", "weight")
    )
    return Samples(
        np.concatenate(places), depth, time, value, np.concatenate(lines), tie, origin, weight,
        _common_rho([one.rho for one in parts]), modes, max(one.level_sigma for one in parts),
    )  # fmt: skip


def _common_rho(rho: Sequence[float | None]) -> float | None:
    known = [one for one in rho if one is not None]
    return max(known) if len(known) == len(rho) else None


def _doubtful(corrected: xr.Dataset) -> BoolArray:
    """Return True for samples with a flag that may affect the field (n,); all False without flags."""
    quality = np.asarray(corrected.get("quality", np.zeros(corrected.sizes["time"])), float)
    return np.asarray(np.nan_to_num(quality).astype(int) & int(~Quality.NO_BORESIGHT), bool)


def _daily(ds: xr.Dataset) -> FloatArray | float:
    """Return a base station's variation (n,), nT; 0 without one."""
    return ds["daily_variation"].to_numpy() if "daily_variation" in ds else 0.0


def _modes(calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray) -> FloatArray:
    """Return the change of the samples with 1-sigma of each uncertain combination of coefficients, (n, r)."""

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


def _first(path: Path, table: pd.DataFrame, names: Sequence[str]) -> str:
    for name in names:
        if name in table:
            return name
    raise FormatError(path, f"expected a column {names[0]!r}; there are: {' '.join(map(str, table.columns))}")


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
