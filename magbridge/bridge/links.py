"""Ports of MAVLink links by UDP, TCP (client and server) or serial line, and of NMEA outputs."""

from __future__ import annotations

import errno
import re
import select
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import IPv6Address
from math import inf
from operator import itemgetter
from typing import Any

from magbridge.bridge.devices import may_be_device, serial_line
from magbridge.bridge.port import PEER_READ_BYTES, READ_BYTES, PacedPort, Peer, Peers, Port, cut
from magbridge.config import Config
from magbridge.errors import ConfigError, PortError

__all__ = ["LINKS", "nmea_port", "open_link"]

ADDRESS = re.compile(r"(?://)?(?:\[(?P<ipv6>.+)\]|(?P<host>[^:]*)):(?P<port>[0-9]{1,5})")
UNSENT = 4096
"""Most bytes that wait in the system for a slow connection; the bridge keeps the rest and can drop it."""
CONNECTIONS = 16
"""Most clients of a server; a further client replaces a client that has sent nothing valid."""
GREETING = 0.2
"""Time in which a client may send its first valid frame before another client can replace it, s."""
ACCEPTED = 4
"""Most clients that are accepted before the sensors are read."""
DATAGRAM = 1400
"""Most bytes of one packet, which any usual network transmits without fragmentation."""
DATAGRAMS = 512
"""Most packets that are read before the sensors are read, since empty packets could delay them for ever."""
NO_LISTENER_ERRORS = (errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EPERM)
"""Errors of a UDP socket if no program listens yet, which are not faults of the port."""


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT`` or ``[IPV6]:PORT``; raise ValueError for other texts."""
    match = ADDRESS.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        raise ValueError(text)
    if match["ipv6"]:
        return str(IPv6Address(match["ipv6"])), int(match["port"])
    match["host"].encode("idna")  # raises UnicodeError, as resolving the name would
    return match["host"], int(match["port"])


def resolve(address: tuple[str, int], kind: int, *, listen: bool) -> tuple[int, Any]:
    """Return address family and socket address of a host, preferably IPv4; raise OSError if it is unknown.

    `kind`: type of the socket. `listen`: True for an address to bind.
    """
    host, port = address
    found = socket.getaddrinfo(host or None, port, type=kind, flags=socket.AI_PASSIVE if listen else 0)
    family, *_, resolved = min(found, key=itemgetter(0))
    return family, resolved


class TcpConnection(PacedPort):
    """Port of ``tcp``, a connection to a server at `address`; without address, a client of `TcpServer`."""

    def __init__(self, name: str, address: tuple[str, int] | None = None) -> None:
        super().__init__(name, UNSENT, read_bytes=PEER_READ_BYTES, ended="closed by the other end")
        self._address = address
        self._connection: socket.socket | None = None
        self.since = 0.0
        """Time at which the connection was made, s of the monotonic clock."""

    def _open(self) -> int:
        """Connect within a second."""
        assert self._address is not None
        return self.adopt(socket.create_connection(self._address, timeout=1.0))

    def adopt(self, connection: socket.socket) -> int:
        """Use `connection` as the port's socket, and return its descriptor."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
        self.since, self._connection, self._fd = time.monotonic(), connection, connection.fileno()
        return self._fd

    def _send(self, data: bytes, address: Any) -> None:
        """Send `data` as other paced ports do; without a connection, drop `data`."""
        if self._connection is None:
            self.dropped += len(data)
        else:
            super()._send(data, address)

    def _room(self) -> bool:
        return self._connection is not None and bool(select.select([], [self._connection], [], 0)[1])

    def write_all(self, data: bytes) -> None:
        """Send all of `data`; wait if the reader is slow."""
        assert self._connection is not None
        self._connection.setblocking(True)
        self._connection.sendall(data)
        self._connection.setblocking(False)

    def close(self) -> None:
        """Close the connection and discard its unsent bytes."""
        if self._connection is not None:
            self._connection.close()
        self._connection, self._fd = None, -1
        self._forget()


