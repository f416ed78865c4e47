"""Position of the vehicle with the main field there, and heading of the vehicle for autopilot and NMEA."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import atan2, cos, degrees, hypot, inf, isfinite, isnan, nan, radians, sin, tan
from typing import Final

import numpy as np

from magbridge.align import Sample
from magbridge.calibration import heading
from magbridge.calibration.correct import Corrector
from magbridge.calibration.model import Calibration
from magbridge.config import HeadingOutput
from magbridge.errors import MagbridgeError
from magbridge.field.geodesy import separation
from magbridge.field.igrf import HeldField, igrf
from magbridge.link import telemetry
from magbridge.link.component import Component
from magbridge.link.estimates import HEADING_SENDERS, NO_ATTITUDE, Attitude, nmea_sentences
from magbridge.link.output import Rate
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT
from magbridge.records import Corrected, Vector

__all__ = ["CLOCK_SET_US", "LiveHeading", "Position"]

MAX_POSITION_AGE_US: Final = 60_000_000
"""Longest time for which a position is used, µs. In a minute a glider moves by 20 m, and the main field
changes by less than 0.1 nT."""
CLOCK_SET_US: Final = 10**15
"""Time in 2001, µs since 1970; if the host's clock is earlier, it was never set, and the date is unknown."""
FIELD_RETRY_US: Final = 1_000_000
"""Time after which the bridge tries again to compute the main field, µs."""
MAX_VECTOR_AGE_US: Final = 3_600_000_000
MAX_VECTOR_DISTANCE_DEG: Final = 0.01
"""Time (µs) and difference of latitude or longitude (deg) after which the bridge computes the main field's
vector again; over 1 km its direction changes by 0.01 deg."""
MAX_VEHICLE_SPEED_M_S: Final = 350.0
"""Speed that no vehicle with a fluxgate exceeds, m/s."""
MAX_JUMP_M: Final = 10_000.0
"""Step of the position, in excess of `MAX_VEHICLE_SPEED_M_S`, that is not a jump, m. A correction after long
dead reckoning is within it; over this distance the main field changes by at most 50 nT."""
SUSPECT_US: Final = 900_000_000
"""Time, µs, for which the vehicle must stay at a position beyond a jump before the bridge uses it."""
FIRST_US: Final = 60_000_000
"""Time after the first position in which a jump replaces the first positions, µs."""
ALTITUDE_M: Final = -15_000.0, 100_000.0
"""Lowest and highest altitude for which the main field is computed, m; other altitudes count as 0."""

UNKNOWN_VECTOR: Final = (nan, nan, nan)


class Position:
    """Last position of the vehicle, and the main field at this position.

    `notify`: called with the reason if the main field is unknown at a known position.
    """

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._where: tuple[float, float] | None = None
        self._depth, self._place = 0.0, (nan, nan, nan)
        self._when_us = self._failed_us = 0
        self._held = HeldField()
        self._vector = UNKNOWN_VECTOR
        self._vector_us, self._vector_at = 0, (nan, nan)
        self._vector_where: tuple[float, float] | None = None  # for which the vector was checked
        self._trusted: tuple[float, float] | None = None
        self._first_us = self._trusted_us = self._jumped_us = 0

    @property
    def place_and_depth(self) -> tuple[tuple[float, float] | None, float]:
        """Latitude and longitude (deg) of the last position, and its depth (m).

        None and NaN before the first position and after a jump.
        """
        if self._jumped_us or self._where is None:
            return None, nan
        return self._where, self._depth

    def update(self, message: Message, time_us: int) -> None:
        """Update the position with a GLOBAL_POSITION_INT of possible values, received at `time_us` (µs).

        An unknown position is ignored. After a jump that no vehicle's speed explains, main
        field and anomaly are unknown. They are known again when the vehicle is near the former track, or
        has stayed beyond the jump for :data:`SUSPECT_US`. In the first minute, the new position is used.
        """
        lat, lon, altitude = message["lat"], message["lon"], message["alt"] * 1e-3
        if telemetry.is_null_position(message):  # the autopilot does not know its position
            return
        if not ALTITUDE_M[0] < altitude < ALTITUDE_M[1]:
            altitude = 0.0
        latitude, longitude = lat * 1e-7, lon * 1e-7
        if self._where != (latitude, longitude) or self._depth != -altitude:
            self._where, self._depth, self._failed_us = (latitude, longitude), -altitude, 0
            self._place = latitude, longitude, -altitude
        self._when_us = time_us
        self._watch_for_jumps(time_us)

    def _watch_for_jumps(self, time_us: int) -> None:
        """Compare the last position with the last trusted position, and detect or end a jump."""
        assert self._where is not None
        elapsed = abs((self._jumped_us or time_us) - self._trusted_us) * 1e-6
        reach = MAX_JUMP_M + MAX_VEHICLE_SPEED_M_S * elapsed
        if self._trusted is not None and hypot(*separation(*self._trusted, *self._where)) >= reach:
            if not self._jumped_us and time_us - self._first_us < FIRST_US:
                self._first_us = time_us
            elif not self._jumped_us:
                self._jumped_us = time_us
                self._notify("the position jumps farther than the vehicle can move")
            if self._jumped_us and time_us - self._jumped_us < SUSPECT_US:
                return
        elif self._trusted is None:
            self._first_us = time_us
        self._trusted, self._trusted_us, self._jumped_us = self._where, time_us, 0

    def main_field(self, time_us: int, utc_us: int) -> float:
        """Return the IGRF's total field at the position, nT.

        It is NaN if position or date are unknown, or the model is not valid for them.

        `time_us`, `utc_us`: present event time, and UNIX time of the host's clock, µs.
        """
        if (
            self._where is None
            or self._jumped_us
            or utc_us < CLOCK_SET_US
            or abs(time_us - self._when_us) > MAX_POSITION_AGE_US
            or abs(utc_us - self._failed_us) <= FIELD_RETRY_US
        ):
            return nan
        try:
            return self._held.field_at(self._place, utc_us)
        except (OSError, MagbridgeError) as error:  # OSError: no file handle is left
            self._failed_us = utc_us
            self._notify(str(error))
            return nan

    def direction(self, main_field: float, utc_us: int) -> tuple[float, float, float]:
        """Return the IGRF's field vector near the position, nT, north-east-down.

        `main_field`: result of :meth:`main_field`; if it is NaN, the vector is NaN, too.
        `utc_us`: UNIX time, µs.
        """
        if isnan(main_field):
            return UNKNOWN_VECTOR
        if self._where is not self._vector_where or abs(utc_us - self._vector_us) > MAX_VECTOR_AGE_US:
            self._evaluate_vector(utc_us)
        return self._vector

    def _evaluate_vector(self, utc_us: int) -> None:
        """Compute the vector at the position, unless the position and time of the last vector are near."""
        assert self._where is not None
        self._vector_where = self._where
        (latitude, longitude), (last_latitude, last_longitude) = self._where, self._vector_at
        distance_deg = max(abs(latitude - last_latitude), abs(longitude - last_longitude))
        if distance_deg < MAX_VECTOR_DISTANCE_DEG and abs(utc_us - self._vector_us) <= MAX_VECTOR_AGE_US:
            return
        north, east, down = igrf(longitude, latitude, self._depth, utc_us * 1e-6)[0].tolist()
        self._vector, self._vector_us, self._vector_at = (north, east, down), utc_us, self._where


