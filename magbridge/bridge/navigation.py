"""Navigation in the bridge: telemetry and samples for the navigator, and its fixes for the autopilot."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import cos, hypot, inf, radians, sin

import numpy as np

from magbridge.bridge.motion import FIX_3D, GPS_RAW, LONGEST_US, Autopilot, Motion, MotionSource
from magbridge.calibration.model import Calibration
from magbridge.config import Config
from magbridge.config import Navigation as Wanted
from magbridge.errors import ConfigError
from magbridge.field.geodesy import offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.read import read_grid
from magbridge.link.component import Component
from magbridge.link.estimates import FIX_MESSAGES, Fix, Kind, widened
from magbridge.link.output import Rate
from magbridge.link.telemetry import own_time, sent_us
from magbridge.mavlink import Message, by_id, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_CMD, MAV_RESULT, MAV_SEVERITY
from magbridge.navigate import NavigationOptions, NavigationState, Navigator, Record
from magbridge.navigate.gnss import UNSTATED_SIGMA_M, GnssMonitor, GnssReason, GnssState
from magbridge.navigate.options import at_depth, informed
from magbridge.navigate.record import Reckoned
from magbridge.records import Corrected
from magbridge.toml import convert
from magbridge.wording import one_of

__all__ = ["NavigationService", "open_navigation"]

SHORTEST_US = 5_000_000
"""Shortest time without a position after which GPS counts as lost, µs. The time is three GPS periods, at most
`LONGEST_US`."""
HELD_US = 60_000_000
"""Time of good GPS after which the autopilot's position is equal to the GPS position, µs."""
ASK_US = 5_000_000
"""Time between two requests for the origin of the local frame, µs."""
OVERRATED = "ArduPilot would claim to know it better: use EXTERNAL_POSITION_ESTIMATE"
ANSWER_PAUSE_US = 20_000_000
"""Shortest time between two reports that the autopilot starts or stops to accept fixes, µs."""
UNUSED_US = 45_000_000
"""Time for which the autopilot's position must differ from the fixes before the bridge reports it, µs."""
MIN_DIFFERENCE_M, DIFFERENCE_SIGMA = 40.0, 4.0
"""Tolerated difference of the autopilot's position from a fix: m, plus a multiple of the fix's sigma."""
PX4_KEEPS_CLAIM = 1, 16
"""Last version of PX4 in which EXTERNAL_POSITION_ESTIMATE replaces the autopilot's uncertainty. Later
versions fuse it (EKF/ekf.cpp, resetGlobalPosToExternalObservation, since December 2025)."""
UNANSWERED = 3
"""Number of commands in a row without a reply after which the bridge reports it."""
HINTS = {
    MAV_RESULT.FAILED: " (it still uses GPS, has no origin, or nothing measures its speed)",
    MAV_RESULT.TEMPORARILY_REJECTED: " (it does not dead-reckon)",
}
"""Result of a fix -> its meaning in the replies of ArduPilot (setLatLng) and PX4 (EKF2.cpp)."""


