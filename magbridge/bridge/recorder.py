"""Record all inputs and outputs of the bridge for the log; a replay needs nothing else."""

from __future__ import annotations

from struct import Struct
from typing import Final

from magbridge.mavlink import Codec, spec
from magbridge.records import Channel

__all__ = ["Recorder"]

BYTES: Final = spec("MAG_SENSOR_BYTES")
RAW: Final = spec("MAG_RAW")
BYTES_HEADER: Final = Struct("<BB")
"""The fields of MAG_SENSOR_BYTES before its data: sensor_id, length."""
RECORDED_BYTES: Final = BYTES.fields["data"].count
SENT, LINK, SENSOR, STATE = Channel


class Recorder:
    """Collect records until :meth:`drain`.

    Attributes
    ----------
    active : bool
        Whether records are collected and counted; False without a log.
    count : int
        Records collected since the start.
    """

    def __init__(self, system: int, component: int, *, active: bool) -> None:
        self.active = active
        self.count = 0
        self._records: list[tuple[int, Channel, bytes]] = []
        self._scribe = Codec(system, component)

    def sent(self, frames: list[tuple[int, bytes]]) -> None:
        """Record the frames sent over the link, each with its event time (µs)."""
        if self.active and frames:
            self._records += [(time_us, SENT, frame) for time_us, frame in frames]
            self.count += len(frames)

    def link(self, time_us: int, frames: list[bytes]) -> None:
        """Record the frames that came over the link."""
        for frame in frames:
            self._add(time_us, LINK, frame)

    def sensor(self, time_us: int, data: bytes, sensor_id: int = 0) -> None:
        """Record bytes as they came from a sensor."""
        if not self.active:
            return
        while data:
            piece, data = data[:RECORDED_BYTES], data[RECORDED_BYTES:]
            frame = self._scribe.frame(BYTES, BYTES_HEADER.pack(sensor_id, len(piece)) + piece)
            self._add(time_us, SENSOR, frame)

    def state(self, time_us: int, frame: bytes) -> None:
        """Record a frame of :mod:`magbridge.bridge.states`, or of the run's start."""
        self._add(time_us, STATE, frame)

    def raw(self, time_us: int, payload: bytes) -> None:
        """Record a MAG_RAW in the log only, because a calibration needs every sample."""
        self._add(time_us, STATE, self._scribe.frame(RAW, payload))

    def drain(self) -> list[tuple[int, Channel, bytes]]:
        """Return and clear the records collected so far, in order: event time in µs, channel, frame."""
        records, self._records = self._records, []
        return records

    def _add(self, time_us: int, channel: Channel, frame: bytes) -> None:
        if self.active:
            self._records.append((time_us, channel, frame))
            self.count += 1
