"""Signatures: both ways with pymavlink, and the forged packet from the future."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from magbridge.errors import ConfigError
from magbridge.mavlink import REFUSED, Codec, Signing, load_key
from magbridge.mavlink.signing import timestamp

KEY = bytes(range(32))
NOW = 1_700_000_000_000_000


def codec(key: bytes = KEY, now: int = NOW, component: int = 191) -> Codec:
    one = Codec(1, component, Signing(key))
    one.now_us = now
    return one


def signing(one: Codec) -> Signing:
    assert one.signing is not None
    return one.signing


def text(one: Codec) -> bytes:
    return one.pack("STATUSTEXT", severity=6, text="hello")


def station(peer: ModuleType, now: int = NOW) -> Any:
    mav = peer.MAVLink(None, 255, 190)
    mav.robust_parsing = True
    mav.signing.secret_key = KEY
    mav.signing.sign_outgoing = True
    mav.signing.link_id = 3
    mav.signing.timestamp = timestamp(now)
    return mav


def test_pymavlink_accepts_ours_and_we_accept_its(peer: ModuleType) -> None:
    ours, theirs = codec(), station(peer)
    (message,) = theirs.parse_buffer(text(ours))
    assert message.get_signed()
    frame = peer.MAVLink_param_request_list_message(1, 191).pack(theirs)
    assert [m.name for m in ours.parse(frame)] == ["PARAM_REQUEST_LIST"]
    assert signing(ours).refused == 0


def test_unsigned_wrongly_signed_and_old_packets_are_refused() -> None:
    listener = codec()
    good = text(codec(component=1))
    assert listener.parse(good)[0].name == "STATUSTEXT"
    for frame in (good, text(codec(key=KEY[::-1])), text(Codec(1, 1)), text(codec(now=NOW - 90_000_000))):
        (refused,) = listener.parse(frame)
        assert refused.id == REFUSED
        assert refused.frame == frame
        assert refused.fields == {}
    assert signing(listener).refused == 4
    assert listener.frames == 1


def test_radio_status_needs_no_signature() -> None:
    (message,) = codec().parse(Codec(51, 68).pack("RADIO_STATUS", rssi=80))
    assert message["rssi"] == 80


@pytest.mark.parametrize("before", [True, False])
def test_a_forged_packet_from_the_future_locks_nobody_out(before: bool) -> None:
    listener, speaker = codec(), codec(component=1)
    if before:
        assert listener.parse(text(speaker))[0].known
    forger = codec(key=bytes(32), now=NOW + 10**15, component=1)
    assert listener.parse(text(forger))[0].id == REFUSED
    for _ in range(3):
        speaker.now_us += 1_000_000
        assert listener.parse(text(speaker))[0].known
    assert signing(listener).last < timestamp(NOW + 10**9)


def test_stamps_increase_even_when_the_clock_goes_back() -> None:
    one = codec()
    listener = codec()
    for now in (NOW, NOW, NOW - 10**9, NOW + 5):
        one.now_us = now
        assert listener.parse(text(one))[0].known
    resumed = Codec(1, 191, Signing(KEY, last=signing(one).last))
    assert listener.parse(text(resumed))[0].known


def test_same_events_same_bytes() -> None:
    assert [text(codec()) for _ in range(2)] == [text(codec())] * 2


def test_key_file(tmp_path: Path) -> None:
    path = tmp_path / "key.bin"
    with pytest.raises(ConfigError, match="No such file"):
        load_key(path)
    path.write_bytes(b"short")
    with pytest.raises(ConfigError, match="32 bytes, not 5"):
        load_key(path)
    path.write_bytes(KEY)
    assert load_key(path) == KEY


def test_signatures_follow_the_host_s_clock(peer: ModuleType) -> None:
    """A computer without a clock of its own wakes up in 1970, until it hears the time."""
    ours, theirs = codec(now=5_000_000), station(peer)
    (refused,) = theirs.parse_buffer(text(codec(now=5_000_000)))
    assert refused.get_type() == "BAD_DATA"
    ours.utc_offset_us = NOW - ours.now_us
    (message,) = theirs.parse_buffer(text(ours))
    assert message.get_signed()
    stranger = peer.MAVLink_param_request_list_message(1, 191).pack(station(peer, NOW - 90_000_000))
    assert [m.id for m in ours.parse(stranger)] == [REFUSED]
