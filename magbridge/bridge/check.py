"""Checks of a ``bridge.toml``, by its contents and by the messages that arrive on its ports."""

from __future__ import annotations

import glob
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import deepcopy
from functools import partial
from math import isnan
from pathlib import Path
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from magbridge.bridge.devices import sensor_port
from magbridge.bridge.events import Event, HostClock, LiveEdge
from magbridge.bridge.learning import CALIBRATION_KEYS, first_calibration, open_learner
from magbridge.bridge.links import LINKS, nmea_port, open_link
from magbridge.bridge.pipeline import Pipeline, drive
from magbridge.bridge.port import cut
from magbridge.bridge.run import Keeper, leave_wrong_devices, ports
from magbridge.bridge.sensor import needed_units, open_correction, open_drivers, other_calibrations, unmet
from magbridge.calibration.model import Calibration
from magbridge.config import Config, HeadingOutput, Sensor, Telemetry, load, parse
from magbridge.errors import ConfigError, MagbridgeError
from magbridge.link.publish import check_publish
from magbridge.link.telemetry import MIN_RATE_FRACTION, TelemetryMap
from magbridge.link.vehicle import VehicleClock
from magbridge.mavlink import Codec, Message, load_key, spec
from magbridge.mavlink.enums import MAG_PORT_STATE, MAV_SEVERITY
from magbridge.mavlink.messages import MESSAGE_IDS
from magbridge.records import Channel
from magbridge.sensors import is_scalar, open_driver
from magbridge.toml import load_toml

__all__ = ["LISTEN_TIME_S", "ConfigFault", "LiveCheck", "access", "findings"]

MIN_FREE_BYTES = 100e6
"""Free space that the disk of the log should have, bytes."""


class ConfigFault(NamedTuple):
    """Fault of a configuration."""

    fatal: bool
    """True if the bridge would not start; False if it would wait, or run with less function."""
    text: str
    """One line with the file, the key, and the expected value."""


def warning(path: Path, key: str, text: str) -> ConfigFault:
    """Return a fault that does not prevent a start, at a dotted key of the configuration or at none."""
    return ConfigFault(fatal=False, text=": ".join(filter(None, (f"{path}", key, text))))


def findings(path: Path) -> list[ConfigFault]:
    """Return all faults of the ``bridge.toml`` at `path`; open the files that it names, but no ports."""
    try:
        table = load_toml(path)
    except ConfigError as error:
        return [ConfigFault(fatal=True, text=str(error))]
    left = deepcopy(table)
    found = [ConfigFault(fatal=True, text=str(error)) for error in _errors(left, lambda: parse(left, path))]
    try:
        config = parse(left, path)
    except ConfigError:  # without sensor or link nothing more can be checked
        pass
    else:
        found += dict.fromkeys(_contents(config))
    try:
        load(path)
    except ConfigError as error:
        if not any(one.fatal for one in found):
            found.append(ConfigFault(fatal=True, text=str(error)))
    return found


def _errors(table: dict[str, Any], attempt: Callable[[], object]) -> Iterator[ConfigError]:
    """Yield the errors of `attempt`; remove the faulty key from `table` before each further attempt."""
    removed = set[str]()
    while True:
        try:
            attempt()
        except ConfigError as error:
            if error.key in removed:  # it is required
                return
            yield error
            removed.add(error.key)
            if _remove_key(table, error.key):
                continue
        return


def _remove_key(table: dict[str, Any], key: str) -> bool:
    """Remove a dotted key from nested tables; return False if it does not exist."""
    first, _, rest = key.replace("[...]", "").partition(".")
    if rest and isinstance(table.get(first), dict):
        return _remove_key(table[first], rest)
    return table.pop(first, None) is not None


