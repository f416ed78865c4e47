"""Test that a station can read a log while the bridge measures, without a change of the bridge's log."""

from __future__ import annotations

import itertools
import socket
from collections.abc import Callable, Iterator

import pytest
from checks import replays
from rig import Rig

from magbridge.link.files import FTP_HEADER, Opcode
from magbridge.mavlink import Codec, Message, Signing

KEY = bytes(range(7, 39))
LOG = "20250101T000000Z_0001.tlog"
MakeRig = Callable[..., Rig]


class Station:
    """Ground station 255:190 on its own socket."""

    def __init__(self, rig: Rig, key: bytes | None) -> None:
        self._rig = rig
        self._codec, self._ear = Codec(255, 190, Signing(key) if key else None), Codec(0, 0)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(rig.autopilot.address)
        self._sequence = 0
        self.received: list[Message] = []

    def send_message(self, name: str, **fields: object) -> None:
        self._codec.now_us = self._rig.autopilot.codec.now_us
        self._socket.send(self._codec.pack(name, **fields))

    def ask(self, opcode: int, data: bytes = b"", *, session: int = 0, size: int = 0, offset: int = 0) -> int:
        """Send an FTP request; return the number of messages received before its reply."""
        mark, self._sequence = len(self.received), self._sequence + 1
        header = FTP_HEADER.pack(self._sequence, session, opcode, size or len(data), 0, 0, offset)
        payload = (header + data).ljust(251, b"\0")
        self.send_message("FILE_TRANSFER_PROTOCOL", target_system=1, target_component=191, payload=payload)
        return mark

    def replies(self, mark: int) -> Iterator[tuple[int, int, bytes]]:
        """Yield opcode, end of burst (bool) and data of each FTP reply received since a position."""
        for message in self.received[mark:]:
            if message.name == "FILE_TRANSFER_PROTOCOL":
                _, _, opcode, size, _, complete, _ = FTP_HEADER.unpack_from(message["payload"])
                yield opcode, complete, message["payload"][12 : 12 + size]

    def until(self, condition: Callable[[], object]) -> None:
        def met() -> object:
            try:
                while True:
                    self.received += self._ear.parse(self._socket.recv(65536))
            except BlockingIOError:
                return condition()

        self._rig.until(met)

    def close(self) -> None:
        self._socket.close()


@pytest.mark.parametrize("key", [None, KEY])
def test_a_log_is_read_while_the_bridge_measures(make_rig: MakeRig, key: bytes | None) -> None:
    rig = make_rig("udpin", key=key)
    (rig.folder / "logs").mkdir()
    content = bytes(range(251)) * 600
    (rig.folder / "logs" / LOG).write_bytes(content)
    rig.start()
    mark, before = rig.mark, rig.fresh_status()
    station = Station(rig, key)
    station.send_message("HEARTBEAT", type=6, autopilot=8)
    start = station.ask(Opcode.OPEN_READ, f"@MAV_LOG/{LOG}".encode())
    station.until(lambda: list(station.replies(start)))
    assert list(station.replies(start)) == [(Opcode.ACK, 0, len(content).to_bytes(4, "little"))]
    data = b""
    while len(data) < len(content):
        start = station.ask(Opcode.BURST, size=239, offset=len(data))
        station.until(lambda: any(done or kind == Opcode.NAK for kind, done, _ in station.replies(start)))  # noqa: B023
        data += b"".join(piece for kind, _, piece in station.replies(start) if kind == Opcode.ACK)
    assert data == content
    start = station.ask(Opcode.OPEN_READ, b"../key.bin")
    station.until(lambda: list(station.replies(start)))
    assert [kind for kind, _, _ in station.replies(start)] == [Opcode.NAK]
    rig.until_reported("file for 255:190 refused: file not found", mark)
    station.send_message("LOG_REQUEST_LIST", target_system=1, target_component=191, end=0xFFFF)
    station.until(lambda: any(one.name == "LOG_ENTRY" for one in station.received))
    station.send_message("LOG_REQUEST_DATA", target_system=1, target_component=191, id=1, count=900)
    station.until(lambda: sum(one.name == "LOG_DATA" for one in station.received) == 10)
    logged = b"".join(one["data"] for one in station.received if one.name == "LOG_DATA")
    assert logged == content[:900]
    station.send_message("LOG_ERASE", target_system=1, target_component=191)
    rig.until_reported("logs are not erased over the link", mark)
    assert (rig.folder / "logs" / LOG).read_bytes() == content
    after = rig.fresh_status()
    assert after["samples_lost"] == before["samples_lost"]
    assert rig.undue_flags(mark) == ""
    # no other peer got the file, and its frames are numbered without a gap
    assert not rig.of("FILE_TRANSFER_PROTOCOL", mark)
    numbers = [one.sequence for one in station.received if one.system == 1]
    assert all((b - a) % 256 == 1 for a, b in itertools.pairwise(numbers))
    station.close()
    (rig.folder / "logs" / LOG).unlink()
    assert sum(path.stat().st_size for path in rig.logs) < len(content) * 4
    replays(rig)
