"""From deployments to the arrays that a diagnosis compares, with every telemetry channel that varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.model import Calibration
from magbridge.config import Align
from magbridge.errors import DataError
from magbridge.field.grid import AnomalyGrid
from magbridge.field.reference import positions, reference_field

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Channel", "Survey", "take"]

FloatArray = NDArray[np.float64]

FEWEST = 60
"""Samples below which nothing can be said about noise and effect at once."""
KINDS = {
    "degC": "temperature", "K": "temperature", "A": "current", "mA": "current", "m": "pressure", "dbar": "pressure",
    "bar": "pressure", "Pa": "pressure", "hPa": "pressure", "kPa": "pressure", "mbar": "pressure",
}  # fmt: skip
"""What a channel is, by its unit. Anything else is taken for the position of something that moves."""
HINTS = (("temp", "temperature"), ("current", "current"), ("press", "pressure"))
"""Where a channel declares no unit, its name may help; else it is tried as everything."""
TRUSTED = 0.5
"""Of the noise: how far a channel may be from where it is interpolated to."""
OURS = ("mag_", "truth_")
NOT_TELEMETRY = {
    "time", "learned", "reference_field", "roll", "pitch", "heading", "latitude", "longitude", "run", "dive", "quality",
    "total_field", "total_field_sigma", "field_x", "field_y", "field_z", "anomaly", "power_cycle",
}  # fmt: skip


class Channel(NamedTuple):
    """A telemetry channel: values (n,), unit, and which of the kinds it may be."""

    values: FloatArray
    unit: str
    kinds: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Survey:
    """A deployment as arrays; rows without field, reference or position of a modelled mass are gone.

    Attributes
    ----------
    time : (n,) array
        s since 1970 UTC.
    field : (n, 3) array
        nT, raw channels at `time`.
    reference : (n,) array
        nT.
    channels : dict of Channel
        Everything that varies, and what the calibration needs.
    still : tuple of str
        Telemetry that never changes: nothing can be learned from it.
    follows : (n,) bool array
        The sample comes one interval after the one before.
    dive : (n,) int array
        Whole dives, for leaving out.
    place : (n, 2) array or None
        m north and east of the middle.
    attitude : (n, 3) array or None
        deg, roll, pitch, heading.
    learned : (n,) bool array
        The calibration was made from this sample.
    cycles : (c,) array
        s, when the instrument was switched on again, as the log says.
    source : str
    """

    time: FloatArray
    field: FloatArray
    reference: FloatArray
    channels: dict[str, Channel]
    still: tuple[str, ...]
    follows: NDArray[np.bool_]
    dive: NDArray[np.int64]
    place: FloatArray | None
    attitude: FloatArray | None
    learned: NDArray[np.bool_]
    cycles: FloatArray
    source: str

    def __len__(self) -> int:
        return len(self.time)

    def values(self, names: Sequence[str]) -> FloatArray:
        """(n, k) channels, in this order."""
        missing = [name for name in names if name not in self.channels]
        if missing:
            raise DataError(
                f"{self.source}: the calibration needs the column {missing[0]!r}, which is missing"
            )
        return (
            np.stack([self.channels[name].values for name in names], axis=1)
            if names
            else np.empty((len(self), 0))
        )


def take(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    learned_from: Sequence[xr.Dataset] = (),
    grid: AnomalyGrid | None = None,
) -> Survey:
    """Gather deployments.

    Parameters
    ----------
    datasets : sequence of Dataset
        To be diagnosed.
    calibration : Calibration
    learned_from : sequence of Dataset
        The logs that the calibration was made from, if they are at hand.
    grid : AnomalyGrid, optional
        Added to the main field where a log has no reference of its own.

    Raises
    ------
    DataError
        A column is missing, or too few samples have all they need: one line that says which.
    """
    parts = [
        _columns(ds, calibration, grid, learned)
        for learned, group in ((False, datasets), (True, learned_from))
        for ds in group
    ]
    names = {name for part in parts for name in part}
    sizes = [part["time"].size for part in parts]
    table = {
        name: np.concatenate(
            [part.get(name, np.full(n, np.nan)) for part, n in zip(parts, sizes, strict=True)]
        )
        for name in names
    }
    order = np.argsort(table["time"], kind="stable")
    table = {name: column[order] for name, column in table.items()}
    source = ", ".join(
        dict.fromkeys(str(ds.attrs.get("source", "deployment")) for ds in (*datasets, *learned_from))
    )
    twice = int(np.sum(np.diff(table["time"]) == 0.0))
    if twice > 0.1 * table["time"].size:
        raise DataError(
            f"{source}: {twice} samples are given twice: a log is either diagnosed or learned from"
        )
    parameters = [parameter.name for parameter in calibration.parameters]
    needed = [*(f"mag_{axis}" for axis in "xyz"), "reference_field", *parameters]
    if sum(sizes) < FEWEST:
        raise DataError(f"{source}: {sum(sizes)} samples, at least {FEWEST} needed")
    whole = np.all([np.isfinite(table[name]) for name in needed], axis=0)
    if whole.sum() < FEWEST:
        worst = min(needed, key=lambda name: int(np.isfinite(table[name]).sum()))
        raise DataError(
            f"{source}: only {int(whole.sum())} of {whole.size} samples can be compared, at least {FEWEST} needed "
            f"(column {worst!r} has {int(np.isfinite(table[worst]).sum())} numbers)"
        )
    table = {name: column[whole] for name, column in table.items()}
    if not any(np.ptp(table[f"mag_{axis}"]) for axis in "xyz"):
        raise DataError(f"{source}: columns mag_x, mag_y, mag_z never change: nothing was measured")
    units = {
        str(k): str(v.attrs.get("units", ""))
        for ds in (*datasets, *learned_from)
        for k, v in ds.data_vars.items()
    }
    return _assemble(table, units, source, calibration.channels)


def _columns(
    ds: xr.Dataset, calibration: Calibration, grid: AnomalyGrid | None, learned: bool
) -> dict[str, FloatArray]:
    """Return every column that counts; the channels at the row's time, the reference from wherever it is."""
    source = str(ds.attrs.get("source", "deployment"))
    sensor = str(ds.attrs.get("sensor", ""))
    if sensor and calibration.sensor.name and sensor != calibration.sensor.name:
        raise DataError(f"{source}: sensor {sensor!r}, but the calibration is of {calibration.sensor.name!r}")
    for name in ("mag_x", "mag_y", "mag_z", *(parameter.name for parameter in calibration.parameters)):
        if name not in ds:
            raise DataError(
                f"{source}: column {name!r} is missing; there are {', '.join(map(str, ds.data_vars))}"
            )
    time = ds["time"].to_numpy().astype(float)
    table = {
        str(name): column.to_numpy().astype(float)
        for name, column in ds.data_vars.items()
        if column.dtype.kind in "fiub" and not str(name).startswith("truth_")
    }
    in_turn = False
    for axis in "xyz":  # a converter that takes the channels in turn says when it took each
        own = table.pop(f"mag_time_{axis}", None)
        if own is not None and np.isfinite(own).all() and not np.array_equal(own, time):
            table[f"mag_{axis}"] = _at(time, own, table[f"mag_{axis}"], TRUSTED * calibration.noise.sensor)
            in_turn = True
    table |= {"time": time, "learned": np.full(time.size, float(learned))}
    if in_turn:
        for axis in "xyz":
            table[f"mag_{axis}"][_moving(table, calibration)] = np.nan
    table["reference_field"] = reference_field(ds, grid, calibration.reference.bias)
    if {"latitude", "longitude"} <= set(table):
        table["longitude"], table["latitude"], _ = positions(ds)
    return table


