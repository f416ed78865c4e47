"""All inputs and outputs of the bridge, as records for the log: a replay needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from struct import Struct
from typing import Any

from magbridge.config import Telemetry
from magbridge.mavlink import Codec, spec
from magbridge.records import Channel

__all__ = ["Journal", "declarations"]

BYTES, RAW = spec("MAG_SENSOR_BYTES"), spec("MAG_RAW")
HEAD = Struct("<BB")
"""The fields of MAG_SENSOR_BYTES before its data: sensor_id, length."""
SIZE = BYTES.fields["data"].count
SENT, LINK, SENSOR, STATE = Channel


class Journal:
    """Collects records until :meth:`drain`.

    Attributes
    ----------
    active : bool
        Whether records are collected and counted; False where there is no log.
    count : int
        Records collected since the start.
    """

    def __init__(self, system: int, component: int, *, active: bool) -> None:
        self.active = active
        self.count = 0
        self._records: list[tuple[int, Channel, bytes]] = []
        self._scribe = Codec(system, component)

    def sent(self, frames: Iterable[tuple[int, bytes]]) -> None:
        """Record the frames sent over the link, each with its event time (µs)."""
        self._add([(time_us, SENT, frame) for time_us, frame in frames])

    def link(self, time_us: int, frames: Iterable[bytes]) -> None:
        """Record the frames that came over the link."""
        self._add([(time_us, LINK, frame) for frame in frames])

    def sensor(self, time_us: int, data: bytes) -> None:
        """Record bytes as they came from the sensor."""
        if not self.active:
            return
        for begin in range(0, len(data), SIZE):
            piece = data[begin : begin + SIZE]
            frame = self._scribe.frame(BYTES, HEAD.pack(0, len(piece)) + piece)
            self._add([(time_us, SENSOR, frame)])

    def state(self, time_us: int, frame: bytes) -> None:
        """Record a frame of :mod:`magbridge.bridge.states`, or of the run's start."""
        self._add([(time_us, STATE, frame)])

    def raw(self, time_us: int, payload: bytes) -> None:
        """Record a MAG_RAW in the log only: a calibration from the log needs that of every sample."""
        self._add([(time_us, STATE, self._scribe.frame(RAW, payload))])

    def drain(self) -> list[tuple[int, Channel, bytes]]:
        """Return and clear the records collected so far, in order: event time in µs, channel, frame."""
        records, self._records = self._records, []
        return records

    def _add(self, records: list[tuple[int, Channel, bytes]]) -> None:
        if self.active:
            self._records += records
            self.count += len(records)


def declarations(
    system: int,
    component: int,
    telemetry: Mapping[str, Telemetry],
    nt_per_count: float = 0.0,
    settings: Mapping[str, float] | None = None,
) -> list[bytes]:
    """Return the frames that tell a reader of the log what each column comes from, and how it was corrected.

    Parameters
    ----------
    system, component : int
        The bridge's own.
    telemetry : mapping of str to Telemetry
        By parameter.
    nt_per_count : float
        nT per count of the sensor, 0 for one without counts. A reader then takes the channels from the
        counts, because MAG_RAW's float32 fields are less precise than the values that were corrected.
    settings : mapping of str to float, optional
        What decides about flags and sigmas, by its key in the configuration: attributes of the log.
    """
    codec = Codec(system, component)
    columns: list[dict[str, Any]] = [
        {"column": key, "scale": value} for key, value in (settings or {}).items()
    ]
    columns += [
        {
            "column": name,
            "unit": one.unit,
            "message": one.message,
            "field": one.field,
            "match": ",".join(f"{field}={value}" for field, value in one.match.items()),
            "scale": one.scale,
            "offset": one.offset,
        }
        for name, one in telemetry.items()
    ]
    if nt_per_count:
        columns += [
            {
                "column": f"mag_{axis}",
                "unit": "nT",
                "message": "MAG_RAW",
                "field": f"count_{axis}",
                "scale": nt_per_count,
            }
            for axis in "xyz"
        ]
    return [codec.pack("MAG_COLUMN", **column) for column in columns]
