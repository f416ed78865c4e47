"""Messages of each sample, and the rates of all messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite, nan
from pathlib import Path
from struct import Struct
from typing import Final

from magbridge.align import Sample
from magbridge.errors import ConfigError
from magbridge.link.estimates import NO_ATTITUDE, Attitude, send_attitude
from magbridge.link.output import Outbox, Rate, Timers, period_us
from magbridge.link.parameters import (
    Parameters,
    rate_name,
)
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAG_RAW_FLAGS
from magbridge.mavlink.messages import MESSAGES
from magbridge.records import Corrected
from magbridge.wording import one_of

__all__ = [
    "DEFAULT_RATES_HZ", "LIMITS", "MASK", "PUBLISHED", "MessageRates", "Publisher", "check_publish",
]  # fmt: skip

RAW: Final = spec("MAG_RAW")
FIELD_MESSAGE: Final = spec("MAG_FIELD")
IMU: Final = spec("HIGHRES_IMU")
IMU_FIELD: Final = Struct("<Q24x3f16xHB")
"""HIGHRES_IMU without accelerations, rotations, pressures, altitude and temperature, which are zero."""
NAMED: Final = spec("NAMED_VALUE_FLOAT")
VECTOR: Final = spec("DEBUG_VECT")
MAGNETOMETER: Final = 0x1C0
"""HIGHRES_IMU.fields_updated: xmag, ymag, zmag."""
GAUSS_PER_NT: Final = 1e-5
"""Gauss in 1 nT."""
MASK: Final = 0xFFFFFFFF
RAW_SATURATED_FLAG: Final = int(MAG_RAW_FLAGS.SATURATED)
COUNTS_FLAG: Final = int(MAG_RAW_FLAGS.COUNTS)
SEQUENCE: Final = int(MAG_RAW_FLAGS.SEQUENCE)
POWER_CYCLE: Final = int(MAG_RAW_FLAGS.POWER_CYCLE)
NO_COUNTS: Final = (0, 0, 0)
NO_HEADING: Final = (0.0, 0.0, 0.0)
"""The extension fields of MAG_FIELD without a heading: zeros at the end are not transmitted."""


class Publisher:
    """Send each sample as the messages that are due.

    `rates`: by message name; of those of `PUBLISHED`, the messages that are sent.
    `calibration_id`: CRC-32 of the calibration's file; 0 is none.
    `start_us`: µs, when the bridge started: NAMED_VALUE_FLOAT counts from there.
    `sensor_id`: which sensor the samples are of.
    """

    def __init__(
        self,
        outbox: Outbox,
        rates: Mapping[str, Rate],
        calibration_id: int = 0,
        start_us: int = 0,
        sensor_id: int = 0,
    ) -> None:
        self._outbox, self._codec = outbox, outbox.codec
        self.calibration_id, self._start_us, self._sensor_id = calibration_id, start_us, sensor_id
        self._messages = [
            (rates[name], getattr(self, method)) for name, method in PUBLISHED.items() if name in rates
        ]
        self.latest: tuple[Sample, Corrected, float, Attitude] | None = None
        self.samples = 0

    def publish(
        self, sample: Sample, corrected: Corrected, anomaly: float = nan, attitude: Attitude = NO_ATTITUDE
    ) -> None:
        """Send the messages that are due for a sample; ``outbox.codec.now_us`` is the time of sending.

        `sample`: as aligned.
        `corrected`: what the calibration made of it.
        `anomaly`: nT above the main field; NaN where the position is not known.
        `attitude`: with the heading that follows from the corrected field.
        """
        self.latest = sample, corrected, anomaly, attitude
        self.samples += 1
        time_us = sample.time_us
        for rate, send in self._messages:
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
        self._outbox.put(RAW, self.raw_payload(sample))

    def raw_payload(self, sample: Sample) -> bytes:
        """Return the payload of a sample's MAG_RAW."""
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
            max(sample.reading_us + self._codec.utc_offset_us, 0), (sequence or 0) & MASK,
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
        self._outbox.put(FIELD_MESSAGE, payload)

    def _imu(self, sample: Sample, corrected: Corrected, *_: object) -> None:
        x, y, z = corrected.field
        time_us = max(sample.time_us + self._codec.utc_offset_us, 0)
        payload = IMU_FIELD.pack(
            time_us, x * GAUSS_PER_NT, y * GAUSS_PER_NT, z * GAUSS_PER_NT, MAGNETOMETER, 0
        )
        self._outbox.put(IMU, payload)

    def _named(self, sample: Sample, corrected: Corrected, anomaly: float, _: Attitude) -> None:
        boot_ms = (sample.time_us - self._start_us) // 1000 & MASK
        values = [(b"mag_total", corrected.total_field), (b"mag_sigma", corrected.total_field_sigma)]
        if isfinite(anomaly):
            values.append((b"mag_anom", anomaly))
        for name, value in values:
            self._outbox.put(NAMED, NAMED.struct.pack(boot_ms, value, name))

    def _vector(self, sample: Sample, corrected: Corrected, *_: object) -> None:
        time_us = max(sample.time_us + self._codec.utc_offset_us, 0)
        self._outbox.put(VECTOR, VECTOR.struct.pack(time_us, *corrected.field, b"mag_field"))

    def _quaternion(self, sample: Sample, _: Corrected, __: float, attitude: Attitude) -> None:
        if isfinite(attitude.heading):
            time_us = max(sample.time_us + self._codec.utc_offset_us, 0)
            send_attitude(self._outbox, attitude, time_us)


