"""Check the direction of the corrected vector against the main field, given the vehicle's attitude.

The total field does not show a wrong mounting, two exchanged axes or an axis of wrong sign. The direction
does. With the corrected vector *b* and the unit vector *d* that points down, both in body axes, the
inclination I follows from ``sin I = b·d / |b|``. The unit vectors *f* and *s* point forward and starboard in
the horizontal plane. The heading from magnetic north, ``m = atan2(-b·s, b·f)``, gives the declination
``D = yaw - m``.

Roll and pitch come from gravity, and have errors of a degree or two: an inclination error above
:data:`INCLINED` is flagged. The heading of an autopilot may come from a compass near the same iron, or be
missing before a flight. If it and the vector differ by more than :data:`MAX_HEADING_ERROR`, one of them is
wrong, and the check cannot decide which. It reports the difference, and the vector's sigma includes it.
"""

from __future__ import annotations

from math import asin, atan2, cos, degrees, inf, isfinite, nan, pi, radians, remainder, sin, sqrt
from typing import Final

from magbridge.health.checks import Messages
from magbridge.records import NEVER, Quality

INCLINED: Final = radians(10.0)
"""Inclination error that is flagged, rad: five sigmas of 2 deg. The attitude has 1.5 deg, the boresight 1,
the main field 0.2 (error model of the World Magnetic Model 2025), the crustal field the rest."""
MAX_HEADING_ERROR: Final = radians(60.0)
"""Heading difference that is reported, rad: five sigmas of a compass with an error of 12 deg."""
MIN_HORIZONTAL_FRACTION: Final = 0.2
"""Smallest horizontal fraction of the field at which the check compares headings."""
EVERY_US: Final = 1_000_000
"""Interval between checks, µs: a mounting does not change from sample to sample."""
MAX_DIRECTION_AGE_US: Final = 5_000_000
"""Largest age of an attitude that a check uses, µs."""
MIN_DIFFERING_CHECKS: Final = 8
"""Number of consecutive differing checks that make a fault: a manoeuvre is over by then."""
LONG_US: Final = 3_600_000_000
"""Time for which a fault stays in force, µs: at some headings a reversed axis looks right."""
IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)


class DirectionCheck:
    """Periodic check of the corrected vector's direction.

    `flags` are the :class:`~magbridge.records.Quality` bits that the last check set.
    """

    def __init__(self, messages: Messages | None = None) -> None:
        self.flags = 0
        self._messages = messages or Messages()
        self.messages = self._messages.lines
        self._roll = self._pitch = self._yaw = nan
        self._attitude_us = NEVER
        self._inclination = self._declination = nan
        self._next_us = NEVER
        self._tilted = self._turned = 0
        self._variance = 0.0
        self._until_us = self._tilted_until_us = NEVER

    def attitude(self, time_us: int, roll: float, pitch: float, yaw: float) -> None:
        """Set the vehicle's attitude (rad, forward-starboard-down axes, yaw from true north)."""
        if isfinite(roll + pitch + yaw):
            self._roll, self._pitch, self._yaw, self._attitude_us = roll, pitch, yaw, time_us

    def expect(self, north: float, east: float, downward: float) -> None:
        """Set the components of the main field at the vehicle, in any unit; NaN if unknown."""
        self._inclination = atan2(downward, sqrt(north * north + east * east))
        self._declination = atan2(east, north)

    def check(self, time_us: int, x: float, y: float, z: float) -> float:
        """Check a corrected vector, set :attr:`flags`, and return the variance (nT²) to add on each axis.

        `time_us` is the time (µs); `x`, `y` and `z` are the vector in body axes (nT).
        """
        if time_us < self._next_us and self._next_us - time_us <= EVERY_US:
            return self._variance
        self._next_us = time_us + EVERY_US
        field = sqrt(x * x + y * y + z * z)
        known = abs(time_us - self._attitude_us) < MAX_DIRECTION_AGE_US
        if not known or not 0.0 < field < inf or self._inclination != self._inclination:
            return self._variance
        # level the vector by roll and pitch, without the heading
        cr, sr, cp, sp = cos(self._roll), sin(self._roll), cos(self._pitch), sin(self._pitch)
        down = min(max((-sp * x + sr * cp * y + cr * cp * z) / field, -1.0), 1.0)
        forward, starboard = cp * x + sr * sp * y + cr * sp * z, cr * y - sr * z
        # differences in inclination and heading from the main field
        inclination = asin(down)
        tilt = inclination - self._inclination
        turn = remainder(self._yaw + atan2(starboard, forward) - self._declination, 2.0 * pi)
        # horizontal share of the field: near the pole a heading does not exist
        level = min(cos(inclination), cos(self._inclination))
        self._judge(time_us, tilt, turn if level > MIN_HORIZONTAL_FRACTION else 0.0)
        if self._tilted >= MIN_DIFFERING_CHECKS or self._turned >= MIN_DIFFERING_CHECKS:
            # chord between two unit vectors, from the differences in inclination and heading
            horizontal = 2.0 * level * sin(0.5 * turn)
            chord = field * field * (4.0 * sin(0.5 * tilt) ** 2 + horizontal * horizontal)
            self._variance, self._until_us = max(self._variance, chord), time_us + LONG_US
        elif time_us >= self._until_us:
            self._variance = 0.0
        return self._variance

    def _judge(self, time_us: int, tilt: float, turn: float) -> None:
        """Count consecutive checks with a large inclination error `tilt` or heading error `turn`, rad.

        Report a fault after :data:`MIN_DIFFERING_CHECKS` of them; an inclination fault also sets the flags.
        """
        self._tilted = self._tilted + 1 if abs(tilt) > INCLINED else 0
        self._turned = self._turned + 1 if abs(turn) > MAX_HEADING_ERROR else 0
        if self._tilted >= MIN_DIFFERING_CHECKS:
            self._tilted_until_us = time_us + LONG_US
            text = f"inclination off by {degrees(tilt):+.0f} deg: axes or mounting wrong"
            self._messages.report("inclination", text)
        if self._turned >= MIN_DIFFERING_CHECKS:
            text = f"vector {degrees(turn):+.0f} deg off the heading: axes or compass wrong"
            self._messages.report("heading", text)
        self.flags = IMPLAUSIBLE if time_us < self._tilted_until_us else 0