class Fixing:
    """Sender of fixes while the autopilot has no good GPS, and handler of the autopilot's replies.

    `kind`: message of the fixes, a value of :data:`~magbridge.link.estimates.FIX_MESSAGES`.
    `autopilot`: state of the autopilot; the caller has passed each message to it before.
    `gnss`: monitor of GPS; the caller has passed each GPS position to it before.
    `sent`: number of sent fixes.
    """

    def __init__(self, kind: Kind, component: Component, autopilot: Autopilot, gnss: GnssMonitor) -> None:
        self.sent = 0
        self._kind, self._component, self._autopilot = kind, component, autopilot
        self._output = component.output
        self._gnss = gnss
        # times (µs) of the last usable GPS position, and since when GPS is good; how long it counts as good
        self._gps_us = self._gps_since_us = -LONGEST_US
        self._gps_allowed_us = 0
        self._stack = int(MAV_AUTOPILOT.GENERIC)
        self._reported_unused = False
        self._last: Fix | None = None
        self._agreed_us = 0  # when the autopilot's position was last that of our fixes
        self._before_us: int | None = None
        self._waiting = 0
        self._result, self._report_us = -1, 0  # the answer that was reported; when another may be
        self._reboots = component.vehicle.reboots
        self._handlers = by_id(
            COMMAND_ACK=self._answer, GLOBAL_POSITION_INT=self._compare, GPS_RAW_INT=self._gps,
            HEARTBEAT=self._heartbeat,
        )  # fmt: skip
        if kind.local:
            self._output.every("origin", ASK_US, self._ask_origin, component.codec.now_us)

    @property
    def velocity_stays(self) -> bool:
        """True if a fix does not change the autopilot's velocity, as ArduPilot's setLatLng."""
        return not self._kind.fused and self._autopilot.stack != MAV_AUTOPILOT.PX4

    @property
    def is_fused(self) -> bool:
        """True if the autopilot fuses fixes with its own position: their covariance is then inflated."""
        version = self._autopilot.version
        replaced = version is not None and version <= PX4_KEEPS_CLAIM
        fused_by_px4 = self._autopilot.stack == MAV_AUTOPILOT.PX4 and not replaced
        return self._kind.fused or fused_by_px4

    def receive(self, message: Message, time_us: int) -> None:
        """Process a message of the autopilot, received at `time_us` (µs)."""
        if handler := self._handlers.get(message.id):
            handler(message, time_us)

    def send(self, reckoned: Reckoned | None, resets: int) -> bool:
        """Send a dead-reckoned position as a fix if the autopilot needs it; return True if a fix was sent.

        `reckoned`: the present position, or None if it is unknown.
        `resets`: number of jumps of the navigator's estimate.
        """
        now_us = self._component.codec.now_us
        fix = self._fix(reckoned, resets, now_us)
        if isinstance(fix, str):
            self._before_us = self._last = None
            self._report_none(fix)
            return False
        if self._last is None:
            self._agreed_us = now_us
        self._last = fix
        if self.is_fused:
            since_us = inf if self._before_us is None else now_us - self._before_us
            fix = widened(fix, since_us * 1e-6)
        self._before_us = now_us
        self._kind.send(self._component.output, fix, *self._component.peer)
        self.sent += 1
        rejected = self._gnss.state is GnssState.REJECTED and self._has_gps(now_us)
        text = f"fixes go to the autopilot: GPS is {'rejected' if rejected else 'lost'}"
        self._output.announce("fixes", text)
        if not self._kind.fused:
            self._waiting += 1
            if self._waiting > UNANSWERED:
                text = "the autopilot does not answer fixes"
                self._output.announce("answer", text, MAV_SEVERITY.WARNING)
        return True

    def _fix(self, reckoned: Reckoned | None, resets: int, now_us: int) -> Fix | str:
        """Return the fix for the position `reckoned`, or the reason why no fix shall be sent."""
        unwanted = self._unwanted(now_us)
        if unwanted or reckoned is None:
            return unwanted or "no valid position"
        pose = None
        if self._kind.local:
            pose = self._autopilot.pose(now_us, reckoned.latitude, reckoned.longitude)
        if isinstance(pose, str):
            return pose
        fix = Fix(
            time_us=now_us + self._component.codec.utc_offset_us,
            latitude=reckoned.latitude,
            longitude=reckoned.longitude,
            covariance_nn=reckoned.covariance_nn,
            covariance_ne=reckoned.covariance_ne,
            covariance_ee=reckoned.covariance_ee,
            altitude=self._autopilot.altitude(now_us),
            pose=pose,
            resets=resets,
        )
        if self._autopilot.stack == MAV_AUTOPILOT.ARDUPILOTMEGA and self._kind.overrated(fix):
            return OVERRATED
        return fix

    def _unwanted(self, now_us: int) -> str:
        """Return the reason why the autopilot does not need or accept a fix; empty if it needs a fix."""
        if (stack := self._autopilot.stack) in self._kind.refused_by:
            return self._kind.refused_by[stack]
        if self.has_good_gps(now_us):
            return "GPS is good"
        suspect = self._gnss.state is GnssState.SUSPECT and self._has_gps(now_us)
        return "GPS is suspect" if suspect else ""

    def _answer(self, message: Message, time_us: int) -> None:
        if message["command"] != MAV_CMD.EXTERNAL_POSITION_ESTIMATE or not self.sent:
            return
        self._waiting, result = 0, message["result"]
        accepted = result == MAV_RESULT.ACCEPTED
        if time_us < self._report_us and result != self._result:
            return
        if result != self._result:
            self._result, self._report_us = result, time_us + ANSWER_PAUSE_US
        if accepted:
            self._output.announce("answer", "the autopilot takes fixes")
            return
        known = result in set(MAV_RESULT)
        name = MAV_RESULT(result).name if known else f"result {result}"
        text = f"the autopilot refuses fixes: {name}{HINTS.get(result, '')}"
        self._output.announce("answer", text, MAV_SEVERITY.WARNING)

    def _compare(self, message: Message, time_us: int) -> None:
        """Compare the autopilot's position with the last fix; report a difference that lasts `UNUSED_US`."""
        if self._last is None or self._before_us is None:
            return
        own = message["lat"] * 1e-7, message["lon"] * 1e-7
        distance = hypot(*separation(self._last.latitude, self._last.longitude, *own))
        if distance < MIN_DIFFERENCE_M + DIFFERENCE_SIGMA * self._last.sigma:
            self._agreed_us = time_us
            self._output.forget("use")
        elif time_us - self._agreed_us > UNUSED_US:
            text = f"the autopilot does not use the fixes: its position is {distance:.0f} m off"
            # report only once, although the distance in the text changes
            if not self._reported_unused:
                self._output.announce("use", text, MAV_SEVERITY.WARNING)
        self._reported_unused = distance >= MIN_DIFFERENCE_M and time_us - self._agreed_us > UNUSED_US

    def has_good_gps(self, time_us: int) -> bool:
        """Return True if the GPS has a recent usable position at `time_us` (µs)."""
        return time_us - self._gps_us < self._gps_allowed_us

    def gps_held(self, time_us: int) -> bool:
        """Return True if GPS has been good for `HELD_US`, so that the autopilot has adopted its position."""
        return self.has_good_gps(time_us) and time_us - self._gps_since_us > HELD_US

    def _has_gps(self, time_us: int) -> bool:
        """Return True if the GPS receiver has recently sent positions, even if the bridge rejects them."""
        return time_us - self._autopilot.position_us < LONGEST_US

    def _gps(self, message: Message, time_us: int) -> None:
        """Use a GPS_RAW_INT; the bridge may reject or suspect its position."""
        if message["fix_type"] < FIX_3D or self._gnss.state not in (GnssState.NONE, GnssState.GOOD):
            self._gps_allowed_us = 0
            return
        if not self.has_good_gps(time_us):
            self._gps_since_us = time_us
        self._gps_allowed_us = min(max(3 * (time_us - self._gps_us), SHORTEST_US), LONGEST_US)
        self._gps_us = time_us
        if self._before_us is not None:
            self._before_us = self._last = None
            self._report_none("GPS is good")

    def _heartbeat(self, message: Message, time_us: int) -> None:  # noqa: ARG002 - as the other handlers
        if self._stack != message["autopilot"] and self._autopilot.version is None:
            self._request("AUTOPILOT_VERSION")
        self._stack = message["autopilot"]

    def _ask_origin(self, time_us: int) -> None:  # noqa: ARG002 - a timer's action
        component = self._component
        if component.vehicle.reboots != self._reboots:
            self._reboots, self._autopilot.origin = component.vehicle.reboots, None
        if self._autopilot.origin is None:
            self._request("GPS_GLOBAL_ORIGIN")

    def _request(self, name: str) -> None:
        """Request one message `name` from the autopilot."""
        system, autopilot = self._component.peer
        self._output.send(
            "COMMAND_LONG",
            command=MAV_CMD.REQUEST_MESSAGE,
            param1=float(spec(name).id),
            target_system=system,
            target_component=autopilot,
        )

    def _report_none(self, reason: str) -> None:
        severity = MAV_SEVERITY.INFO if "GPS" in reason else MAV_SEVERITY.WARNING
        self._output.announce("fixes", f"no fixes to the autopilot: {reason}", severity)


