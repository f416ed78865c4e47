"""Observations of a fit as arrays, and the monomials of their positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as attribute
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.model import CalibratedRange, Calibration, Parameter
from magbridge.calibration.terms import Exponents
from magbridge.columns import TEMPERATURE
from magbridge.config import Align
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import ResidualSamples
from magbridge.records import MAX_MEASURED_NT

RARE = 0.001
"""Fraction of the samples at each end that the range of a condition excludes."""
COMMON, FAR = 0.005, 10.0
"""A position is implausible FAR spans (between the quantiles COMMON and 1 - COMMON) from the median."""
_PER_SAMPLE = (
    "field", "reference", "parameters", "runs", "time", "attitude", "reference_ned", "place", "unmapped",
    "temperature", "depth",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Observations:
    """Calibration data as arrays.

    The constructor removes samples without field, reference, position or time, or with an impossible field.
    """

    field: FloatArray
    """(n, 3): Raw readings in sensor axes, nT."""
    reference: FloatArray
    """(n,): Reference of the total field, nT."""
    parameters: FloatArray
    """(n, k): Value of each parameter, such as an actuator's position; k may be 0."""
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    """`names`, `units`: Name and unit of each parameter."""
    runs: NDArray[np.generic] = attribute(default_factory=lambda: np.empty(0))
    """(n,): Run of each sample (dive, spiral, file); default: one. Cross-validation holds out runs."""
    time: FloatArray = attribute(default_factory=lambda: np.empty(0))
    """(n,): Time of the samples, s since 1970 UTC; default: one sample per second."""
    attitude: FloatArray | None = None
    """(n, 3): Roll, pitch and true heading, rad; NaN where unknown."""
    independent_headings: bool = False
    """True if another instrument than the magnetometer measured the headings, for example an inertial one. A
    fit then also uses the direction of the field."""
    reference_ned: FloatArray | None = None
    """(n, 3): Reference field vector, north-east-down, nT."""
    place: FloatArray | None = None
    """(n, 3): Position north, east and down of `origin`, m."""
    unmapped: FloatArray | None = None
    """(n,): 1 where the reference lacks the crustal field or a part of it, 0 where it is the true field."""
    temperature: FloatArray | None = None
    """(n,): Temperature of the sensor, degC; NaN where unknown."""
    depth: FloatArray | None = None
    """(n,): Depth, m; NaN where unknown."""
    map_sigma: float | None = None
    """1-sigma of the map in the reference, nT; None without a map."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Latitude and longitude of the origin of `place`, deg."""
    sensor: str = ""
    """Name of the sensor; empty if unknown."""
    filter_cutoff: float = 0.0
    """Cutoff frequency (Hz) of the anti-alias filter whose effect has been removed from `field`; 0: none."""
    inputs: dict[str, str] = attribute(default_factory=dict)
    """SHA-256 of each input file, by the file's name."""
    model: str = ""
    """Name of the reference's field model."""

    def __post_init__(self) -> None:
        n = len(self.field)
        put = object.__setattr__  # frozen from here on
        parameters = np.asarray(self.parameters, float).reshape(n, -1 if n else len(self.names))
        k = parameters.shape[1]
        put(self, "names", tuple(self.names) or tuple(f"p{i + 1}" for i in range(k)))
        put(self, "units", tuple(self.units) or ("",) * k)
        # one name and one unit for each column, no name twice
        if len(self.names) != k or len(self.units) != k:
            raise CalibrationError(
                f"parameters: {k} columns, but {len(self.names)} names and {len(self.units)} units"
            )
        for i, name in enumerate(self.names):
            if name in self.names[:i]:
                raise CalibrationError(f"parameter {name!r} is named twice")
        reference = np.broadcast_to(np.asarray(self.reference, float), n)
        time = np.asarray(self.time, float) if len(self.time) else np.arange(n, dtype=float)
        runs = np.asarray(self.runs) if len(self.runs) else np.zeros(n, int)
        field = np.asarray(self.field, float)
        # a missing or impossible reading becomes NaN, and its row is removed below
        absent = (field == 0.0).all(axis=1, keepdims=True)  # what an absent sensor reads
        field = np.where((np.abs(field) < MAX_MEASURED_NT) & ~absent, field, np.nan)
        whole = np.isfinite(field).all(axis=1) & np.isfinite(reference)
        whole &= np.isfinite(parameters).all(axis=1) & np.isfinite(time)
        named = zip(("mag_x", "mag_y", "mag_z", *self.names), (*field.T, *parameters.T), strict=True)
        _enough(whole, {**dict(named), "reference field": reference})
        if not (reference[whole] > 0).all():
            raise CalibrationError("reference field: expected positive numbers (nT)")
        _plausible(self.names, parameters[whole])
        values = {
            "field": field,
            "reference": reference,
            "parameters": parameters,
            "runs": runs,
            "time": time,
        }
        optional = {name: getattr(self, name) for name in _PER_SAMPLE if name not in values}
        values |= {name: np.asarray(v, float) for name, v in optional.items() if v is not None}
        for name, value in values.items():
            put(self, name, value[whole])

    def __len__(self) -> int:
        return len(self.field)

    def part(self, rows: BoolArray) -> Observations:
        """Return the samples at which the mask `rows` (n,) is True."""
        columns = ((name, getattr(self, name)) for name in _PER_SAMPLE)
        picked: dict[str, Any] = {name: None if v is None else v[rows] for name, v in columns}
        return replace(self, **picked)

    def thinned(self, most: int) -> Observations:
        """Return every second, third ... sample, so that at most `most` samples remain."""
        step = -(-len(self) // most)
        return self if step <= 1 else self.part(np.arange(len(self)) % step == 0)

    def without_parameters(self) -> Observations:
        """Return the samples without their parameters, as if the vehicle had no moving masses."""
        return replace(self, parameters=self.parameters[:, :0], names=(), units=())

    def channels(self, calibration: Calibration) -> FloatArray:
        """Return the values (n, c) of the channels with which a calibration of these data corrects.

        The first columns are the parameters; the temperature follows if one of the effects needs it.
        """
        positions = self.parameters[:, : len(calibration.parameters)]
        if TEMPERATURE not in calibration.channels[positions.shape[1] :] or self.temperature is None:
            return positions
        return np.column_stack([positions, self.temperature])

    def directed(self) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Return a mask, and the attitude and reference vector of the m samples that have both.

        Mask (n,), attitude (m, 3) in rad, reference (m, 3) north-east-down in nT.
        """
        if self.attitude is None or self.reference_ned is None:
            return np.zeros(len(self), bool), np.empty((0, 3)), np.empty((0, 3))
        known = np.asarray(np.isfinite(np.hstack([self.attitude, self.reference_ned])).all(axis=1))
        return known, self.attitude[known], self.reference_ned[known]

    @property
    def lacks_rock(self) -> bool:
        """Return True if the reference lacks the crustal field at any sample."""
        return self.unmapped is not None and bool(self.unmapped.any())

    @property
    def unmapped_place(self) -> FloatArray | None:
        """Positions (n, 3), m, if the reference lacks the crustal field at all samples; else None."""
        return self.place if self.unmapped is not None and bool(self.unmapped.all()) else None

    @property
    def steps(self) -> FloatArray:
        """Number of sampling intervals since the run's previous sample, (n,); infinite at its first sample.

        It is an integer of at least 1, because the noise's correlation is estimated at one interval and not
        extrapolated to shorter times.
        """
        # in units of the median interval; independent across runs
        steps = np.full(len(self), np.inf)
        apart = np.diff(self.time)
        if apart.size:
            near = (self.runs[1:] == self.runs[:-1]) & (apart > 0)
            steps[1:][near] = np.maximum(np.rint(apart[near] / np.median(apart)), 1.0)
        return steps

    @property
    def at_rest(self) -> BoolArray:
        """Mask (n,) that is True for samples without a motion of a mass.

        The mask is True throughout if at least half of the samples have a motion, for example of a current.
        """
        span = np.ptp(self.parameters, axis=0) if len(self) else np.zeros(len(self.names))
        rest = ~beside_motion(self.time, self.parameters, span)
        return rest if rest.mean() > 0.5 else np.ones(len(self), bool)

    def conditions(self) -> tuple[CalibratedRange, ...]:
        """Return the ranges of depth and temperature in the data, for each condition that is known."""
        found = []
        for name, values in (("depth", self.depth), (TEMPERATURE, self.temperature)):
            known = np.empty(0) if values is None else values[np.isfinite(values)]
            if name == "depth":
                known = np.maximum(known, 0.0)  # above the surface the pressure does not change enough
            if known.size:
                low, high = np.quantile(known, [RARE, 1.0 - RARE]).tolist()
                found.append(CalibratedRange(name, low, high))
        return tuple(found)

    def ranges(self) -> tuple[Parameter, ...]:
        """Return the parameters with their ranges in the data, and scales that map these to [-1, 1].

        CalibrationError: a parameter is constant.
        """
        found = []
        for name, unit, column in zip(self.names, self.units, self.parameters.T, strict=True):
            # x = (p - centre) / scale is in [-1, 1]
            low, high = float(column.min()), float(column.max())
            if not high - low > 1e-9 * max(abs(high), abs(low)):
                raise CalibrationError(
                    f"parameter {name!r} never moves (it is {low:g} throughout): leave it out, or add runs"
                )
            found.append(Parameter(name, unit, low, high, (low + high) / 2, (high - low) / 2))
        return tuple(found)


def beside_motion(time: FloatArray, values: FloatArray, spans: FloatArray) -> BoolArray:
    """Return a mask (n,) that is True for samples before, during or after a motion of a mass.

    A mass moves if its position changes faster than the default ``moving_rate`` of the alignment, from one
    sample to the next or over 1 s, whichever is longer. `time` (n,): s. `values` (n, k): positions of the
    masses. `spans` (k,): their ranges, in the same units.
    """
    # a clock that was set back continues
    t = np.cumsum(np.maximum(np.diff(time, prepend=time[:1]), 0.0))
    then = np.minimum(t[:-1], t[1:] - 1.0)
    past = np.array([np.interp(then, t, one) for one in values.T]).T.reshape(values[1:].shape)
    fastest = Align().moving_rate * spans * (t[1:] - then)[:, None]
    last = np.flatnonzero((np.abs(values[1:] - past) > fastest).any(axis=1)) + 1
    # samples from `then` to the last one of each motion
    bounds = np.zeros(len(time) + 1)
    np.add.at(bounds, np.searchsorted(t, then[last - 1]), 1.0)
    np.add.at(bounds, last + 1, -1.0)
    return np.asarray(np.cumsum(bounds)[:-1] > 0.0)


def _enough(complete: BoolArray, columns: dict[str, FloatArray]) -> None:
    """Raise CalibrationError if fewer than 10 samples are `complete` (n,); `columns`: values (n,) by name."""
    if complete.sum() >= 10:
        return
    # name the column with too few numbers, or say that the rows do not match
    n, counts = len(complete), {name: int(np.isfinite(column).sum()) for name, column in columns.items()}
    reasons = [f"{name!r} has {count}" for name, count in counts.items() if count < min(n, 10)]
    because = f" ({', '.join(reasons)} numbers)" if reasons else ""
    if n >= 10 and not reasons:
        because = " (the columns have theirs in different rows: interpolate all to the times of mag_x)"
    raise CalibrationError(
        f"only {int(complete.sum())} of {n} samples have every value{because}: at least 10 needed"
    )


def _plausible(names: Sequence[str], positions: FloatArray) -> None:
    """Raise CalibrationError if a position is far from all others, such as a missing-value code."""
    for name, column in zip(names, positions.T, strict=True):
        # the span of 99 % of the positions is the scale: a code such as -999 lies many spans away
        low, middle, high = np.quantile(column, [COMMON, 0.5, 1.0 - COMMON])
        far = np.abs(column - middle) > FAR * (high - low)
        if high > low and far.any():
            raise CalibrationError(
                f"parameter {name!r} is {column[far][0]:g} in {int(far.sum())} of {len(column)} samples, and "
                f"{low:g} to {high:g} in the others: leave unknown values empty"
            )


def monomials(
    positions: FloatArray, parameters: Sequence[Parameter], exponents: Sequence[Exponents]
) -> FloatArray:
    """Return the m monomials (n, m) of positions (n, k), scaled by centre and scale of the k `parameters`."""
    # each monomial is the product of the scaled positions to its powers
    x = (positions - [p.centre for p in parameters]) / [p.scale for p in parameters]
    return np.stack([np.prod(x ** np.array(powers), axis=1) for powers in exponents], axis=1)


def polynomial_samples(
    data: Observations,
    exponents: tuple[Exponents, ...],
    ranges: Sequence[Parameter] | None = None,
) -> ResidualSamples:
    """Return the samples of `data` for a fit of polynomials, with the monomials of their positions.

    `ranges`: parameters whose scales apply; default: the ranges in the data.
    """
    phi = monomials(data.parameters, data.ranges() if ranges is None else ranges, exponents)
    at_rest, F_0 = data.at_rest, float(data.reference.mean())
    moving = None if at_rest.all() else ~at_rest
    return ResidualSamples(data.field, data.reference, phi, data.steps, F_0, moving=moving)


MIN_SLOPE_TIME_CONSTANTS = 4.0
"""Smallest number of time constants over which a slope is computed, because shorter slopes are noise."""


def unfiltered(data: Observations, corner: float) -> Observations:
    """Return `data` with the effect of a first-order filter of cutoff `corner` (Hz) removed from the field.

    CalibrationError: the time constant of the filter is longer than the data.
    """
    if len(data) < 3:
        return data
    tau = 1.0 / (2.0 * np.pi * corner)
    duration = float(np.ptp(data.time))
    if tau > duration:
        raise CalibrationError(
            f"filter corner = {corner:g} Hz: its time constant of {tau:.3g} s is longer than the data "
            f"({duration:.3g} s)"
        )
    reach = max(int(np.ceil(0.5 * MIN_SLOPE_TIME_CONSTANTS * tau / np.median(np.diff(data.time)))), 1)
    stretch = np.cumsum(data.steps != 1)
    rows = np.arange(len(data))
    ahead, behind = np.minimum(rows + reach, len(data) - 1), np.maximum(rows - reach, 0)
    # a slope does not reach into another run; at an end it looks one way only
    ahead = np.where(stretch[ahead] == stretch, ahead, rows)
    behind = np.where(stretch[behind] == stretch, behind, rows)
    apart = data.time[ahead] - data.time[behind]
    rise: FloatArray = data.field[ahead] - data.field[behind]
    slope = np.divide(rise, apart[:, None], out=np.zeros_like(rise), where=apart[:, None] > 0.0)
    return replace(data, field=data.field + tau * slope, filter_cutoff=corner)