class TcpServer(Port):
    """Port of ``tcpin``, a server that sends to the clients which :class:`Peers` accepts.

    On a link without signatures, the server sends to every client at once, because a client may only want to
    receive and cannot forge its address. A client that has sent a valid frame is never disconnected in favour
    of another one.
    """

    def __init__(self, name: str, address: tuple[str, int], peers: Peers, *, signed: bool = False) -> None:
        super().__init__(name, peers)
        self._peers: Peers
        self._address, self._signed = address, signed
        self._listener: socket.socket | None = None
        self._clients: dict[int, TcpConnection] = {}

    def _open(self) -> int:
        """Start to listen."""
        family, address = resolve(self._address, socket.SOCK_STREAM, listen=True)
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        self._listener = socket.create_server(address, family=family, dualstack_ipv6=both)
        self._listener.setblocking(False)
        return self._listener.fileno()

    def fds(self) -> list[int]:
        """Return the file descriptors of the listening socket and of the clients."""
        return super().fds() + list(self._clients)

    def _receive(self) -> list[tuple[Any, bytes]]:
        """Accept waiting clients, then return the received bytes of each client; remove clients that left."""
        assert self._listener is not None
        with suppress(OSError):  # no client waits, or it has left, or too many files are open
            for _ in range(ACCEPTED):
                self._accept(self._listener.accept()[0])
        received = []
        for fd, client in list(self._clients.items()):
            try:
                received.append((fd, client.read()))
            except PortError:
                self._dismiss(fd)
        return [(fd, data) for fd, data in received if data]

    def write(self, data: bytes) -> None:
        """Send `data` to the accepted clients; without clients, drop `data`."""
        first = next((fd for fd, _ in self._receivers()), None)
        super().write(data)
        if first is None:
            self.dropped += len(data)
        elif (client := self._clients.get(first)) is not None:  # losses of further clients do not count
            self.dropped, self.overrun = self.dropped + client.dropped, self.overrun + client.overrun
            client.dropped = client.overrun = 0

    def _send(self, data: bytes, address: Any) -> None:
        """Send `data` to the client with descriptor `address`; remove the client if it has left."""
        try:
            if address in self._clients:
                self._clients[address].write(data)
        except PortError:
            self._dismiss(address)

    def _receivers(self) -> list[tuple[Any, Peer | None]]:
        """Return descriptor and peer of each client to send to; None for one that only receives."""
        chosen = [(fd, peer) for fd, peer in super()._receivers() if fd in self._clients]
        answered = {fd for fd, _ in chosen}
        others = [] if self._signed else [(fd, None) for fd in self._clients if fd not in answered]
        return [*chosen, *others]

    @property
    def waiting(self) -> bool:
        """True if bytes wait for a slow client."""
        return any(client.waiting for client in self._clients.values())

    def flush(self) -> None:
        """Send more of the waiting bytes to the clients; remove clients that left."""
        for fd, client in list(self._clients.items()):
            try:
                client.flush()
            except PortError:
                self._dismiss(fd)

    def blocked(self) -> list[int]:
        """Return the descriptors of the clients for which bytes wait."""
        return [fd for fd, client in self._clients.items() if client.waiting]

    def write_all(self, data: bytes) -> None:
        """Send all of `data` to every client; wait for slow clients."""
        for client in self._clients.values():
            client.write_all(data)

    def close(self) -> None:
        """Close the connections to all clients and the listening socket."""
        for fd in list(self._clients):
            self._dismiss(fd)
        if self._listener is not None:
            self._listener.close()
        self._listener, self._fd = None, -1

    def _accept(self, connection: socket.socket) -> None:
        """Accept a client if fewer than `CONNECTIONS` exist or one can be replaced; else close it."""
        if len(self._clients) >= CONNECTIONS:
            late = time.monotonic() - GREETING
            mute = (fd for fd, one in self._clients.items() if not self._peers.is_known(fd))
            idle = next((fd for fd in mute if self._clients[fd].since < late), None)
            if idle is None:
                connection.close()
                return
            self._dismiss(idle)
        client = self._clients[connection.fileno()] = TcpConnection(self.name)
        client.adopt(connection)

    def _dismiss(self, fd: int) -> None:
        self._clients.pop(fd).close()
        self._peers.forget(fd)


