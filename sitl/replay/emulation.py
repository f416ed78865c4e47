"""What two devices would have sent in a deployment: the events that a replay of it plays.

The emulated fluxgate takes its readings at the deployment's times and sends each when its last channel is
sampled; the emulated autopilot sends each row's telemetry just before.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import isfinite, nan

import numpy as np
import xarray as xr

from magbridge.bridge import events
from magbridge.bridge.events import Event
from magbridge.config import Config
from magbridge.field.geodesy import separation
from magbridge.mavlink.enums import MAG_PORT_NAME
from magbridge.records import Channel, Reading
from magbridge.sensors import open_driver
from sitl.fluxgate import Encoder, open_encoder
from sitl.replay.autopilot import Autopilot

__all__ = ["emulate", "start_us", "with_motion"]

LEAD_US = 2_000_000
"""µs before the first row at which the bridge starts."""
TELEMETRY_LEAD_US = 1_000
"""µs by which a row's telemetry comes before its reading."""
LINE_DELAY_US = 2_000
"""µs from a reading's last sample to its last byte."""


def start_us(deployment: xr.Dataset) -> int:
    """Return when the bridge starts, in µs since 1970 UTC: a little before the first row."""
    return _stamp(float(deployment["time"][0])) - LEAD_US


def emulate(deployment: xr.Dataset, config: Config) -> Iterator[Event]:
    """Yield the events of a deployment with ``mag_x mag_y mag_z``, in order of time.

    The bridge's configuration states which instrument is emulated, and which messages carry the telemetry.

    Raises
    ------
    ConfigError
        The instrument cannot be emulated.
    """
    if config.navigation is not None:
        deployment = with_motion(deployment)
    begin_us = start_us(deployment)
    autopilot = Autopilot(config, begin_us)
    times = deployment["time"].to_numpy().astype(float)
    fluxgate = open_encoder(config.sensor.driver, config.sensor.options, _rate(times), config.path)
    driver = open_driver(config.sensor.driver, config.sensor.options, config.path)
    answers = b"".join(fluxgate.feed(command) for command in driver.start())
    for port in (MAG_PORT_NAME.SENSOR, MAG_PORT_NAME.LINK):
        yield Event(begin_us, Channel.STATE, events.port_state(port))
    if answers:
        yield Event(begin_us, Channel.SENSOR, answers)
    last_us = begin_us
    for time_us, row in _rows(deployment):
        reported_us = max(last_us, time_us - TELEMETRY_LEAD_US & ~3)
        for beat_us, frame in autopilot.heartbeats(reported_us):
            yield Event(max(last_us, beat_us), Channel.LINK, frame)
        frames = autopilot.row(time_us, row)
        if frames:
            yield Event(reported_us, Channel.LINK, b"".join(frames))
        last_us = reported_us
        data, delay_us = _reading(fluxgate, (time_us - begin_us) * 1e-6, row, time_us)
        if data:
            last_us = max(reported_us, time_us + delay_us + LINE_DELAY_US & ~3)
            yield Event(last_us, Channel.SENSOR, data)


def _rows(deployment: xr.Dataset) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield each row as a dict, with its time in µs."""
    names = ["time", *(str(name) for name in deployment.data_vars)]
    columns = [deployment[name].to_numpy().astype(float).tolist() for name in names]
    for values in zip(*columns, strict=True):
        row = dict(zip(names, values, strict=True))
        yield _stamp(row["time"]), row


def _reading(fluxgate: Encoder, device_time: float, row: dict[str, float], time_us: int) -> tuple[bytes, int]:
    """Return the bytes of a row's reading, and the µs until its last channel is sampled."""
    x, y, z = row["mag_x"], row["mag_y"], row["mag_z"]
    if not isfinite(x + y + z):
        return b"", 0
    dx, dy, dz = (
        delay if isfinite(delay := row.get(f"mag_time_{axis}", nan) - time_us * 1e-6) else 0.0
        for axis in "xyz"
    )
    delays = (max(dx, 0.0), max(dy, 0.0), max(dz, 0.0))
    temperature = row.get("sensor_temperature", nan)
    reading = Reading((x, y, z), device_time=device_time, channel_delay=delays, temperature=temperature)
    data = fluxgate.encode(reading)
    return data, round(max(delays) * 1e6)


def _stamp(time: float) -> int:
    return round(time * 1e6) & ~3


def _rate(times: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    steps = [later - earlier for earlier, later in pairwise(times[:1000].tolist())]
    return 1.0 / float(np.median(steps)) if steps else 1.0


def with_motion(deployment: xr.Dataset) -> xr.Dataset:
    """Return the deployment with the columns that the autopilot sends to a navigator.

    These are ``gps_latitude gps_longitude`` (deg), the log's or its first position, and ``local_north
    local_east`` (m) of a track or a velocity. From a speed or a glide the bridge dead-reckons itself. The
    motions :data:`~magbridge.navigate.batch.MOTIONS` are tried in that order.

    Raises
    ------
    FormatError
        The log has no position to start from, or no motion.
    """
    from magbridge.navigate.batch import MOTIONS, first_position, motion_of  # noqa: PLC0415 - takes a second

    source = str(deployment.attrs.get("source", "deployment"))
    motion = motion_of(deployment, source)
    if "gps_latitude" not in deployment:
        for name, first in zip(("latitude", "longitude"), first_position(deployment, source), strict=True):
            fix = np.where(np.arange(deployment.sizes["time"]) == 0, first, np.nan)
            deployment = deployment.assign({f"gps_{name}": ("time", fix)})
    columns = [deployment[name].to_numpy().astype(float) for name in MOTIONS[motion]]
    if motion == "velocity":
        step = np.diff(deployment["time"].to_numpy().astype(float), prepend=np.nan)
        local = [np.nancumsum(step * (velocity + np.roll(velocity, 1)) / 2) for velocity in columns]
    elif motion in ("inertial", "position"):
        latitude, longitude = columns
        known = np.flatnonzero(np.isfinite(latitude + longitude))[0]
        local = list(separation(float(latitude[known]), float(longitude[known]), latitude, longitude))
    else:
        return deployment
    return deployment.assign(local_north=("time", local[0]), local_east=("time", local[1]))
