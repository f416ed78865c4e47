"""Extraction of the calibration's parameters from fields of messages, and requests for these messages."""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from math import isnan, nan, pi
from pathlib import Path
from typing import Any, Final

from magbridge.config import Telemetry
from magbridge.errors import ConfigError
from magbridge.link.output import Output
from magbridge.link.vehicle import VehicleClock
from magbridge.mavlink import Message, Source, Spec, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_CMD, MAV_RESULT, MAV_SEVERITY
from magbridge.mavlink.messages import MESSAGE_IDS, Field, split_index
from magbridge.records import NULL_POSITION_DEG
from magbridge.wording import suggestion

__all__ = [
    "AIRCRAFT", "EKF_STATUS", "MIN_RATE_FRACTION", "PX4_STATUS", "Stream", "StreamRequests",
    "TelemetryMap", "is_contradicted", "is_null_position", "is_possible", "needed_rates", "own_time",
    "sent_us",
]  # fmt: skip

Value = tuple[str, float, int]
ReadTime = Callable[[bytes], tuple[int, int]]
YEAR_2001_US = 10**15
"""Limit between times since boot and times since 1970 in a 64-bit field, µs."""


class Extractor:
    """Reader of one parameter from the payloads of one message type."""

    __slots__ = ("field", "index", "match", "name", "offset", "scale")

    def __init__(self, name: str, quantity: Telemetry, layout: Spec, path: Path) -> None:
        key = f"telemetry.{name}"
        self.name, self.scale, self.offset = name, quantity.scale, quantity.offset
        field_name, self.index = split_index(quantity.field)
        self.field = find(layout, field_name, path, f"{key}.field")
        count = self.field.count
        if self.field.code == "s":
            raise ConfigError(path, f"{key}.field", f"a number, but {layout.name}.{field_name} is text")
        if (self.index is None) != (count == 0) or (count and not 0 <= (self.index or 0) < count):
            place = f"[0] to {field_name}[{count - 1}]" if count else " without an index"
            raise ConfigError(path, f"{key}.field", f"{field_name}{place}, not {quantity.field!r}")
        self.match: list[tuple[Field, str | float]] = []
        for one, value in quantity.match.items():
            place = f"{key}.match.{one}"
            field = find(layout, one, path, place)
            if isinstance(value, str) != (field.code == "s"):
                kind = "text" if field.code == "s" else "a number"
                raise ConfigError(path, place, f"{kind}, not {value!r}")
            if isinstance(value, str) and len(value.encode()) > field.struct.size:
                raise ConfigError(path, place, f"at most {field.struct.size} bytes, not {value!r}")
            if not isinstance(value, str) and not can_be(field, value):
                raise ConfigError(path, place, f"a value that {layout.name}.{one} can have, not {value:g}")
            self.match.append((field, value))

    def value(self, payload: bytes) -> float | None:
        """Return the parameter's value; NaN if the field is marked as unknown, None if ``match`` fails."""
        for field, wanted in self.match:
            if field.get(payload) != wanted:
                return None
        raw = self.field.get(payload)
        if self.index is not None:
            raw = raw[self.index]
        return nan if raw == self.field.invalid else self.scale * raw + self.offset


def can_be(field: Field, value: float) -> bool:
    """Return True if a number can be the value of a field: not 300 in a uint8, not 0.1 in a float."""
    try:
        packed = field.struct.pack(value if field.code in "fd" else int(value))
    except (struct.error, ValueError, OverflowError):
        return False
    return bool(field.get(packed.rjust(field.offset + len(packed), b"\0")) == value)


def find(layout: Spec, name: str, path: Path, key: str) -> Field:
    """Return the field `name` of a message; ConfigError: the message has no such field."""
    try:
        return layout.fields[name]
    except KeyError:
        hint = suggestion(name, layout.fields) or f"; it has {', '.join(layout.fields)}"
        raise ConfigError(path, key, f"{layout.name} has no field {name!r}{hint}") from None