PUBLISHED: dict[str, str] = {
    "MAG_RAW": "_raw",
    "MAG_FIELD": "_field",
    "HIGHRES_IMU": "_imu",
    "NAMED_VALUE_FLOAT": "_named",
    "DEBUG_VECT": "_vector",
    "ATTITUDE_QUATERNION_COV": "_quaternion",
}
"""The messages that follow the samples, and which method of `Publisher` sends each."""


LIMITS = {
    "HEARTBEAT": (0.2, 10.0),
    "MAG_STATUS": (-1.0, 10.0),
    "MAG_NAVIGATION": (-1.0, 1000.0),
    "MAG_LEARNING": (-1.0, 1000.0),
    **dict.fromkeys(PUBLISHED, (-1.0, 1000.0)),
}
"""The messages whose rate (Hz) can be set, and within which limits."""


DEFAULT_RATES_HZ = {"HEARTBEAT": 1.0, "MAG_STATUS": 1.0, "MAG_NAVIGATION": 0.0, "MAG_LEARNING": 0.1}


MAX_MESSAGE_INTERVAL_US = 0x7FFFFFFF
"""Longest interval that a MESSAGE_INTERVAL holds, µs (36 min)."""


def check_publish(publish: Mapping[str, float], path: Path) -> None:
    """Check ``[publish]``.

    ConfigError: a message that the bridge does not publish, or a rate out of range.
    """
    for name, rate in publish.items():
        if name not in LIMITS:
            raise ConfigError(path, f"publish.{name}", one_of(name, sorted(LIMITS)))
        low, high = LIMITS[name]
        if not low <= rate <= high:
            raise ConfigError(
                path, f"publish.{name}", f"expected a rate from {low:g} to {high:g} Hz, not {rate:g}"
            )


class MessageRates:
    """Rate of each message; each rate is also a parameter.

    `by_name`: the rates of the messages of the main sensor, and of reports.
    """

    def __init__(self, parameters: Parameters, timers: Timers, codec: Codec) -> None:
        self._parameters, self._timers, self._codec = parameters, timers, codec
        self.by_name = {name: Rate(parameters[rate_name(name)]) for name in LIMITS}
        self._by_clock: dict[str, Callable[[], object]] = {}
        self._rates = [(rate_name(name), rate) for name, rate in self.by_name.items()]
        parameters.watch(self._changed)

    def another(self, name: str) -> Rate:
        """Return one more rate of a message, with its own times: for the samples of another sensor."""
        rate = Rate(self.by_name[name].hertz)
        self._rates.append((rate_name(name), rate))
        return rate

    def send_by_clock(self, name: str, report: Callable[[], object]) -> None:
        """Send a message by the clock instead of with the samples; a rate of 0 is off."""
        self._by_clock[rate_name(name)] = report
        self._changed(rate_name(name))

    def interval_us(self, number: int, sample_rate: float) -> int:
        """Return a message's interval in µs; -1 off, 0 if it has no rate or an unknown `sample_rate`, Hz."""
        rate = self.by_name.get(spec(number).name) if number in MESSAGES else None
        if rate is None or rate.hertz < 0:
            return 0 if rate is None else -1
        hertz = rate.hertz or sample_rate
        return min(period_us(hertz), MAX_MESSAGE_INTERVAL_US) if hertz > 0 else 0

    def set(self, number: int, hertz: float | None) -> str:
        """Set a message's rate (None: the default); return the parameter's name, empty if impossible."""
        name = spec(number).name if number in MESSAGES else ""
        if name not in LIMITS:
            return ""
        parameter = rate_name(name)
        value = self._parameters.table[parameter].default if hertz is None else hertz
        return parameter if self._parameters.set(parameter, value) else ""

    def _changed(self, parameter: str) -> None:
        """Apply a changed parameter if it is the rate of a message."""
        for name, rate in self._rates:
            if name == parameter and rate.hertz != self._parameters[parameter]:
                rate.set(self._parameters[parameter])
        if (report := self._by_clock.get(parameter)) is None:
            return
        hertz = self._parameters[parameter]
        if hertz > 0:
            self._timers.every(parameter, period_us(hertz), lambda _: report(), self._codec.now_us)
        else:
            self._timers.cancel(parameter)
