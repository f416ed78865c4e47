"""Test that any bytes in any pieces give messages or a counted loss."""

import itertools
import random
from types import ModuleType

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from machine import cost
from pymavlink.dialects.v20 import all as upstream

from magbridge.mavlink import BAD_DATA, Codec, Message, Signing, spec
from magbridge.mavlink.codec import MAX_PENDING_BYTES, timestamp
from magbridge.mavlink.messages import EXTRA


def stream(count: int, system: int = 1) -> list[bytes]:
    codec = Codec(system, 1)
    return [codec.pack("ATTITUDE", time_boot_ms=1000 + i, roll=0.1 + i, yawspeed=1.0) for i in range(count)]


def foreign(payload: bytes, number: int = 59_999) -> bytes:
    """Return the frame of an unknown message; its checksum cannot be checked."""
    return bytes((0xFD, len(payload), 0, 0, 9, 1, 1, *number.to_bytes(3, "little"))) + payload + b"\x12\x34"


def cut(data: bytes, places: list[int]) -> list[bytes]:
    edges = [0, *sorted({place % (len(data) + 1) for place in places}), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


def parse(chunks: list[bytes]) -> tuple[list[Message], Codec]:
    codec = Codec(1, 191)
    return [message for chunk in chunks for message in codec.parse(chunk)], codec


PIECES = st.one_of(
    st.binary(max_size=40),
    st.sampled_from(stream(5)),
    st.binary(min_size=1, max_size=20).map(foreign),
    st.sampled_from([b"\xfd", b"\xfd\xff\x00", b"\xfe", b"\xfe\xff" * 200, b"\xfd\x00\x00" * 500]),
)


@given(st.lists(PIECES, max_size=20).map(b"".join), st.lists(st.integers(0, 10_000), max_size=30))
@example(b"\xfd" * 5000, [1, 2, 3])
@example(bytes(3 * MAX_PENDING_BYTES) + stream(1)[0], [MAX_PENDING_BYTES, MAX_PENDING_BYTES + 1])
def test_any_bytes_however_cut(data: bytes, places: list[int]) -> None:
    whole, one = parse([data])
    pieces, other = parse(cut(data, places))
    assert pieces == whole
    assert other.bytes_skipped == one.bytes_skipped
    kept = b"".join(message.frame for message in whole)
    assert data.startswith(kept)  # every byte is in a message, in order, or still waited for
    assert len(data) - len(kept) <= MAX_PENDING_BYTES
    assert one.bytes_skipped == sum(len(m.frame) for m in whole if m.id == BAD_DATA)
    for message in whole:
        assert isinstance(message.fields, dict)
        assert message.name


@given(st.lists(PIECES, max_size=6).map(b"".join))
def test_a_genuine_frame_survives_what_is_around_it(noise: bytes) -> None:
    noise = noise.replace(b"\xfd", b"\xfc").replace(b"\xfe", b"\xfc")[: MAX_PENDING_BYTES - 100]
    frames = stream(3)
    found, codec = parse([noise + frames[0] + noise + frames[1] + frames[2]])
    assert [message.frame for message in found if message.known] == frames
    assert codec.bytes_skipped == 2 * len(noise)
    assert codec.frames == 3


def test_a_damaged_frame_does_not_take_the_next_with_it() -> None:
    first, second, third = stream(3)
    damaged = first[:15] + bytes((first[15] ^ 1,)) + first[16:]
    shortened = first[:-4]
    for bad in (damaged, shortened, b"\xfd\xff"):
        # 300 bytes on, even a header that promises the longest frame is found out
        found, codec = parse([bad + second + third * 10])
        assert [m.frame for m in found if m.known] == [second] + [third] * 10
        assert codec.bytes_skipped == len(bad)


def test_messages_outside_the_dialect_are_kept_when_another_frame_follows() -> None:
    codec = Codec(1, 191)
    frame = foreign(b"abc")
    assert codec.parse(frame) == []
    unknown, received = codec.parse(stream(1)[0])
    assert (unknown.name, unknown.frame, unknown.fields) == ("UNKNOWN_59999", frame, {})
    assert received.name == "ATTITUDE"


def test_version_1_is_read(peer: ModuleType) -> None:
    station = peer.MAVLink(None, 1, 1)
    frame = peer.MAVLink_attitude_message(5, 0.5, 0, 0, 0, 0, 0).pack(station, force_mavlink1=True)
    (message,) = Codec(1, 191).parse(frame)
    assert message["roll"] == 0.5
    assert message.system == 1


def test_wrong_names_and_values_are_refused() -> None:
    codec = Codec(1, 191)
    with pytest.raises(KeyError, match="colour"):
        codec.pack("HEARTBEAT", colour=1)
    with pytest.raises(KeyError):
        spec("NO_SUCH_MESSAGE")
    assert codec._mav.seq == 0


def test_garbage_is_cheap_even_byte_by_byte() -> None:
    """A parser that restarts at every byte would need minutes: tens of thousands of units."""
    for garbage in (b"\xfd" * 20_000, b"\xfe\xff" * 10_000, random.Random(1).randbytes(20_000)):
        codec = Codec(1, 191)
        bytewise = (garbage[i : i + 1] for i in range(len(garbage)))
        assert cost(lambda: [codec.parse(byte) for byte in bytewise]) < 1000.0  # noqa: B023 - called at once
        assert codec.bytes_skipped > len(garbage) - MAX_PENDING_BYTES - 300


@pytest.mark.parametrize("key", [None, bytes(range(32))])
def test_each_frame_equals_pymavlinks(key: bytes | None) -> None:
    """Payloads of zeros, of other bytes and with zeros at the end, of every message, signed or not."""
    own = Codec(1, 191, Signing(key) if key else None)
    own.now_us = 1_700_000_000_000_000
    peer = upstream.MAVLink(None, 1, 191)
    if key:
        peer.signing.secret_key, peer.signing.sign_outgoing = key, True
        peer.signing.timestamp = timestamp(own.now_us)
    for number, extra in EXTRA.items():
        layout = spec(number)
        full = random.Random(number).randbytes(layout.size)
        for payload in (bytes(layout.size), full, full[: layout.size // 2].ljust(layout.size, b"\0")):
            packed = upstream.MAVLink_message(number, layout.name)._pack(peer, extra[0], payload)
            peer.seq = (peer.seq + 1) % 256
            assert own.frame(layout, payload) == packed