class TelemetryMap:
    """Reader of all configured parameters from messages, with the source and the time of each value.

    `telemetry`: sections ``[telemetry.NAME]`` of the configuration, by name.
    `autopilot`: id of the autopilot's component, whose clock the :class:`VehicleClock` estimates.
    `path`: path of the configuration, for errors.
    `delays_us`: delay of each parameter, µs, which the caller subtracts from the time of its values.
    ConfigError: a message or field that does not exist.
    """

    def __init__(
        self, telemetry: Mapping[str, Telemetry], autopilot: int = 1, path: Path = Path("bridge.toml")
    ) -> None:
        self._autopilot = autopilot
        self.delays_us = {name: round(what.delay * 1e6) for name, what in telemetry.items()}
        self._sources = {
            name: Source(autopilot, round(what.max_age * 1e6), what.component)
            for name, what in telemetry.items()
        }
        self._by_id: dict[int, list[Extractor]] = {}
        self._times: dict[int, ReadTime | None] = {}
        for name, what in telemetry.items():
            try:
                layout = spec(what.message)
            except KeyError:
                hint = suggestion(what.message, MESSAGE_IDS)
                unknown = f"unknown MAVLink message {what.message!r}{hint}"
                raise ConfigError(path, f"telemetry.{name}.message", unknown) from None
            self._by_id.setdefault(layout.id, []).append(Extractor(name, what, layout, path))
            self._times[layout.id] = own_time(layout)

    def values(self, message: Message, t_us: int, clock: VehicleClock) -> list[Value]:
        """Return ``(name, value, time in µs)`` of every parameter in `message`, received at `t_us` (µs).

        The time is the time stamp of an autopilot's message, if the autopilot's clock is known; else `t_us`.
        A value that the sender marks as unknown is NaN.
        """
        extractors = self._by_id.get(message.id)
        if extractors is None:
            return []
        found = []
        when_us = 0
        for one in extractors:
            value = one.value(message.payload)
            if value is not None:
                if not when_us:
                    read = self._times[message.id] if message.component == self._autopilot else None
                    when_us = sent_us(read, message.payload, t_us, clock)
                found.append((one.name, value, when_us))
        return found

    def admit(self, name: str, message: Message, time_us: int, output: Output) -> bool:
        """Return True if the sender of `message` is the source of the parameter `name` at `time_us` (µs).

        STATUSTEXTs report a second sender, and a change of the source.
        """
        source = self._sources[name]
        before = source.component
        if not source.admit(message.component, time_us):
            text = f"{name} also from {message.system}:{message.component}: not used"
            output.announce(f"source {name} {message.component}", text, MAV_SEVERITY.WARNING)
            return False
        if message.component != before and before is not None:
            text = f"{name} now from {message.system}:{message.component}, not {before}"
            output.announce(f"source {name}", text, MAV_SEVERITY.WARNING)
        return True


def sent_us(read: ReadTime | None, payload: bytes, t_us: int, clock: VehicleClock) -> int:
    """Return the time (µs, bridge clock) of the values in an autopilot's payload received at `t_us`.

    `read` (from :func:`own_time`) returns the message's time stamp. If the message has none, or the
    autopilot's clock is unknown, return `t_us`.
    """
    if read is None or not clock.known:
        return t_us
    vehicle_us, wrap_us = read(payload)
    if vehicle_us <= 0 or vehicle_us > YEAR_2001_US:  # not set, or a different clock from TIMESYNC's
        return t_us
    return clock.bridge_time(vehicle_us, t_us, wrap_us)


def own_time(layout: Spec) -> ReadTime | None:
    """Return a function that reads a payload's time stamp and its wrap (µs); None without time stamp."""
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
"""Largest magnitude of a coordinate, m: the Earth's circumference."""
MAX_VALID_SPEED_M_S: Final = 1e4
LATITUDE_E7, LONGITUDE_E7 = 900_000_000, 1_800_000_000
"""Largest magnitudes of latitude and longitude, 1e-7 deg."""

