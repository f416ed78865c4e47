"""A key that somebody sends over the link reaches neither the messages nor the log."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magbridge.mavlink import REFUSED, SECRET, Codec, FrameLogReader, FrameLogWriter, Signing, spec

KEY = bytes(range(1, 33))
FIELDS = {
    "SETUP_SIGNING": "secret_key",
    "AUTH_KEY": "key",
    "CHANGE_OPERATOR_CONTROL": "passkey",
    "WIFI_CONFIG_AP": "password",
}
SETUP = Codec(255, 190).pack("SETUP_SIGNING", target_system=1, secret_key=KEY, initial_timestamp=1 << 40)
BEAT = Codec(1, 1).pack("HEARTBEAT", type=12)


def logged(codec: Codec, *chunks: bytes) -> list[bytes]:
    """The frames that the log gets."""
    frame_log, frames = FrameLogWriter(1, 191), []
    for data in chunks:
        frames += frame_log.frames(codec.parse(data), codec.pending)
    return frames


def holds(frames: list[bytes]) -> bool:
    """Return True if the bytes contain any eight bytes of the key."""
    data = b"".join(frames)
    return any(KEY[i : i + 8] in data for i in range(len(KEY) - 8))


@pytest.mark.parametrize("signing", [None, Signing(bytes(32))])
@pytest.mark.parametrize("name", FIELDS)
def test_a_message_with_a_secret(name: str, signing: Signing | None) -> None:
    assert spec(name).id in SECRET
    frame = Codec(255, 190).pack(name, **{FIELDS[name]: KEY[:25]})
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
