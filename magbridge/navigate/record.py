"""The navigator's output: its state, one record for each update, and its restarts."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import msgspec

__all__ = ["Jump", "NavigationState", "Reckoned", "Record"]


class NavigationState(IntEnum):
    """State of the filter; the values are those sent over the link."""

    OFF = 0
    """No start yet."""
    SEARCHING = 1
    """Several hypotheses."""
    TRACKING = 2
    """One hypothesis holds."""
    DEAD_RECKONING = 3
    """Off the map, or the field adds no information here."""
    LOST = 4
    """The field and the map disagree, or agree better elsewhere."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """One update."""

    time_us: int
    """µs since 1970 UTC, at which the rest holds: the mean time of the samples that went in."""
    state: NavigationState
    valid: bool
    """The position can be used: it may be sent as a fix."""
    latitude: float
    longitude: float
    """`latitude`, `longitude`: deg."""
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float
    """`covariance_nn`, `covariance_ne`, `covariance_ee`: m², of the position."""
    innovation: float
    innovation_variance: float
    """`innovation`, `innovation_variance`: nT, nT²; measured minus expected anomaly; NaN off the map."""
    gate: float
    """Largest innovation squared over variance that is accepted."""
    accepted: bool
    """The measurement was accepted."""
    depth: float
    """Depth of the vehicle, m."""
    anomaly: float
    """Measured anomaly: total field minus main field at the dead-reckoned position, nT."""
    map_anomaly: float
    """Anomaly of the map at the position, nT; NaN off the map."""
    bias: float
    bias_sigma: float
    """`bias`, `bias_sigma`: nT, of the calibration."""
    map_error: float
    """Estimated error of the map, nT."""
    current_north: float
    current_east: float
    """`current_north`, `current_east`: m/s."""
    north: float
    east: float
    """`north`, `east`: m, from the dead-reckoned position."""
    hypotheses: int
    odds: float
    """Natural logarithm of the odds of another place against this one."""


class Reckoned(NamedTuple):
    """A position between updates: µs, deg, m²."""

    time_us: int
    latitude: float
    longitude: float
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float


class Jump(NamedTuple):
    """A restart of the estimate: µs, metres jumped, 1-sigma (m) of dead reckoning alone, and the cause."""

    time_us: int
    north: float
    east: float
    allowed: float
    cause: str
