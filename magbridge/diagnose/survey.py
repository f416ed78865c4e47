"""Deployments as arrays for a diagnosis: field, reference, telemetry channels by kind, dives and gaps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from magbridge.arrays import BoolArray, FloatArray, IntArray
from magbridge.calibration.fitting.observations import beside_motion
from magbridge.calibration.model import Calibration
from magbridge.columns import AGE, CHANNELS, require
from magbridge.errors import DataError
from magbridge.field.geodesy import separation, wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.field.reference import positions, reference_field
from magbridge.one_time import interpolate_to_rows
from magbridge.records import MAX_MEASURED_NT
from magbridge.rows import refuse_unsuited
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

ANY = ("temperature", "current", "pressure", "position")
DRIVE = ("current", "position")
"""Kinds of a drive's quantity: current flows while the drive turns, and the turned part may carry iron."""
UNIT_KINDS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("degC", "K", "degF"), ("temperature",)),
    **dict.fromkeys(("A", "mA", "uA", "W", "mW"), ("current",)),
    **dict.fromkeys(("dbar", "bar", "mbar", "Pa", "hPa", "kPa"), ("pressure",)),
    **dict.fromkeys(("rpm", "1/min", "rad/s", "us", "PWM"), DRIVE),
    **dict.fromkeys(("V", "mV"), DRIVE),
}
"""Possible kinds of a series by its unit, for units that determine them."""
VAGUE = {"", "1", "%", "m"}
"""Units that do not determine the kind of a series; its name decides instead."""
NAME_KINDS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("temp therm", ("temperature",)),
    ("current curr amps ampere", ("current",)),
    ("press depth baro alt altitude", ("pressure",)),
    ("throttle motor thrust thruster esc rpm pwm servo prop propeller winch pump", DRIVE),
    ("pos position fin rudder elevator aileron flap ballast vbd ctl ctrl piston valve gear", ("position",)),
)
"""Kinds by the words of a name. The first entry that matches counts: ``motor_temp`` is a temperature."""
PART = re.compile(r"[A-Z]?[a-z]+|[A-Z]+")
BEGINNING, END = 4, 3
"""Least number of letters of a word that is also recognised at the beginning, or end, of a longer word."""
DAY_S, NIGHT_S = 86400.0, 21600.0
"""Longest duration of a day, and shortest gap that ends a day, s."""
MIN_SAMPLES_A_DAY = 100
"""Least number of samples of a day in cross-validation."""
MAX_LAG = 1000
"""Largest lag, in sampling intervals. A sample so long ago does not predict the noise of the present one."""
MIN_SURVEY_SAMPLES = 60
"""Least number of samples from which noise and an effect can both be estimated."""
SHORT = 0.25
"""Quantile of time steps taken as the sampling interval: some gliders sample faster near the surface."""
INTERNAL_PREFIXES = ("mag_", "truth_", AGE)
FIELDS = {"nT", "uT", "\N{MICRO SIGN}T", "mG", "G", "T"}
"""Units of a magnetic field. A second magnetometer repeats all effects and so cannot explain any."""
NOT_TELEMETRY = {
    "time", "fitted", "learned", "reference_field", "roll", "pitch", "heading", "latitude", "longitude",
    "run", "dive", "quality", "total_field", "total_field_sigma", "field_x", "field_y", "field_z", "anomaly",
    "power_cycle",
}  # fmt: skip
TRUSTED = 0.5
"""Largest cubic term in the interpolation of an axis to its row's time, as a multiple of the noise."""
MAX_HALF_RANGES = 10.0
"""Distance from the middle of a parameter's range, in half ranges, beyond which a value is invalid."""


def kinds_of(name: str, unit: str) -> tuple[str, ...]:
    """Return the possible kinds of a telemetry series: temperature, current, pressure or position."""
    # A unit decides where it is specific; else the words of the name; else every kind is possible
    if unit in UNIT_KINDS:
        return UNIT_KINDS[unit]
    parts = [part.lower() for part in PART.findall(name)]
    named = next((kinds for words, kinds in NAME_KINDS if any(_is_among(part, words) for part in parts)), ())
    if unit not in VAGUE:
        # of a temperature or a pressure we know the units; anything else may be what drives, or moves
        return DRIVE if named == DRIVE else ("position",)
    if unit == "m":
        return named if named in (("pressure",), ("position",)) else ("pressure",)
    return named or ANY


