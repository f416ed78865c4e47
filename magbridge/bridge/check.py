"""Find all faults of a ``bridge.toml`` without opening a port."""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from magbridge.bridge.bus_port import sensor_port
from magbridge.bridge.learning import first_calibration, open_learner
from magbridge.bridge.links import LINKS, open_link
from magbridge.bridge.nmea import nmea_port
from magbridge.bridge.sensor_stream import open_correction, open_drivers, other_calibrations, unmet
from magbridge.calibration.model import Calibration
from magbridge.config import Config, Sensor, load, parse
from magbridge.errors import ConfigError, MagbridgeError
from magbridge.link.message_rates import check_publish
from magbridge.link.telemetry import TelemetryMap
from magbridge.mavlink import load_key
from magbridge.sensors import is_scalar, open_driver
from magbridge.toml import load_toml

__all__ = ["ConfigFault", "access", "findings"]

CALIBRATION_KEYS = ("calibration.file", "learning.prior")
MIN_FREE_BYTES = 100e6
"""Bytes that a log's disk should have."""


class ConfigFault(NamedTuple):
    """A fault of a configuration."""

    fatal: bool
    """The bridge would not start; otherwise it would start and wait, or run worse."""
    text: str
    """One line with the file, the key, and the expected value."""


def findings(path: Path) -> list[ConfigFault]:
    """Return all faults of a configuration; only the files that it names are opened.

    Parameters
    ----------
    path : Path
        The ``bridge.toml``.
    """
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
    """Yield the faults of a table; each faulty key is removed so that the next one is found."""
    while True:
        try:
            attempt()
        except ConfigError as error:
            yield error
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
    """Yield the faults of single values."""
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
    if config.link.signing_key and (key := config.resolve(config.link.signing_key)).exists():
        yield from _tried(lambda: load_key(key))
    for name, one in config.telemetry.items():
        yield from _tried(partial(TelemetryMap, {name: one}, config.link.autopilot, path))
    for name, rate in config.publish.items():
        yield from _tried(partial(check_publish, {name: rate}, path))
    if calibration is not None:
        yield from _parameters(config, calibration)
        if calibration.boresight is None and (config.heading.send or config.heading.nmea):
            text = f"{path}: heading: the calibration has no boresight: no heading is sent"
            yield ConfigFault(fatal=False, text=text)
    if config.navigation is not None:
        yield from _map(config, calibration)
    if (reference := names.get("learning.reference")) is None or config.resolve(reference).exists():
        yield from _tried(lambda: open_learner(config, calibration))
    yield from _log(config)


def _files(config: Config) -> Iterator[ConfigFault]:
    """Yield each missing file that the configuration names."""
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
    """Yield the faults of the sensors after the first: their calibrations, and what these need."""
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
        if used is None and not (is_scalar(driver) and sensor.sigma is not None):
            why = f"the calibration is of {own.sensor.name!r}" if own is not None else "no calibration"
            text = f"{config.path}: {sensor.key}: {why}: every sample would be uncalibrated"
            yield ConfigFault(fatal=False, text=text)


def _tried(attempt: Callable[[], object]) -> Iterator[ConfigFault]:
    try:
        attempt()
    except MagbridgeError as error:
        yield ConfigFault(fatal=True, text=str(error))


def _device(config: Config, key: str, name: str) -> Iterator[ConfigFault]:
    """Yield why a serial device could not be opened now."""
    if "://" in name or not name.startswith("/"):
        return
    there = sorted(glob.glob(name))  # noqa: PTH207 - it may be absolute, which pathlib does not glob
    if not there:
        yield ConfigFault(
            fatal=False, text=f"{config.path}: {key}: no {name} now: the bridge would wait for it"
        )
    for device in there:
        if reason := access(device):
            yield ConfigFault(fatal=False, text=f"{config.path}: {key}: {reason}")


def access(device: str) -> str:
    """Return why this user may not open a device, and the remedy; empty if the user may."""
    if os.access(device, os.R_OK | os.W_OK):
        return ""
    group = _group(device)
    hint = (
        f": it belongs to the group {group}: sudo usermod -aG {group} $USER, then log in again"
        if group
        else ""
    )
    return f"{device} may not be opened by this user{hint}"


def _group(device: str) -> str:
    try:
        return Path(device).group()
    except (OSError, KeyError, NotImplementedError):  # gone, without a name, or not on this system
        return ""


def _parameters(config: Config, calibration: Calibration) -> Iterator[ConfigFault]:
    """Yield each parameter that the calibration needs and the link would not provide."""
    if not calibration.sensor.may_be(config.sensor.driver):
        text = (
            f"{config.path}: sensor.driver: the calibration is of {calibration.sensor.name!r}: every sample "
        )
        yield ConfigFault(fatal=False, text=text + "would be uncalibrated")
        return
    for error in unmet(calibration, config):
        yield ConfigFault(fatal=True, text=str(error))
    key = "calibration.file" if config.calibration else "learning.prior"
    for doubt in calibration.warnings:
        yield ConfigFault(fatal=False, text=f"{config.path}: {key}: {doubt}")


def _map(config: Config, calibration: Calibration | None) -> Iterator[ConfigFault]:
    from magbridge.bridge.navigation import open_navigation  # noqa: PLC0415 - it brings filterpy

    assert config.navigation is not None
    try:
        open_navigation(config, config.navigation, calibration)
    except MagbridgeError as error:
        if isinstance(error, ConfigError) or config.resolve(config.navigation.map).exists():
            yield ConfigFault(fatal=True, text=str(error))


def _log(config: Config) -> Iterator[ConfigFault]:
    if config.log is None:
        yield ConfigFault(
            fatal=False, text=f"{config.path}: log: none is kept: nothing can be replayed or calibrated"
        )
        return
    folder = config.resolve(config.log.directory)
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    key = f"{config.path}: log.directory"
    if not there.is_dir():
        yield ConfigFault(fatal=False, text=f"{key}: {there} is a file")
    elif not os.access(there, os.W_OK):
        yield ConfigFault(fatal=False, text=f"{key}: {there} cannot be written to")
    elif (free := shutil.disk_usage(there).free) < MIN_FREE_BYTES:
        yield ConfigFault(fatal=False, text=f"{key}: {free / 1e6:.0f} MB are free")
