"""Processing of one sensor of the bridge: its serial line, its driver, its correction and its messages."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from glob import has_magic
from math import nan
from typing import TYPE_CHECKING, Final

import msgspec

from magbridge.align import Sample
from magbridge.calibration.file import load
from magbridge.calibration.model import Calibration
from magbridge.calibration.scalar import ScalarSensor
from magbridge.columns import COLUMNS, TEMPERATURE, may_be
from magbridge.config import Align, Config, Sensor
from magbridge.correction import Correction
from magbridge.errors import ConfigError
from magbridge.link.component import Component
from magbridge.link.output import Rate
from magbridge.link.publish import Publisher
from magbridge.mavlink.enums import MAG_PORT_STATE, MAV_SEVERITY
from magbridge.records import Corrected, Reading, Vector
from magbridge.scalar_correction import ScalarCorrection
from magbridge.sensors import Driver, is_scalar, open_driver
from magbridge.sensors.clock import DeviceClock

if TYPE_CHECKING:
    from magbridge.learning import Learner

__all__ = [
    "NMEA_SENTENCE", "SensorStream", "needed_units", "open_correction", "open_drivers",
    "other_calibrations", "unmet",
]  # fmt: skip

OK: Final = MAG_PORT_STATE.OK
COMMAND_GAP_US = 100_000
"""Time between two commands to a sensor, µs."""
LISTEN_US = 1_200_000
"""Time without commands on a line that may be another instrument's, µs; a GPS sends within this time."""
NMEA_SENTENCE = re.compile(rb"[$!][A-OQ-Z][A-Z]{4},[ -~]*\*[0-9A-Fa-f]{2}\r?\n")
"""Pattern of a standard sentence of NMEA 0183, which does not match proprietary sentences (``$P...``)."""
MAX_SENTENCE_BYTES = 128
"""Length of the longest NMEA sentence plus a margin, bytes."""
TEXT_BYTES = re.compile(rb"[\t\r\n -~]+")
NOT_A_NUMBER = re.compile(rb"\bnan\b", re.IGNORECASE)
LINE_CHECK_INTERVAL_US = 1_000_000
"""Time between two checks that readings arrive, µs."""


def needed_units(calibration: Calibration) -> dict[str, str]:
    """Return the units of the telemetry values that a calibration needs, by name."""
    units = calibration.units
    return {name: units.get(name, "") for name in calibration.channels if name != TEMPERATURE}


def unmet(units: Mapping[str, str], config: Config) -> list[ConfigError]:
    """Return an error for each channel of `units` that ``[telemetry]`` lacks or has in another unit."""
    errors = []
    for name, expected_unit in units.items():
        if name not in config.telemetry:
            missing = "missing: the calibration needs this parameter"
            errors.append(ConfigError(config.path, f"telemetry.{name}", missing))
            continue
        unit = config.telemetry[name].unit
        if not may_be(unit, expected_unit):
            expected = f"expected {expected_unit!r}, the calibration's unit, not {unit!r}"
            errors.append(ConfigError(config.path, f"telemetry.{name}.unit", expected))
    return errors


OVERLOAD_HZ = 5.0
"""Rate of the samples that get all optional work during an overload, Hz."""
RATE_SAMPLES = 64
"""Number of latest samples over which the sample rate is computed."""


def open_drivers(config: Config) -> list[Driver]:
    """Return the driver of each sensor.

    ConfigError: a driver does not exist, sensor 0 is a scalar although a vector sensor exists, or a setting
    does not fit the sensor.
    """
    drivers = [open_driver(one.driver, one.options, config.path, one.key) for one in config.sensors]
    vectors = [one for one, driver in zip(config.sensors, drivers, strict=True) if not is_scalar(driver)]
    if vectors and is_scalar(drivers[0]):
        expected = f"expected 0 for a vector sensor, such as {vectors[0].label}: sensor 0 is the main sensor"
        raise ConfigError(config.path, f"{config.sensor.key}.id", expected)
    if is_scalar(drivers[0]) and config.learning is not None:
        raise ConfigError(config.path, "learning", "expected a vector sensor: a scalar cannot be learned")
    if is_scalar(drivers[0]) and config.calibration is not None:
        text = "expected none: the compensation of a scalar needs a vector sensor as sensor 0"
        raise ConfigError(config.path, "calibration", text)
    for one in config.more_sensors:
        if one.name in COLUMNS or f"{one.name}_x" in COLUMNS:
            text = f"expected another name: logs have columns of {one.name!r} already"
            raise ConfigError(config.path, one.key, text)
    for one, driver in zip(config.sensors, drivers, strict=True):
        if one.sigma is not None and not is_scalar(driver):
            raise ConfigError(config.path, f"{one.key}.sigma", "expected only for a scalar sensor")
    return drivers