INTEGRITY = spec("GNSS_INTEGRITY").id
GPS_AGE_S, GPS_AGE_SIGMA_S = 0.15, 0.1
"""Delay from the GPS measurement to the arrival of GPS_RAW_INT and its standard deviation, s. It is 0.1 to
0.2 s in the receiver (ArduPilot's and PX4's defaults), and up to 0.2 s until the autopilot sends the
message."""
MAX_GPS_DELAY_S = 10.0
"""Largest time by GPS_RAW_INT's own time stamp for which it waited, s; the clocks disagree beyond."""
UNKNOWN_VALUE = 65535
"""Value of GPS_RAW_INT.eph, .vel and .cog that means 'unknown'."""
STATE_TEXTS = {
    NavigationState.OFF: "waiting for a first position",
    NavigationState.SEARCHING: "searching",
    NavigationState.TRACKING: "tracking",
    NavigationState.DEAD_RECKONING: "dead reckoning: no information in the field here",
    NavigationState.LOST: "lost: the field contradicts the map, or the position is uncertain",
}

GPS_REASONS = {
    GnssReason.SPOOFING: "the receiver reports spoofing",
    GnssReason.JAMMING: "the receiver reports jamming",
    GnssReason.FROZEN: "its position stays the same while the vehicle moves",
    GnssReason.JUMP: "its position jumps",
    GnssReason.POSITION: "it differs from the navigator's position",
    GnssReason.FIELD: "the map does not describe the field at its position",
}

