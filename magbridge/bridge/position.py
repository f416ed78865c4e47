"""Position of the vehicle as reported, and the Earth's main field there."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, isnan, nan
from typing import TYPE_CHECKING, ClassVar, Final

from magbridge.errors import MagbridgeError
from magbridge.field.geodesy import separation
from magbridge.mavlink import Message, spec

if TYPE_CHECKING:
    from magbridge.field.igrf import NearbyField

__all__ = ["CLOCK_SET_US", "Position"]

POSITION = spec("GLOBAL_POSITION_INT")
MAX_POSITION_AGE_US: Final = 60_000_000
"""Age of a position, µs: a glider makes 20 m in a minute, over which the main field changes by less than
0.1 nT."""
CLOCK_SET_US: Final = 10**15
"""µs since 1970, in 2001: a host whose clock says less has none that was set, and the date is not known."""
FIELD_INTERVAL_US: Final = 1_000_000
"""µs after which the bridge computes the main field again."""
MAX_VECTOR_AGE_US: Final = 3_600_000_000
MAX_VECTOR_DISTANCE_DEG: Final = 0.01
"""Time, and difference of latitude or longitude, from which on the bridge computes the main field's vector
again: over 1 km its direction changes by 0.01 deg."""
MAX_VEHICLE_SPEED_M_S: Final = 350.0
"""Speed that no vehicle with a fluxgate exceeds, m/s."""
MAX_JUMP_M: Final = 10_000.0
"""m beyond what MAX_SPEED_M_S allows: the main field changes by 50 nT at most over that, so that a correction
of a long dead reckoning is not a jump."""
SUSPECT_US: Final = 900_000_000
"""µs for which the vehicle must stay at a position beyond a jump until the bridge uses that position."""
LATITUDE_E7, LONGITUDE_E7 = 900_000_000, 1_800_000_000
"""Largest magnitudes of GLOBAL_POSITION_INT's lat and lon, 1e-7 deg."""
ALTITUDE_M: Final = -15_000.0, 100_000.0
"""Heights at which the main-field model is defined for vehicles, m."""

UNKNOWN_VECTOR: Final = (nan, nan, nan)


class Position:
    """Last position of the vehicle; the first one loads the field model.

    `notify`: receives the reason why the main field is unknown at a known position.
    """

    MESSAGE: ClassVar[int] = POSITION.id

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._where: tuple[float, float] | None = None
        self._depth = 0.0
        self._when_us = self._evaluated_us = 0
        self._field = nan
        self._vector = UNKNOWN_VECTOR
        self._vector_us, self._vector_at = 0, (nan, nan)
        self._vector_where: tuple[float, float] | None = None  # for which the vector was checked
        self._model: NearbyField | None = None
        self._trusted: tuple[float, float] | None = None
        self._trusted_us = self._jumped_us = 0

    @property
    def last_position(self) -> tuple[float, float] | None:
        """Latitude and longitude of the last position, deg; None before the first and after a jump."""
        return None if self._jumped_us else self._where

    @property
    def depth(self) -> float:
        """Depth of the last position, m; NaN where :attr:`last_position` is None."""
        return nan if self.last_position is None else self._depth

    def update(self, message: Message, time_us: int) -> None:
        """Use a GLOBAL_POSITION_INT; ignore one that states an unknown or impossible position.

        After a jump that speed and time do not allow, main field and anomaly are unknown until the
        vehicle is near the former track again or has stayed beyond the jump for :data:`SUSPECT_US`.
        """
        lat, lon, altitude = message["lat"], message["lon"], message["alt"] * 1e-3
        # an autopilot that does not know its position sends 0, 0 or INT32_MAX
        if not (lat or lon) or abs(lat) > LATITUDE_E7 or abs(lon) > LONGITUDE_E7:
            return
        if not ALTITUDE_M[0] < altitude < ALTITUDE_M[1]:
            altitude = 0.0
        latitude, longitude = lat * 1e-7, lon * 1e-7
        if self._where != (latitude, longitude) or self._depth != -altitude:
            self._where, self._depth, self._evaluated_us = (latitude, longitude), -altitude, 0
        self._when_us = time_us
        self._watch_for_jumps(time_us)

    def _watch_for_jumps(self, time_us: int) -> None:
        """Compare the last position with the last one that was trusted."""
        assert self._where is not None
        if self._trusted is not None and not self._within_reach(
            self._trusted, (self._jumped_us or time_us) - self._trusted_us
        ):
            if not self._jumped_us:
                self._jumped_us = time_us
                self._notify("the position jumps farther than the vehicle can move")
            if time_us - self._jumped_us < SUSPECT_US:
                return
        self._trusted, self._trusted_us, self._jumped_us = self._where, time_us, 0

    def _within_reach(self, trusted: tuple[float, float], elapsed_us: int) -> bool:
        """Return True if the vehicle can have come from a position (deg) to the present one."""
        assert self._where is not None
        north, east = separation(*trusted, *self._where)
        return hypot(north, east) < MAX_JUMP_M + MAX_VEHICLE_SPEED_M_S * abs(elapsed_us) * 1e-6

    def main_field(self, time_us: int, utc_us: int) -> float:
        """Return the IGRF's total field in nT; NaN where position or date is not known, or no model holds.

        `time_us`, `utc_us`: µs of event time, and of UNIX time by the host's clock as it is set now.
        """
        if (
            self._where is None
            or self._jumped_us
            or utc_us < CLOCK_SET_US
            or abs(time_us - self._when_us) > MAX_POSITION_AGE_US
        ):
            return nan
        if abs(utc_us - self._evaluated_us) > FIELD_INTERVAL_US:
            self._evaluated_us = utc_us
            self._field = self._evaluate(utc_us)
        return self._field

    def direction(self, main_field: float, utc_us: int) -> tuple[float, float, float]:
        """Return the IGRF's vector near the position, nT, north-east-down.

        `main_field`: what :meth:`main_field` has returned; the vector is NaN where that is.
        """
        if isnan(main_field):
            return UNKNOWN_VECTOR
        if self._where is not self._vector_where or abs(utc_us - self._vector_us) > MAX_VECTOR_AGE_US:
            self._evaluate_vector(utc_us)
        return self._vector

    def _evaluate_vector(self, utc_us: int) -> None:
        """Compute the vector at the position, unless the vehicle is still near the last place of that."""
        assert self._where is not None
        self._vector_where = self._where
        (latitude, longitude), (last_latitude, last_longitude) = self._where, self._vector_at
        distance_deg = max(abs(latitude - last_latitude), abs(longitude - last_longitude))
        if distance_deg < MAX_VECTOR_DISTANCE_DEG and abs(utc_us - self._vector_us) <= MAX_VECTOR_AGE_US:
            return
        from magbridge.field.igrf import igrf  # noqa: PLC0415 - the field model is optional live

        north, east, down = igrf(longitude, latitude, self._depth, utc_us * 1e-6)[0].tolist()
        self._vector, self._vector_us, self._vector_at = (north, east, down), utc_us, self._where

    def _evaluate(self, utc_us: int) -> float:
        assert self._where is not None
        try:
            if self._model is None:
                from magbridge.field.igrf import NearbyField  # noqa: PLC0415 - the field model is optional live

                self._model = NearbyField()
            return self._model.field_and_slopes(*self._where, self._depth, utc_us * 1e-6)[0]
        except (ImportError, OSError, MagbridgeError) as error:  # OSError: no file handle is left
            self._notify(str(error))
            return nan
