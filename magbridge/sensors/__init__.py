"""Instruments: each driver a parser that never touches a port, all of them in one table.

Other packages add their own by an entry point in the group ``magbridge.sensors`` whose name is the driver's
and whose object is a class like :class:`Driver`; one that inherits from it needs no more than ``Options``,
``feed`` and the two counters. ``examples/driver`` is such a package.
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
"""Name: module and class; a module is imported when its driver is opened."""


class Driver(Protocol):
    """What every driver offers.

    Whole chunk or byte by byte, :meth:`feed` gives the same readings and the same counts; whatever the bytes
    are, they end up in a reading, in a message that is not a reading, in a counter, or, up to a bound, in the
    remainder that waits for more.

    Attributes
    ----------
    Options : type
        A msgspec struct: the keys that ``[sensor.options]`` may have.
    range_nt : float
        nT, at which a channel saturates; infinite where unknown.
    nt_per_count : float
        nT per count of ``Reading.counts``; 0 where the instrument sends no counts.
    sequence_modulo : int
        Where ``Reading.sequence`` wraps; 0: never, or there is none.
    time_modulo : float
        s, at which ``Reading.device_time`` wraps; 0 where it does not.
    period : float
        s, nominal, between the readings of an instrument without a clock; 0 where unknown or irrelevant.
    is_scalar : bool
        The instrument measures the total field F only: its readings are (F, 0, 0).
    """

    Options: ClassVar[Any]
    range_nt: float = inf
    nt_per_count: float = 0.0
    sequence_modulo: int = 0
    time_modulo: float = 0.0
    period: float = 0.0
    is_scalar: bool = False

    def __init__(self, options: Any) -> None: ...

    @property
    def bytes_skipped(self) -> int:
        """Bytes that belonged to no valid frame (delimiters are not counted)."""
        ...

    @property
    def frames_bad(self) -> int:
        """Frames with a wrong length, checksum or content."""
        ...

    def start(self) -> tuple[bytes, ...]:
        """Begin a line that has just been opened, perhaps in the middle of a frame.

        Return the commands to send to the instrument, at intervals of at least 0.1 s; maybe none.
        """
        return ()

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        ...


class Bus(Protocol):
    """Registers on a bus; each method raises OSError where the part does not answer."""

    def read(self, register: int, count: int) -> bytes:
        """Return `count` bytes from `register` on."""
        ...

    def write(self, register: int, data: bytes) -> None:
        """Write bytes from `register` on."""
        ...


MEMBERS = (
    "range_nt", "nt_per_count", "sequence_modulo", "time_modulo", "period", "bytes_skipped", "frames_bad",
)  # fmt: skip
"""What an open driver must have besides its methods."""


def open_driver(
    name: str, options: Mapping[str, Any], source: str | Path = "bridge.toml", key: str = "sensor"
) -> Driver:
    """Return the driver called `name`, with its options checked.

    Parameters
    ----------
    name : str
        From :data:`DRIVERS`, or an entry point of the group ``magbridge.sensors``.
    options : mapping
        As they stand in ``[sensor.options]``.
    source : path
        The file they stand in, for the error.
    key : str
        Dotted key of the sensor's table, for the error.

    Raises
    ------
    ConfigError
        No such driver, or one that lacks a member; an option that is unknown, missing, of the wrong type or
        out of range.
    """
    driver: type[Driver] = driver_class(name, source, key)
    _check(name, driver, ("Options", "feed", "start"), source, key)
    opened = driver(convert(dict(options), driver.Options, source, f"{key}.options."))
    _check(name, opened, MEMBERS, source, key)
    return opened


def is_scalar(driver: Driver) -> bool:
    """Return True if the instrument measures the total field F only; a driver need not say."""
    return getattr(driver, "is_scalar", False)


def _check(name: str, driver: object, members: tuple[str, ...], source: str | Path, key: str) -> None:
    """Raise :class:`ConfigError` where a driver, its class or an instance, lacks some of `members`."""
    if lacking := [member for member in members if not hasattr(driver, member)]:
        raise ConfigError(source, f"{key}.driver", f"driver {name!r} lacks {', '.join(lacking)}")


def driver_class(name: str, source: str | Path, key: str = "sensor") -> Any:
    """Return the class of the driver called `name`; ConfigError, naming `source`: there is none."""
    if name in DRIVERS:
        module, attribute = DRIVERS[name]
        return getattr(import_module(module), attribute)
    others = plugins("magbridge.sensors")
    if name not in others:
        raise ConfigError(source, f"{key}.driver", one_of(name, sorted({*DRIVERS, *others})))
    return load(others[name])
