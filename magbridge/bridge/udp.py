"""A link by UDP."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any

from magbridge.bridge.address import resolve
from magbridge.bridge.peers import Peers
from magbridge.bridge.port import CHUNK, Port
from magbridge.bridge.stream import cut
from magbridge.errors import PortError

__all__ = ["UdpPort"]

PEER_TIMEOUT = 30.0
"""s without a packet after which the peer of ``udpout`` is connected again."""
DATAGRAM = 1400
"""Bytes that a packet carries on any usual network: more is split on the way, and 64 kB are refused."""
DATAGRAMS = 512
"""Most that are read before the sensor's turn: empty ones could keep it waiting for ever."""
AWAY = (errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EPERM)
"""What a UDP socket reports when no program listens (yet): not a fault of the port."""


class UdpPort(Port):
    """``udpout`` sends to one address; ``udpin``, given its `peers`, answers those of them that are valid."""

    def __init__(self, name: str, address: tuple[str, int], peers: Peers | None = None) -> None:
        super().__init__(name)
        self._address, self._peers = address, peers
        self._socket: socket.socket | None = None
        self._received = 0.0

    @property
    def is_open(self) -> bool:
        """Whether the socket is open."""
        return self._socket is not None

    def open(self) -> None:
        """Bind or connect; raises :class:`PortError`."""
        try:
            opened = self._new()
        except OSError as error:
            raise PortError(self.name, error.strerror or str(error)) from error
        self._socket, self._received = opened, time.monotonic()

    def tend(self) -> None:
        """Connect again if nothing has come for long, and the host, or we, have another address by now."""
        opened, now = self._socket, time.monotonic()
        if opened is None or self._peers is not None or now - self._received < PEER_TIMEOUT:
            return
        self._received = now
        with suppress(OSError), self._new() as new:  # not known at present, or closed meanwhile
            if _ends(new) != _ends(opened):
                # the same descriptor, because the bridge may be waiting for it
                os.dup2(new.fileno(), opened.fileno(), inheritable=False)

    def _new(self) -> socket.socket:
        """Return a socket that is bound or connected; raises OSError."""
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
        datagrams: list[bytes] = []
        size = 0
        while size < CHUNK and len(datagrams) < DATAGRAMS:
            try:
                datagram, peer = self._socket.recvfrom(CHUNK)
            except BlockingIOError:
                break
            except OSError as error:
                if datagrams or error.errno in AWAY:
                    break  # first return what has come
                raise self.lost(error.strerror) from error
            size += len(datagram)
            datagrams.append(datagram)
            if self._peers is not None:
                self._peers.receive(peer, datagram)
        if datagrams:
            self._received = time.monotonic()
        return b"".join(datagrams) if self._peers is None else self._peers.drain()

    def credit(self, frames: Iterable[bytes]) -> None:
        """Answer, from now on, who sent these frames."""
        if self._peers is not None:
            self._peers.credit(frames)

    def notice(self) -> str:
        """Return something to tell about the peers, once."""
        return self._peers.notices.popleft() if self._peers is not None and self._peers.notices else ""

    def write(self, data: bytes) -> None:
        """Send to each peer, mostly one datagram; what cannot be sent is dropped and counted."""
        if self._peers is None:
            self._send(data, None)
            return
        for peer in self._peers.answered():
            if self._peers.affords(peer, len(data)):
                self._send(data, peer.address)

    def write_to(self, sender: tuple[int, int], data: bytes) -> None:
        """Send only to the peer from which a system and component was last heard."""
        if self._peers is None:
            self._send(data, None)
        elif (peer := self._peers.route(sender)) is not None and self._peers.affords(peer, len(data)):
            self._send(data, peer.address)

    def _send(self, data: bytes, peer: Any) -> None:
        for datagram in _datagrams(data):
            self._send_one(datagram, peer)

    def _send_one(self, data: bytes, peer: Any) -> None:
        assert self._socket is not None
        try:
            if peer is None:
                self._socket.send(data)
            else:
                self._socket.sendto(data, peer)
        except BlockingIOError:
            self.overran(data)
        except OSError as error:
            self.dropped += len(data)
            if self._peers is not None:  # an address that cannot be sent to, as one with port 0, is no fault
                self._peers.forget(peer)
            elif error.errno not in AWAY:
                raise self.lost(error.strerror) from error

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def _datagrams(data: bytes) -> Iterator[bytes]:
    """Yield `data` in datagrams of whole messages: after a standstill, thousands are sent at once."""
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


def _ends(connected: socket.socket) -> tuple[Any, Any]:
    """Return our own address, without its port, and the peer's."""
    return connected.getsockname()[0], connected.getpeername()