SPEED = dict.fromkeys(("vx", "vy", "vz"), MAX_VALID_SPEED_M_S)
DISTANCE_AND_SPEED = dict.fromkeys("xyz", MAX_DISTANCE_M) | SPEED
VALID_BY_NAME: Final[dict[str, dict[str, float]]] = {
    "ATTITUDE": dict.fromkeys(("roll", "pitch", "yaw"), MAX_ANGLE_RAD),
    "GLOBAL_POSITION_INT": {"lat": LATITUDE_E7, "lon": LONGITUDE_E7},
    "GPS_RAW_INT": {"lat": LATITUDE_E7, "lon": LONGITUDE_E7},
    "GPS_GLOBAL_ORIGIN": {"latitude": LATITUDE_E7, "longitude": LONGITUDE_E7},
    "LOCAL_POSITION_NED": DISTANCE_AND_SPEED,
    "ODOMETRY": DISTANCE_AND_SPEED,
    "VFR_HUD": dict.fromkeys(("airspeed", "groundspeed"), MAX_VALID_SPEED_M_S),
}
VALID_LIMITS: Final = {
    spec(name).id: [(spec(name).fields[field], largest) for field, largest in fields.items()]
    for name, fields in VALID_BY_NAME.items()
}
"""Message id -> fields with their largest valid magnitudes."""
MAX_QUATERNION: Final = 1.1
ATTITUDE, ODOMETRY = spec("ATTITUDE").id, spec("ODOMETRY").id


def is_possible(message: Message) -> bool:
    """Return False if a used field of a message is infinite, out of range, or NaN in an ATTITUDE."""
    may_be_unknown = message.id != ATTITUDE
    for field, largest in VALID_LIMITS.get(message.id, ()):
        value = field.get(message.payload)
        if not (abs(value) <= largest or (may_be_unknown and isnan(value))):
            return False
    if message.id == ODOMETRY:
        return all(isnan(part) or abs(part) <= MAX_QUATERNION for part in message["q"])
    return True


AIRCRAFT: Final = frozenset((1, 2, 3, 4, 13, 14, 15, 19, 20, 21, 22, 23, 24, 25, 29, 35))
"""Values of MAV_TYPE for fixed-wing and rotary-wing aircraft, which turn by tens of degrees a second."""
RATE_INTERVAL_US: Final = 10_000_000
"""Interval over which the bridge measures the rate of each message, µs."""
ANSWER_US: Final = 2_000_000
"""Time that the bridge waits for the reply to one request, µs."""
MIN_RATE_FRACTION: Final = 0.7
"""Fraction of the needed rate below which the bridge requests the needed rate. The bridge never lowers a
higher rate, which another client may have requested."""
MAX_ATTEMPTS: Final = 3
"""Most requests of one message between two reboots of the autopilot."""
UNREQUESTABLE: Final = frozenset(
    ("NAMED_VALUE_FLOAT", "NAMED_VALUE_INT", "DEBUG", "DEBUG_VECT", "DEBUG_FLOAT_ARRAY", "HEARTBEAT")
)
"""Messages whose rate the bridge does not request: several programs send them, each on its own schedule."""


Stream = tuple[int, int]
"""Id of the component that sends a message, and id of the message."""


def is_contradicted(status: Message) -> bool:
    """Return True if an EKF_STATUS_REPORT or ESTIMATOR_STATUS shows that the attitude is unreliable.

    The attitude is unreliable if an innovation of velocity, position or compass exceeds its limit. In a real
    ArduPlane with a jammed receiver, heading and tilt were then wrong by 20 to 40 deg.
    """
    return bool(max(status[name] for name in INNOVATION_RATIOS[status.id]) > 1.0)


