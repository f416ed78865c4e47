"""Test MAVLink FTP and the older log transfer, without a link: accepted and rejected requests."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from line import Line

from magbridge.link import files as metadata
from magbridge.link.files import (
    BURST,
    DATA,
    EACH,
    FTP_HEADER,
    SESSIONS,
    Error,
    FtpServer,
    LogTransfer,
    Opcode,
    Request,
    Tree,
)
from magbridge.mavlink import Codec
from magbridge.mavlink.enums import MAV_CMD

ME, OTHER = (255, 190), (254, 190)
TEXTS = {"/general.json": b"{}", "/parameter.json": b"[]"}
NAMES = ["20260101T000000Z_0001.tlog", "20260102T030405Z_0001.tlog", "20260102T030405Z_0002.tlog"]
SECRETS = ["key.bin", "bridge.toml", "20260101T000000Z_0001.tlog.txt", "x20260101T000000Z_0001.tlog"]


class Station:
    """A client that sends requests and decodes replies."""

    def __init__(self, server: FtpServer, who: tuple[int, int] = ME) -> None:
        self._server, self._who, self._sequence = server, who, 0

    def ask(
        self, opcode: int, data: bytes | str = b"", *, session: int = 0, offset: int = 0,
        size: int | None = None, again: bool = False,
    ) -> list[tuple[int, int, int, int, bytes]]:  # fmt: skip
        """Return opcode, session, offset, whether the burst is complete, data of each reply."""
        text = data.encode() if isinstance(data, str) else data
        self._sequence += not again
        header = FTP_HEADER.pack(
            self._sequence & 0xFFFF, session, opcode, len(text) if size is None else size, 0, 0, offset
        )
        replies = []
        for k, payload in enumerate(self._server.handle(self._who, (header + text).ljust(251, b"\0")), 1):
            assert len(payload) == 251
            sequence, got, kind, length, asked, complete, at = FTP_HEADER.unpack_from(payload)
            assert (sequence, asked) == ((self._sequence + k) & 0xFFFF, opcode & 0xFF)
            replies.append((kind, got, at, complete, payload[12 : 12 + length]))
        return replies

    def one(self, *args: Any, **options: Any) -> tuple[int, bytes]:
        """Return opcode and data of the one reply."""
        ((kind, _, _, _, data),) = self.ask(*args, **options)
        return kind, data

    def refused(self, *args: Any, **options: Any) -> Error:
        kind, data = self.one(*args, **options)
        assert kind == Opcode.NAK
        return Error(data[0])

    def open(self, path: str, session: int = 0) -> int:
        ((kind, got, _, _, _),) = self.ask(Opcode.OPEN_READ, path, session=session)
        assert kind == Opcode.ACK
        return got


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    logs = tmp_path / "logs"
    logs.mkdir()
    for k, name in enumerate(NAMES):
        (logs / name).write_bytes(bytes(range(256)) * (k + 1) * 300)
    for name in SECRETS:
        (logs / name).write_bytes(b"secret")
    (tmp_path / "key.bin").write_bytes(b"secret")
    (logs / "20260103T000000Z_0001.tlog").symlink_to(tmp_path / "key.bin")
    return logs


@pytest.fixture
def clock() -> list[float]:
    return [100.0]


@pytest.fixture
def server(folder: Path, clock: list[float]) -> Iterator[FtpServer]:
    one = FtpServer(Tree(TEXTS, folder), lambda: clock[0])
    yield one
    one.close()


def listing(station: Station, path: str) -> list[str]:
    entries: list[str] = []
    while True:
        kind, data = station.one(Opcode.LIST, path, offset=len(entries))
        if kind == Opcode.NAK:
            assert data == bytes((Error.END_OF_FILE,))
            return entries
        entries += data.decode().rstrip("\0").split("\0")


def test_only_what_is_meant_for_stations_is_listed(server: FtpServer) -> None:
    station = Station(server)
    root = ["D@MAV_LOG", "Dlogs", "Fgeneral.json\t2", "Fparameter.json\t2"]
    assert listing(station, "/") == listing(station, "") == listing(station, "/./") == root
    logs = [f"F{name}\t{76800 * (k + 1)}" for k, name in enumerate(NAMES)]
    assert listing(station, "@MAV_LOG") == listing(station, "/logs/") == logs


def test_a_long_listing_comes_whole(tmp_path: Path) -> None:
    names = [f"20260101T000000Z_{k:04d}.tlog" for k in range(1000)]
    for name in names:
        (tmp_path / name).touch()
    assert listing(Station(FtpServer(Tree({}, tmp_path), float)), "logs") == [f"F{name}\t0" for name in names]


@pytest.mark.parametrize("size", [1, 80, DATA, 0])
def test_a_file_by_bursts(server: FtpServer, folder: Path, size: int) -> None:
    station, path = Station(server), folder / NAMES[0]
    session = station.open(f"/logs/{NAMES[0]}")
    data, replies = b"", [(int(Opcode.ACK), 0, 0, 1, b"")]
    wanted = path.read_bytes()[: 5000 if size == 1 else None]
    while replies[-1][0] == Opcode.ACK and len(data) < len(wanted):
        assert replies[-1][3] == 1
        replies = station.ask(Opcode.BURST, session=session, offset=len(data), size=size)
        assert len(replies) <= BURST
        for kind, got, at, complete, piece in replies:
            assert got == session
            assert at == len(data)
            assert not complete or kind == Opcode.ACK
            data += piece if kind == Opcode.ACK else b""
    assert data[: len(wanted)] == wanted


def test_a_file_by_reads_and_its_checksum(server: FtpServer, folder: Path) -> None:
    station, data = Station(server), (folder / NAMES[1]).read_bytes()
    session = station.open(f"@MAV_LOG/{NAMES[1]}")
    for offset in (0, 100, len(data) - 5):
        piece = Opcode.ACK, data[offset : offset + DATA]
        assert station.one(Opcode.READ, session=session, offset=offset, size=DATA) == piece
    for offset in (len(data), 0xFFFFFFFF):
        assert station.refused(Opcode.READ, session=session, offset=offset, size=DATA) is Error.END_OF_FILE
        assert station.refused(Opcode.BURST, session=session, offset=offset, size=DATA) is Error.END_OF_FILE
    kind, checksum = station.one(Opcode.CRC32, f"logs/{NAMES[1]}")
    assert (kind, int.from_bytes(checksum, "little")) == (Opcode.ACK, slow_crc32(data))
    assert station.one(Opcode.TERMINATE, session=session)[0] == Opcode.ACK
    assert station.refused(Opcode.READ, session=session) is Error.INVALID_SESSION


def slow_crc32(data: bytes) -> int:
    """Return the CRC of the guide's example, bit by bit, from 0 and not inverted."""
    total = 0
    for byte in data:
        total ^= byte
        for _ in range(8):
            total = total >> 1 ^ (0xEDB88320 if total & 1 else 0)
    return total