def other_calibrations(config: Config) -> dict[int, Calibration]:
    """Return the calibrations of the sensors after the first, by sensor id.

    ConfigError: a file is not a calibration.
    """
    read = {one.id or 0: config.read(f"{one.key}.calibration", load) for one in config.more_sensors}
    return {number: calibration for number, calibration in read.items() if calibration is not None}


def scalar_entry(
    sensor: Sensor, config: Config, own_calibration: Calibration | None, main: Calibration | None
) -> ScalarSensor | None:
    """Return the compensation of a scalar sensor; None if no calibration contains it.

    `sensor`: the sensor, whose name is the column of its compensation.
    `config`: configuration with the telemetry.
    `own_calibration`, `main`: calibrations of the sensor itself and of sensor 0, or None.
    ConfigError: `own_calibration` has no entry for the sensor, or a channel is not in ``[telemetry]``.
    """
    entries = (own_calibration or main).sensors if own_calibration is not None or main is not None else ()  # type: ignore[union-attr]
    entry = next((one for one in entries if one.column == sensor.name), None)
    if entry is None and own_calibration is not None:
        if len(entries) != 1:
            columns = ", ".join(one.column for one in entries) or "none"
            text = f"expected a scalar sensor called {sensor.name!r}, got {columns}"
            raise ConfigError(config.path, f"{sensor.key}.calibration", text)
        entry = entries[0]
    if entry is not None:
        for error in unmet({channel.name: channel.unit for channel in entry.channels}, config):
            raise error
    return entry


