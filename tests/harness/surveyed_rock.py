"""Simulate a survey over a crustal field of 40 nT (RMS) by a vehicle with hard and soft iron."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.fit import Fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import level_of

MAIN = np.array([18_000.0, -5_000.0, 48_000.0])
IRON = np.eye(3) + np.array([[0.012, 0.003, -0.004], [0.003, -0.008, 0.002], [-0.004, 0.002, 0.005]])
OFFSET = np.array([900.0, -600.0, 1200.0])
NOISE = 1.0


def flown(
    *, legs: int = 16, straight: bool = False, zigzag: bool = False, seed: int = 3, noise: float = NOISE
) -> tuple[Observations, FloatArray]:
    """Simulate dives on crossing courses; return the readings and the true total field (n,), nT."""
    rng = np.random.default_rng(seed)
    each, dt, speed = 110, 4.0, 0.9
    n = legs * each
    leg = np.arange(n) // each
    course = np.zeros(legs) if straight else np.radians(rng.uniform(0, 360, legs))
    if zigzag:
        course = np.radians(np.where(np.arange(legs) // 2 % 2, 50.0, -50.0))
    heading = course[leg] + rng.normal(0, 0.02, n)
    pitch = np.radians(np.where(leg % 2, 25, -25) + rng.normal(0, 1, n))
    roll = np.radians(rng.normal(0, 5, legs)[leg] + rng.normal(0, 1, n))
    place = np.cumsum(speed * dt * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1), axis=0)
    k, phase = rng.normal(0, 1 / 700.0, (400, 2)), rng.uniform(0, 2 * np.pi, 400)
    rock = 40.0 * np.sqrt(2 / 400) * np.cos(place[:, :2] @ k.T + phase).sum(axis=1)
    F_0 = float(np.linalg.norm(MAIN))
    true = F_0 + rock
    ned = MAIN * (true / F_0)[:, None]
    attitude = np.stack([roll, pitch, heading], axis=1)
    field = field_body(attitude, ned) @ np.linalg.inv(IRON).T + OFFSET + rng.normal(0, noise, (n, 3))
    data = Observations(
        field=field, reference=np.full(n, F_0), parameters=np.empty((n, 0)),
        time=1e9 + dt * np.arange(n, dtype=float), runs=leg, attitude=attitude,
        reference_ned=np.tile(MAIN, (n, 1)), place=place, unmapped=np.ones(n),
    )  # fmt: skip
    return data, true


def error_of(found: Fit, data: Observations, true: FloatArray) -> tuple[float, float]:
    """Return the corrected field's standard deviation of error and its predicted sigma, without bias, nT."""
    channels = data.channels(found.calibration)
    got = correct(found.calibration, data.field, channels, data.time)
    level = level_of(found.calibration, data.field, channels, data.time)
    return float(np.std(got.total - true)), float(np.sqrt(np.median(got.sigma**2 - level**2)))
