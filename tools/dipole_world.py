"""Simulate vehicles with dipole masses, for studies of health checks and of in-flight calibration.

Nothing here comes from the simulator ``sitl``: the vehicle is a hard iron, a soft iron and two or more point
dipoles that move, the crustal field is a random Fourier sum over the plane, and the noise is white or 1/f.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.field.igrf import igrf

START_S = 1_780_000_000.0
"""Time of the first sample, s since 1970 UTC."""
METRES_PER_DEGREE = 111_200.0
MU0_OVER_4PI_NT = 100.0
"""mu_0 / 4 pi in nT m^3 / (A m^2)."""


@dataclass(frozen=True)
class Track:
    """A trajectory with its telemetry: `time` (n,) s, attitude (n, 3) rad, position (deg, m), masses."""

    time: FloatArray
    attitude: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    depth: FloatArray
    masses: dict[str, FloatArray]
    temperature: FloatArray

    def metres(self) -> FloatArray:
        """Return north and east of the first position (n, 2), m."""
        north = (self.latitude - self.latitude[0]) * METRES_PER_DEGREE
        east = (self.longitude - self.longitude[0]) * METRES_PER_DEGREE * np.cos(np.radians(self.latitude[0]))
        return np.stack([north, east], axis=1)


class Crust:
    """A random crustal anomaly (nT) of a standard deviation and a shortest wavelength (m)."""

    def __init__(self, seed: int, sigma_nt: float, wavelength_m: float, waves: int = 60) -> None:
        rng = np.random.default_rng([seed, 11])
        length = wavelength_m * np.exp(rng.uniform(0.0, 2.0, waves))
        angle = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._k = 2.0 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._amplitude = sigma_nt * np.sqrt(2.0 / waves)

    def at_position(self, metres: FloatArray) -> FloatArray:
        """Return the anomaly (n,) at north and east (n, 2), m."""
        return np.asarray(self._amplitude * np.cos(metres @ self._k.T + self._phase).sum(axis=1))


class Vehicle:
    """Hard iron, soft iron and dipole masses of one vehicle, drawn from `seed`."""

    def __init__(self, seed: int, masses: tuple[str, ...] = ("battpos", "ballast")) -> None:
        rng = np.random.default_rng([seed, 3])
        self.masses = masses
        self._hard = rng.normal(0.0, 800.0, 3)
        soft = rng.normal(0.0, 0.012, (3, 3))
        self._soft = np.eye(3) + soft
        self._moment = {name: rng.normal(0.0, 1.6, 3) for name in masses}
        self._induced = {name: abs(rng.normal(0.0, 1.0e-5)) for name in masses}  # A m^2 per nT
        self._home = {}
        for name in masses:
            away = rng.normal(size=3)
            self._home[name] = away / np.linalg.norm(away) * rng.uniform(0.55, 0.75)

    def field(
        self, track: Track, anomaly: FloatArray, masses: dict[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the noiseless reading (n, 3) and the true total field (n,), nT."""
        ned = igrf(track.longitude, track.latitude, track.depth, track.time)
        total = np.linalg.norm(ned, axis=1)
        ned = ned * ((total + anomaly) / total)[:, None]
        body = to_body(track.attitude, ned)
        out = body @ self._soft.T + self._hard
        for name in self.masses:
            r = self._home[name] + masses[name][:, None] * np.array([0.0254, 0.0, 0.0])
            distance = np.linalg.norm(r, axis=1)[:, None]
            n = r / distance
            moment = self._moment[name] + self._induced[name] * body
            along = np.sum(n * moment, axis=1)[:, None]
            out = out + MU0_OVER_4PI_NT * (3.0 * n * along - moment) / distance**3
        return np.asarray(out), np.asarray(total + anomaly)


