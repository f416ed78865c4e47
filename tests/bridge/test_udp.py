"""A link by UDP: a peer that is not there, one that moves, and datagrams that waited."""

from __future__ import annotations

import select
import socket
import time
from typing import Any

import pytest

from magbridge.bridge.links import open_link
from magbridge.mavlink import Codec


def test_a_udp_peer_that_is_not_there_is_no_fault() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        port = open_link(f"udpout:127.0.0.1:{gone.getsockname()[1]}", 0)
    port.open()
    for _ in range(20):
        port.write(b"x")
    assert port.dropped > 0
    assert port.read() == b""
    assert port.is_open
    port.close()


def test_a_named_host_that_gets_another_address_is_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """While it is heard it is not looked up; the silence counts from the last packet, or the last look."""
    host, look_up, looks = ["127.0.0.1"], socket.getaddrinfo, []

    def resolver(name: str, *rest: Any, **options: Any) -> object:
        looks.append(name)
        return look_up(host[0], *rest, **options)

    monkeypatch.setattr(socket, "getaddrinfo", resolver)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as before,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as after,
    ):
        before.bind((host[0], 0))
        after.bind(("127.0.0.2", before.getsockname()[1]))
        for one in (before, after):
            one.settimeout(1.0)
        port = open_link(f"udpout:topside.local:{before.getsockname()[1]}", 0)
        port.open()
        port.write(b"1")
        _, peer = before.recvfrom(9)
        host[0] = "127.0.0.2"
        monkeypatch.setattr("magbridge.bridge.links.PEER_TIMEOUT", 0.3)
        for _ in range(4):
            time.sleep(0.1)
            before.sendto(b"here", peer)
            assert select.select(port.fds(), [], [], 1.0)[0]
            assert port.read() == b"here"
            port.tend()
        assert len(looks) == 1
        came_from = set()
        for message in (b"2", b"3"):  # the second time, nothing has changed
            time.sleep(0.3)
            port.tend()
            port.write(message)
            received, sender = after.recvfrom(9)
            assert received == message
            came_from.add(sender)
        assert len(looks) == 3
        assert len(came_from) == 1
        after.sendto(b"there", sender)
        assert select.select(port.fds(), [], [], 1.0)[0]
        assert port.read() == b"there"
        port.close()
        port.tend()  # as the thread that opens it may, just then


def test_what_is_sent_at_once_after_a_standstill_goes_in_datagrams_that_a_network_takes() -> None:
    codec, data = Codec(1, 191), b""
    while len(data) < 100_000:
        data += codec.pack("MAG_FIELD", total_field=5e4, latency=1.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        port = open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}", 0)
        port.open()
        port.write(data)
        datagrams: list[bytes] = []
        while sum(map(len, datagrams)) < len(data):
            datagrams.append(peer.recv(1 << 16))
        assert (port.is_open, port.dropped) == (True, 0)
        port.close()
    assert b"".join(datagrams) == data
    assert max(map(len, datagrams)) <= 1400
    assert all(datagram[0] == 0xFD for datagram in datagrams)


def test_datagrams_that_waited_come_at_once() -> None:
    """So a bridge that stood still has the telemetry before it looks at the samples."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        port = open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}", 0)
        port.open()
        port.write(b"hello")
        _, bridge = peer.recvfrom(10)
        for k in range(200):
            peer.sendto(bytes((k,)) * 600, bridge)
        received = [port.read() for _ in range(3)]
        for data in (b"first", b"", b"after an empty one"):
            peer.sendto(data, bridge)
        assert port.read() == b"firstafter an empty one"
        port.close()
    assert [len(data) for data in received] == [66_000, 54_000, 0]
    assert b"".join(received)[::600] == bytes(range(200))
