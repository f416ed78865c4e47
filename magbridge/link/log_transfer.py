"""Transfer logs by LOG_REQUEST_LIST, LOG_REQUEST_DATA and LOG_REQUEST_END; logs are never erased."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

from magbridge.link.tree import Entry, Tree, began_s
from magbridge.mavlink import Spec, spec

__all__ = ["LogTransfer"]

ENTRY, DATA = spec("LOG_ENTRY"), spec("LOG_DATA")
LOG_DATA_BYTES = DATA.fields["data"].count
LOG_BLOCK_BYTES = 256 * LOG_DATA_BYTES
LAST_LOG_ID = 0xFFFF


class LogTransfer:
    """List logs and send their data.

    Logs are numbered from 1, the oldest, as they were when they were last listed.
    """

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._logs: list[Entry] = []

    def entries(self, start: int, end: int) -> Iterator[tuple[Spec, bytes]]:
        """Yield the LOG_ENTRY of each log from `start` to `end`; one with no logs where there are none."""
        with suppress(OSError):
            self._logs = self._tree.logs()[-LAST_LOG_ID:]
        count = len(self._logs)
        if not count:
            yield ENTRY, ENTRY.payload()
        for number, one in enumerate(self._logs, 1):
            if start <= number <= end:
                fields = {"id": number, "num_logs": count, "last_log_num": count, "size": one.size or 0}
                yield ENTRY, ENTRY.payload(**fields, time_utc=began_s(one.name))

    def data(self, number: int, offset: int, count: int) -> Iterator[tuple[Spec, bytes]]:
        """Yield LOG_DATA from `offset` of a log; one that is not full, perhaps empty, ends the log.

        An empty one is also the answer where there is no such log, or it cannot be read.
        """
        if not self._logs:
            with suppress(OSError):
                self._logs = self._tree.logs()[-LAST_LOG_ID:]
        end = offset + count
        try:
            name = self._logs[number - 1].name if 0 < number <= len(self._logs) else ""
            file, _ = self._tree.open(f"logs/{name}")
        except OSError:
            yield DATA, DATA.payload(id=number, ofs=offset)
            return
        with file:
            while offset < end:
                file.seek(offset)
                block = file.read(min(LOG_BLOCK_BYTES, end - offset)) or b""
                for at in range(0, len(block), LOG_DATA_BYTES):
                    piece = block[at : at + LOG_DATA_BYTES]
                    fields = {"id": number, "ofs": offset + at, "count": len(piece)}
                    yield DATA, DATA.payload(**fields, data=piece.ljust(LOG_DATA_BYTES, b"\0"))
                offset += len(block)
                if len(block) < LOG_BLOCK_BYTES and offset < end:
                    if not len(block) % LOG_DATA_BYTES:
                        yield DATA, DATA.payload(id=number, ofs=offset)
                    return
