"""MAVLink component of the bridge: replies to requests, and periodic messages."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from math import isfinite, nan
from typing import Any

from magbridge.config import Link
from magbridge.link.files import GENERAL, crc32, metadata_files, uri
from magbridge.link.output import Output
from magbridge.link.parameters import Parameters, ParameterService, Tunable, rates
from magbridge.link.publish import DEFAULT_RATES_HZ, LIMITS, MASK, PUBLISHED, MessageRates, Publisher
from magbridge.link.telemetry import Stream, StreamRequests
from magbridge.link.vehicle import VehicleState
from magbridge.mavlink import BAD_DATA, REFUSED, Codec, FrameLogWriter, Message, Signing, by_id, spec
from magbridge.mavlink.codec import NOT_SIGNED
from magbridge.mavlink.enums import (
    FIRMWARE_VERSION_TYPE,
    MAG_PORT_STATE,
    MAV_AUTOPILOT,
    MAV_CMD,
    MAV_PROTOCOL_CAPABILITY,
    MAV_RESULT,
    MAV_SEVERITY,
    MAV_STATE,
    MAV_TYPE,
)
from magbridge.mavlink.messages import is_signed

__all__ = ["TIMESYNC_US", "Component"]

FIRST_DIALECT_ID = 60100
"""First message id of the bridge's dialect; no other component of the vehicle has these messages."""
CALIBRATES = {MAV_CMD.PREFLIGHT_CALIBRATION, *(one for one in MAV_CMD if "MAG_CAL" in one.name)}
ABOUT_MESSAGES = MAV_CMD.REQUEST_MESSAGE, MAV_CMD.SET_MESSAGE_INTERVAL, MAV_CMD.GET_MESSAGE_INTERVAL
MAX_COMMAND_RATE = 100
"""Most commands of one sender that are executed within a second; further commands are rejected
temporarily."""
SENDERS = 64
"""Most senders whose commands are counted separately within a second; all other senders share one count."""
AUTOPILOT_VERSION, MESSAGE_INTERVAL = spec("AUTOPILOT_VERSION").id, spec("MESSAGE_INTERVAL").id


