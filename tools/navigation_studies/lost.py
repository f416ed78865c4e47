"""Voyages on which a filter is in the wrong place or has the wrong map, and how long it is called valid."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace as with_options

from magbridge.arrays import BoolArray
from magbridge.field.grid import AnomalyGrid
from navigation_studies.simulated import (
    GLIDER,
    OUTSIDE,
    SPEEDS,
    Map,
    Run,
    longest,
    sail,
    synthetic,
    track_over,
)

LEVEL = 60.0
"""nT by which the field is measured too large."""


def carried(kind: Map, seed: int) -> tuple[float, float]:
    """Displace a tracking vehicle by 1.5 correlation lengths at 2 h; return as :func:`silence`."""
    grid = synthetic(kind, seed % 10)
    length, angle = 1.5 * grid.correlation_length, np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    options = with_options(GLIDER, start_sigma=0.2 * grid.correlation_length)
    away = (2.0, float(length * np.cos(angle)), float(length * np.sin(angle)))
    return silence(
        sail(track_over(grid, options, 5000 + seed, speed=SPEEDS[seed % 3], jump=away), grid, options)
    )


def misled(kind: Map, seed: int) -> tuple[float, float]:
    """Start a filter with a tenth of its true start error, 1-sigma one length; return as :func:`silence`."""
    grid = synthetic(kind, seed % 10)
    options = with_options(GLIDER, start_sigma=grid.correlation_length)
    ds = track_over(grid, options, 7000 + seed, speed=SPEEDS[seed % 3])
    return silence(sail(ds, grid, with_options(options, start_sigma=0.1 * grid.correlation_length)))


def level(kind: Map, seed: int) -> tuple[float, float]:
    """Measure 60 nT too much all along, where 0.5 nT is claimed; return as :func:`standing`."""
    grid = synthetic(kind, seed % 10)
    options = with_options(GLIDER, start_sigma=0.2 * grid.correlation_length)
    ds = track_over(grid, options, 9000 + seed, speed=SPEEDS[seed % 3])
    return standing(sail(ds.assign(total_field=ds["total_field"] + LEVEL), grid, options))


def half(kind: Map, seed: int) -> tuple[float, float]:
    """Sail on a field of which the map holds half the variance; return as :func:`standing`."""
    grid, other = synthetic(kind, seed % 10), synthetic(kind, 10 + seed % 10)
    field = AnomalyGrid(grid.longitude, grid.latitude, (grid.anomaly + other.anomaly) / 2**0.5)
    options = with_options(GLIDER, start_sigma=0.2 * grid.correlation_length)
    return standing(sail(track_over(field, options, 9000 + seed, speed=SPEEDS[seed % 3]), grid, options))


def outside(run: Run) -> BoolArray:
    """Return when the vehicle is outside the filter's ellipse and over a quarter correlation length away."""
    return (run.nees > OUTSIDE) & (run.error > 0.25 * run.length)


def silence(run: Run) -> tuple[float, float]:
    """Return the longest spells (hours) in which a wrong position counted as valid, and of being wrong."""
    return longest(outside(run) & run.valid, run.hours), longest(outside(run), run.hours)


def standing(run: Run) -> tuple[float, float]:
    """Return the share of the time in which a right position counted as valid, and a wrong one."""
    return float(np.mean(run.valid & ~outside(run))), float(np.mean(run.valid & outside(run)))
