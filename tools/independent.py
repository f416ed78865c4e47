"""Simulate gliders without the code of ``sitl``, and score what ``diagnose`` finds in their logs.

The gliders have fixed iron and two masses whose field a subclass of :class:`Vehicle` defines. They are
calibrated with ten spirals in a known field, and then survey a crustal field with dives over a criss-cross.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magbridge import Calibration, fit, observations
from magbridge.arrays import FloatArray
from magbridge.field.igrf import igrf

UNITS = {
    "mag_x": "nT", "mag_y": "nT", "mag_z": "nT", "reference_field": "nT", "roll": "deg", "pitch": "deg",
    "heading": "deg", "latitude": "deg", "longitude": "deg", "depth": "m", "battpos": "in",
    "ballast": "in", "sensor_temperature": "degC", "motor_current": "A", "fin": "deg",
}  # fmt: skip
START_S = 1_780_000_000.0
"""Time of the first sample, s since 1970 UTC."""
STEP_S = 4.0
"""Time between two samples, s."""
METRES_PER_DEGREE = 111_200.0
MASSES = {"battpos": 0.0254, "ballast": 0.0254}
"""Moving masses, and the travel along the vehicle for a unit of their telemetry, m."""


@dataclass(frozen=True)
class Log:
    """Telemetry columns of a log, (n,) each, and the true field in body axes (n, 3), nT."""

    columns: dict[str, FloatArray]
    body: FloatArray

    @property
    def time(self) -> FloatArray:
        """Times of the samples (n,), s since 1970 UTC."""
        return self.columns["time"]

    @property
    def hours(self) -> FloatArray:
        """Time since the first sample (n,), h."""
        return np.asarray((self.time - self.time[0]) / 3600.0)

    def dataset(self, readings: FloatArray, reference: FloatArray | float = 0.0) -> xr.Dataset:
        """Return the log with readings (n, 3), nT, and an error of the reference field, nT."""
        columns = self.columns | dict(zip(("mag_x", "mag_y", "mag_z"), readings.T, strict=True))
        if "reference_field" in columns:
            columns["reference_field"] = columns["reference_field"] + reference
        time = columns.pop("time")
        variables = {name: ("time", values, {"units": UNITS[name]}) for name, values in columns.items()}
        return xr.Dataset(variables, {"time": time}, {"source": "another world"})

    def visible(self, effect: FloatArray) -> FloatArray:
        """Return the part of an effect (n, 3) along the field, which changes the total field (n,), nT."""
        unit = self.body / np.linalg.norm(self.body, axis=1)[:, None]
        return np.asarray(np.sum(effect * unit, axis=1))


def rotated(columns: dict[str, FloatArray], field: FloatArray) -> FloatArray:
    """Rotate a field (n, 3) from north-east-down to body axes, by heading, pitch and roll."""
    roll, pitch, heading = (np.radians(columns[name]) for name in ("roll", "pitch", "heading"))
    n, e, d = field.T
    x, y = np.cos(heading) * n + np.sin(heading) * e, np.cos(heading) * e - np.sin(heading) * n
    x, d = np.cos(pitch) * x - np.sin(pitch) * d, np.sin(pitch) * x + np.cos(pitch) * d
    return np.stack([x, np.cos(roll) * y + np.sin(roll) * d, np.cos(roll) * d - np.sin(roll) * y], axis=1)


def along(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a series (n,) along a random axis, (n, 3)."""
    axis = rng.normal(size=3)
    return np.outer(x, axis / np.linalg.norm(axis))


class Crust:
    """Random crustal anomaly with a given standard deviation (nT) and shortest wavelength (m)."""

    def __init__(self, seed: int, sigma_nt: float, wavelength_m: float, waves: int = 60) -> None:
        rng = np.random.default_rng([seed, 11])
        length = wavelength_m * np.exp(rng.uniform(0.0, 2.0, waves))
        angle = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._k = 2.0 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._amplitude = sigma_nt * np.sqrt(2.0 / waves)

    def at_position(self, metres: FloatArray) -> FloatArray:
        """Return the anomaly (n,), nT, at positions (n, 2), m north and east."""
        return np.asarray(self._amplitude * np.cos(metres @ self._k.T + self._phase).sum(axis=1))


