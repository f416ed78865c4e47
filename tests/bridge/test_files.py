"""Test that a station can read a log while the bridge measures, without a change of the bridge's log."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count, pairwise

import pytest
from checks import replays
from devices import Ear, ftp
from rig import Rig

from magbridge.link.files import FTP_HEADER, Opcode

KEY = bytes(range(7, 39))
LOG = "20250101T000000Z_0001.tlog"
MakeRig = Callable[..., Rig]


def replies(station: Ear, mark: int) -> list[tuple[int, int, bytes]]:
    """Return opcode, end of burst (bool) and data of each FTP reply received since a position."""
    found = []
    for message in station.of("FILE_TRANSFER_PROTOCOL", mark):
        _, _, opcode, size, _, complete, _ = FTP_HEADER.unpack_from(message["payload"])
        found.append((opcode, complete, message["payload"][12 : 12 + size]))
    return found


@pytest.mark.parametrize("key", [None, KEY])
def test_a_log_is_read_while_the_bridge_measures(make_rig: MakeRig, key: bytes | None) -> None:
    rig = make_rig("udpin", key=key)
    (rig.folder / "logs").mkdir()
    content = bytes(range(251)) * 600
    (rig.folder / "logs" / LOG).write_bytes(content)
    rig.start()
    mark, before = rig.mark, rig.fresh_status()
    station, sequence = Ear(255, key, rig.autopilot.address), count(1)

    def ask(opcode: int, data: bytes = b"", **options: int) -> list[tuple[int, int, bytes]]:
        """Send an FTP request; return its replies, which end with the burst or with a negative reply."""
        start = len(station.received)
        station.send_message("FILE_TRANSFER_PROTOCOL", **ftp(opcode, data, next(sequence), **options))
        is_burst = opcode == Opcode.BURST
        rig.until(
            lambda: any(
                done or kind == Opcode.NAK or not is_burst for kind, done, _ in replies(station, start)
            )
        )
        return replies(station, start)

    station.send_message("HEARTBEAT", type=6, autopilot=8)
    assert ask(Opcode.OPEN_READ, f"@MAV_LOG/{LOG}".encode()) == [
        (Opcode.ACK, 0, len(content).to_bytes(4, "little"))
    ]
    data = b""
    while len(data) < len(content):
        burst = ask(Opcode.BURST, size=239, offset=len(data))
        data += b"".join(piece for kind, _, piece in burst if kind == Opcode.ACK)
    assert data == content
    assert [kind for kind, _, _ in ask(Opcode.OPEN_READ, b"../key.bin")] == [Opcode.NAK]
    rig.until_reported("file for 255:190 refused: file not found", mark)
    station.send_message("LOG_REQUEST_LIST", target_system=1, target_component=191, end=0xFFFF)
    rig.until(lambda: station.of("LOG_ENTRY"))
    station.send_message("LOG_REQUEST_DATA", target_system=1, target_component=191, id=1, count=900)
    rig.until(lambda: len(station.of("LOG_DATA")) == 10)
    assert b"".join(one["data"] for one in station.of("LOG_DATA")) == content[:900]
    station.send_message("LOG_ERASE", target_system=1, target_component=191)
    rig.until_reported("logs are not erased over the link", mark)
    assert (rig.folder / "logs" / LOG).read_bytes() == content
    after = rig.fresh_status()
    assert after["samples_lost"] == before["samples_lost"]
    assert rig.undue_flags(mark) == ""
    # no other peer got the file, and its frames are numbered without a gap
    assert not rig.of("FILE_TRANSFER_PROTOCOL", mark)
    numbers = [one.sequence for one in station.received if one.system == 1]
    assert all((b - a) % 256 == 1 for a, b in pairwise(numbers))
    station.line.close()
    (rig.folder / "logs" / LOG).unlink()
    assert sum(path.stat().st_size for path in rig.logs) < len(content) * 4
    replays(rig)
