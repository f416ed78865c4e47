"""Update the state of one bridge from its messages, independently of port, clock and page."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from math import hypot, inf, isclose, isfinite, nan
from typing import Any, NamedTuple

from magbridge.mavlink import Message, by_id
from magbridge.mavlink.enums import MAG_NAVIGATION_STATE, MAV_PARAM_TYPE, MAV_SEVERITY
from magbridge.monitor.history import Alarms, Series, TrackPoint, Trail
from magbridge.records import Quality

FLAG_HOLD_TIME_S = 3.0
"""Time for which the page shows a flag after the last sample with the flag, s."""
REQUEST_RETRY_S = 1.5
"""Time after which an unanswered request is repeated, s."""
WAITING = "no answer yet"
MAX_SENSORS = 8
"""Largest number of sensors that are stored for a bridge."""
MIN_COMPARISON_TIME_S = 1.0
"""Largest time difference of two sensors' samples for a comparison, s; or two sample intervals, if longer."""
SAMPLES, PARAMETERS, TELEMETRY = 3000, 512, 12
"""Largest numbers of samples, parameters and telemetry series that are stored."""
LOCATED = {MAG_NAVIGATION_STATE.TRACKING, MAG_NAVIGATION_STATE.DEAD_RECKONING}
"""States of the position filter in which its position is valid."""
COMMAND_PARAMETERS = {"MB_LEARN_CMD"}
"""Parameters that are commands: the bridge resets them to 0 after it has executed the command."""
FIX_2D = 2
"""Lowest GPS_FIX_TYPE with a valid position."""
TEMPERATURE_SERIES = "Temperature, °C"
"""Name of the series with the fluxgate's temperature."""


class Text(NamedTuple):
    """STATUSTEXT of the bridge: time of reception (s, receiver's clock), MAV_SEVERITY, text."""

    time: float
    severity: int
    text: str


@dataclass
class RemoteParameter:
    """Parameter of the bridge, and the state of a request to change it.

    `value` is the last received value, `asked` the requested value (None without an open request), `when` the
    time at which the request was last sent (s), and `error` the reason why the value was not set.
    """

    index: int
    value: float
    asked: float | None = None
    when: float = -inf
    error: str = ""


@dataclass
class SensorState:
    """State of one sensor of a bridge: its last MAG_FIELD (`field`) and MAG_SENSOR (`report`), or empty."""

    number: int
    field: dict[str, Any] = dataclass_field(default_factory=dict)
    report: dict[str, Any] = dataclass_field(default_factory=dict)
    sampled: float = -inf
    interval: float = 0.0
    """`sampled`, `interval`: Time of the last MAG_FIELD, and from the one before (0 if none), s."""

    @property
    def label(self) -> str:
        """Name of the sensor in the configuration; its number before the first MAG_SENSOR."""
        return str(self.report.get("name", "")) or f"sensor {self.number}"

    def take(self, fields: dict[str, Any], now_s: float) -> None:
        """Store a MAG_FIELD received at `now_s`."""
        self.interval = now_s - self.sampled if self.field else 0.0
        self.field, self.sampled = fields, now_s

    def difference(self, first: SensorState) -> tuple[float, float]:
        """Return the total field minus the first sensor's, and 1-sigma, nT; NaN if not of one time."""
        if not (self.field and first.field):
            return nan, nan
        apart_s = abs(self.field["time_usec"] - first.field["time_usec"]) * 1e-6
        if apart_s > max(MIN_COMPARISON_TIME_S, 2.0 * max(self.interval, first.interval)):
            return nan, nan
        both = self.field, first.field
        own, other = (one["total_field"] for one in both)
        return own - other, hypot(*(one["total_field_sigma"] for one in both))


