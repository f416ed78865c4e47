"""Request the messages that the bridge needs, from their senders and at the rates that it needs."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Final

from magbridge.config import Telemetry
from magbridge.link.output import Announcer, Outbox, Timers
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_CMD, MAV_RESULT, MAV_SEVERITY

__all__ = ["AIRCRAFT", "MIN_RATE_FRACTION", "Stream", "StreamRequests", "needed_rates"]

AIRCRAFT: Final = frozenset((1, 2, 3, 4, 13, 14, 15, 19, 20, 21, 22, 23, 24, 25, 29, 35))
"""MAV_TYPE of vehicles that turn by tens of degrees a second: fixed and rotary wings."""
RATE_INTERVAL_US: Final = 10_000_000
"""µs over which the bridge measures at which rate each message arrives."""
ANSWER_US: Final = 2_000_000
"""µs that the bridge waits for the answer to one request."""
MIN_RATE_FRACTION: Final = 0.7
"""Fraction of the needed rate below which the bridge requests it. A higher rate, which another client may
have requested, stays as it is."""
MAX_ATTEMPTS: Final = 3
"""Requests of one message between two reboots of the autopilot."""
UNREQUESTABLE: Final = frozenset(
    ("NAMED_VALUE_FLOAT", "NAMED_VALUE_INT", "DEBUG", "DEBUG_VECT", "DEBUG_FLOAT_ARRAY", "HEARTBEAT")
)
"""Messages that several programs send, each on its own schedule."""


Stream = tuple[int, int]
"""Component that sends a message, and the message's id."""


def needed_rates(
    autopilot: int, telemetry: Iterable[Telemetry] = (), *, attitude: bool, navigation: bool
) -> dict[Stream, tuple[float, float]]:
    """Return the needed rate (Hz) of each message, for an aircraft and for any other vehicle.

    Parameters
    ----------
    autopilot : int
        Its component.
    telemetry : iterable of Telemetry
        Sources of the parameters of the calibration; one without a component is expected of the autopilot.
    attitude : bool
        The direction of the field is checked.
    navigation : bool
        The bridge navigates.
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
    return rates | {(autopilot, spec(name).id): pair for name, pair in names.items()}


class StreamRequests:
    """Measure the rate of each needed message, and request it from its sender if it arrives too rarely.

    A message that the autopilot does not send and another component sends at the needed rate is not
    requested.

    Parameters
    ----------
    peer : tuple of 2 int
        System and component of the autopilot.
    rates : mapping of Stream to tuple of 2 float
        As :func:`needed_rates` returns them.
    outbox, timers, announcer
        Those of the link.
    active : bool
        False: rates are only measured.
    """

    def __init__(
        self,
        peer: tuple[int, int],
        rates: Mapping[Stream, tuple[float, float]],
        outbox: Outbox,
        timers: Timers,
        announcer: Announcer,
        *,
        active: bool = True,
    ) -> None:
        self._active = active
        self._peer, self._outbox, self._timers, self._announcer = peer, outbox, timers, announcer
        self.needed = dict(rates)
        """Sender and message -> rate in Hz at which it is needed on an aircraft, and on any other vehicle."""
        self._numbers = {number for _, number in self.needed}
        self._received: Counter[Stream] = Counter()
        self._attempts: Counter[Stream] = Counter()
        self._queue: deque[Stream] = deque()
        self._asked: Stream | None = None
        self._present = self._is_aircraft = False
        self.interval_us = RATE_INTERVAL_US
        """µs over which rates are measured."""
        self.measured: dict[str, float] = {}
        """Rate in Hz at which each needed message arrived in the last interval."""
        self.denied: dict[str, str] = {}
        """Message that its sender does not send as requested -> the text that was announced."""

    def receive(self, message: Message, time_us: int) -> None:
        """Count a message of the vehicle; handle the answer to a request."""
        autopilot = self._peer[1]
        if message.id == HEARTBEAT and message.component == autopilot:
            self._is_aircraft = message["type"] in AIRCRAFT
            ardupilot, px4 = (autopilot, EKF_STATUS), (autopilot, PX4_STATUS)
            if message["autopilot"] == MAV_AUTOPILOT.PX4 and ardupilot in self.needed:
                self.needed[px4] = self.needed.pop(ardupilot)
                self._numbers.add(PX4_STATUS)
            if not self._present:
                self._present = True
                self._timers.every("streams", self.interval_us, self._look, time_us + self.interval_us)
        elif message.id == ACK:
            is_asked = self._asked is not None and message.component == self._asked[0]
            if is_asked and message["command"] == MAV_CMD.SET_MESSAGE_INTERVAL:
                self._answered(message["result"])
        elif message.id in self._numbers:
            self._received[message.component, message.id] += 1

    def rebooted(self) -> None:
        """Restart after a reboot of the autopilot, which has forgotten the requests."""
        self._attempts.clear()
        self._received.clear()
        self.denied.clear()

    def rate_of(self, stream: Stream) -> float:
        """Return the rate in Hz at which a message is needed."""
        return self.needed[stream][0 if self._is_aircraft else 1]

    def _look(self, _: int) -> None:
        """Queue requests for the messages that arrived too rarely since the last call."""
        largest: Counter[int] = Counter()  # of each message that other components send, too
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
        """Send the next request; only one is pending, because an answer does not name its message."""
        self._asked = None
        if not self._queue:
            return
        stream = self._asked = self._queue.popleft()
        self._attempts[stream] += 1
        self._outbox.send(
            "COMMAND_LONG",
            target_system=self._peer[0],
            target_component=stream[0],
            command=int(MAV_CMD.SET_MESSAGE_INTERVAL),
            param1=float(stream[1]),
            param2=1e6 / self.rate_of(stream),
        )
        deadline = self._outbox.codec.now_us + ANSWER_US
        self._timers.run_once("stream request", deadline, lambda _: self._ask_next())

    def _answered(self, result: int) -> None:
        """Report a denial and continue with the next request."""
        assert self._asked is not None
        component, name = self._asked[0], spec(self._asked[1]).name
        if result not in (MAV_RESULT.ACCEPTED, MAV_RESULT.IN_PROGRESS):
            self._attempts[self._asked] = MAX_ATTEMPTS
            why = MAV_RESULT(result).name if result in MAV_RESULT.__members__.values() else str(result)
            sender = "the autopilot" if component == self._peer[1] else f"component {component}"
            text = f"{sender} does not send {name} at {self.rate_of(self._asked):g} Hz: {why}"
            self.denied[name] = text
            self._announcer.state(f"stream {name}", text, MAV_SEVERITY.WARNING)
        self._timers.cancel("stream request")
        self._ask_next()


HEARTBEAT: Final = spec("HEARTBEAT").id
EKF_STATUS, PX4_STATUS = spec("EKF_STATUS_REPORT").id, spec("ESTIMATOR_STATUS").id
"""Messages with the flags of the estimator: ArduPilot's and PX4's."""
ACK: Final = spec("COMMAND_ACK").id
