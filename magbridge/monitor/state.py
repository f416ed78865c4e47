"""What a ground station knows of a bridge: messages in, requests out. No port, no clock, no page."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import inf, isclose, isfinite
from typing import Any, NamedTuple

from magbridge.mavlink import Message, spec
from magbridge.mavlink.dialect import MAV_AUTOPILOT, MAV_PARAM_TYPE, MAV_SEVERITY, MAV_STATE, MAV_TYPE
from magbridge.records import Quality

__all__ = ["Parameter", "Point", "State", "Text"]

BRIDGES = {spec(name).id for name in ("MAG_RAW", "MAG_FIELD", "MAG_STATUS")}
"""A component that sends one of these is a bridge."""
HOLD = 3.0
"""s for which a flag is still shown after it was last set."""
WINDOW, BUCKET = 600.0, 1.0
"""s of total field that are kept, and s of them that make one point."""
RETRY = 1.5
"""s after which a request without an answer is repeated."""
WAITING = "no answer yet"
AWAY = 30.0
"""s of silence after which another bridge that is heard takes its place."""


class Text(NamedTuple):
    """A text of the bridge: when it came (s), its MAV_SEVERITY, its words."""

    time: float
    severity: int
    text: str


@dataclass
class Point:
    """The samples of one `BUCKET` from `time` (s): sum, number, and outline of their 2-sigma bands (nT)."""

    time: float
    sum: float = 0.0
    count: int = 0
    low: float = inf
    high: float = -inf


@dataclass
class Parameter:
    """A parameter: value last received, value requested (and when), and why the request was not granted."""

    index: int
    value: float
    asked: float | None = None
    when: float = -inf
    error: str = ""


class State:
    """All that a page shows of one bridge: the first heard; another only once that was silent for `AWAY`.

    Times are the receiver's, s of a clock that nobody sets.

    Attributes
    ----------
    bridge : tuple of 2 int or None
        Its system and component.
    heard, sampled, reported, navigated : float
        When its last message, MAG_FIELD, MAG_STATUS and MAG_NAVIGATION came; -inf before the first.
    interval, report_interval : float
        s between its last two MAG_FIELDs, and MAG_STATUSes; 0 before the second.
    received, lost : int
        Its messages received, and those missing by their sequence numbers.
    field, status, navigation : dict
        The last MAG_FIELD, MAG_STATUS and MAG_NAVIGATION; empty before the first.
    flags : dict of str to tuple of 2 float
        The flags shown, by their public names: since when, and when last set.
    trace : deque of Point
        The last ten minutes of total field.
    texts : deque of Text
        STATUSTEXTs, the newest first.
    parameters : dict of str to Parameter
    """

    def __init__(self) -> None:
        self._begin()
        handlers = {
            "MAG_FIELD": self._field,
            "MAG_STATUS": self._status,
            "MAG_NAVIGATION": self._navigation,
            "STATUSTEXT": self._text,
        }
        self._handlers = {spec(name).id: handle for name, handle in handlers.items()}
        self._handlers[spec("PARAM_VALUE").id] = self._value

    def _begin(self) -> None:
        """Forget everything, as before any bridge was heard."""
        self.bridge: tuple[int, int] | None = None
        self.heard = self.sampled = self.reported = self.navigated = -inf
        self.interval = self.report_interval = 0.0
        self.received = self.lost = 0
        self.field: dict[str, Any] = {}
        self.status: dict[str, Any] = {}
        self.navigation: dict[str, Any] = {}
        self.flags: dict[str, tuple[float, float]] = {}
        self.trace: deque[Point] = deque()
        self.texts: deque[Text] = deque(maxlen=200)
        self.parameters: dict[str, Parameter] = {}
        self._count = self._lost_before = 0
        self._sequence = -1
        self._piece = (0, -1)
        self._beat = self._asked = -inf

    def hear(self, message: Message, now: float) -> None:
        """Take a message that came at `now`."""
        sender = message.system, message.component
        away = sender != self.bridge and now - self.heard > AWAY
        if away and message.known and message.id in BRIDGES:
            self._begin()
            self.bridge, self._sequence = sender, message.sequence - 1
        if sender != self.bridge or not message.known:
            return
        gap = (message.sequence - self._sequence - 1) % 256
        self.lost += gap if gap < 128 else 0  # a larger step is a message that comes late
        self._sequence, self.heard = message.sequence, now
        self.received += 1
        if handle := self._handlers.get(message.id):
            handle(message, now)

    def due(self, now: float) -> list[tuple[str, dict[str, Any]]]:
        """Return the messages to send at `now`: our heartbeat, and requests not yet answered."""
        requests: list[tuple[str, dict[str, Any]]] = []
        if now - self._beat >= 1.0:
            self._beat = now
            kind = {"type": MAV_TYPE.GCS, "autopilot": MAV_AUTOPILOT.INVALID, "mavlink_version": 3}
            requests.append(("HEARTBEAT", {**kind, "system_status": MAV_STATE.ACTIVE}))
        if self.bridge is None:
            return requests
        target = dict(zip(("target_system", "target_component"), self.bridge, strict=True))
        known = {one.index for one in self.parameters.values()}
        missing = [index for index in range(self._count) if index not in known]
        if now - self._asked > RETRY and (missing or not known):
            self._asked = now
            requests += [("PARAM_REQUEST_READ", {**target, "param_index": index}) for index in missing[:10]]
            requests += [("PARAM_REQUEST_LIST", target)] if not known else []
        for name, one in self.parameters.items():
            if one.asked is not None and now - one.when > RETRY:
                one.error, one.when = WAITING if isfinite(one.when) else "", now
                value = {"param_id": name, "param_value": one.asked, "param_type": MAV_PARAM_TYPE.REAL32}
                requests.append(("PARAM_SET", {**target, **value}))
        return requests

    def set(self, name: str, value: float) -> None:
        """Ask for another value of a parameter; the answer, or the refusal, appears in `parameters`."""
        one = self.parameters[name]
        if abs(value) < 1e38:  # what a REAL32 takes
            one.asked, one.when, one.error = value, -inf, ""
        else:
            one.error = "expected a number"

    def _field(self, message: Message, now: float) -> None:
        self.interval = now - self.sampled if self.field else 0.0
        self.field, self.sampled = message.fields, now
        for name in Quality(self.field["flags"]).names().split():
            self.flags[name] = self.flags.get(name, (now, now))[0], now
        self.flags = {name: times for name, times in self.flags.items() if now - times[1] <= HOLD}
        time, total = self.field["time_usec"] * 1e-6 // BUCKET * BUCKET, self.field["total_field"]
        two_sigma = 2 * self.field["total_field_sigma"]
        if not isfinite(total + two_sigma):
            return
        if self.trace and time < self.trace[-1].time:
            self.trace.clear()  # the bridge's clock was set back
        if not self.trace or time > self.trace[-1].time:
            self.trace.append(Point(time))
        point = self.trace[-1]
        point.sum, point.count = point.sum + total, point.count + 1
        point.low, point.high = min(point.low, total - two_sigma), max(point.high, total + two_sigma)
        while time - self.trace[0].time > WINDOW:
            self.trace.popleft()

    def _status(self, message: Message, now: float) -> None:
        self.report_interval = now - self.reported if self.status else 0.0
        self.reported = now
        before, self.status = self.status.get("uptime", 0), message.fields
        if self.status["uptime"] < before:  # the bridge restarted, perhaps with other parameters
            self.parameters.clear()
            self._count = 0
            self.lost = self._lost_before  # its sequence numbers began anew
        self._lost_before = self.lost

    def _navigation(self, message: Message, now: float) -> None:
        self.navigation, self.navigated = message.fields, now

    def _text(self, message: Message, now: float) -> None:
        number, piece = message["id"], message["chunk_seq"]
        said = Text(now, message["severity"], message["text"])
        if piece and self._piece == (number, piece - 1):
            said = said._replace(text=self.texts.popleft().text + said.text)
        self._piece = number, piece
        self.texts.appendleft(said)
        name, _, reason = said.text.partition(": ")
        if name in self.parameters and said.severity <= MAV_SEVERITY.WARNING:
            self.parameters[name].error = reason

    def _value(self, message: Message, now: float) -> None:
        name, value = message["param_id"], message["param_value"]
        self._asked, self._count = now, message["param_count"]
        one = self.parameters.setdefault(name, Parameter(message["param_index"], value))
        one.value = value
        if one.asked is None:
            return
        if isclose(one.asked, value, rel_tol=1e-6):
            one.error = ""
        elif one.error in ("", WAITING):
            one.error = f"{one.asked:.7g} was not taken"
        one.asked = None
