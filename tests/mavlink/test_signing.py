"""Test signatures in both directions with pymavlink, and a forged frame from the future."""

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magbridge.errors import FormatError
from magbridge.mavlink import (
    REFUSED,
    SECRET,
    Codec,
    FrameLogReader,
    FrameLogWriter,
    Signing,
    load_key,
    readable_by_all,
    spec,
)
from magbridge.mavlink.codec import timestamp

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
def test_a_forged_packet_from_the_future_locks_out_no_peer(before: bool) -> None:
    listener, speaker = codec(), codec(component=1)
    if before:
        assert listener.parse(text(speaker))[0].known
    forger = codec(key=bytes(32), now=NOW + 10**15, component=1)
    assert listener.parse(text(forger))[0].id == REFUSED
    for _ in range(3):
        speaker.now_us += 1_000_000
        assert listener.parse(text(speaker))[0].known
    assert signing(listener).last < timestamp(NOW + 10**9)


def test_key_file_and_who_may_read_it(tmp_path: Path) -> None:
    path = tmp_path / "key.bin"
    with pytest.raises(FormatError, match="there is none"):
        load_key(path)
    path.write_bytes(b"short")
    with pytest.raises(FormatError, match="32 bytes, not 5"):
        load_key(path)
    path.write_bytes(KEY)
    assert load_key(path) == KEY
    for mode, reported in ((0o600, False), (0o640, False), (0o644, True)):
        path.chmod(mode)
        assert readable_by_all(path) is reported


def test_signatures_follow_the_host_s_clock(peer: ModuleType) -> None:
    """The bridge's stamps follow an autopilot that is a day or a month ahead, but not eleven years."""
    ours, theirs = codec(now=5_000_000), station(peer)
    (refused,) = theirs.parse_buffer(text(codec(now=5_000_000)))
    assert refused.get_type() == "BAD_DATA"
    ours.utc_offset_us = NOW - ours.now_us
    (message,) = theirs.parse_buffer(text(ours))
    assert message.get_signed()
    stranger = peer.MAVLink_param_request_list_message(1, 191).pack(station(peer, NOW - 90_000_000))
    assert [m.id for m in ours.parse(stranger)] == [REFUSED]


MINUTE, HOUR, YEAR = 60_000_000, 3_600_000_000, 31_557_600_000_000


def accepts(listener: Codec, speaker: Codec, now: int, ahead: int = 0) -> bool:
    """Return True if a frame that the sender sends now, its clock `ahead` (µs), is accepted."""
    listener.now_us, speaker.now_us = now, now + ahead
    return bool(listener.parse(text(speaker))[0].known)


