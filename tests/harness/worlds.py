"""Simulate in-flight calibration: a glider turns, dives and moves its mass over a smooth field."""

from collections.abc import Callable
from math import nan

import numpy as np
from small import polynomial

from magbridge.calibration.correct import Corrector
from magbridge.calibration.model import Calibration, Parameter
from magbridge.calibration.terms import full_order
from magbridge.field.grid import AnomalyGrid
from magbridge.learning import Learner

MASS = Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0)
ORDER = full_order(1, 2)
FIELD = 50_000.0


def calibration(sigma: float = 1.0) -> Calibration:
    """Return a calibration whose coefficients have a standard deviation of `sigma` nT each."""
    K = 9 * len(ORDER)
    return polynomial(np.random.default_rng(3).normal(size=K) * 200.0, MASS, variance=sigma**2)


class World:
    """Samples of a glider that yaws, pitches and moves its mass over a smooth crustal field."""

    def __init__(self, truth: Calibration, samples: int, seed: int = 1, *, straight: bool = False) -> None:
        rng = np.random.default_rng(seed)
        k = np.arange(samples)
        leg = k // 60
        yaw = 0.6 if straight else 0.7 * leg + 0.1 * rng.normal(size=samples)
        pitch = 0.0 if straight else np.where(leg % 2, 0.45, -0.4) + 0.05 * rng.normal(size=samples)
        roll = 0.02 * rng.normal(size=samples)
        north, down = 0.4 * np.cos(yaw) + 0 * k, 0.9
        x = north * np.cos(pitch) - down * np.sin(pitch)
        z = north * np.sin(pitch) + down * np.cos(pitch)
        y = -0.4 * np.sin(yaw) * np.cos(roll) + z * np.sin(roll)
        unit = np.column_stack([x, y, z])
        unit /= np.linalg.norm(unit, axis=1)[:, None]
        self.rock = 60.0 * np.sin(k * 4.0 * 0.35 / 400.0) if straight else 60.0 * np.sin(k * 1.4 / 900.0)
        self.total = FIELD + self.rock
        self.mass = np.where(leg % 2, 0.5, -0.5) if not straight else np.zeros(samples)
        A, T = truth.matrices(self.mass[:, None])
        self.field = np.linalg.solve(A, (unit * self.total[:, None])[:, :, None])[:, :, 0] + T
        self.field += rng.normal(size=(samples, 3))
        self.track = [(49.0 + n * 1.4 / 111_000.0, -57.0) for n in range(samples)]
        self.where: list[tuple[float, float] | None] = [*self.track]


def learn(
    learner: Learner,
    world: World,
    *,
    added: np.ndarray | None = None,
    quality: int | np.ndarray = 0,
    watched: np.ndarray | None = None,
    faulty: np.ndarray | None = None,
    settled: np.ndarray | None = None,
    seen: Callable[[int], None] | None = None,
) -> list[int]:
    """Feed a world's samples to the learner; return the indices of the samples at which it had an alarm.

    The function calls `seen` after each sample. `settled` (n, 3) is the final field of each sample in nT,
    given to the learner with the next sample.
    """
    corrector, doubted = Corrector(learner.first), []
    field = world.field if added is None else world.field + added
    flags = np.broadcast_to(quality, len(field)).tolist()
    for n, reading in enumerate(field.tolist()):
        values = (float(world.mass[n]),)
        corrector.numbers(0, (reading[0], reading[1], reading[2]), values, 0)
        learner.sample(
            (n + 1) * 4_000_000,
            (reading[0], reading[1], reading[2]),
            corrector.regressors,
            values,
            flags[n],
            faulty=faulty is not None and bool(faulty[n]),
            reference=FIELD,
            position=world.where[n],
            watched=(nan,) if watched is None else watched[n].tolist(),
            settled=None if settled is None or n == 0 else tuple(settled[n - 1].tolist()),
        )
        if learner.flags:
            doubted.append(n)
        if seen is not None:
            seen(n)
    return doubted


def error_of(learned: Calibration, world: World) -> float:
    """Return the standard deviation of the calibrated total field's error, nT, without bias."""
    A, T = learned.matrices(world.mass[:, None])
    total = np.linalg.norm(np.matmul(A, (world.field - T)[:, :, None])[:, :, 0], axis=1)
    return float(np.std(total - world.total))


def grid_of(scale: float, shift: float = 0.0, level: float = 0.0) -> AnomalyGrid:
    """Return a map of the crustal field, scaled by `scale`, shifted by `shift` (m), plus `level` (nT)."""
    metres = np.arange(-3_000.0, 5_000.0, 100.0)
    rock = scale * 60.0 * np.sin((metres + shift) / 900.0) + level
    latitude = 49.0 + metres / 111_000.0
    longitude = np.linspace(-57.1, -56.9, 5)
    return AnomalyGrid(longitude, latitude, np.repeat(rock[:, None], 5, axis=1), altitude=0.0)
