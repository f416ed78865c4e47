"""Test ``diagnose`` in a second world: another glider, mission and noise, without the code of ``sitl``.

    python tools/second_world.py --cases 40

The forward model has dipoles with an induced part, eddy currents of a plate with a time constant, and
currents in a loop. The detector was not tuned on it. :mod:`independent` explains the table.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from independent import Log, along, calibrated, diagnosed, main, rotated
from studies import Row

from magbridge.arrays import FloatArray

STEP, HOURS, EPOCH = 5.0, 4.0, 1.75e9
EARTH = np.array([17_000.0, -4_600.0, 46_500.0])
"""Main field, nT: north, east, down."""


def logged(rng: np.random.Generator, hours: float, *, spins: bool) -> Log:
    """Simulate saw-tooth dives around a triangle; or with `spins`, rotations in place with moving masses."""
    n = int(hours * 3600.0 / STEP)
    t = STEP * np.arange(n)
    swayed = sum(
        rng.normal(0.0, 0.8) * np.sin(2.0 * np.pi * t / period + rng.uniform(0.0, 6.3))
        for period in rng.uniform(23.0, 70.0, 5)
    )
    period = rng.uniform(700.0, 1100.0)
    cycle = (t / period) % 1.0
    depth = 5.0 + 90.0 * (1.0 - np.abs(2.0 * cycle - 1.0))
    down = np.where(cycle < 0.5, 1.0, -1.0)
    down = np.convolve(np.pad(down, 6, mode="edge"), np.ones(13) / 13.0, mode="valid")
    if spins:
        heading, pitch = 2.3 * t % 360.0, 28.0 * np.sin(2.0 * np.pi * t / 1310.0)
        roll = 35.0 * np.sin(2.0 * np.pi * t / 410.0)
        batt, vbd = (
            14.0 * np.sign(np.sin(2 * np.pi * t / 2600.0)) * (t // 900 % 3) / 2,
            250.0 * (t // 700 % 3 - 1),
        )
        north = east = np.zeros(n)
    else:
        leg = np.floor(6.0 * t / t[-1] * 0.9999)
        heading = 120.0 * leg + 17.0 + swayed
        pitch, roll = -24.0 * down + 0.7 * swayed, 3.0 * np.sin(2.0 * np.pi * t / 330.0) + 0.5 * swayed
        batt, vbd = 9.0 * down + 2.0 * np.sin(leg), -200.0 * down
        north, east = (0.35 * STEP * np.cumsum(turn(np.radians(heading))) for turn in (np.cos, np.sin))
    warm = 12.0 - 7.0 / (1.0 + np.exp((40.0 - depth) / 8.0)) + 0.4 * np.sin(2.0 * np.pi * t / 9000.0)
    pump = (np.abs(np.diff(vbd, prepend=vbd[0])) > 1.0) * 1.7 + 0.02 * rng.random(n)
    columns = {
        "time": EPOCH + t + (0.0 if spins else 90_000.0), "roll": roll, "pitch": pitch,
        "heading": heading % 360.0,
        "latitude": 61.0 + north / 111_200.0, "longitude": 4.0 + east / 53_900.0, "depth": depth,
        "battpos": batt, "vbd": vbd, "sensor_temperature": warm, "motor_current": pump,
        "fin": 6.0 * np.sin(t / 30.0 + rng.uniform(0.0, 6.0)) + 4.0 * np.sign(np.sin(t / 1700.0)),
    }  # fmt: skip
    rock = sum(
        25.0
        * np.cos((north * np.cos(a) + east * np.sin(a)) / length + phase)
        * np.exp(depth / (9.0 * length))
        for a, length, phase in zip(
            rng.uniform(0, 6.3, 4), rng.uniform(150.0, 600.0, 4), rng.uniform(0, 6.3, 4), strict=True
        )
    )
    field = EARTH * (1.0 + rock / np.linalg.norm(EARTH))[:, None]
    columns["reference_field"] = np.linalg.norm(field, axis=1)
    return Log(columns, rotated(columns, field))


def dipole(r: FloatArray, m: FloatArray) -> FloatArray:
    """Return the field (n, 3), nT, of dipoles m (n, 3), A m², at displacements r (n, 3), m, from them."""
    far = np.linalg.norm(r, axis=1)[:, None]
    return np.asarray(100.0 * (3.0 * r * np.sum(r * m, axis=1)[:, None] / far**5 - m / far**3))


class Glider:
    """Magnetic model of a glider: hard iron, soft iron, and two masses with permanent and induced dipoles."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.soft = 0.01 * rng.normal(size=(3, 3))
        self.hard = rng.normal(0.0, 150.0, 3)
        self.at = [np.array([-0.8, 0.02, 0.1]), np.array([-1.1, 0.0, -0.05])]
        self.m = [rng.normal(0.0, 0.25, 3), rng.normal(0.0, 0.4, 3)]
        self.chi = [2e-6, 1e-6]

    def reads(self, log: Log) -> FloatArray:
        """Return the readings (n, 3), nT, without noise and without a hidden effect."""
        H = log.body + log.body @ self.soft.T + self.hard
        for at, m, chi, name, scale in zip(
            self.at, self.m, self.chi, ("battpos", "vbd"), (1e-3, 1e-4), strict=True
        ):
            r = -(at + np.outer(scale * log.columns[name], [1.0, 0.0, 0.0]))
            H = H + dipole(r, m + chi * log.body)
        return H


