"""The MAVLink link: UDP and TCP sockets, or a serial line."""

from __future__ import annotations

import errno
import os
import re
import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from ipaddress import IPv6Address
from operator import itemgetter
from typing import Any

from magbridge.bridge.port import CHUNK, Port
from magbridge.bridge.serial_port import serial_line
from magbridge.bridge.stream import Stream
from magbridge.errors import ConfigError, PortError

__all__ = ["LINKS", "TcpClient", "TcpServer", "UdpPort", "open_link"]

UNSENT = 4096
"""Bytes that may wait in the system for a slow connection; the rest waits here, where it can be dropped."""
SHARE = 8192
"""Bytes of a connection that are read before the sensor's turn: a flood of them is parsed in some 10 ms."""
PEER_TIMEOUT = 30.0
"""s without a packet after which a UDP peer is forgotten, or connected anew."""
PEERS = 16
"""Stations that ``udpin`` answers; of more, those heard last."""
AWAY = (errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EPERM)
"""What a UDP socket reports when nobody listens (yet): no fault of the port."""
ADDRESS = re.compile(r"(?://)?(?:\[(?P<ipv6>.+)\]|(?P<host>[^:]*)):(?P<port>[0-9]{1,5})")


class UdpPort(Port):
    """``udpout`` sends to one address; ``udpin`` answers the stations that it has heard from lately."""

    def __init__(self, name: str, address: tuple[str, int], *, listen: bool) -> None:
        super().__init__(name)
        self._address, self._listen = address, listen
        self._socket: socket.socket | None = None
        self._peers: dict[Any, float] = {}
        self._heard = 0.0

    @property
    def up(self) -> bool:
        """Whether the socket is open."""
        return self._socket is not None

    def open(self) -> None:
        """Bind or connect; raises :class:`PortError`."""
        try:
            opened = self._new()
        except OSError as error:
            raise PortError(self.name, error.strerror or str(error)) from error
        self._socket, self._heard = opened, time.monotonic()

    def tend(self) -> None:
        """Connect anew if nothing has come for long, and the host, or we, have another address by now."""
        opened, now = self._socket, time.monotonic()
        if opened is None or self._listen or now - self._heard < PEER_TIMEOUT:
            return
        self._heard = now
        with suppress(OSError), self._new() as new:  # not known at present, or closed meanwhile
            if _ends(new) != _ends(opened):
                # the same descriptor, because the bridge may be waiting for it
                os.dup2(new.fileno(), opened.fileno(), inheritable=False)

    def _new(self) -> socket.socket:
        """Return a socket that is bound or connected; raises OSError."""
        family, address = _resolve(self._address, socket.SOCK_DGRAM, listen=self._listen)
        opened = socket.socket(family, socket.SOCK_DGRAM)
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        try:
            (opened.bind if self._listen else opened.connect)(address)
        except OSError:
            opened.close()
            raise
        return opened

    def fds(self) -> list[int]:
        """Return the one descriptor, if open."""
        return [self._socket.fileno()] if self._socket is not None else []

    def read(self) -> bytes:
        """Return the datagrams that have come; an unreachable peer is nothing, not an error.

        All that are waiting are returned at once, as from a stream, so that samples that queued up while the
        bridge stood still meet the telemetry that queued up with them.
        """
        assert self._socket is not None
        data = b""
        while len(data) < CHUNK:
            try:
                datagram, peer = self._socket.recvfrom(CHUNK)
            except BlockingIOError:
                break
            except OSError as error:
                if data or error.errno in AWAY:
                    break  # first return what has come
                raise self.lost(error.strerror) from error
            self._heard = time.monotonic()
            if self._listen:
                self._peers.pop(peer, None)  # so that the dict is in the order in which they were heard last
                self._peers[peer] = self._heard
                if len(self._peers) > PEERS:
                    del self._peers[next(iter(self._peers))]
            data += datagram
            if not datagram:
                break  # empty datagrams could keep this loop running for ever
        return data

    def write(self, data: bytes) -> None:
        """Send one datagram to each peer; what cannot be sent is dropped and counted."""
        assert self._socket is not None
        if not self._listen:
            self._send(data, None)
            return
        now = time.monotonic()
        for peer, heard in list(self._peers.items()):
            if now - heard > PEER_TIMEOUT:
                del self._peers[peer]
            else:
                self._send(data, peer)

    def _send(self, data: bytes, peer: Any) -> None:
        assert self._socket is not None
        try:
            if peer is None:
                self._socket.send(data)
            else:
                self._socket.sendto(data, peer)
        except BlockingIOError:
            self.overran(data)
        except OSError as error:
            if error.errno not in AWAY:
                raise self.lost(error.strerror) from error
            self.dropped += len(data)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None


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
            family, address = _resolve(self._address, socket.SOCK_STREAM, listen=True)
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


def _resolve(address: tuple[str, int], kind: int, *, listen: bool) -> tuple[int, Any]:
    """Return the family and the socket address of a host; of a name that has both, IPv4's. Raises OSError."""
    host, port = address
    found = socket.getaddrinfo(host or None, port, type=kind, flags=socket.AI_PASSIVE if listen else 0)
    family, *_, resolved = min(found, key=itemgetter(0))
    return family, resolved


def _ends(connected: socket.socket) -> tuple[Any, Any]:
    """Return our own address, without its port, and the peer's."""
    return connected.getsockname()[0], connected.getpeername()


def _address(text: str) -> tuple[str, int]:
    """Return host and port; raises ValueError."""
    match = ADDRESS.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        raise ValueError(text)
    if match["ipv6"]:
        return str(IPv6Address(match["ipv6"])), int(match["port"])
    match["host"].encode("idna")  # raises UnicodeError, as looking it up would
    return match["host"], int(match["port"])


LINKS: dict[str, Callable[[str, tuple[str, int]], Port]] = {
    "udpin": partial(UdpPort, listen=True),
    "udpout": partial(UdpPort, listen=False),
    "tcp": TcpClient,
    "tcpin": TcpServer,
}
"""Link kinds by the first part of the URL, as in the MAVLink world; any other URL is a serial device."""


def open_link(url: str, baudrate: int, source: str = "bridge.toml", key: str = "link.url") -> Port:
    """Return the (unopened) port for a MAVLink URL.

    Raises
    ------
    ConfigError
        An unknown kind of link or of serial URL, or an address that is not HOST:PORT; it names `source` and
        `key`.
    """
    kind, colon, address = url.partition(":")
    if kind not in LINKS:
        if colon and kind.isalnum() and kind != "serial" and not address.startswith("//"):
            known = ", ".join(LINKS)
            raise ConfigError(source, key, f"expected {known} or a serial device, got {url!r}")
        return serial_line(url.removeprefix("serial:"), baudrate, source, key)
    try:
        host, port = _address(address)
        if not port and kind in ("udpout", "tcp"):  # of one's own, 0 is any that is free
            raise ValueError(url)  # noqa: TRY301 - as `_address` does
    except ValueError as error:
        raise ConfigError(source, key, f"expected HOST:PORT or [IPV6]:PORT, got {url!r}") from error
    return LINKS[kind](url, (host, port))
