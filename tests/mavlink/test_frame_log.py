"""A link's bytes through a log and back: the same messages at the same moments."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from magbridge.mavlink import Codec, FrameLogReader, FrameLogWriter

GENUINE = [
    Codec(1, 1).pack("ATTITUDE", time_boot_ms=1, roll=0.1, yawspeed=1.0),
    Codec(1, 1).pack("HEARTBEAT", type=12, autopilot=3),
    Codec(1, 1).pack("MAG_LINK_BYTES", length=3, data=b"abc"),
    b"\xfd\x03\x00\x00\x09\x01\x01\x5f\xea\x00abc\x12\x34",  # an unknown message
]
CHUNKS = st.lists(
    st.lists(
        st.one_of(
            st.sampled_from(GENUINE),
            st.sampled_from(GENUINE).flatmap(
                lambda frame: st.integers(1, len(frame)).map(lambda n: frame[:n])
            ),
            st.binary(max_size=10),
            st.sampled_from([b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00", b"\xfd", bytes(3000)]),
        ),
        max_size=4,
    ).map(b"".join),
    max_size=12,
)


@given(CHUNKS)
@example([b"\xfd\x30\x00\x00\x00\x01\x01\x00\x00\x00", GENUINE[0] + b"\xfd" * 9, GENUINE[1]])
@example(
    [b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00" + GENUINE[0], b"\xfd" * 260, b"\xfd\xff" * 300, GENUINE[1]]
)
def test_the_log_brings_about_the_same_messages_at_the_same_moments(chunks: list[bytes]) -> None:
    live, again = Codec(1, 191), Codec(1, 191)
    writer, reader = FrameLogWriter(1, 191), FrameLogReader()
    for chunk in chunks:
        messages = live.parse(chunk)
        frames = writer.frames(messages, live.pending)
        replayed = [message for frame in frames for message in again.parse(reader.data(frame))]
        believed = [message.frame for message in messages if message.known]
        assert [message.frame for message in replayed if message.known] == believed
        assert again.bytes_skipped == live.bytes_skipped
        assert Codec(1, 1).parse(b"".join(frames) + GENUINE[0])[-1].known  # any tool reads the log
