"""The files that a station may read: generated texts, and the logs in one folder, also by LOG_REQUEST_*."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from magbridge.mavlink import Spec, spec

__all__ = ["Entry", "LogTransfer", "Tree", "began_s"]

LOG = re.compile(r"(\d{8}T\d{6})Z_\d{4,}\.tlog")
"""Names that the bridge gives its logs: its key or configuration may lie in the same folder."""
LOGS = ("@MAV_LOG", "logs")
"""The folder of the logs, as the MAVLink guide calls it and as people do."""


class Entry(NamedTuple):
    """A name in a folder, and its size in bytes; None is a folder."""

    name: str
    size: int | None


class Tree:
    """A read-only tree.

    Parameters
    ----------
    texts : mapping of str to bytes
        Files of the root, ``/name``.
    logs : Path or None
        The folder of the logs.
    """

    def __init__(self, texts: Mapping[str, bytes], logs: Path | None) -> None:
        self._texts = {name.strip("/"): text for name, text in texts.items()}
        self._logs = logs

    def entries(self, path: str) -> list[Entry]:
        """Return the entries of a folder, in order; raises OSError if it does not exist."""
        match parts(path):
            case []:
                texts = [Entry(name, len(text)) for name, text in self._texts.items()]
                return [*(Entry(name, None) for name in LOGS if self._logs is not None), *texts]
            case [name] if name in LOGS and self._logs is not None:
                return self.logs()
        raise FileNotFoundError(errno.ENOENT, path)

    def open(self, path: str) -> tuple[BinaryIO, int]:
        """Return a file and its size in bytes; raises OSError where there is none."""
        match parts(path):
            case [name] if name in self._texts:
                return BytesIO(self._texts[name]), len(self._texts[name])
            case [folder, name] if folder in LOGS and self._logs is not None and LOG.fullmatch(name):
                opened = os.open(self._logs / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
                return os.fdopen(opened, "rb", buffering=0), os.fstat(opened).st_size
        raise FileNotFoundError(errno.ENOENT, path)

    def logs(self) -> list[Entry]:
        """Return the logs, oldest first."""
        if self._logs is None or not self._logs.is_dir():
            return []
        with os.scandir(self._logs) as found:
            logs = [
                Entry(one.name, one.stat().st_size)
                for one in found
                if LOG.fullmatch(one.name) and one.is_file(follow_symlinks=False)
            ]
        return sorted(logs)


def parts(path: str) -> list[str]:
    """Return the names along a path; raise OSError if it leads upward."""
    names = [name for name in path.split("/") if name not in ("", ".")]
    if ".." in names or "\0" in path:
        raise PermissionError(errno.EACCES, path)
    return names


def began_s(name: str) -> int:
    """Return the start of a log's run by the log's name, s since 1970."""
    found = LOG.fullmatch(name)
    return int(datetime.strptime(found[1], "%Y%m%dT%H%M%S").replace(tzinfo=UTC).timestamp()) if found else 0


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
