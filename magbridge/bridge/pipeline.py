"""Processing of the bridge without its ports, from events to frames; equal events give equal bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import nan, sqrt
from typing import TYPE_CHECKING, Any, Final, Protocol

from msgspec.structs import replace

from magbridge.align import Sample
from magbridge.bridge import events
from magbridge.bridge.events import Event, Recorder, StartEvent, StateChanges, port_number
from magbridge.bridge.learning import LearningService, first_calibration, open_learner
from magbridge.bridge.position import LiveHeading, Position
from magbridge.bridge.sensor import SensorStream, open_correction, open_drivers, other_calibrations
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration
from magbridge.config import Align, Config
from magbridge.correction import Correction
from magbridge.health.comparison import SensorComparison
from magbridge.link.component import Component
from magbridge.link.estimates import NO_ATTITUDE, Attitude
from magbridge.link.parameters import alignment, file_rate, learning, telemetry_ages
from magbridge.link.publish import MASK, check_publish
from magbridge.link.telemetry import EKF_STATUS, PX4_STATUS, TelemetryMap, is_possible, needed_rates
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import Message, Signing, Spec, load_key, spec
from magbridge.mavlink.enums import MAG_PORT_NAME, MAV_SEVERITY
from magbridge.records import Channel, Corrected, Quality, Reading
from magbridge.scalar_correction import ScalarCorrection
from magbridge.sensors import Driver
from magbridge.version import __version__

if TYPE_CHECKING:
    from magbridge.bridge.navigation import NavigationService

__all__ = ["Pipeline", "drive", "set_up"]

NOT_USED = "calibration is not of a {}: not used"

LINK: Final = Channel.LINK
SENSOR: Final = Channel.SENSOR
ATTITUDE_ID, POSITION_ID = spec("ATTITUDE").id, spec("GLOBAL_POSITION_INT").id
HEADING_INPUTS: Final = frozenset((ATTITUDE_ID, EKF_STATUS, PX4_STATUS, spec("HEARTBEAT").id))
"""Ids of the messages that the computation of the heading uses."""
ANNOUNCED_FLAGS = int(
    Quality.STALE_TELEMETRY
    | Quality.SATURATED
    | Quality.UNCALIBRATED
    | Quality.OFFSET_SUSPECT
    | Quality.UNEXPLAINED
)
"""Quality flags whose changes are sent as STATUSTEXT; other flags change with every manoeuvre."""


class Pipeline:
    """Processor of events (sensor bytes, link bytes, changes of state) to MAVLink frames and sensor commands.

    `calibration`: calibration of the first sensor, or None.
    `start`: state at the start of the run.
    `key`: key of 32 bytes for signing; None for a link without signatures.
    `navigate`: function that creates the navigation service; None without ``[navigation]``.
    `more`: calibrations of the sensors after the first, by sensor id.
    `component`: the MAVLink component.
    `recorder`: records for the log of all inputs and outputs since the recorder was last drained.
    `streams`: the sensors; the first is the main sensor.
    ConfigError: a driver, option, message, field or rate is not valid, or ``[telemetry]`` lacks a parameter
        of a calibration or has it in another unit.
    """

    def __init__(
        self,
        config: Config,
        calibration: Calibration | None,
        start: StartEvent,
        key: bytes | None = None,
        navigate: Callable[[Component], NavigationService] | None = None,
        more: Mapping[int, Calibration] | None = None,
    ) -> None:
        self._config, self._start = config, start
        drivers = open_drivers(config)
        self._telemetry = TelemetryMap(config.telemetry, config.link.autopilot, config.path)
        check_publish(config.publish, config.path)
        foreign = calibration is not None and not calibration.sensor.may_be(config.sensor.driver)
        learner = open_learner(config, None if foreign else calibration)
        main, used = open_correction(config.sensor, drivers[0], config, calibration, None, learner)
        self._correction = main
        self._direction = main.direction if isinstance(main, Correction) else None
        self._calibration_id = calibration_id(used) if used else 0
        own = config.link
        stamps = start.signing_timestamp, start.signing_streams
        self.signing = Signing(key, *stamps, (own.system, own.autopilot)) if key else None
        self.component = self._open_component()
        publisher = self.component.publisher
        stream = SensorStream(config.sensor, drivers[0], main, self.component, start.time_us, publisher)
        self.streams = [stream, *self._other_streams(drivers[1:], more or {}, used)]
        self._by_id = {one.sensor_id: one for one in self.streams}
        if len(self.streams) > 1:
            self.component.more_reports += [one.report for one in self.streams]
        self._changes = StateChanges(self.component.output, self._by_id)
        main_label = config.sensor.label
        self._comparisons = [SensorComparison((main_label, one.label)) for one in config.more_sensors]
        self.recorder = Recorder(own.system, own.component, active=config.log is not None)
        self.navigation = navigate(self.component) if navigate else None
        self.learning = LearningService(learner, self.component) if learner is not None else None
        self._raw_rate = self.component.rates["MAG_RAW"]
        self._parts = main.parts
        self._position = Position(self._report_no_anomaly)
        has_boresight = used is not None and used.boresight is not None
        self.heading = LiveHeading(config.heading, self.component) if has_boresight else None
        self._late = False
        self.component.parameters.watch(self._tune)
        self._tune()
        self._begin(start, used, foreign=foreign)

    def _open_component(self) -> Component:
        """Return the MAVLink component, with its parameters and the needed rates of messages."""
        config, start = self._config, self._start
        tunables = [*alignment(config.align), *telemetry_ages(config.telemetry), *file_rate()]
        if config.learning is not None:
            tunables += learning(config.learning.enabled)
        streams = needed_rates(
            config.link.autopilot,
            config.telemetry.values(),
            attitude=self._direction is not None,
            navigation=config.navigation is not None,
        )
        return Component(
            config.link,
            config.publish,
            tunables,
            start_us=start.time_us,
            signing=self.signing,
            calibration_id=self._calibration_id,
            version=__version__,
            kept=start.parameters,
            status=self._status,
            streams=streams,
        )

    def _other_streams(
        self, drivers: Sequence[Driver], calibrations: Mapping[int, Calibration], main: Calibration | None
    ) -> Iterator[SensorStream]:
        """Yield the sensors after the first; their `calibrations` by sensor id, `main` that of the first."""
        config, component = self._config, self.component
        for sensor, driver in zip(config.more_sensors, drivers, strict=True):
            number = sensor.id or 0
            own = calibrations.get(number)
            correction, used = open_correction(sensor, driver, config, own, main)
            if own is not None and used is None:
                component.output.send_statustext(NOT_USED.format(sensor.driver), MAV_SEVERITY.ERROR)
            publisher = component.another_publisher(number, calibration_id(used) if used else 0)
            yield SensorStream(sensor, driver, correction, component, self._start.time_us, publisher)

    @property
    def declarations(self) -> list[bytes]:
        """Frames at the begin of each log file, which declare its columns."""
        parameters = self.component.parameters
        keys = [row.key for row in parameters.table.values()]
        settings = {key: parameters.value_of(key) for key in keys if key.startswith(("align.", "telemetry."))}
        return events.declarations(self._config, [one.driver for one in self.streams], settings)

    @property
    def deadline(self) -> int:
        """Time by which :meth:`feed` must be called, if only with an empty event, µs since 1970 UTC."""
        return self.component.output.next_deadline

    def feed(self, event: Event) -> list[tuple[int, bytes]]:
        """Process an event; return the frames to send over the link, each with its event time (µs)."""
        component, recorder = self.component, self.recorder
        output, time_us, channel, data = component.output, event.time_us, event.channel, event.data
        if channel is Channel.STATE and data and (held_us := self._changes.held_up(data)):
            for name in ("autopilot", "overload", *(stream.timer for stream in self.streams)):
                output.delay(name, held_us)  # during a stall, silence cannot be observed
        output.advance(time_us)
        due: list[tuple[int, bytes]] = []
        if output.frames:
            due = output.drain()
            recorder.sent(due)
        if self._late and time_us > self._changes.until_us:
            self._late = False
            self._set_late(0)
        if channel is SENSOR:
            recorder.sensor(time_us, data, event.sensor_id)
            if (stream := self._by_id.get(event.sensor_id)) is not None:
                for reading in stream.receive(data, time_us):
                    self._sample(stream, reading)
        elif channel is LINK:
            self._receive_link(data, time_us)
        elif data:
            recorder.record(time_us, Channel.STATE, data)
            self._changes.receive(data, time_us)
            if self._changes.until_us >= time_us:
                self._late = True
                self._set_late(self._changes.since_us)
        answers = output.drain()
        recorder.sent(answers)
        return due + answers if due else answers

    def interleaved(self, messages: Sequence[tuple[Spec, bytes]]) -> bytes:
        """Return the bytes of messages to send that are not logged; the log records only their number.

        `messages`: layout and packed payload of each message.
        """
        codec = self.component.codec
        self.recorder.record(codec.now_us, Channel.STATE, events.interleaved(len(messages)))
        return b"".join([codec.frame(layout, payload) for layout, payload in messages])

    def _set_late(self, since_us: int) -> None:
        """Set the time since which inputs may have waited in a buffer, µs; 0 if they did not wait."""
        for stream in self.streams:
            stream.correction.aligner.late_since_us = since_us

    def _sample(self, stream: SensorStream, reading: Reading) -> None:
        position, main = self._position, self.streams[0]
        if isinstance(self._correction, Correction):
            self._correction.is_learning = not self._changes.is_overloaded
        utc_us = reading.time_us + self.component.codec.utc_offset_us
        main_field = self._parts.call("position", nan, position.main_field, reading.time_us, utc_us)
        place, depth = position.place_and_depth
        for sample, corrected in stream.correct(reading, main_field, place, depth):
            self._process(stream, sample, corrected)
        if self._comparisons and stream is main:
            for other in self.streams[1:]:
                for sample, corrected in other.complete():
                    self._process(other, sample, corrected)

    def _process(self, stream: SensorStream, sample: Sample, corrected: Corrected) -> None:
        """Check a corrected sample, pass it to navigation, heading and learning, and publish it."""
        # during an overload, most samples are only checked and published as MAG_RAW and MAG_FIELD
        is_brief = self._changes.is_overloaded and not stream.overload_rate.due(sample.time_us)
        if self._comparisons:
            call, compare = self._parts.call, self._compare
            corrected = call("comparison of sensors", corrected, compare, stream, sample.time_us, corrected)
        if stream.correction.notices:
            self._report_implausible(stream)
        doubtful = corrected.quality & ANNOUNCED_FLAGS
        if doubtful != stream.quality:
            self._report_doubtful(stream, doubtful)
        anomaly, attitude = corrected.total_field - corrected.main_field, NO_ATTITUDE
        is_main = stream is self.streams[0]
        if is_main:
            for other in self.streams[1:]:
                other.use_vector(sample.time_us, corrected.field)
            if self.navigation is not None and not is_brief:
                self._parts.call("navigation", None, self.navigation.sample, sample.time_us, corrected)
            if self.heading is not None and not is_brief:
                attitude = self._parts.call("heading", NO_ATTITUDE, self._attitude, sample, corrected)
        stream.publisher.publish(sample, corrected, anomaly, attitude, is_brief=is_brief)
        if is_main and self.heading is not None and self.heading.is_sending and not is_brief:
            self.heading.send(attitude, sample.time_us)
        if self.recorder.active and self._raw_rate.hertz != 0:
            self.recorder.raw(self.component.codec.now_us, stream.publisher.raw_payload(sample))
        if is_main and self.learning is not None:
            self._parts.call("learning", None, self.learning.sample, sample.time_us)

    def _compare(self, stream: SensorStream, time_us: int, corrected: Corrected) -> Corrected:
        """Return `corrected` with flags and sigmas updated by the comparison of the sensors."""
        stated = corrected.stated_sigma
        total = corrected.total_field, stated
        main = corrected.main_field, stream.correction.aligner.settings.reference_sigma
        variance, flags = 0.0, 0
        for other, comparison in zip(self.streams[1:], self._comparisons, strict=True):
            if stream is not other and stream is not self.streams[0]:
                continue
            side = 1 if stream is other else 0
            more, flag = comparison.update(side, time_us, total, main, corrected.quality)
            variance, flags = max(variance, more), flags | flag
            if comparison.message:
                severity = MAV_SEVERITY.ERROR if comparison.is_wrong else MAV_SEVERITY.INFO
                self.component.output.send_statustext(comparison.message, severity)
                comparison.message = ""
        if isinstance(stream.correction, Correction):
            stream.correction.is_contradicted = bool(flags or variance)
        # the checks of the sensor itself may have added this variance already
        missing = stated * stated + variance - corrected.total_field_sigma**2
        if not flags and not (variance and missing > 0.0):
            return corrected
        missing = max(missing, 0.0)
        sigma = sqrt(corrected.total_field_sigma**2 + missing)
        x, y, z = (sqrt(component * component + missing) for component in corrected.field_sigma)
        quality = corrected.quality | flags
        return replace(corrected, total_field_sigma=sigma, field_sigma=(x, y, z), quality=quality)

    def _attitude(self, sample: Sample, corrected: Corrected) -> Attitude:
        """Return the attitude at a sample, with the heading computed from the corrected field."""
        time_us, correction = sample.time_us, self._correction
        assert self.heading is not None
        assert isinstance(correction, Correction)
        utc_us = time_us + self.component.codec.utc_offset_us
        main = self._position.direction(corrected.main_field, utc_us)
        crustal = correction.aligner.settings.reference_sigma
        return self.heading.compute(sample, corrected, correction.corrector, main, crustal)

    def _receive_link(self, data: bytes, time_us: int) -> None:
        component = self.component
        for message in component.receive(data, time_us):
            for name, value, when_us in self._telemetry.values(message, time_us, component.vehicle.clock):
                if self._telemetry.admit(name, message, time_us, component.output):
                    guessed = self._late and when_us == time_us
                    true_us = when_us - self._telemetry.delays_us[name]
                    for stream in self.streams:
                        stream.correction.telemetry(name, value, true_us, guessed=guessed)
            if not is_possible(message):
                self.component.output.announce(
                    f"impossible {message.name}", f"{message.name} with impossible values ignored",
                    MAV_SEVERITY.WARNING,
                )  # fmt: skip
                continue
            if message.id == POSITION_ID and self._is_autopilot(message):
                self._parts.call("position", None, self._position.update, message, time_us)
            elif message.id == POSITION_ID:
                text = f"position of component {message.component} ignored"
                component.output.announce(text, text, MAV_SEVERITY.WARNING)
            elif message.id == ATTITUDE_ID and self._is_autopilot(message):
                self._parts.call("direction check", None, self._use_attitude, message, time_us)
            if self.heading is not None and message.id in HEADING_INPUTS and self._is_autopilot(message):
                self.heading.receive(message, time_us)
            if self.navigation is not None:
                self._parts.call("navigation", None, self.navigation.receive, message, time_us)
        for frame in component.received:
            self.recorder.record(time_us, LINK, frame)
        component.received.clear()

    def _is_autopilot(self, message: Message) -> bool:
        """Return True if the autopilot sent `message`."""
        return message.component == self._config.link.autopilot

    def _use_attitude(self, message: Message, time_us: int) -> None:
        """Pass the vehicle's attitude and the main field to the check of the measured field's direction."""
        if self._direction is not None:
            utc_us = time_us + self.component.codec.utc_offset_us
            main_field = self._position.main_field(time_us, utc_us)
            self._direction.expect(*self._position.direction(main_field, utc_us))
            self._direction.attitude(time_us, message["roll"], message["pitch"], message["yaw"])

    def _tune(self, _: str = "") -> None:
        """Apply the present values of the parameters to the alignment of samples with telemetry."""
        parameters = self.component.parameters
        settings = {name: parameters.value_of(f"align.{name}") for name in Align.__struct_fields__}
        ages = {name: parameters.value_of(f"telemetry.{name}.max_age") for name in self._config.telemetry}
        for stream in self.streams:
            stream.tune(Align(**settings), ages)

    def _report_doubtful(self, stream: SensorStream, doubtful: int) -> None:
        names = Quality(doubtful).names().replace("_", " ")
        severity = MAV_SEVERITY.WARNING if names else MAV_SEVERITY.INFO
        key = f"quality {stream.sensor_id}" if stream.sensor_id else "quality"
        field = f"field of {stream.sensor.label}" if len(self.streams) > 1 else "field"
        self.component.output.announce(key, f"{field}: {names or 'good'}", severity)
        stream.quality = doubtful

    def _report_implausible(self, stream: SensorStream) -> None:
        prefix = f"{stream.sensor.label}: " if len(self.streams) > 1 else ""
        for text in stream.correction.notices:
            self.component.output.send_statustext(prefix + text, MAV_SEVERITY.ERROR)
        stream.correction.notices.clear()

    def _report_no_anomaly(self, reason: str) -> None:
        self.component.output.announce("anomaly", f"no anomaly: {reason}", MAV_SEVERITY.WARNING)

    def _begin(self, start: StartEvent, calibration: Calibration | None, *, foreign: bool) -> None:
        """Record the frames that a replay needs; report the calibration, or its `foreign` type of sensor."""
        for frame in self.beginning(start.parameters):
            self.recorder.record(start.time_us, Channel.STATE, frame)
        self._changes.check_clock()
        send_statustext = self.component.output.send_statustext
        if foreign:
            send_statustext(NOT_USED.format(self._config.sensor.driver), MAV_SEVERITY.ERROR)
        elif isinstance(self._correction, ScalarCorrection):
            if self._config.sensor.sigma is None:
                send_statustext("scalar without sigma: field of the vehicle unknown", MAV_SEVERITY.WARNING)
        elif calibration is None:
            send_statustext("no calibration: raw field", MAV_SEVERITY.WARNING)
        elif calibration.method == "none":
            send_statustext("no calibration: learned in flight", MAV_SEVERITY.WARNING)
        else:
            send_statustext(f"calibration {self._calibration_id:08x}, {calibration.method}")
            if calibration.warnings:
                send_statustext("calibration is not supported by its data", MAV_SEVERITY.WARNING)

    def beginning(self, parameters: Mapping[str, float]) -> list[bytes]:
        """Return the frames that record the start of the run, with these values of `parameters` by name."""
        return events.beginning(self._config, self._start, self._calibration_id, parameters)

    def _status(self) -> dict[str, Any]:
        """Return the fields of MAG_STATUS about sensor, samples and log, by name."""
        now_us, main = self.component.codec.now_us, self.streams[0]
        tracks = self._correction.aligner.by_name
        stale = 0
        for bit, name in enumerate(self._config.telemetry):
            if bit < 32 and name in tracks and tracks[name].stale(now_us):
                stale |= 1 << bit
        # count unsent frames, too: in a replay, several timers may fire before the output is drained
        records = self.recorder.count + len(self.component.output.frames) if self.recorder.active else 0
        return {
            "samples": main.samples & MASK,
            "samples_lost": main.readings_lost & MASK,
            "sensor_bytes_skipped": main.driver.bytes_skipped & MASK,
            "sensor_frames_bad": main.driver.frames_bad & MASK,
            "sensor_state": main.state,
            "sensor_clock_drift": -main.clock.drift_ppm,
            "sample_rate": main.sample_rate,
            "telemetry_stale": stale,
            "log_records": records & MASK,
            "log_lost": self._changes.log_lost & MASK,
            "log_state": self._changes.log_state,
        }


class Edge(Protocol):
    """Source of events and destination of bytes."""

    def events(self, deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield events in order; yield an empty event if none came by the time ``deadline()`` (µs)."""
        ...

    def send(self, number: int, data: bytes) -> None:
        """Send `data` to the port `number` (MAG_PORT_NAME)."""
        ...

    def credit(self, frames: list[bytes]) -> None:
        """Record which frames of the last event from the link were signed with the key."""
        ...


