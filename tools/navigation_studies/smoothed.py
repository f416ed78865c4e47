"""Flights on a map as it is, and on the same map without its short waves."""

from __future__ import annotations

from msgspec.structs import replace as with_options

from magbridge.field.continuation import smoothed
from navigation_studies.simulated import GLIDER, SPEEDS, Map, Score, sail, synthetic, track_over

__all__ = ["ROUGH", "WAVELENGTHS", "on_smoothed"]

ROUGH = Map(40, 1000, rough=True)
WAVELENGTHS = (0.0, 1_000.0, 2_000.0)
"""m, of which half the amplitude stays; 0: all of it."""


def on_smoothed(seed: int) -> tuple[Score, ...]:
    """Return one flight's score on the map of every wavelength."""
    raw = synthetic(ROUGH, seed % 10)
    options = with_options(GLIDER, start_sigma=0.2 * raw.correlation_length)
    flown = track_over(raw, options, 1000 + seed, speed=SPEEDS[seed % 3])
    maps = (smoothed(raw, length) if length else raw for length in WAVELENGTHS)
    return tuple(sail(flown, grid, options).score() for grid in maps)
