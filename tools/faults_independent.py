"""Count the samples that are wrong and unflagged, in a world that shares no code with the simulator.

    python3 tools/faults_independent.py                        every fault, vehicles 1 and 2
    python3 tools/faults_independent.py --vehicles 11 12       vehicles that were not used for tuning
    python3 tools/faults_independent.py --clean 14             false alarms in 14 days at 0.25 Hz

Each vehicle has dipole masses and 1/f noise (:mod:`dipole_world`). It is calibrated with ten runs whose true
field is known, and then flies for six hours. A fault begins after 1.5 hours. A sample is wrong if it has no
flag and its error exceeds three of its own sigmas.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from dipole_world import (
    START_S,
    Crust,
    Published,
    Track,
    Vehicle,
    calibrate,
    correct_live,
    flicker,
    glider_track,
    plane_track,
)
from rich.console import Console
from studies import command_line, table

from magbridge.arrays import FloatArray
from magbridge.correction import Correction

FAULT_S = 5400.0
"""Time after the start at which a fault begins."""


@dataclass
class Flight:
    """What one flight measures and reports; a fault replaces fields of it."""

    track: Track
    field: FloatArray
    truth: FloatArray
    reported: dict[str, FloatArray]
    vehicle: Vehicle
    noise: FloatArray
    anomaly: FloatArray
    lost: FloatArray | None = None
    every: int = 1
    interval_s: float = 1.0

    @property
    def seconds(self) -> FloatArray:
        """Time since the fault begins (n,), s; negative before."""
        return np.asarray(self.track.time - self.track.time[0] - FAULT_S)


Fault = Callable[[Flight], None]


def nothing(flight: Flight) -> None:
    """Change nothing."""


def repeat_reading(flight: Flight) -> None:
    """Repeat one reading on all axes."""
    first = int(np.argmax(flight.seconds >= 0.0))
    flight.field[first:] = flight.field[first]


def drift_gain(per_hour: float) -> Fault:
    """Return a fault: the gain of all axes drifts."""

    def fault(flight: Flight) -> None:
        flight.field *= 1.0 + per_hour * np.maximum(flight.seconds, 0.0)[:, None] / 3600.0

    return fault


def shift_telemetry(inches: float) -> Fault:
    """Return a fault: the battery's reported position is wrong by a constant."""

    def fault(flight: Flight) -> None:
        flight.reported["battpos"] = flight.reported["battpos"] + inches * (flight.seconds >= 0.0)

    return fault


def thermocline(flight: Flight) -> None:
    """Let the offset of two axes follow the temperature by 12 nT a dive."""
    warmth = flight.track.temperature - flight.track.temperature.min()
    flight.field += (
        12.0 / 9.0 * warmth[:, None] * np.array([0.0, 0.6, 0.8]) * (flight.seconds >= 0.0)[:, None]
    )


def step_offset(axis: int) -> Fault:
    """Return a fault: the offset of one axis changes by 40 nT."""

    def fault(flight: Flight) -> None:
        flight.field[:, axis] += 40.0 * (flight.seconds >= 0.0)

    return fault


def freeze_position(flight: Flight) -> None:
    """Freeze the battery's reported position while its time stamps advance."""
    values = flight.reported["battpos"].copy()
    first = int(np.argmax(flight.seconds >= 0.0))
    values[first:] = values[first]
    flight.reported["battpos"] = values


def freeze_within_leg(flight: Flight) -> None:
    """Freeze the battery's position for the trims of each dive; the moves at its ends are reported."""
    leg = np.floor((flight.track.time - flight.track.time[0]) / 840.0)
    values = flight.reported["battpos"].copy()
    into = (flight.track.time - flight.track.time[0]) - 840.0 * leg
    held = values[0]
    for k in range(len(values)):
        if flight.seconds[k] < 0.0 or into[k] < 60.0:
            held = values[k]
        values[k] = held
    flight.reported["battpos"] = values


