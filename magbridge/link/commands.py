"""Commands to the bridge: messages to send, their rates, and its capabilities."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite

from magbridge.link.authority import Authority
from magbridge.link.output import Announcer, Outbox
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_CMD, MAV_RESULT, MAV_SEVERITY

__all__ = ["Commands"]

FIRST_DIALECT_ID = 60100
"""The first message id of our dialect: no other component of the vehicle has these messages."""
CALIBRATES = {MAV_CMD.PREFLIGHT_CALIBRATION, *(one for one in MAV_CMD if "MAG_CAL" in one.name)}
ABOUT_MESSAGES = MAV_CMD.REQUEST_MESSAGE, MAV_CMD.SET_MESSAGE_INTERVAL, MAV_CMD.GET_MESSAGE_INTERVAL
MAX_COMMAND_RATE = 100
"""Commands of one sender that are executed within a second; more are rejected for the time being."""
SENDERS = 64
"""Senders that are counted; in a second with more of them, the others count as one."""
AUTOPILOT_VERSION, MESSAGE_INTERVAL = spec("AUTOPILOT_VERSION").id, spec("MESSAGE_INTERVAL").id


class Commands:
    """Answer COMMAND_LONG and COMMAND_INT.

    A command to component 0 is for any component that can execute it. The bridge then executes only what
    concerns messages of its own dialect and never refuses, because a ground station would take the refusal
    for the autopilot's. Calibration of the autopilot's own compass (DO_START_MAG_CAL and the like) is the
    autopilot's business; a request to the bridge itself gets a STATUSTEXT on how ours is calibrated.

    Parameters
    ----------
    outbox : Outbox
    messages : mapping of int to callable
        What can be requested, by message id; sends the message, and returns False where there is nothing to
        send yet.
    interval_us : callable
        Interval of a message id in µs: -1 off, 0 unknown; KeyError where it has none.
    set_rate : callable
        Takes a message id and a rate in Hz (-1 off, None for the default); returns whether it is allowed.
        KeyError where the message has no rate.
    authority : Authority
        Knows who may change a rate.
    announcer : Announcer
    """

    def __init__(
        self,
        outbox: Outbox,
        messages: Mapping[int, Callable[[], bool]],
        interval_us: Callable[[int], int],
        set_rate: Callable[[int, float | None], bool],
        authority: Authority,
        announcer: Announcer,
    ) -> None:
        self._outbox, self._authority, self._announcer = outbox, authority, announcer
        self._messages, self._interval_us, self._set_rate = messages, interval_us, set_rate
        self._second_us = 0
        self._asked: dict[tuple[int, int], int] = {}
        self._commands = {
            MAV_CMD.REQUEST_MESSAGE: self._request,
            MAV_CMD.SET_MESSAGE_INTERVAL: self._set_interval,
            MAV_CMD.GET_MESSAGE_INTERVAL: self._get_interval,
            MAV_CMD.REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
        }

    def handle(self, message: Message, system: int, component: int) -> None:
        """Execute and acknowledge a command, if it is addressed to `component` of `system`."""
        target = message["target_component"]
        if message["target_system"] not in (0, system) or target not in (0, component):
            return
        number = message["command"]
        values = [message["param1"], message["param2"]]
        if target == 0 and not self._only_us(number, values[0]):
            return
        command = self._commands.get(number)
        if self._is_flood(message.system, message.component):
            text = f"more than {MAX_COMMAND_RATE} commands a second from {message.system}:{message.component}"
            self._announcer.state("flood", text, MAV_SEVERITY.WARNING)
            result = MAV_RESULT.TEMPORARILY_REJECTED
        elif number == MAV_CMD.SET_MESSAGE_INTERVAL and not self._authority.may_change(message):
            text = f"{message.system}:{message.component} may not set a rate: no station, no autopilot"
            self._announcer.state("rate", text, MAV_SEVERITY.WARNING, recurring=True)
            result = MAV_RESULT.DENIED
        else:
            result = command(values) if command else self._unsupported(number)
        self._outbox.send(
            "COMMAND_ACK",
            command=number,
            result=result,
            progress=0xFF,  # not known
            target_system=message.system,
            target_component=message.component,
        )

    def _is_flood(self, system: int, component: int) -> bool:
        """Count a command; return whether its sender has sent too many within a second."""
        now_us = self._outbox.codec.now_us
        if now_us - self._second_us >= 1_000_000:
            self._second_us, self._asked = now_us, {}
        who = (system, component) if (system, component) in self._asked else (0, 0)
        if len(self._asked) < SENDERS:
            who = system, component
        self._asked[who] = self._asked.get(who, 0) + 1
        return self._asked[who] > MAX_COMMAND_RATE

    def _unsupported(self, number: int) -> MAV_RESULT:
        if number in CALIBRATES:
            text = "this magnetometer is calibrated from its logs: magbridge calibrate"
            self._announcer.state("calibrate", text, MAV_SEVERITY.NOTICE, recurring=True)
        return MAV_RESULT.UNSUPPORTED

    def _only_us(self, number: int, first: float) -> bool:
        about_message = number in ABOUT_MESSAGES
        return about_message and first >= FIRST_DIALECT_ID and first in self._messages

    def _request(self, values: list[float]) -> MAV_RESULT:
        if values[0] == MESSAGE_INTERVAL:  # the successor of GET_MESSAGE_INTERVAL
            return self._get_interval(values[1:])
        answer = self._messages.get(to_integer(values[0]))
        if answer is None:
            return MAV_RESULT.DENIED
        return MAV_RESULT.ACCEPTED if answer() else MAV_RESULT.TEMPORARILY_REJECTED

    def _set_interval(self, values: list[float]) -> MAV_RESULT:
        interval = values[1]
        if not isfinite(interval) or (interval < 0 and interval != -1):
            return MAV_RESULT.DENIED
        rate = None if interval == 0 else -1.0 if interval < 0 else 1e6 / interval
        try:
            allowed = self._set_rate(to_integer(values[0]), rate)
        except KeyError:
            allowed = False
        return MAV_RESULT.ACCEPTED if allowed else MAV_RESULT.DENIED

    def _get_interval(self, values: list[float]) -> MAV_RESULT:
        number = to_integer(values[0])
        try:
            interval = self._interval_us(number)
        except KeyError:
            interval = 0
        if not 0 <= number <= 0xFFFF:
            return MAV_RESULT.DENIED
        self._outbox.send("MESSAGE_INTERVAL", message_id=number, interval_us=interval)
        return MAV_RESULT.ACCEPTED

    def _capabilities(self, values: list[float]) -> MAV_RESULT:
        if values[0] != 1:
            return MAV_RESULT.DENIED
        return self._request([AUTOPILOT_VERSION])


def to_integer(value: float) -> int:
    """Return a float parameter as an integer, or -1 (no message has this id) if it is not finite."""
    return int(value) if isfinite(value) else -1
