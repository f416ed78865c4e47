"""The records that packages pass to each other, and the flags that go with a corrected sample.

Units and frames as everywhere: fields in nT, sensor axes x forward, y starboard, z down.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from math import nan
from typing import Final

import msgspec

__all__ = [
    "MAX_DEVICE_TIME_S", "MAX_MEASURED_NT", "NEVER", "NULL_POSITION_DEG", "Channel", "Corrected", "Quality",
    "Reading", "Vector",
]  # fmt: skip

Vector = tuple[float, float, float]

MAX_MEASURED_NT: Final = 1e9
"""Largest field or sigma that can be a measurement, nT (1 T)."""
MAX_DEVICE_TIME_S: Final = 1e11
"""Largest time of an instrument, s: one beyond 3,000 years is an error of transmission."""
NULL_POSITION_DEG: Final = 0.01
"""Largest magnitude of latitude and longitude of an unknown position, deg: without a fix, ArduPilot's
position drifts about 0, 0."""
NEVER: Final = -(1 << 62)
"""Time of an event that has not happened yet, µs; times before 1970 are negative."""


class Quality(IntFlag):
    """Why a corrected sample is doubtful; 0 is a sample without a flag.

    The lower-case names are the public ones: of the column ``quality`` and of ``MAG_FIELD.flags``.
    """

    STALE_TELEMETRY = 1
    """A parameter the calibration needs is older than its ``max_age``, missing or NaN."""
    EXTRAPOLATED = 2
    """A parameter, the depth or the temperature lies outside the calibrated range."""
    MOVING = 4
    """A mass moved faster than ``align.moving_rate`` in the last second of telemetry, or had just moved."""
    SATURATED = 8
    """A channel was at the end of its range."""
    UNCALIBRATED = 16
    """No calibration, or one that does not belong to this sensor."""
    OFFSET_SUSPECT = 32
    """The sensor was power-cycled since the calibration, so its offset may have changed."""
    NO_BORESIGHT = 64
    """The vector is known only up to one rotation; its magnitude is right."""
    GAP = 128
    """Samples are missing just before this one."""
    IMPLAUSIBLE = 256
    """It cannot be the Earth's field here, or the sensor or the telemetry shows a fault."""
    LATE_JOIN = 512
    """Sample and telemetry may not be of one time."""
    UNEXPLAINED = 1024
    """The model no longer explains the data."""

    def names(self) -> str:
        """Return the public names, in order of value, separated by spaces; empty for no flag."""
        return " ".join(str(flag.name).lower() for flag in self)

    @classmethod
    def parse(cls, names: str) -> Quality:
        """Return the flags that `names` lists (inverse of :meth:`names`); KeyError: a name is not a flag."""
        flags = cls(0)
        for name in names.split():
            flags |= cls[name.upper()]
        return flags


class Channel(IntEnum):
    """Origin of a record of the log; kept in the low two bits of its time stamp (µs)."""

    SENT = 0
    LINK = 1
    SENSOR = 2
    STATE = 3


class Reading(msgspec.Struct, frozen=True, gc=False):
    """One measurement of the three channels, as the instrument sent it, and its time on the host's clock."""

    field: Vector
    """Field, nT, sensor axes, uncorrected; (total field, 0, 0) of a scalar instrument."""
    counts: tuple[int, int, int] | None = None
    """The converter's own numbers, where the instrument sends counts."""
    sequence: int | None = None
    """Frame number, wrapping at the driver's ``sequence_modulo``."""
    device_time: float = nan
    """Time on the instrument's clock, s; NaN if it has none."""
    channel_delay: Vector = (0.0, 0.0, 0.0)
    """Time from `device_time` to the sample of each channel, s."""
    temperature: float = nan
    supply: float = nan
    """`temperature`, `supply`: degC at the fluxgate and V; NaN where unknown."""
    power_cycle: int | None = None
    """Number of times that the instrument was powered on."""
    saturated: bool = False
    """A channel was at the end of its range."""
    time_us: int = 0
    """Time of `device_time` on the host's clock, µs since 1970 UTC, a multiple of 4; 0 until it is known."""
    missing: int = 0
    """Number of readings missing immediately before this reading."""
    since_us: int = 0
    """Earliest possible value of `time_us`, µs, if it is uncertain because readings waited; else 0."""
    restarted: bool = False
    """True if the instrument's clock restarted, because the instrument was powered on again."""


class Corrected(msgspec.Struct, frozen=True, gc=False):
    """One sample after calibration."""

    total_field: float
    total_field_sigma: float
    """`total_field`, `total_field_sigma`: nT, magnitude and its 1-sigma."""
    field: Vector
    """Corrected field in body axes, nT (sensor axes while ``no_boresight`` is set)."""
    field_sigma: Vector
    """1-sigma of each component, nT."""
    quality: int
    """:class:`Quality` bits."""
    main_field: float = nan
    """Main field's total at the sample, nT; NaN where unknown."""
    stated_sigma: float = nan
    """1-sigma of the total field without what the plausibility checks added, nT."""
