"""Delimiters, COBS, CRC: against naive oracles."""

from __future__ import annotations

from zlib import crc32

from hypothesis import given
from hypothesis import strategies as st

from magbridge.sensors.framing import CRC32_RESIDUE, Framer, cobs_decode, cobs_encode

LIMIT = 10


def naive_frames(data: bytes) -> tuple[list[bytes], int]:
    """What a whole stream should give: frames, and bytes skipped for being in overlong ones."""
    *pieces, rest = data.split(b"\0")
    skipped = sum(len(piece) for piece in pieces if len(piece) > LIMIT)
    skipped += len(rest) if len(rest) > LIMIT else 0
    return [piece for piece in pieces if 0 < len(piece) <= LIMIT], skipped


@given(st.lists(st.binary(max_size=30)))
def test_chunks_do_not_matter_and_every_byte_is_accounted_for(chunks: list[bytes]) -> None:
    framer = Framer(b"\0", LIMIT)
    frames = [frame for chunk in chunks for frame in framer.split(chunk)]
    assert (frames, framer.skipped) == naive_frames(b"".join(chunks))


def test_an_endless_frame_is_not_kept() -> None:
    framer = Framer(b"\0", LIMIT)
    for _ in range(1000):
        assert framer.split(b"x" * 1000) == []
    assert framer.skipped == 1_000_000
    assert len(framer._rest) <= LIMIT
    assert framer.split(b"tail\0good\0") == [b"good"]
    assert framer.skipped == 1_000_004


def naive_cobs(data: bytes) -> bytes:
    """COBS as its paper tells it, for blocks shorter than 254."""
    return b"".join(bytes([len(block) + 1]) + block for block in data.split(b"\0"))


@given(st.lists(st.sampled_from([0, 0, 1, 2, 254, 255]), max_size=253).map(bytes))
def test_cobs(data: bytes) -> None:
    frame = cobs_encode(data)
    assert frame == naive_cobs(data)
    assert 0 not in frame
    assert cobs_decode(frame) == data


@given(st.binary(max_size=300))
def test_cobs_decodes_anything_or_says_no(frame: bytes) -> None:
    assert len(cobs_decode(frame)) < max(len(frame), 1)


@given(st.binary(max_size=100))
def test_crc_residue(data: bytes) -> None:
    assert crc32(data + crc32(data).to_bytes(4, "little")) == CRC32_RESIDUE
