"""A deployment as the arrays that a diagnosis compares, with every telemetry channel that varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IntArray
from magbridge.columns import AGE
from magbridge.diagnose.compare.dives import dives_of, eighths, held
from magbridge.diagnose.compare.kinds import kinds_of
from magbridge.diagnose.compare.past import MAX_LAG, Past
from magbridge.errors import DataError
from magbridge.field.geodesy import separation, wrap

__all__ = ["MIN_SURVEY_SAMPLES", "Channel", "Survey", "assemble"]

MIN_SURVEY_SAMPLES = 60
"""Samples below which noise and effect cannot both be estimated."""
SHORT = 0.25
"""Quantile of the time steps that is taken for the sampling interval: some gliders sample faster near
the surface."""
INTERNAL_PREFIXES = ("mag_", "truth_", AGE)
FIELDS = {"nT", "uT", "\N{MICRO SIGN}T", "mG", "G", "T"}
"""Units of another magnetometer, which follows everything that this one does and so explains nothing."""
NOT_TELEMETRY = {
    "time", "fitted", "learned", "reference_field", "roll", "pitch", "heading", "latitude", "longitude",
    "run", "dive", "quality", "total_field", "total_field_sigma", "field_x", "field_y", "field_z", "anomaly",
    "power_cycle",
}  # fmt: skip


class Channel(NamedTuple):
    """A telemetry series, as a channel is throughout a diagnosis: values (n,), unit, kinds that it may be."""

    values: FloatArray
    unit: str
    kinds: tuple[str, ...]

    @property
    def extent(self) -> tuple[float, float]:
        """Its smallest and its largest value."""
        return float(self.values.min()), float(self.values.max())


@dataclass(frozen=True, eq=False)
class Survey:
    """A deployment as arrays, of the rows that have field, reference and the position of every mass."""

    time: FloatArray
    """(n,) s since 1970 UTC."""
    field: FloatArray
    """(n, 3) nT, the sensor's raw axes at `time`."""
    reference: FloatArray
    """(n,) nT."""
    channels: dict[str, Channel]
    """All telemetry that varies, and what the calibration needs."""
    still: tuple[str, ...]
    """Telemetry that never changes."""
    steps: IntArray
    """(n,) intervals since the previous sample; :data:`~.past.MAX_LAG` if it is too long ago to predict this
    one's noise."""
    dive: IntArray
    """(n,) number of the dive, the unit of cross-validation."""
    place: FloatArray | None
    """(n, 3) m north and east of the middle, and below the surface: 0 in a log without a depth."""
    attitude: FloatArray | None
    """(n, 3) deg, roll, pitch, heading."""
    fitted: BoolArray
    """(n,) the calibration was fitted to this sample."""
    learned: BoolArray
    """(n,) it was, and the sample is given only to be compared with: its log is not diagnosed."""
    cycles: FloatArray
    """(c,) s, when the instrument was power-cycled, as the log says."""
    source: str
    """The logs that are diagnosed, for people to read."""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def interval(self) -> float:
        """Sampling interval, s."""
        known = self.steps[1:] < MAX_LAG
        return float(np.median(np.diff(self.time)[known] / self.steps[1:][known])) if known.any() else 1.0

    @cached_property
    def slots(self) -> IntArray:
        """(n,) intervals since the first sample; a gap counts at most :data:`~.past.MAX_LAG`."""
        return np.asarray(np.cumsum(self.steps) - self.steps[0])

    def follows(self, lost: int = 0) -> BoolArray:
        """(n,) the sample follows the previous one at the median interval, with at most `lost` missing."""
        apart = np.diff(self.time, prepend=np.inf)
        return np.asarray((apart > 0.0) & (apart < (lost + 1.5) * np.median(apart)) & (self.steps < MAX_LAG))

    @property
    def parts(self) -> str:
        """The units of cross-validation, in words."""
        return "eighths of the log" if np.array_equal(self.dive, eighths(len(self))) else "dives"

    def past(self, order: int) -> Past:
        """Return the samples before each one that autoregressive noise of this order depends on."""
        if order not in self._pasts:
            self._pasts[order] = Past(self.steps, order)
        return self._pasts[order]

    @cached_property
    def _pasts(self) -> dict[int, Past]:
        return {}

    def values(self, names: Sequence[str]) -> FloatArray:
        """(n, k) channels, in this order; DataError: one is missing."""
        missing = [name for name in names if name not in self.channels]
        if missing:
            raise DataError(
                f"{self.source}: the calibration needs the column {missing[0]!r}, which is missing or empty"
            )
        return (
            np.stack([self.channels[name].values for name in names], axis=1)
            if names
            else np.empty((len(self), 0))
        )