class Commands:
    """Handler of COMMAND_LONG and COMMAND_INT.

    A command to component 0 is for any component that can execute it. Of these commands, the bridge executes
    only those about messages of its own dialect. It ignores the rest, because a ground station would take a
    rejection for the autopilot's. The bridge does not execute compass calibration (DO_START_MAG_CAL and
    similar), but explains in a STATUSTEXT how its magnetometer is calibrated.
    """

    def __init__(self, component: Component) -> None:
        self._component, self._output = component, component.output
        by_name: dict[str, Callable[[], bool | None]] = {
            "HEARTBEAT": component.send_heartbeat,
            "MAG_STATUS": component.send_status,
            "AUTOPILOT_VERSION": component.send_version,
            "COMPONENT_INFORMATION_BASIC": component.send_information,
            "COMPONENT_METADATA": component.send_metadata,
            **{name: partial(component.publisher.repeat, name) for name in PUBLISHED},
        }
        self._messages = by_id(**by_name)
        self._second_us = 0
        self._asked: dict[tuple[int, int], int] = {}
        self._commands = {
            MAV_CMD.REQUEST_MESSAGE: self._request,
            MAV_CMD.SET_MESSAGE_INTERVAL: self._set_interval,
            MAV_CMD.GET_MESSAGE_INTERVAL: self._get_interval,
            MAV_CMD.REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
        }

    def handle(self, message: Message) -> None:
        """Execute and acknowledge a command that is addressed to the bridge or to all components."""
        target = message["target_component"]
        number = message["command"]
        values = [message["param1"], message["param2"]]
        is_ours = number in ABOUT_MESSAGES and values[0] >= FIRST_DIALECT_ID and values[0] in self._messages
        if target == 0 and not is_ours:
            return
        command, may_change = self._commands.get(number), self._component.parameter_service.may_change
        if self._is_flood(message.system, message.component):
            text = f"more than {MAX_COMMAND_RATE} commands a second from {message.system}:{message.component}"
            self._output.announce("flood", text, MAV_SEVERITY.WARNING)
            result = MAV_RESULT.TEMPORARILY_REJECTED
        elif number == MAV_CMD.SET_MESSAGE_INTERVAL and not may_change(message):
            text = f"{message.system}:{message.component} may not set a rate: no station, no autopilot"
            self._output.announce("rate", text, MAV_SEVERITY.WARNING, recurring=True)
            result = MAV_RESULT.DENIED
        else:
            result = command(values) if command else MAV_RESULT.UNSUPPORTED
            if number in CALIBRATES:
                text = "this magnetometer is calibrated from its logs: magbridge calibrate"
                self._output.announce("calibrate", text, MAV_SEVERITY.NOTICE, recurring=True)
        self._output.send(
            "COMMAND_ACK",
            command=number,
            result=result,
            progress=0xFF,  # not known
            target_system=message.system,
            target_component=message.component,
        )

    def _is_flood(self, system: int, component: int) -> bool:
        """Count a command; return True if its sender has sent more than `MAX_COMMAND_RATE` in this second."""
        now_us = self._output.codec.now_us
        if now_us - self._second_us >= 1_000_000:
            self._second_us, self._asked = now_us, {}
        who = (system, component) if (system, component) in self._asked else (0, 0)
        if len(self._asked) < SENDERS:
            who = system, component
        self._asked[who] = self._asked.get(who, 0) + 1
        return self._asked[who] > MAX_COMMAND_RATE

    def _request(self, values: list[float]) -> MAV_RESULT:
        if values[0] == MESSAGE_INTERVAL:  # the successor of GET_MESSAGE_INTERVAL
            return self._get_interval(values[1:])
        answer = self._messages.get(to_integer(values[0]))
        if answer is None:
            return MAV_RESULT.DENIED
        return MAV_RESULT.TEMPORARILY_REJECTED if answer() is False else MAV_RESULT.ACCEPTED

    def _set_interval(self, values: list[float]) -> MAV_RESULT:
        interval = values[1]
        if not isfinite(interval) or (interval < 0 and interval != -1):
            return MAV_RESULT.DENIED
        rate = None if interval == 0 else -1.0 if interval < 0 else 1e6 / interval
        parameter = self._component.message_rates.set(to_integer(values[0]), rate)
        if parameter:
            self._component.parameter_service.send(parameter)
        return MAV_RESULT.ACCEPTED if parameter else MAV_RESULT.DENIED

    def _get_interval(self, values: list[float]) -> MAV_RESULT:
        number = to_integer(values[0])
        if not 0 <= number <= 0xFFFF:
            return MAV_RESULT.DENIED
        interval = self._component.message_rates.interval_us(number, self._component.sample_rate)
        self._output.send("MESSAGE_INTERVAL", message_id=number, interval_us=interval)
        return MAV_RESULT.ACCEPTED

    def _capabilities(self, values: list[float]) -> MAV_RESULT:
        if values[0] != 1:
            return MAV_RESULT.DENIED
        return self._request([AUTOPILOT_VERSION])


def to_integer(value: float) -> int:
    """Return a float parameter as an integer, or -1 (no message has this id) if it is not finite."""
    return int(value) if isfinite(value) else -1


HEARTBEAT_SPEC, STATUS = spec("HEARTBEAT"), spec("MAG_STATUS")
ALIVE, CRITICAL = (
    HEARTBEAT_SPEC.payload(
        type=MAV_TYPE.ONBOARD_CONTROLLER,
        autopilot=MAV_AUTOPILOT.INVALID,
        system_status=state,
        mavlink_version=3,
    )
    for state in (MAV_STATE.ACTIVE, MAV_STATE.CRITICAL)
)
CAPABILITIES = (
    MAV_PROTOCOL_CAPABILITY.PARAM_FLOAT
    | MAV_PROTOCOL_CAPABILITY.COMMAND_INT
    | MAV_PROTOCOL_CAPABILITY.MAVLINK2
    | MAV_PROTOCOL_CAPABILITY.FTP
    | MAV_PROTOCOL_CAPABILITY.PARAM_ENCODE_C_CAST
)
TIMESYNC = spec("TIMESYNC")
SETUP_SIGNING = spec("SETUP_SIGNING").id.to_bytes(3, "little")
TIMESYNC_US = 1_000_000
MOST_REQUESTS = 64
"""Most requests for files that wait for the bridge; a further request displaces the oldest."""
FILE_REQUESTS = ("FILE_TRANSFER_PROTOCOL", "LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END")