def restarted(one: Codec, *, clean: bool) -> Codec:
    """Return the receiver after a restart."""
    old = signing(one)
    last = old.last if clean else old.reserved(one.utc_us, 2 * MINUTE // 10)
    new = Codec(one.system, one.component, Signing(KEY, last, old.streams, (1, 1)))
    new.now_us = one.now_us
    return new


@pytest.mark.parametrize("clean", [True, False])
def test_restarts_within_seconds_lock_out_no_peer(clean: bool) -> None:
    """The bridge's own time stamps do not run ahead of the clock from restart to restart."""
    bridge, autopilot = codec(), codec(component=1)
    for k in range(20):
        now = NOW + k * 500_000
        assert accepts(bridge, autopilot, now)
        text(bridge)
        bridge = restarted(bridge, clean=clean)
    assert signing(bridge).last - timestamp(NOW) <= (20 * 100_000 + 12_000_000 if not clean else 1_000_000)


@pytest.mark.parametrize("ours", [True, False])
@pytest.mark.parametrize("step", [-HOUR, HOUR, 10 * YEAR])
def test_a_clock_that_was_wrong_refuses_nothing_once_it_is_right(step: int, ours: bool) -> None:
    bridge, autopilot = codec(), codec(component=1)
    assert accepts(bridge, autopilot, NOW)
    received = []
    for k in range(1, 6):
        now = NOW + k * 1_000_000 + (step if ours else 0)
        received.append(accepts(bridge, autopilot, now, -step if ours else max(step, 0)))
    autopilot = codec(component=1)  # its stamps restart with the right clock
    after = [accepts(restarted(bridge, clean=True), autopilot, NOW + k * 1_000_000) for k in range(7, 12)]
    assert all(received)
    assert all(after)


def test_a_liar_with_the_key_harms_only_its_own_stream() -> None:
    bridge, autopilot, liar = codec(), codec(component=1), codec(component=25)
    assert accepts(bridge, liar, NOW, 10 * YEAR)
    lie = text(liar)
    assert all(accepts(bridge, autopilot, NOW + k * 1_000_000) for k in range(1, 5))
    assert bridge.parse(lie)[0].known
    assert not bridge.parse(lie)[0].known  # it cannot be replayed
    assert signing(bridge).last == 0
    newcomer = codec(component=42)
    assert accepts(bridge, newcomer, NOW + 6_000_000)


def test_our_stamps_follow_the_autopilot_s_but_not_for_years() -> None:
    """A computer without a clock, off for a day, takes the time from a vehicle that knows it."""
    day = 24 * HOUR
    for ahead, follows in ((day, True), (30 * day, True), (11 * YEAR, False)):
        bridge, autopilot = Codec(1, 191, Signing(KEY, follow=(1, 1))), codec(component=1)
        assert accepts(bridge, autopilot, NOW, ahead)
        text(bridge)
        assert signing(bridge).last - timestamp(NOW) == pytest.approx(ahead // 10 if follows else 0, abs=5)


def test_what_was_recorded_is_refused_after_a_restart() -> None:
    bridge, autopilot = codec(), codec(component=1)
    bridge.now_us = autopilot.now_us = NOW
    recorded = text(autopilot)
    assert bridge.parse(recorded)[0].known
    bridge = restarted(bridge, clean=True)
    assert [one.id for one in bridge.parse(recorded)] == [REFUSED]
    bridge = Codec(1, 191, Signing(KEY))  # its file is lost: a minute is what the guide allows
    bridge.now_us = NOW + 2 * MINUTE
    assert [one.id for one in bridge.parse(recorded)] == [REFUSED]
    assert signing(bridge).refusals == {"a time stamp behind our clock": (1, 1)}


def test_floors_are_kept_of_so_many_streams() -> None:
    bridge = codec()
    for system in range(1, 6):
        for component in range(1, 251):
            speaker = Codec(system, component, Signing(KEY))
            assert accepts(bridge, speaker, NOW)
    assert len(signing(bridge).streams) == 1024


def test_a_count_of_frames_stands_for_the_frames() -> None:
    """As a replay takes it, which does not have those of a file."""
    one, other = codec(), codec()
    for now in (NOW, NOW, NOW + 7):
        one.now_us = other.now_us = now
        for _ in range(300):
            text(one)
        other.skip(300)
        assert text(one) == text(other)


# ---- A key that somebody sends over the link reaches neither the messages nor the log --------------------


LINK_KEY = bytes(range(1, 33))
FIELDS = {
    "SETUP_SIGNING": "secret_key",
    "AUTH_KEY": "key",
    "CHANGE_OPERATOR_CONTROL": "passkey",
    "WIFI_CONFIG_AP": "password",
}
SETUP = Codec(255, 190).pack("SETUP_SIGNING", target_system=1, secret_key=LINK_KEY, initial_timestamp=1 << 40)
BEAT = Codec(1, 1).pack("HEARTBEAT", type=12)


def logged(codec: Codec, *chunks: bytes) -> list[bytes]:
    """Return the frames that the log receives."""
    frame_log, frames = FrameLogWriter(1, 191), []
    for data in chunks:
        frames += frame_log.frames(codec.parse(data), codec.pending)
    return frames


def holds(frames: list[bytes]) -> bool:
    """Return True if the bytes contain any eight bytes of the key."""
    data = b"".join(frames)
    return any(LINK_KEY[i : i + 8] in data for i in range(len(LINK_KEY) - 8))


@pytest.mark.parametrize("signing", [None, Signing(bytes(32))])
@pytest.mark.parametrize("name", FIELDS)
def test_a_message_with_a_secret(name: str, signing: Signing | None) -> None:
    assert spec(name).id in SECRET
    frame = Codec(255, 190).pack(name, **{FIELDS[name]: LINK_KEY[:25]})
    listener = Codec(1, 191, signing)
    (message,) = listener.parse(frame)
    assert (message.id, message.payload, message.system) == (REFUSED, b"", 255)
    assert not holds([message.frame])
    # the kept bytes are a frame, and removing secrets again changes nothing
    assert Codec(1, 191).parse(message.frame)[0].frame == message.frame
    assert len(message.frame) == len(frame)


@given(st.integers(0, len(SETUP)), st.integers(0, len(SETUP) - 1), st.booleans())
def test_however_it_is_cut_or_damaged(cut: int, bad: int, noise: bool) -> None:
    damaged = SETUP[:bad] + bytes((SETUP[bad] ^ 0xFF,)) + SETUP[bad + 1 :]
    header = bad < 10  # a damaged header does not identify the message
    for data in [SETUP] if header else [SETUP, damaged]:
        chunks = (b"\xfd noise" * noise + data[:cut], data[cut:] + BEAT * 3, BEAT)
        frames = logged(Codec(1, 191), *chunks)
        assert not holds(frames)
        reader = FrameLogReader()
        assert sum(len(reader.data(frame)) for frame in frames) == sum(map(len, chunks))