def lose_telemetry(flight: Flight) -> None:
    """Lose telemetry for 28 s at each second move of the battery."""
    time = flight.track.time - flight.track.time[0]
    flight.lost = (((time + 14.0) % 1680.0) < 28.0) & (flight.seconds >= 0.0)


def tenfold_noise(flight: Flight) -> None:
    """Let the noise be ten times as large."""
    flight.field += 9.0 * flight.noise * (flight.seconds >= 0.0)[:, None]


def fast_sensor(flight: Flight) -> None:
    """Change nothing: the flight has a sensor of 10 Hz and telemetry of 1 Hz."""


FAULTS: dict[str, tuple[Fault, str]] = {
    "none": (nothing, ""),
    "all axes repeat one reading": (repeat_reading, ""),
    "gain drifts 0.2 %/h": (drift_gain(0.002), ""),
    "gain drifts 1 %/h": (drift_gain(0.01), ""),
    "telemetry off by 0.3 in": (shift_telemetry(0.3), ""),
    "telemetry off by 0.1 in": (shift_telemetry(0.1), ""),
    "thermocline, 12 nT": (thermocline, ""),
    "offset of x +40 nT": (step_offset(0), ""),
    "offset of y +40 nT": (step_offset(1), ""),
    "offset of z +40 nT": (step_offset(2), ""),
    "position frozen, stamps advance": (freeze_position, ""),
    "trims not reported": (freeze_within_leg, ""),
    "telemetry lost 28 s a second move": (lose_telemetry, ""),
    "noise times 10, 1/f": (tenfold_noise, ""),
    "10 Hz sensor, 1 Hz telemetry": (fast_sensor, "fast"),
    "plane, 120 nT over 1 km, current": (nothing, "plane"),
}


def fly(seed: int, kind: str, hours: float) -> tuple[Flight, Correction]:
    """Return a flight without a fault, and a correction by the vehicle's calibration."""
    rng = np.random.default_rng([seed, 1])
    rate = 10.0 if kind == "fast" else 5.0 if kind == "plane" else 1.0
    later = START_S + 3.0 * 86_400.0
    if kind == "plane":
        vehicle = Vehicle(seed, (), "batt_current")
        runs = plane_track(seed, 0.25, rate, box=True)
        track = plane_track(seed, hours / 4.0, rate, start_s=later)
        crust = Crust(seed, 85.0, 1000.0)
    else:
        vehicle = Vehicle(seed)
        runs = glider_track(seed, 5.0, 1.0, spirals=True)
        track = glider_track(seed, hours / 4.0 if kind == "fast" else hours, rate, start_s=later)
        crust = Crust(seed, 20.0, 800.0)
    white = 0.5 if kind == "plane" else 0.3
    before = flicker(rng, runs.time, 0.9) + rng.normal(0.0, white, (len(runs.time), 3))
    calibration = calibrate(vehicle, runs, before, unit="A" if kind == "plane" else "in")
    noise = flicker(rng, track.time, 0.9) + rng.normal(0.0, white, (len(track.time), 3))
    anomaly = crust.at_position(track.metres())
    field, truth = vehicle.field(track, anomaly, track.masses)
    # a potentiometer's resolution: what is reported has steps
    reported = {name: np.round(values / 1e-4) * 1e-4 for name, values in track.masses.items()}
    interval_s = 0.4 if kind == "plane" else 1.0
    flight = Flight(track, field + noise, truth, reported, vehicle, noise, anomaly, interval_s=interval_s)
    return flight, Correction(calibration)


@dataclass(frozen=True)
class Score:
    """Fractions of all samples, from the start of the fault on, and what was reported."""

    flagged: float
    wrong: float
    late_wrong: float
    worst_nt: float
    sigma_nt: float
    first_s: float
    reported: list[str]