def _is_among(part: str, words: str) -> bool:
    return any(
        part == word
        or (len(word) >= BEGINNING and part.startswith(word))
        or (len(word) >= END and part.endswith(word))
        for word in words.split()
    )


def dives_of(table: pd.DataFrame) -> IntArray:
    """Return the dive number (n,) of each sample: by the log, else by depth, else the eighth of the log.

    `table` has the samples in order of time, and no empty column. ``learned`` is True in logs that are only
    compared with.
    """
    # As the log counts; a log that lacks the count has its dives found by itself
    for name in ("dive", "run"):
        if name in table and np.unique(table[name]).size > 3:
            dive = np.unique(table[name], return_inverse=True)[1].astype(np.int64)
            for log in (table["learned"], ~table["learned"]):
                if log.any() and table[name][log].isna().all():
                    dive[log] = dive.max() + 1 + dives_of(table[log].dropna(axis=1, how="all"))
            return dive
    if "depth" in table and table["depth"].max() > 5.0:
        depth = held(table["depth"])
        # A dive begins where the vehicle leaves the surface
        shallow = depth < 0.15 * np.quantile(depth, 0.98)
        start = shallow & ~np.append(False, shallow[:-1])
        if 4 <= start.sum() <= 0.05 * len(depth):
            return np.cumsum(start)
    return eighths(len(table["time"]))


def days_of(time: FloatArray, learned: BoolArray) -> IntArray | None:
    """Return the number (n,) of each sample's day, -1 for `learned` samples; None for fewer than two days.

    A day begins with the first sample, after :data:`DAY_S`, and after a gap of :data:`NIGHT_S`. Days of fewer
    than :data:`MIN_SAMPLES_A_DAY` samples count to the day before.
    """
    day, number, start, last = np.full(len(time), -1), -1, -np.inf, -np.inf
    fresh = np.flatnonzero(~learned)
    t = time[fresh]
    bounds = []
    # A day ends after 24 h, or with a night without samples
    for k, moment in enumerate(t.tolist()):
        if moment - start >= DAY_S or moment - last > NIGHT_S:
            start = moment
            bounds.append(k)
        last = moment
    for part in np.split(fresh, bounds[1:]):
        number += part.size >= MIN_SAMPLES_A_DAY or number < 0
        day[part] = number
    return day if number > 0 else None


def held(values: pd.Series | pd.DataFrame) -> FloatArray:
    """Return columns (n, ...) with gaps filled by the last known value, and the beginning by the first."""
    return np.array(values.ffill().bfill(), float)


def eighths(n: int) -> IntArray:
    """Return the number (n,), 0 to 7, of the eighth of a log to which each of n samples belongs."""
    return np.arange(n) * 8 // n


class Past:
    """Lags of the p samples before each sample, for autoregressive noise of `order` p.

    `steps` (n,) are the intervals since the previous sample. `whole` (n,) is true for a sample whose p
    predecessors have the lags 1 to p. The other samples are `rows` (m,), shortly after a gap. Their lags are
    row `pattern` (m,) of the l distinct `lags` (l, p).
    """

    def __init__(self, steps: IntArray, order: int) -> None:
        n, self.order = len(steps), order
        index = np.arange(n)
        # A sample has a whole past if the last gap is at least `order` samples ago
        broken = np.where(steps == 1, 0, index)
        broken[:1] = 0
        self.whole = index - np.maximum.accumulate(broken) >= order
        self.rows = np.flatnonzero(~self.whole)
        # Equal patterns of lags share one predictor: only the distinct ones are kept
        place = np.append(np.cumsum(np.minimum(steps, MAX_LAG)), -MAX_LAG)
        before = np.maximum(self.rows[:, None] - np.arange(1, order + 1), -1)
        lags = np.minimum(place[self.rows, None] - place[before], MAX_LAG)
        self.lags, inverse = np.unique(lags, axis=0, return_inverse=True)
        self.pattern: IntArray = inverse.ravel()