COPIED_FIELDS = (
    *("covariance_nn", "covariance_ne", "covariance_ee", "innovation", "innovation_variance", "gate"),
    *("bias", "bias_sigma", "current_north", "current_east"),
)
"""Fields of MAG_NAVIGATION with the same name as an attribute of :class:`Record`."""


class NavigationService:
    """Connection of a navigator to the link: passes inputs to it, and sends its updates and fixes.

    `grid`: map of the crustal anomaly.
    `options`: options of the navigator.
    `fix`: message of the fixes, a value of :data:`~magbridge.link.estimates.FIX_MESSAGES`.
    `component`: the MAVLink component that sends the messages.
    """

    def __init__(
        self, grid: AnomalyGrid, options: NavigationOptions, fix: Kind, component: Component
    ) -> None:
        self.navigator = Navigator(grid, options)
        self._component = component
        self._autopilot_id, self._autopilot = component.peer[1], Autopilot()
        self.fixing = Fixing(fix, component, self._autopilot, self.navigator.gnss)
        self.motion = Motion(self.navigator, component, self._autopilot, lambda: self.fixing.velocity_stays)
        self._gnss_state = GnssState.GOOD
        self._gps_time = own_time(spec("GPS_RAW_INT"))
        self._with_updates = fix.rate == 0.0
        if not self._with_updates:
            now_us = component.codec.now_us
            component.output.every("fix", round(1e6 / fix.rate), lambda _: self._send(), now_us)
        self._rate: Rate = component.rates["MAG_NAVIGATION"]
        self._state = NavigationState.OFF

    def receive(self, message: Message, time_us: int) -> None:
        """Pass the motion or GPS position in a message, received at `time_us` (µs), to the navigator."""
        if message.component == self._autopilot_id:
            self._autopilot.receive(message, time_us)
        if message.id == INTEGRITY:
            states = message["jamming_state"], message["spoofing_state"]
            self.navigator.gnss.receive_integrity(time_us, *states)
        elif message.id == GPS_RAW:
            self._gps(message, time_us)
        if message.component == self._autopilot_id:
            self.fixing.receive(message, time_us)
        self.motion.receive(message, time_us)
        if message.id == GPS_RAW and self._with_updates and not self.fixing.has_good_gps(time_us):
            self._send()  # the first fix does not wait for the next update

    def sample(self, time_us: int, corrected: Corrected) -> None:
        """Pass a corrected sample at `time_us` (µs) to the navigator, and send the resulting update."""
        self.navigator.utc_offset_us = utc_offset_us = self._component.codec.utc_offset_us
        self.motion.direct(time_us, corrected, time_us + utc_offset_us)
        self._notify(self.navigator.sample(time_us, corrected))

    def _gps(self, message: Message, time_us: int) -> None:
        if message["fix_type"] < FIX_3D or not (message["lat"] or message["lon"]):
            return
        latitude, longitude = message["lat"] * 1e-7, message["lon"] * 1e-7
        # without a stated accuracy (MAVLink 1 has no field for it), that of satellite positioning times HDOP
        hdop = message["eph"] * 0.01 if 0 < message["eph"] < UNKNOWN_VALUE else 1.0
        sigma = message["h_acc"] * 1e-3 or UNSTATED_SIGMA_M * max(hdop, 1.0)
        if UNKNOWN_VALUE not in (message["vel"], message["cog"]):
            # the vehicle has moved on since the receiver's measurement
            speed, course = message["vel"] * 1e-2, radians(message["cog"] * 1e-2)
            delay, delay_sigma = self._delay(message, time_us)
            moved = (GPS_AGE_S + delay) * speed
            latitude, longitude = offset(latitude, longitude, moved * cos(course), moved * sin(course))
            sigma = hypot(sigma, GPS_AGE_SIGMA_S * speed, delay_sigma * speed)
        self.motion.rise(time_us)
        self._notify(self.navigator.gnss_position(time_us, latitude, longitude, sigma))
        gnss = self.navigator.gnss
        if gnss.state is GnssState.GOOD and self.fixing.gps_held(time_us):
            self.motion.gps_held()
        self.motion.gps_trusted = gnss.state is GnssState.GOOD
        if gnss.state is not self._gnss_state:
            self._gnss_state = gnss.state
            text, severity = "GPS good", MAV_SEVERITY.INFO
            if gnss.state is not GnssState.GOOD:
                word = gnss.state.name.lower()
                text, severity = f"GPS {word}: {GPS_REASONS[gnss.reason]}", MAV_SEVERITY.WARNING
            self._component.output.announce("gps", text, severity)

    def _delay(self, message: Message, time_us: int) -> tuple[float, float]:
        """Return how long a GPS_RAW_INT received at `time_us` has waited, with 1-sigma, s; 0 if unknown."""
        clock = self._component.vehicle.clock
        delay = (time_us - sent_us(self._gps_time, message.payload, time_us, clock)) * 1e-6
        return (delay, clock.sigma) if clock.known and delay < MAX_GPS_DELAY_S else (0.0, 0.0)

    def _notify(self, record: Record | None) -> None:
        """Send an update of the navigator, if any; also send a fix if fixes have no rate of their own."""
        if record is None:
            return
        component = self._component
        if record.state is not self._state:
            self._state = record.state
            severity = MAV_SEVERITY.WARNING if record.state is NavigationState.LOST else MAV_SEVERITY.INFO
            component.output.announce("navigation", f"navigation: {STATE_TEXTS[record.state]}", severity)
        offset_us = component.codec.utc_offset_us
        if self._rate.due(record.time_us):
            component.output.send(
                "MAG_NAVIGATION",
                time_usec=record.time_us + offset_us,
                lat=round(record.latitude * 1e7),
                lon=round(record.longitude * 1e7),
                **{name: getattr(record, name) for name in COPIED_FIELDS},
                state=int(record.state),
                accepted=int(record.accepted),
                gps_state=int(self.navigator.gnss.state),
                gps_reason=int(self.navigator.gnss.reason),
            )
        if self._with_updates:
            self._send()

    def _send(self) -> None:
        """Send the position, dead-reckoned until now, as a fix."""
        if self._state is NavigationState.OFF:
            return
        moving = self.motion.source is not MotionSource.NONE
        now = self.navigator.reckon(self._component.codec.now_us) if moving else None
        if self.fixing.send(now, len(self.navigator.estimate.jumps)):
            self.motion.fixes_sent()


