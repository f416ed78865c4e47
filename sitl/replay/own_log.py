"""Read a bridge's own log: the events to replay, and the bytes that the bridge must publish again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

from magbridge.bridge.events import Event, StartEvent
from magbridge.errors import FormatError
from magbridge.link.component import TIMESYNC_US
from magbridge.mavlink import FrameLogReader, LogReader, Stream, TlogRecord, spec
from magbridge.records import Channel

BEGIN, PARAMETER, STREAM, COLUMN = (
    spec(name).id for name in ("MAG_BRIDGE_START", "PARAM_VALUE", "MAG_SIGNING_STREAM", "MAG_COLUMN")
)
NOT_EVENTS = (BEGIN, PARAMETER, STREAM, COLUMN, spec("MAG_RAW").id)
"""Ids of the state records that a bridge writes only for readers of the log, not for a replay."""


def is_own_log(path: Path) -> bool:
    """Return True if a file is the beginning of a bridge's own log."""
    if path.suffix.lower() != ".tlog":
        return False
    with path.open("rb") as file:
        first = next(iter(LogReader(file, block_bytes=4096)), None)
    return first is not None and first.channel == Channel.STATE and first.message.id == BEGIN


def runs(paths: Sequence[Path]) -> list[list[Path]]:
    """Group files, in order, by run of a bridge: a run begins with a file in which the bridge starts."""
    grouped: list[list[Path]] = []
    for path in paths:
        if is_own_log(path) or not grouped:
            grouped.append([])
        grouped[-1].append(path)
    return grouped


class Recorded:
    """Log of one run of a bridge, in one file or in several rotated files.

    `start` is the run's start event, `config_digest` the digest of its configuration. `late` is the time from
    the run's start to the log's beginning, s; it exceeds 0 if the log was restarted after a loss. The log
    lacks the bridge's state at that time, so the replay starts without the state. It starts at a multiple of
    the time synchronisation's interval, so that its requests to the autopilot match the logged answers.
    `published` are the bytes that the bridge published, as far as :meth:`events` has been read.

    Raises
    ------
    FormatError
        The first file does not begin with the start of a bridge.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self.published = bytearray()
        self.messages = 0
        self.damages = 0
        self._last_us = 0
        records = self._records()
        first = next(records, None)
        if first is None or first.message.id != BEGIN:
            raise FormatError(paths[0], "expected the log of a bridge, from its start")
        parameters: dict[str, float] = {}
        streams: list[Stream] = []
        for record in records:
            one = record.message
            if record.channel == Channel.STATE and one.id == COLUMN:
                continue  # MAG_COLUMN is repeated in every file, for readers
            if record.channel == Channel.STATE and one.id == STREAM:
                ahead = bool(one["ahead"])
                streams.append((one["link"], one["system"], one["sender"], ahead, one["stamp"]))
                continue
            if record.channel != Channel.STATE or one.id != PARAMETER:
                break
            parameters[one["param_id"]] = one["param_value"]
        self.config_digest = first.message["config_digest"].hex()
        late_us = first.time_us - first.message["time_usec"]
        self.late = late_us * 1e-6
        start_us = first.time_us - late_us % TIMESYNC_US
        self.start = StartEvent(start_us, parameters, first.message["signing_timestamp"], streams)

    def _records(self) -> Iterator[TlogRecord]:
        for path in self._paths:
            with path.open("rb") as file:
                reader = LogReader(file)
                yield from reader
                self.damages += reader.damages

    def events(self) -> Iterator[Event]:
        """Yield the bridge's inputs; add its outputs to `published`."""
        frame_log = FrameLogReader()
        time_us = self.start.time_us
        inputs = (
            record
            for record in self._records()
            if not self._went_out(record)
            # other records may separate two pieces of one input
            and (record.channel != Channel.STATE or record.message.id not in NOT_EVENTS)
        )
        for (time_us, channel, sensor_id), group in groupby(inputs, _event_key):
            if channel == Channel.STATE:
                for record in group:
                    yield Event(time_us, Channel.STATE, record.frame)
            elif channel == Channel.SENSOR:
                # the log may have split the bytes of one time into several records
                messages = (record.message for record in group)
                data = b"".join(message["data"][: message["length"]] for message in messages)
                yield Event(time_us, Channel.SENSOR, data, sensor_id)
            elif data := b"".join(frame_log.data(record.frame) for record in group):
                yield Event(time_us, Channel.LINK, data)
        # timers that fired after the last input
        yield Event(max(time_us, self._last_us), Channel.STATE, b"")

    def _went_out(self, record: TlogRecord) -> bool:
        self._last_us = record.time_us
        if record.channel != Channel.SENT:
            return False
        self.published += record.frame
        self.messages += 1
        return True


def _event_key(record: TlogRecord) -> tuple[int, int, int]:
    """Return time (µs), channel and sensor id of the event that a record belongs to."""
    sensor_id = record.message["sensor_id"] if record.channel == Channel.SENSOR else 0
    return record.time_us, record.channel, sensor_id
