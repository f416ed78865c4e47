"""Messages that the bridge sends for each sample, and the rates of all its messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite, nan
from pathlib import Path
from struct import Struct
from typing import Final

from magbridge.align import Sample
from magbridge.errors import ConfigError
from magbridge.link.estimates import NO_ATTITUDE, Attitude, send_attitude
from magbridge.link.output import Output, Rate, period_us
from magbridge.link.parameters import Parameters, rate_name
from magbridge.mavlink import spec
from magbridge.mavlink.enums import MAG_RAW_FLAGS
from magbridge.mavlink.messages import EXTRA
from magbridge.records import Corrected
from magbridge.wording import one_of

__all__ = [
    "DEFAULT_RATES_HZ", "LIMITS", "MASK", "PUBLISHED", "MessageRates", "Publisher", "check_publish",
]  # fmt: skip

RAW: Final = spec("MAG_RAW")
FIELD_MESSAGE: Final = spec("MAG_FIELD")
IMU: Final = spec("HIGHRES_IMU")
IMU_FIELD: Final = Struct("<Q24x3f16xHB")
"""Layout of a HIGHRES_IMU payload with time, field and flags; all other fields are zero bytes."""
NAMED: Final = spec("NAMED_VALUE_FLOAT")
VECTOR: Final = spec("DEBUG_VECT")
MAGNETOMETER: Final = 0x1C0
"""Value of HIGHRES_IMU.fields_updated: xmag, ymag and zmag are valid."""
GAUSS_PER_NT: Final = 1e-5
"""Conversion factor from nT to gauss."""
MASK: Final = 0xFFFFFFFF
RAW_SATURATED_FLAG: Final = int(MAG_RAW_FLAGS.SATURATED)
COUNTS_FLAG: Final = int(MAG_RAW_FLAGS.COUNTS)
SEQUENCE: Final = int(MAG_RAW_FLAGS.SEQUENCE)
POWER_CYCLE: Final = int(MAG_RAW_FLAGS.POWER_CYCLE)
NO_COUNTS: Final = (0, 0, 0)
NO_HEADING: Final = (0.0, 0.0, 0.0)
"""Extension fields of MAG_FIELD if the heading is unknown; MAVLink does not transmit zeros at the end."""


class Publisher:
    """Sender of the messages of one sensor's samples.

    `rates`: rate of each message, by name; messages of `PUBLISHED` without a rate are not sent.
    `calibration_id`: CRC-32 of the calibration file; 0 without a calibration.
    `start_us`: start of the bridge, µs since 1970 UTC; NAMED_VALUE_FLOAT states times since then.
    `sensor_id`: number of the sensor in the messages.
    `latest`: arguments of the last call of :meth:`publish`.
    `samples`: number of samples so far.
    """

    def __init__(
        self,
        output: Output,
        rates: Mapping[str, Rate],
        calibration_id: int = 0,
        start_us: int = 0,
        sensor_id: int = 0,
    ) -> None:
        self._output, self._codec = output, output.codec
        self.calibration_id, self._start_us, self._sensor_id = calibration_id, start_us, sensor_id
        self._messages = [
            (rates[name], getattr(self, method)) for name, method in PUBLISHED.items() if name in rates
        ]
        self._main_messages = sum(name in rates for name in MAIN_MESSAGES)
        self.latest: tuple[Sample, Corrected, float, Attitude] | None = None
        self.samples = 0

    def publish(
        self,
        sample: Sample,
        corrected: Corrected,
        anomaly: float = nan,
        attitude: Attitude = NO_ATTITUDE,
        *,
        is_brief: bool = False,
    ) -> None:
        """Send the messages whose rates are due for a sample, at the time ``output.codec.now_us``.

        `sample`: reading with the telemetry of its time.
        `corrected`: the corrected field of the sample.
        `anomaly`: total field minus the main field, nT; NaN if the position is unknown.
        `attitude`: attitude with the heading computed from the corrected field.
        `is_brief`: True to send only MAG_RAW and MAG_FIELD.
        """
        self.latest = sample, corrected, anomaly, attitude
        self.samples += 1
        time_us = sample.time_us
        for rate, send in self._messages[: self._main_messages] if is_brief else self._messages:
            hertz = rate.hertz
            if hertz == 0.0 or (hertz > 0.0 and rate.due(time_us)):
                send(sample, corrected, anomaly, attitude)

    def repeat(self, name: str) -> bool:
        """Send message `name` of the latest sample again; return False before the first sample."""
        if self.latest is None:
            return False
        send: Callable[[Sample, Corrected, float, Attitude], None] = getattr(self, PUBLISHED[name])
        send(*self.latest)
        return True

    def _raw(self, sample: Sample, *_: object) -> None:
        self._output.put(RAW, self.raw_payload(sample))

    def raw_payload(self, sample: Sample) -> bytes:
        """Return the payload of MAG_RAW for a sample."""
        reading = sample.reading
        counts, sequence, cycle = reading.counts, reading.sequence, reading.power_cycle
        flags = RAW_SATURATED_FLAG if reading.saturated else 0
        if counts is not None:
            flags |= COUNTS_FLAG
        if sequence is not None:
            flags |= SEQUENCE
        if cycle is not None:
            flags |= POWER_CYCLE
        x, y, z = reading.field
        x_count, y_count, z_count = counts or NO_COUNTS
        x_late, y_late, z_late = reading.channel_delay
        return RAW.struct.pack(
            max(reading.time_us + self._codec.utc_offset_us, 0), (sequence or 0) & MASK,
            x, y, z, x_count, y_count, z_count,
            round(x_late * 1e6), round(y_late * 1e6), round(z_late * 1e6),
            reading.temperature, reading.supply, (cycle or 0) & 0xFFFF, self._sensor_id, flags,
        )  # fmt: skip

    def _field(self, sample: Sample, corrected: Corrected, anomaly: float, attitude: Attitude) -> None:
        x, y, z = corrected.field
        x_sigma, y_sigma, z_sigma = corrected.field_sigma
        payload = FIELD_MESSAGE.struct.pack(
            max(sample.time_us + self._codec.utc_offset_us, 0), corrected.total_field,
            self.samples & MASK, self.calibration_id, corrected.total_field_sigma,
            x, y, z, x_sigma, y_sigma, z_sigma, anomaly, sample.age,
            (self._codec.now_us - sample.time_us) * 1e-6, corrected.quality, self._sensor_id,
            *(NO_HEADING if attitude is NO_ATTITUDE else attitude[:3]),
        )  # fmt: skip
        self._output.put(FIELD_MESSAGE, payload)

    def _imu(self, sample: Sample, corrected: Corrected, *_: object) -> None:
        x, y, z = corrected.field
        time_us = max(sample.time_us + self._codec.utc_offset_us, 0)
        field = x * GAUSS_PER_NT, y * GAUSS_PER_NT, z * GAUSS_PER_NT
        self._output.put(IMU, IMU_FIELD.pack(time_us, *field, MAGNETOMETER, 0))

    def _named(self, sample: Sample, corrected: Corrected, anomaly: float, _: Attitude) -> None:
        boot_ms = (sample.time_us - self._start_us) // 1000 & MASK
        values = [(b"mag_total", corrected.total_field), (b"mag_sigma", corrected.total_field_sigma)]
        if isfinite(anomaly):
            values.append((b"mag_anom", anomaly))
        for name, value in values:
            self._output.put(NAMED, NAMED.struct.pack(boot_ms, value, name))

    def _vector(self, sample: Sample, corrected: Corrected, *_: object) -> None:
        time_us = max(sample.time_us + self._codec.utc_offset_us, 0)
        self._output.put(VECTOR, VECTOR.struct.pack(time_us, *corrected.field, b"mag_field"))

    def _quaternion(self, sample: Sample, _: Corrected, __: float, attitude: Attitude) -> None:
        if isfinite(attitude.heading):
            time_us = max(sample.time_us + self._codec.utc_offset_us, 0)
            send_attitude(self._output, attitude, time_us)


PUBLISHED: dict[str, str] = {
    "MAG_RAW": "_raw",
    "MAG_FIELD": "_field",
    "HIGHRES_IMU": "_imu",
    "NAMED_VALUE_FLOAT": "_named",
    "DEBUG_VECT": "_vector",
    "ATTITUDE_QUATERNION_COV": "_quaternion",
}
"""Messages that can be sent with each sample, each with the method of `Publisher` that sends it."""
MAIN_MESSAGES = ("MAG_RAW", "MAG_FIELD")
"""First messages of `PUBLISHED`, which are sent even during an overload."""


LIMITS = {
    "HEARTBEAT": (0.2, 10.0),
    "MAG_STATUS": (-1.0, 10.0),
    "MAG_NAVIGATION": (-1.0, 1000.0),
    "MAG_LEARNING": (-1.0, 1000.0),
    **dict.fromkeys(PUBLISHED, (-1.0, 1000.0)),
}
"""Messages whose rate can be set, each with the smallest and largest rate, Hz."""


DEFAULT_RATES_HZ = {"HEARTBEAT": 1.0, "MAG_STATUS": 1.0, "MAG_NAVIGATION": 0.0, "MAG_LEARNING": 0.1}


MAX_MESSAGE_INTERVAL_US = 0x7FFFFFFF
"""Largest interval in MESSAGE_INTERVAL, µs (36 min)."""


def check_publish(publish: Mapping[str, float], path: Path) -> None:
    """Check the section ``[publish]`` of the configuration `path`.

    ConfigError: a message that the bridge does not publish, or a rate out of range.
    """
    for name, rate in publish.items():
        if name not in LIMITS:
            raise ConfigError(path, f"publish.{name}", one_of(name, sorted(LIMITS)))
        low, high = LIMITS[name]
        if not low <= rate <= high:
            expected = f"expected a rate from {low:g} to {high:g} Hz, not {rate:g}"
            raise ConfigError(path, f"publish.{name}", expected)


class MessageRates:
    """Rates of all messages, kept equal to the parameters that set them.

    `by_name`: rate of each message of the main sensor and of each report, by message name.
    """

    def __init__(self, parameters: Parameters, output: Output) -> None:
        self._parameters, self._output = parameters, output
        self.by_name = {name: self.another(name) for name in LIMITS}

    def another(self, name: str) -> Rate:
        """Return a further rate limit of message `name`, for the samples of another sensor."""
        parameters = self._parameters
        rate = Rate(parameters[rate_name(name)])
        parameters.watch(lambda parameter: rate.set(parameters[parameter]), rate_name(name))
        return rate

    def send_by_clock(self, name: str, report: Callable[[], object]) -> None:
        """Send message `name` by a timer that calls `report`; here a rate of 0 is off."""

        def schedule(parameter: str) -> None:
            hertz, output = self._parameters[parameter], self._output
            if hertz > 0:
                output.every(parameter, period_us(hertz), lambda _: report(), output.codec.now_us)
            else:
                output.cancel(parameter)

        self._parameters.watch(schedule, rate_name(name))
        schedule(rate_name(name))

    def interval_us(self, number: int, sample_rate: float) -> int:
        """Return the interval (µs) of the message with id `number`; -1 if off, 0 if unknown.

        A message that is sent with every sample has the interval of `sample_rate` (Hz).
        """
        rate = self.by_name.get(spec(number).name) if number in EXTRA else None
        if rate is None or rate.hertz < 0:
            return 0 if rate is None else -1
        hertz = rate.hertz or sample_rate
        return min(period_us(hertz), MAX_MESSAGE_INTERVAL_US) if hertz > 0 else 0

    def set(self, number: int, hertz: float | None) -> str:
        """Set the rate of the message with id `number`; None sets the default.

        Return the name of the rate's parameter; empty if the message has no rate or `hertz` is out of range.
        """
        name = spec(number).name if number in EXTRA else ""
        if name not in LIMITS:
            return ""
        parameter = rate_name(name)
        value = self._parameters.table[parameter].default if hertz is None else hertz
        return parameter if self._parameters.set(parameter, value) else ""
