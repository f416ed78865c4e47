"""A link by TCP, as client or server."""

from __future__ import annotations

import select
import socket
from contextlib import suppress

from magbridge.bridge.address import resolve
from magbridge.bridge.stream import Stream
from magbridge.errors import PortError

__all__ = ["TcpClient", "TcpServer"]

UNSENT = 4096
"""Bytes that may wait in the system for a slow connection; the rest waits here, where it can be dropped."""
SHARE = 8192
"""Bytes of a connection that are read before the sensor's turn: a flood of them is parsed in some 10 ms."""


class _Connection(Stream):
    """One TCP connection."""

    def __init__(self, name: str, address: tuple[str, int]) -> None:
        super().__init__(name, UNSENT)
        self._address = address
        self._connection: socket.socket | None = None

    def fds(self) -> list[int]:
        """Return the connection's descriptor, if there is one."""
        return [self._connection.fileno()] if self._connection is not None else []

    def read(self) -> bytes:
        """Return what has come."""
        assert self._connection is not None
        try:
            data = self._connection.recv(SHARE)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self.lost(error.strerror) from error
        if not data:
            raise self.lost("closed by the other end")
        return data

    def write(self, data: bytes) -> None:
        """Send as :meth:`Stream.write` does; without a connection, `data` are dropped."""
        if self._connection is None:
            self.dropped += len(data)
        else:
            super().write(data)

    def _room(self) -> bool:
        return self._connection is not None and bool(select.select([], [self._connection], [], 0)[1])

    def _put(self, data: bytes | bytearray) -> int:
        assert self._connection is not None
        try:
            return self._connection.send(data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self.lost(error.strerror) from error

    def write_all(self, data: bytes) -> None:
        """Send `data` whole, waiting for a slow reader."""
        assert self._connection is not None
        self._connection.setblocking(True)
        self._connection.sendall(data)
        self._connection.setblocking(False)

    def adopt(self, connection: socket.socket) -> None:
        """Make `connection` the one to use."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
        self.drop()
        self._connection = connection

    def drop(self) -> None:
        """Close the connection and forget what was to be sent on it."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None
        self._forget()


class TcpClient(_Connection):
    """``tcp``: connects to a server."""

    @property
    def up(self) -> bool:
        """Whether it is connected."""
        return self._connection is not None

    def open(self) -> None:
        """Connect, waiting at most a second; raises :class:`PortError`."""
        try:
            self.adopt(socket.create_connection(self._address, timeout=1.0))
        except OSError as error:
            raise PortError(self.name, error.strerror or str(error)) from error

    def close(self) -> None:
        """Close the connection."""
        self.drop()


class TcpServer(_Connection):
    """``tcpin``: waits for a client; a new one takes the place of the old, which may be dead."""

    def __init__(self, name: str, address: tuple[str, int]) -> None:
        super().__init__(name, address)
        self._listener: socket.socket | None = None

    @property
    def up(self) -> bool:
        """Whether it listens."""
        return self._listener is not None

    def open(self) -> None:
        """Listen; raises :class:`PortError`."""
        try:
            family, address = resolve(self._address, socket.SOCK_STREAM, listen=True)
            both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
            self._listener = socket.create_server(address, family=family, dualstack_ipv6=both)
        except OSError as error:
            raise PortError(self.name, error.strerror or str(error)) from error
        self._listener.setblocking(False)

    def fds(self) -> list[int]:
        """Return the listener's descriptor and the client's."""
        listener = [self._listener.fileno()] if self._listener is not None else []
        return listener + super().fds()

    def read(self) -> bytes:
        """Accept a waiting client, then return what the client has sent; a client that leaves is no error."""
        assert self._listener is not None
        with suppress(BlockingIOError):
            self.adopt(self._listener.accept()[0])
        try:
            return super().read() if self._connection is not None else b""
        except PortError:
            return b""

    def flush(self) -> None:
        """Send to the client; a client that leaves is no error."""
        with suppress(PortError):
            super().flush()

    def lost(self, reason: object) -> PortError:
        """Drop the client: the port itself is well."""
        self.drop()
        return PortError(self.name, str(reason))

    def close(self) -> None:
        """Close the client and the listener."""
        self.drop()
        if self._listener is not None:
            self._listener.close()
        self._listener = None
