"""Test files and parameters with third-party programs, through a router, and with old peers."""

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from checks import records
from devices import TRUTH, Ear, ftp
from pymavlink import mavutil
from pymavlink.dialects.v10 import common as version_1
from rig import Rig

from magbridge.link.files import Opcode
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel

LOG = "20250101T000000Z_0001.tlog"
MakeRig = Callable[[str], Rig]
Start = Callable[..., Any]


def with_a_log(rig: Rig, size: int) -> bytes:
    content = bytes(range(251)) * (size // 251)
    rig.until((rig.folder / "logs").is_dir)
    (rig.folder / "logs" / LOG).write_bytes(content)
    return content


def proxy(python: Path, *arguments: str) -> list[object]:
    return [python, python.with_name("mavproxy.py"), "--state-basedir=.", *arguments]


def test_mavproxy_reads_logs_both_ways(make_rig: MakeRig, start_peer: Start, python: Path) -> None:
    rig = make_rig("udpout")
    rig.start_alone()
    content = with_a_log(rig, 200_000)
    target = ("--target-system=1", "--target-component=191", "--default-modules=ftp,log,link,param")
    peer = start_peer(rig, proxy(python, f"--master=udpin:127.0.0.1:{rig.port}", *target))
    peer.until("Detected vehicle 1:191")
    peer.ask("ftp list @MAV_LOG")
    peer.until(LOG)
    peer.ask(f"ftp get @MAV_LOG/{LOG} by_ftp.tlog")
    got = rig.folder / "by_ftp.tlog"
    rig.until(lambda: got.exists() and got.stat().st_size == len(content), 60)
    peer.ask("ftp get ../key.bin none.bin")
    peer.until("ftp open failed")
    peer.ask("log list")
    peer.until(f"lastLog {len(rig.logs)}")
    peer.ask("log download 1 by_log.tlog")
    peer.until("Finished downloading by_log.tlog", timeout=60)
    peer.end()
    assert got.read_bytes() == content
    assert (rig.folder / "by_log.tlog").read_bytes() == content
    assert rig.stop() == 0


def indices(values: list[Message]) -> set[int]:
    return {value["param_index"] for value in values}


@pytest.fixture
def ears() -> Iterator[list[Ear]]:
    made = [Ear(255), Ear(254)]
    yield made
    for one in made:
        one.line.close()


def test_two_stations_and_a_vehicle_behind_a_router(
    make_rig: MakeRig, start_peer: Start, python: Path, ears: list[Ear]
) -> None:
    """MAVProxy forwards between the bridge and two stations; another vehicle is heard through it, too."""
    rig = make_rig("udpout")
    rig.start_alone()
    with_a_log(rig, 1000)
    outs = [f"--out=udp:127.0.0.1:{one.line.getsockname()[1]}" for one in ears]
    target = "--target-system=1", "--target-component=191", "--default-modules=link,output"
    source = f"--master=udpin:127.0.0.1:{rig.port}"
    start_peer(rig, proxy(python, source, *outs, *target, "--streamrate=-1"))
    rig.until(lambda: all(one.of("MAG_FIELD") or one.of("HEARTBEAT") for one in ears), 60)
    for one in ears:
        one.send_message("HEARTBEAT", type=6, autopilot=8, mavlink_version=3)
    names = 15
    rig.until(
        lambda: all(len({v["param_index"] for v in one.of("PARAM_VALUE")}) >= names for one in ears), 30
    )
    for k, one in enumerate(ears):
        one.send_message("FILE_TRANSFER_PROTOCOL", **ftp(Opcode.LIST, b"logs", 10 + k))
    rig.until(lambda: all(one.of("FILE_TRANSFER_PROTOCOL") for one in ears), 30)
    other = Codec(2, 1)
    for name, fields in (
        ("HEARTBEAT", {"type": 12, "autopilot": 3, "mavlink_version": 3}),
        ("NAMED_VALUE_FLOAT", {"name": "battpos", "value": -9.0}),
    ):
        ears[0].line.sendto(other.pack(name, **fields), ears[0].peer)
    rig.until(lambda: any("vehicle 2 is on the link" in one["text"] for one in ears[1].of("STATUSTEXT")), 30)
    assert rig.stop() == 0


def test_an_autopilot_that_sends_mavlink_1(make_rig: MakeRig) -> None:
    """The bridge uses MAVLink 1 telemetry, and still sends MAVLink 2."""
    rig = make_rig("udpin")
    station = version_1.MAVLink(None, 1, 1)
    rig.fluxgate.plug()
    rig.autopilot.up()
    rig.autopilot.pack = lambda name, /, **fields: old(station, name, fields)  # type: ignore[method-assign]
    rig.restart()
    assert rig.status["autopilot_state"] == 1
    assert rig.stop() == 0
    assert all(one.message.frame[0] == 0xFD for one in rig.received)


def old(station: Any, name: str, fields: dict[str, Any]) -> bytes:
    """Return a MAVLink 1 frame with the fields that version 1 of the message has."""
    if "name" in fields:
        fields = {**fields, "name": fields["name"].encode()}
    make = getattr(version_1, f"MAVLink_{name.lower()}_message")
    wanted = {key: fields.get(key, 0) for key in make.fieldnames}
    return bytes(make(**wanted).pack(station))


def test_a_station_behind_the_autopilot(make_rig: MakeRig) -> None:
    """On a serial line all that a station says comes through the autopilot, and all answers go back there."""
    rig = make_rig("serial")
    rig.start()
    rig.until(lambda: rig.of("HEARTBEAT"))  # so the autopilot knows where 1:191 is
    station, mark = Codec(255, 190), rig.mark
    rig.autopilot.send(station.pack("HEARTBEAT", type=6, autopilot=8, mavlink_version=3))
    rig.autopilot.send(station.pack("FILE_TRANSFER_PROTOCOL", **ftp(Opcode.LIST, b"/", 1)))
    rig.until(lambda: rig.of("FILE_TRANSFER_PROTOCOL", mark))
    rig.until(lambda: len(indices(rig.of("PARAM_VALUE", mark))) >= 15)
    (reply,) = rig.of("FILE_TRANSFER_PROTOCOL", mark)
    assert (reply["target_system"], reply["target_component"]) == (255, 190)
    assert b"D@MAV_LOG\0" in reply["payload"]
    assert rig.undue_flags(mark) == ""


# ---- pymavlink's own log tools read our log, without our dialect and with it -------------------------------


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log of two seconds with a request for the parameters."""
    rig = Rig(tmp_path_factory.mktemp("rig"))
    try:
        rig.start()
        rig.autopilot.send_message("PARAM_REQUEST_LIST", target_system=1, target_component=191)
        rig.until(lambda: len(rig.of("PARAM_VALUE")) >= 15)
        rig.autopilot.send(b"noise" * 20)
        rig.run(0.5)
        assert rig.stop() == 0
    finally:
        rig.close()
    (log,) = rig.logs
    return log


def tool(name: str, *arguments: object) -> str:
    command = [sys.executable, "-W", "ignore", "-m", f"pymavlink.tools.{name}", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


def counted(log: Path) -> Counter[str]:
    return Counter(record.message.name for record in records(log))


def test_mavlogdump_without_our_dialect(log: Path) -> None:
    lines = [json.loads(line) for line in tool("mavlogdump", "--format", "json", log).splitlines()]
    seen = Counter(line["meta"]["type"] for line in lines)
    counts = counted(log)
    for name in ("HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "HIGHRES_IMU", "PARAM_VALUE", "TIMESYNC"):
        assert seen[name] == counts[name] > 0
    assert not seen["BAD_DATA"]
    imu = next(line["data"] for line in lines if line["meta"]["type"] == "HIGHRES_IMU")
    assert imu["zmag"] == pytest.approx(TRUTH[2] * 1e-5, abs=2e-4)


def test_mavparms(log: Path) -> None:
    lines = tool("mavparms", log).splitlines()
    values = dict(line.split()[:2] for line in lines)
    assert float(values["MB_GAP_FACTOR"]) == 2.5


def test_mavlink_connection_with_our_dialect(log: Path, peer: ModuleType) -> None:
    """Read it as a user's program does: pymavlink and the module that mavgen generates from our XML."""
    reader = mavutil.mavlink_connection(str(log))
    reader.mav = peer.MAVLink(reader)
    reader.mav.robust_parsing = True
    counts: Counter[str] = Counter()
    last = None
    while (message := reader.recv_msg()) is not None:
        counts[message.get_type()] += 1
        last = message if message.get_type() == "MAG_FIELD" else last
    reader.close()
    assert counts == counted(log)
    assert last is not None
    assert last.get_srcComponent() == 191
    assert last.x == pytest.approx(TRUTH[0], abs=5)
    assert {record.channel for record in records(log)} == set(Channel)
