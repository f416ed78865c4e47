"""From readings and telemetry to corrected samples: what the live bridge and ``magbridge correct`` share.

Alignment gives the channels and the parameters at the sample's time; the calibration turns them into the
corrected field. A parameter that is not known exactly (a mass in motion, telemetry that never came) widens
the sigma: the correction is evaluated at both ends of the interval in which the parameter lies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import inf, isfinite, nan, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.align import Aligner, Input, Sample
from magbridge.arrays import FloatArray
from magbridge.calibration.correct import Corrector
from magbridge.calibration.model import RAISED, Calibration, identity
from magbridge.columns import AGE, CHANNELS, COLUMNS, CORRECTED, require
from magbridge.config import Align
from magbridge.field.igrf import magnitude
from magbridge.field.nearby import HeldField
from magbridge.field.reference import main_field
from magbridge.learning import Learner
from magbridge.learning.model import TEMPERATURE
from magbridge.plausibility import Attitude, Plausibility
from magbridge.plausibility.direction import Direction
from magbridge.plausibility.told import Told
from magbridge.plausibility.turns import Turns
from magbridge.records import BEYOND, Corrected, Quality, Reading
from magbridge.toml import convert

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["TEMPERATURE", "Correction", "correct_rows"]

MAX_AGE = 30.0
"""s after which telemetry is stale, unless :meth:`magbridge.align.Aligner.tune` has said otherwise."""


class Correction:
    """Corrects reading after reading.

    Parameters
    ----------
    calibration : Calibration or None
        Without one every sample passes unchanged, flagged ``uncalibrated``.
    settings : Align, optional
        If not given, and what :func:`correct_rows` corrects is a bridge's own log: that bridge's.
    learner : Learner, optional
        Learns from the samples; what it publishes is used from the next sample on.

    Attributes
    ----------
    notices : list of str
        What was found doubtful since the caller has last emptied it, each once.
    """

    def __init__(
        self, calibration: Calibration | None, settings: Align | None = None, learner: Learner | None = None
    ) -> None:
        self.learner, self.held_field = learner, HeldField()
        self._given = settings is not None
        calibration = calibration if calibration is not None else identity()
        ranges = {parameter.name: (parameter.low, parameter.high) for parameter in calibration.parameters}
        inputs = tuple(
            Input(name, *ranges.get(name, (nan, nan)), max_age=MAX_AGE) for name in calibration.channels
        )
        self.aligner = Aligner(inputs, settings or Align(), calibration.sensor.power_cycle)
        self.names = tuple(one.name for one in inputs)
        for name in learner.watched if learner is not None else ():
            self.aligner.watch(name, MAX_AGE)
        self._wants_temperature = TEMPERATURE in self.aligner.by_name
        self._corrector = Corrector(calibration)
        self._raised = Corrector(calibration.at_level()) if calibration.level else None
        # what has no calibration is not expected to be the Earth's field
        self._told = told = Told()
        self.notices = told.notices
        judged = calibration.method != "none"
        self.plausibility = Plausibility(calibration.noise.sensor, told) if judged else None
        self.turns, self.attitude = Turns(told), Attitude(told)
        self.direction = None if calibration.boresight is None else Direction(told)

    def as_declared(self, attrs: Mapping[str, Any]) -> None:
        """Align as the bridge did whose log declares its settings among its attributes.

        Raises
        ------
        ConfigError
            A number out of range.
        """
        declared = {key: float(value) for key, value in attrs.items() if isinstance(value, (int, float))}
        names = [key for key in Align.__struct_fields__ if f"align.{key}" in declared]
        if names and not self._given:
            settings = {key: declared[f"align.{key}"] for key in names}
            self.aligner.settings = convert(settings, Align, attrs.get("source", "the log"), "align.")
        ages = {name: declared.get(f"telemetry.{name}.max_age") for name in self.names}
        self.aligner.tune(self.aligner.settings, {name: age for name, age in ages.items() if age})

    def telemetry(self, name: str, value: float, time_us: int, *, guessed: bool = False) -> None:
        """Take a telemetry value; arguments as :meth:`magbridge.align.Aligner.telemetry`."""
        self.aligner.telemetry(name, time_us, value, guessed=guessed)

    def reading(
        self,
        reading: Reading,
        time_us: int,
        *,
        restarted: bool = False,
        missing: int = 0,
        main_field: float = nan,
        where: tuple[float, float] | None = None,
    ) -> tuple[Sample, Corrected]:
        """Align and correct one reading, and judge what comes out.

        Parameters
        ----------
        reading, time_us, restarted, missing
            As for :meth:`magbridge.align.Aligner.reading`.
        main_field : float
            nT, the main field's total where the sample was taken; NaN where that is not known.
        where : tuple of 2 float or None
            deg, latitude and longitude; None where not known.
        """
        if self.learner is not None and self.learner.calibration is not self._corrector.calibration:
            self._use(self.learner.calibration)
        if self._wants_temperature and isfinite(reading.temperature):  # not every reading need have one
            self.aligner.telemetry(TEMPERATURE, time_us, reading.temperature)
        sample = self.aligner.reading(reading, time_us, restarted=restarted, missing=missing)
        (F, sigma, x, y, z, sx, sy, sz), quality = self._corrector.numbers(
            sample.time_us, sample.field, sample.values, sample.quality
        )
        judged = 0.0
        if self.plausibility is not None:
            if where is not None:
                self.plausibility.place(sample.time_us, *where)
            judged = self.plausibility.check(
                sample.time_us,
                reading.field,
                F,
                sigma,
                quality,
                main_field,
                self.aligner.settings.reference_sigma,
            )
            quality |= self.plausibility.flags
            turns = self.turns.check(sample.time_us, x, y, z, F, sigma * sigma + judged, quality)
            judged += turns + self.attitude.check(sample.time_us, x, y, z, F, sigma * sigma, quality)
        turned = 0.0
        if self.direction is not None:
            turned = self.direction.check(sample.time_us, x, y, z)
            quality |= self.direction.flags
        if self.learner is not None:
            quality |= self._learn(sample, quality, main_field, where, restarted=restarted)
            judged += self.learner.variance
        if sample.sigma or sample.spans or judged or turned:
            more = judged + (self._more(sample) if sample.sigma or sample.spans else 0.0)
            sigma = sqrt(sigma * sigma + more)
            more += turned
            sx, sy, sz = sqrt(sx * sx + more), sqrt(sy * sy + more), sqrt(sz * sz + more)
        return sample, Corrected(F, sigma, (x, y, z), (sx, sy, sz), quality)

    def _learn(
        self,
        sample: Sample,
        quality: int,
        main_field: float,
        where: tuple[float, float] | None,
        *,
        restarted: bool,
    ) -> int:
        """Let the learner have the sample; return its flags."""
        assert self.learner is not None
        if restarted:
            self.learner.restarted()
        self.learner.sample(
            sample.time_us,
            sample.field,
            self._corrector.regressors,
            sample.values,
            quality,
            faulty=self.plausibility is not None and self.plausibility.fault,
            reference=main_field,
            where=where,
            watched=[self.aligner.by_name[name].at(sample.time_us)[0] for name in self.learner.watched],
        )
        return self.learner.flags

    def _use(self, calibration: Calibration) -> None:
        """Correct from now on with another calibration, of the same terms or with effects more or fewer."""
        self.aligner.follow(calibration.channels)
        values = [track.last for track in self.aligner.tracks]
        by = self._corrector.replace(calibration, values)
        if self._raised is not None:
            self._raised.replace(calibration.at_level(), values)
        if self.plausibility is None:
            self.plausibility = Plausibility(calibration.noise.sensor, self._told)
        elif self.learner is not None:
            self.plausibility.explain(by, jumps=not self.learner.renewed)
            self.turns.explain(by)
            self.attitude.forget()

    def level(self, sample: Sample, corrected: Corrected) -> float:
        """Return how much of a corrected sample's sigma all samples share, nT; NaN without a level."""
        if self._raised is None:
            return nan
        raised = self._raised.numbers(sample.time_us, sample.field, sample.values, sample.quality)[0][0]
        return abs(raised - corrected.total_field) / RAISED

    def _more(self, sample: Sample) -> float:
        """Return the variance to add: ``s^2 + sum ((F(hi) - F(lo)) / 2)^2``, s and spans the sample's."""
        more = sample.sigma * sample.sigma
        for change in self._corrector.changes(sample.field, sample.values, sample.spans):
            more += 0.25 * change * change
        if not more < BEYOND * BEYOND:  # also NaN, as where a parameter has neither value nor range
            more = inf
        return more


