"""A running bridge on a network that is not friendly: attacks of tools/attacks.py, and one siege."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from attacks import ALLOWED, ATTACKS, Attack, run
from checks import replays
from rig import Rig

from magbridge.mavlink import Codec

KEY = bytes(range(1, 33))
SECRET = bytes(range(101, 133))
MakeRig = Callable[..., Rig]
SIEGE = [one for one in ATTACKS if one.reported or "garbage" in one.name or "half a frame" in one.name]
"""Attacks that the bridge reports, and two floods; tools/attacks.py has them all."""


def test_a_signed_bridge_that_anyone_can_reach(make_rig: MakeRig) -> None:
    """Restarted in haste, between strangers' headers, asked for too much, and told a key."""
    rig = make_rig("udpin", key=KEY)
    rig.start()
    for _ in range(3):
        assert rig.stop() == 0
        for path in rig.logs:
            path.unlink()
        rig.received.clear()
        rig.restart()
    rig.fresh_status()
    rig.received.clear()  # what the last bridge but one said may have come only now
    before, mark = rig.fresh_status(), rig.mark
    with ExitStack() as stack:
        strangers = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(40)]
        header = bytes((0xFD, 60, 0, 0, 7, 9, 9, 0xF0, 0xE0, 0))
        beat = Codec(255, 190).pack("HEARTBEAT", type=6)

        def shout(frame: bytes) -> list[bytes]:
            for one in strangers:
                one.sendto(header, rig.autopilot.address)
                one.sendto(beat, rig.autopilot.address)
            return [frame]

        with rig.autopilot.retelling(shout):
            rig.run(1.5)
        assert not select.select(strangers, [], [], 0)[0]
    rig.autopilot.send_message("SETUP_SIGNING", target_system=1, target_component=191, secret_key=SECRET)
    rig.until_reported("key from 1:1 not taken: keys come from a file", mark)
    after = rig.fresh_status()
    assert after["link_frames_lost"] - before["link_frames_lost"] <= 1  # that one
    assert after["link_refused"] - before["link_refused"] >= 40 * 20
    assert rig.undue_flags(mark) == ""
    assert not any("old time stamp" in text for text in rig.texts())
    replays(rig)
    assert not any(SECRET[:6] in path.read_bytes() for path in rig.logs)


@pytest.fixture(scope="module")
def besieged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Rig]]:
    """Return the bridge that is reached by a link; one for all attacks on it."""
    rigs: dict[str, Rig] = {}

    def reached_by(link: str) -> Rig:
        if link not in rigs:
            folder: Path = tmp_path_factory.mktemp("rig")
            kind = "udpin" if link == "signed" else link.partition(",")[0]
            rigs[link] = Rig(folder, kind, key=KEY if link == "signed" else None)
            rigs[link].start()
        return rigs[link]

    yield reached_by
    for rig in rigs.values():
        rig.close()
        rig.fluxgate.unplug()


@pytest.mark.parametrize("attack", SIEGE, ids=lambda one: one.name)
def test_an_attack_costs_the_autopilot_nothing_or_is_reported(
    besieged: Callable[[str], Rig], attack: Attack
) -> None:
    rig = besieged(attack.link)
    lost, out, _, reported = run(rig, attack, 0.3)
    assert max(lost, out) <= ALLOWED or reported
    assert any(attack.reported in text for text in rig.texts()), "each once while it lasts"
