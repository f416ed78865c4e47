"""What an effect may change: the simulation between the vehicle and its log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as attribute

import msgspec
import numpy as np
from numpy.typing import NDArray

from sitl.instrument import Instrument
from sitl.signals import autoregressive, first_order
from sitl.trajectory import Track

Array = NDArray[np.float64]
Generator = np.random.Generator


@dataclass
class Scene:
    """What an effect may change, on the simulation's fine grid of n points; m rows are logged."""

    track: Track
    when: Array
    """(m,), s after the start, of the rows."""
    field: Array
    """(n, 3), nT at the sensor, body axes."""
    earth: Array
    """(n, 3), nT north-east-down, added to the Earth's field but not to the reference."""
    water: Array
    """(n,), degC."""
    instrument: Instrument
    reference: Array
    """(m,), nT by which the reference is too small."""
    late: float = 0.0
    """s by which the telemetry's timestamps are behind."""
    logged: dict[str, tuple[Array, str]] = attribute(default_factory=dict)
    """(n,) each: Further telemetry."""
    bend: list[Callable[[Array], Array]] = attribute(default_factory=list)
    """Functions applied to the channels (m, 3) after the analogue chain."""
    truth: dict[str, float] = attribute(default_factory=dict)
    """Numbers that a perfect diagnosis would print, by the name it would print them under."""

    @property
    def t(self) -> Array:
        """(n,) s after the start."""
        return self.track.elapsed

    def add(self, shape: Array, vector: Array) -> None:
        """Add ``shape(t) vector``, (n,) times (3,) nT in body axes, to the field at the sensor."""
        self.field = self.field + shape[:, None] * vector

    def record_truth(self, vector: Array) -> None:
        """Note as the truth what the channels read of a `vector` (3,) in body axes."""
        self.truth |= dict(zip("xyz", (self.instrument.matrix() @ vector).tolist(), strict=True))


Effect = Callable[[Scene, float, Generator], None]


class HiddenEffect(msgspec.Struct, frozen=True):
    """One hidden effect: its name, as in :data:`~.effects.EFFECTS`, size, seed."""

    name: str
    size: float
    seed: int


def direction(rng: Generator) -> Array:
    """Draw a unit vector (3,)."""
    d = rng.normal(size=3)
    return np.asarray(d / np.linalg.norm(d))


def relays(x: Array, centres: Array, widths: Array) -> Array:
    """Mean state of relays along a history x (n,) (Preisach 1935), less that without hysteresis."""
    total = np.zeros(len(x))
    for c, w in zip(centres, widths, strict=True):
        up, down = x >= c + w / 2, x <= c - w / 2
        last = np.maximum.accumulate(np.where(up | down, np.arange(len(x)), 0))
        total += np.where(up[last], 1.0, -1.0) - np.where(x >= c, 1.0, -1.0)
    return total / len(centres)


def soaked(surface: Array, step: float, lag: float) -> Array:
    """Return the temperature (n,) in the middle of a slab whose faces follow `surface` (n,), every `step` s.

    `lag` is the slowest mode's time constant, s (Carslaw & Jaeger 1959, sec. 3.4).
    """
    modes = range(40)
    weights = np.array([4.0 * (-1) ** k / (np.pi * (2 * k + 1)) for k in modes])
    parts = [first_order(surface, step, lag / (2 * k + 1) ** 2) for k in modes]
    return np.asarray((weights / weights.sum()) @ np.array(parts))


def furnish(scene: Scene, rng: Generator) -> None:
    """Log what any vehicle logs, related to an effect or not: motor currents, a fin, temperatures."""
    n, t, step = len(scene.t), scene.t, scene.track.step
    moving = np.abs(np.gradient(scene.track.parameters["ballast"], step)) > 1.0
    duty = (autoregressive(rng, (n,), 1.0, 400.0 / step) > 0.8) & ~moving
    pump = 2.5 * first_order(moving.astype(float), step, 3.0) + 0.02 * rng.normal(size=n)
    motor = 0.8 * first_order(duty.astype(float), step, 8.0) * (1.0 + 0.1 * np.sin(t / 700.0))
    scene.logged["amps_a"] = (pump, "A")
    scene.logged["amps_b"] = (motor + 0.005 * rng.normal(size=n), "A")
    fin = np.round(first_order(autoregressive(rng, (n,), 12.0, 240.0 / step), step, 5.0), 1)
    scene.logged["p17"] = (fin, "deg")
    day = 0.8 * np.sin(2 * np.pi * t / 86400.0 + rng.uniform(0, 6.28)) + autoregressive(
        rng, (n,), 0.25, 4000.0 / step
    )
    scene.water = scene.water + day
    scene.logged["sensor_temperature"] = (first_order(scene.water, step, 300.0), "degC")
    scene.logged["water_temperature"] = (scene.water, "degC")
    bay = first_order(scene.water, step, 20_000.0) + first_order(0.6 * pump, step, 5000.0)
    scene.logged["bay_temperature"] = (bay, "degC")