def correct_rows(correction: Correction, deployment: xr.Dataset) -> xr.Dataset:
    """Correct the rows of a deployment, or of its pieces in order, as the live bridge would.

    One flag is added that live cannot be known yet: ``moving`` of the last sample before telemetry tells of
    a motion, where that sample's own telemetry is older than it. A motion that begins with a piece's first
    row does not reach back into the piece before.

    Parameters
    ----------
    correction : Correction
        Keeps its state from one piece to the next.
    deployment : Dataset (time)
        With ``mag_x mag_y mag_z`` (nT, sensor axes), and the parameters that the calibration needs; what is
        missing is not known, and the samples are flagged, as live.

    Returns
    -------
    Dataset (time)
        ``total_field total_field_sigma field_x field_y field_z anomaly quality``; ``time`` as in the input.
        The field is in body axes. The anomaly is the total field minus the IGRF, NaN where there is no
        position or no date. ``level_sigma`` is there where the calibration states one. All in nT, but for
        ``quality``, the bits of :class:`~magbridge.records.Quality`. A row without any channel is not a
        sample but telemetry: NaN there, with ``gap``.

    Raises
    ------
    FormatError
        A channel is missing.
    OutOfRange
        A date that the IGRF does not cover.
    """
    import xarray as xr  # noqa: PLC0415 - the live path runs without it

    require(deployment, CHANNELS)
    correction.as_declared(deployment.attrs)
    results = np.full((deployment.sizes["time"], len(CORRECTED)), nan)
    level, age = np.full((2, len(results)), nan)
    results[:, CORRECTED.index("quality")] = Quality.GAP
    vectors, places, attitudes = main_field(deployment), _places(deployment), _attitudes(deployment)
    if correction.learner is None:
        main_fields = magnitude(vectors)
    else:
        main_fields = _as_live(correction.held_field, deployment)
    known = main_fields.tolist()
    for row, reading, stamp in _readings(correction, deployment):
        if correction.direction is not None and attitudes is not None:
            correction.direction.expect(*vectors[row].tolist())
            correction.direction.attitude(stamp, *attitudes[row])
        sample, one = correction.reading(reading, stamp, main_field=known[row], where=places[row])
        level[row], age[row] = correction.level(sample, one), sample.age
        results[row] = one.total_field, one.total_field_sigma, *one.field, nan, one.quality
    _keep_late_joins(results, deployment)
    _flag_onsets(results, age)
    columns = dict(zip(CORRECTED, results.T, strict=True))
    if np.isfinite(level).any():
        columns["level_sigma"] = level
    columns["anomaly"] = columns["total_field"] - main_fields
    return xr.Dataset(
        {name: ("time", column, COLUMNS[name]._asdict()) for name, column in columns.items()},
        coords={"time": deployment["time"]},
        attrs={"source": deployment.attrs.get("source", "")},
    )


