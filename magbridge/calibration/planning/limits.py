"""What a vehicle can fly to be calibrated: banks, pitches, and where its masses can stand with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Parameter

__all__ = ["Limits", "PlannedRun", "candidate_runs", "settled", "trim_of"]

SLACK = 3.0
"""deg, by which another trim of the vehicle changes the pitch at the same positions."""
MAX_REST_FRACTION = 0.01
"""Share of half a position's range, from one sample to the next: a mass at rest."""
MAX_POSITION_DIFFERENCE = 0.35
"""Share of half a position's range, by which a run may differ from positions that were flown."""


@dataclass(frozen=True)
class PlannedRun:
    """One spiral: pitch and roll in deg, positions in their units."""

    pitch: float
    roll: float
    parameters: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Limits:
    """What the vehicle can do."""

    roll: tuple[float, float] = (-10.0, 10.0)
    """deg, banks that it can hold in a spiral."""
    pitch: tuple[float, float] = (14.0, 30.0)
    """Smallest and largest pitch of dives and climbs, deg."""
    parameters: tuple[tuple[float, float], ...] = ()
    """Ends of each position."""
    pitch_at: Callable[[FloatArray], float] | None = None
    """Positions (k,) -> pitch that they trim the vehicle to (deg), see :func:`trim_of`; without it pitch is
    free."""
    flown: FloatArray | None = None
    """(m, k): Positions that the vehicle is known to fly with: a run keeps within
    :data:`MAX_POSITION_DIFFERENCE` of some of
    them. (No glider dives with its ballast out.)."""


def trim_of(data: Observations) -> Callable[[FloatArray], float] | None:
    """Return the pitch (deg) that positions (k,) trim a vehicle to, linear in them; None if undetermined."""
    if data.attitude is None or not data.names:
        return None
    known = np.isfinite(data.attitude[:, 1])
    pitch = np.degrees(data.attitude[known, 1])
    design = np.column_stack([np.ones(len(pitch)), data.parameters[known]])
    if len(pitch) <= design.shape[1]:
        return None
    trim, *_ = np.linalg.lstsq(design, pitch, rcond=None)
    if np.var(pitch - design @ trim) > 0.1 * np.var(pitch):
        return None
    return lambda positions: float(trim[0] + positions @ trim[1:])


def settled(data: Observations, parameters: tuple[Parameter, ...]) -> FloatArray:
    """Return the (m, k) positions at which the masses of `data` are at rest; `parameters` give the scales."""
    scale = [parameter.scale for parameter in parameters]
    moving = (np.abs(np.diff(data.parameters, axis=0) / scale) > MAX_REST_FRACTION).any(axis=1)
    at_rest = np.ones(len(data), bool)
    at_rest[1:] &= ~moving
    at_rest[:-1] &= ~moving
    return data.parameters[at_rest]


def candidate_runs(limits: Limits, parameters: tuple[Parameter, ...], levels: int) -> list[PlannedRun]:
    """Return every run that the vehicle can fly, on a grid of `levels` values of each position."""
    ends = limits.parameters or tuple((p.low, p.high) for p in parameters)
    rolls = np.unique(np.append(np.linspace(*limits.roll, 5), np.clip(0.0, *limits.roll)))
    found = []
    for positions in product(*(np.linspace(low, high, levels) for low, high in ends)):
        if limits.flown is not None and not _near(np.array(positions), limits.flown, parameters):
            continue
        if limits.pitch_at is None:
            steep = np.linspace(*limits.pitch, 3)
            pitches = [*(-steep), *steep]
        else:
            trim = limits.pitch_at(np.array(positions))
            pitches = [trim - SLACK, trim, trim + SLACK]
        found += [
            PlannedRun(float(pitch), float(roll), tuple(float(p) for p in positions))
            for pitch in pitches
            for roll in rolls
            if limits.pitch[0] <= abs(pitch) <= limits.pitch[1]
        ]
    return found


def _near(positions: FloatArray, flown: FloatArray, parameters: tuple[Parameter, ...]) -> bool:
    """Return True if some flown positions differ by no more than REACH in any parameter."""
    off = np.abs(positions - flown) / [parameter.scale for parameter in parameters]
    return bool((off.max(axis=1) <= MAX_POSITION_DIFFERENCE).any())
