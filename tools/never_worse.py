"""Compare in-flight calibration with the fixed calibration, in a world of its own.

    python3 tools/never_worse.py                          every change, vehicles 1 to 4
    python3 tools/never_worse.py none --vehicles 11 12    vehicles that were not used for tuning

Each vehicle has two dipole masses and 1 nT of white noise (:mod:`dipole_world`). It is calibrated with ten
runs whose true field is known. It then surveys a crustal field of 7 nT (standard deviation) for 12 hours at
0.25 Hz with one hidden change. The reference is the IGRF alone. Errors are RMS, nT: from one hour after a
step on, else from the start.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from dipole_world import START_S, Crust, Track, Vehicle, as_log, calibrate, glider_track
from live import learn
from studies import Column, Row, Study, study_options

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.learning import Learner

Change = Callable[[Track, FloatArray], FloatArray]


def seconds(track: Track) -> FloatArray:
    """Return the time since the middle of the survey (n,), s."""
    return np.asarray(track.time - track.time[len(track.time) // 2])


def none(track: Track, direction: FloatArray) -> FloatArray:
    """Change nothing."""
    return np.zeros((len(track.time), 3)) * direction


def step(track: Track, direction: FloatArray) -> FloatArray:
    """Change the offset by 60 nT in the middle of the survey."""
    return np.asarray(60.0 * (seconds(track) >= 0.0)[:, None] * direction)


def drift(track: Track, direction: FloatArray) -> FloatArray:
    """Add an offset that drifts by 60 nT over the survey."""
    return np.asarray(60.0 * np.linspace(0.0, 1.0, len(track.time))[:, None] * direction)


def temperature(track: Track, direction: FloatArray) -> FloatArray:
    """Add an offset of 1 nT/degC."""
    return np.asarray((track.temperature - 10.0)[:, None] * direction)


def current(track: Track, direction: FloatArray) -> FloatArray:
    """Let a pump's current add 20 nT in two of every ten minutes, without telemetry."""
    return np.asarray(20.0 * ((track.time % 600.0) < 120.0)[:, None] * direction)


CHANGES: dict[str, Change] = {
    "none": none,
    "offset step of 60 nT": step,
    "offset drift": drift,
    "temperature": temperature,
    "current without telemetry": current,
}


def run(name: str, seed: int, hours: float) -> list[Row]:
    """Return the errors of the fixed calibration and of the one that is learned in flight."""
    vehicle, rng = Vehicle(seed), np.random.default_rng([seed, 21])
    runs = glider_track(seed, 5.0, 0.25, spirals=True)
    calibration = calibrate(vehicle, runs, rng.normal(0.0, 1.0, (len(runs.time), 3)))
    track = glider_track(seed, hours, 0.25, start_s=START_S + 3.0 * 86_400.0)
    anomaly = Crust(seed, 7.0, 900.0).at_position(track.metres())
    field, truth = vehicle.field(track, anomaly, track.masses)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    field = field + CHANGES[name](track, direction) + rng.normal(0.0, 1.0, field.shape)
    log = as_log(track, field)
    fixed, learned = (learn(one, calibration, log, age_s=0.0) for one in (None, Learner(calibration)))
    moving = fixed.quality & 0b101 != 0
    late = ~moving & (seconds(track) > 3600.0 if name.startswith("offset step") else True)
    errors = [(one.total - truth)[late] for one in (fixed, learned)]
    row: Row = {"change": name, "vehicle": seed, "fixed": rms(errors[0]), "learned": rms(errors[1])}
    row |= {"ratio": row["learned"] / row["fixed"], "about": float(errors[1].std())}
    return [row | {"standardised": rms(errors[1] / learned.sigma[late]), "alarms": len(learned.alarms)}]


STUDY = Study(
    run,
    ("change", "vehicle"),
    {
        "fixed, nT": Column("fixed"),
        "learned, nT": Column("learned"),
        "about the mean": Column("about"),
        "learned / fixed": Column("ratio", form=".3f"),
        "standardised": Column("standardised"),
        "alarms": Column("alarms", form=".0f"),
    },
)


def main() -> None:
    """Print the table."""
    parser = study_options(__doc__)
    parser.add_argument("names", nargs="*", metavar="CHANGE", help="; ".join(CHANGES))
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--hours", type=float, default=12.0)
    chosen = parser.parse_args()
    names = chosen.names or list(CHANGES)
    cases = [(name, seed, chosen.hours) for name in names for seed in chosen.vehicles]
    STUDY.main(f"{chosen.hours:g} h", cases, chosen)


if __name__ == "__main__":
    main()
