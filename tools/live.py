"""Measure in-flight calibration on simulated gliders that change after their calibration.

    python tools/live.py --seeds 10 --hours 12
    python tools/live.py --nothing --seeds 4 --hours 24     a start without a calibration

Each glider is calibrated by the runs of the paper's Table 1. It then surveys a crustal field of 60 nT on
another day, with one change. The reference is the IGRF. A sample's telemetry is two seconds old, so a motion
begins before its report; the figures exclude samples during a motion.

fixed, bound, published   RMS error without bias after three hours, over the noise floor: of the fixed
              calibration, of a filter that knows cause and onset, and of the published field
normalised    normalised error of the published field, from the alarm on
delay         samples until the alarm, over the delay of a detector that knows cause and calibration
among, alone  fraction of the runs in which the true cause is among the named causes, or the only one
false         number of alarms without a change

With ``--nothing``, the gliders have no calibration. *Error* is then the published field's error without bias
over the noise floor, in each stretch of the survey; *mean* is its mean error, which is not observable;
*normalised* includes both.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import xarray as xr
from studies import Column, Row, Study
from study_worlds import MASSES

from magbridge import Calibration, Correction, fit, observations
from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.model import Parameter
from magbridge.columns import CHANNELS
from magbridge.config import Align
from magbridge.estimation.kalman import KalmanFilter
from magbridge.estimation.residual import rms
from magbridge.estimation.sequential import ALARM_LOG_RATIO
from magbridge.estimation.track_process import TRACK_STATES
from magbridge.field.geodesy import separation
from magbridge.field.igrf import magnitude
from magbridge.field.reference import main_field
from magbridge.learning import Learner
from magbridge.learning.estimator import Nuisance, class_prior
from magbridge.records import Quality, Reading
from sitl import load, segments, simulate
from sitl.dataset import channels, side_by_side
from sitl.inject import direction
from sitl.mission import CrissCross, Leg, Legs, Spirals
from sitl.world import Geology

CRUST = Geology(rms=60.0, top=1000.0, bottom=5000.0)
AGE_S = 2.0
"""Age of a sample's telemetry, s; the next telemetry arrives this time after the sample."""
CHANGE_SIGMA_NT = 200.0
"""1-sigma of a change's amplitude on an axis that the bound assumes, nT."""
Change = Callable[[xr.Dataset, np.random.Generator, float], np.ndarray]
"""Function of log, generator and size (nT) that returns the field added to the readings (n, 3), nT."""


class Published(NamedTuple):
    """Published total field and sigma (n,), nT, quality (n,), and row and named causes of each alarm."""

    total: np.ndarray
    sigma: np.ndarray
    quality: np.ndarray
    alarms: list[tuple[int, tuple[str, ...]]]


# ---- the changes -------------------------------------------------------------------------------------------


def hours_of(log: xr.Dataset) -> np.ndarray:
    """Return the time since the start (n,), h."""
    time = log["time"].to_numpy()
    return np.asarray((time - time[0]) / 3600.0)