def set_up(config: Config, start: StartEvent) -> Pipeline:
    """Return the pipeline that a configuration describes.

    ConfigError, FormatError, CalibrationError: the configuration, or a file that it names, is not valid.
    """
    calibration = first_calibration(config)
    key = config.read("link.signing_key", load_key)
    navigate = None
    if config.navigation is not None:
        from magbridge.bridge.navigation import open_navigation  # noqa: PLC0415 - where a map is used

        navigate = open_navigation(config, config.navigation, calibration)
    return Pipeline(config, calibration, start, key, navigate, other_calibrations(config))


def drive(pipeline: Pipeline, edge: Edge, log: TlogWriter | None, after_event: Callable[[int], None]) -> None:
    """Pass the events of `edge` to the pipeline until they end; send and log the results.

    `log`: log for the records; None without a log.
    `after_event`: function that is called with the event's time (µs) after each event.
    """
    for event in edge.events(lambda: pipeline.deadline):
        sent = pipeline.feed(event)
        if pipeline.component.signed_frames:
            edge.credit(pipeline.component.signed_frames)
        if sent:
            edge.send(Channel.LINK, b"".join([frame for _, frame in sent]))
        for stream in pipeline.streams:
            if commands := stream.to_send:
                edge.send(port_number(stream.sensor_id), b"".join(commands))
                commands.clear()
        if pipeline.heading is not None and (sentences := pipeline.heading.nmea):
            edge.send(MAG_PORT_NAME.NMEA, b"".join(sentences))
            sentences.clear()
        records = pipeline.recorder.drain()
        if log is not None and records:
            log.extend(records)
        after_event(event.time_us)
