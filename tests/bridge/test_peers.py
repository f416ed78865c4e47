"""Test a link with many peers: which peers get replies, and that none blocks the frames of another."""

import os
import select
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from math import inf
from typing import Any

import pytest

from magbridge.bridge.links import CONNECTIONS, open_link
from magbridge.bridge.port import MAX_PARSED_PEERS, MAX_RECEIVERS, PEER_READ_BYTES, Peers, Port
from magbridge.mavlink import Codec

PILOT = (1, 1)


def beat(component: int = 1, system: int = 1) -> bytes:
    return Codec(system, component).pack("HEARTBEAT", type=12)


def header(size: int) -> bytes:
    """Return the header of an unknown message, after which a waiting parser loses `size` bytes."""
    return bytes((0xFD, size, 0, 0, 7, 9, 9, 0xF0, 0xE0, 0))


@contextmanager
def opened(kind: str, *, budget: float = inf, signed: bool = False) -> Iterator[tuple[Port, Any]]:
    port = open_link(f"{kind}:127.0.0.1:0", 0, autopilot=PILOT, budget=budget, signed=signed)
    port.open()
    with socket.socket(fileno=os.dup(port.fds()[0])) as own:
        place = own.getsockname()
    with closing(port):
        yield port, place


def receive(port: Port, size: int) -> bytes:
    data = b""
    while len(data) < size:
        assert select.select(port.fds(), [], [], 2.0)[0], data
        data += port.read()
    return data


def answered(everyone: list[socket.socket], port: Port) -> list[int]:
    """Return the indices of the peers that receive a reply of the port."""
    port.write(b"field")
    time.sleep(0.02)
    return [k for k, one in enumerate(everyone) if select.select([one], [], [], 0)[0] and one.recv(9)]


def udp(stack: ExitStack, count: int) -> list[socket.socket]:
    return [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]


def test_a_header_swallows_nothing_of_another_peer() -> None:
    bridge, received = Codec(1, 191), []
    with opened("udpin") as (port, place), ExitStack() as stack:
        autopilot, wrong_device = udp(stack, 2)
        for k in range(30):
            wrong_device.sendto(header(20 + k), place)
            autopilot.sendto(beat(), place)
            while select.select(port.fds(), [], [], 0.02)[0]:
                received += bridge.parse(port.read(), final=True)
    assert [one.name for one in received].count("HEARTBEAT") == 30


def test_frames_come_first_and_a_frame_in_pieces_is_whole() -> None:
    """So a parser can distinguish a frame from other data without further bytes."""
    both = Peers()
    noise, frame = b"noise" + header(30) + bytes(9), beat()
    for who, data in ((1, frame[:7]), (2, noise), (1, frame[7:]), (2, bytes(5000)), (3, frame)):
        both.receive(who, data)
    data = both.drain()
    assert data.startswith(frame * 2)
    assert len(data) == 2 * len(frame) + 4096
    messages = Codec(1, 191).parse(data, final=True)
    assert [one.name for one in messages[:2]] == ["HEARTBEAT"] * 2
    assert b"".join(one.frame for one in messages) == data
    assert both.drain() == b""


@pytest.mark.parametrize("word", [b"", b"x", b"\xfd", beat()[:-1], beat()[:-1] + b"\0", header(1) + bytes(3)])
def test_who_says_nothing_valid_is_not_answered(word: bytes) -> None:
    with opened("udpin") as (port, place), ExitStack() as stack:
        (wrong_device,) = udp(stack, 1)
        wrong_device.sendto(word, place)
        assert select.select(port.fds(), [], [], 1)[0]
        port.read()
        assert answered([wrong_device], port) == []


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_where_we_sign_only_a_signature_is_answered(kind: str) -> None:
    with opened(kind, signed=True) as (port, place), ExitStack() as stack:
        if kind == "udpin":
            everyone = udp(stack, 2)
            for one in everyone:
                one.connect(place)
        else:
            everyone = [stack.enter_context(socket.create_connection(place)) for _ in range(2)]
        for k, one in enumerate(everyone):
            one.send(beat(1 + k))
        receive(port, 2 * len(beat()))
        assert answered(everyone, port) == []
        everyone[0].send(beat(1))
        receive(port, len(beat()))
        port.credit([beat(1)])
        assert answered(everyone, port) == [0]


@pytest.mark.parametrize("first", [True, False])
def test_strangers_never_take_the_autopilot_s_place(first: bool) -> None:
    with opened("udpin") as (port, place), ExitStack() as stack:
        autopilot, *strangers = udp(stack, 41)
        everyone = [autopilot, *strangers]
        for one in everyone if first else reversed(everyone):
            one.sendto(beat(1 if one is autopilot else 99), place)
        receive(port, 41 * len(beat()))
        reached = answered(everyone, port)
        assert len(reached) == MAX_RECEIVERS
        assert 0 in reached
        assert port.notice() == f"more than {MAX_RECEIVERS} peers: the others are not answered"
        assert port.notice() == ""


