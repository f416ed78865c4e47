"""Any field of any message as a parameter of the calibration; messages with impossible values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isnan, nan, pi
from pathlib import Path
from typing import Any, Final

from magbridge.config import Telemetry
from magbridge.errors import ConfigError
from magbridge.link.clock import VehicleClock
from magbridge.mavlink import Message, Spec, by_id, spec
from magbridge.mavlink.messages import MESSAGE_IDS, Field, split_index
from magbridge.wording import suggestion

__all__ = ["TelemetryMap", "is_possible", "own_time", "sent_us"]

Value = tuple[str, float, int]
ReadTime = Callable[[bytes], tuple[int, int]]
YEAR_2001_US = 10**15
"""64-bit time beyond which it counts from 1970 and not from the boot, µs."""


class Extractor:
    """Extract one parameter from one kind of message."""

    __slots__ = ("field", "index", "match", "name", "offset", "scale", "texts")

    def __init__(self, name: str, quantity: Telemetry, layout: Spec, path: Path) -> None:
        key = f"telemetry.{name}"
        self.name, self.scale, self.offset = name, quantity.scale, quantity.offset
        field_name, self.index = split_index(quantity.field)
        self.field = find(layout, field_name, path, f"{key}.field")
        count = self.field.count
        if self.field.code == "s":
            raise ConfigError(path, f"{key}.field", f"a number, but {layout.name}.{field_name} is text")
        if (self.index is None) != (count == 0) or (count and not 0 <= (self.index or 0) < count):
            wanted = (
                f"{field_name}[0] to {field_name}[{count - 1}]" if count else f"{field_name} without an index"
            )
            raise ConfigError(path, f"{key}.field", f"{wanted}, not {quantity.field!r}")
        self.match: list[tuple[Field, float]] = []
        self.texts: list[tuple[int, bytes]] = []  # where they lie, and with the zero that ends them
        for one, value in quantity.match.items():
            field = find(layout, one, path, f"{key}.match.{one}")
            if isinstance(value, str) != (field.code == "s"):
                kind = "text" if field.code == "s" else "a number"
                raise ConfigError(path, f"{key}.match.{field.name}", f"{kind}, not {value!r}")
            if isinstance(value, str) and len(value.encode()) > field.struct.size:
                raise ConfigError(
                    path, f"{key}.match.{field.name}", f"at most {field.struct.size} bytes, not {value!r}"
                )
            if isinstance(value, str):
                self.texts.append((field.offset, (value.encode() + b"\0")[: field.struct.size]))
            else:
                self.match.append((field, value))

    def value(self, payload: bytes) -> float | None:
        """Return the value; NaN if the sender does not know it, None if the message does not match."""
        for offset, text in self.texts:
            if not payload.startswith(text, offset):
                return None
        for field, wanted in self.match:
            if field.get(payload) != wanted:
                return None
        raw = self.field.get(payload)
        if self.index is not None:
            raw = raw[self.index]
        return nan if raw == self.field.invalid else self.scale * raw + self.offset


def find(layout: Spec, name: str, path: Path, key: str) -> Field:
    """Return the field `name` of a message; the error for a name that it lacks lists those it has."""
    try:
        return layout.fields[name]
    except KeyError:
        hint = suggestion(name, layout.fields) or f"; it has {', '.join(layout.fields)}"
        raise ConfigError(path, key, f"{layout.name} has no field {name!r}{hint}") from None


class TelemetryMap:
    """Extract the configured parameters from messages, with the time of each value.

    Parameters
    ----------
    telemetry : mapping of str to Telemetry
        ``[telemetry.NAME]`` of the configuration.
    autopilot : int
        Component whose clock the ``VehicleClock`` knows.
    path : Path
        The configuration, for errors.

    Attributes
    ----------
    delays_us : dict of str to int
        Time in µs by which each parameter is late: to be subtracted from the time of its values.

    Raises
    ------
    ConfigError
        A message or field that does not exist.
    """

    def __init__(
        self, telemetry: Mapping[str, Telemetry], autopilot: int = 1, path: Path = Path("bridge.toml")
    ) -> None:
        self._autopilot = autopilot
        self.delays_us = {name: round(what.delay * 1e6) for name, what in telemetry.items()}
        self._by_id: dict[int, list[Extractor]] = {}
        self._times: dict[int, ReadTime | None] = {}
        for name, what in telemetry.items():
            try:
                layout = spec(what.message)
            except KeyError:
                hint = suggestion(what.message, MESSAGE_IDS)
                raise ConfigError(
                    path, f"telemetry.{name}.message", f"unknown MAVLink message {what.message!r}{hint}"
                ) from None
            self._by_id.setdefault(layout.id, []).append(Extractor(name, what, layout, path))
            self._times[layout.id] = own_time(layout)

    def values(self, message: Message, t_us: int, clock: VehicleClock) -> list[Value]:
        """Return ``(name, value, time in µs)`` of every parameter in `message`, received at `t_us`.

        The time is the message's own where it has one and the autopilot's clock is known, else `t_us`. A
        value that the sender marks as not known is NaN.
        """
        extractors = self._by_id.get(message.id)
        if extractors is None:
            return []
        found = []
        when_us = 0
        for one in extractors:
            value = one.value(message.payload)
            if value is not None:
                when_us = when_us or self._time(message, t_us, clock)
                found.append((one.name, value, when_us))
        return found

    def _time(self, message: Message, t_us: int, clock: VehicleClock) -> int:
        read = self._times[message.id]
        return t_us if message.component != self._autopilot else sent_us(read, message.payload, t_us, clock)


def sent_us(read: ReadTime | None, payload: bytes, t_us: int, clock: VehicleClock) -> int:
    """Return our time (µs) of the values in a payload of the autopilot that was received at `t_us`.

    It is the message's own time, which `read` (of :func:`own_time`) returns, where the autopilot's clock is
    known; else `t_us`.
    """
    if read is None or not clock.known:
        return t_us
    vehicle_us, wrap_us = read(payload)
    if vehicle_us <= 0 or vehicle_us > YEAR_2001_US:  # not filled in, or another clock than TIMESYNC's
        return t_us
    return clock.bridge_time(vehicle_us, t_us, wrap_us)


def own_time(layout: Spec) -> ReadTime | None:
    """Return a function that reads a message's own time and the µs after which it wraps, or None."""
    for name, unit_us in (("time_boot_ms", 1000), ("time_usec", 1)):
        field = layout.fields.get(name)
        if field is None:
            continue
        get: Callable[[bytes], Any] = field.get
        wrap_us = unit_us << 32 if field.code == "I" else 0
        return lambda payload: (get(payload) * unit_us, wrap_us)
    return None


