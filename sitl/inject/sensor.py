"""What goes wrong inside the instrument: heat, shocks, age; its converter, filter, clock and range."""

from __future__ import annotations

import msgspec
import numpy as np

from sitl.inject.scene import Array, Generator, Scene, direction, soaked

CALIBRATED_AT = 4.5
"""Instrument's temperature during the calibration, to about half a degree, degC."""


def _warmer(scene: Scene, rng: Generator) -> Array:
    """Return by how much the core is warmer than during the calibration, degC."""
    core = soaked(scene.logged["sensor_temperature"][0], scene.track.step, float(rng.uniform(300, 4000)))
    return core - CALIBRATED_AT - 0.5 * rng.normal()


def heat_offset(scene: Scene, size: float, rng: Generator) -> None:
    """An offset that follows the core's temperature; size in nT/degC."""
    warmer, vector = _warmer(scene, rng), size * direction(rng)
    scene.add(warmer, vector)
    scene.record_truth(vector)


def heat_scale(scene: Scene, size: float, rng: Generator) -> None:
    """Copper in the coils: gains follow the core's temperature; size in 1/degC, times 5e4."""
    gains = 1.0 + size / 5e4 * np.abs(rng.normal(1.0, 0.4, 3)) * _warmer(scene, rng)[:, None]
    scene.field = scene.field * gains


def jump(scene: Scene, size: float, rng: Generator) -> None:
    """A shock: the offset jumps and relaxes within a minute; amplitude in nT."""
    t0 = rng.uniform(0.15, 0.85) * scene.t[-1]
    settled = np.where(scene.t > t0, 1.0 - 0.15 * np.exp(-np.maximum(scene.t - t0, 0.0) / 20.0), 0.0)
    vector = size * direction(rng)
    scene.add(settled, vector)
    scene.record_truth(vector)


def creep(scene: Scene, size: float, rng: Generator) -> None:
    """Stress relaxes logarithmically (magnetic viscosity: Street & Woolley 1949); size in nT over the log."""
    tau = rng.uniform(0.3, 1.5) * scene.t[-1]
    crept = np.log1p(scene.t / tau) / np.log1p(scene.t[-1] / tau)
    scene.add(crept, size * direction(rng))


def multiplexed(scene: Scene, size: float, rng: Generator) -> None:
    """The converter samples the channels in turn, and the log does not say so; size in s between channels."""
    order = rng.choice([-1.0, 1.0])
    delays = (0.0, size, 2 * size) if order > 0 else (2 * size, size, 0.0)
    scene.instrument = msgspec.structs.replace(scene.instrument, channel_delay=delays)
    scene.truth |= dict(zip("xyz", delays, strict=True))


def anti_alias(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (a filter has no direction)
    """A slow RC filter before the converter; size is its time constant in s."""
    scene.instrument = msgspec.structs.replace(scene.instrument, corner=1.0 / (2 * np.pi * max(size, 1e-6)))
    scene.truth["delay"] = size


def late_stamps(scene: Scene, size: float, rng: Generator) -> None:
    """The telemetry's clock is behind, or ahead; size in s."""
    scene.late = size * float(rng.choice([-1.0, 1.0]))
    scene.truth["delay"] = scene.late


def core(scene: Scene, size: float, rng: Generator) -> None:
    """The feedback's gain is finite, so the core's nonlinearity shows; size in nT at 50,000 nT."""
    a, b = rng.normal(0, 1, 3), rng.normal(0, 1, 3)
    scene.bend.append(
        lambda H: H - size * (a * (H / 5e4) ** 2 + b * np.tan(np.clip(H / 5e4, -1.2, 1.2)) / 1.5574)
    )


def rail(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (the rail is where it is)
    """An amplifier compresses softly towards its rail; size in nT lost at the largest reading."""

    def bend(H: Array) -> Array:
        axis = int(np.argmax(np.abs(H).max(axis=0)))
        h = np.abs(H[:, axis])
        top = float(h.max())
        knee = top - 0.25 * float(np.ptp(h))
        out = H.copy()
        out[:, axis] -= np.sign(H[:, axis]) * size * (np.maximum(h - knee, 0.0) / (top - knee)) ** 1.5
        return out

    scene.bend.append(bend)


def bit_flips(scene: Scene, size: float, rng: Generator) -> None:
    """A bus flips bits now and then: a dozen samples are off by `size` nT, or two or four times that."""

    def bend(H: Array) -> Array:
        rows = rng.choice(len(H) // 4, 12, replace=False) * 4
        out = H.copy()
        out[rows, rng.integers(0, 3, 12)] += (
            size * rng.choice([-1.0, 1.0], 12) * 2.0 ** rng.integers(0, 3, 12)
        )
        return out

    scene.bend.append(bend)
