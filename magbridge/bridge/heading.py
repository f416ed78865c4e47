"""The heading of the live bridge: the corrected vector, levelled by the autopilot's roll and pitch; NMEA."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import atan2, cos, degrees, hypot, inf, isfinite, nan, radians, sin, tan
from typing import Final

import numpy as np

from magbridge.align import Sample
from magbridge.bridge import events
from magbridge.bridge.links import open_link
from magbridge.bridge.port import Port
from magbridge.calibration.corrector import Corrector
from magbridge.calibration.heading import heading_of_sample, model_declination_sigma
from magbridge.calibration.model import Calibration
from magbridge.config import Config, HeadingOutput
from magbridge.errors import PortError
from magbridge.link.component import Component
from magbridge.link.estimates import HEADING_SENDERS, NO_ATTITUDE, Attitude, nmea_sentences
from magbridge.link.output import Rate
from magbridge.link.telemetry import EKF_STATUS, PX4_STATUS, is_contradicted, own_time, sent_us
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT
from magbridge.records import Corrected, Quality, Vector

__all__ = ["LiveHeading", "NmeaOutput", "nmea_port"]

ATTITUDE, HEARTBEAT = spec("ATTITUDE"), spec("HEARTBEAT").id
MAX_ATTITUDE_AGE_US: Final = 1_000_000
"""µs between a sample and the ATTITUDE that levels it; beyond, the heading is unknown."""
COVARIANCE_INTERVAL_US: Final = 200_000
"""µs for which the covariance of the vector is used again: it changes with attitude and masses, slowly."""
MAX_PITCH_RAD: Final = radians(89.0)
"""Largest pitch at which roll and heading are distinguished, rad."""
CONTRADICTED_TILT_RAD: Final = radians(10.0)
"""1-sigma of roll and pitch of an autopilot whose filter contradicts its sensors, rad."""
MAX_SENT_SIGMA_DEG: Final = 30.0
"""Largest sigma of a heading that is sent to the autopilot, deg."""
MAX_WAITING: Final = 8
"""Sentences that wait at most."""
NO_HEADING_FLAGS: Final = int(
    Quality.SATURATED | Quality.UNCALIBRATED | Quality.IMPLAUSIBLE | Quality.NO_BORESIGHT
)
"""Flags of samples whose heading is not sent to the autopilot or to NMEA receivers."""


class LiveHeading:
    """Compute the heading of each sample; send it to the autopilot and to NMEA receivers.

    `wanted`: ``[heading]`` of the configuration.
    `component`: the MAVLink side.
    `nmea`: sentences that are due; the bridge takes them out. A replay does not: the oldest are dropped.
    `stack`: MAV_AUTOPILOT of the autopilot; GENERIC before it is known.
    `is_sending`: the configuration names a receiver of headings.
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
        self._read_time = own_time(ATTITUDE)
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
        """Process an ATTITUDE, HEARTBEAT or report of the filter of the autopilot, received at `time_us`."""
        if message.id == HEARTBEAT:
            self.stack = message["autopilot"]
            return
        if message.id in (EKF_STATUS, PX4_STATUS):
            self._is_contradicted = is_contradicted(message)
            return
        clock = self._component.vehicle.clock
        self._attitude_us = sent_us(self._read_time, message.payload, time_us, clock)
        self._roll, self._pitch = message["roll"], message["pitch"]
        self._rates = message["rollspeed"], message["pitchspeed"], message["yawspeed"]

    def compute(
        self, sample: Sample, corrected: Corrected, corrector: Corrector, main: Vector, crustal: float
    ) -> Attitude:
        """Return the attitude at a sample, with its heading; unknown without a recent ATTITUDE.

        `sample`, `corrected`: as aligned, and as corrected.
        `corrector`: has just corrected the sample.
        `main`: nT, main field, north-east-down; NaN where unknown.
        `crustal`: nT, 1-sigma of the crustal field that the main-field model lacks.
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
        magnetic, true, sigma = heading_of_sample(
            corrected.field, roll, pitch, self._declination, self._covariance, self._turn,
            published if published < inf else inf, tilt_sigma_deg=degrees(tilt_sigma),
            declination_sigma_deg=self._declination_sigma,
        )  # fmt: skip
        return Attitude(magnetic, true, sigma, self._declination, roll, pitch, self._rates, tilt_sigma)

    def _tilt(self, elapsed: float, stated: float) -> tuple[float, float, float]:
        """Return roll, pitch and their standard deviation (rad), `elapsed` s after the last ATTITUDE.

        `stated`: rad, that of the ATTITUDE itself.

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
        """Compute the declination (deg) and its standard deviation when the main field has changed."""
        if self._main is main and self._crustal == crustal:
            return
        north, east, _ = main
        self._main, self._crustal = main, crustal
        self._declination = degrees(atan2(east, north))
        sigma = model_declination_sigma(np.array([hypot(north, east)]), crustal)
        self._declination_sigma = sigma.item()

    def send(self, attitude: Attitude, time_us: int, quality: int) -> None:
        """Send the heading of a sample if it is due and accurate; `time_us` is the sample's time."""
        if not attitude.is_known or quality & NO_HEADING_FLAGS or attitude.sigma > MAX_SENT_SIGMA_DEG:
            return
        utc_us = time_us + self._component.codec.utc_offset_us
        is_true = isfinite(attitude.heading)
        if self._send is not None and is_true and self._rate.due(time_us):
            self._send(self._component.outbox, attitude, max(utc_us, 0), self.stack)
        if self._nmea_rate.due(time_us):
            self.nmea.append(nmea_sentences(attitude, max(utc_us, 0)))


NMEA_RETRY_US = 1_000_000
"""µs between two attempts to open the port."""


def nmea_port(config: Config) -> Port | None:
    """Return the (unopened) port of ``[heading] nmea``, None without one.

    ConfigError: it is neither ``udp:HOST:PORT`` nor a serial device.
    """
    name = config.heading.nmea
    if name is None:
        return None
    url = f"udpout:{name.removeprefix('udp:')}" if name.startswith("udp:") else f"serial:{name}"
    return open_link(url, config.heading.nmea_baudrate, str(config.path), "heading.nmea")


class NmeaOutput:
    """Sends sentences on a port, which it opens again when it is lost.

    `notify`: receives a state frame when the port cannot be opened or is lost, once for each reason.
    """

    def __init__(self, port: Port, notify: Callable[[bytes], None]) -> None:
        self._port, self._notify = port, notify
        self._reported = ""
        self._retry_us = 0

    def send(self, sentences: deque[bytes], time_us: int) -> None:
        """Send the sentences and empty the queue; those that come while the port is down are dropped."""
        if not sentences:
            return
        data = b"".join(sentences)
        sentences.clear()
        try:
            if not self._port.is_open:
                if time_us < self._retry_us:
                    return
                self._retry_us = time_us + NMEA_RETRY_US
                self._port.open()
                self._reported = ""
            self._port.write(data)
            self._port.flush()
        except PortError as error:
            if error.reason != self._reported:
                self._reported = error.reason
                self._notify(events.notice(f"heading.nmea: {error.reason}"[:50]))

    def close(self) -> None:
        """Close the port."""
        self._port.close()