ATTITUDE, HEARTBEAT = spec("ATTITUDE"), spec("HEARTBEAT").id
MAX_ATTITUDE_AGE_US: Final = 1_000_000
"""Longest time between a sample and the ATTITUDE for its heading, µs; beyond, the heading is unknown."""
COVARIANCE_INTERVAL_US: Final = 200_000
"""Time for which a covariance of the vector is used, µs; it changes slowly with attitude and moving
masses."""
MAX_PITCH_RAD: Final = radians(89.0)
"""Largest pitch at which roll and heading are separable, rad."""
CONTRADICTED_TILT_RAD: Final = radians(10.0)
"""Standard deviation of roll and pitch from an autopilot whose filter contradicts its sensors, rad."""
MAX_SENT_SIGMA_DEG: Final = 30.0
"""Largest standard deviation of a heading that is sent to the autopilot or to NMEA receivers, deg."""
MAX_WAITING: Final = 8
"""Most sets of NMEA sentences that wait for the bridge to send them."""


class LiveHeading:
    """Computation of the heading of each sample, and sender of headings to autopilot and NMEA receivers.

    `wanted`: section ``[heading]`` of the configuration.
    `component`: the MAVLink component.
    `nmea`: NMEA sentences to send, which the bridge takes out; the oldest are dropped in a replay.
    `stack`: MAV_AUTOPILOT of the autopilot; GENERIC before it is known.
    `is_sending`: True if the configuration names a receiver of headings.
    """

    def __init__(self, wanted: HeadingOutput, component: Component) -> None:
        self.nmea: deque[bytes] = deque(maxlen=MAX_WAITING)
        self.stack = int(MAV_AUTOPILOT.GENERIC)
        self._component = component
        self._send = HEADING_SENDERS[wanted.send] if wanted.send is not None else None
        self._rate = Rate(wanted.rate)
        self._nmea_rate = Rate(wanted.nmea_rate if wanted.nmea is not None else -1.0)
        self.is_sending = wanted.send is not None or wanted.nmea is not None
        self._wanted_tilt_sigma = wanted.tilt_sigma
        self._is_contradicted = False
        self._read_time = telemetry.own_time(ATTITUDE)
        self._attitude_us = -(1 << 62)
        self._roll = self._pitch = 0.0
        self._rates = (0.0, 0.0, 0.0)
        self._covariance: tuple[float, ...] = ()
        self._turn: tuple[float, ...] = ()
        self._covariance_us = 0
        self._calibration: Calibration | None = None
        self._main: Vector | None = None
        self._crustal = nan
        self._declination = self._declination_sigma = nan

    def receive(self, message: Message, time_us: int) -> None:
        """Process an ATTITUDE, HEARTBEAT or filter report of the autopilot, received at `time_us` (µs)."""
        if message.id == HEARTBEAT:
            self.stack = message["autopilot"]
            return
        if message.id in (telemetry.EKF_STATUS, telemetry.PX4_STATUS):
            self._is_contradicted = telemetry.is_contradicted(message)
            return
        clock = self._component.vehicle.clock
        self._attitude_us = telemetry.sent_us(self._read_time, message.payload, time_us, clock)
        self._roll, self._pitch = message["roll"], message["pitch"]
        self._rates = message["rollspeed"], message["pitchspeed"], message["yawspeed"]

    def compute(
        self, sample: Sample, corrected: Corrected, corrector: Corrector, main: Vector, crustal: float
    ) -> Attitude:
        """Return the attitude at a sample, with its heading; `NO_ATTITUDE` without a recent ATTITUDE.

        `sample`, `corrected`: the sample, and its corrected field.
        `corrector`: the corrector, whose last sample is `sample`.
        `main`: main field, north-east-down, nT; NaN if unknown.
        `crustal`: standard deviation of the crustal field, which the main-field model lacks, nT.
        """
        boresight = corrector.calibration.boresight
        since_us = sample.time_us - self._attitude_us
        if boresight is None or abs(since_us) > MAX_ATTITUDE_AGE_US or not isfinite(corrected.total_field):
            return NO_ATTITUDE
        stated = self._wanted_tilt_sigma or boresight.tilt_sigma
        roll, pitch, tilt_sigma = self._tilt(since_us * 1e-6, radians(stated))
        if not abs(pitch) < MAX_PITCH_RAD:
            return NO_ATTITUDE
        self._decline(main, crustal)
        is_old = abs(sample.time_us - self._covariance_us) >= COVARIANCE_INTERVAL_US
        if is_old or corrector.calibration is not self._calibration:
            self._covariance = corrector.vector_covariance()
            self._turn = tuple(entry for row in boresight.covariance for entry in row)
            self._covariance_us, self._calibration = sample.time_us, corrector.calibration
        x, y, z = corrected.field_sigma
        published = x * x + y * y + z * z
        magnetic, true, sigma = heading.heading_of_sample(
            corrected.field, roll, pitch, self._declination, self._covariance, self._turn,
            published if published < inf else inf, tilt_sigma_deg=degrees(tilt_sigma),
            declination_sigma_deg=self._declination_sigma,
        )  # fmt: skip
        if isnan(magnetic):
            return NO_ATTITUDE
        if corrected.quality & heading.NO_HEADING_FLAGS:
            sigma = heading.UNIFORM_SIGMA_DEG
        return Attitude(magnetic, true, sigma, self._declination, roll, pitch, self._rates, tilt_sigma)

    def _tilt(self, elapsed: float, stated: float) -> tuple[float, float, float]:
        """Return roll, pitch and their standard deviation (rad), `elapsed` s after the last ATTITUDE.

        `stated`: standard deviation of roll and pitch at the ATTITUDE itself, rad.

        The body rates p, q, r give ``droll/dt = p + tan(pitch) (q sin(roll) + r cos(roll))`` and
        ``dpitch/dt = q cos(roll) - r sin(roll)``.
        """
        roll, pitch, (p, q, r) = self._roll, self._pitch, self._rates
        known = CONTRADICTED_TILT_RAD if self._is_contradicted else stated
        if not (isfinite(p + q + r) and abs(pitch) < MAX_PITCH_RAD):
            return roll, pitch, known
        roll_change = elapsed * (p + tan(pitch) * (q * sin(roll) + r * cos(roll)))
        pitch_change = elapsed * (q * cos(roll) - r * sin(roll))
        # half of the extrapolated change counts as its standard deviation
        sigma = hypot(known, 0.5 * max(abs(roll_change), abs(pitch_change)))
        return roll + roll_change, pitch + pitch_change, sigma

    def _decline(self, main: Vector, crustal: float) -> None:
        """Compute declination and its standard deviation (deg) again if the main field (nT) has changed."""
        if self._main is main and self._crustal == crustal:
            return
        north, east, _ = main
        self._main, self._crustal = main, crustal
        self._declination = degrees(atan2(east, north))
        sigma = heading.model_declination_sigma(np.array([hypot(north, east)]), crustal)
        self._declination_sigma = sigma.item()

    def send(self, attitude: Attitude, time_us: int) -> None:
        """Send the heading of a sample at `time_us` (µs) if it is due and accurate enough."""
        if attitude.sigma > MAX_SENT_SIGMA_DEG:
            return
        utc_us = time_us + self._component.codec.utc_offset_us
        is_true = isfinite(attitude.heading)
        if self._send is not None and is_true and self._rate.due(time_us):
            self._send(self._component.output, attitude, max(utc_us, 0), self.stack)
        if self._nmea_rate.due(time_us):
            self.nmea.append(nmea_sentences(attitude, max(utc_us, 0)))
