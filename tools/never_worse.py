"""Compare in-flight calibration with the fixed calibration, in a world of its own.

    python3 tools/never_worse.py                          every change, vehicles 1 to 4
    python3 tools/never_worse.py none --vehicles 11 12    vehicles that were not used for tuning

Each vehicle has two dipole masses and 1 nT of white noise (:mod:`dipole_world`). It is calibrated with ten
runs whose true field is known. It then surveys a crustal field of 7 nT (standard deviation) for 12 hours at
0.25 Hz with one hidden change. The reference is the IGRF alone. Errors are RMS, nT: from one hour after a
step on, else from the start.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
from dipole_world import START_S, Crust, Track, Vehicle, calibrate, correct_live, glider_track
from rich.console import Console
from studies import command_line, table

from magbridge.arrays import FloatArray
from magbridge.correction import Correction
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


def run(name: str, seed: int, hours: float) -> tuple[float, float, float, float, list[str]]:
    """Return RMS fixed, RMS learned, its RMS about the mean, its standardised error, and the messages."""
    vehicle, rng = Vehicle(seed), np.random.default_rng([seed, 21])
    runs = glider_track(seed, 5.0, 0.25, spirals=True)
    calibration = calibrate(vehicle, runs, rng.normal(0.0, 1.0, (len(runs.time), 3)), unit="in")
    track = glider_track(seed, hours, 0.25, start_s=START_S + 3.0 * 86_400.0)
    anomaly = Crust(seed, 7.0, 900.0).at_position(track.metres())
    field, truth = vehicle.field(track, anomaly, track.masses)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    field = field + CHANGES[name](track, direction) + rng.normal(0.0, 1.0, field.shape)
    corrections = Correction(calibration), Correction(calibration, learner=Learner(calibration))
    fixed, learned = (correct_live(one, track, field, track.masses, interval_s=4.0) for one in corrections)
    moving = fixed.quality.astype(int) & 0b101 != 0
    late = ~moving & (seconds(track) > 3600.0 if name.startswith("offset step") else True)
    errors = [(one.total - truth)[late] for one in (fixed, learned)]
    rms = [float(np.sqrt(np.mean(error**2))) for error in errors]
    standardised = float(np.sqrt(np.mean((errors[1] / learned.sigma[late]) ** 2)))
    return rms[0], rms[1], float(errors[1].std()), standardised, [text for _, text in learned.notices]


def main() -> int:
    """Print the table."""
    parser = command_line(__doc__)
    parser.add_argument("names", nargs="*", metavar="CHANGE", help="; ".join(CHANGES))
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--hours", type=float, default=12.0)
    parser.add_argument("-v", action="store_true", help="print the messages")
    chosen = parser.parse_args()
    shown = table(
        f"vehicles {chosen.vehicles}, {chosen.hours:g} h",
        "hidden change", "fixed, nT", "learned, nT", "about the mean", "standardised", "ratio, each",
        left=("hidden change",),
    )  # fmt: skip
    for name in chosen.names or CHANGES:
        rows = [run(name, seed, chosen.hours) for seed in chosen.vehicles]
        if chosen.v:
            for row in rows:
                print(name, np.round(row[:4], 2), row[4], flush=True)
        middle = np.median([row[:4] for row in rows], axis=0)
        ratios = " ".join(f"{row[1] / row[0]:.3f}" for row in rows)
        shown.add_row(name, *(f"{value:.2f}" for value in middle), ratios)
    Console(width=None if sys.stdout.isatty() else 160).print(shown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