def open_navigation(
    config: Config, wanted: Wanted, calibration: Calibration | None
) -> Callable[[Component], NavigationService]:
    """Return a function that creates the navigation service for a MAVLink component.

    If `wanted`, the section ``[navigation]``, sets neither ``noise`` nor ``bias_sigma``, the calibration
    determines both.

    ConfigError: a fix message or an option does not exist, or the rate is too low for the receiver.
    FormatError, OutOfRange: the map cannot be read.
    """
    if wanted.fix not in FIX_MESSAGES:
        raise ConfigError(config.path, "navigation.fix", one_of(wanted.fix, FIX_MESSAGES))
    options = convert(wanted.options, NavigationOptions, config.path, "navigation.options.")
    if calibration is not None and not wanted.options.keys() & {"noise", "bias_sigma"}:
        options = informed(options, calibration, calibration.noise.sensor)
    kind = FIX_MESSAGES[wanted.fix]
    if wanted.rate is not None:
        if wanted.rate < kind.least:
            expected = f"expected at least {kind.least:g} Hz, or nothing, not {wanted.rate:g}"
            why = f"the autopilot drops slower {wanted.fix}"
            raise ConfigError(config.path, "navigation.rate", f"{expected}: {why}")
        kind = kind._replace(rate=wanted.rate)
    dives = np.linspace(0.0, wanted.depth)
    return partial(NavigationService, *at_depth(read_grid(config.resolve(wanted.map)), options, dives), kind)