@pytest.mark.parametrize("signed", [False, True])
def test_many_strangers_at_once_silence_no_station(monkeypatch: pytest.MonkeyPatch, signed: bool) -> None:
    """A station sends a heartbeat each second; 100 other sources send heartbeats between two of them."""
    now = [1000.0]
    monkeypatch.setattr("magbridge.bridge.port.time.monotonic", lambda: now[0])
    both = Peers(PILOT, signed=signed)
    for _ in range(3):
        both.receive("station", beat(190, 255))
        for k in range(100):
            both.receive(k, beat(190, 2 + k))
        both.drain()
        both.credit([beat(190, 255)])
        now[0] += 0.5
        assert both.receivers()[0].address == "station"
        assert both.route((255, 190)) is both.receivers()[0]
        assert len(both.receivers()) == (1 if signed else MAX_RECEIVERS)
        now[0] += 0.5


def test_two_senders_as_the_autopilot_are_reported() -> None:
    both = Peers(PILOT)
    for who in "ab":
        both.receive(who, beat())
    assert [one.address for one in both.receivers()] == ["a", "b"]
    assert list(both.notices) == ["the autopilot sends from several addresses"]


def test_a_peer_that_falls_silent_is_no_longer_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("magbridge.bridge.port.time.monotonic", lambda: now[0])
    both = Peers(PILOT)
    both.receive("station", beat(190, 255))
    assert [one.address for one in both.receivers()] == ["station"]
    now[0] += 31.0
    assert both.receivers() == []
    assert not both.is_known("station")


def test_a_flood_costs_its_sender_not_the_autopilot() -> None:
    both = Peers(PILOT)
    both.receive("autopilot", beat())
    both.drain()
    for k in range(10 * MAX_PARSED_PEERS):
        both.receive(k, beat(99)[:-1] + b"?" + bytes(1000))
    for _ in range(100):
        both.receive("station", beat(190, 255) * 20)
    for _ in range(1000):
        both.receive("autopilot", beat())
    data = both.drain()
    assert len(data) < 50_000, "not all of 650 kB of garbage"
    frames = [one for one in Codec(1, 191).parse(data, final=True) if one.known]
    assert sum(one.component == 1 for one in frames) == 1000
    assert sum(one.component == 190 for one in frames) <= PEER_READ_BYTES / len(beat())


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_others_share_a_budget_and_the_autopilot_has_none(kind: str) -> None:
    """A peer that only listens by TCP shares the budget; file transfers count as well."""
    with opened(kind, budget=2000.0) as (port, place), ExitStack() as stack:
        make = socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM
        everyone = [stack.enter_context(socket.socket(socket.AF_INET, make)) for _ in range(3)]
        for one in everyone:
            one.connect(place)
        for k, one in enumerate(everyone[: 2 if kind == "tcpin" else 3]):
            one.send(beat(1 + k))
        receive(port, (2 if kind == "tcpin" else 3) * len(beat()))
        while select.select(port.fds(), [], [], 0.05)[0]:
            port.read()  # accepts the last one
        begun = time.monotonic()
        for _ in range(20):
            port.write(bytes(500))
        port.write_to((1, 2), bytes(500))
        time.sleep(0.05)
        got = [0, 0, 0]
        for k, one in enumerate(everyone):
            while select.select([one], [], [], 0)[0]:
                got[k] += len(one.recv(65536))
        allowed = 2000.0 * (1.0 + time.monotonic() - begun)
        assert got[0] == 20 * 500
        assert 2000 <= got[1] + got[2] <= allowed
        assert port.notice() == "others get 2 kB/s in all: link.max_other_peers_rate"
        assert port.notice() == ""
        time.sleep(1.0)
        assert answered(everyone, port) == [0, 1, 2]


def test_connections_never_turn_the_autopilot_out() -> None:
    with opened("tcpin") as (port, place), ExitStack() as stack:
        autopilot = stack.enter_context(socket.create_connection(place))
        autopilot.sendall(beat())
        assert receive(port, len(beat())) == beat()
        for _ in range(200):
            stack.enter_context(socket.create_connection(place))
            port.read()
        assert len(port.fds()) <= CONNECTIONS + 1
        autopilot.sendall(beat())
        assert receive(port, len(beat())) == beat()
        port.write(b"field")
        assert autopilot.recv(9) == b"field"


def test_a_client_that_only_listens_gives_way_to_one_that_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("magbridge.bridge.links.GREETING", 0.0)
    with opened("tcpin") as (port, place), ExitStack() as stack:
        mute = [stack.enter_context(socket.create_connection(place)) for _ in range(CONNECTIONS)]
        for _ in mute:
            port.read()
        assert len(answered(mute, port)) == CONNECTIONS
        late = stack.enter_context(socket.create_connection(place))
        late.sendall(beat())
        assert receive(port, len(beat())) == beat()
        assert mute[0].recv(9) == b""
