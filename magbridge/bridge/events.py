"""Events, which are all inputs of the bridge, their creation from ports and clock, and their log records.

One thread reads, corrects and sends. Each port has a further thread that opens the port when it is down. So a
slow attempt to open one port (a host name that does not resolve) never delays another port.
"""

from __future__ import annotations

import os
import queue
import select
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from struct import Struct
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from magbridge.bridge.port import Port
from magbridge.bridge.position import CLOCK_SET_US
from magbridge.bridge.sensor import SensorStream
from magbridge.config import Config
from magbridge.errors import PortError
from magbridge.link.output import Output
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAG_LOG_STATE, MAG_PORT_NAME, MAG_PORT_STATE, MAV_PARAM_TYPE, MAV_SEVERITY
from magbridge.records import Channel
from magbridge.sensors import Driver, is_scalar
from magbridge.version import __version__

__all__ = [
    "Event", "HostClock", "LiveEdge", "Recorder", "StartEvent", "StateChanges", "beginning", "clock_step",
    "declarations", "interleaved", "notice", "port_number", "port_state", "source_of", "standstill",
]  # fmt: skip


Byte = Annotated[int, Meta(ge=0, le=255)]


class StartEvent(msgspec.Struct, frozen=True, omit_defaults=True):
    """State at the start of a run that a replay needs besides configuration, calibration and events.

    Without its time, it is also the state of the bridge that is stored in a file for the next run.
    """

    time_us: int = 0
    """Start of the run, µs since 1970 UTC, a multiple of 4."""
    parameters: dict[str, Annotated[float, Meta(ge=-3e38, le=3e38)]] = {}
    """Values that a ground station set in earlier runs, by parameter name."""
    signing_timestamp: Annotated[int, Meta(ge=0, lt=1 << 47)] = 0
    """Last signing time stamp that an earlier run may have used (units of 10 µs since 2015-01-01; 48 bits on
    the link)."""
    signing_streams: list[tuple[Byte, Byte, Byte, bool, Annotated[int, Meta(ge=0, lt=1 << 48)]]] = []
    """Last accepted time stamp of each signed stream."""


class Event(msgspec.Struct, frozen=True, gc=False):
    """One input of the bridge: bytes from a port, a change of state, or only the passing of time."""

    time_us: int
    """Time at which the input was read, µs since 1970 UTC; a multiple of 4, never decreasing."""
    channel: Channel
    """Kind of `data`. ``SENSOR``, ``LINK``: bytes as read. ``STATE``: one MAVLink frame of our own dialect
    about a change of a port, the host's clock or the log; empty if only time has passed."""
    data: bytes
    sensor_id: int = 0
    """Number of the sensor, for ``SENSOR``."""


def port_number(sensor_id: int) -> int:
    """Return the MAG_PORT_NAME of a sensor's port."""
    return MAG_PORT_NAME.LOG + sensor_id if sensor_id else MAG_PORT_NAME.SENSOR


def source_of(port: int) -> tuple[Channel, int]:
    """Return channel and sensor id of the bytes from a port, given by its MAG_PORT_NAME."""
    if port > MAG_PORT_NAME.LOG:
        return Channel.SENSOR, port - MAG_PORT_NAME.LOG
    return Channel(port), 0