class TelemetryChannel(NamedTuple):
    """A telemetry series: values (n,), unit, and possible kinds of quantity (:func:`kinds_of`)."""

    values: FloatArray
    unit: str
    kinds: tuple[str, ...]

    @property
    def extent(self) -> tuple[float, float]:
        """Smallest and largest value of the series."""
        return float(self.values.min()), float(self.values.max())


@dataclass(frozen=True, eq=False)
class Survey:
    """Deployments as arrays of the n samples with field, reference and the position of every mass."""

    time: FloatArray
    """(n,) time, s since 1970 UTC."""
    field: FloatArray
    """(n, 3) raw readings of the sensor's axes at `time`, nT."""
    reference: FloatArray
    """(n,) reference of the total field, nT."""
    channels: dict[str, TelemetryChannel]
    """Telemetry that varies, and all channels that the calibration needs, by name."""
    still: tuple[str, ...]
    """Names of telemetry that never changes."""
    steps: IntArray
    """(n,) sampling intervals since the previous sample, at most :data:`MAX_LAG`."""
    dive: IntArray
    """(n,) number of the dive, the unit of cross-validation."""
    place: FloatArray | None
    """(n, 3) position, m: north and east of the track's middle, depth (0 in a log without depth)."""
    attitude: FloatArray | None
    """(n, 3) roll, pitch and heading, deg."""
    fitted: BoolArray
    """(n,) True if the calibration was fitted to the sample."""
    learned: BoolArray
    """(n,) True in logs of the calibration that are only compared with, not diagnosed."""
    cycles: FloatArray
    """(c,) times of power cycles of the sensor in the log, s since 1970 UTC."""
    source: str
    """Names of the diagnosed logs, for messages."""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def interval(self) -> float:
        """Sampling interval, s."""
        known = self.steps[1:] < MAX_LAG
        return float(np.median(np.diff(self.time)[known] / self.steps[1:][known])) if known.any() else 1.0

    @cached_property
    def slots(self) -> IntArray:
        """(n,) sampling intervals since the first sample; a gap counts at most :data:`~.survey.MAX_LAG`."""
        return np.asarray(np.cumsum(self.steps) - self.steps[0])

    def follows(self, lost: int = 0) -> BoolArray:
        """Return True (n,) where at most `lost` samples are missing between a sample and the previous one."""
        apart = np.diff(self.time, prepend=np.inf)
        return np.asarray((apart > 0.0) & (apart < (lost + 1.5) * np.median(apart)) & (self.steps < MAX_LAG))

    @property
    def parts(self) -> str:
        """Name of the folds of cross-validation: ``dives`` or ``eighths of the log``."""
        return "eighths of the log" if np.array_equal(self.dive, eighths(len(self))) else "dives"

    def history(self, order: int) -> Past:
        """Return the lags of each sample's predecessors for autoregressive noise of this order, cached."""
        if order not in self._pasts:
            self._pasts[order] = Past(self.steps, order)
        return self._pasts[order]

    @cached_property
    def _pasts(self) -> dict[int, Past]:
        return {}

    def values(self, names: Sequence[str]) -> FloatArray:
        """Return the values (n, k) of channels, in the order of `names`; DataError: a channel is missing."""
        missing = [name for name in names if name not in self.channels]
        if missing:
            raise DataError(
                f"{self.source}: the calibration needs the column {missing[0]!r}, which is missing or empty"
            )
        columns = [self.channels[name].values for name in names]
        return np.array(columns).reshape(len(names), len(self)).T


