"""Drivers of the instruments: parsers of received bytes, which never open a port.

Other packages add drivers by entry points in the group ``magbridge.sensors``. The name of the entry point is
the driver's name, its object a class like :class:`Driver`. A class that inherits from :class:`Driver` needs
only ``Options``, ``feed`` and the two counters. ``examples/driver`` is an example of a package with a driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any, ClassVar, Protocol

from magbridge.errors import ConfigError
from magbridge.plugins import load, plugins
from magbridge.records import Reading
from magbridge.toml import convert
from magbridge.wording import one_of

__all__ = ["DRIVERS", "Bus", "Driver", "driver_class", "is_scalar", "open_driver"]

DRIVERS: dict[str, tuple[str, str]] = {
    "ascii": ("magbridge.sensors.ascii", "Ascii"),
    "digitizer": ("magbridge.sensors.digitizer", "Digitizer"),
    "hmr2300": ("magbridge.sensors.hmr2300", "Hmr2300"),
    "rm3100": ("magbridge.sensors.rm3100", "Rm3100"),
    "twinleaf": ("magbridge.sensors.twinleaf", "Twinleaf"),
}
"""Name of each built-in driver -> its module and class; the module is imported when the driver is opened."""


class Driver(Protocol):
    """Interface of all drivers.

    :meth:`feed` gives the same readings and counts however the bytes are split into chunks. Every byte
    belongs to a reading or another message, is counted as skipped, or waits in a limited buffer for the rest
    of its frame.

    Attributes
    ----------
    Options : type
        A msgspec struct with the keys that ``[sensor.options]`` may have.
    range_nt : float
        Field at which a channel saturates, nT; infinite if unknown.
    nt_per_count : float
        Field of one count of ``Reading.counts``, nT; 0 if the instrument sends no counts.
    sequence_modulo : int
        Value at which ``Reading.sequence`` wraps to 0; 0 if it never wraps or does not exist.
    time_modulo : float
        Time at which ``Reading.device_time`` wraps to 0, s; 0 if it never wraps.
    period : float
        Nominal time between the readings of an instrument without a clock, s; 0 if unknown or irrelevant.
    is_scalar : bool
        True if the instrument measures only the total field F; its readings are (F, 0, 0).
    frames_bad : int
        Number of frames with a wrong length, checksum or content.
    """

    Options: ClassVar[Any]
    range_nt: float = inf
    nt_per_count: float = 0.0
    sequence_modulo: int = 0
    time_modulo: float = 0.0
    period: float = 0.0
    is_scalar: bool = False
    frames_bad: int = 0

    def __init__(self, options: Any) -> None: ...

    @property
    def bytes_skipped(self) -> int:
        """Number of bytes that belonged to no valid frame (delimiters are not counted)."""
        ...

    def start(self) -> tuple[bytes, ...]:
        """Reset the parser for a line that was just opened; return the commands that start the instrument.

        The first bytes may be in the middle of a frame. The caller sends the commands, if any, at intervals
        of at least 0.1 s.
        """
        return ()

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        ...


class Bus(Protocol):
    """Registers of a part on a bus; each method raises OSError if the part does not respond."""

    def read(self, register: int, count: int) -> bytes:
        """Return the bytes of `count` registers from `register` on."""
        ...

    def write(self, register: int, data: bytes) -> None:
        """Write `data` to the registers from `register` on."""
        ...


MEMBERS = (
    "range_nt", "nt_per_count", "sequence_modulo", "time_modulo", "period", "bytes_skipped", "frames_bad",
)  # fmt: skip
"""Attributes that an open driver must have in addition to its methods."""


def open_driver(
    name: str, options: Mapping[str, Any], source: str | Path = "bridge.toml", key: str = "sensor"
) -> Driver:
    """Return the driver called `name`, with its options checked.

    Parameters
    ----------
    name : str
        Name in :data:`DRIVERS`, or of an entry point of the group ``magbridge.sensors``.
    options : mapping
        Values of ``[sensor.options]``.
    source : path
        Path of the configuration, for the error.
    key : str
        Dotted key of the sensor's table, for the error.

    Raises
    ------
    ConfigError
        The driver does not exist or lacks a member, or an option is unknown, missing, of the wrong type or
        out of range.
    """
    driver: type[Driver] = driver_class(name, source, key)
    _check(name, driver, ("Options", "feed", "start"), source, key)
    opened = driver(convert(dict(options), driver.Options, source, f"{key}.options."))
    _check(name, opened, MEMBERS, source, key)
    return opened


def is_scalar(driver: Driver) -> bool:
    """Return True if the instrument measures only the total field; False if the driver does not state it."""
    return getattr(driver, "is_scalar", False)


def _check(name: str, driver: object, members: tuple[str, ...], source: str | Path, key: str) -> None:
    """Raise :class:`ConfigError` if a driver (a class or an instance) lacks an attribute of `members`."""
    if lacking := [member for member in members if not hasattr(driver, member)]:
        raise ConfigError(source, f"{key}.driver", f"driver {name!r} lacks {', '.join(lacking)}")


def driver_class(name: str, source: str | Path, key: str = "sensor") -> Any:
    """Return the class of the driver called `name`; ConfigError: the driver does not exist."""
    if name in DRIVERS:
        module, attribute = DRIVERS[name]
        return getattr(import_module(module), attribute)
    others = plugins("magbridge.sensors")
    if name not in others:
        raise ConfigError(source, f"{key}.driver", one_of(name, sorted({*DRIVERS, *others})))
    return load(others[name])