def is_null_position(message: Message) -> bool:
    """Return True if a GLOBAL_POSITION_INT lies near 0, 0: the autopilot does not know its position."""
    return bool(max(abs(message["lat"]), abs(message["lon"])) < 1e7 * NULL_POSITION_DEG)


def needed_rates(
    autopilot: int, telemetry: Iterable[Telemetry] = (), *, attitude: bool, navigation: bool
) -> dict[Stream, tuple[float, float]]:
    """Return the needed rates (Hz) of each message: for an aircraft, and for any other vehicle.

    `autopilot`: component id of the autopilot.
    `telemetry`: sources of the calibration's parameters; the autopilot is expected to send a message whose
        source has no component.
    `attitude`: True if the bridge checks the direction of the field.
    `navigation`: True if the bridge navigates.
    """
    rates = {
        (one.component or autopilot, spec(one.message).id): (5.0, 2.0)
        for one in telemetry
        if one.message not in UNREQUESTABLE
    }
    names = {"GLOBAL_POSITION_INT": (2.0, 1.0)}
    if attitude or navigation:
        names["ATTITUDE"] = (10.0, 4.0)
    if navigation:
        names |= {"VFR_HUD": (5.0, 2.0), "GPS_RAW_INT": (2.0, 1.0), "EKF_STATUS_REPORT": (1.0, 1.0)}
        names["SYS_STATUS"] = (0.5, 0.5)  # states if the vehicle has an airspeed sensor
        names["EXTENDED_SYS_STATE"] = (1.0, 0.0)  # states if an aircraft is on the ground
        names["RAW_IMU"] = (1.0, 0.0)  # rates of the gyros without the autopilot's estimate of their bias
    for name, pair in names.items():
        stream = autopilot, spec(name).id
        rates[stream] = max(pair, rates.get(stream, pair))
    return rates


