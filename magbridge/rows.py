"""Correct the rows of a log with the algorithm and state of the live bridge."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite, nan
from typing import TYPE_CHECKING, Final

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import vector_covariance
from magbridge.calibration.heading import (
    NO_HEADING_FLAGS,
    UNIFORM_SIGMA_DEG,
    heading,
    model_declination_sigma,
    published_covariance,
)
from magbridge.columns import AGE, CHANNELS, COLUMNS, CORRECTED, HEADINGS, TEMPERATURE, require, require_units
from magbridge.correction import Correction
from magbridge.datasets import expect, standard_log
from magbridge.errors import FormatError
from magbridge.field.igrf import HeldField, magnitude
from magbridge.field.reference import main_field, other_units
from magbridge.records import NEVER, Quality, Reading

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.model import Calibration

__all__ = ["correct_rows", "refuse_unsuited"]

SAME_US: Final = 1000
"""Difference of the times below which two rows hold the same report, µs: ages are rounded."""


def correct_rows(correction: Correction, deployment: xr.Dataset) -> xr.Dataset:
    """Correct the rows of a deployment, or of its pieces in order, as the live bridge would.

    One flag is added that needs later telemetry, which a live bridge does not have: ``moving`` for the last
    sample before the telemetry reports a motion, if the telemetry of that sample is older than the sample. A
    motion that begins with the first row of a piece does not flag the last row of the previous piece.

    If the interval of two reports exceeds ``max_age``, a parameter is interpolated between them, and sigma
    covers both values. Its age is then the time to the nearer report.

    Parameters
    ----------
    correction : Correction
        Keeps its state from one piece to the next.
    deployment : Dataset (time)
        With ``mag_x mag_y mag_z`` (nT, sensor axes), and the parameters that the calibration needs. Missing
        values are unknown, and the samples are flagged, as live.

    Returns
    -------
    Dataset (time)
        ``total_field total_field_sigma field_x field_y field_z anomaly quality``; ``time`` as in the input.
        The field is in body axes. The anomaly is the total field minus the IGRF, NaN without a position or a
        date, and at a date that the IGRF does not cover. With roll and pitch, and a boresight in the
        calibration, the columns of :data:`~magbridge.columns.HEADINGS` (deg) are added. ``level_sigma`` is
        there where the calibration states one. All other columns are in nT, except
        ``quality``, the bits of :class:`~magbridge.records.Quality`. A row without any channel is not a
        sample but telemetry: NaN there, with ``gap``.

    Raises
    ------
    FormatError
        A channel is missing, times do not increase, or the log does not suit the calibration, as
        :func:`refuse_unsuited` tests.
    """
    import xarray as xr  # noqa: PLC0415 - the live path runs without it

    expect("correction", correction, Correction, "magbridge.Correction(calibration)")
    given = deployment
    deployment = standard_log(given)
    require(deployment, CHANNELS)
    if not correction.is_suited:
        refuse_unsuited(correction.calibration, deployment)
        # a piece of telemetry alone shows no unit of the channels: the next piece is tested, too
        whole = deployment[list(CHANNELS)].to_array().notnull().all("variable")
        correction.is_suited = bool(whole.any())
    correction.as_declared(deployment.attrs)
    results = np.full((deployment.sizes["time"], len(CORRECTED)), nan)
    level, age = np.full((2, len(results)), nan)
    results[:, CORRECTED.index("quality")] = Quality.GAP
    vectors, places = main_field(deployment, is_partial=True), _places(deployment)
    attitudes = _angles(deployment, "roll", "pitch", "heading")
    if correction.learner is None:
        main_fields = magnitude(vectors)
    else:
        main_fields = _as_live(correction.held_field, deployment, vectors)
    known, tilt = main_fields.tolist(), _angles(deployment, "roll", "pitch")
    fields, values = np.full((len(results), 3), nan), np.full((len(results), len(correction.names)), nan)
    added = np.zeros(len(results))
    depth = _column(deployment, "depth")
    for row, reading, stamp in _readings(correction, deployment):
        if correction.direction is not None and attitudes is not None:
            correction.direction.expect(*vectors[row].tolist())
            correction.direction.attitude(stamp, *attitudes[row].tolist())
        sample, one = correction.reading(
            reading, stamp, main_field=known[row], position=places[row], depth=float(depth[row])
        )
        level[row], age[row] = correction.level(sample, one), sample.age
        fields[row], values[row] = sample.field, sample.values[: values.shape[1]]
        added[row] = one.field_sigma[0] ** 2 + one.field_sigma[1] ** 2 + one.field_sigma[2] ** 2
        results[row] = one.total_field, one.total_field_sigma, *one.field, nan, one.quality
    _keep_late_joins(results, deployment)
    _flag_onsets(results, age)
    columns = dict(zip(CORRECTED, results.T, strict=True))
    if np.isfinite(level).any():
        columns["level_sigma"] = level
    columns["anomaly"] = columns["total_field"] - main_fields
    calibration, sigma = correction.calibration, correction.aligner.settings.reference_sigma
    if tilt is not None and calibration.boresight is not None:
        samples = fields, values, added
        columns |= _headings(calibration, samples, results[:, 2:5], tilt, vectors, sigma, deployment)
        flags = np.nan_to_num(columns["quality"]).astype(int) & NO_HEADING_FLAGS
        least = np.where(flags != 0, UNIFORM_SIGMA_DEG, 0.0)
        columns["heading_sigma"] = np.maximum(columns["heading_sigma"], least)
    return xr.Dataset(
        {name: ("time", column, COLUMNS[name]._asdict()) for name, column in columns.items()},
        coords={"time": given["time"]},
        attrs={"source": deployment.attrs.get("source", "")},
    )


def refuse_unsuited(calibration: Calibration, log: xr.Dataset) -> None:
    """Check that a log suits a calibration.

    FormatError: the log is of another sensor, a parameter is in another unit, or the channels are not in nT.
    """
    source, sensor = log.attrs.get("source", "the deployment"), str(log.attrs.get("sensor", ""))
    if not calibration.sensor.may_be(sensor):
        name = calibration.sensor.name
        raise FormatError(source, f"expected a log of sensor {name!r}, the calibration's, got {sensor!r}")
    require_units(log, calibration.units)
    channels = log[list(CHANNELS)].to_array().to_numpy().T
    if wrong := other_units(channels, calibration.reference.field):
        raise FormatError(source, wrong)


def _column(deployment: xr.Dataset, name: str) -> FloatArray:
    """Return a column (n,); NaN if the log lacks it."""
    if name in deployment:
        return np.asarray(deployment[name].to_numpy().astype(float))
    return np.full(deployment.sizes["time"], nan)


def _angles(deployment: xr.Dataset, *names: str) -> FloatArray | None:
    """Return columns in deg as (n, k) rad; None if the log lacks one."""
    if not set(names) <= set(deployment):
        return None
    return np.asarray(np.radians(np.stack([_column(deployment, name) for name in names], axis=1)))


def _headings(
    calibration: Calibration,
    samples: tuple[FloatArray, FloatArray, FloatArray],
    vector: FloatArray,
    tilt: FloatArray,
    main: FloatArray,
    crustal_sigma: float,
    deployment: xr.Dataset,
) -> dict[str, FloatArray]:
    """Return the columns of :data:`~magbridge.columns.HEADINGS`.

    `samples` are the aligned field (nT) and channels, and the sum of the three components' variances (nT^2)
    as published; `vector` (n, 3) is the corrected field in body axes and `main` (n, 3) the main field in
    north-east-down, nT; `tilt` (n, 2) is roll and pitch, rad; `crustal_sigma` (nT) is the 1-sigma of the
    crustal field that the main-field model lacks.
    """
    field, channels, published = samples
    time = np.asarray(deployment["time"].to_numpy(), float)
    assert calibration.boresight is not None
    turn = np.array(calibration.boresight.covariance)
    stated = vector_covariance(calibration, field, channels, time)
    covariance = published_covariance(stated, turn, vector, published)
    declination = np.degrees(np.arctan2(main[:, 1], main[:, 0]))
    uncertain = model_declination_sigma(np.hypot(main[:, 0], main[:, 1]), crustal_sigma)
    found = heading(
        vector, tilt[:, 0], tilt[:, 1], declination, covariance=covariance, boresight_covariance=turn,
        tilt_sigma_deg=calibration.boresight.tilt_sigma, declination_sigma_deg=uncertain,
    )  # fmt: skip
    columns = found.magnetic, found.true, found.sigma, declination, uncertain
    return dict(zip(HEADINGS, columns, strict=True))


def _places(deployment: xr.Dataset) -> list[tuple[float, float] | None]:
    """Return latitude and longitude of every row, deg; None where they are not known."""
    both = (_column(deployment, name).tolist() for name in ("latitude", "longitude"))
    return [(lat, lon) if isfinite(lat + lon) else None for lat, lon in zip(*both, strict=True)]


def _as_live(held: HeldField, deployment: xr.Dataset, vectors: FloatArray) -> FloatArray:
    """Return the main field (n,), nT, at every row as a bridge computes it; NaN where `vectors` is."""
    depth = np.nan_to_num(_column(deployment, "depth"))
    utc_us = np.rint(np.asarray(deployment["time"].to_numpy(), float) * 1e6).astype(np.int64).tolist()
    found = np.full(len(depth), nan)
    for row, (place, down) in enumerate(zip(_places(deployment), depth.tolist(), strict=True)):
        if place is not None and vectors[row, 0] == vectors[row, 0]:
            found[row] = held.field_at((*place, down), utc_us[row])
    return found


def _keep_late_joins(results: FloatArray, deployment: xr.Dataset) -> None:
    """Keep ``late_join`` flags and sigmas that the bridge recorded, because rows do not hold delays."""
    if not {"quality", "total_field_sigma"} <= set(deployment):
        return
    recorded = np.nan_to_num(_column(deployment, "quality")).astype(int)
    late = recorded & Quality.LATE_JOIN != 0
    sigma, quality = CORRECTED.index("total_field_sigma"), CORRECTED.index("quality")
    results[late, quality] = results[late, quality].astype(int) | Quality.LATE_JOIN
    results[late, sigma] = np.fmax(results[late, sigma], deployment["total_field_sigma"].to_numpy()[late])


def _flag_onsets(results: FloatArray, age: FloatArray) -> None:
    """Flag the last sample before each motion as moving if its telemetry is old; `age` (n,) is in s."""
    quality = CORRECTED.index("quality")
    sampled = np.flatnonzero(np.isfinite(age))
    moving = results[sampled, quality].astype(int) & Quality.MOVING != 0
    onset = sampled[:-1][moving[1:] & ~moving[:-1] & (age[sampled[:-1]] > 0.0)]
    results[onset, quality] += Quality.MOVING


def _readings(correction: Correction, deployment: xr.Dataset) -> Iterator[tuple[int, Reading, int]]:
    """Yield each sample's row, reading and time (µs), after passing the telemetry so far to `correction`.

    If the next report of a parameter comes later than its ``max_age``, this report is passed, too.
    """

    def column(name: str) -> list[float]:
        return list(_column(deployment, name).tolist())

    times = np.asarray(deployment["time"].to_numpy(), float)
    stamps = (np.rint(times * 1e6).astype(np.int64) & ~3).tolist()
    sampled = [_column(deployment, f"mag_time_{axis}") for axis in "xyz"]
    delays = [np.nan_to_num(one - times).round(6).tolist() for one in sampled]
    wanted = [name for name in correction.aligner.by_name if name != TEMPERATURE]
    telemetry = [(name, column(name), column(AGE + name)) for name in wanted]
    following = [
        (name, correction.aligner.by_name[name], _following(stamps, values, ages))
        for name, values, ages in telemetry
    ]
    cycles = column("power_cycle")
    channels = zip(*(column(f"mag_{axis}") for axis in "xyz"), strict=True)
    rows = zip(stamps, channels, zip(*delays, strict=True), column(TEMPERATURE), cycles, strict=True)
    for row, (stamp, field, delay, temperature, cycle) in enumerate(rows):
        for name, values, ages in telemetry:
            if isfinite(ages[row]):
                correction.telemetry(name, values[row], stamp - round(ages[row] * 1e6))
            elif isfinite(values[row]):  # an empty cell is not a message that the value is unknown
                correction.telemetry(name, values[row], stamp)
        for name, track, reports in following:
            time_us, value = reports[row]
            if time_us - track.last_us > track.max_age * 1e6 and isfinite(value) and not track.lacking:
                correction.telemetry(name, value, time_us)
        if field[0] == field[0] or field[1] == field[1] or field[2] == field[2]:  # not all NaN
            power_cycle = int(cycle) if isfinite(cycle) else None
            fields = Reading(field, channel_delay=delay, temperature=temperature, power_cycle=power_cycle)
            yield row, fields, stamp
        elif isfinite(temperature):  # of another log than the readings
            correction.telemetry(TEMPERATURE, temperature, stamp)


def _following(stamps: list[int], values: list[float], ages: list[float]) -> list[tuple[int, float]]:
    """Return time (µs) and value of the first report after that of each row; NaN without one."""
    found = []
    report = after = (NEVER, nan)
    for stamp, value, age in zip(reversed(stamps), reversed(values), reversed(ages), strict=True):
        if not isfinite(age) and not isfinite(value):  # the row has the report of an earlier row
            found.append(report)
            continue
        time_us = stamp - round(age * 1e6) if isfinite(age) else stamp
        if abs(report[0] - time_us) > SAME_US:
            report, after = (time_us, value), report
        found.append(after)
    return found[::-1]
