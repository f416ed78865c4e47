"""Check the direction of the corrected vector against the main field, given the vehicle's attitude.

The total field does not show a wrong mounting, two exchanged axes or one of wrong sign. The direction does:
with the unit vector *d* that is down in body axes, ``sin I = b·d / |b|`` is the field's inclination, which
needs no heading; and the levelled vector's heading from magnetic north, ``m = atan2(-b·s, b·f)``, f and s
forward and starboard in the horizontal plane, gives the declination ``D = yaw - m``.

Roll and pitch come from gravity, and have errors of a degree or two: an inclination error above
:data:`INCLINED` is flagged. The heading of an autopilot may come from a compass near the same iron, or be
missing before a flight. If it and the vector differ by more than :data:`MAX_HEADING_ERROR`, one of them is
wrong, and the check cannot decide which. It reports the difference, and the vector's sigma includes it.
"""

from __future__ import annotations

from math import asin, atan2, cos, degrees, inf, isfinite, nan, pi, radians, remainder, sin, sqrt
from typing import Final

from magbridge.health.checks import Messages
from magbridge.records import Quality

INCLINED: Final = radians(10.0)
"""Five sigmas of 2 deg: attitude 1.5, boresight 1, main field 0.2 (Chulliat et al. 2020, table 14), crust."""
MAX_HEADING_ERROR: Final = radians(60.0)
"""Five sigmas of a compass that is off by 12 deg."""
MIN_HORIZONTAL_FRACTION: Final = 0.2
"""Share of the field that is horizontal, below which no heading is read from it."""
EVERY_US: Final = 1_000_000
"""Time from one check to the next, µs: a mounting does not change from sample to sample."""
MAX_DIRECTION_AGE_US: Final = 5_000_000
"""Age of an attitude, µs, up to which it is used."""
MIN_DIFFERING_CHECKS: Final = 8
"""Number of checks in a row that differ until it counts: a manoeuvre is over by then."""
LONG_US: Final = 3_600_000_000
"""Time for which a disagreement is remembered, µs: at some headings a reversed axis looks right."""
IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)


class DirectionCheck:
    """Check the vector at intervals; `flags` are the :class:`~magbridge.records.Quality` bits of the last."""

    def __init__(self, messages: Messages | None = None) -> None:
        self.flags = 0
        self._messages = messages or Messages()
        self.messages = self._messages.lines
        self._roll = self._pitch = self._yaw = nan
        self._attitude_us = -MAX_DIRECTION_AGE_US
        self._inclination = self._declination = nan
        self._next_us = 0
        self._tilted = self._turned = 0
        self._variance = 0.0
        self._until_us = self._tilted_until_us = 0

    def attitude(self, time_us: int, roll: float, pitch: float, yaw: float) -> None:
        """Set the vehicle's attitude, rad, of forward-starboard-down axes, yaw from true north."""
        if isfinite(roll + pitch + yaw):
            self._roll, self._pitch, self._yaw, self._attitude_us = roll, pitch, yaw, time_us

    def expect(self, north: float, east: float, downward: float) -> None:
        """Set the main field at the vehicle, any unit; NaN if it is not known."""
        self._inclination = atan2(downward, sqrt(north * north + east * east))
        self._declination = atan2(east, north)

    def check(self, time_us: int, x: float, y: float, z: float) -> float:
        """Judge a corrected vector: set :attr:`flags`, return the variance (nT²) to add to each component's.

        `time_us` is µs; `x`, `y` and `z` are nT, body axes.
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
        # horizontal share of the field: near the pole there is no heading
        level = min(cos(inclination), cos(self._inclination))
        self._judge(time_us, tilt, turn if level > MIN_HORIZONTAL_FRACTION else 0.0)
        if (
            self._tilted >= MIN_DIFFERING_CHECKS or self._turned >= MIN_DIFFERING_CHECKS
        ):  # the chord between both directions
            # chord between two unit vectors, from the differences in inclination and heading
            horizontal = 2.0 * level * sin(0.5 * turn)
            chord = field * field * (4.0 * sin(0.5 * tilt) ** 2 + horizontal * horizontal)
            self._variance, self._until_us = max(self._variance, chord), time_us + LONG_US
        elif time_us >= self._until_us:
            self._variance = 0.0
        return self._variance

    def _judge(self, time_us: int, tilt: float, turn: float) -> None:
        """Count the checks that differ, by `tilt` in inclination and by `turn` in heading, rad."""
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
