"""The navigator's output: its state, a record of each update, and its restarts."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import msgspec

from magbridge.arrays import FloatArray

__all__ = ["Jump", "NavigationState", "Reckoned", "Record", "Rival"]


class NavigationState(IntEnum):
    """State of the filter; the values are those sent over the link."""

    OFF = 0
    """The navigator has no position to start from."""
    SEARCHING = 1
    """Several positions still explain the field."""
    TRACKING = 2
    """One position explains the field."""
    DEAD_RECKONING = 3
    """The vehicle is off the map, or the field does not improve the dead-reckoned position."""
    LOST = 4
    """The field contradicts the map at the position or agrees with it better elsewhere, or a position that
    was known has become more uncertain than ``sigma_limit``."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """Estimate of the position and of the states after one update of the filter."""

    time_us: int
    """Mean time of the samples in the update, to which all fields refer, µs since 1970 UTC."""
    state: NavigationState
    valid: bool
    """True if the position may be sent as a fix."""
    latitude: float
    longitude: float
    """`latitude`, `longitude`: estimated position, deg."""
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float
    """`covariance_nn`, `covariance_ne`, `covariance_ee`: covariance of the position, north and east, m²."""
    innovation: float
    innovation_variance: float
    """`innovation`, `innovation_variance`: measured minus expected anomaly, nT, and its variance, nT²; NaN
    off the map."""
    gate: float
    """Largest squared innovation over its variance that the filter accepts."""
    accepted: bool
    """True if the filter accepted the measurement."""
    depth: float
    """Depth of the vehicle, m."""
    anomaly: float
    """Measured anomaly: total field minus main field at the dead-reckoned position, nT."""
    map_anomaly: float
    """Anomaly of the map at the position, nT; NaN off the map."""
    bias: float
    bias_sigma: float
    """`bias`, `bias_sigma`: estimated bias of the calibration and its 1-sigma, nT."""
    map_error: float
    """Estimated error of the map, nT."""
    current_north: float
    current_east: float
    """`current_north`, `current_east`: estimated velocity error of dead reckoning, m/s."""
    north: float
    east: float
    """`north`, `east`: offset of the estimate from the dead-reckoned position, m."""
    hypotheses: int
    odds: float
    """Natural logarithm of the odds of another place against the estimated position."""


class Reckoned(NamedTuple):
    """Position between updates: time (µs), latitude and longitude (deg), covariance (m²)."""

    time_us: int
    latitude: float
    longitude: float
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float


class Jump(NamedTuple):
    """Restart of the estimate: time (µs), jump north and east (m), and its cause.

    `allowed` is the 1-sigma of dead reckoning alone, m.
    """

    time_us: int
    north: float
    east: float
    allowed: float
    cause: str


class Rival(NamedTuple):
    """Position at which the vehicle may be instead of at the navigator's.

    Its position (2,) is in m north and east of dead reckoning, its covariance (2, 2) in m². `log_odds` is the
    natural logarithm of its odds against the navigator's position.
    """

    position: FloatArray
    covariance: FloatArray
    log_odds: float
