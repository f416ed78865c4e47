"""Rates, timers and announcements in event time."""

from __future__ import annotations

import random
from collections.abc import Iterable
from types import ModuleType
from typing import Any

import pytest

from magbridge.link.output import FOREVER, Announcer, Outbox, Rate, Timers
from magbridge.mavlink import Codec

START = 1_700_000_000_000_000


def passed(rate: Rate, times: Iterable[int]) -> list[int]:
    return [t for t in times if rate.due(t)]


def test_a_jittering_stream_at_just_the_rate_passes_whole() -> None:
    rng = random.Random(2)
    times = [START + 100_000 * i + rng.randrange(-20_000, 20_000) for i in range(1000)]
    assert len(passed(Rate(10), times)) == pytest.approx(1000, abs=2)


def test_timers_fire_in_order_at_their_own_times() -> None:
    timers = Timers()
    fired: list[tuple[str, int]] = []
    begun: list[int] = []
    timers.every("a", 300, lambda t: fired.append(("a", t)), 0)
    timers.every("b", 500, lambda t: fired.append(("b", t)), 100)
    timers.run_once("c", 600, lambda t: timers.run_once("d", t + 1, lambda t: fired.append(("d", t))))
    timers.advance(1000, begun.append)
    assert fired == [("a", 0), ("b", 100), ("a", 300), ("a", 600), ("b", 600), ("d", 601), ("a", 900)]
    assert begun == [0, 100, 300, 600, 600, 600, 601, 900]
    assert timers.next_deadline == 1100
    for name in ("a", "b", "never"):
        timers.cancel(name)
    assert timers.next_deadline == FOREVER


class Talker:
    def __init__(self, peer: ModuleType) -> None:
        self.codec = Codec(1, 191)
        self.outbox, self.timers = Outbox(self.codec), Timers()
        self.announcer = Announcer(self.outbox, self.timers)
        self.station = peer.MAVLink(None)
        self.codec.now_us = START

    def at(self, seconds: float) -> list[Any]:
        def begin(t: int) -> None:
            self.codec.now_us = t

        self.timers.advance(START + round(seconds * 1e6), begin)
        begin(START + round(seconds * 1e6))
        return [m for _, frame in self.outbox.drain() for m in self.station.parse_buffer(frame)]


@pytest.fixture
def talker(peer: ModuleType) -> Talker:
    return Talker(peer)


def test_short_text(talker: Talker) -> None:
    talker.announcer.send_statustext("sensor found")
    (message,) = talker.at(0)
    assert (message.text, message.id, message.severity) == ("sensor found", 0, 6)


@pytest.mark.parametrize("length", [50, 51, 99, 100, 150, 151])
def test_long_text_in_pieces(talker: Talker, length: int) -> None:
    text = "".join(chr(97 + i % 26) for i in range(length))
    for _ in range(2):
        talker.announcer.send_statustext(text)
        messages = talker.at(0)
        assert "".join(message.text for message in messages) == text
        if length > 50:
            assert len({message.id for message in messages}) == 1
            assert messages[0].id > 0
            assert [message.chunk_seq for message in messages] == list(range(len(messages)))
            assert len(messages[-1].text) < 50  # else the receiver waits for more
    talker.announcer.send_statustext("5 µT")
    assert talker.at(0)[0].text == "5 ?T"


def test_only_changes_are_reported(talker: Talker) -> None:
    for second, state in enumerate(("ok", "ok", "lost", "lost", "ok")):
        talker.at(second * 2)
        talker.announcer.state("sensor", state)
        talker.announcer.state("log", "ok")
    assert [m.text for m in talker.at(20)] == ["ok"]


def test_a_flapping_text_is_sent_once_a_second_and_its_last_state_always(talker: Talker) -> None:
    texts = []
    for i in range(201):  # 100 Hz for 2 s, ends on "up"
        texts += talker.at(i / 100)
        talker.announcer.state("link", "up" if i % 2 == 0 else "down")
    texts += talker.at(10)
    assert 2 <= len(texts) <= 4
    assert texts[-1].text == "up"