class Component:
    """MAVLink component of the bridge, without port or clock: equal events give equal bytes.

    `link`: section ``[link]``: ids of the vehicle, the bridge and the autopilot.
    `publish`: section ``[publish]``: rates in Hz; a message without rate has the rate in `DEFAULT_RATES_HZ`,
        or is off.
    `tunables`: parameters in addition to the messages' rates.
    `start_us`: event time of the start, in µs since 1970 UTC; a multiple of 4.
    `signing`: keys of signed frames; None if the link is not signed.
    `calibration_id`: CRC-32 of the calibration file; 0 without a calibration.
    `version`: version of the program, such as ``"0.1.0"``.
    `kept`: values of the parameters that a station changed in an earlier run, by name.
    `status`: returns the fields of MAG_STATUS on the samples, the log and the sensor. The state of the
        heartbeat is CRITICAL unless ``sensor_state`` is OK.
    `streams`: needed rates of telemetry, see :func:`needed_rates`.
    `output`: messages to send, with the timers and the STATUSTEXTs.
    `received`: all received bytes as frames for the log; the bridge empties the list.
    `signed_frames`: the signed frames of the last :meth:`receive` that were accepted.
    `file_requests`: requests for files; the bridge takes them out and replies.
    `metadata`: contents of the files that describe the parameters, by path.
    `more_reports`: functions that are called after each MAG_STATUS, to send further messages at its rate.
    `parameters`, `parameter_service`, `message_rates`, `vehicle`, `publisher`: services of the component.
    """

    def __init__(
        self,
        link: Link,
        publish: Mapping[str, float],
        tunables: Iterable[Tunable] = (),
        *,
        start_us: int,
        signing: Signing | None = None,
        calibration_id: int = 0,
        version: str = "0.0.0",
        kept: Mapping[str, float] | None = None,
        status: Callable[[], dict[str, Any]] = dict,
        streams: Mapping[Stream, tuple[float, float]] | None = None,
    ) -> None:
        self._link = link
        self.codec = Codec(link.system, link.component, signing)
        self.codec.now_us = start_us
        self._frame_log = FrameLogWriter(link.system, link.component)
        self.output = Output(self.codec)
        self.received: list[bytes] = []
        self.signed_frames: list[bytes] = []
        self._whole = link.shared
        self._refusals_reported = 0
        self.vehicle = VehicleState(link.system, link.component, link.autopilot, self.output)
        self.streams = StreamRequests(self.peer, streams or {}, self.output, active=link.request_streams)
        self.vehicle.on_reboot = self.streams.rebooted
        self.parameters = Parameters([*rates({**DEFAULT_RATES_HZ, **publish}, LIMITS), *tunables])
        for name in self.parameters.restore(kept or {}):
            self.output.send_statustext(f"kept parameter {name} does not fit: default", MAV_SEVERITY.WARNING)
        if changed := self.parameters.changed():
            self.output.send_statustext(f"kept from the link, not as configured: {', '.join(changed)}")
        self.message_rates = MessageRates(self.parameters, self.output)
        self.rates = self.message_rates.by_name
        self.publisher = Publisher(self.output, self.rates, calibration_id, start_us)
        self.metadata = metadata_files(self.parameters.table.values(), link.component)
        self.file_requests: deque[Message] = deque(maxlen=MOST_REQUESTS)
        self._version, self._status, self._start_us = version, status, start_us
        self.more_reports: list[Callable[[], object]] = []
        self.parameter_service = ParameterService(self.parameters, self.output, self.peer)
        self._handlers = self._open_handlers()
        self.message_rates.send_by_clock("HEARTBEAT", self.send_heartbeat)
        self.message_rates.send_by_clock("MAG_STATUS", self.send_status)
        self.output.every("TIMESYNC", TIMESYNC_US, self._ask_time, start_us + TIMESYNC_US // 2)

    def _open_handlers(self) -> dict[int, Callable[[Message], None]]:
        """Return the handlers of requests, replies and heartbeats, by message id."""
        service, command = self.parameter_service, self._if_ours(Commands(self).handle)
        return by_id(
            PARAM_REQUEST_LIST=self._if_ours(service.list),
            PARAM_REQUEST_READ=self._if_ours(service.read),
            PARAM_SET=self._if_ours(service.write),
            TIMESYNC=self._if_ours(self._timesync),
            HEARTBEAT=service.heartbeat,
            LOG_ERASE=self._if_ours(self._erase, is_exact=True),
            **dict.fromkeys(("COMMAND_LONG", "COMMAND_INT"), command),
            **dict.fromkeys(FILE_REQUESTS, self._if_ours(self.file_requests.append, is_exact=True)),
        )

    @property
    def peer(self) -> tuple[int, int]:
        """System id and component id of the autopilot."""
        return self._link.system, self._link.autopilot

    def another_publisher(self, sensor_id: int, calibration_id: int) -> Publisher:
        """Return a publisher of a further sensor's samples, as MAG_RAW and MAG_FIELD with `sensor_id`."""
        rates = {name: self.message_rates.another(name) for name in ("MAG_RAW", "MAG_FIELD")}
        return Publisher(self.output, rates, calibration_id, sensor_id=sensor_id)

    def receive(self, data: bytes, t_us: int) -> list[Message]:
        """Process bytes received at `t_us` (µs); return the messages that are telemetry of our vehicle.

        Replies to requests go to the output, which the caller has advanced to `t_us` before.
        """
        self.codec.now_us = t_us
        ours = []
        messages = self.codec.parse(data, final=self._whole)
        self.received += self._frame_log.frames(messages, self.codec.pending)
        if self.codec.signing is not None:
            self.signed_frames = [one.frame for one in messages if one.known and is_signed(one.frame)]
            if (days := self.codec.signing.followed_days) >= 1.0:  # the autopilot rejects older signatures
                text = f"clock is {days:.0f} days behind the autopilot's: signatures follow its time"
                self.output.announce("signing clock", text, MAV_SEVERITY.WARNING)
        for message in messages:
            if not message.known:
                if message.id == REFUSED:
                    self._report_refusals(message)
                if message.id != BAD_DATA:
                    self.vehicle.count(message, t_us)
                continue
            handler = self._handlers.get(message.id)
            if handler:
                handler(message)
            if self.vehicle.receive(message, t_us):
                self.streams.receive(message, t_us)
                ours.append(message)
        return ours

    def _report_refusals(self, message: Message) -> None:
        """Send one STATUSTEXT for each reason why frames are rejected, since their sender seems absent."""
        if message.frame[7:10] == SETUP_SIGNING:
            text = f"key from {message.system}:{message.component} not taken: keys come from a file"
            self.output.announce("key", text, MAV_SEVERITY.WARNING)
        if self.codec.signing is None:
            return
        refusals = list(self.codec.signing.refusals.items())
        for why, (system, component) in refusals[self._refusals_reported :]:
            text = f"frames of {system}:{component} refused: {why}"
            if why == NOT_SIGNED:
                text += ", or a router has removed the signature"
            self.output.announce(f"refused: {why}", text, MAV_SEVERITY.WARNING)
        self._refusals_reported = len(refusals)

    def _if_ours(
        self, handler: Callable[[Message], None], *, is_exact: bool = False
    ) -> Callable[[Message], None]:
        """Return a handler that ignores messages for others; if `is_exact`, also those for all components."""
        system, component = self._link.system, self._link.component
        # the autopilot serves files and logs too, so a broadcast request for them is not for the bridge
        systems, components = ((system,), (component,)) if is_exact else ((0, system), (0, component))

        def handle(message: Message) -> None:
            if message["target_system"] in systems and message["target_component"] in components:
                handler(message)

        return handle

    def _erase(self, _: Message) -> None:
        text = "logs are not erased over the link"
        self.output.announce("erase", text, MAV_SEVERITY.WARNING, recurring=True)

    def _timesync(self, message: Message) -> None:
        now_us = self.codec.now_us
        if message["tc1"] == 0:
            answer = TIMESYNC.struct.pack(now_us * 1000, message["ts1"], message.system, message.component)
            self.output.put(TIMESYNC, answer)
        elif (message.system, message.component) == (self._link.system, self._link.autopilot):
            self.vehicle.clock.answer(message["tc1"], message["ts1"], now_us)

    def _ask_time(self, t_us: int) -> None:
        ts1 = self.vehicle.clock.ask(t_us)
        self.output.put(TIMESYNC, TIMESYNC.struct.pack(0, ts1, self._link.system, self._link.autopilot))

    def send_heartbeat(self) -> None:
        """Send HEARTBEAT, with state ACTIVE if the sensor delivers readings, else CRITICAL."""
        is_alive = self._status().get("sensor_state") == MAG_PORT_STATE.OK
        self.output.put(HEARTBEAT_SPEC, ALIVE if is_alive else CRITICAL)

    def send_status(self) -> None:
        """Send MAG_STATUS, then those of `more_reports`."""
        codec, vehicle = self.codec, self.vehicle
        clock, offset_us = vehicle.clock, vehicle.clock.offset_us(codec.now_us)
        payload = STATUS.payload(
            time_usec=codec.utc_us,
            vehicle_clock_offset=round(offset_us) - codec.utc_offset_us if clock.known else 0,
            uptime=(codec.now_us - self._start_us) // 1_000_000 & MASK,
            calibration_id=self.publisher.calibration_id,
            link_frames=codec.frames & MASK,
            link_frames_lost=vehicle.frames_lost & MASK,
            link_bytes_skipped=codec.bytes_skipped & MASK,
            link_refused=codec.signing.refused & MASK if codec.signing else 0,
            vehicle_clock_sigma=clock.sigma,
            vehicle_clock_drift=clock.drift_ppm,
            vehicle_reboots=vehicle.reboots & 0xFFFF,
            autopilot_state=vehicle.state,
            **{"sample_rate": nan, "sensor_clock_drift": nan} | self._status(),
        )
        self.output.put(STATUS, payload)
        for send in self.more_reports:
            send()

    def send_version(self) -> None:
        """Send AUTOPILOT_VERSION."""
        numbers = [int(number) & 0xFF for number in re.findall(r"\d+", self._version)[:3]]
        version = bytes([*numbers, 0, 0, 0][:3]) + bytes((FIRMWARE_VERSION_TYPE.OFFICIAL,))
        self.output.send(
            "AUTOPILOT_VERSION", capabilities=CAPABILITIES, flight_sw_version=int.from_bytes(version, "big")
        )

    def send_information(self) -> None:
        """Send COMPONENT_INFORMATION_BASIC."""
        self.output.send(
            "COMPONENT_INFORMATION_BASIC",
            time_boot_ms=self._boot_ms,
            capabilities=CAPABILITIES,
            vendor_name="magbridge",
            model_name="magnetometer bridge",
            software_version=self._version,
        )

    def send_metadata(self) -> None:
        """Send COMPONENT_METADATA with the URI of the files that describe the parameters."""
        general, component = self.metadata[GENERAL], self.codec.component
        self.output.send(
            "COMPONENT_METADATA",
            time_boot_ms=self._boot_ms,
            file_crc=crc32(general),
            uri=uri(component, GENERAL),
        )

    @property
    def sample_rate(self) -> float:
        """Recent rate of the sensor's samples, Hz; NaN while unknown."""
        rate: float = self._status().get("sample_rate", nan)
        return rate

    @property
    def _boot_ms(self) -> int:
        return (self.codec.now_us - self._start_us) // 1000 & MASK
