"""Test a running bridge under the attacks of tools/attacks.py and under one combined attack."""

import select
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from attacks import ALLOWED, ATTACKS, Attack, run
from checks import replays
from fed import FedBridge, named
from fuzz import events, feed, make_bridge
from rig import Rig
from small import small_bridge

from magbridge.bridge.run import FileServer
from magbridge.correction import Correction
from magbridge.mavlink import Codec, Message
from magbridge.parts import OptionalParts
from magbridge.records import Channel

KEY = bytes(range(1, 33))
SECRET = bytes(range(101, 133))
MakeRig = Callable[..., Rig]
SIEGE = [one for one in ATTACKS if one.reported or "garbage" in one.name or "half a frame" in one.name]
"""Attacks that the bridge reports, and two floods; tools/attacks.py has them all."""


def test_a_signed_bridge_that_anyone_can_reach(make_rig: MakeRig) -> None:
    """Restart it quickly among strangers' headers, flood it with requests, and send it a key."""
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
    """Return the bridge on a kind of link; all attacks on this link share the bridge."""
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


# ---- Valid frames and lines with extreme values end neither the bridge nor, unnoticed, a part of it ------


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_extreme_values_raise_nothing(seed: int, tmp_path: Path) -> None:
    bridge = make_bridge(tmp_path, seed)
    files = FileServer(bridge.component.metadata, tmp_path, lambda: 1e9, lambda _: None)
    for event in events(4000, seed):
        feed(bridge, files, event)
    files.close()
    parameters = bridge.component.parameters
    assert all(row.low <= parameters[name] <= row.high * 1.0001 for name, row in parameters.table.items())
    assert bridge.streams[0].samples > 500
    assert bridge.navigation is not None
    assert bridge.navigation.navigator.estimate.begun


def global_position(component: int = 1, **fields: int) -> bytes:
    return Codec(1, component).pack("GLOBAL_POSITION_INT", **fields)


def sent(bridge: FedBridge, second: int) -> list[Message]:
    return bridge.feed(second, Channel.SENSOR, b"1000 2000 50000 4 %d %d\n" % (second, second))


@pytest.mark.parametrize(
    ("component", "lat", "lon", "reported"),
    [
        (25, 505_000_000, -579_000_000, "position of component 25 ignored"),
        (1, 0x7FFFFFFF, 0x7FFFFFFF, "GLOBAL_POSITION_INT with impossible values ignored"),
        (1, 495_000_000, -1_900_000_000, "GLOBAL_POSITION_INT with impossible values ignored"),
    ],
)
def test_a_position_of_another_component_or_of_no_place_is_ignored_and_reported(
    tmp_path: Path, component: int, lat: int, lon: int, reported: str
) -> None:
    bridge = FedBridge(small_bridge(tmp_path))
    bridge.feed(0.0, Channel.LINK, global_position(lat=495_000_000, lon=-579_000_000))
    (before,) = named(sent(bridge, 1), "MAG_FIELD")
    bridge.feed(1.0, Channel.LINK, global_position(component, lat=lat, lon=lon))
    (after,) = named(sent(bridge, 2), "MAG_FIELD")
    assert after["anomaly"] == pytest.approx(before["anomaly"], abs=0.1)
    assert reported in bridge.texts


def test_a_part_that_raises_is_switched_off_and_the_sample_is_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge = FedBridge(small_bridge(tmp_path))
    monkeypatch.setattr(OptionalParts, "propagate", False)

    def fail(*_: object, **__: object) -> float:
        raise ZeroDivisionError("made for this test")

    correction = bridge.bridge.streams[0].correction
    assert isinstance(correction, Correction)
    assert correction.health is not None
    monkeypatch.setattr(correction.health, "check", fail)
    for second in (1, 2, 3):
        assert len(named(sent(bridge, second), "MAG_FIELD")) == 1
    expected = "plausibility check is off after an internal error: ZeroDivisionError: made for this test"
    assert "".join(bridge.texts).count(expected) == 1
    assert list(correction.parts.failures) == ["plausibility check"]
