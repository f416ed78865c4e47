"""Possible causes of data that the model no longer explains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from magbridge.arrays import FloatArray, IndexArray

__all__ = ["CAUSE_UNITS", "FROM_ZERO", "NO_COEFFICIENT", "Alarm", "Cause", "Signs", "named"]

CAUSE_UNITS: Final = {
    "offset_step": 20.0,
    "offset_drift": 20.0,
    "temperature_offset": 2.0,
    "unmodelled_actuator": 20.0,
    "current_field": 20.0,
    "clock_offset": 2.0,
    "map_error": 50.0,
}
"""Cause -> the unit of its amplitude: nT, nT/h, nT/degC, nT a half range, nT/A, s, nT. Each cause has a bit
in MAG_LEARNING."""
FROM_ZERO: Final = ("offset_step", "current_field", "clock_offset", "map_error")
"""Causes whose effect is proportional to their regressor, not to its change since the onset."""
NO_COEFFICIENT: Final = frozenset(("clock_offset", "map_error"))
"""Causes that no coefficient can represent."""


def named(causes: Sequence[str]) -> str:
    """Return the likeliest two of `causes` in words."""
    return " or ".join(causes[:2]).replace("_", " ")


class Signs(NamedTuple):
    """What a sample's causes would do to its residual."""

    time: float
    """Time of the sample, s since 1970 UTC."""
    offset: FloatArray
    """(3,): Derivative of the residual by the offset of each axis."""
    positions: tuple[float, ...]
    """Parameters, scaled to their range."""
    watched: tuple[float, ...]
    """degC and A: temperature and currents; NaN where unknown."""
    clock: float
    """nT/s: how the residual changes with the telemetry's time."""
    level: float
    """By the reference's level."""


class Cause(NamedTuple):
    """One to test: its name, the telemetry it follows, and the states (3,) that would take it up, if any."""

    name: str
    channel: str
    states: IndexArray | None


class Alarm(NamedTuple):
    """The model no longer explains the data."""

    causes: tuple[str, ...]
    """Which fit, the likeliest first."""
    channels: tuple[str, ...]
    """The telemetry that each follows; empty for none."""
    since: float
    """Onset of the likeliest cause, s since 1970 UTC."""
    size: float
    """Root mean square of the likeliest cause's effect on the total field, nT."""
    strength: float
    """Log-likelihood ratio L of the likeliest cause."""
    mapless: bool = False
    """True for a map alarm: an unmapped crustal field explains the data. The corrected field is not affected,
    and the alarm lasts as long as the bank raises it."""