def _contents(config: Config) -> Iterator[ConfigFault]:
    """Yield the faults of a configuration that was parsed: of its files, ports, messages and parameters."""
    path = config.path
    yield from _files(config)
    calibration = None
    names = config.files
    if all(config.resolve(name).exists() for key in CALIBRATION_KEYS if (name := names.get(key)) is not None):
        try:
            calibration = first_calibration(config)
        except MagbridgeError as error:
            yield ConfigFault(fatal=True, text=str(error))
    faults = [fault for sensor in config.sensors for fault in _driver(config, sensor)]
    yield from faults
    for sensor in config.sensors:
        yield from _tried(partial(sensor_port, sensor, path))
        yield from _device(config, f"{sensor.key}.port", sensor.port)
    if not faults:
        yield from _other_sensors(config, calibration)
    yield from _tried(lambda: open_link(config.link.url, config.link.baudrate, str(path)))
    if config.link.url.partition(":")[0] not in LINKS:
        yield from _device(config, "link.url", config.link.url.removeprefix("serial:"))
    yield from _tried(lambda: nmea_port(config))
    yield from _tried(lambda: ports(config))
    if config.link.signing_key and config.resolve(config.link.signing_key).exists():
        yield from _tried(lambda: config.read("link.signing_key", load_key))
    for name, one in config.telemetry.items():
        yield from _tried(partial(TelemetryMap, {name: one}, config.link.autopilot, path))
        yield from _unmatched(name, one, path)
    for name, rate in config.publish.items():
        yield from _tried(partial(check_publish, {name: rate}, path))
    if calibration is not None:
        yield from _parameters(config, calibration)
        if calibration.boresight is None and (config.heading.send or config.heading.nmea):
            yield warning(path, "heading", "the calibration has no boresight: no heading is sent")
    if config.navigation is not None:
        yield from _map(config, calibration)
    if (reference := names.get("learning.reference")) is None or config.resolve(reference).exists():
        yield from _tried(lambda: open_learner(config, calibration))
    yield from _log(config)


def _files(config: Config) -> Iterator[ConfigFault]:
    """Yield a fault for each file that the configuration names and that does not exist."""
    for key, name in config.files.items():
        if name is not None and not (file := config.resolve(name)).exists():
            yield ConfigFault(fatal=True, text=str(ConfigError(config.path, key, f"no such file: {file}")))


def _driver(config: Config, sensor: Sensor) -> Iterator[ConfigFault]:
    """Yield the faults of a sensor's driver and its options."""
    options = deepcopy(sensor.options)
    left: dict[str, Any] = {"options": options}
    for part in reversed(sensor.key.split(".")):
        left = {part: left}
    for error in _errors(left, lambda: open_driver(sensor.driver, options, config.path, sensor.key)):
        yield ConfigFault(fatal=True, text=str(error))


def _other_sensors(config: Config, main: Calibration | None) -> Iterator[ConfigFault]:
    """Yield the faults of the calibrations of the sensors after the first, whose calibration is `main`."""
    try:
        drivers, calibrations = open_drivers(config), other_calibrations(config)
    except MagbridgeError as error:
        if all(config.resolve(one.calibration).exists() for one in config.more_sensors if one.calibration):
            yield ConfigFault(fatal=True, text=str(error))
        return
    for sensor, driver in zip(config.more_sensors, drivers[1:], strict=True):
        own = calibrations.get(sensor.id or 0)
        try:
            _, used = open_correction(sensor, driver, config, own, main)
        except MagbridgeError as error:
            yield ConfigFault(fatal=True, text=str(error))
            continue
        if own is not None:
            yield from _unitless(own, config)
        if used is None and not (is_scalar(driver) and sensor.sigma is not None):
            why = f"the calibration is of {own.sensor.name!r}" if own is not None else "no calibration"
            yield warning(config.path, sensor.key, f"{why}: every sample would be uncalibrated")


def _tried(attempt: Callable[[], object]) -> Iterator[ConfigFault]:
    try:
        attempt()
    except MagbridgeError as error:
        yield ConfigFault(fatal=True, text=str(error))