MAX_ANGLE_RAD: Final = 2.0 * pi + 0.1
MAX_DISTANCE_M: Final = 4e7
"""The Earth's circumference, m."""
MAX_VALID_SPEED_M_S: Final = 1e4
LATITUDE_E7, LONGITUDE_E7 = 900_000_000, 1_800_000_000
"""1e-7 deg."""

REQUIRED: dict[int, dict[str, float]] = by_id(
    ATTITUDE={"roll": MAX_ANGLE_RAD, "pitch": MAX_ANGLE_RAD, "yaw": MAX_ANGLE_RAD},
    GLOBAL_POSITION_INT={"lat": LATITUDE_E7, "lon": LONGITUDE_E7},
    GPS_RAW_INT={"lat": LATITUDE_E7, "lon": LONGITUDE_E7},
    GPS_GLOBAL_ORIGIN={"latitude": LATITUDE_E7, "longitude": LONGITUDE_E7},
)
"""Fields that must be numbers, and their largest magnitudes."""
LIMITED: dict[int, dict[str, float]] = by_id(
    LOCAL_POSITION_NED={
        **dict.fromkeys(("x", "y", "z"), MAX_DISTANCE_M),
        **dict.fromkeys(("vx", "vy", "vz"), MAX_VALID_SPEED_M_S),
    },
    ODOMETRY={
        **dict.fromkeys(("x", "y", "z"), MAX_DISTANCE_M),
        **dict.fromkeys(("vx", "vy", "vz"), MAX_VALID_SPEED_M_S),
    },
    VFR_HUD={"airspeed": MAX_VALID_SPEED_M_S, "groundspeed": MAX_VALID_SPEED_M_S},
)
"""Fields that may be NaN, which means unknown, and their largest magnitudes."""
MAX_QUATERNION: Final = 1.1
ODOMETRY: Final = spec("ODOMETRY").id


def is_possible(message: Message) -> bool:
    """Return False if a message has an infinite, a missing or an impossible value in a field that is used."""
    for name, largest in REQUIRED.get(message.id, {}).items():
        if not abs(message[name]) <= largest:  # also NaN
            return False
    limits = LIMITED.get(message.id)
    if limits is None:
        return True
    for name, largest in limits.items():
        value = message[name]
        if not (isnan(value) or abs(value) <= largest):
            return False
    if message.id == ODOMETRY:
        return all(isnan(part) or abs(part) <= MAX_QUATERNION for part in message["q"])
    return True