def _places(deployment: xr.Dataset) -> list[tuple[float, float] | None]:
    """Return latitude and longitude of every row, deg; None where they are not known."""
    if not {"latitude", "longitude"} <= set(deployment):
        return [None] * deployment.sizes["time"]
    both = (deployment[name].to_numpy().astype(float).tolist() for name in ("latitude", "longitude"))
    return [(lat, lon) if isfinite(lat + lon) else None for lat, lon in zip(*both, strict=True)]


def _attitudes(deployment: xr.Dataset) -> list[list[float]] | None:
    """Return roll, pitch and heading of every row, rad; None where a log has none."""
    names = ["roll", "pitch", "heading"]
    if not set(names) <= set(deployment):
        return None
    degrees = np.stack([deployment[name].to_numpy().astype(float) for name in names], axis=1)
    attitudes: list[list[float]] = np.radians(degrees).tolist()
    return attitudes


def _as_live(held: HeldField, deployment: xr.Dataset) -> FloatArray:
    """Return the main field (n,), nT, at every row as a bridge computes it; NaN where it is not known."""
    n = deployment.sizes["time"]
    depth = deployment["depth"].to_numpy().astype(float) if "depth" in deployment else np.zeros(n)
    utc_us = np.rint(np.asarray(deployment["time"].to_numpy(), float) * 1e6).astype(np.int64).tolist()
    found = np.full(n, nan)
    for row, (place, down) in enumerate(zip(_places(deployment), np.nan_to_num(depth).tolist(), strict=True)):
        if place is not None:
            found[row] = held.at((*place, down), utc_us[row])
    return found