class HostClock:
    """The bridge's only clock, which starts at the host's UTC and follows the host's monotonic clock.

    A step of the host's UTC does not change this clock, so that no interval contains a step.
    :meth:`step_us` reports such steps.
    """

    THRESHOLD_US = 50_000
    """Smallest difference that counts as a step, µs; smaller ones come from slewing of the host's clock."""

    AT_ONCE_US = 5_000
    """Longest time in which the host's two clocks are read, µs; if the process stalls longer between the two,
    both are read again."""

    def __init__(self) -> None:
        self._offset_us = self._ahead_us()
        self._known_step_us = 0

    def now_us(self) -> int:
        """Return the time, µs since 1970 UTC, a multiple of 4."""
        return (time.monotonic_ns() // 1000 + self._offset_us) & ~3

    def step_us(self) -> int:
        """Return the step (µs) of the host's UTC since the last call; 0 without a step."""
        difference = self._ahead_us() - self._offset_us - self._known_step_us
        if abs(difference) < self.THRESHOLD_US:
            return 0
        self._known_step_us += difference
        return difference

    def _ahead_us(self) -> int:
        """Return the host's UTC minus its monotonic clock, µs, to within `AT_ONCE_US`."""
        while True:
            before, utc, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if after - before < 1000 * self.AT_ONCE_US:
                return (utc - before) // 1000


def _frame(name: str, **fields: object) -> bytes:
    return Codec(0, 0).pack(name, **fields)


def clock_step(time_us: int, step_us: int) -> bytes:
    """Return the state frame for a step of the host's clock by `step_us` (µs)."""
    return _frame("MAG_CLOCK_STEP", time_usec=time_us + step_us, step=step_us)


def standstill(time_us: int, duration_us: int) -> bytes:
    """Return the state frame for a stall of the bridge of `duration_us` (µs) that ended at `time_us`."""
    return _frame("MAG_HOST_STALL", time_usec=time_us, duration=min(duration_us, 2**32 - 1))


def interleaved(count: int) -> bytes:
    """Return the state frame for `count` frames that were sent but are not in the log."""
    return _frame("MAG_INTERLEAVED", count=count)


def notice(text: str, severity: MAV_SEVERITY = MAV_SEVERITY.WARNING) -> bytes:
    """Return the state frame for a text, at most 50 characters, that the bridge sends as a STATUSTEXT."""
    return _frame("STATUSTEXT", severity=int(severity), text=text)


def port_state(number: int, reason: str = "", dropped: int = 0, *, is_open: bool | None = None) -> bytes:
    """Return the state frame for a port or the log, which is open if `reason` is empty.

    `number`: MAG_PORT_NAME of the port. `reason`: why the port is not open. `dropped`: number of lost bytes,
    or of lost records of the log. `is_open`: state of the port if it does not follow from `reason`.
    """
    well = not reason if is_open is None else is_open
    state = MAG_PORT_STATE.OK if well else MAG_PORT_STATE.LOST
    return _frame("MAG_PORT", port=int(number), state=int(state), dropped=dropped, reason=reason)


INTERLEAVED = spec("MAG_INTERLEAVED").id
CLOCK_STEP, NOTICE, PORT, STANDSTILL = (
    spec(name).id for name in ("MAG_CLOCK_STEP", "STATUSTEXT", "MAG_PORT", "MAG_HOST_STALL")
)
GRACE_US = 500_000
"""Time after a stall in which delayed inputs still arrive, because the buffers were full, µs."""
NOTICE_US = 1_000_000
"""Shortest stall that is reported, µs."""
OVERLOAD_US, PAUSE_US = 3_000_000, 5_000_000
"""An overload begins if stalls fill half of the time for `OVERLOAD_US`, and ends after `PAUSE_US` without a
stall, µs. While the inputs wait, each pass of the event loop has more to process and lasts longer."""


class StateChanges:
    """Handler of state frames, which applies the changes and sends STATUSTEXTs about them.

    `output`: sender of the STATUSTEXTs. The ``utc_offset_us`` of its codec follows the steps of the host's
        clock.
    `sensors`: the sensors, by sensor id.
    `log_state`: state of the log (MAG_LOG_STATE).
    `log_lost`: number of records that the log has lost.
    `since_us`, `until_us`: event times, µs; inputs up to `until_us` may have waited since `since_us`.
    `is_overloaded`: True while the computer is too slow, so that the bridge omits optional work. This depends
        only on event times, so that a replay omits the same work.
    """

    def __init__(self, output: Output, sensors: Mapping[int, SensorStream]) -> None:
        self._output, self._codec, self._sensors = output, output.codec, sensors
        self.log_state, self.log_lost = MAG_LOG_STATE.OFF, 0
        self.since_us = self.until_us = 0
        self.is_overloaded = False
        self._stalled_since_us = self._stalled_us = self._last_stall_us = 0
        self._clock_unset = False

    def _end_overload(self, _: int) -> None:
        self.is_overloaded = False
        self._output.announce("overload", "overload is over")

    def _find_overload(self, time_us: int, duration_us: int) -> None:
        """Detect that successive stalls, the last of `duration_us` until `time_us`, fill most of the time."""
        if time_us - duration_us - self._last_stall_us > PAUSE_US:
            self._stalled_since_us, self._stalled_us = time_us - duration_us, 0
        self._stalled_us += duration_us
        self._last_stall_us = time_us
        elapsed_us, is_single = time_us - self._stalled_since_us, self._stalled_us == duration_us
        if elapsed_us >= OVERLOAD_US and 2 * self._stalled_us >= elapsed_us and not is_single:
            self.is_overloaded = True
            text = "overload: learning pauses, fewer messages"
            self._output.announce("overload", text, MAV_SEVERITY.WARNING)
        if self.is_overloaded:  # a timer, because a replay lacks events without data
            self._output.run_once("overload", time_us + PAUSE_US, self._end_overload)

    @staticmethod
    def held_up(data: bytes) -> int:
        """Return the total duration (µs) of stalls that the state frames in `data` report."""
        return sum(one["duration"] for one in Codec(0, 0).parse(data) if one.id == STANDSTILL)

    def receive(self, data: bytes, time_us: int) -> None:
        """Process the state frames in `data`, from an event at `time_us` (µs)."""
        for message in Codec(0, 0).parse(data):
            if message.id == CLOCK_STEP:
                self._codec.utc_offset_us += message["step"]
                step = f"clock was set by {message['step'] * 1e-6:+.3f} s"
                self._output.send_statustext(step, MAV_SEVERITY.NOTICE)
                self.check_clock()
            elif message.id == INTERLEAVED:  # in a replay
                self._codec.skip(message["count"])
            elif message.id == NOTICE:
                self._output.send_statustext(message["text"], MAV_SEVERITY(message["severity"]))
            elif message.id == STANDSTILL:
                self._stood_still(time_us, message["duration"])
            elif message.id == PORT:
                well = message["state"] == MAG_PORT_STATE.OK
                self._port(message["port"], well, message["reason"], message["dropped"], time_us)

    def check_clock(self) -> None:
        """Send a STATUSTEXT if the host's clock was never set, and another one when it is set."""
        unset = self._codec.utc_us < CLOCK_SET_US
        if unset or self._clock_unset:
            text = "host clock was never set: no date, no main field" if unset else "host clock is set"
            severity = MAV_SEVERITY.WARNING if unset else MAV_SEVERITY.INFO
            self._output.announce("clock", text, severity)
        self._clock_unset = unset

    def _stood_still(self, time_us: int, duration_us: int) -> None:
        if time_us > self.until_us:  # else the stall continues an earlier one
            self.since_us = time_us - duration_us
        self.until_us = time_us + GRACE_US
        self._find_overload(time_us, duration_us)
        if duration_us >= NOTICE_US and not self.is_overloaded:
            text = f"stood still for {duration_us * 1e-6:.1f} s: late samples are flagged"
            self._output.send_statustext(text, MAV_SEVERITY.WARNING)

    def _port(self, port: int, well: bool, reason: str, dropped: int, time_us: int) -> None:
        severity = MAV_SEVERITY.INFO if well else MAV_SEVERITY.ERROR
        if port == MAG_PORT_NAME.LOG:
            self.log_state = MAG_LOG_STATE.OK if well else MAG_LOG_STATE.FAILED
            self.log_lost = dropped
            self._output.announce("log", f"log: {reason or 'being written'}", severity)
        elif port not in (MAG_PORT_NAME.LINK, MAG_PORT_NAME.NMEA):
            if (sensor := self._sensors.get(source_of(port)[1])) is not None:
                sensor.opened(time_us) if well else sensor.closed(reason)
        else:
            severity = MAV_SEVERITY.WARNING if well and reason else severity
            name = "link" if port == MAG_PORT_NAME.LINK else "heading.nmea"
            self._output.announce(name, f"{name}: {reason or 'open'}", severity)


BYTES: Final = spec("MAG_SENSOR_BYTES")
RAW: Final = spec("MAG_RAW")
BYTES_HEADER: Final = Struct("<BB")
"""Layout of the fields of MAG_SENSOR_BYTES before its data: sensor_id, length."""
RECORDED_BYTES: Final = BYTES.fields["data"].count
SENT, _, SENSOR, STATE = Channel


class Recorder:
    """Collector of the records for the log, which the caller takes out with :meth:`drain`.

    `active`: True if records are collected and counted; False without a log.
    `count`: number of records since the start.
    """

    def __init__(self, system: int, component: int, *, active: bool) -> None:
        self.active = active
        self.count = 0
        self._records: list[tuple[int, Channel, bytes]] = []
        self._scribe = Codec(system, component)

    def record(self, time_us: int, channel: Channel, frame: bytes) -> None:
        """Record a frame that was received over the link, a state frame, or a frame of the start."""
        if self.active:
            self._records.append((time_us, channel, frame))
            self.count += 1

    def sent(self, frames: list[tuple[int, bytes]]) -> None:
        """Record the frames sent over the link, each with its event time (µs)."""
        if self.active and frames:
            self._records += [(time_us, SENT, frame) for time_us, frame in frames]
            self.count += len(frames)

    def sensor(self, time_us: int, data: bytes, sensor_id: int = 0) -> None:
        """Record the bytes that were received from a sensor at `time_us` (µs)."""
        if not self.active:
            return
        for start in range(0, len(data), RECORDED_BYTES):
            piece = data[start : start + RECORDED_BYTES]
            frame = self._scribe.frame(BYTES, BYTES_HEADER.pack(sensor_id, len(piece)) + piece)
            self._records.append((time_us, SENSOR, frame))
            self.count += 1

    def raw(self, time_us: int, payload: bytes) -> None:
        """Record a MAG_RAW payload that is not sent over the link; a calibration needs every sample."""
        self.record(time_us, STATE, self._scribe.frame(RAW, payload))

    def drain(self) -> list[tuple[int, Channel, bytes]]:
        """Return the collected records in order, as event time (µs), channel and frame; then clear them."""
        records, self._records = self._records, []
        return records


def beginning(
    config: Config, start: StartEvent, calibration_id: int, parameters: Mapping[str, float]
) -> list[bytes]:
    """Return the frames that record the start of a run.

    `parameters`: values of the parameters, by name, in place of the values in `start`.
    """
    codec = Codec(config.link.system, config.link.component)
    frames = [
        codec.pack(
            "MAG_BRIDGE_START",
            time_usec=start.time_us,
            signing_timestamp=start.signing_timestamp,
            calibration_id=calibration_id,
            config_digest=bytes.fromhex(config.digest),
            version=__version__,
            driver=config.sensor.driver,
        )
    ]
    for link, system, sender, ahead, stamp in start.signing_streams:
        stream = {"link": link, "system": system, "sender": sender, "ahead": ahead, "stamp": stamp}
        frames.append(codec.pack("MAG_SIGNING_STREAM", **stream))
    for name, value in parameters.items():
        real = MAV_PARAM_TYPE.REAL32
        frames.append(codec.pack("PARAM_VALUE", param_id=name, param_value=value, param_type=real))
    return frames


def declarations(config: Config, drivers: Sequence[Driver], settings: Mapping[str, float]) -> list[bytes]:
    """Return the frames that declare the source and the scale of each column of the log.

    If a sensor has counts, readers of the log compute its channels from them, because they are more precise
    than MAG_RAW's float32 fields. The columns of a sensor after the first have the name of the sensor:
    ``NAME`` for a scalar, else ``NAME_x``, ``NAME_y`` and ``NAME_z``; ``NAME_time`` is the time of the
    reading.

    `drivers`: drivers of all sensors.
    `settings`: settings that affect flags and sigmas, by key in the configuration, as attributes of the log.
    """
    codec = Codec(config.link.system, config.link.component)
    columns: list[dict[str, Any]] = [{"column": key, "scale": value} for key, value in settings.items()]
    columns += [
        {
            "column": name,
            "unit": one.unit,
            "message": one.message,
            "field": one.field,
            "match": ",".join(f"{field}={value}" for field, value in one.match.items()),
            "scale": one.scale,
            "offset": one.offset,
            "component": one.component or 0,
        }
        for name, one in config.telemetry.items()
    ]
    for sensor, driver in zip(config.sensors, drivers, strict=True):
        raw: dict[str, Any] = {"message": "MAG_RAW", "unit": "nT", "scale": driver.nt_per_count or 1.0}
        prefix = "count_" if driver.nt_per_count else ""
        if not sensor.id:
            names = {axis: f"mag_{axis}" for axis in "xyz"} if prefix else {}
        else:
            raw["match"] = f"sensor_id={sensor.id}"
            scalar = is_scalar(driver)
            names = {"x": sensor.name} if scalar else {axis: f"{sensor.name}_{axis}" for axis in "xyz"}
            time = {"column": f"{sensor.name}_time", "field": "time_usec", "unit": "s", "scale": 1e-6}
        columns += [raw | {"column": name, "field": f"{prefix}{axis}"} for axis, name in names.items()]
        columns += [raw | time] if sensor.id else []
    return [codec.pack("MAG_COLUMN", **column) for column in columns]


PORT_RETRY_S = 0.25
"""Time between two attempts to open a port that is down, s."""
CLOSE_TIMEOUT_S = 2.0
"""Time that :meth:`LiveEdge.close` waits for a running attempt to open a port, s."""
SLOW_US = 10_000_000
"""Shortest time between two reports that the link is too slow, µs."""
CLOCK_CHECK_INTERVAL_US = 100_000
"""Time between two checks for a step of the host's clock and for a link that is too slow, µs."""
BACKLOG = 1 << 20
"""Most bytes of the link's backlog that are read at once after a stall."""
STANDSTILL_US = 400_000
"""Duration of one pass of the event loop that means a stall of the process, µs. A pass waits for at most
`CLOCK_CHECK_INTERVAL_US`."""


class LiveEdge:
    """Source of live events, which reads the ports and the clock, and sends data to the ports.

    `ports`: ports of the link, the sensors and the NMEA sentences, by MAG_PORT_NAME; opened in this order by
        the constructor. The port for NMEA sentences is not read.
    `clock`: clock for the times of events.
    """

    def __init__(self, ports: Mapping[int, Port], clock: HostClock) -> None:
        self._ports = ports
        self._read_ports = {number: port for number, port in ports.items() if number != MAG_PORT_NAME.NMEA}
        self._clock = clock
        self._changes: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._woken, self._waker = os.pipe()
        self._stopping = False
        self._overrun = self._slow_us = 0
        self._openers: dict[int, threading.Thread] = {}
        for number, port in ports.items():
            tried = threading.Event()
            opener = threading.Thread(
                target=self._keep_open, args=(number, port, tried), name="port opener", daemon=True
            )
            self._openers[number] = opener
            opener.start()
            tried.wait(PORT_RETRY_S)  # so that a report on the next port can be sent over this port

    def events(self, deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield events until :meth:`stop`; yield an empty event when the time ``deadline()`` (µs) passes."""
        before_us = self._clock.now_us()
        check_us = before_us + CLOCK_CHECK_INTERVAL_US
        while not self._stopping:
            # the checks need no wake-up of their own while events arrive
            wait = min(deadline() - self._clock.now_us(), CLOCK_CHECK_INTERVAL_US) * 1e-6
            lines = {fd: number for number, port in self._read_ports.items() for fd in port.fds()}
            full = [number for number, port in self._ports.items() if port.waiting]
            blocked = [fd for number in full for fd in self._ports[number].blocked()]
            try:
                ready = select.select([*lines, self._woken], blocked, [], max(wait, 0.0))[0]
            except (OSError, ValueError):  # a descriptor was closed before the call of select()
                continue
            now_us = self._clock.now_us()
            for number in full:
                self._flush(number)
            if self._woken in ready:
                os.read(self._woken, 4096)
            while not self._changes.empty():  # the event that a port opened comes before its data
                yield Event(now_us, Channel.STATE, self._changes.get())
            if held := now_us - before_us > STANDSTILL_US:
                yield Event(now_us, Channel.STATE, standstill(now_us, now_us - before_us))
            before_us = now_us
            for fd in ready:
                if fd != self._woken and (data := self._waiting(lines[fd], fd, held)):
                    channel, sensor_id = source_of(lines[fd])
                    yield Event(now_us, channel, data, sensor_id)
            if now_us >= check_us:
                check_us = now_us + CLOCK_CHECK_INTERVAL_US
                for state in self._check(now_us):
                    yield Event(now_us, Channel.STATE, state)
            if now_us >= deadline():
                yield Event(now_us, Channel.STATE, b"")

    def _check(self, now_us: int) -> Iterator[bytes]:
        """Yield state frames about a step of the host's clock, a notice of the link, and a slow link."""
        if step_us := self._clock.step_us():
            yield clock_step(now_us, step_us)
        if text := self._ports[Channel.LINK].notice():
            yield notice(text)
        link = self._ports[Channel.LINK]
        if link.overrun != self._overrun and now_us >= self._slow_us:
            self._overrun, self._slow_us = link.overrun, now_us + SLOW_US
            reason = f"too slow, {link.overrun} bytes not sent so far"
            yield port_state(Channel.LINK, reason, link.dropped, is_open=True)

    def send(self, number: int, data: bytes) -> None:
        """Send `data` to the port `number` (MAG_PORT_NAME); if the port is down, drop and count `data`."""
        port = self._ports[number]
        if not port.is_open:
            port.dropped += len(data)
            return
        try:
            port.write(data)
        except PortError as error:
            self._report(number, error.reason)

    def answer(self, sender: tuple[int, int], data: bytes) -> None:
        """Send `data` over the link, only to the peer of one system and component."""
        link = self._ports[Channel.LINK]
        try:
            if link.is_open:
                link.write_to(sender, data)
        except PortError as error:
            self._report(Channel.LINK, error.reason)

    def credit(self, frames: list[bytes]) -> None:
        """Pass the frames that were signed with the key to the link, which then replies to their senders."""
        self._ports[Channel.LINK].credit(frames)

    def _flush(self, number: int) -> None:
        """Send more of the pending data of a slow port."""
        try:
            self._ports[number].flush()
        except PortError as error:
            self._report(number, error.reason)

    def notify(self, state: bytes) -> None:
        """Add an event with a state frame; any thread may call this method."""
        self._changes.put(state)
        os.write(self._waker, b"!")

    def stop(self) -> None:
        """End :meth:`events` after the present pass; any thread or signal handler may call this method."""
        if not self._stopping:
            self._stopping = True
            os.write(self._waker, b"!")

    def close(self) -> None:
        """Close the ports, except a port that is still being opened, which the end of the process closes."""
        self._stopping = True
        for number, opener in self._openers.items():
            opener.join(CLOSE_TIMEOUT_S)
            if not opener.is_alive():
                self._ports[number].close()
        if not any(opener.is_alive() for opener in self._openers.values()):
            os.close(self._woken)
            os.close(self._waker)

    def _read(self, number: int, fd: int) -> bytes:
        port = self._ports[number]
        if fd not in port.fds():  # send() has lost the port since select() returned
            return b""
        try:
            return port.read()
        except PortError as error:
            self._report(number, error.reason)
            return b""

    def _waiting(self, number: int, fd: int, held: bool) -> bytes:
        """Return the waiting bytes of a port; after a stall (`held`), up to `BACKLOG` bytes of the link."""
        data = self._read(number, fd)
        # the readings of a stall need its telemetry
        while held and data and number == Channel.LINK and len(data) < BACKLOG:
            more = select.select([fd], [], [], 0)[0] if fd in self._ports[number].fds() else []
            piece = self._read(number, fd) if more else b""
            if not piece:
                break
            data += piece
        return data

    def _report(self, number: int, reason: str) -> None:
        """Add an event that a port is not open because of `reason`, or, without a reason, that it opened."""
        port = self._ports[number]
        # the port's name comes last, because the end of a long text is cut off
        self.notify(port_state(number, f"{reason}: {port.name}" if reason else "", port.dropped))

    def _keep_open(self, number: int, port: Port, tried: threading.Event) -> None:
        """Open the port whenever it is down; report each change once; set `tried` after the first attempt."""
        reported: str | None = None
        while not self._stopping:
            if not port.is_open:
                try:
                    port.open()
                    reason = ""
                except PortError as error:
                    reason = error.reason
                if not reason or reported != reason:
                    self._report(number, reason)
                reported = reason
            tried.set()
            time.sleep(PORT_RETRY_S)
