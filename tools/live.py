"""What a bridge that learns in flight makes of a calibration that no longer fits, on simulated gliders.

Each glider flies the paper's Table 1 and is calibrated; then it surveys a crustal field of 60 nT on another
day, with one thing changed, and the bridge has nothing but the IGRF to compare with. A sample's telemetry
is two seconds old: a mass's motion begins before it is reported. Samples in a motion are left out. Printed
for each change, the median of the gliders unless stated otherwise:

- fixed, MagNav, bound, published (and the 95th percentile): RMS error about its mean after the first three
  hours, over the noise floor, of the fixed field, the field by MagNav.jl's online filter
  (:mod:`magnav_online`), by one that knows the cause and its onset (:mod:`live_bound`) and the published one;
- sigma: normalised error of the published field, from the alarm on;
- beyond: how many samples are off by more than three sigmas, over those that the optimal detector needs,
  which knows cause, direction, size and calibration, but the crustal field no better than the bridge does
  (95th percentile);
- delay: samples until the alarm, over the same;
- among, alone: how often the cause is among those named, and the only one;
- false: alarms without a cause;
- moved: by how many sigmas a coefficient has moved (95th percentile).

    python tools/live.py --seeds 10 --hours 12
"""

from __future__ import annotations

import sys
import warnings
from typing import NamedTuple

import numpy as np
import xarray as xr
from live_bound import best_delay, best_field
from live_changes import CHANGES, MASSES, hours
from magnav_online import online
from rich.console import Console
from studies import add_engine, command_line, in_order, table

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS
from magbridge.config import Align
from magbridge.correction import Correction
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import separation
from magbridge.field.igrf import magnitude
from magbridge.field.reference import main_field
from magbridge.learning import Learner
from magbridge.learning.nuisance import LENGTH
from magbridge.records import Quality, Reading
from sitl import load, segments, simulate
from sitl.dataset import channels, side_by_side
from sitl.mission import CrissCross, Leg, Legs, Spirals
from sitl.world import Geology

ROCK = Geology(rms=60.0, top=1000.0, bottom=5000.0)
AGE = 2.0
"""s that a sample's telemetry is old; the next comes as long after the sample."""


class Row(NamedTuple):
    """One survey: errors over the floor; delays over the optimal one; NaN where it does not apply."""

    fixed: float
    peer: float
    bound: float
    published: float
    sigma: float
    beyond: float
    delay: float
    among: float
    alone: float
    false: float
    moved: float


class Seen(NamedTuple):
    """What the bridge published of every sample, and each alarm: its row and its causes."""

    total: np.ndarray
    sigma: np.ndarray
    quality: np.ndarray
    alarms: list[tuple[int, tuple[str, ...]]]


