"""Where the vehicle says it is, and what the Earth's main field is there."""

from __future__ import annotations

from collections.abc import Callable
from math import isnan, nan
from typing import TYPE_CHECKING, ClassVar, Final

from magbridge.errors import MagbridgeError
from magbridge.mavlink import Message, spec

if TYPE_CHECKING:
    from magbridge.field.nearby import NearbyField

__all__ = ["CLOCK_SET_US", "Position"]

POSITION = spec("GLOBAL_POSITION_INT")
MAX_AGE_US: Final = 60_000_000
"""µs: a glider makes 20 m in a minute, over which the main field changes by less than 0.1 nT."""
CLOCK_SET_US: Final = 10**15
"""µs since 1970, in 2001: a host whose clock says less has none that was set, and the date is not known."""
REPEAT_US: Final = 1_000_000
"""µs after which the main field is computed anew."""


class Position:
    """The vehicle's last position; the field model is loaded when the first one comes.

    Parameters
    ----------
    notify : callable
        Takes the reason why there is no main field at a known position.

    Attributes
    ----------
    where : tuple of 2 float or None
        Latitude and longitude, deg, of the last position; None before the first.
    """

    MESSAGE: ClassVar[int] = POSITION.id

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self.where: tuple[float, float] | None = None
        self._depth = 0.0
        self._when_us = self._evaluated_us = 0
        self._field = nan
        self._vector = nan, nan, nan
        self._vector_us = 0
        self._model: NearbyField | None = None

    def update(self, message: Message, time_us: int) -> None:
        """Take a GLOBAL_POSITION_INT."""
        latitude, longitude, altitude = message["lat"] * 1e-7, message["lon"] * 1e-7, message["alt"] * 1e-3
        if latitude or longitude:  # an autopilot that does not know its position sends 0, 0
            if self.where != (latitude, longitude) or self._depth != -altitude:
                self.where, self._depth, self._evaluated_us = (latitude, longitude), -altitude, 0
            self._when_us = time_us

    def main_field(self, time_us: int, utc_us: int) -> float:
        """Return the IGRF's total field in nT; NaN where position or date is not known, or no model holds.

        Parameters
        ----------
        time_us, utc_us : int
            µs of event time, and of UNIX time by the host's clock as it is set now.
        """
        if self.where is None or utc_us < CLOCK_SET_US or abs(time_us - self._when_us) > MAX_AGE_US:
            return nan
        if abs(utc_us - self._evaluated_us) > REPEAT_US:
            self._evaluated_us = utc_us
            self._field = self._evaluate(utc_us)
        return self._field

    def direction(self, time_us: int, utc_us: int) -> tuple[float, float, float]:
        """Return the IGRF's vector in nT, north-east-down, of the last minute; NaN as :meth:`main_field`."""
        if isnan(self.main_field(time_us, utc_us)):
            return nan, nan, nan
        if abs(utc_us - self._vector_us) > MAX_AGE_US:
            from magbridge.field.igrf import igrf  # noqa: PLC0415 - the field model is optional live

            assert self.where is not None
            latitude, longitude = self.where
            north, east, down = igrf(longitude, latitude, self._depth, utc_us * 1e-6)[0].tolist()
            self._vector, self._vector_us = (north, east, down), utc_us
        return self._vector

    def _evaluate(self, utc_us: int) -> float:
        assert self.where is not None
        try:
            if self._model is None:
                from magbridge.field.nearby import NearbyField  # noqa: PLC0415 - the field model is optional live

                self._model = NearbyField()
            return self._model.at(*self.where, self._depth, utc_us * 1e-6)[0]
        except (ImportError, MagbridgeError) as error:
            self._notify(str(error))
            return nan