@pytest.mark.parametrize(
    "path",
    ["/../key.bin", "logs/../key.bin", "logs/../../key.bin", "/etc/passwd", "nothing", "logs/nothing", "/",
     "@MAV_LOG", "logs//../x", "\xff\xfe", "logs/20260103T000000Z_0001.tlog", "logs/" + "x" * 230,
     *(f"logs/{name}" for name in SECRETS)],
)  # fmt: skip
def test_paths_outside_are_not_found(server: FtpServer, path: str) -> None:
    station = Station(server)
    for opcode in (Opcode.OPEN_READ, Opcode.CRC32):
        assert station.refused(opcode, path.encode("latin-1")) in (Error.FILE_NOT_FOUND, Error.FAIL_ERRNO)
    if path not in ("/", "@MAV_LOG"):
        assert station.refused(Opcode.LIST, path.encode("latin-1")) is Error.FILE_NOT_FOUND
    assert len(server._files) == 0


@pytest.mark.parametrize("opcode", [6, 7, 8, 9, 10, 11, 12, 13])
def test_nothing_is_written(server: FtpServer, folder: Path, opcode: int) -> None:
    before = sorted(folder.iterdir())
    assert Station(server).refused(opcode, f"logs/{NAMES[0]}") is Error.FILE_PROTECTED
    assert sorted(folder.iterdir()) == before


def test_a_request_that_comes_again_gets_the_same_reply(server: FtpServer) -> None:
    station = Station(server)
    requests = (Opcode.OPEN_READ, f"logs/{NAMES[0]}"), (Opcode.OPEN_READ, "nothing"), (Opcode.TERMINATE,)
    for request in requests:
        assert station.ask(*request) == station.ask(*request, again=True)
    assert len(server._files) == 0


def test_sessions_have_an_owner_and_an_end(server: FtpServer, clock: list[float]) -> None:
    me, other = Station(server), Station(server, OTHER)
    mine, theirs = me.open(f"logs/{NAMES[0]}", 7), other.open(f"logs/{NAMES[0]}")
    assert mine == 7
    assert other.refused(Opcode.READ, session=mine) is Error.INVALID_SESSION
    assert other.refused(Opcode.TERMINATE, session=mine) is Error.INVALID_SESSION
    other.ask(Opcode.RESET)
    assert other.refused(Opcode.BURST, session=theirs) is Error.INVALID_SESSION
    assert me.one(Opcode.READ, session=mine, size=9)[0] == Opcode.ACK
    for _ in range(EACH - 1):
        me.open(f"logs/{NAMES[0]}")  # half-open: nothing follows
    assert me.refused(Opcode.OPEN_READ, f"logs/{NAMES[0]}") is Error.NO_SESSIONS
    assert Station(server, OTHER).open(f"logs/{NAMES[1]}") == 0
    clock[0] += 11.0
    assert me.one(Opcode.READ, session=mine, size=9)[0] == Opcode.ACK
    me.open(f"logs/{NAMES[0]}")  # in the place of the stalest
    assert me.one(Opcode.READ, session=mine, size=9)[0] == Opcode.ACK


