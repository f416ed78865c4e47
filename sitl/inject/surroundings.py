"""What goes wrong around the vehicle: the Earth's field itself, the map of it, machines and ships."""

from __future__ import annotations

import numpy as np

from sitl.inject.scene import Generator, Scene, direction


def ionosphere(scene: Scene, size: float, rng: Generator) -> None:
    """Sq's four harmonics and the tide of the ocean, mostly along the field; size in nT."""
    hours = scene.t / 3600.0
    total = sum(
        amplitude * np.cos(2 * np.pi * hours / period + rng.uniform(0, 2 * np.pi))
        for period, amplitude in ((24.0, 1.0), (12.0, 0.6), (8.0, 0.35), (6.0, 0.15), (12.42, 0.2))
    )
    scene.earth = scene.earth + size * np.outer(total - np.mean(total), [0.7, 0.2, 0.68])


def bad_map(scene: Scene, size: float, rng: Generator) -> None:
    """The map lacks some bodies: bumps a kilometre or so across; size in nT."""
    seen = scene.track.pose_at(scene.when)
    north, east = scene.track.local(seen["latitude"], seen["longitude"])
    width = 0.35 * max(np.ptp(north), np.ptp(east))
    for _ in range(3):
        k = rng.integers(len(north))
        far = (north - north[k]) ** 2 + (east - east[k]) ** 2
        scene.reference = scene.reference + size * rng.normal() * np.exp(
            -0.5 * far / (width * rng.uniform(0.5, 1.0)) ** 2
        )


def wrong_level(scene: Scene, size: float, rng: Generator) -> None:
    """The main-field model is off at this site, by slightly different amounts along the way; size in nT."""
    along = scene.when / scene.when[-1] - 0.5
    scene.reference = scene.reference + size * (1.0 + 0.02 * rng.normal() * along)
    scene.truth["bias"] = size


def hum(scene: Scene, size: float, rng: Generator) -> None:
    """A machine's field of a steady frequency, turning in an ellipse, seen by the sampling; size in nT."""
    f = rng.uniform(0.1, 0.4) * scene.instrument.rate
    phase = 2 * np.pi * f * scene.t + 0.1 * np.sin(scene.t / 3000.0)
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(phase), a) + np.outer(np.sin(phase + 0.3), 0.5 * b))