def smooth(values: FloatArray, samples: float) -> FloatArray:
    """Return the moving mean of values (n,) over a number of samples, which turns steps into ramps."""
    width = max(round(samples), 1)
    padded = np.concatenate([np.full(width, values[0]), values, np.full(width, values[-1])])
    kernel = np.ones(width) / width
    return np.asarray(np.convolve(padded, kernel, "same")[width:-width])


def wander(rng: np.random.Generator, n: int, step: float, tau: float, sigma: float) -> FloatArray:
    """Return a smoothed Ornstein-Uhlenbeck process (n,) with time constant `tau` (s) and 1-sigma `sigma`."""
    keep = np.exp(-step / tau)
    out = np.empty(n)
    state = rng.normal()
    for k, shock in enumerate(rng.normal(size=n) * np.sqrt(1.0 - keep**2)):
        state = keep * state + shock
        out[k] = state
    return smooth(sigma * out, 3.0 / step)


def logged(seed: int, hours: float, *, spirals: bool, crust: Crust | None = None) -> Log:
    """Simulate a glider's dives over a criss-cross, or ten banked spirals for a calibration."""
    rng = np.random.default_rng([seed, 5, int(spirals)])
    n = int(3600.0 * hours / STEP_S)
    seconds = STEP_S * np.arange(n)
    leg = np.floor(seconds / (180.0 if spirals else 840.0)).astype(int)
    climbing = leg % 2 == 1
    jitter = rng.normal(size=leg[-1] + 1)[leg]
    steep = np.radians(24.0) + np.radians(3.0) * jitter
    pitch = smooth(np.where(climbing, steep, -steep), 25.0 / STEP_S)
    battpos = smooth(np.where(climbing, -0.8, 0.8) + 0.12 * jitter, 20.0 / STEP_S)
    trims = rng.normal(0.0, 0.05, int(seconds[-1] / 240.0) + 1)[(seconds / 240.0).astype(int)]
    battpos = battpos + smooth(trims, 4.0 / STEP_S)
    ballast = smooth(np.where(climbing, 1.0, -1.0), 30.0 / STEP_S)
    if spirals:
        run = np.minimum((seconds / (3600.0 * hours / 10.0)).astype(int), 9)
        bank = np.radians(rng.uniform(-35.0, 35.0, 10))
        heading = np.cumsum(np.full(n, np.radians(2.2) * STEP_S))
        roll = smooth(bank[run], 10.0 / STEP_S)
        battpos = battpos * (0.4 + 0.12 * run)
        ballast = ballast * (1.0 - 0.09 * (run % 5))
    else:
        course = np.radians(rng.choice([20.0, 110.0, 200.0, 290.0], int(seconds[-1] / 2400.0) + 2))
        course += rng.normal(0.0, 0.15, len(course))
        heading = smooth(np.unwrap(course)[(seconds / 2400.0).astype(int)], 40.0 / STEP_S)
        roll = np.radians(rng.uniform(-3.0, 3.0)) + np.zeros(n)
    for angle, sigma in ((pitch, 0.6), (roll, 0.8), (heading, 2.0)):
        angle[:] = angle + np.radians(wander(rng, n, STEP_S, 20.0, sigma))
    vertical = 0.16 * np.sin(pitch) / np.sin(np.radians(24.0))
    depth = np.maximum(1.0 - np.cumsum(vertical) * STEP_S, 0.0)
    north, east = (np.cumsum(0.35 * turn(heading)) * STEP_S for turn in (np.cos, np.sin))
    columns = {
        "time": START_S + 3.0 * 86_400.0 * (not spirals) + seconds,
        "roll": np.degrees(roll), "pitch": np.degrees(pitch), "heading": np.degrees(heading),
        "latitude": 47.5 + north / METRES_PER_DEGREE,
        "longitude": -59.0 + east / (METRES_PER_DEGREE * np.cos(np.radians(47.5))),
        "depth": depth, "battpos": battpos, "ballast": ballast,
        "sensor_temperature": 4.0 + 9.0 / (1.0 + np.exp((depth - 40.0) / 6.0)),
    }  # fmt: skip
    ned = igrf(columns["longitude"], columns["latitude"], depth, columns["time"])
    if crust is not None:  # its field is along the main field
        metres = np.stack([north - north[0], east - east[0]], axis=1)
        ned *= 1.0 + (crust.at_position(metres) / np.linalg.norm(ned, axis=1))[:, None]
    return Log(columns, rotated(columns, ned))


