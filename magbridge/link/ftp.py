"""MAVLink FTP: a station reads files of the bridge and cannot write.

Requests in, replies out, without port and clock (MAVLink guide, 'File Transfer Protocol'). A request that
cannot be granted gets the protocol's own error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from struct import Struct
from typing import BinaryIO, NamedTuple

from magbridge.link.metadata import crc32
from magbridge.link.tree import Entry, Tree

__all__ = ["DATA", "Error", "FtpServer", "Opcode", "Request"]

FTP_HEADER = Struct("<HBBBBBxI")
"""Sequence, session, opcode, size, opcode replied to, whether the burst is complete, offset."""
DATA = 239
"""Most bytes of data in a message."""
SESSIONS, EACH = 16, 8
"""Most files open at once, and most of one station."""
SESSION_TIMEOUT_S = 10.0
"""s after its last request at which a session may be closed, when another is wanted."""
BURST = 256
"""Most messages of a burst; the station then asks for the next."""
FTP_BLOCK_BYTES = 1 << 20

Sender = tuple[int, int]
"""System and component."""


class Opcode(IntEnum):
    """Operation of a request, or the result in a reply."""

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
"""Create, write, remove, make a folder, truncate, rename ..."""


class Error(IntEnum):
    """Reason why a request was refused."""

    FAIL_ERRNO = 2
    INVALID_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class Refused(Exception):
    """A refused request."""

    def __init__(self, error: Error, number: int = 0) -> None:
        self.data = bytes((error, number & 0xFF)) if error is Error.FAIL_ERRNO else bytes((error,))
        super().__init__(error.name)


class Request(NamedTuple):
    """A parsed request."""

    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes

    @classmethod
    def from_payload(cls, payload: bytes) -> Request:
        """Parse the payload of a FILE_TRANSFER_PROTOCOL."""
        sequence, session, opcode, size, _, _, offset = FTP_HEADER.unpack_from(payload)
        return cls(sequence, session, opcode, size, offset, payload[FTP_HEADER.size : FTP_HEADER.size + DATA])

    @property
    def path(self) -> str:
        """The path in its data."""
        return self.data[: self.size].partition(b"\0")[0].decode("utf-8", "replace")

    def reply(
        self, opcode: Opcode, data: bytes = b"", *, later: int = 1, session: int | None = None,
        offset: int | None = None, complete: bool = False,
    ) -> bytes:  # fmt: skip
        """Return the payload of a reply, the `later`-th to this request."""
        header = FTP_HEADER.pack(
            (self.sequence + later) & 0xFFFF, self.session if session is None else session, opcode, len(data),
            self.opcode, complete, self.offset if offset is None else offset,
        )  # fmt: skip
        return (header + data).ljust(FTP_HEADER.size + DATA, b"\0")


class Session:
    """A file that a station has open."""

    def __init__(self, file: BinaryIO, now_s: float) -> None:
        self.file, self.used = file, now_s

    def read(self, offset: int, size: int) -> bytes:
        """Return bytes of the file; none beyond its end."""
        self.file.seek(offset)
        return self.file.read(size)


class FtpServer:
    """Answer the requests of all stations.

    Parameters
    ----------
    tree : Tree
    now : callable
        A clock in s, for sessions that are no longer used.
    """

    def __init__(self, tree: Tree, now_s: Callable[[], float]) -> None:
        self._tree, self._now = tree, now_s
        self._sessions: dict[tuple[Sender, int], Session] = {}
        self._last: dict[Sender, tuple[Request, bytes]] = {}
        self._simple: dict[int, Callable[[Sender, Request], bytes]] = {
            Opcode.NONE: lambda _, request: request.reply(Opcode.ACK),
            Opcode.TERMINATE: self._terminate,
            Opcode.RESET: self._reset,
            Opcode.LIST: self._list,
            Opcode.OPEN_READ: self._open,
            Opcode.READ: self._read,
            Opcode.CRC32: self._crc32,
        }

    def handle(self, sender: Sender, payload: bytes) -> Iterator[bytes]:
        """Yield the payloads of the replies to a request: one, or a burst, read as it is taken.

        A request that comes again, because its reply was lost, gets the same reply again and does nothing.
        """
        request = Request.from_payload(payload)
        before, reply = self._last.get(sender, (None, b""))
        if request == before:
            yield reply
            return
        try:
            if request.opcode == Opcode.BURST:
                self._last.pop(sender, None)
                yield from self._burst(sender, request)
                return
            reply = self._answer(sender, request)
        except Refused as refused:
            reply = request.reply(Opcode.NAK, refused.data)
        except OSError as error:
            reply = request.reply(Opcode.NAK, Refused(Error.FAIL_ERRNO, error.errno or 0).data)
        self._last[sender] = request, reply
        if len(self._last) > SESSIONS:
            del self._last[next(iter(self._last))]
        yield reply

    @staticmethod
    def refusal(reply: bytes) -> str:
        """Return the reason of a refusal as text; empty for a grant and at the end of a file."""
        if reply[3] != Opcode.NAK or reply[FTP_HEADER.size] == Error.END_OF_FILE:
            return ""
        return Error(reply[FTP_HEADER.size]).name.lower().replace("_", " ")

    def close(self) -> None:
        """Close all files."""
        for key in list(self._sessions):
            self._close(key)

    def _answer(self, sender: Sender, request: Request) -> bytes:
        self._check(request)
        if request.opcode in WRITES:
            raise Refused(Error.FILE_PROTECTED)
        answer = self._simple.get(request.opcode)
        if answer is None:
            raise Refused(Error.UNKNOWN_COMMAND)
        return answer(sender, request)

    def _terminate(self, sender: Sender, request: Request) -> bytes:
        self._session(sender, request)
        self._close((sender, request.session))
        return request.reply(Opcode.ACK)

    def _reset(self, sender: Sender, request: Request) -> bytes:
        """Close all files that this station has open, but not those of other stations."""
        for key in [key for key in self._sessions if key[0] == sender]:
            self._close(key)
        return request.reply(Opcode.ACK)

    def _list(self, _: Sender, request: Request) -> bytes:
        with _no_such_file():
            entries = self._tree.entries(request.path)
        if request.offset >= len(entries):
            raise Refused(Error.END_OF_FILE)
        data = b""
        for one in entries[request.offset :]:
            text = _described(one)
            if len(data) + len(text) > DATA:
                break
            data += text
        return request.reply(Opcode.ACK, data)

    def _open(self, sender: Sender, request: Request) -> bytes:
        number = self._free(sender, request.session)
        with _no_such_file():
            file, size = self._tree.open(request.path)
        self._sessions[sender, number] = Session(file, self._now())
        size_data = min(size, 0xFFFFFFFF).to_bytes(4, "little")
        return request.reply(Opcode.ACK, size_data, session=number)

    def _read(self, sender: Sender, request: Request) -> bytes:
        data = self._session(sender, request).read(request.offset, request.size or DATA)
        if not data:
            raise Refused(Error.END_OF_FILE)
        return request.reply(Opcode.ACK, data)

    def _crc32(self, _: Sender, request: Request) -> bytes:
        with _no_such_file():
            file, _size = self._tree.open(request.path)
        total = 0
        with file:
            while data := file.read(FTP_BLOCK_BYTES):
                total = crc32(data, total)
        return request.reply(Opcode.ACK, total.to_bytes(4, "little"))

    def _burst(self, sender: Sender, request: Request) -> Iterator[bytes]:
        """Yield the messages of a burst; it ends when its session does."""
        self._check(request)
        session, size = self._session(sender, request), request.size or DATA
        block = session.read(request.offset, BURST * size)
        for count in range(BURST):
            if self._sessions.get((sender, request.session)) is not session:
                return
            session.used = self._now()
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

    @staticmethod
    def _check(request: Request) -> None:
        if request.size > DATA:
            raise Refused(Error.INVALID_SIZE)

    def _session(self, sender: Sender, request: Request) -> Session:
        session = self._sessions.get((sender, request.session))
        if session is None:
            raise Refused(Error.INVALID_SESSION)
        session.used = self._now()
        return session

    def _free(self, sender: Sender, wanted: int) -> int:
        """Return the number of a new session, `wanted` if it is free; close the oldest if necessary."""
        own = [key for key in self._sessions if key[0] == sender]
        crowd = own if len(own) >= EACH else list(self._sessions) if len(self._sessions) >= SESSIONS else []
        if crowd:
            oldest: tuple[Sender, int] = min(crowd, key=lambda key: self._sessions[key].used)
            if self._now() - self._sessions[oldest].used < SESSION_TIMEOUT_S:
                raise Refused(Error.NO_SESSIONS)
            self._close(oldest)
        taken = {number for who, number in self._sessions if who == sender}
        return wanted if wanted not in taken else min(set(range(256)) - taken)

    def _close(self, key: tuple[Sender, int]) -> None:
        with suppress(OSError):
            self._sessions.pop(key).file.close()


@contextmanager
def _no_such_file() -> Iterator[None]:
    """Turn 'no such file', or a path that leads elsewhere, into the protocol's error."""
    try:
        yield
    except (FileNotFoundError, PermissionError, UnicodeError) as error:
        raise Refused(Error.FILE_NOT_FOUND) from error


def _described(device: Entry) -> bytes:
    """Return an entry of a listing."""
    text = f"D{device.name}" if device.size is None else f"F{device.name}\t{device.size}"
    return text.encode("utf-8", "replace") + b"\0"
