"""Write the live log: all bytes received and sent, as a ``.tlog`` that any MAVLink tool reads.

A record is an 8-byte big-endian stamp and a MAVLink frame. The stamp is the event's time in µs since 1970
UTC, a multiple of 4, plus the :class:`~magbridge.records.Channel` in its low two bits.

The live thread only appends to a queue (about 0.3 µs an event); a second thread writes whole records. It
writes the first record after a pause at once, and records that follow within :data:`WRITE_INTERVAL_S`
together. So ``kill -9`` costs only the last group, and the file is readable to its end. A stalled disk fills
the queue, and a full disk stops the log. Records are then dropped and counted; the live thread never waits.
The first file after a failure begins with the record of the run's start. The ``time_usec`` of this record
precedes the file, from which a replay detects that records are missing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

from magbridge.mavlink import pack_records
from magbridge.records import Channel

__all__ = ["TlogWriter"]

Record = tuple[int, int, bytes]
"""Time of the event (µs since 1970 UTC), channel, and frame."""

WRITE_INTERVAL_S = 0.05
"""Interval between two writes, s. Up to 20 events a second, each event is written at once, and ``kill -9``
costs at most the last event; at higher rates it costs the events of 50 ms. With an interval of 5 ms, the
writing thread would take a sixth of the bridge's processor time at 100 Hz."""
QUEUE = 50_000
"""Largest number of events (some 10 MB) that wait for a stalled disk; further events are dropped."""
LOG_RETRY_US = 2_000_000
"""Time after which a failed log is tried again in a new file, µs of the events' clock."""
SYNC_US = 5_000_000
"""Interval between two syncs, µs of the events' clock: the most that a power failure or a deletion costs."""


class TlogWriter:
    """Writer of records to files ``UTC-start_index.tlog`` in a directory.

    The start in the name is the start of the run, so the files of one run are sorted together even if others
    write to the directory. It is some seconds late if another run has taken the name.

    `directory` is created whenever it does not exist; existing files are never changed. A new file begins
    after `max_size` MB, or `max_age` h of the events' time. The frames of `header` follow the first record of
    every file, so that a reader can interpret each file alone. The frames of `beginning`, which the live
    thread may replace, record the run's start; they begin the first file after a failure.

    `records` counts the written records, `lost` the records dropped because the disk stalled or the log had
    failed. `failure` is the operating system's reason why the log has stopped, empty while it is written.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        max_size: float = 64.0,
        max_age: float = 24.0,
        header: Sequence[bytes] = (),
        beginning: Sequence[bytes] = (),
    ) -> None:
        self._directory = Path(directory)
        self._max_size, self._max_age_us = round(max_size * 1e6), round(max_age * 3.6e9)
        self._header, self.beginning = tuple(header), beginning
        self.records, self.failure = 0, ""
        # used by the live thread
        self._queue: SimpleQueue[Sequence[Record]] = SimpleQueue()
        self._refused = 0
        # used by the writing thread
        self._dropped = 0
        self._file, self._name = -1, self._directory
        self._size = self._index = self._begin_s = 0
        self._torn = False
        self._start_us = self._synced_us = self._failed_us = 0
        self._thread = Thread(target=self._run, name="log writer", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Number of records dropped so far."""
        return self._refused + self._dropped

    def extend(self, records: Sequence[Record]) -> None:
        """Log the frames of an event, each with its time and channel; returns at once and never raises.

        `records` must not be empty, since an empty list ends the writing thread. The caller must not change
        the list.
        """
        if self._queue.qsize() < QUEUE:
            self._queue.put(records)
        else:
            self._refused += len(records)

    def close(self, timeout: float = 5.0) -> None:
        """Write the queued records and end the thread; wait for a stalled disk at most `timeout` s."""
        self._queue.put(())
        self._thread.join(timeout)

    def _run(self) -> None:
        """Write the queued records until an event without records arrives."""
        events: list[Sequence[Record]] = []
        while not events or events[-1]:
            events = [self._queue.get()]
            events += [self._queue.get() for _ in range(self._queue.qsize())]
            if records := [record for event in events for record in event]:
                self._put_all(records)
            time.sleep(WRITE_INTERVAL_S)
        self._end_file()

    def _put_all(self, records: list[Record]) -> None:
        """Write records; continue in the next file when one is full."""
        data = pack_records(records)
        if self._fits(len(data), records[-1][0]):
            self._put_down(data, records)
            return
        for record in records:
            data = pack_records([record])
            if not self._fits(len(data), record[0]):
                self._end_file()
            if self._file >= 0 or self._begin_file(record[0]):
                self._put_down(data, [record])
            else:
                self._dropped += 1

    def _fits(self, size: int, time_us: int) -> bool:
        is_small = self._size + size <= self._max_size
        return self._file >= 0 and is_small and time_us - self._start_us <= self._max_age_us

    def _begin_file(self, time_us: int) -> bool:
        if self.failure and 0 <= time_us - self._failed_us < LOG_RETRY_US:
            return False
        begin_s = self._begin_s or time_us // 1_000_000
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            while self._file < 0:
                begin = datetime.fromtimestamp(begin_s, UTC)
                self._name = self._directory / f"{begin:%Y%m%dT%H%M%SZ}_{self._index + 1:04d}.tlog"
                try:
                    self._file = os.open(self._name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
                except FileExistsError:
                    begin_s += 1  # another run began in the same second
        except OSError as error:
            self._fail(error, time_us)
            return False
        self._begin_s, self._index = begin_s, self._index + 1
        self._size, self._start_us, self._synced_us = 0, time_us, time_us
        return True

    def _put_down(self, data: bytes, records: list[Record]) -> None:
        """Write records to the open file; if writing fails, remove a half-written record."""
        if not self._size:
            first = 0 if self._torn else 1
            frames = (*self.beginning, *self._header) if self._torn else self._header
            declared = [(records[0][0], Channel.STATE, frame) for frame in frames]
            data = pack_records([*records[:first], *declared, *records[first:]])
        rest, time_us = memoryview(data), records[-1][0]
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
            if not 0 <= time_us - self._synced_us < SYNC_US:
                os.fdatasync(self._file)
                self._name.stat()  # raises if the file was deleted, since further writes to it would be lost
                self._synced_us = time_us
        except OSError as error:
            self._fail(error, time_us)
            self._dropped += len(records)
            return
        self._size += len(data)
        self._torn = False
        self.failure = ""
        self.records += len(records)

    def _fail(self, error: OSError, time_us: int) -> None:
        self._torn = True
        if self._file >= 0:
            with suppress(OSError):  # the reader skips a torn record
                os.ftruncate(self._file, self._size)
                if not self._size:  # on a full disk, every attempt would leave an empty file
                    self._name.unlink()
        self._end_file()
        self.failure, self._failed_us = error.strerror or str(error), time_us

    def _end_file(self) -> None:
        if self._file >= 0:
            file, self._file = self._file, -1
            try:
                os.close(file)
            except OSError as error:  # a network disk may report only here that it could not write
                self.failure = error.strerror or str(error)
