"""Read-only files for ground stations: metadata of the parameters, and logs.

Stations read files by MAVLink FTP (MAVLink guide, 'File Transfer Protocol'), and logs also by LOG_REQUEST_*.
To find the metadata, a station requests COMPONENT_METADATA and reads the general file that this message
names; the general file names the file of the parameters (MAVLink guide, 'Component Metadata Protocol').
"""

from __future__ import annotations

import errno
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from enum import IntEnum
from io import BytesIO
from math import ceil, log10
from pathlib import Path
from struct import Struct
from typing import BinaryIO, NamedTuple

import msgspec

from magbridge.link.parameters import Tunable
from magbridge.mavlink import Spec, spec

__all__ = ["GENERAL", "FtpServer", "LogTransfer", "Tree", "crc32", "metadata_files", "uri"]

GENERAL, PARAMETERS = "/general.json", "/parameter.json"
PARAMETER_TYPE = 1
"""Value of COMP_METADATA_TYPE_PARAMETER."""
GROUPS = {"publish": "Rates", "align": "Alignment", "telemetry": "Telemetry", "metadata_files": "Files"}
"""Group of parameters in a ground station, by the first part of the parameter's key."""
MOST_PLACES = 7


def crc32(data: bytes, initial: int = 0) -> int:
    """Return the CRC-32 of MAVLink FTP, which is zlib's without the inversions of start value and result."""
    return zlib.crc32(data, initial ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def uri(component: int, path: str) -> str:
    """Return the MAVLink FTP URI of the file at `path` on `component`."""
    return f"mftp://[;comp={component}]{path}"


def metadata_files(parameters: Iterable[Tunable], component: int) -> Mapping[str, bytes]:
    """Return the contents of the general metadata file and of the parameter metadata file, by path."""
    rows = msgspec.json.encode({"version": 1, "parameters": [describe(row) for row in parameters]})
    kinds = [{"type": PARAMETER_TYPE, "uri": uri(component, PARAMETERS), "fileCrc": crc32(rows)}]
    general = msgspec.json.encode({"version": 1, "metadataTypes": kinds})
    return {GENERAL: general, PARAMETERS: rows}


def describe(row: Tunable) -> dict[str, object]:
    """Return the metadata of one parameter according to MAVLink's JSON schema for parameters."""
    smallest = min((abs(value) for value in (row.default, row.low) if value), default=1.0)
    return {
        "name": row.name,
        "type": "Float",
        "shortDesc": row.doc[:1].upper() + row.doc[1:],
        "longDesc": f"{row.key} of the configuration. Takes effect at once, and is kept over restarts.",
        "units": row.unit,
        "default": row.default,
        "min": row.low,
        "max": row.high,
        "decimalPlaces": min(max(ceil(-log10(smallest)) + 1, 2), MOST_PLACES),
        "rebootRequired": False,
        "volatile": False,
        "group": GROUPS.get(row.key.partition(".")[0], "Standard"),
        "category": "Standard",
    }


LOG = re.compile(r"(\d{8}T\d{6})Z_\d{4,}\.tlog")
"""Names of the bridge's logs; other files of the folder, such as a key, are not served."""
LOGS = ("@MAV_LOG", "logs")
"""Names of the log folder: the name in the MAVLink guide, and a readable alias."""


Entry = tuple[str, int | None]
"""Entry of a folder: its name, and its size in bytes, which is None for a folder."""


class Tree:
    """Read-only tree of the files that stations can read.

    `texts`: contents of the files in the root folder, by path ``/name``.
    `logs`: the folder of the logs on disk; None if logs are not served.
    """

    def __init__(self, texts: Mapping[str, bytes], logs: Path | None) -> None:
        self._texts = {name.strip("/"): text for name, text in texts.items()}
        self._logs = logs

    def entries(self, path: str) -> list[Entry]:
        """Return the entries of a folder, in a fixed order; raise OSError if the folder does not exist."""
        match parts(path):
            case []:
                texts = [(name, len(text)) for name, text in self._texts.items()]
                return [*((name, None) for name in LOGS if self._logs is not None), *texts]
            case [name] if name in LOGS and self._logs is not None:
                return self.logs()
        raise FileNotFoundError(errno.ENOENT, path)

    def open(self, path: str) -> tuple[BinaryIO, int]:
        """Return the opened file at `path` and its size in bytes; raise OSError if it does not exist."""
        match parts(path):
            case [name] if name in self._texts:
                return BytesIO(self._texts[name]), len(self._texts[name])
            case [folder, name] if folder in LOGS and self._logs is not None and LOG.fullmatch(name):
                opened = os.open(self._logs / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
                return os.fdopen(opened, "rb", buffering=0), os.fstat(opened).st_size
        raise FileNotFoundError(errno.ENOENT, path)

    def logs(self) -> list[Entry]:
        """Return the entries of the log folder, oldest log first."""
        if self._logs is None or not self._logs.is_dir():
            return []
        with os.scandir(self._logs) as found:
            logs = [one for one in found if LOG.fullmatch(one.name) and one.is_file(follow_symlinks=False)]
            return sorted((one.name, one.stat().st_size) for one in logs)


def parts(path: str) -> list[str]:
    """Return the names of folders and file in a path; raise OSError if the path contains ``..`` or NUL."""
    names = [name for name in path.split("/") if name not in ("", ".")]
    if ".." in names or "\0" in path:
        raise PermissionError(errno.EACCES, path)
    return names


LOG_ENTRY, LOG_DATA = spec("LOG_ENTRY"), spec("LOG_DATA")
LOG_DATA_BYTES = LOG_DATA.fields["data"].count
LOG_BLOCK_BYTES = 256 * LOG_DATA_BYTES
LAST_LOG_ID = 0xFFFF


class LogTransfer:
    """Replies to LOG_REQUEST_LIST and LOG_REQUEST_DATA.

    Log 1 is the oldest. The numbers are those of the last listing, even if logs were added since.
    """

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._logs: list[Entry] = []

    def entries(self, start: int, end: int) -> Iterator[tuple[Spec, bytes]]:
        """Yield the LOG_ENTRY of each log from number `start` to `end`; without logs, one empty LOG_ENTRY."""
        with suppress(OSError):
            self._logs = self._tree.logs()[-LAST_LOG_ID:]
        count = len(self._logs)
        if not count:
            yield LOG_ENTRY, LOG_ENTRY.payload()
        for number, (name, size) in enumerate(self._logs, 1):
            if start <= number <= end:
                began = datetime.strptime(name[:15], "%Y%m%dT%H%M%S").replace(tzinfo=UTC)  # as LOG demands
                fields = {"id": number, "num_logs": count, "last_log_num": count, "size": size or 0}
                yield LOG_ENTRY, LOG_ENTRY.payload(**fields, time_utc=int(began.timestamp()))

    def data(self, number: int, offset: int, count: int) -> Iterator[tuple[Spec, bytes]]:
        """Yield the LOG_DATA messages with `count` bytes from `offset` of the log `number`.

        A message that is not full, perhaps empty, marks the end of the log. If the log does not exist or
        cannot be read, yield one empty message.
        """
        if not self._logs:
            with suppress(OSError):
                self._logs = self._tree.logs()[-LAST_LOG_ID:]
        end = offset + count
        try:
            name = self._logs[number - 1][0] if 0 < number <= len(self._logs) else ""
            file, _ = self._tree.open(f"logs/{name}")
        except OSError:
            yield LOG_DATA, LOG_DATA.payload(id=number, ofs=offset)
            return
        with file:
            while offset < end:
                file.seek(offset)
                block = file.read(min(LOG_BLOCK_BYTES, end - offset)) or b""
                for at in range(0, len(block), LOG_DATA_BYTES):
                    piece = block[at : at + LOG_DATA_BYTES]
                    fields = {"id": number, "ofs": offset + at, "count": len(piece)}
                    yield LOG_DATA, LOG_DATA.payload(**fields, data=piece.ljust(LOG_DATA_BYTES, b"\0"))
                offset += len(block)
                if len(block) < LOG_BLOCK_BYTES and offset < end:
                    if not len(block) % LOG_DATA_BYTES:
                        yield LOG_DATA, LOG_DATA.payload(id=number, ofs=offset)
                    return


FTP_HEADER = Struct("<HBBBBBxI")
"""Layout of an FTP header: sequence, session, opcode, size, requested opcode, burst complete, offset."""
DATA = 239
"""Most bytes of file data in one FTP message."""
SESSIONS, EACH = 16, 8
"""Most files open at once in total, and of one station."""
SESSION_TIMEOUT_S = 10.0
"""Time since its last request after which a session may be closed to open another, s."""
BURST = 256
"""Most messages of a burst; the station then requests the next burst."""
FTP_BLOCK_BYTES = 1 << 20

Sender = tuple[int, int]
"""System id and component id of a station."""
SessionKey = tuple[Sender, int]
"""Station, and number of its session."""


class Opcode(IntEnum):
    """Operation of an FTP request, or ACK or NAK in a reply."""

    NONE = 0
    TERMINATE = 1
    RESET = 2
    LIST = 3
    OPEN_READ = 4
    READ = 5
    CRC32 = 14
    BURST = 15
    ACK = 128
    NAK = 129


WRITES = range(6, 14)
"""Opcodes of requests that would change files or folders; the server rejects them."""


class Error(IntEnum):
    """Reason why an FTP request was rejected, as numbered by MAVLink."""

    FAIL_ERRNO = 2
    INVALID_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class Refused(Exception):
    """Rejection of an FTP request; `data` is the payload of the NAK."""

    def __init__(self, error: Error, number: int = 0) -> None:
        self.data = bytes((error, number & 0xFF)) if error is Error.FAIL_ERRNO else bytes((error,))
        super().__init__(error.name)


class Request(NamedTuple):
    """Parsed FTP request."""

    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes

    @classmethod
    def from_payload(cls, payload: bytes) -> Request:
        """Parse the payload of a FILE_TRANSFER_PROTOCOL message."""
        sequence, session, opcode, size, _, _, offset = FTP_HEADER.unpack_from(payload)
        return cls(sequence, session, opcode, size, offset, payload[FTP_HEADER.size : FTP_HEADER.size + DATA])

    @property
    def path(self) -> str:
        """Path of the file or folder, as the data of the request state it."""
        return self.data[: self.size].partition(b"\0")[0].decode("utf-8", "replace")

    def reply(
        self, opcode: Opcode, data: bytes = b"", *, later: int = 1, session: int | None = None,
        offset: int | None = None, complete: bool = False,
    ) -> bytes:  # fmt: skip
        """Return the payload of the reply number `later` (from 1) to this request."""
        header = FTP_HEADER.pack(
            (self.sequence + later) & 0xFFFF, self.session if session is None else session, opcode, len(data),
            self.opcode, complete, self.offset if offset is None else offset,
        )  # fmt: skip
        return (header + data).ljust(FTP_HEADER.size + DATA, b"\0")


class FtpServer:
    """MAVLink FTP server for all stations.

    `tree`: the files that stations can read.
    `now_s`: returns the time in s, with which the server finds unused sessions.
    """

    def __init__(self, tree: Tree, now_s: Callable[[], float]) -> None:
        self._tree, self._now = tree, now_s
        self._files: dict[SessionKey, BinaryIO] = {}
        self._used_s: dict[SessionKey, float] = {}  # time of the last use of each session
        self._last: dict[Sender, tuple[Request, bytes]] = {}

    def handle(self, sender: Sender, payload: bytes) -> Iterator[bytes]:
        """Yield the payloads of the replies to a request: one reply, or the replies of a burst.

        A repeated request gets the stored reply and is not executed again, because its reply may be lost.
        """
        request = Request.from_payload(payload)
        before, reply = self._last.get(sender, (None, b""))
        if request == before:
            yield reply
            return
        try:
            if request.size > DATA:
                raise Refused(Error.INVALID_SIZE)  # noqa: TRY301 - as the other operations do
            if request.opcode == Opcode.BURST:
                self._last.pop(sender, None)
                yield from self._burst(sender, request)
                return
            reply = self._answer(sender, request)
        except Refused as refused:
            reply = request.reply(Opcode.NAK, refused.data)
        except (FileNotFoundError, PermissionError, UnicodeError):  # or a path that leads elsewhere
            reply = request.reply(Opcode.NAK, Refused(Error.FILE_NOT_FOUND).data)
        except OSError as error:
            reply = request.reply(Opcode.NAK, Refused(Error.FAIL_ERRNO, error.errno or 0).data)
        self._last[sender] = request, reply
        if len(self._last) > SESSIONS:
            del self._last[next(iter(self._last))]
        yield reply

    @staticmethod
    def refusal(reply: bytes) -> str:
        """Return the reason of a NAK as text; empty for an ACK and for the end of a file."""
        if reply[3] != Opcode.NAK or reply[FTP_HEADER.size] == Error.END_OF_FILE:
            return ""
        return Error(reply[FTP_HEADER.size]).name.lower().replace("_", " ")

    def close(self) -> None:
        """Close all open files."""
        for key in list(self._files):
            self._close(key)

    def _answer(self, sender: Sender, request: Request) -> bytes:
        match request.opcode:
            case Opcode.NONE:
                pass
            case Opcode.TERMINATE:
                self._file(sender, request)
                self._close((sender, request.session))
            case Opcode.RESET:  # closes no file of another station
                for key in [key for key in self._files if key[0] == sender]:
                    self._close(key)
            case Opcode.LIST:
                return self._list(request)
            case Opcode.OPEN_READ:
                return self._open(sender, request)
            case Opcode.READ:
                if data := self._read(sender, request, request.size or DATA):
                    return request.reply(Opcode.ACK, data)
                raise Refused(Error.END_OF_FILE)
            case Opcode.CRC32:
                return self._crc32(request)
            case _:
                raise Refused(Error.FILE_PROTECTED if request.opcode in WRITES else Error.UNKNOWN_COMMAND)
        return request.reply(Opcode.ACK)

    def _list(self, request: Request) -> bytes:
        entries = self._tree.entries(request.path)
        if request.offset >= len(entries):
            raise Refused(Error.END_OF_FILE)
        data = b""
        for name, size in entries[request.offset :]:
            text = f"D{name}" if size is None else f"F{name}\t{size}"
            text_data = text.encode("utf-8", "replace") + b"\0"
            if len(data) + len(text_data) > DATA:
                break
            data += text_data
        return request.reply(Opcode.ACK, data)

    def _open(self, sender: Sender, request: Request) -> bytes:
        number = self._free(sender, request.session)
        file, size = self._tree.open(request.path)
        self._files[sender, number], self._used_s[sender, number] = file, self._now()
        size_data = min(size, 0xFFFFFFFF).to_bytes(4, "little")
        return request.reply(Opcode.ACK, size_data, session=number)

    def _file(self, sender: Sender, request: Request) -> BinaryIO:
        """Return the open file of the session of a request; Refused: it does not exist."""
        key = sender, request.session
        if key not in self._files:
            raise Refused(Error.INVALID_SESSION)
        self._used_s[key] = self._now()
        return self._files[key]

    def _read(self, sender: Sender, request: Request, size: int) -> bytes:
        """Return up to `size` bytes from the offset of a request; empty beyond the end of the file."""
        file = self._file(sender, request)
        file.seek(request.offset)
        return file.read(size)

    def _crc32(self, request: Request) -> bytes:
        file, _ = self._tree.open(request.path)
        total = 0
        with file:
            while data := file.read(FTP_BLOCK_BYTES):
                total = crc32(data, total)
        return request.reply(Opcode.ACK, total.to_bytes(4, "little"))

    def _burst(self, sender: Sender, request: Request) -> Iterator[bytes]:
        """Yield the payloads of a burst of file data; the burst ends early if its session is closed."""
        size, key = request.size or DATA, (sender, request.session)
        file, block = self._file(sender, request), self._read(sender, request, BURST * size)
        for count in range(BURST):
            if self._files.get(key) is not file:
                return
            self._used_s[key] = self._now()
            data = block[count * size : (count + 1) * size]
            opcode, complete = (Opcode.ACK, count == BURST - 1) if data else (Opcode.NAK, False)
            yield request.reply(
                opcode,
                data or bytes((Error.END_OF_FILE,)),
                later=count + 1,
                offset=request.offset + min(count * size, len(block)),
                complete=complete,
            )
            if not data:
                return

    def _free(self, sender: Sender, wanted: int) -> int:
        """Return a free session number, preferably `wanted`, or that of an unused one; Refused: none."""
        own = [key for key in self._files if key[0] == sender]
        crowd = own if len(own) >= EACH else list(self._files) if len(self._files) >= SESSIONS else []
        if crowd:
            oldest = min(crowd, key=self._used_s.__getitem__)
            if self._now() - self._used_s[oldest] < SESSION_TIMEOUT_S:
                raise Refused(Error.NO_SESSIONS)
            self._close(oldest)
        taken = {number for who, number in self._files if who == sender}
        return wanted if wanted not in taken else min(set(range(256)) - taken)

    def _close(self, key: SessionKey) -> None:
        del self._used_s[key]
        with suppress(OSError):
            self._files.pop(key).close()
