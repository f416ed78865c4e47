"""Voyages on which a filter is in the wrong place, and how long it stands by it."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace as with_options
from voyages import GLIDER, OUTSIDE, SPEEDS, Map, Run, longest, sail, synthetic, voyage


def carried(kind: Map, seed: int) -> tuple[float, float]:
    """Carry a tracking vehicle off by 1.5 lengths at 2 h; return as :func:`silence`."""
    grid = synthetic(kind, seed % 10)
    length, angle = 1.5 * grid.correlation_length, np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    options = with_options(GLIDER, start_sigma=0.2 * grid.correlation_length)
    away = (2.0, float(length * np.cos(angle)), float(length * np.sin(angle)))
    return silence(sail(voyage(grid, options, 5000 + seed, speed=SPEEDS[seed % 3], jump=away), grid, options))


def misled(kind: Map, seed: int) -> tuple[float, float]:
    """Start a filter that claims a tenth of a length, and is one length off; return as :func:`silence`."""
    grid = synthetic(kind, seed % 10)
    options = with_options(GLIDER, start_sigma=grid.correlation_length)
    ds = voyage(grid, options, 7000 + seed, speed=SPEEDS[seed % 3])
    return silence(sail(ds, grid, with_options(options, start_sigma=0.1 * grid.correlation_length)))


def silence(run: Run) -> tuple[float, float]:
    """Return for how many hours on end the filter vouched for a place where it was not; and was not there at all."""
    outside = (run.nees > OUTSIDE) & (run.error > 0.25 * run.length)
    return longest(outside & run.vouched, run.hours), longest(outside, run.hours)