class UdpPort(Port):
    """Port of ``udpout``, which sends to one address, or of ``udpin``, which sends to accepted `peers`."""

    def __init__(self, name: str, address: tuple[str, int], peers: Peers | None = None) -> None:
        super().__init__(name, peers)
        self._address = address
        self._socket: socket.socket | None = None

    def _open(self) -> int:
        """Bind the socket of ``udpin``, or connect the socket of ``udpout``."""
        listen = self._peers is not None
        family, address = resolve(self._address, socket.SOCK_DGRAM, listen=listen)
        opened = socket.socket(family, socket.SOCK_DGRAM)
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        try:
            (opened.bind if listen else opened.connect)(address)
        except OSError:
            opened.close()
            raise
        self._socket = opened
        return opened.fileno()

    def _receive(self) -> list[tuple[Any, bytes]]:
        """Return the received datagrams, each with its sender; an unreachable peer is not an error.

        All waiting datagrams are returned at once. So samples that queued up during a stall of the bridge get
        the telemetry that queued up with them.
        """
        assert self._socket is not None
        datagrams: list[tuple[Any, bytes]] = []
        size = 0
        while size < READ_BYTES and len(datagrams) < DATAGRAMS:
            try:
                datagram, address = self._socket.recvfrom(READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if datagrams or error.errno in NO_LISTENER_ERRORS:
                    break  # first return the received bytes
                raise self.lost(error.strerror) from error
            size += len(datagram)
            datagrams.append((address, datagram))
        return datagrams

    def _send(self, data: bytes, address: Any) -> None:
        """Send `data` as one or more datagrams; drop and count datagrams that cannot be sent."""
        assert self._socket is not None
        for datagram in _datagrams(data):
            try:
                if address is None:
                    self._socket.send(datagram)
                else:
                    self._socket.sendto(datagram, address)
            except BlockingIOError:
                self.overran(datagram)
            except OSError as error:
                self.dropped += len(datagram)
                if self._peers is not None:  # a peer with an invalid address, such as port 0, is not a fault
                    self._peers.forget(address)
                elif error.errno not in NO_LISTENER_ERRORS:
                    raise self.lost(error.strerror) from error

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._fd = None, -1


def _datagrams(data: bytes) -> Iterator[bytes]:
    """Yield `data` in datagrams of whole messages, each at most `DATAGRAM` bytes."""
    if len(data) <= DATAGRAM:
        yield data
        return
    begun = b""
    for frame in cut(data):
        if len(begun) + len(frame) > DATAGRAM:
            yield begun
            begun = b""
        begun += frame
    yield begun


LINKS = ("udpin", "udpout", "tcp", "tcpin")
"""Kinds of link, the first part of the URL; ``udpin`` and ``tcpin`` have any number of peers."""


def open_link(
    url: str,
    baudrate: int,
    source: str = "bridge.toml",
    key: str = "link.url",
    *,
    autopilot: tuple[int, int] | None = None,
    budget: float = inf,
    signed: bool = False,
) -> Port:
    """Return the (unopened) port for a MAVLink URL.

    `url`: URL as in ``[link]``; a URL of no kind in `LINKS` is a serial device.
    `baudrate`: baud rate of a serial device, bit/s.
    `source`, `key`: file and key that contain `url`, for errors.
    `autopilot`: system and component of the peer to which a link with many peers sends first.
    `budget`: bytes/s that a link with many peers sends to all peers other than the autopilot.
    `signed`: True to send only to peers that have sent a signed frame, according to :meth:`Port.credit`.
    ConfigError: the kind of link or of serial URL is unknown, the name cannot be a device's, or the address
        is not HOST:PORT.
    """
    kind, colon, address = url.partition(":")
    if kind not in LINKS:
        named = kind == "serial" or address.startswith("//")
        if not named and ((colon and kind.isalnum()) or not may_be_device(url)):
            known = ", ".join(LINKS)
            raise ConfigError(source, key, f"expected {known} or a serial device, got {url!r}")
        return serial_line(url.removeprefix("serial:"), baudrate, source, key)
    try:
        host, port = parse_address(address)
        if not port and kind in ("udpout", "tcp"):  # as a local port, 0 is any that is free
            raise ValueError(url)  # noqa: TRY301 - as `parse_address` does
    except ValueError as error:
        raise ConfigError(source, key, f"expected HOST:PORT or [IPV6]:PORT, got {address!r}") from error
    peers = Peers(autopilot, budget=budget, signed=signed) if kind.endswith("in") else None
    if kind.startswith("udp"):
        return UdpPort(url, (host, port), peers)
    if peers is not None:
        return TcpServer(url, (host, port), peers, signed=signed)
    return TcpConnection(url, (host, port))


def nmea_port(config: Config) -> Port | None:
    """Return the (unopened) port of ``[heading] nmea``; None if it is not configured.

    ConfigError: the name is neither ``udp:HOST:PORT`` nor a serial device.
    """
    name = config.heading.nmea
    if name is None:
        return None
    url = f"udpout:{name.removeprefix('udp:')}" if name.startswith("udp:") else f"serial:{name}"
    return open_link(url, config.heading.nmea_baudrate, str(config.path), "heading.nmea")
