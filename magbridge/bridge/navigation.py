"""The navigator on the link: dead reckoning from the vehicle's telemetry in, fixes out."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from magbridge.bridge.fixing import FIX_3D, Fixing
from magbridge.bridge.motion import Frame, Motion, MotionSource
from magbridge.calibration.model import Calibration
from magbridge.config import Config
from magbridge.config import Navigation as Wanted
from magbridge.errors import ConfigError
from magbridge.field.grid import AnomalyGrid
from magbridge.field.read import read_grid
from magbridge.link.component import Component
from magbridge.link.fixes import FIX_MESSAGES, Kind
from magbridge.link.output import Rate
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_SEVERITY
from magbridge.navigate import NavigationOptions, NavigationState, Navigator, Record
from magbridge.navigate.depth import at_depth
from magbridge.navigate.gnss import GnssReason, GnssState
from magbridge.navigate.options import informed
from magbridge.records import Corrected
from magbridge.toml import convert
from magbridge.wording import one_of

__all__ = ["NavigationService", "open_navigation"]

GPS, INTEGRITY = spec("GPS_RAW_INT").id, spec("GNSS_INTEGRITY").id
STATE_TEXTS = {
    NavigationState.OFF: "waiting for a first position",
    NavigationState.SEARCHING: "searching",
    NavigationState.TRACKING: "tracking",
    NavigationState.DEAD_RECKONING: "dead reckoning: no information in the field here",
    NavigationState.LOST: "lost: the field and the map disagree",
}

GPS_REASONS = {
    GnssReason.SPOOFING: "the receiver reports spoofing",
    GnssReason.JAMMING: "the receiver reports jamming",
    GnssReason.FROZEN: "its position stays the same while the vehicle moves",
    GnssReason.JUMP: "its position jumps",
    GnssReason.POSITION: "it differs from the navigator's position",
    GnssReason.DRIFT: "it drifts away from the navigator's position",
    GnssReason.FIELD: "the map does not describe the field at its position",
}

COPIED_FIELDS = (
    *("covariance_nn", "covariance_ne", "covariance_ee", "innovation", "innovation_variance", "gate"),
    *("bias", "bias_sigma", "current_north", "current_east"),
)
"""Fields of MAG_NAVIGATION that a record has under the same name."""


class NavigationService:
    """Feed the navigator, and send its updates and fixes.

    Parameters
    ----------
    grid : AnomalyGrid
    options : Options
    fix : Kind
        Of :data:`~magbridge.link.fixes.FIX_MESSAGES`.
    component : Component
    """

    def __init__(
        self, grid: AnomalyGrid, options: NavigationOptions, fix: Kind, component: Component
    ) -> None:
        self.navigator = Navigator(grid, options)
        self._component = component
        self._frame = Frame()
        self.fixing = Fixing(fix, component, self._frame, self.navigator.gnss)
        self.motion = Motion(self.navigator, component, self._frame, lambda: self.fixing.velocity_stays)
        self._gnss_state = GnssState.GOOD
        self._with_updates = fix.rate == 0.0
        if not self._with_updates:
            now_us = component.codec.now_us
            component.timers.every("fix", round(1e6 / fix.rate), lambda _: self._send(), now_us)
        self._rate: Rate = component.rates["MAG_NAVIGATION"]
        self._state = NavigationState.OFF

    def receive(self, message: Message, time_us: int) -> None:
        """Pass the vehicle's motion or surface position in a message to the navigator."""
        if message.id == INTEGRITY:
            states = message["jamming_state"], message["spoofing_state"]
            self.navigator.gnss.receive_integrity(time_us, *states)
        elif message.id == GPS:
            self._gps(message, time_us)
        if message.component == self._component.peer[1]:
            self._frame.receive(message, time_us)
            self.fixing.receive(message, time_us)
        self.motion.receive(message, time_us)
        if message.id == GPS and self._with_updates and not self.fixing.gps.good(time_us):
            self._send()  # the first fix does not wait for the next update

    def sample(self, time_us: int, corrected: Corrected) -> None:
        """Process a corrected sample."""
        self.navigator.utc_offset_us = self._component.codec.utc_offset_us
        self._notify(self.navigator.sample(time_us, corrected))

    def _gps(self, message: Message, time_us: int) -> None:
        if message["fix_type"] < FIX_3D or not (message["lat"] or message["lon"]):
            return
        latitude, longitude = message["lat"] * 1e-7, message["lon"] * 1e-7
        accuracy = message["h_acc"] * 1e-3
        sigma = accuracy if accuracy > 0.0 else None
        self._notify(self.navigator.gnss_position(time_us, latitude, longitude, sigma))
        gnss = self.navigator.gnss
        if gnss.state is GnssState.GOOD and self.fixing.gps.held(time_us):
            self.motion.gps_held()
        self.motion.gps_trusted = gnss.state is GnssState.GOOD
        if gnss.state is not self._gnss_state:
            self._gnss_state = gnss.state
            text, severity = "GPS good", MAV_SEVERITY.INFO
            if gnss.state is not GnssState.GOOD:
                word = gnss.state.name.lower()
                text, severity = f"GPS {word}: {GPS_REASONS[gnss.reason]}", MAV_SEVERITY.WARNING
            self._component.announcer.state("gps", text, severity)

    def _notify(self, record: Record | None) -> None:
        """Send an update; and a fix, if fixes have no rate of their own."""
        if record is None:
            return
        component = self._component
        if record.state is not self._state:
            self._state = record.state
            severity = MAV_SEVERITY.WARNING if record.state is NavigationState.LOST else MAV_SEVERITY.INFO
            component.announcer.state("navigation", f"navigation: {STATE_TEXTS[record.state]}", severity)
        offset_us = component.codec.utc_offset_us
        if self._rate.due(record.time_us):
            component.outbox.send(
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
    """Return a function that makes the navigation of a configuration for a component.

    Where the configuration sets neither ``noise`` nor ``bias_sigma``, both are taken from the calibration.

    ConfigError: a fix message or an option that does not exist, or a rate too low for the receiver.
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
            expected = (
                f"expected at least {kind.least:g} Hz, or nothing: the autopilot drops slower {wanted.fix}"
            )
            raise ConfigError(config.path, "navigation.rate", f"{expected}, not {wanted.rate:g}")
        kind = kind._replace(rate=wanted.rate)
    dives = np.linspace(0.0, wanted.depth)
    return partial(NavigationService, *at_depth(read_grid(config.resolve(wanted.map)), options, dives), kind)
