"""A link by TCP, as client or server."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import cast

from magbridge.bridge.address import resolve
from magbridge.bridge.peers import Peer, Peers
from magbridge.bridge.port import Port
from magbridge.bridge.stream import PacedPort
from magbridge.errors import PortError

__all__ = ["TcpClient", "TcpServer"]

UNSENT = 4096
"""Bytes that may wait in the system for a slow connection; the rest waits here, where it can be dropped."""
SHARE = 8192
"""Bytes of a connection that are read before the sensor's turn: a flood of them is parsed in some 10 ms."""
CONNECTIONS = 16
"""Most clients of a server; for another one, one that has said nothing valid has to go."""
GREETING = 0.2
"""s that a client has to say something valid before it has to go for another."""
ACCEPTED = 4
"""Most clients that are accepted before the sensor's turn."""


class _Connection(PacedPort):
    """One TCP connection."""

    def __init__(self, name: str) -> None:
        super().__init__(name, UNSENT)
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
        self.close()
        self._connection = connection

    @property
    def is_open(self) -> bool:
        """Whether there is a connection."""
        return self._connection is not None

    def close(self) -> None:
        """Close the connection and forget what was to be sent on it."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None
        self._forget()


class TcpClient(_Connection):
    """``tcp``: connects to a server."""

    def __init__(self, name: str, address: tuple[str, int]) -> None:
        super().__init__(name)
        self._address = address

    def open(self) -> None:
        """Connect, waiting at most a second; raises :class:`PortError`."""
        try:
            self.adopt(socket.create_connection(self._address, timeout=1.0))
        except OSError as error:
            raise PortError(self.name, error.strerror or str(error)) from error


class _Client(_Connection):
    """One client of a server: when it goes, the server is well."""

    def __init__(self, name: str, connection: socket.socket) -> None:
        super().__init__(name)
        self.since = time.monotonic()
        self.adopt(connection)

    def open(self) -> None:
        """Raise :class:`PortError`: a client comes by itself."""
        raise PortError(self.name, "not connected")


class TcpServer(Port):
    """``tcpin``: waits for clients, and answers those that :class:`Peers` lets it answer.

    On a link without signatures a client is answered at once, because it may only want to listen, and its
    address is no forgery. But who has said something valid is never turned out for another.
    """

    def __init__(self, name: str, address: tuple[str, int], peers: Peers, *, signed: bool = False) -> None:
        super().__init__(name)
        self._address, self._peers, self._signed = address, peers, signed
        self._listener: socket.socket | None = None
        self._clients: dict[int, _Client] = {}

    @property
    def is_open(self) -> bool:
        """Whether it listens."""
        return self._listener is not None

    def open(self) -> None:
        """Listen; raises :class:`PortError`."""
        try:
            family, address = resolve(self._address, socket.SOCK_STREAM, listen=True)
            both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
            listener = socket.create_server(address, family=family, dualstack_ipv6=both)
        except OSError as error:
            raise PortError(self.name, error.strerror or str(error)) from error
        listener.setblocking(False)
        self._listener = listener

    def fds(self) -> list[int]:
        """Return the listener's descriptor and the clients'."""
        return ([self._listener.fileno()] if self._listener is not None else []) + list(self._clients)

    def read(self) -> bytes:
        """Accept clients that wait, then return what all have sent; a client that leaves is no error."""
        assert self._listener is not None
        with suppress(OSError):  # nobody waits, or who did has gone, or there are too many open files
            for _ in range(ACCEPTED):
                self._accept(self._listener.accept()[0])
        for fd, client in list(self._clients.items()):
            try:
                if data := client.read():
                    self._peers.receive(fd, data)
            except PortError:
                self._dismiss(fd)
        return self._peers.drain()

    def write(self, data: bytes) -> None:
        """Send to those clients that are to be answered; without one, `data` are dropped."""
        peers = self._chosen()
        chosen = [fd for fd, peer in peers.items() if self._peers.affords(peer, len(data))]
        for fd in chosen:
            self._write_one(fd, data)
        if not chosen:
            self.dropped += len(data)
        elif (first := self._clients.get(chosen[0])) is not None:  # of the others nobody wants to know
            self.dropped, self.overrun = self.dropped + first.dropped, self.overrun + first.overrun
            first.dropped = first.overrun = 0

    def write_to(self, sender: tuple[int, int], data: bytes) -> None:
        """Send only to the client from which a system and component was last heard."""
        peer = self._peers.route(sender)
        if peer is not None and peer.address in self._clients and self._peers.affords(peer, len(data)):
            self._write_one(peer.address, data)

    def _write_one(self, fd: int, data: bytes) -> None:
        """Send to one client; one that leaves is no error."""
        try:
            self._clients[fd].write(data)
        except PortError:
            self._dismiss(fd)

    def _chosen(self) -> dict[int, Peer | None]:
        """Return those to send to by their descriptors, in the order in which to send."""
        valid = {cast(int, peer.address): peer for peer in self._peers.answered()}
        chosen: dict[int, Peer | None] = {fd: peer for fd, peer in valid.items() if fd in self._clients}
        if not self._signed:
            chosen |= {fd: None for fd in self._clients if fd not in chosen}
        return chosen

    @property
    def waiting(self) -> bool:
        """Whether something waits that a slow client had no room for."""
        return any(client.waiting for client in self._clients.values())

    def flush(self) -> None:
        """Send to the clients; one that leaves is no error."""
        for fd, client in list(self._clients.items()):
            try:
                client.flush()
            except PortError:
                self._dismiss(fd)

    def blocked(self) -> list[int]:
        """Return the descriptors of clients that take more once they are writable."""
        return [fd for fd, client in self._clients.items() if client.waiting]

    def credit(self, frames: Iterable[bytes]) -> None:
        """Answer, from now on, who sent these frames."""
        self._peers.credit(frames)

    def notice(self) -> str:
        """Return something to tell about the clients, once."""
        return self._peers.notices.popleft() if self._peers.notices else ""

    def write_all(self, data: bytes) -> None:
        """Send `data` whole to every client, waiting for a slow reader."""
        for client in self._clients.values():
            client.write_all(data)

    def close(self) -> None:
        """Close the clients and the listener."""
        for fd in list(self._clients):
            self._dismiss(fd)
        if self._listener is not None:
            self._listener.close()
        self._listener = None

    def _accept(self, connection: socket.socket) -> None:
        """Take a client, if need be for one that has had its time and said nothing valid."""
        if len(self._clients) >= CONNECTIONS:
            late = time.monotonic() - GREETING
            mute = (fd for fd, one in self._clients.items() if not self._peers.is_known(fd))
            idle = next((fd for fd in mute if self._clients[fd].since < late), None)
            if idle is None:
                connection.close()
                return
            self._dismiss(idle)
        self._clients[connection.fileno()] = _Client(self.name, connection)

    def _dismiss(self, fd: int) -> None:
        self._clients.pop(fd).close()
        self._peers.forget(fd)