def offset(course: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return a change by an offset (n, 3) in a random direction, with a course (n,) of the hours (n,)."""
    return lambda log, rng, size: np.outer(course(hours_of(log)), size * direction(rng))


def warming(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    """Return the offset (n, 3) of a sensor that warms from -10 to +2 degC, as in the paper's trial 1."""
    warmer = 12.0 * (1.0 - np.exp(-hours_of(log) / 0.5))
    log["sensor_temperature"] = "time", -10.0 + warmer
    return np.asarray((warmer / 12.0)[:, None] * 3.0 * size * direction(rng))


def pump(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    """Return the field (n, 3) of a pump, on for 2 of 10 min, whose wiring changes at 40 % of the survey."""
    current = 2.0 * ((hours_of(log) * 6.0) % 1.0 < 0.2)
    log["pump_current"] = "time", current, {"units": "A"}
    changed = hours_of(log) > 0.4 * hours_of(log)[-1]
    return np.outer(current * changed, 0.5 * size * direction(rng))


def clock(log: xr.Dataset, _: np.random.Generator, size: float) -> np.ndarray:
    """Delay the telemetry of the masses by half of `size`, in s, after 40 % of the survey."""
    time = log["time"].to_numpy()
    later = hours_of(log) > 0.4 * hours_of(log)[-1]
    for name in MASSES:
        values = log[name].to_numpy()
        log[name] = "time", np.where(later, np.interp(time - 0.5 * size, time, values), values)
    return np.zeros((len(time), 3))


def sheet(log: xr.Dataset, _: np.random.Generator, size: float) -> np.ndarray:
    """Shift the reference by three times `size` nT after 40 % of the survey, as another map sheet does."""
    log["reference_error"] = "time", 3.0 * size * (hours_of(log) > 0.4 * hours_of(log)[-1])
    return np.zeros((log.sizes["time"], 3))


CHANGES: dict[str, tuple[Change, str, float]] = {
    "nothing": (offset(np.zeros_like), "", 0.0),
    "turn-on step": (offset(np.ones_like), "offset_step", 0.0),
    "bolt magnetised": (offset(lambda hours: hours > 0.4 * hours[-1]), "offset_step", 0.4),
    "drift": (offset(lambda hours: 3.75 * np.maximum(hours / hours[-1] - 0.2, 0.0)), "offset_drift", 0.2),
    "warming (trial 1)": (warming, "temperature_offset", 0.0),
    "pump": (pump, "current_field", 0.4),
    "clock": (clock, "clock_offset", 0.4),
    "map": (sheet, "map_error", 0.4),
    "straight over rock": (offset(np.zeros_like), "", 0.0),
}
"""Change by name: function, cause, and the fraction of the survey after which it begins. The drift reaches
three times the size."""

# ---- the bounds --------------------------------------------------------------------------------------------


def filtered(
    series: FloatArray, columns: FloatArray, log: xr.Dataset, rest: BoolArray, calibration: Calibration
) -> Iterator[tuple[FloatArray, float, float]]:
    """Filter a series (n,), nT: columns (n, k) with unknown coefficients, plus the nuisance along the track.

    Yield the coefficients (k,) before each sample, the innovation and its variance. Only the samples in
    `rest` (n,) update the filter.
    """
    nuisance = Nuisance(calibration.noise, Align().reference_sigma)
    latitude, longitude = (log[name].to_numpy() for name in ("latitude", "longitude"))
    north, east = separation(latitude[:-1], longitude[:-1], latitude[1:], longitude[1:])
    metres, seconds = (np.r_[0.0, step] for step in (np.hypot(north, east), np.diff(log["time"].to_numpy())))
    k = columns.shape[1]
    P = np.diag(np.full(k + TRACK_STATES, CHANGE_SIGMA_NT**2))
    P[k:, k:] = nuisance.initial
    estimate = KalmanFilter(np.zeros(len(P)), P)
    for i, moved in enumerate(zip(metres.tolist(), seconds.tolist(), strict=True)):
        estimate.predict(*nuisance.transition(*moved), slice(k, None))
        row = np.r_[columns[i], -nuisance.row(1.0)]
        estimate.innovate(-float(series[i]), row, nuisance.white_variance)
        yield estimate.mean[:k].copy(), estimate.innovation, estimate.variance
        if rest[i]:
            estimate.update()


def best_delay(
    effect: FloatArray, log: xr.Dataset, rest: BoolArray, calibration: Calibration, since: int
) -> int:
    """Return the number of samples in `rest` (n,) until a known `effect` (n,), nT, is significant.

    The effect on the total field begins at sample `since`. It is significant if the expected log-likelihood
    ratio, half the effect's whitened energy, reaches the threshold of the bridge.
    """
    energy, count = 0.0, 0
    none = np.empty((len(effect), 0))
    for k, (_, v, S) in enumerate(filtered(effect, none, log, rest, calibration)):
        if rest[k]:
            energy, count = energy + 0.5 * v * v / S, count + (k >= since)
            if energy > ALARM_LOG_RATIO:
                break
    return count


def best_field(
    added: FloatArray, log: xr.Dataset, rest: BoolArray, calibration: Calibration, reference: FloatArray
) -> FloatArray:
    """Return the total field (n,), nT, of a Kalman filter that knows the time course of a change.

    The filter estimates the amplitude and direction of `added` (n, 3), nT. The field of a sample is computed
    before the sample updates the filter. `reference` (n,), nT, is the main field.
    """
    seen, values, time = channels(log), side_by_side(log, MASSES), log["time"].to_numpy()
    total = correct(calibration, seen, values, time).total
    amount = np.linalg.norm(added, axis=1) / np.linalg.norm(added, axis=1).max()
    by_axis = [correct(calibration, seen + one, values, time).total - total for one in np.eye(3)]
    by_change = np.stack(by_axis, axis=1) * amount[:, None]
    known = [x for x, _, _ in filtered(total - reference, by_change, log, rest, calibration)]
    return np.asarray(total - np.sum(by_change * known, axis=1))


# ---- the flight, and the bridge ----------------------------------------------------------------------------


def fly(name: str, seed: int, length: float) -> tuple[xr.Dataset, xr.Dataset]:
    """Simulate a glider; return its runs, and its survey at twice the rate that :func:`sampled` keeps."""
    straight = Leg(
        duration=3600.0 * length, pitch=0.0, roll=1.0, heading=70.0, segment="survey",
        parameters=dict.fromkeys(MASSES, 0.0),
    )  # fmt: skip
    survey = Legs((straight,)) if name == "straight over rock" else CrissCross(hours=length, roll=(1.0, 2.0))
    world, instrument = {"geology": CRUST}, {"rate": 1.0 / AGE_S}
    scenario = load("random_glider").replace(world=world, mission=(Spirals(), survey), instrument=instrument)
    runs, mission = segments(simulate(scenario, seed)).values()
    return runs.isel(time=slice(0, None, 2)), mission.copy()


def sampled(log: xr.Dataset) -> xr.Dataset:
    """Return every second row of a log, with the telemetry of the row before."""
    sent, samples = (log.isel(time=slice(k, log.sizes["time"] & ~1, 2)) for k in (0, 1))
    return samples.assign({name: ("time", sent[name].to_numpy()) for name in (*MASSES, *currents(log))})


def currents(log: xr.Dataset) -> tuple[str, ...]:
    """Return the names of the currents in a log."""
    return ("pump_current",) * ("pump_current" in log)


def learn(
    learner: Learner | None, calibration: Calibration, log: xr.Dataset, age_s: float = AGE_S
) -> Published:
    """Correct a survey as the bridge does, with or without a learner; its telemetry is `age_s` (s) old."""
    correction = Correction(calibration, learner=learner)
    n = log.sizes["time"]
    total, sigma, quality, alarms = np.empty(n), np.empty(n), np.empty(n, int), []
    reference = (magnitude(main_field(log)) + wrong_by(log)).tolist()
    stamps = (np.rint(log["time"].to_numpy() * 1e6).astype(np.int64) & ~3).tolist()
    where = list(zip(log["latitude"].to_numpy().tolist(), log["longitude"].to_numpy().tolist(), strict=True))
    telemetry = {key: log[key].to_numpy().tolist() for key in (*MASSES, *currents(log))}
    fields, warmth = channels(log).tolist(), log["sensor_temperature"].to_numpy().tolist()
    for k in range(n):
        for key, values in telemetry.items():
            correction.telemetry(key, values[k], stamps[k] - round(age_s * 1e6))
        reading = Reading(tuple(fields[k]), temperature=warmth[k])
        _, one = correction.reading(reading, stamps[k], main_field=reference[k], position=where[k])
        total[k], sigma[k], quality[k] = one.total_field, one.total_field_sigma, one.quality
        if learner is None:
            continue
        if any(notice.text.startswith("unexplained") for notice in learner.notices):
            alarms.append((k, learner.state.causes))
        learner.notices.clear()
    return Published(total, sigma, quality, alarms)


def at_rest(quality: np.ndarray) -> np.ndarray:
    """Return the samples (n,) at which the masses were at rest until the next telemetry."""
    rest = (quality & int(Quality.MOVING | Quality.STALE_TELEMETRY)) == 0
    rest[:-1] &= rest[1:]
    return np.asarray(rest)


def wrong_by(log: xr.Dataset) -> np.ndarray | float:
    """Return the error of the reference (n,), nT; 0 if the log has no such error."""
    return log["reference_error"].to_numpy() if "reference_error" in log else 0.0


def run(change: str, seed: int, hours: float, size: float) -> list[Row]:
    """Simulate and calibrate a glider, change it, and score the survey with in-flight calibration."""
    add, cause, begins = CHANGES[change]
    runs, log = fly(change, seed, hours)
    calibration = fit(observations(runs, MASSES), "auto").calibration
    clean = log.copy()
    added = add(log, np.random.default_rng([seed, 7]), size)
    for k, channel in enumerate(CHANNELS):
        log[channel] = "time", log[channel].to_numpy() + added[:, k]
    added, log, clean = added[1::2], sampled(log), sampled(clean)
    truth = log["truth_total_field"].to_numpy()
    values, time = side_by_side(log, MASSES), log["time"].to_numpy()
    fixed = correct(calibration, channels(log), values, time)
    exact = correct(calibration, channels(clean), side_by_side(clean, MASSES), time)
    seen = learn(Learner(calibration, currents=currents(log)), calibration, log)
    rest = at_rest(seen.quality)
    reference = magnitude(main_field(log))
    best = best_field(added, log, rest, calibration, reference) if added.any() else fixed.total
    late = rest & (hours_of(log) > min(3.0, 0.5 * hours))
    row: Row = {}
    for label, total in (("fixed", fixed.total), ("bound", best), ("published", seen.total)):
        row[label] = float(np.std((total - truth)[late])) / calibration.noise.sensor
    since = int(begins * len(time))
    real = [(k, causes) for k, causes in seen.alarms if cause and k >= since]
    found = real[0] if real else None
    after = late & (np.arange(len(time)) >= (found[0] if found else 0))
    row["sigma"] = rms(((seen.total - truth) / seen.sigma)[after])
    row["false"] = float(len(seen.alarms) - len(real))
    if cause:
        effect = np.where(np.arange(len(time)) >= since, fixed.total - exact.total - wrong_by(log), 0.0)
        optimal = best_delay(effect, log, rest, calibration, since)
        until = np.count_nonzero(rest[since : found[0]]) + 1 if found else np.nan
        row |= {
            "delay": until / optimal,
            "among": float(found is not None and cause in found[1]),
            "alone": float(found is not None and found[1] == (cause,)),
        }
    return [row]


STUDY = Study(
    run,
    ("change",),
    {
        "fixed": Column("fixed"),
        "bound": Column("bound"),
        "published": Column("published"),
        "maximum": Column("published", np.max),
        "normalised": Column("sigma"),
        "its minimum": Column("sigma", np.min),
        "its maximum": Column("sigma", np.max),
        "delay": Column("delay", form=".1f"),
        "its maximum ": Column("delay", np.max, ".1f"),
        "among": Column("among", np.mean, ".0%"),
        "alone": Column("alone", np.mean, ".0%"),
        "false": Column("false", np.sum, ".0f"),
    },
)


# ---- a start without a calibration -------------------------------------------------------------------------

STRETCH_ENDS_H = (0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.5, 2.25, 3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0)
SENSOR_NOISE_NT = 1.0


def run_nothing(seed: int, hours: float) -> list[Row]:
    """Return a row for each stretch of one glider's survey."""
    log = sampled(fly("nothing", seed, hours)[1])
    parameters = []
    for name in MASSES:
        low, high = float(log[name].min()), float(log[name].max())
        parameters.append(Parameter(name, "", low, high, 0.5 * (low + high), 0.5 * (high - low)))
    prior = class_prior(tuple(parameters))
    seen = learn(Learner(prior), prior, log)
    time, error = hours_of(log), seen.total - log["truth_total_field"].to_numpy()
    rest = at_rest(seen.quality)
    rows: list[Row] = []
    for low, high in pairwise(STRETCH_ENDS_H):
        here = rest & (time >= low) & (time < high)
        if here.sum() > 10:
            rows.append(
                {
                    "stretch": f"{low:g} to {high:g} h",
                    "error": float(np.std(error[here])) / SENSOR_NOISE_NT,
                    "mean": abs(float(np.mean(error[here]))), "sigma": float(np.median(seen.sigma[here])),
                    "normalised": rms((error / seen.sigma)[here]),
                }
            )  # fmt: skip
    return rows


NOTHING = Study(
    run_nothing,
    ("stretch",),
    {
        "error / noise": Column("error"),
        "maximum": Column("error", np.max),
        "mean, nT": Column("mean", form=".0f"),
        "sigma, nT": Column("sigma", form=".0f"),
        "normalised": Column("normalised", rms),
        "its maximum": Column("normalised", np.max),
    },
)


if __name__ == "__main__":
    if "--nothing" in sys.argv:
        NOTHING.main(__doc__, seeds=4, first=0, hours=24.0, nothing=False)
    else:
        STUDY.main(__doc__, seeds=10, first=0, hours=12.0, size=20.0, changes=list(CHANGES))