def assemble(table: pd.DataFrame, units: dict[str, str], source: str, needed: Sequence[str]) -> Survey:
    """Return the survey of complete columns in order of time; find its channels, dives and gaps.

    Channels in `needed` are kept even if they never change.
    """
    time, learned = (np.array(table[name]) for name in ("time", "learned"))
    step = np.diff(time, prepend=np.nan)
    # Steps in whole sampling intervals; a change of log is as a gap
    interval = float(np.nanquantile(step, SHORT))
    steps = np.where(step > 0.5 * interval, np.minimum(np.rint(step / interval), MAX_LAG), MAX_LAG)
    steps[1:][learned[1:] != learned[:-1]] = MAX_LAG
    channels, still = _channels(table, units, needed)
    table = table.dropna(axis=1, how="all")
    cycles, attitude, place = np.empty(0), None, None
    if "power_cycle" in table:
        cycles = time[1:][np.diff(table["power_cycle"]) > 0]
    if {"roll", "pitch", "heading"} <= set(table):
        attitude = held(table[["roll", "pitch", "heading"]])
    if {"latitude", "longitude"} <= set(table):
        # m from the middle of the track, on the sphere, also across the date line
        latitude, longitude = np.array(table["latitude"]), np.array(table["longitude"])
        middle = float(np.median(latitude)), float(longitude[0] + np.median(wrap(longitude - longitude[0])))
        down = held(table["depth"]) if "depth" in table else np.zeros(len(time))
        place = np.stack([*separation(*middle, latitude, longitude), down], axis=1)
    return Survey(
        time=time,
        field=np.array(table[list(CHANNELS)]),
        reference=np.array(table["reference_field"]),
        channels=channels,
        still=still,
        steps=steps.astype(np.int64),
        dive=dives_of(table),
        place=place,
        attitude=attitude,
        fitted=np.array(table["fitted"]),
        learned=learned,
        cycles=cycles,
        source=source,
    )


def _channels(
    table: pd.DataFrame, units: dict[str, str], needed: Sequence[str]
) -> tuple[dict[str, TelemetryChannel], tuple[str, ...]]:
    """Return the telemetry that varies or is needed, and the names of the channels that never change."""
    channels, still = {}, []
    for name in sorted(table):
        if name in NOT_TELEMETRY or name.startswith(INTERNAL_PREFIXES):
            continue
        unit = units.get(name, "")
        unit = "" if unit == "1" else unit
        if unit in FIELDS and name not in needed:
            continue
        known = np.array(table[name][np.isfinite(table[name])])
        kinds = kinds_of(name, unit)
        if known.size < MIN_SURVEY_SAMPLES or np.ptp(known) <= 1e-9 * (np.abs(known).max() + 1e-30):
            still.append(name)
            if name not in needed or not known.size:
                continue
            kinds = ()  # the correction takes it, but nothing can be learned from it
        channels[name] = TelemetryChannel(held(table[name]), unit, kinds)
    return channels, tuple(still)


def load_survey(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    training_logs: Sequence[xr.Dataset] = (),
    grid: AnomalyGrid | None = None,
) -> Survey:
    """Return the survey of the deployments to diagnose and the logs that the calibration was fitted to.

    A log that is among both is diagnosed. If a log has no reference of its own, its reference is the main
    field plus the `grid`. DataError: a column is missing, too few samples are complete, or a parameter is out
    of range.
    """
    # A training log that is diagnosed as well is read once, as diagnosed
    own = [any(ds is one for one in training_logs) for ds in datasets]
    apart = [ds for ds in training_logs if not any(ds is one for one in datasets)]
    logs = (*datasets, *apart)
    source = _sources(logs)
    parts = [_columns(ds, calibration, grid, fitted) for ds, fitted in zip(datasets, own, strict=True)]
    parts += [_columns(ds, calibration, grid, fitted=True, learned=True) for ds in apart]
    # The columns of all logs in order of time; NaN where a log lacks one
    table = pd.concat(parts).sort_values("time", kind="stable", ignore_index=True)
    twice = int(np.sum(np.diff(table["time"]) == 0.0))
    if twice > 0.1 * len(table):
        raise DataError(
            f"{source}: {twice} samples are given twice: a log is either diagnosed or learned from"
        )
    table = _comparable(table, calibration, source)
    for parameter in calibration.parameters:
        values = np.array(table[parameter.name])
        far = np.abs(values - parameter.centre) > MAX_HALF_RANGES * parameter.scale
        if far.any():
            raise DataError(
                f"{source}: {parameter.name!r} is {values[far][0]:g} in {int(far.sum())} of "
                f"{far.size} samples, and {parameter.low:g} to {parameter.high:g} in the calibration: "
                "expected its unit, and nothing where it is not known"
            )
    if not np.ptp(table[list(CHANNELS)].to_numpy(), axis=0).any():
        raise DataError(f"{source}: columns mag_x, mag_y, mag_z never change: nothing was measured")
    units = {str(k): str(v.attrs.get("units", "")) for ds in logs for k, v in ds.data_vars.items()}
    return assemble(table, units, _sources(datasets), calibration.channels)


