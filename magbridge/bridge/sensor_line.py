"""State of the sensor's line, and the commands that the sensor needs."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Final

from magbridge.link.output import Announcer, Timers
from magbridge.mavlink.enums import MAG_PORT_STATE, MAV_SEVERITY
from magbridge.records import Vector

__all__ = ["SensorLine"]

OK: Final = MAG_PORT_STATE.OK
COMMAND_GAP_US = 100_000
"""µs between two commands to a sensor."""
LISTEN_US = 1_200_000
"""µs for which a line that may be another instrument's is listened to: a GPS sends every second."""
NMEA_SENTENCE = re.compile(rb"[$!][A-OQ-Z][A-Z]{4},[ -~]*\*[0-9A-Fa-f]{2}\r?\n")
"""A sentence of NMEA 0183, but none that a maker has defined (``$P...``)."""
MAX_SENTENCE_BYTES = 128
"""Bytes, the longest sentence and a margin."""
TEXT_BYTES = re.compile(rb"[\t\r\n -~]+")
NOT_A_NUMBER = re.compile(rb"\bnan\b", re.IGNORECASE)
SAME_US: Final = 60_000_000
MIN_REPEATED_READINGS: Final = 10
"""µs, and number of readings, after which one that repeats is announced: the sensor may hang. It has no flag,
because one that counts in steps of 100 nT may as well be at rest."""
LINE_CHECK_INTERVAL_US = 1_000_000
"""µs between two checks that readings still come."""


class SensorLine:
    """Watch the line; send the start-up commands whenever the sensor may have lost them.

    Parameters
    ----------
    name : str
        What the sensor is called in messages about its state.
    start : callable
        To be called whenever the line was opened; returns the commands that start the sensor.
    timeout_us : int
        µs without a reading after which it counts as silent.
    searching : bool
        The line may be another instrument's: it is listened to before it gets commands, and it gets none if
        it sends NMEA 0183 and no readings.
    announcer, timers
        The link's.
    start_us : int
        µs since 1970 UTC.
    sensor_id : int
        Which sensor.

    Attributes
    ----------
    state : MAG_PORT_STATE
    timer : str
        Name of the timer that fires if the sensor is silent.
    to_send : list of bytes
        Commands that are due; the caller of the pipeline sends them and empties the list.
    wrong_device : bool
        No reading has come since the line was opened, but a timeout or NMEA 0183 has: it may be another
        instrument's. The owner of the line tries another one, if there is one, and resets this.
    """

    def __init__(
        self,
        name: str,
        start: Callable[[], tuple[bytes, ...]],
        timeout_us: int,
        announcer: Announcer,
        timers: Timers,
        start_us: int,
        *,
        searching: bool = False,
        sensor_id: int = 0,
    ) -> None:
        suffix = f" {sensor_id}" if sensor_id else ""
        self.timer, self._command_timer = f"sensor{suffix}", f"command{suffix}"
        self._reading_key = f"reading{suffix}"
        self._name, self._start, self._timeout_us = name, start, timeout_us
        self._announcer, self._timers = announcer, timers
        self.state = MAG_PORT_STATE.ABSENT
        self.to_send: list[bytes] = []
        self.wrong_device = self._known = False
        self._received_us = start_us
        # no longer than until the line counts as silent, so that the message does not depend on it
        self._listen_us = min(LISTEN_US, timeout_us // 2) if searching else 0
        self._commands: tuple[bytes, ...] = ()
        self._tail = b""
        self._unparsed_us = 0
        self._field: Vector | None = None
        self._repeats = self._since_us = 0
        self._hangs = False
        timers.every(self.timer, LINE_CHECK_INTERVAL_US, self._look, start_us + LINE_CHECK_INTERVAL_US)

    def on_reading(self, time_us: int) -> None:
        """Record a reading."""
        self._received_us, self._known = time_us, True
        if self.state != OK:
            self.state = OK
            self._announcer.state(self.timer, f"{self._name} sends readings")

    def read(self, field: Vector, time_us: int) -> None:
        """Check the values of a reading (nT); announce one that stays the same for long."""
        if field != self._field:
            self._field, self._repeats, self._since_us = field, 0, time_us
            if self._hangs:
                self._hangs = False
                self._announcer.state(self._reading_key, f"{self._name}'s readings change again")
            return
        self._repeats += 1
        if not self._hangs and self._repeats >= MIN_REPEATED_READINGS and time_us - self._since_us >= SAME_US:
            self._hangs = True
            text = f"{self._name} sends the same reading for {SAME_US // 1_000_000} s"
            self._announcer.state(self._reading_key, text, MAV_SEVERITY.WARNING)

    def on_unparsed(self, data: bytes, time_us: int) -> None:
        """Record bytes that complete no reading."""
        self._unparsed_us = time_us
        received = self._tail + data
        self._tail = received[-MAX_SENTENCE_BYTES:]
        if self._listen_us and not self._known and NMEA_SENTENCE.search(received):
            self._commands, self.wrong_device = (), True
            self._timers.cancel(self._command_timer)

    def opened(self, time_us: int) -> None:
        """Send the start-up commands, because the sensor may have lost power; SILENT until it sends."""
        self._commands, self._known, self._tail = self._start(), False, b""
        self._wake(time_us, self._listen_us)

    def lost(self, reason: str) -> None:
        """Record that the port is lost."""
        self.state = MAG_PORT_STATE.LOST
        self._timers.cancel(self._command_timer)
        self._announcer.state(self.timer, f"{self._name} lost: {reason}", MAV_SEVERITY.ERROR)

    def _look(self, time_us: int) -> None:
        if time_us - self._received_us < self._timeout_us or self.state == MAG_PORT_STATE.LOST:
            return
        sends = time_us - self._unparsed_us < self._timeout_us // 2
        what = self._unparsed() if sends else "is silent"
        self._announcer.state(self.timer, f"{self._name} {what}", MAV_SEVERITY.ERROR)
        self.wrong_device = not self._known
        self._wake(time_us)

    def _unparsed(self) -> str:
        """Return a description of the bytes without readings: at a wrong baud rate, they are not text."""
        if not TEXT_BYTES.fullmatch(self._tail):
            return "sends, but no readings: baud rate?"
        if NOT_A_NUMBER.search(self._tail):
            return "sends NaN, but no readings"
        return "sends text, but no readings: sensor.options?"

    def _wake(self, time_us: int, listen_us: int = 0) -> None:
        self.state, self._received_us = MAG_PORT_STATE.SILENT, time_us
        if listen_us:
            self._timers.run_once(
                self._command_timer, time_us + listen_us, lambda t: self._command(t, self._commands)
            )
        else:
            self._command(time_us, self._commands)

    def _command(self, time_us: int, commands: tuple[bytes, ...]) -> None:
        if commands:
            self.to_send.append(commands[0])
            self._timers.run_once(
                self._command_timer, time_us + COMMAND_GAP_US, lambda t: self._command(t, commands[1:])
            )