def _device(config: Config, key: str, name: str) -> Iterator[ConfigFault]:
    """Yield the reasons why the serial device `name` of a `key` cannot be opened now, as faults."""
    if "://" in name or not name.startswith("/"):
        return
    there = sorted(glob.glob(name))  # noqa: PTH207 - it may be absolute, which pathlib does not glob
    if not there:
        yield warning(config.path, key, f"no {name} now: the bridge would wait for it")
    for device in there:
        if reason := access(device):
            yield warning(config.path, key, reason)


def access(device: str) -> str:
    """Return why this user may not open a device, and the remedy; empty if the user may open it."""
    if os.access(device, os.R_OK | os.W_OK):
        return ""
    hint = ""
    with suppress(OSError, KeyError, NotImplementedError):  # gone, without a name, or not on this system
        group = Path(device).group()
        hint = f": it belongs to the group {group}: sudo usermod -aG {group} $USER, then log in again"
    return f"{device} may not be opened by this user{hint}"


def _parameters(config: Config, calibration: Calibration) -> Iterator[ConfigFault]:
    """Yield a fault for each parameter that the link would not provide, and the calibration's warnings."""
    if not calibration.sensor.may_be(config.sensor.driver):
        text = f"the calibration is of {calibration.sensor.name!r}: every sample would be uncalibrated"
        yield warning(config.path, "sensor.driver", text)
        return
    for error in unmet(needed_units(calibration), config):
        yield ConfigFault(fatal=True, text=str(error))
    yield from _unitless(calibration, config)
    key = "calibration.file" if config.calibration else "learning.prior"
    for doubt in calibration.warnings:
        yield warning(config.path, key, doubt)


def _unitless(calibration: Calibration, config: Config) -> Iterator[ConfigFault]:
    """Yield a fault for each telemetry value without a unit that has one in the calibration."""
    scalars = {channel.name: channel.unit for scalar in calibration.sensors for channel in scalar.channels}
    for name, unit in (scalars | needed_units(calibration)).items():
        if unit and name in config.telemetry and not config.telemetry[name].unit:
            text = f"none: not compared with {unit!r}, the calibration's"
            yield warning(config.path, f"telemetry.{name}.unit", text)


def _unmatched(name: str, source: Telemetry, path: Path) -> Iterator[ConfigFault]:
    """Yield a fault if a parameter takes the values of all messages of a kind that states a name or index."""
    fields = spec(source.message).fields if source.message in MESSAGE_IDS else {}
    if not source.match and (key := next((key for key in ("name", "ind") if key in fields), "")):
        text = f"none: every {source.message} is used, with any {key}; add {key} = ..."
        yield warning(path, f"telemetry.{name}.match", text)


def _map(config: Config, calibration: Calibration | None) -> Iterator[ConfigFault]:
    from magbridge.bridge.navigation import open_navigation  # noqa: PLC0415 - where a map is used

    assert config.navigation is not None
    try:
        open_navigation(config, config.navigation, calibration)
    except MagbridgeError as error:
        if isinstance(error, ConfigError) or config.resolve(config.navigation.map).exists():
            yield ConfigFault(fatal=True, text=str(error))


def _log(config: Config) -> Iterator[ConfigFault]:
    if config.log is None:
        yield warning(config.path, "log", "none is kept: nothing can be replayed or calibrated")
        return
    folder = config.resolve(config.log.directory)
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not there.is_dir():
        yield warning(config.path, "log.directory", f"{there} is a file")
    elif not os.access(there, os.W_OK):
        yield warning(config.path, "log.directory", f"{there} cannot be written to")
    elif (free := shutil.disk_usage(there).free) < MIN_FREE_BYTES:
        yield warning(config.path, "log.directory", f"{free / 1e6:.0f} MB are free")