class StreamRequests:
    """Monitor of the rates of needed messages, which requests a message that arrives too rarely.

    If the autopilot does not send a message, but another component sends it at the needed rate, the bridge
    does not request it.

    `peer`: system id and component id of the autopilot.
    `rates`: needed rates from :func:`needed_rates`.
    `active`: False to measure rates without requests.
    """

    def __init__(
        self,
        peer: tuple[int, int],
        rates: Mapping[Stream, tuple[float, float]],
        output: Output,
        *,
        active: bool = True,
    ) -> None:
        self._active = active
        self._peer, self._output = peer, output
        self.needed = dict(rates)
        """Sender and message -> needed rates: on an aircraft, and on any other vehicle, Hz."""
        self._numbers = {number for _, number in self.needed}
        self._received: Counter[Stream] = Counter()
        self._attempts: Counter[Stream] = Counter()
        self._queue: deque[Stream] = deque()
        self._asked: Stream | None = None
        self._present = self._is_aircraft = False
        self.interval_us = RATE_INTERVAL_US
        """Interval over which rates are measured, µs."""
        self.measured: dict[str, float] = {}
        """Name of each needed message -> its rate in the last interval, Hz."""
        self.denied: dict[str, str] = {}
        """Name of each message whose sender rejected the request -> text of the STATUSTEXT about it."""

    def receive(self, message: Message, time_us: int) -> None:
        """Count a needed message, process a heartbeat of the autopilot, or handle the reply to a request."""
        autopilot = self._peer[1]
        if message.id == HEARTBEAT and message.component == autopilot:
            self._is_aircraft = message["type"] in AIRCRAFT
            ardupilot, px4 = (autopilot, EKF_STATUS), (autopilot, PX4_STATUS)
            if message["autopilot"] == MAV_AUTOPILOT.PX4 and ardupilot in self.needed:
                self.needed[px4] = self.needed.pop(ardupilot)
                self.needed.pop((autopilot, RAW_IMU), None)  # PX4 does not send it
                self._numbers.add(PX4_STATUS)
            if not self._present:
                self._present = True
                self._output.every("streams", self.interval_us, self._look, time_us + self.interval_us)
        elif message.id == ACK:
            is_asked = self._asked is not None and message.component == self._asked[0]
            if is_asked and message["command"] == MAV_CMD.SET_MESSAGE_INTERVAL:
                self._answered(message["result"])
        elif message.id in self._numbers:
            self._received[message.component, message.id] += 1

    def rebooted(self) -> None:
        """Clear counts and attempts after a reboot of the autopilot, which loses the requested rates."""
        self._attempts.clear()
        self._received.clear()
        self.denied.clear()

    def rate_of(self, stream: Stream) -> float:
        """Return the needed rate (Hz) of a message for the present type of vehicle."""
        return self.needed[stream][0 if self._is_aircraft else 1]

    def _look(self, _: int) -> None:
        """Queue requests for the messages that arrived too rarely since the last call."""
        largest: Counter[int] = Counter()  # message id -> largest count from an unexpected component
        for (component, number), count in self._received.items():
            if (component, number) not in self.needed:
                largest[number] = max(largest[number], count)
        for stream in self.needed:
            count = self._received[stream]
            if not count and stream[0] == self._peer[1]:
                count = largest[stream[1]]
            rate = count * 1e6 / self.interval_us
            self.measured[spec(stream[1]).name] = rate
            rare = self._active and rate < MIN_RATE_FRACTION * self.rate_of(stream)
            if rare and self._attempts[stream] < MAX_ATTEMPTS and stream not in self._queue:
                self._queue.append(stream)
        self._received.clear()
        if self._asked is None:
            self._ask_next()

    def _ask_next(self) -> None:
        """Send the next request; only one may be pending, because COMMAND_ACK does not name the message."""
        self._asked = None
        # a message needed only on aircraft has a rate of 0 once another MAV_TYPE is received
        while self._queue and not self.rate_of(self._queue[0]) > 0.0:
            self._queue.popleft()
        if not self._queue:
            return
        stream = self._asked = self._queue.popleft()
        self._attempts[stream] += 1
        self._output.send(
            "COMMAND_LONG",
            target_system=self._peer[0],
            target_component=stream[0],
            command=int(MAV_CMD.SET_MESSAGE_INTERVAL),
            param1=float(stream[1]),
            param2=1e6 / self.rate_of(stream),
        )
        deadline = self._output.codec.now_us + ANSWER_US
        self._output.run_once("stream request", deadline, lambda _: self._ask_next())

    def _answered(self, result: int) -> None:
        """Process the reply to the pending request: report a rejection, then send the next request."""
        assert self._asked is not None
        component, name = self._asked[0], spec(self._asked[1]).name
        if result not in (MAV_RESULT.ACCEPTED, MAV_RESULT.IN_PROGRESS):
            self._attempts[self._asked] = MAX_ATTEMPTS
            why = MAV_RESULT(result).name if result in MAV_RESULT.__members__.values() else str(result)
            sender = "the autopilot" if component == self._peer[1] else f"component {component}"
            text = f"{sender} does not send {name} at {self.rate_of(self._asked):g} Hz: {why}"
            self.denied[name] = text
            self._output.announce(f"stream {name}", text, MAV_SEVERITY.WARNING)
        self._output.cancel("stream request")
        self._ask_next()


HEARTBEAT: Final = spec("HEARTBEAT").id
EKF_STATUS, PX4_STATUS = spec("EKF_STATUS_REPORT").id, spec("ESTIMATOR_STATUS").id
"""Ids of the messages with the state of the autopilot's estimator: ArduPilot's and PX4's."""
RAW_IMU: Final = spec("RAW_IMU").id
INNOVATION_RATIOS: Final = {
    EKF_STATUS: ("velocity_variance", "pos_horiz_variance", "compass_variance"),
    PX4_STATUS: ("vel_ratio", "pos_horiz_ratio", "mag_ratio"),
}
"""Id of an estimator message -> its fields with ratios of innovations to their limits."""
ACK: Final = spec("COMMAND_ACK").id