Effect = Callable[[Log, np.random.Generator], FloatArray]


def _lagged(x: FloatArray, lag: float) -> FloatArray:
    y = x.copy()
    for k in range(1, len(x)):
        y[k] = y[k - 1] + (x[k] - y[k - 1]) * STEP / (lag + STEP)
    return y


def _along(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    return along(x - x[0], rng)


def _plate(log: Log, rng: np.random.Generator) -> FloatArray:
    rate = np.gradient(log.body, STEP, axis=0)
    K = rng.normal(size=(3, 3))
    np.fill_diagonal(K, 0.0)
    return np.stack([_lagged(x, 2.0) for x in (rate @ K.T).T], axis=1)


def _onset(log: Log, rng: np.random.Generator) -> FloatArray:
    return (log.hours > rng.uniform(0.8, 3.2)).astype(float)


def _telegraph(log: Log, rng: np.random.Generator, minutes: float) -> FloatArray:
    flips = rng.random(len(log.body)) < STEP / 60.0 / minutes
    return (np.cumsum(flips) % 2).astype(float)


def _chart(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return an error of the reference (n,), nT: a regional gradient and two bumps."""
    north, east = 111_200.0 * (log.columns["latitude"] - 61.0), 53_900.0 * (log.columns["longitude"] - 4.0)
    found = (north * rng.normal() + east * rng.normal()) / np.std(np.hypot(north, east))
    for _ in range(2):
        k = rng.integers(len(north))
        found = found + rng.normal() * np.exp(
            -((north - north[k]) ** 2 + (east - east[k]) ** 2) / 2.0 / 250.0**2
        )
    return found


def _fin(log: Log, rng: np.random.Generator) -> FloatArray:
    angle = np.radians(log.columns["fin"] + 20.0)
    r = np.stack([np.full_like(angle, 0.5), 0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=1)
    return dipole(r, np.tile(rng.normal(size=3), (len(angle), 1)))


def _bolt(log: Log, rng: np.random.Generator) -> FloatArray:
    return _along(np.sign(log.columns["pitch"] + 3.0), rng) * (0.3 + _onset(log, rng))[:, None]


OWN: dict[str, Effect] = {
    "temperature_offset": lambda log, rng: _along(_lagged(log.columns["sensor_temperature"], 600.0), rng),
    "current_field": lambda log, rng: _along(log.columns["motor_current"], rng),
    "offset_step": lambda log, rng: _along(_onset(log, rng), rng),
    "offset_drift": lambda log, rng: _along(log.hours + 0.06 * log.hours ** 2, rng),
    "pressure_offset": lambda log, rng: _along(log.columns["depth"], rng),
    "eddy_current": _plate,
    "unmodelled_actuator": _fin,
    "interference_tone": lambda log, rng: _along(np.sin(log.time / rng.uniform(2.1, 14.0)), rng),
    "map_error": _chart,
    "diurnal_variation": lambda log, rng: np.cos(2 * np.pi * (log.hours - rng.uniform(0.0, 24.0)) / 24.0),
}  # fmt: skip
"""Effects by their cause: each returns an offset (n, 3), or an error of the reference (n,)."""
FOREIGN: dict[str, Effect] = {
    "relay": lambda log, rng: _along(_telegraph(log, rng, 20.0), rng),
    "connector": lambda log, rng: _along(_telegraph(log, rng, 2.0) * _onset(log, rng), rng),
    "ship": lambda log, rng: _along((1.0 + ((log.hours - rng.uniform(1, 3)) / 0.1) ** 2) ** -1.5, rng),
    "loose bolt": _bolt,
    "bursts": lambda log, rng: _along(_telegraph(log, rng, 15.0) * np.sin(log.time / 11.0), rng),
}  # fmt: skip
"""Foreign effects by name: none is a cause of the table."""


NAMES = (*OWN, *FOREIGN)


def run(case: int, snr: float) -> list[Row]:
    """Calibrate a glider, hide one effect in its survey, diagnose the survey, and return the row."""
    name, rng = NAMES[case % len(NAMES)], np.random.default_rng([20_251, case])
    glider, spins, survey = Glider(rng), logged(rng, 1.0, spins=True), logged(rng, HOURS, spins=False)

    def noise(n: int) -> FloatArray:
        e = rng.standard_t(6.0, (n, 3)) * 0.8
        return e + 0.6 * np.vstack([np.zeros(3), e[:-1]])  # a moving average, unlike the simulator's noise

    calibration = calibrated(spins.dataset(glider.reads(spins) + noise(len(spins.time))))
    effect = (OWN | FOREIGN)[name](survey, rng)
    seen = effect if effect.ndim == 1 else survey.visible(effect)
    effect = effect * snr / (np.std(seen) * np.sqrt(len(seen)))
    H = glider.reads(survey) + noise(len(seen))
    log = survey.dataset(H, effect) if effect.ndim == 1 else survey.dataset(H + effect)
    return diagnosed(name, log, calibration, OWN)


if __name__ == "__main__":
    main(run, 2 * len(NAMES), __doc__)
