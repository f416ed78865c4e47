"""Changes of ports, log and host clock: frames for logs and replays, and their announcements."""

from __future__ import annotations

from collections.abc import Mapping

from magbridge.bridge.events import source_of
from magbridge.bridge.port import Port
from magbridge.bridge.position import CLOCK_SET_US
from magbridge.bridge.sensor_line import SensorLine
from magbridge.link.output import Announcer
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAG_LOG_STATE, MAG_PORT_NAME, MAG_PORT_STATE, MAV_SEVERITY

__all__ = [
    "StateChanges", "clock_step", "interleaved", "log_state", "notice", "opened", "port", "standstill",
    "too_slow",
]  # fmt: skip


def _frame(name: str, **fields: object) -> bytes:
    return Codec(0, 0).pack(name, **fields)


def clock_step(time_us: int, step_us: int) -> bytes:
    """Return the frame for a step of the host's clock by `step_us` µs."""
    return _frame("MAG_CLOCK_STEP", time_usec=time_us + step_us, step=step_us)


def standstill(time_us: int, duration_us: int) -> bytes:
    """Return the frame for a stall of the bridge of `duration_us` µs that ends now."""
    return _frame("MAG_HOST_STALL", time_usec=time_us, duration=min(duration_us, 2**32 - 1))


def interleaved(count: int) -> bytes:
    """Return the frame for `count` sent frames that are not in the log."""
    return _frame("MAG_INTERLEAVED", count=count)


def notice(text: str, severity: MAV_SEVERITY = MAV_SEVERITY.WARNING) -> bytes:
    """Return the frame of a text that the bridge forwards, at most 50 characters."""
    return _frame("STATUSTEXT", severity=int(severity), text=text)


def port(number: int, link: Port, reason: str) -> bytes:
    """Return the frame for a port that opened (no `reason`) or that is not open, with the reason."""
    state = MAG_PORT_STATE.LOST if reason else MAG_PORT_STATE.OK
    # the name last, because the end of a long text is cut off
    why = f"{reason}: {link.name}" if reason else ""
    return _frame("MAG_PORT", port=number, state=int(state), dropped=link.dropped, reason=why)


def too_slow(number: int, link: Port) -> bytes:
    """Return the frame for an open port that is too slow for the sent data."""
    why = f"too slow, {link.overrun} bytes not sent so far"
    state = int(MAG_PORT_STATE.OK)
    return _frame("MAG_PORT", port=number, state=state, dropped=link.dropped, reason=why)


def opened(name: int) -> bytes:
    """Return the frame for a port that opened, for a replay, which has no `Port`."""
    return _frame("MAG_PORT", port=int(name), state=int(MAG_PORT_STATE.OK))


def log_state(reason: str, lost: int) -> bytes:
    """Return the frame for the log's state: written (no `reason`) or not, and the lost records."""
    state = MAG_PORT_STATE.LOST if reason else MAG_PORT_STATE.OK
    return _frame("MAG_PORT", port=int(MAG_PORT_NAME.LOG), state=int(state), dropped=lost, reason=reason)


INTERLEAVED = spec("MAG_INTERLEAVED").id
CLOCK_STEP, NOTICE, PORT, STANDSTILL = (
    spec(name).id for name in ("MAG_CLOCK_STEP", "STATUSTEXT", "MAG_PORT", "MAG_HOST_STALL")
)
GRACE_US = 500_000
"""µs after a standstill within which more of what waited comes: what a full buffer had no room for."""
NOTICE_US = 1_000_000
"""µs from which on a standstill is announced."""


class StateChanges:
    """Record and announce the changes that the frames of :mod:`.states` report.

    Parameters
    ----------
    codec : Codec
        The link's: its ``utc_offset_us`` follows the host's clock.
    announcer : Announcer
    sensors : mapping of int to SensorLine
        By sensor id.

    Attributes
    ----------
    log_state : MAG_LOG_STATE
    log_lost : int
        Records that the log has lost.
    since_us, until_us : int
        µs: inputs up to `until_us` may have waited since `since_us`.
    """

    def __init__(self, codec: Codec, announcer: Announcer, sensors: Mapping[int, SensorLine]) -> None:
        self._codec, self._announcer, self._sensors = codec, announcer, sensors
        self.log_state, self.log_lost = MAG_LOG_STATE.OFF, 0
        self.since_us = self.until_us = 0
        self._clock_unset = False

    @staticmethod
    def held_up(data: bytes) -> int:
        """Return the duration (µs) of a stall of the bridge by these frames; 0 without one."""
        return sum(one["duration"] for one in Codec(0, 0).parse(data) if one.id == STANDSTILL)

    def receive(self, data: bytes, time_us: int) -> None:
        """Process frames received at `time_us`."""
        for message in Codec(0, 0).parse(data):
            if message.id == CLOCK_STEP:
                self._codec.utc_offset_us += message["step"]
                step = f"clock was set by {message['step'] * 1e-6:+.3f} s"
                self._announcer.send_statustext(step, MAV_SEVERITY.NOTICE)
                self.check_clock()
            elif message.id == INTERLEAVED:  # in a replay
                self._codec.skip(message["count"])
            elif message.id == NOTICE:
                self._announcer.send_statustext(message["text"], MAV_SEVERITY(message["severity"]))
            elif message.id == STANDSTILL:
                self._stood_still(time_us, message["duration"])
            elif message.id == PORT:
                well = message["state"] == MAG_PORT_STATE.OK
                self._port(message["port"], well, message["reason"], message["dropped"], time_us)

    def check_clock(self) -> None:
        """Announce that the host's clock was never set."""
        unset = self._codec.utc_us < CLOCK_SET_US
        if unset or self._clock_unset:
            text = "host clock was never set: no date, no main field" if unset else "host clock is set"
            severity = MAV_SEVERITY.WARNING if unset else MAV_SEVERITY.INFO
            self._announcer.state("clock", text, severity)
        self._clock_unset = unset

    def _stood_still(self, time_us: int, duration_us: int) -> None:
        if time_us > self.until_us:  # else one more of a row of them
            self.since_us = time_us - duration_us
        self.until_us = time_us + GRACE_US
        if duration_us >= NOTICE_US:
            text = f"stood still for {duration_us * 1e-6:.1f} s: late samples are flagged"
            self._announcer.send_statustext(text, MAV_SEVERITY.WARNING)

    def _port(self, port: int, well: bool, reason: str, dropped: int, time_us: int) -> None:
        severity = MAV_SEVERITY.INFO if well else MAV_SEVERITY.ERROR
        if port == MAG_PORT_NAME.LOG:
            self.log_state = MAG_LOG_STATE.OK if well else MAG_LOG_STATE.FAILED
            self.log_lost = dropped
            self._announcer.state("log", f"log: {reason or 'being written'}", severity)
        elif port != MAG_PORT_NAME.LINK:
            if (sensor := self._sensors.get(source_of(port)[1])) is not None:
                sensor.opened(time_us) if well else sensor.lost(reason)
        else:
            severity = MAV_SEVERITY.WARNING if well and reason else severity
            self._announcer.state("link", f"link: {reason or 'open'}", severity)