def assemble(
    table: dict[str, FloatArray], units: dict[str, str], source: str, needed: Sequence[str]
) -> Survey:
    """Make a survey from complete columns: find channels, dives and gaps.

    Parameters
    ----------
    table : dict of (n,) arrays
        In order of time; ``fitted`` and ``learned`` are 1 where the survey's are true.
    units : dict
        Column -> unit.
    source : str
        The logs that are diagnosed, for people to read.
    needed : sequence of str
        Channels that are kept even if they never change.
    """
    time = table["time"]
    step = np.diff(time, prepend=np.nan)
    interval = float(np.nanquantile(step, SHORT))
    steps = np.where(step > 0.5 * interval, np.minimum(np.rint(step / interval), MAX_LAG), MAX_LAG).astype(
        np.int64
    )
    steps[1:][table["learned"][1:] != table["learned"][:-1]] = MAX_LAG
    channels, still = _channels(table, units, needed)
    table = {name: column for name, column in table.items() if np.isfinite(column).any()}
    cycles = np.empty(0)
    if "power_cycle" in table:
        cycles = time[1:][np.diff(table["power_cycle"]) > 0]
    attitude = None
    if {"roll", "pitch", "heading"} <= set(table):
        attitude = np.stack([held(table[name]) for name in ("roll", "pitch", "heading")], axis=1)
    return Survey(
        time=time,
        field=np.stack([table[f"mag_{axis}"] for axis in "xyz"], axis=1),
        reference=table["reference_field"],
        channels=channels,
        still=still,
        steps=steps,
        dive=dives_of(table),
        place=_place(table),
        attitude=attitude,
        fitted=table["fitted"] > 0.5,
        learned=table["learned"] > 0.5,
        cycles=cycles,
        source=source,
    )


def _channels(
    table: dict[str, FloatArray], units: dict[str, str], needed: Sequence[str]
) -> tuple[dict[str, Channel], tuple[str, ...]]:
    """Return the telemetry that varies or is needed, and the names of the channels that never change."""
    channels, still = {}, []
    for name in sorted(table):
        if name in NOT_TELEMETRY or name.startswith(INTERNAL_PREFIXES):
            continue
        values, unit = table[name], units.get(name, "")
        unit = "" if unit == "1" else unit
        if unit in FIELDS and name not in needed:
            continue
        known = values[np.isfinite(values)]
        if known.size < MIN_SURVEY_SAMPLES or np.ptp(known) <= 1e-9 * (np.abs(known).max() + 1e-30):
            still.append(name)
            if name in needed and known.size:  # the correction takes it, but nothing can be learned from it
                channels[name] = Channel(held(values), unit, ())
            continue
        channels[name] = Channel(held(values), unit, kinds_of(name, unit))
    return channels, tuple(still)


def _place(table: dict[str, FloatArray]) -> FloatArray | None:
    """(n, 3) m north and east of the middle, and below the surface; None without positions."""
    if not {"latitude", "longitude"} <= set(table):
        return None
    latitude, longitude = table["latitude"], table["longitude"]
    along = wrap(longitude - longitude[0])  # also across the date line
    middle = float(np.median(latitude)), float(longitude[0] + np.median(along))
    north, east = separation(*middle, latitude, longitude)
    down = held(table["depth"]) if "depth" in table else np.zeros_like(north)
    return np.stack([north, east, down], axis=1)