LISTEN_TIME_S = 20.0
"""Default time for which the ports are read, s."""
RATE_INTERVALS = 4
"""Number of equal intervals of a check over which rates are measured; requests follow the first interval."""
SENT: Final = frozenset(spec(name).id for name in ("HEARTBEAT", "TIMESYNC", "COMMAND_LONG"))
"""Ids of the messages that the check sends; a router forwards messages only to senders of heartbeats."""
SYSTEM_TIME: Final = spec("SYSTEM_TIME").id
MAX_MATCHES = 10
"""Number of values that a message of missing telemetry lists."""
ARDUPILOT_GROUPS: Final = {
    "ATTITUDE": "EXTRA1", "VFR_HUD": "EXTRA2", "EKF_STATUS_REPORT": "EXTRA3", "BATTERY_STATUS": "EXTRA3",
    "SYSTEM_TIME": "EXTRA3", "ESC_TELEMETRY_1_TO_4": "EXTRA3", "RPM": "EXTRA3", "SYS_STATUS": "EXT_STAT",
    "GPS_RAW_INT": "EXT_STAT", "GLOBAL_POSITION_INT": "POSITION", "LOCAL_POSITION_NED": "POSITION",
    "SERVO_OUTPUT_RAW": "RC_CHAN", "RAW_IMU": "RAW_SENS", "SCALED_PRESSURE": "RAW_SENS",
}  # fmt: skip
"""Message -> ArduPilot's group of stream rates (``ArduPlane/GCS_MAVLink_Plane.cpp``, ``STREAM_*_msgs``)."""
MAX_CLOCK_DIFFERENCE_S = 2.0
"""Difference of the host's clock from SYSTEM_TIME above which the check reports it, s."""
YEAR_2001_US = 10**15
"""Smallest SYSTEM_TIME that is a valid date, µs since 1970 UTC."""


class Arrived(NamedTuple):
    """Message that arrived during a check, or that the bridge needs."""

    name: str
    sender: str
    """System and component of the sender, such as ``1:1``."""
    rate_hz: float
    """Rate in the last quarter of the check, Hz; over the whole check if none arrived in this quarter."""
    needed_hz: float
    """Rate that the bridge needs, Hz; 0 if it does not need the message."""