def _keep_late_joins(results: FloatArray, deployment: xr.Dataset) -> None:
    """Flag again what a bridge flagged as late, with its sigma: rows do not tell how long they waited."""
    if not {"quality", "total_field_sigma"} <= set(deployment):
        return
    recorded = np.nan_to_num(deployment["quality"].to_numpy().astype(float)).astype(int)
    late = recorded & Quality.LATE_JOIN != 0
    sigma, quality = CORRECTED.index("total_field_sigma"), CORRECTED.index("quality")
    results[late, quality] = results[late, quality].astype(int) | Quality.LATE_JOIN
    results[late, sigma] = np.fmax(results[late, sigma], deployment["total_field_sigma"].to_numpy()[late])


def _flag_onsets(results: FloatArray, age: FloatArray) -> None:
    """Flag samples as moving after whose telemetry, `age` (n,) s old, a mass began to move."""
    quality = CORRECTED.index("quality")
    sampled = np.flatnonzero(np.isfinite(age))
    moving = results[sampled, quality].astype(int) & Quality.MOVING != 0
    onset = sampled[:-1][moving[1:] & ~moving[:-1] & (age[sampled[:-1]] > 0.0)]
    results[onset, quality] += Quality.MOVING


def _readings(correction: Correction, deployment: xr.Dataset) -> Iterator[tuple[int, Reading, int]]:
    """Yield each sample's row, reading and time (µs), after passing the telemetry so far to `correction`."""

    def column(name: str) -> list[float]:
        if name in deployment:
            return list(deployment[name].to_numpy().astype(float).tolist())
        return [nan] * deployment.sizes["time"]

    times = np.asarray(deployment["time"].to_numpy(), float)
    stamps = (np.rint(times * 1e6).astype(np.int64) & ~3).tolist()
    delays = [np.nan_to_num(np.array(column(f"mag_time_{axis}")) - times).round(6).tolist() for axis in "xyz"]
    wanted = [name for name in correction.aligner.by_name if name != TEMPERATURE]
    telemetry = [(name, column(name), column(AGE + name)) for name in wanted]
    cycles = column("power_cycle")
    channels = zip(*(column(f"mag_{axis}") for axis in "xyz"), strict=True)
    rows = zip(stamps, channels, zip(*delays, strict=True), column(TEMPERATURE), cycles, strict=True)
    for row, (stamp, field, delay, temperature, cycle) in enumerate(rows):
        for name, values, ages in telemetry:
            if isfinite(ages[row]):
                correction.telemetry(name, values[row], stamp - round(ages[row] * 1e6))
            elif isfinite(values[row]):  # an empty cell is not a message that the value is unknown
                correction.telemetry(name, values[row], stamp)
        if field[0] == field[0] or field[1] == field[1] or field[2] == field[2]:  # not all NaN
            power_cycle = int(cycle) if isfinite(cycle) else None
            yield (
                row,
                Reading(field, channel_delay=delay, temperature=temperature, power_cycle=power_cycle),
                stamp,
            )
        elif isfinite(temperature):  # of another log than the readings
            correction.telemetry(TEMPERATURE, temperature, stamp)