class SensorStream:
    """Processing of one sensor, from its serial line to corrected samples.

    It sends the start-up commands whenever the sensor may have lost them. If the line may be another
    instrument's, because a pattern found it, the sensor gets commands after a pause, and none if the line
    carries NMEA 0183 and no readings.

    `correction`: correction of the sensor's readings.
    `component`: the MAVLink component.
    `start_us`: start of the bridge, µs since 1970 UTC.
    `publisher`: sender of the sensor's samples.
    `timer`: name of the timer that checks if the sensor is silent.
    `state`: state of the line (MAG_PORT_STATE).
    `to_send`: commands to send; the caller of the pipeline sends them and empties the list.
    `wrong_device`: True if a timeout or NMEA 0183 suggests another instrument, and no reading has arrived
        since the line was opened. The owner of the line then tries another device and resets this attribute.
    `samples`: number of readings received.
    `quality`: quality flags that were last sent as STATUSTEXT.
    `overload_rate`: limit of the samples with all optional work during an overload.
    """

    def __init__(
        self,
        sensor: Sensor,
        driver: Driver,
        correction: Correction | ScalarCorrection,
        component: Component,
        start_us: int,
        publisher: Publisher,
    ) -> None:
        self.sensor, self.driver, self.correction, self.publisher = sensor, driver, correction, publisher
        self.sensor_id = sensor.id or 0
        self.clock = DeviceClock.for_driver(driver)
        self._component, self._output = component, component.output
        suffix = f" {sensor.id}" if sensor.id else ""
        self.timer, self._command_timer = f"sensor{suffix}", f"command{suffix}"
        self._timeout_us = round(sensor.timeout * 1e6)
        self.state = MAG_PORT_STATE.ABSENT
        self.to_send: list[bytes] = []
        self.wrong_device = self._known = False
        self._received_us = start_us
        # shorter than the timeout, so that the pause does not change the message about a silent line
        self._listen_us = min(LISTEN_US, self._timeout_us // 2) if has_magic(sensor.port) else 0
        self._commands: tuple[bytes, ...] = ()
        self._tail = b""
        self._unparsed_us = 0
        self.samples = self.quality = self._missing = 0
        self._rate = self.clock.rate
        self.overload_rate = Rate(OVERLOAD_HZ)
        self._times: deque[int] = deque(maxlen=RATE_SAMPLES)
        interval_us = LINE_CHECK_INTERVAL_US
        self._output.every(self.timer, interval_us, self._check_line, start_us + interval_us)

    def receive(self, data: bytes, time_us: int) -> list[Reading]:
        """Parse bytes received at `time_us` (µs); return the completed readings with their times."""
        readings = self.driver.feed(data)
        if not readings:
            self._receive_unparsed(data, time_us)
            return []
        self._received_us, self._known = time_us, True
        if self.state != OK:
            self.state = OK
            self._output.announce(self.timer, f"{self.sensor.label} sends readings")
        stamped = self.clock.stamp(readings, time_us)
        if self.clock.rate != self._rate:
            self._rate = self.clock.rate
            configured = 1.0 / self.driver.period
            text = f"{self.sensor.label} sends {self._rate:.3g} readings/s, but rate = {configured:.3g}"
            self._output.announce(f"rate {self.sensor_id}", text, MAV_SEVERITY.WARNING)
        return stamped

    @property
    def readings_lost(self) -> int:
        """Number of readings missing in the instrument's numbering or at its rate."""
        return self._missing - self.clock.invented

    def correct(
        self, reading: Reading, main_field: float, position: tuple[float, float] | None, depth: float
    ) -> list[tuple[Sample, Corrected]]:
        """Correct a reading; return the completed samples, each with its corrected field.

        `reading`: reading from :meth:`receive`.
        `main_field`: magnitude of the main field, nT; NaN if unknown.
        `position`: latitude and longitude, deg; None if unknown.
        `depth`: depth below the sea, m; NaN if unknown.
        """
        correction, time_us = self.correction, reading.time_us
        self.samples += 1
        self._missing += reading.missing
        self._times.append(time_us)
        if isinstance(correction, Correction):
            return [
                correction.reading(reading, time_us, main_field=main_field, position=position, depth=depth)
            ]
        correction.reading(reading, time_us, main_field, position)
        return self.complete()

    def complete(self) -> list[tuple[Sample, Corrected]]:
        """Return the waiting scalar samples for whose time the vector is known."""
        if not isinstance(self.correction, ScalarCorrection):
            return []
        return self.correction.samples(self._component.codec.now_us)

    def use_vector(self, time_us: int, field: Vector) -> None:
        """Pass sensor 0's corrected vector (nT) at `time_us` (µs) to the compensation of a scalar."""
        if isinstance(self.correction, ScalarCorrection):
            self.correction.vector(time_us, field)

    def tune(self, settings: Align, ages: Mapping[str, float]) -> None:
        """Apply the settings of the alignment, and the age (s) beyond which each telemetry value is stale."""
        self.correction.aligner.tune(own_settings(self.sensor, self.driver, settings), ages)

    def _receive_unparsed(self, data: bytes, time_us: int) -> None:
        """Record the arrival of bytes that complete no reading, and detect NMEA 0183 in them."""
        self._unparsed_us = time_us
        received = self._tail + data
        self._tail = received[-MAX_SENTENCE_BYTES:]
        if self._listen_us and not self._known and NMEA_SENTENCE.search(received):
            self._commands, self.wrong_device = (), True
            self._output.cancel(self._command_timer)

    def opened(self, time_us: int) -> None:
        """Handle an opened port: send the start-up commands, and set the state to SILENT until a reading."""
        self._commands, self._known, self._tail = self.driver.start(), False, b""
        self.state, self._received_us = MAG_PORT_STATE.SILENT, time_us
        if self._listen_us:
            listened_us = time_us + self._listen_us
            self._output.run_once(
                self._command_timer, listened_us, lambda t: self._command(t, self._commands)
            )
        else:
            self._command(time_us, self._commands)

    def closed(self, reason: str) -> None:
        """Record and report that the port was lost because of `reason`."""
        self.state = MAG_PORT_STATE.LOST
        self._output.cancel(self._command_timer)
        self._output.announce(self.timer, f"{self.sensor.label} lost: {reason}", MAV_SEVERITY.ERROR)

    def _check_line(self, time_us: int) -> None:
        if time_us - self._received_us < self._timeout_us or self.state == MAG_PORT_STATE.LOST:
            return
        sends = time_us - self._unparsed_us < self._timeout_us // 2
        what = self._unparsed() if sends else "is silent"
        self._output.announce(self.timer, f"{self.sensor.label} {what}", MAV_SEVERITY.ERROR)
        self.wrong_device = not self._known
        self.state, self._received_us = MAG_PORT_STATE.SILENT, time_us
        self._command(time_us, self._commands)

    def _unparsed(self) -> str:
        """Return a description of received bytes that are not readings, with the likely cause."""
        if not TEXT_BYTES.fullmatch(self._tail):
            return "sends, but no readings: baud rate?"
        if NOT_A_NUMBER.search(self._tail):
            return "sends NaN, but no readings"
        return "sends text, but no readings: sensor.options?"

    def _command(self, time_us: int, commands: tuple[bytes, ...]) -> None:
        if commands:
            self.to_send.append(commands[0])
            self._output.run_once(
                self._command_timer, time_us + COMMAND_GAP_US, lambda t: self._command(t, commands[1:])
            )

    @property
    def sample_rate(self) -> float:
        """Rate of the latest readings, Hz; NaN while the sensor is silent."""
        times = self._times
        span_us = times[-1] - times[0] if times and self.state == OK else 0
        return (len(times) - 1) * 1e6 / span_us if span_us > 0 else nan

    def report(self) -> None:
        """Send MAG_SENSOR with the state and the counts of the sensor."""
        component = self._component
        self._output.send(
            "MAG_SENSOR",
            time_usec=component.codec.utc_us,
            calibration_id=self.publisher.calibration_id,
            samples=self.samples & 0xFFFFFFFF,
            samples_lost=self.readings_lost & 0xFFFFFFFF,
            bytes_skipped=self.driver.bytes_skipped & 0xFFFFFFFF,
            frames_bad=self.driver.frames_bad & 0xFFFFFFFF,
            sample_rate=self.sample_rate,
            clock_drift=-self.clock.drift_ppm,
            sensor_id=self.sensor_id,
            state=self.state,
            name=self.sensor.label,
        )


def own_settings(sensor: Sensor, driver: Driver, settings: Align) -> Align:
    """Return the settings of the alignment with the filter delay of one sensor."""
    if sensor.filter_delay is None and not is_scalar(driver):
        return settings
    return msgspec.structs.replace(settings, filter_delay=sensor.filter_delay or 0.0)


def open_correction(
    sensor: Sensor,
    driver: Driver,
    config: Config,
    own_calibration: Calibration | None,
    main: Calibration | None,
    learner: Learner | None = None,
) -> tuple[Correction | ScalarCorrection, Calibration | None]:
    """Return the correction of a sensor, and the calibration that it uses, or None.

    `sensor`, `driver`, `config`: the sensor, its driver, and the configuration.
    `own_calibration`, `main`: calibrations of the sensor itself and of sensor 0, or None.
    `learner`: online estimator of sensor 0, or None.
    ConfigError: ``[telemetry]`` lacks a channel of the calibration, or has it in another unit.
    """
    settings = own_settings(sensor, driver, config.align)
    if is_scalar(driver):
        entry = scalar_entry(sensor, config, own_calibration, main) if config.sensor != sensor else None
        used = None if entry is None else own_calibration or main
        return ScalarCorrection(entry, settings, sensor.sigma), used
    if own_calibration is not None:
        for error in unmet(needed_units(own_calibration), config):
            raise error
        if not own_calibration.sensor.may_be(sensor.driver):
            return Correction(None, settings, learner), None
    return Correction(own_calibration, settings, learner), own_calibration