def _at(time: FloatArray, own: FloatArray, values: FloatArray, trusted: float) -> FloatArray:
    """Return a channel at the row's time: the cubic through its sample, the one after and the two before.

    A line between two is off by the turn's curvature, tenths of a nanotesla, always the same way. Where it matters
    whether it is a cubic or a parabola, nobody knows what the channel was: NaN.
    """
    out = np.full(time.size, np.nan)
    if time.size < 4:
        return out
    a, b, c, d, t = own[:-3], own[1:-2], own[2:-1], own[3:], time[2:-1]
    first = (values[2:-1] - values[1:-2]) / (c - b)
    after = (values[3:] - values[2:-1]) / (d - c)
    before = (values[1:-2] - values[:-3]) / (b - a)
    second, earlier = (after - first) / (d - b), (first - before) / (c - a)
    bend = (second - earlier) / (d - a) * (t - b) * (t - c) * (t - d)
    out[2:-1] = values[2:-1] + first * (t - c) + second * (t - c) * (t - b) + bend
    out[2:-1][np.abs(bend) > trusted] = np.nan
    return out


def _moving(table: dict[str, FloatArray], calibration: Calibration) -> NDArray[np.bool_]:
    """Say about which samples a mass is on its way, by the bridge's own criterion.

    There each channel saw another vehicle, and no vector is common to them. A converter that takes all three at once
    keeps such samples: only they tell a clock that is off.
    """
    moving = np.zeros(table["time"].size, bool)
    elapsed = np.maximum(np.diff(table["time"]), 1.0)
    for parameter in calibration.parameters:
        fastest = Align().moving_rate * (parameter.high - parameter.low)
        step = np.abs(np.diff(table[parameter.name])) > fastest * elapsed
        moving[1:] |= step
        moving[:-1] |= step  # the later channels of this sample were taken when it had begun
    return moving