def fly(name: str, seed: int, length: float) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the calibration runs, and the survey with what telemetry says between the samples, too."""
    straight = Leg(
        duration=3600.0 * length,
        pitch=0.0,
        roll=1.0,
        heading=70.0,
        segment="survey",
        parameters={"battpos": 0.0, "ballast": 0.0},
    )
    survey = Legs((straight,)) if name == "straight over rock" else CrissCross(hours=length, roll=(1.0, 2.0))
    scenario = load("random_glider").replace(
        world={"geology": ROCK}, mission=(Spirals(), survey), instrument={"rate": 1.0 / AGE}
    )
    runs, mission = segments(simulate(scenario, seed)).values()
    return runs.isel(time=slice(0, None, 2)), mission.copy()


def sampled(log: xr.Dataset) -> xr.Dataset:
    """Return every second row, with what telemetry said the row before."""
    sent, samples = (log.isel(time=slice(k, log.sizes["time"] & ~1, 2)) for k in (0, 1))
    return samples.assign({name: ("time", sent[name].to_numpy()) for name in (*MASSES, *currents(log))})


def currents(log: xr.Dataset) -> tuple[str, ...]:
    return ("pump_current",) * ("pump_current" in log)


def learn(learner: Learner, calibration: Calibration, log: xr.Dataset) -> Seen:
    """Correct a survey as the bridge does."""
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
            correction.telemetry(key, values[k], stamps[k] - round(AGE * 1e6))
        reading = Reading(tuple(fields[k]), temperature=warmth[k])
        _, one = correction.reading(reading, stamps[k], main_field=reference[k], where=where[k])
        total[k], sigma[k], quality[k] = one.total_field, one.total_field_sigma, one.quality
        if any(notice.text.startswith("unexplained") for notice in learner.notices):
            alarms.append((k, learner.state.causes))
        if "-v" in sys.argv and learner.notices:
            print(
                k,
                "; ".join(n.text for n in learner.notices),
                learner.state.causes,
                np.round(learner.state.rms, 1),
            )
        learner.notices.clear()
    return Seen(total, sigma, quality, alarms)


def at_rest(quality: np.ndarray) -> np.ndarray:
    """Return whether the masses were at rest until what telemetry said next."""
    rest = (quality & int(Quality.MOVING | Quality.STALE_TELEMETRY)) == 0
    rest[:-1] &= rest[1:]
    return np.asarray(rest)


def wrong_by(log: xr.Dataset) -> np.ndarray | float:
    """Return by how much the reference is wrong, nT (n,)."""
    return log["reference_error"].to_numpy() if "reference_error" in log else 0.0


def run(name: str, seed: int, length: float, size: float) -> Row:
    """Simulate, calibrate, change, correct while learning, and score."""
    change, cause, begins = CHANGES[name]
    runs, log = fly(name, seed, length)
    calibration = fit(observations(runs, MASSES), "auto").calibration
    clean = log.copy()
    added = change(log, np.random.default_rng([seed, 7]), size)
    for k, channel in enumerate(CHANNELS):
        log[channel] = "time", log[channel].to_numpy() + added[:, k]
    added, log, clean = added[1::2], sampled(log), sampled(clean)
    truth = log["truth_total_field"].to_numpy()
    values, time = side_by_side(log, MASSES), log["time"].to_numpy()
    fixed = correct(calibration, channels(log), values, time)
    exact = correct(calibration, channels(clean), side_by_side(clean, MASSES), time)
    learner = Learner(calibration, currents=currents(log))
    seen = learn(learner, calibration, log)
    rest = at_rest(seen.quality)
    metres = separation(*(log[name].to_numpy()[[0, 100]].tolist()[0] for name in ("latitude", "longitude")),
                        *(log[name].to_numpy()[100] for name in ("latitude", "longitude")))  # fmt: skip
    speed = float(np.hypot(*metres)) / (time[100] - time[0])
    rock = Align().reference_sigma, LENGTH / speed
    reference = magnitude(main_field(log))
    peer = online(fixed.vector, fixed.total, reference, time, rest, calibration.noise.sensor, rock)
    best = best_field(added, log, rest, calibration, reference) if added.any() else fixed.total
    late = rest & (hours(log) > min(3.0, 0.5 * length))
    floor = calibration.noise.sensor
    since = int(begins * len(time))
    real = [(k, causes) for k, causes in seen.alarms if cause and k >= since]
    found = real[0] if real else None
    effect = np.where(np.arange(len(time)) >= since, fixed.total - exact.total - wrong_by(log), 0.0)
    optimal = best_delay(effect, log, rest, calibration, since)
    until = np.count_nonzero(rest[since : found[0]]) + 1 if found else np.nan
    after = late & (np.arange(len(time)) >= (found[0] if found else 0))
    error = seen.total - truth
    beyond = rest & (np.abs(error) > 3.0 * seen.sigma)
    moved = learner.learned().coefficients[: len(calibration.coefficients)] - calibration.coefficients
    spread = np.sqrt(np.diag(calibration.covariance) + 20.0**2)
    return Row(
        fixed=float(np.std((fixed.total - truth)[late])) / floor,
        peer=float(np.std((peer - truth)[late])) / floor,
        bound=float(np.std((best - truth)[late])) / floor,
        published=float(np.std(error[late])) / floor,
        sigma=rms((error / seen.sigma)[after]),
        beyond=np.count_nonzero(beyond[since:]) / optimal if cause else np.nan,
        delay=until / optimal if cause else np.nan,
        among=np.nan if not cause else float(found is not None and cause in found[1]),
        alone=np.nan if not cause else float(found is not None and found[1] == (cause,)),
        false=len(seen.alarms) - len(real),
        moved=float(np.abs(moved / spread).max()),
    )


def main() -> None:
    """Run, and print a table."""
    parser = command_line(__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="gliders")
    parser.add_argument("--first", type=int, default=0, help="the first glider")
    parser.add_argument("--hours", type=float, default=12.0, help="of the survey")
    parser.add_argument("--size", type=float, default=20.0, help="nT of a change, in times its kind's unit")
    parser.add_argument("--changes", nargs="+", default=list(CHANGES), choices=list(CHANGES))
    parser.add_argument("-v", action="store_true", help="print the notices")
    add_engine(parser)
    asked = parser.parse_args()
    shown = table(
        f"{asked.seeds} gliders, {asked.hours:g} h, {asked.size:g} nT",
        "", "fixed", "MagNav", "bound", "published", "95 %", "sigma", "beyond", "delay", "among",
        "alone", "false", "moved",
    )  # fmt: skip
    seeds = range(asked.first, asked.first + asked.seeds)
    cases = [(name, seed, asked.hours, asked.size) for name in asked.changes for seed in seeds]
    done = np.array(in_order(run, cases, asked)).reshape(len(asked.changes), len(seeds), -1)
    for name, rows in zip(asked.changes, done, strict=True):
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            middle, high, mean = np.nanmedian(rows, 0), np.nanquantile(rows, 0.95, 0), np.nanmean(rows, 0)
        shown.add_row(
            name,
            *(f"{one:.2f}" for one in middle[:4]), f"{high[3]:.2f}", f"{middle[4]:.2f}",
            f"{high[5]:.1f}", f"{middle[6]:.1f}", f"{mean[7]:.0%}", f"{mean[8]:.0%}",
            f"{rows[:, 9].sum():.0f}", f"{high[10]:.1f}",
        )  # fmt: skip
    Console(width=120).print(shown)


if __name__ == "__main__":
    main()