class BridgeState:
    """State of one bridge, from which the page is drawn.

    `bridge` is its MAVLink system and component; None before a bridge has been received. Times are s of the
    receiver's monotonic clock; -inf before the first message of a kind.
    """

    def __init__(self, bridge: tuple[int, int] | None = None, sequence: int = -1) -> None:
        self.bridge = bridge
        self.began = inf  # time of the first message
        # time of the last message, MAG_FIELD, MAG_STATUS and MAG_NAVIGATION
        self.received_at = self.sampled = self.reported = self.navigated = -inf
        # time between the last two MAG_FIELDs, and MAG_STATUSes, s; 0 before the second
        self.interval = self.report_interval = 0.0
        self.received = self.lost = 0  # number of messages received, and missing by sequence number
        # the last MAG_FIELD, MAG_STATUS, MAG_NAVIGATION and MAG_LEARNING; empty before the first
        self.field: dict[str, Any] = {}
        self.status: dict[str, Any] = {}
        self.navigation: dict[str, Any] = {}
        self.learning: dict[str, Any] = {}
        self.sensors: dict[int, SensorState] = {}
        # flags of the first sensor: name -> time since when it is set, and when it was last set
        self.flags: dict[str, tuple[float, float]] = {}
        self.samples: deque[dict[str, Any]] = deque(maxlen=SAMPLES)  # the last MAG_FIELDs
        # the total field, nT; the fluxgate's temperature, and named values such as the positions of masses
        self.total, self.telemetry = Series(), dict[str, Series]()
        # positions of the position filter (MAG_NAVIGATION), and of the vehicle's own navigation
        self.estimated, self.reported_track = Trail(), Trail()
        self.alarms = Alarms()
        self.texts: deque[Text] = deque(maxlen=200)  # STATUSTEXTs, the newest first
        self.parameters: dict[str, RemoteParameter] = {}
        self._count = self._lost_before = 0
        self._sequence = sequence
        self._piece = (0, -1)
        self._asked = -inf
        self._handlers = by_id(
            MAG_FIELD=self._field, MAG_RAW=self._raw, MAG_STATUS=self._status,
            MAG_NAVIGATION=self._navigation, MAG_LEARNING=self._learning,
            MAG_SENSOR=self._sensor, STATUSTEXT=self._text, PARAM_VALUE=self._value,
        )  # fmt: skip
        place = dict.fromkeys(("GLOBAL_POSITION_INT", "GPS_RAW_INT"), self._position)
        self._others = by_id(NAMED_VALUE_FLOAT=self._named_value, **place)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of the bridge received at `now_s`."""
        gap = (message.sequence - self._sequence - 1) % 256
        self.lost += gap if gap < 128 else 0  # a larger step means that a message arrived late
        self._sequence, self.received_at = message.sequence, now_s
        self.began = min(self.began, now_s)
        self.received += 1
        if handle := self._handlers.get(message.id):
            handle(message, now_s)

    def receive_other(self, message: Message, now_s: float) -> None:
        """Process a message of another component of the vehicle, such as its autopilot."""
        if handle := self._others.get(message.id):
            handle(message, now_s)

    def due(self, now_s: float) -> list[tuple[str, dict[str, Any]]]:
        """Return the messages to send at `now_s`: requests of parameters that are not yet answered."""
        if self.bridge is None:
            return []
        requests: list[tuple[str, dict[str, Any]]] = []
        target = dict(zip(("target_system", "target_component"), self.bridge, strict=True))
        known = {one.index for one in self.parameters.values()}
        missing = [index for index in range(min(self._count, PARAMETERS)) if index not in known]
        if now_s - self._asked > REQUEST_RETRY_S and (missing or not known):
            self._asked = now_s
            requests += [("PARAM_REQUEST_READ", {**target, "param_index": index}) for index in missing[:10]]
            requests += [("PARAM_REQUEST_LIST", target)] if not known else []
        for name, one in self.parameters.items():
            if one.asked is not None and now_s - one.when > REQUEST_RETRY_S:
                one.error, one.when = WAITING if isfinite(one.when) else "", now_s
                value = {"param_id": name, "param_value": one.asked, "param_type": MAV_PARAM_TYPE.REAL32}
                requests.append(("PARAM_SET", {**target, **value}))
        return requests

    def time(self, now_s: float) -> float:
        """Convert a time of the receiver's clock to the bridge's, s since 1970; NaN before a MAG_FIELD."""
        return self.field["time_usec"] * 1e-6 + now_s - self.sampled if self.field else nan

    def set(self, name: str, value: float) -> None:
        """Request a new value of a parameter; `parameters` receives the confirmed value or the error."""
        one = self.parameters[name]
        if abs(value) < 1e38:  # the range of a REAL32
            one.asked, one.when, one.error = value, -inf, ""
        else:
            one.error = "expected a number"

    def _field(self, message: Message, now_s: float) -> None:
        sensor = self._sensor_of(message)
        if sensor is not None:
            sensor.take(message.fields, now_s)
        if number := message["sensor_id"]:
            two_sigma = 2.0 * message["total_field_sigma"]
            moment = message["time_usec"] * 1e-6
            self._measured(f"Sensor {number}: total field, nT", moment, message["total_field"], two_sigma)
            return
        self.interval = now_s - self.sampled if self.field else 0.0
        self.field, self.sampled = message.fields, now_s
        for name in Quality(self.field["flags"]).names().split():
            self.flags[name] = self.flags.get(name, (now_s, now_s))[0], now_s
        oldest = now_s - FLAG_HOLD_TIME_S
        self.flags = {name: times for name, times in self.flags.items() if times[1] >= oldest}
        self.samples.append(self.field)
        total, sigma = (self.field[name] for name in ("total_field", "total_field_sigma"))
        self.total.add(self.field["time_usec"] * 1e-6, total, 2 * sigma)

    def _sensor(self, message: Message, now_s: float) -> None:  # noqa: ARG002 - handlers are alike
        if sensor := self._sensor_of(message):
            sensor.report = message.fields

    def _sensor_of(self, message: Message) -> SensorState | None:
        """Return the sensor that a message names; None if it would exceed `MAX_SENSORS`."""
        number = message["sensor_id"]
        if number not in self.sensors and len(self.sensors) < MAX_SENSORS:
            self.sensors[number] = SensorState(number)
            self.sensors = dict(sorted(self.sensors.items()))
        return self.sensors.get(number)

    def _raw(self, message: Message, now_s: float) -> None:  # noqa: ARG002 - handlers are alike
        if not message["sensor_id"]:
            self._measured(TEMPERATURE_SERIES, message["time_usec"] * 1e-6, message["temperature"])

    def _named_value(self, message: Message, now_s: float) -> None:
        self._measured(message["name"], self.time(now_s), message["value"])

    def _measured(self, name: str, time: float, value: float, two_sigma: float = 0.0) -> None:
        if isfinite(value) and name not in self.telemetry and len(self.telemetry) < TELEMETRY:
            self.telemetry[name] = Series()
        if name in self.telemetry:
            self.telemetry[name].add(time, value, two_sigma)

    def _position(self, message: Message, now_s: float) -> None:  # noqa: ARG002 - handlers are alike
        if message.fields.get("fix_type", FIX_2D) >= FIX_2D and (message["lat"] or message["lon"]):
            self.reported_track.add(TrackPoint(message["lat"] * 1e-7, message["lon"] * 1e-7))

    def _status(self, message: Message, now_s: float) -> None:
        self.report_interval = now_s - self.reported if self.status else 0.0
        self.reported = now_s
        before, self.status = self.status.get("uptime", 0), message.fields
        if self.status["uptime"] < before:  # the bridge restarted, perhaps with other parameters
            self.parameters.clear()
            self.sensors.clear()
            self.learning = {}
            self._count = 0
            self.lost = self._lost_before  # its sequence numbers restarted
        self._lost_before = self.lost

    def _navigation(self, message: Message, now_s: float) -> None:
        self.navigation, self.navigated = message.fields, now_s
        if self.navigation["state"] in LOCATED:
            nn, ne, ee = (self.navigation[f"covariance_{axes}"] for axes in ("nn", "ne", "ee"))
            latitude, longitude = message["lat"] * 1e-7, message["lon"] * 1e-7
            self.estimated.add(TrackPoint(latitude, longitude, (nn, ne, ee)))

    def _learning(self, message: Message, now_s: float) -> None:  # noqa: ARG002 - handlers are alike
        self.learning = message.fields

    def _text(self, message: Message, now_s: float) -> None:
        number, piece = message["id"], message["chunk_seq"]
        statustext = Text(now_s, message["severity"], message["text"])
        if piece and self._piece == (number, piece - 1):
            beginning = self.texts.popleft().text
            self.alarms.withdraw(f"text: {beginning}")
            statustext = statustext._replace(text=beginning + statustext.text)
        self._piece = number, piece
        self.texts.appendleft(statustext)
        if statustext.severity <= MAV_SEVERITY.ERROR:
            self.alarms.announce(f"text: {statustext.text}", statustext.text, now_s)
        name, _, reason = statustext.text.partition(": ")
        if name in self.parameters and statustext.severity <= MAV_SEVERITY.WARNING:
            self.parameters[name].error = reason

    def _value(self, message: Message, now_s: float) -> None:
        name, value = message["param_id"], message["param_value"]
        self._asked, self._count = now_s, message["param_count"]
        if name not in self.parameters and len(self.parameters) >= PARAMETERS:
            return
        one = self.parameters.setdefault(name, RemoteParameter(message["param_index"], value))
        one.value = value
        if one.asked is None:
            return
        if isclose(one.asked, value, rel_tol=1e-6) or (name in COMMAND_PARAMETERS and value == 0.0):
            one.error = ""
        elif one.error == WAITING:
            return  # this value answers a list request of another station; repeat our request
        elif not one.error:
            one.error = f"{one.asked:.7g} was not taken"
        one.asked = None