def _assemble(
    table: dict[str, FloatArray], units: dict[str, str], source: str, needed: Sequence[str]
) -> Survey:
    time = table["time"]
    step = np.diff(time, prepend=np.nan)
    interval = float(np.nanmedian(step))
    follows = (step > 0.5 * interval) & (step < 1.5 * interval)
    follows[1:] &= table["learned"][1:] == table["learned"][:-1]
    channels, still = {}, []
    for name in sorted(table):
        if name in NOT_TELEMETRY or name.startswith(OURS):
            continue
        values, unit = table[name], units.get(name, "")
        known = values[np.isfinite(values)]
        if known.size < FEWEST or np.ptp(known) <= 1e-9 * (np.abs(known).max() + 1e-30):
            still.append(name)
            if name in needed and known.size:  # the correction takes it, but nothing can be learned from it
                channels[name] = Channel(_held(values), unit, ())
            continue
        channels[name] = Channel(_held(values), unit, _kinds(name, unit))
    cycles = np.empty(0)
    if "power_cycle" in table:
        cycles = time[1:][np.diff(table["power_cycle"]) > 0]
    place = None
    if {"latitude", "longitude"} <= set(table):
        middle = np.median(table["latitude"])
        north = np.radians(table["latitude"] - middle) * 6.3712e6
        east = (
            np.radians(table["longitude"] - np.median(table["longitude"]))
            * 6.3712e6
            * np.cos(np.radians(middle))
        )
        place = np.stack([north, east], axis=1)
    attitude = None
    if {"roll", "pitch", "heading"} <= set(table):
        attitude = np.stack([table[name] for name in ("roll", "pitch", "heading")], axis=1)
    return Survey(
        time=time,
        field=np.stack([table[f"mag_{axis}"] for axis in "xyz"], axis=1),
        reference=table["reference_field"],
        channels=channels,
        still=tuple(still),
        follows=follows,
        dive=_dives(table, follows),
        place=place,
        attitude=attitude,
        learned=table["learned"] > 0.5,
        cycles=cycles,
        source=source,
    )


def _kinds(name: str, unit: str) -> tuple[str, ...]:
    if unit in KINDS:
        return (KINDS[unit],)
    if unit in ("", "1"):
        hinted = tuple(kind for hint, kind in HINTS if hint in name.lower())
        return hinted or ("temperature", "current", "pressure", "position")
    return ("position",)


def _held(values: FloatArray) -> FloatArray:
    """Return the last value known, and the first one before it."""
    known = np.flatnonzero(np.isfinite(values))
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), known[0]))
    return np.asarray(values[np.maximum(last, known[0])])


def _dives(table: dict[str, FloatArray], follows: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Count the dives: as the log does, or from surface to surface, or pieces of an eighth of the log."""
    for name in ("dive", "run"):
        if name in table and np.unique(table[name]).size > 3:
            return np.unique(table[name], return_inverse=True)[1].astype(np.int64)
    if "depth" in table and np.nanmax(table["depth"]) > 5.0:
        depth = _held(table["depth"])
        shallow = depth < 0.15 * np.quantile(depth, 0.98)
        start = shallow & ~np.append(False, shallow[:-1])
        if 4 <= start.sum() <= 0.05 * len(depth):
            return np.cumsum(start)
    pieces = np.arange(len(follows)) * 8 // len(follows)
    return pieces.astype(np.int64)
