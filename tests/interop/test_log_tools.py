"""pymavlink's own log tools read our log, without our dialect and with it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
from devices import TRUTH
from pymavlink import mavutil
from rig import Rig

from magbridge.mavlink import LogReader
from magbridge.records import Channel


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two seconds, in which the parameters were asked for."""
    rig = Rig(tmp_path_factory.mktemp("rig"))
    try:
        rig.start()
        rig.autopilot.send_message("PARAM_REQUEST_LIST", target_system=1, target_component=191)
        rig.until(lambda: len(rig.of("PARAM_VALUE")) == 15)
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
    with log.open("rb") as file:
        reader = LogReader(file)
        counts = Counter(record.message.name for record in reader)
    assert reader.damages == 0
    return counts


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
    with log.open("rb") as file:
        stamps = {record.channel for record in LogReader(file)}
    assert stamps == set(Channel)
