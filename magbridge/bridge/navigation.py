"""The navigator on the link: dead reckoning from the vehicle's telemetry in, fixes out."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, nan

import numpy as np

from magbridge.calibration.model import Calibration
from magbridge.config import Config
from magbridge.errors import ConfigError
from magbridge.field.geodesy import separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.read import read_grid
from magbridge.link.component import Component
from magbridge.link.fixes import FIXES, Fix, Kind
from magbridge.link.rates import Rate
from magbridge.mavlink import Message, spec
from magbridge.mavlink.dialect import MAV_SEVERITY
from magbridge.navigate import Navigator, Options, Record, State
from magbridge.navigate.depth import at_depth
from magbridge.navigate.options import informed
from magbridge.navigate.record import Reckoned
from magbridge.records import Corrected
from magbridge.toml import convert

__all__ = ["Navigation", "open_navigation"]

FIX_3D = 3
"""Lowest GPS_RAW_INT.fix_type whose position is used."""
UNKNOWN_SPEED = 0.0
"""VFR_HUD.airspeed of a vehicle that does not measure its speed through the water."""
WORDS = {
    State.OFF: "waiting for a first position",
    State.SEARCHING: "searching",
    State.TRACKING: "tracking",
    State.DEAD_RECKONING: "dead reckoning: no information in the field here",
    State.LOST: "lost: the field and the map disagree",
}


class Navigation:
    """Feeds the navigator, and sends its updates and fixes.

    Parameters
    ----------
    grid : AnomalyGrid
    options : Options
    fix : Kind
        Of :data:`~magbridge.link.fixes.FIXES`.
    component : Component
    """

    def __init__(self, grid: AnomalyGrid, options: Options, fix: Kind, component: Component) -> None:
        self.navigator = Navigator(grid, options)
        self._fix = fix
        if fix.rate > 0.0:
            now_us = component.codec.now_us
            component.timers.every("fix", round(1e6 / fix.rate), self._between, now_us)
        self._component = component
        self._rate: Rate = component.rates["MAG_NAVIGATION"]
        self._origin: tuple[float, float] | None = None
        self._state = State.OFF
        self._handlers: dict[int, Callable[[Message, int], Record | None]] = {
            spec("ATTITUDE").id: self._attitude,
            spec("GPS_RAW_INT").id: self._gps,
            spec("GLOBAL_POSITION_INT").id: self._depth,
            spec("LOCAL_POSITION_NED").id: self._local,
            spec("ODOMETRY").id: self._local,
            spec("VFR_HUD").id: self._speed,
        }

    def hear(self, message: Message, time_us: int) -> None:
        """Pass on the vehicle's motion, or its position at the surface, from a message to the navigator."""
        handler = self._handlers.get(message.id)
        if handler is not None:
            self._tell(handler(message, time_us))

    def sample(self, time_us: int, corrected: Corrected) -> None:
        """Take a corrected sample."""
        self.navigator.utc_offset_us = self._component.codec.utc_offset_us
        self._tell(self.navigator.sample(time_us, corrected))

    def _attitude(self, message: Message, time_us: int) -> None:
        self.navigator.telemetry(
            time_us, heading=degrees(message["yaw"]) % 360.0, pitch=degrees(message["pitch"])
        )

    def _depth(self, message: Message, time_us: int) -> None:
        # only the depth: the position is the autopilot's estimate, which contains our fixes
        self.navigator.telemetry(time_us, depth=-1e-3 * message["alt"])

    def _local(self, message: Message, time_us: int) -> None:
        self.navigator.telemetry(time_us, north=message["x"], east=message["y"], depth=message["z"])

    def _speed(self, message: Message, time_us: int) -> None:
        speed = message["airspeed"]
        self.navigator.telemetry(time_us, speed=speed if speed > UNKNOWN_SPEED else nan)

    def _gps(self, message: Message, time_us: int) -> Record | None:
        if message["fix_type"] < FIX_3D:
            return None
        latitude, longitude = message["lat"] * 1e-7, message["lon"] * 1e-7
        if self._origin is None:
            self._origin = latitude, longitude
        accuracy = message["h_acc"] * 1e-3
        return self.navigator.fix(time_us, latitude, longitude, accuracy if accuracy > 0.0 else None)

    def _tell(self, record: Record | None) -> None:
        """Send an update; and a fix, if it is valid and fixes have no rate of their own."""
        if record is None:
            return
        component = self._component
        if record.state is not self._state:
            self._state = record.state
            severity = MAV_SEVERITY.WARNING if record.state is State.LOST else MAV_SEVERITY.INFO
            component.announcer.state("navigation", f"navigation: {WORDS[record.state]}", severity)
        offset_us = component.codec.utc_offset_us
        if self._rate.due(record.time_us):
            component.outbox.send(
                "MAG_NAVIGATION",
                time_usec=record.time_us + offset_us,
                lat=round(record.latitude * 1e7),
                lon=round(record.longitude * 1e7),
                covariance_nn=record.covariance_nn,
                covariance_ne=record.covariance_ne,
                covariance_ee=record.covariance_ee,
                innovation=record.innovation,
                innovation_variance=record.innovation_variance,
                gate=record.gate,
                bias=record.bias,
                bias_sigma=record.bias_sigma,
                current_north=record.current_north,
                current_east=record.current_east,
                state=int(record.state),
                accepted=int(record.accepted),
            )
        if record.valid and self._fix.rate == 0.0:
            self._send(record)

    def _between(self, time_us: int) -> None:
        """Send the position dead-reckoned to `time_us` as a fix, if it is valid."""
        if (now := self.navigator.reckon(time_us)) is not None:
            self._send(now)

    def _send(self, at: Record | Reckoned) -> None:
        component = self._component
        origin = self._origin or (at.latitude, at.longitude)
        north, east = separation(*origin, at.latitude, at.longitude)
        fix = Fix(
            time_us=at.time_us + component.codec.utc_offset_us,
            age=(component.codec.now_us - at.time_us) * 1e-6,
            latitude=at.latitude,
            longitude=at.longitude,
            covariance_nn=at.covariance_nn,
            covariance_ne=at.covariance_ne,
            covariance_ee=at.covariance_ee,
            north=north,
            east=east,
            resets=len(self.navigator.estimate.jumps),
        )
        self._fix.send(component.outbox, fix, *component.peer)


def open_navigation(
    config: Config, component: Component, calibration: Calibration | None
) -> Navigation | None:
    """Return the navigation that a configuration asks for.

    Where the configuration sets neither ``noise`` nor ``bias_sigma``, both are taken from the calibration.

    Raises
    ------
    ConfigError
        A fix message or an option that does not exist.
    FormatError, OutOfRange
        The map cannot be read.
    """
    wanted = config.navigation
    if wanted is None:
        return None
    if wanted.fix not in FIXES:
        raise ConfigError(config.path, "navigation.fix", f"expected one of {', '.join(FIXES)}")
    options = convert(wanted.options, Options, config.path, "navigation.options.")
    if calibration is not None and not wanted.options.keys() & {"noise", "bias_sigma"}:
        options = informed(options, calibration, calibration.noise.sensor)
    kind = FIXES[wanted.fix]
    if wanted.rate is not None:
        kind = kind._replace(rate=wanted.rate)
    dives = np.linspace(0.0, wanted.depth)
    return Navigation(*at_depth(read_grid(config.resolve(wanted.map)), options, dives), kind, component)