class Vehicle(ABC):
    """Magnetic model of a vehicle: `hard` iron (3,), nT, `soft` iron (3, 3), and moving masses."""

    hard: FloatArray
    soft: FloatArray

    @abstractmethod
    def mass_field(self, name: str, travel: FloatArray, body: FloatArray) -> FloatArray:
        """Return the field (n, 3), nT, of a mass at `travel` (n,), m, in an ambient field (n, 3), nT."""

    def reads(self, log: Log, later: float = 0.0) -> FloatArray:
        """Return the noiseless readings (n, 3), nT, with the mass positions `later` s after each sample."""
        out = log.body @ (np.eye(3) + self.soft).T + self.hard
        for name, scale in MASSES.items():
            place = np.interp(log.time + later, log.time, log.columns[name])
            out = out + self.mass_field(name, scale * place, log.body)
        return np.asarray(out)

    def calibrated(self, seed: int, noise: Callable[[int], FloatArray]) -> Calibration:
        """Return the calibration by ten spirals in a known field, with noise (n, 3), nT, of n samples."""
        runs = logged(seed, 5.0, spirals=True)
        n = len(runs.time)
        known = runs.dataset(self.reads(runs) + noise(n))[["mag_x", "mag_y", "mag_z", *MASSES]]
        known["reference_field"] = "time", np.linalg.norm(runs.body, axis=1), {"units": "nT"}
        known["segment"] = "time", np.floor(10.0 * np.arange(n) / n).astype(int).astype(str)
        return fit(observations(known, tuple(MASSES))).calibration


class Dipoles(Vehicle):
    """Vehicle whose masses are dipoles with a permanent and an induced part, drawn from `seed`."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        self.hard = rng.normal(0.0, 800.0, 3)
        self.soft = rng.normal(0.0, 0.012, (3, 3))
        self._moment = {name: rng.normal(0.0, 1.6, 3) for name in MASSES}
        self._induced = {name: abs(rng.normal(0.0, 1.0e-5)) for name in MASSES}  # A m^2 per nT
        self._home = {}
        for name in MASSES:
            away = rng.normal(size=3)
            self._home[name] = away / np.linalg.norm(away) * rng.uniform(0.55, 0.75)

    def mass_field(self, name: str, travel: FloatArray, body: FloatArray) -> FloatArray:
        """Return the field of a dipole."""
        r = self._home[name] + np.outer(travel, [1.0, 0.0, 0.0])
        return dipole_field(r, self._moment[name] + self._induced[name] * body)


def dipole_field(r: FloatArray, moment: FloatArray) -> FloatArray:
    """Return the field (n, 3), nT, of dipoles `moment` (n, 3), A m², at displacements r (n, 3), m."""
    distance = np.linalg.norm(r, axis=1)[:, None]
    n = r / distance
    radial = np.sum(n * moment, axis=1)[:, None]
    # mu_0 / 4 pi is 100 nT m^3 / (A m^2)
    return np.asarray(100.0 * (3.0 * n * radial - moment) / distance**3)