class LiveCheck:
    """Check that opens the ports of a configuration for some seconds and counts the messages.

    The bridge's own pipeline reads the bytes. So the sensors are started and messages are requested as by
    ``run``. The check sends no sample and no fix, and writes no log.

    `config`: a configuration without fatal faults.
    `duration_s`: time for which the ports are read, s.
    `arrived`: messages that arrived or are needed, the needed messages first.
    `readings_hz`: rate of each sensor's readings, Hz, by the sensor's name.
    `faults`: one warning, with its remedy, for each missing message, reading or value.
    """

    def __init__(self, config: Config, duration_s: float) -> None:
        self.arrived: list[Arrived] = []
        self.readings_hz: dict[str, float] = {}
        self.faults: list[ConfigFault] = []
        own = self._link = config.link
        self._config, self._duration_us, self._begin_us = config, round(duration_s * 1e6), 0
        self._ear = Codec(0, 0)
        self._counts: Counter[tuple[int, int, int]] = Counter()
        self._late_counts: Counter[tuple[int, int, int]] = Counter()
        self._telemetry = TelemetryMap(config.telemetry, own.autopilot, config.path)
        self._values: Counter[str] = Counter()
        self._unknown_values: Counter[str] = Counter()
        self._arrived_matches = {name: set[str]() for name in config.telemetry}
        self._clock_difference_s = 0.0
        self._edge: LiveEdge | None = None

    def listen(self) -> None:
        """Read the ports for the duration of the check, then set the attributes with its results."""
        config = self._config
        keeper, clock = Keeper(config), HostClock()
        key = config.read("link.signing_key", load_key)
        start = keeper.start(clock.now_us())
        others = other_calibrations(config)
        config = replace(config, log=None, heading=HeadingOutput())
        pipeline = Pipeline(config, first_calibration(config), start, key, more=others)
        pipeline.component.streams.interval_us = self._duration_us // RATE_INTERVALS
        self._begin_us = start.time_us
        opened = ports(config)
        edge = self._edge = LiveEdge(opened, clock)
        keeper.save(pipeline)  # signing stamps are reserved on disk before the first frame uses one

        def finish_event(time_us: int) -> None:
            leave_wrong_devices(pipeline, opened)
            if time_us - self._begin_us > self._duration_us:
                edge.stop()

        try:
            drive(pipeline, self, None, finish_event)
        finally:
            keeper.save(pipeline, last=True)
            edge.close()
        self._compare(pipeline)

    def events(self, deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield the events of the ports; count the messages in the events of the link."""
        assert self._edge is not None
        for event in self._edge.events(deadline):
            if event.channel is Channel.LINK:
                self._receive(event)
            yield event

    def send(self, number: int, data: bytes) -> None:
        """Send `data` to the port `number` (MAG_PORT_NAME); to the link, send only the messages in `SENT`."""
        assert self._edge is not None
        if number == Channel.LINK:
            data = b"".join(frame for frame in cut(data) if int.from_bytes(frame[7:10], "little") in SENT)
        if data:
            self._edge.send(number, data)

    def credit(self, frames: list[bytes]) -> None:
        """Pass the frames that were signed with the key to the link, so that it replies to their senders."""
        assert self._edge is not None
        self._edge.credit(frames)

    def _receive(self, event: Event) -> None:
        """Count the messages and the telemetry values in an event of the link."""
        late = event.time_us - self._begin_us >= self._duration_us * (RATE_INTERVALS - 1) // RATE_INTERVALS
        for message in self._ear.parse(event.data, final=self._link.shared):
            if not message.known:
                continue
            key = message.system, message.component, message.id
            self._counts[key] += 1
            self._late_counts[key] += late
            if message.system == self._link.system:
                self._read(message, event.time_us)

    def _read(self, message: Message, time_us: int) -> None:
        """Use a message of the vehicle: compare SYSTEM_TIME with the host's clock, count telemetry values."""
        if message.id == SYSTEM_TIME and message["time_unix_usec"] > YEAR_2001_US:
            self._clock_difference_s = (time_us - message["time_unix_usec"]) * 1e-6
        for name, one in self._config.telemetry.items():
            if one.match and spec(message.id).name == one.message:
                fields = ", ".join(f"{field} = {message[field]!r}" for field in one.match)
                self._arrived_matches[name].add(fields)
        for name, value, _ in self._telemetry.values(message, time_us, VehicleClock()):
            if self._config.telemetry[name].component in (None, message.component):
                counts = self._unknown_values if isnan(value) else self._values
                counts[name] += 1

    def _rate(self, key: tuple[int, int, int]) -> float:
        """Return :attr:`Arrived.rate_hz` of a message, given by system, component and message id."""
        late_s = self._duration_us * 1e-6 / RATE_INTERVALS
        if late := self._late_counts[key]:
            return late / late_s
        return self._counts[key] / (late_s * RATE_INTERVALS)

    def _compare(self, pipeline: Pipeline) -> None:
        """List the messages that arrived, and add a fault for each missing message or value."""
        streams, system = pipeline.component.streams, self._link.system
        needed = {(system, *stream): streams.rate_of(stream) for stream in streams.needed}
        for key in sorted(needed.keys() | self._counts.keys(), key=lambda key: (key not in needed, key)):
            sender = f"{key[0]}:{key[1]}"
            self.arrived.append(Arrived(spec(key[2]).name, sender, self._rate(key), needed.get(key, 0.0)))
        said = pipeline.component.output.texts
        # a later text replaces an earlier one of its subject, such as "field: stale telemetry" at the start
        latest = {text.partition(": ")[0]: text for _, text in said}
        texts = [text for severity, text in said if severity <= MAV_SEVERITY.WARNING]
        texts = [text for text in texts if latest[text.partition(": ")[0]] == text]
        for text in dict.fromkeys(texts):
            if text not in streams.denied.values():
                self._warn("", text)
        for stream in pipeline.streams:
            self.readings_hz[stream.sensor.label] = stream.samples * 1e6 / self._duration_us
            if not stream.samples:
                remedy = "check power, cable, sensor.baudrate and sensor.options"
                if stream.state == MAG_PORT_STATE.LOST:
                    remedy = "the port is not open; the bridge would wait for it"
                text = f"no reading in {self._duration_us * 1e-6:.0f} s: {remedy}"
                self._warn(stream.sensor.key, f"{stream.sensor.driver}: {text}")
        heartbeat = system, self._link.autopilot, spec("HEARTBEAT").id
        if heartbeat not in self._counts:
            self._warn("link", self._no_autopilot())
            return
        for one in self.arrived:
            is_autopilot = one.sender == f"{system}:{self._link.autopilot}"
            # another component may send a message that the autopilot is expected to send
            rate_hz = max(one.rate_hz, streams.measured.get(one.name, 0.0)) if is_autopilot else one.rate_hz
            if rate_hz < MIN_RATE_FRACTION * one.needed_hz:
                denied = streams.denied.get(one.name, "")
                self._warn("link", _too_rare(one, denied, is_autopilot=is_autopilot))
        for name in self._config.telemetry:
            if not self._values[name]:
                self._warn(f"telemetry.{name}", self._no_value(name))
        if abs(self._clock_difference_s) > MAX_CLOCK_DIFFERENCE_S:
            text = f"the host's clock differs from SYSTEM_TIME by {self._clock_difference_s:+.0f} s"
            self._warn("link", f"{text}: set it by NTP or GPS")

    def _no_autopilot(self) -> str:
        """Return the text of the fault that no heartbeat of the autopilot arrived, with the remedy."""
        text = f"no HEARTBEAT of {self._link.system}:{self._link.autopilot}"
        senders = sorted({f"{system}:{component}" for system, component, _ in self._counts})
        if not senders:
            return f"{text} and no other message: check link.url, the baud rate and the autopilot's port"
        return f"{text}, but messages of {', '.join(senders)}: check link.system and link.autopilot"

    def _no_value(self, name: str) -> str:
        """Return why the telemetry parameter `name` has no value, and the remedy."""
        wanted = self._config.telemetry[name]
        if self._unknown_values[name]:
            return f"{wanted.message}.{wanted.field} is marked as not known by its sender"
        number = spec(wanted.message).id
        senders = [key[1] for key in self._counts if key[0] == self._link.system and key[2] == number]
        if not senders:
            return f"no {wanted.message} arrives: start its sender, or name another message"
        components = ", ".join(map(str, sorted(senders)))
        got = "; ".join(sorted(self._arrived_matches[name])[:MAX_MATCHES])
        text = f"{wanted.message} of component {components} does not match: check match and component"
        return f"{text}, got {got}" if got else text

    def _warn(self, key: str, text: str) -> None:
        self.faults.append(warning(self._config.path, key, text))


def _too_rare(arrived: Arrived, denied: str, *, is_autopilot: bool) -> str:
    """Return the text of the fault that a message arrives too rarely, with the remedy.

    `denied`: text of a rejected request of the message, or empty.
    """
    arrives = f"arrives at {arrived.rate_hz:.2g} Hz" if arrived.rate_hz else "does not arrive"
    why = f" ({denied})" if denied else ""
    remedy = f"request it of PX4 by `mavlink stream -s {arrived.name} -r {arrived.needed_hz:g}`"
    if not is_autopilot:
        remedy = f"set its rate in {arrived.sender}, or correct telemetry.*.component"
    elif group := ARDUPILOT_GROUPS.get(arrived.name):
        remedy = f"set SRn_{group} (MAVn_{group} since ArduPilot 4.7) to {arrived.needed_hz:g}, or {remedy}"
    return f"{arrived.name} {arrives} and is needed at {arrived.needed_hz:g} Hz{why}: {remedy}"