def _sources(logs: Sequence[xr.Dataset]) -> str:
    """Return the names of logs as a list in words, each name once."""
    return ", ".join(dict.fromkeys(str(ds.attrs.get("source", "deployment")) for ds in logs))


def _comparable(table: pd.DataFrame, calibration: Calibration, source: str) -> pd.DataFrame:
    """Return the rows with field, reference and all parameters; DataError: too few rows."""
    if len(table) < MIN_SURVEY_SAMPLES:
        raise DataError(f"{source}: {counted(len(table), 'sample')}, at least {MIN_SURVEY_SAMPLES} needed")
    for name in CHANNELS:
        table[name] = table[name].where(table[name].abs() < MAX_MEASURED_NT)
    # Rows that have field, reference and the position of every mass
    known = np.isfinite(table[[*CHANNELS, "reference_field", *calibration.units]])
    whole, counts = known.all(axis=1), known.sum()
    if whole.sum() < MIN_SURVEY_SAMPLES:
        worst = counts.idxmin()
        raise DataError(
            f"{source}: only {whole.sum()} of {len(table)} samples can be compared, at least "
            f"{MIN_SURVEY_SAMPLES} needed (column {worst!r} has {counts[worst]} numbers)"
        )
    table = table[whole]
    return table[np.diff(table["time"], prepend=-np.inf) > 0.0]  # a sample that two logs share is kept once


def _columns(
    ds: xr.Dataset, calibration: Calibration, grid: AnomalyGrid | None, fitted: bool, learned: bool = False
) -> pd.DataFrame:
    """Return a log's numeric columns and reference; its axes are interpolated to the rows' times."""
    require(ds, (*CHANNELS, *calibration.units))
    refuse_unsuited(calibration, ds)
    time = ds["time"].to_numpy().astype(float)
    table = pd.DataFrame(
        {
            str(name): column.to_numpy().astype(float)
            for name, column in ds.data_vars.items()
            if column.dtype.kind in "fiub" and not str(name).startswith("truth_")
        }
    )
    in_turn, trusted = False, TRUSTED * calibration.noise.sensor
    for axis in CHANNELS:  # a log of axes that were sampled in turn has a time for each
        sampled = table.pop(f"mag_time_{axis[-1]}").to_numpy() if f"mag_time_{axis[-1]}" in table else time
        if np.isfinite(sampled).all() and not np.array_equal(sampled, time):
            values, cubic = interpolate_to_rows(time, sampled, table[axis].to_numpy())
            # where the cubic term is large or unknown, the channel is not known well enough
            table[axis], in_turn = np.where(np.abs(cubic) <= trusted, values, np.nan), True
    if in_turn:
        # Next to a moving mass the axes saw it at different places and form no vector. Where they are sampled
        # at once such samples are kept: only they reveal an offset of the clocks
        parameters = calibration.parameters
        values = table[[one.name for one in parameters]].to_numpy()
        moving = beside_motion(time, values, np.array([one.high - one.low for one in parameters]))
        table.loc[moving, list(CHANNELS)] = np.nan
    reference = reference_field(ds, grid, calibration.reference.bias)
    table = table.assign(time=time, fitted=fitted, learned=learned, reference_field=reference)
    if {"latitude", "longitude"} <= set(table):
        table["longitude"], table["latitude"], _ = positions(ds)
    return table