def to_body(attitude: FloatArray, ned: FloatArray) -> FloatArray:
    """Rotate (n, 3) from north-east-down to body axes by roll, pitch and heading (n, 3), rad."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(attitude).T, np.sin(attitude).T
    n, e, d = ned.T
    x = cp * cy * n + cp * sy * e - sp * d
    y = (sr * sp * cy - cr * sy) * n + (sr * sp * sy + cr * cy) * e + sr * cp * d
    z = (cr * sp * cy + sr * sy) * n + (cr * sp * sy - sr * cy) * e + cr * cp * d
    return np.stack([x, y, z], axis=1)


def smooth(values: FloatArray, samples: float) -> FloatArray:
    """Return a moving mean, which makes ramps of steps."""
    width = max(round(samples), 1)
    padded = np.concatenate([np.full(width, values[0]), values, np.full(width, values[-1])])
    kernel = np.ones(width) / width
    return np.asarray(np.convolve(padded, kernel, "same")[width:-width])


def wander(rng: np.random.Generator, n: int, step: float, tau: float, sigma: float) -> FloatArray:
    """Return an Ornstein-Uhlenbeck process (n,)."""
    keep = np.exp(-step / tau)
    out = np.empty(n)
    state = rng.normal()
    for k, shock in enumerate(rng.normal(size=n) * np.sqrt(1.0 - keep**2)):
        state = keep * state + shock
        out[k] = state
    return smooth(sigma * out, 3.0 / step)


def glider_track(
    seed: int, hours: float, rate_hz: float, *, spirals: bool = False, start_s: float = START_S
) -> Track:
    """Return a glider's dives over a criss-cross, or ten banked spirals for a calibration."""
    rng = np.random.default_rng([seed, 5, int(spirals)])
    step = 1.0 / rate_hz
    n = int(3600.0 * hours * rate_hz)
    seconds = step * np.arange(n)
    half = 180.0 if spirals else 840.0
    leg = np.floor(seconds / half)
    climbing = leg % 2 == 1
    jitter = rng.normal(size=int(leg[-1]) + 1)
    steep = np.radians(24.0) + np.radians(3.0) * jitter[leg.astype(int)]
    pitch = smooth(np.where(climbing, steep, -steep), 25.0 / step)
    battpos = smooth(np.where(climbing, -0.8, 0.8) + 0.12 * jitter[leg.astype(int)], 20.0 / step)
    trims = rng.normal(0.0, 0.05, int(seconds[-1] / 240.0) + 1)[(seconds / 240.0).astype(int)]
    battpos = battpos + smooth(trims, 4.0 / step)
    ballast = smooth(np.where(climbing, 1.0, -1.0), 30.0 / step)
    if spirals:
        run = (seconds / (3600.0 * hours / 10.0)).astype(int)
        bank = np.radians(rng.uniform(-35.0, 35.0, 10))
        heading = np.cumsum(np.full(n, np.radians(2.2) * step))
        roll = smooth(bank[np.minimum(run, 9)], 10.0 / step)
        battpos = battpos * (0.4 + 0.12 * np.minimum(run, 9))
        ballast = ballast * (1.0 - 0.09 * (np.minimum(run, 9) % 5))
    else:
        course = np.radians(rng.choice([20.0, 110.0, 200.0, 290.0], int(seconds[-1] / 2400.0) + 2))
        course += rng.normal(0.0, 0.15, len(course))
        heading = np.unwrap(course)[(seconds / 2400.0).astype(int)]
        heading = smooth(heading, 40.0 / step)
        roll = np.radians(rng.uniform(-3.0, 3.0)) + np.zeros(n)
    for angle, sigma in ((pitch, 0.6), (roll, 0.8), (heading, 2.0)):
        angle[:] = angle + np.radians(wander(rng, n, step, 20.0, sigma))
    vertical = 0.16 * np.sin(pitch) / np.sin(np.radians(24.0))
    depth = np.maximum(1.0 - np.cumsum(vertical) * step, 0.0)
    speed = 0.35
    north, east = (np.cumsum(speed * f(heading)) * step for f in (np.cos, np.sin))
    latitude = 47.5 + north / METRES_PER_DEGREE
    longitude = -59.0 + east / (METRES_PER_DEGREE * np.cos(np.radians(47.5)))
    temperature = 4.0 + 9.0 / (1.0 + np.exp((depth - 40.0) / 6.0))
    return Track(
        np.asarray(start_s + seconds, float),
        np.stack([roll, pitch, heading], axis=1),
        latitude,
        longitude,
        depth,
        {"battpos": battpos, "ballast": ballast},
        temperature,
    )


def as_log(track: Track, field: FloatArray, unit: str = "in") -> xr.Dataset:
    """Return the log of a track: the channels of a `field` (n, 3), nT, and all telemetry."""
    columns: dict[str, Any] = {
        f"mag_{axis}": ("time", field[:, k], {"units": "nT"}) for k, axis in enumerate("xyz")
    }
    columns |= {name: ("time", values, {"units": unit}) for name, values in track.masses.items()}
    columns |= {name: ("time", getattr(track, name)) for name in ("latitude", "longitude", "depth")}
    columns["sensor_temperature"] = "time", track.temperature
    return xr.Dataset(columns, coords={"time": track.time})


def calibrate(vehicle: Vehicle, track: Track, noise: FloatArray) -> Calibration:
    """Fit a calibration to ten runs whose true total field is known."""
    field, total = vehicle.field(track, np.zeros(len(track.time)), track.masses)
    log = as_log(track, field + noise).drop_vars(["latitude", "longitude", "depth", "sensor_temperature"])
    run = np.floor(10.0 * np.arange(len(total)) / len(total)).astype(int).astype(str)
    log = log.assign(reference_field=("time", total, {"units": "nT"}), segment=("time", run))
    return fit(observations(log, vehicle.masses)).calibration