def score(flight: Flight, published: Published) -> Score:
    """Compare what was published with the truth, after the fault has begun."""
    since = flight.seconds >= 0.0 if flight.seconds[-1] > 0.0 else np.ones(len(flight.truth), bool)
    plain = published.plain()
    error = np.abs(published.total - flight.truth)
    wrong = plain & ~(error <= 3.0 * published.sigma)
    usual = np.median(published.sigma[~since]) if (~since).any() else 1e9
    hit = since & (~plain | (published.sigma > 3.0 * usual))
    first = float(flight.seconds[np.argmax(hit)]) if hit.any() else np.nan
    late = since & (flight.seconds > 300.0) if flight.seconds[-1] > 300.0 else since
    return Score(
        float(np.mean(~plain[since])),
        float(np.mean(wrong[since])),
        float(np.mean(wrong[late])),
        float(error[since & plain].max()) if (since & plain).any() else 0.0,
        float(np.median(published.sigma[since & plain])) if (since & plain).any() else 0.0,
        first,
        [text for _, text in published.notices],
    )


def run(name: str, seed: int, hours: float) -> Score:
    """Fly one vehicle with one fault."""
    fault, kind = FAULTS[name]
    flight, correction = fly(seed, kind, hours)
    fault(flight)
    published = correct_live(
        correction,
        flight.track,
        flight.field,
        flight.reported,
        lost=flight.lost,
        interval_s=flight.interval_s,
    )
    return score(flight, published)


def clean(days: float, first: int) -> None:
    """Fly without a fault at 0.25 Hz, a vehicle a day, and print what is flagged."""
    for seed in range(first, first + int(np.ceil(days))):
        flight, correction = fly(seed, "", 24.0)
        published = correct_live(
            correction, flight.track, flight.field, flight.reported, every=4, interval_s=4.0
        )
        error = np.abs(published.total - flight.truth[::4])
        plain = published.plain()
        wrong = np.mean(plain & (error > 3.0 * published.sigma))
        implausible = int(np.sum(published.quality.astype(int) & 1 << 7 != 0))
        sigma = np.percentile(published.sigma[plain], [50, 95, 99])
        print(seed, f"flagged {np.mean(~plain):.2%}, implausible {implausible}, wrong {wrong:.2%}",
              np.round(sigma, 2), published.notices, flush=True)  # fmt: skip


def main() -> int:
    """Print the table."""
    parser = command_line(__doc__)
    parser.add_argument("names", nargs="*", metavar="FAULT", help="; ".join(FAULTS).replace("%", "%%"))
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--hours", type=float, default=6.0)
    parser.add_argument("--clean", type=float, default=0.0, metavar="DAYS")
    chosen = parser.parse_args()
    if chosen.clean:
        clean(chosen.clean, chosen.vehicles[0])
        return 0
    shown = table(
        f"vehicles {chosen.vehicles}, {chosen.hours:g} h: from the start of the fault on",
        "fault", "flagged", "wrong", "after 5 min", "worst, nT", "sigma, nT", "first, s", "reported",
        left=("fault", "reported"),
    )  # fmt: skip
    for name in chosen.names or FAULTS:
        scores = [run(name, seed, chosen.hours) for seed in chosen.vehicles]
        texts = dict.fromkeys(text for one in scores for text in one.reported)

        def both(*parts: str) -> str:
            return " / ".join(parts)

        shown.add_row(
            name,
            both(*(f"{100 * one.flagged:.1f}" for one in scores)),
            both(*(f"{100 * one.wrong:.2f}" for one in scores)),
            both(*(f"{100 * one.late_wrong:.2f}" for one in scores)),
            both(*(f"{one.worst_nt:.0f}" for one in scores)),
            both(*(f"{one.sigma_nt:.1f}" for one in scores)),
            both(*(f"{one.first_s:.0f}" for one in scores)),
            " | ".join(texts)[:110],
        )
    Console(width=None if sys.stdout.isatty() else 220).print(shown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
