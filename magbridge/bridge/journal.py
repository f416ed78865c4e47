"""Everything that came and went, as records for the log: a replay needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from struct import Struct

from magbridge.config import Telemetry
from magbridge.mavlink import Codec, spec
from magbridge.records import Channel

__all__ = ["Journal", "declarations"]

BYTES, RAW = spec("MAG_SENSOR_BYTES"), spec("MAG_RAW")
HEAD = Struct("<BB")
"""Its fields before the data: sensor_id, length."""
SIZE = BYTES.fields["data"].count
SENT, LINK, SENSOR, STATE = Channel


class Journal:
    """Collects records until :meth:`drain`.

    Attributes
    ----------
    active : bool
        When not, nothing is collected, and counting nothing costs nothing.
    count : int
        Records collected since the start.
    """

    def __init__(self, system: int, component: int, *, active: bool) -> None:
        self.active = active
        self.count = 0
        self._records: list[tuple[int, Channel, bytes]] = []
        self._scribe = Codec(system, component)

    def sent(self, frames: Iterable[tuple[int, bytes]]) -> None:
        """Take what went out over the link: event time in µs, frame."""
        self._add([(time_us, SENT, frame) for time_us, frame in frames])

    def link(self, time_us: int, frames: Iterable[bytes]) -> None:
        """Take what came over the link."""
        self._add([(time_us, LINK, frame) for frame in frames])

    def sensor(self, time_us: int, data: bytes) -> None:
        """Take bytes as they came from the sensor."""
        if not self.active:
            return
        for begin in range(0, len(data), SIZE):
            piece = data[begin : begin + SIZE]
            frame = self._scribe.frame(BYTES, HEAD.pack(0, len(piece)) + piece)
            self._add([(time_us, SENSOR, frame)])

    def state(self, time_us: int, frame: bytes) -> None:
        """Take a frame that says what changed at the edge."""
        self._add([(time_us, STATE, frame)])

    def raw(self, time_us: int, payload: bytes) -> None:
        """Write a MAG_RAW that is not published: without it, nothing could be calibrated from the log."""
        self._add([(time_us, STATE, self._scribe.frame(RAW, payload))])

    def drain(self) -> list[tuple[int, Channel, bytes]]:
        """Return what was collected, in order (event time in µs, channel, frame), and forget it."""
        records, self._records = self._records, []
        return records

    def _add(self, records: list[tuple[int, Channel, bytes]]) -> None:
        if self.active:
            self._records += records
            self.count += len(records)


def declarations(
    system: int, component: int, telemetry: Mapping[str, Telemetry], nt_per_count: float = 0.0
) -> list[bytes]:
    """Return the frames that tell a reader of the log which field of which message a column is.

    Parameters
    ----------
    system, component : int
        The bridge's own.
    telemetry : mapping of str to Telemetry
        By parameter.
    nt_per_count : float
        nT, of one count of the sensor: float32, as MAG_RAW tells a channel, is less than what was corrected;
        0 for a sensor without counts.
    """
    codec = Codec(system, component)
    columns = [
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
