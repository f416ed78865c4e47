"""A link by UDP."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from magbridge.bridge.address import resolve
from magbridge.bridge.port import CHUNK, Port
from magbridge.bridge.stream import cut
from magbridge.errors import PortError

__all__ = ["UdpPort"]

PEER_TIMEOUT = 30.0
"""s without a packet after which a UDP peer is forgotten, or connected anew."""
PEERS = 16
"""Stations that ``udpin`` answers; of more, those heard last."""
DATAGRAM = 1400
"""Bytes that a packet carries on any usual network: more is split on the way, and 64 kB are refused."""
AWAY = (errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EPERM)
"""What a UDP socket reports when nobody listens (yet): no fault of the port."""


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
        family, address = resolve(self._address, socket.SOCK_DGRAM, listen=self._listen)
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
        """Send to each peer, mostly one datagram; what cannot be sent is dropped and counted."""
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
            if error.errno not in AWAY:
                raise self.lost(error.strerror) from error
            self.dropped += len(data)

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