def test_a_crowd_cannot_take_all_sessions_for_ever(server: FtpServer, clock: list[float]) -> None:
    for k in range(SESSIONS):
        Station(server, (k, 1)).open("general.json")
    station = Station(server)
    assert station.refused(Opcode.OPEN_READ, "general.json") is Error.NO_SESSIONS
    clock[0] += 11.0
    station.open("general.json")
    assert len(server._files) == SESSIONS


def test_a_burst_ends_with_its_session(server: FtpServer) -> None:
    station = Station(server)
    session = station.open(f"logs/{NAMES[0]}")
    header = FTP_HEADER.pack(50, session, Opcode.BURST, 80, 0, 0, 0)
    burst = server.handle(ME, header.ljust(251, b"\0"))
    next(burst)
    station.ask(Opcode.TERMINATE, session=session)
    assert list(burst) == []


@given(st.lists(st.tuples(st.sampled_from([ME, OTHER]), st.binary(min_size=251, max_size=251)), max_size=20))
def test_whatever_is_asked_is_answered(requests: list[tuple[tuple[int, int], bytes]]) -> None:
    server = FtpServer(Tree(TEXTS, None), float)
    for sender, payload in requests:
        replies = list(server.handle(sender, payload))
        assert 1 <= len(replies) <= BURST
        assert {Request.from_payload(one).opcode for one in replies} <= {Opcode.ACK, Opcode.NAK}
    assert len(server._files) <= SESSIONS


def sent(replies: Any) -> list[dict[str, Any]]:
    codec = Codec(1, 191)
    return [codec.parse(codec.frame(*reply))[0].fields for reply in replies]


def test_logs_the_older_way(folder: Path) -> None:
    logs = LogTransfer(Tree(TEXTS, folder))
    entries = sent(logs.entries(0, 0xFFFF))
    assert [(one["id"], one["size"], one["num_logs"], one["last_log_num"]) for one in entries] == [
        (k + 1, 76800 * (k + 1), 3, 3) for k in range(3)
    ]
    assert entries[1]["time_utc"] == 1767323045
    assert [one["id"] for one in sent(logs.entries(2, 2))] == [2]
    whole = (folder / NAMES[0]).read_bytes()
    pieces = sent(logs.data(1, 0, 0xFFFFFFFF))
    assert b"".join(one["data"][: one["count"]] for one in pieces) == whole
    assert pieces[-1]["count"] < 90
    assert all(one["count"] == 90 for one in pieces[:-1])
    middle = sent(logs.data(1, 900, 270))
    assert [(one["ofs"], one["count"]) for one in middle] == [(900, 90), (990, 90), (1080, 90)]
    for number, offset in ((0, 0), (4, 0), (99, 5), (1, len(whole)), (1, 0xFFFFFFFF)):
        (empty,) = sent(logs.data(number, offset, 90))
        assert (empty["count"], empty["ofs"]) == (0, offset)


def test_a_bridge_without_logs(tmp_path: Path) -> None:
    for place in (None, tmp_path / "none"):
        (entry,) = sent(LogTransfer(Tree(TEXTS, place)).entries(0, 9))
        assert entry["num_logs"] == 0


def test_a_log_of_a_whole_number_of_pieces_ends_with_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / NAMES[0]).write_bytes(bytes(90 * 256))
    pieces = sent(LogTransfer(Tree({}, tmp_path)).data(1, 0, 0xFFFFFFFF))
    assert [one["count"] for one in pieces] == [90] * 256 + [0]


def test_metadata_of_every_parameter(link: Line) -> None:
    (answer, _) = link.command(MAV_CMD.REQUEST_MESSAGE, 397)
    place, checksum = layout(answer)
    files = link.component.metadata
    assert place == "mftp://[;comp=191]/general.json"
    general = files["/general.json"]
    assert checksum == slow_crc32(general)
    (kind,) = msgspec.json.decode(general)["metadataTypes"]
    crc = slow_crc32(files["/parameter.json"])
    assert kind == {"type": 1, "uri": "mftp://[;comp=191]/parameter.json", "fileCrc": crc}
    rows = msgspec.json.decode(files["/parameter.json"])["parameters"]
    table = link.component.parameters.table
    assert [row["name"] for row in rows] == list(table)
    for row in rows:
        one = table[row["name"]]
        assert (row["min"], row["max"]) == (one.low, one.high)
        assert (row["default"], row["units"]) == (one.default, one.unit)
        assert row["shortDesc"]
        assert row["rebootRequired"] is False
        assert row["group"] in metadata.GROUPS.values()
        assert round(one.default, row["decimalPlaces"]) == pytest.approx(one.default, rel=0.1)


def layout(answer: Any) -> tuple[str, int]:
    """Decode a message that pymavlink does not know yet."""
    (message,) = Codec(0, 0).parse(bytes(answer.get_msgbuf()) if hasattr(answer, "get_msgbuf") else answer)
    assert message.name == "COMPONENT_METADATA"
    return message["uri"], message["file_crc"]
