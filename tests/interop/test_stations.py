"""Test that third-party ground stations find the bridge, set its parameters, and read its messages."""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from devices import TRUTH
from rig import Rig

import magbridge.mavlink
from magbridge.mavlink import LogReader, spec
from magbridge.records import Channel

TOTAL = float(np.linalg.norm(TRUTH))
HERE = Path(__file__).parent
XML = Path(magbridge.mavlink.__file__).with_name("magbridge.xml")
TYPES = {
    "Q": "uint64_t", "q": "int64_t", "d": "double", "f": "float",
    "I": "uint32_t", "i": "int32_t", "H": "uint16_t", "B": "uint8_t",
}  # fmt: skip
MakeRig = Callable[[str], Rig]
Start = Callable[..., Any]


def test_mavproxy(make_rig: MakeRig, start_peer: Start, python: Path) -> None:
    rig = make_rig("udpout")
    rig.start_alone()
    peer = start_peer(
        rig,
        [
            python, python.with_name("mavproxy.py"), f"--master=udpin:127.0.0.1:{rig.port}",
            "--state-basedir=.", "--logfile=station.tlog",
            "--default-modules=param,link,cmdlong,misc,calibration", "--target-system=1",
            "--target-component=191",
        ],
    )  # fmt: skip
    peer.until("Detected vehicle 1:191")
    peer.ask("param fetch")
    peer.until("Received 19 parameters")
    peer.ask("param show MB_*")
    peer.until("MB_GAP_FACTOR")
    peer.ask("param set MB_GAP_FACTOR 4.5")
    rig.until((rig.folder / "bridge.parameters.json").exists)
    peer.ask_until("param show MB_GAP_FACTOR", "MB_GAP_FACTOR    4.5")
    rig.fluxgate.speaks = False
    peer.until("digitizer is silent")  # a STATUSTEXT
    rig.fluxgate.speaks = True
    peer.until("digitizer sends readings", len(peer.lines))
    peer.ask("long GET_MESSAGE_INTERVAL 60102")
    peer.until("Got COMMAND_ACK: GET_MESSAGE_INTERVAL: ACCEPTED")
    peer.end()
    assert rig.stop() == 0
    ours = (rig.folder / "logs").glob("*.tlog")
    logged = {record.frame for record in read(rig.folder / "station.tlog")}
    sent = Counter(record.frame for path in ours for record in read(path) if record.channel == Channel.SENT)
    # 256 messages later a heartbeat is the same to the bit
    has = [frame in logged for frame, times in sent.items() if times == 1]
    first, last = has.index(True), len(has) - has[::-1].index(True)
    assert sum(has[first:last]) > 0.98 * (last - first) > 50


def read(path: Path) -> list[Any]:
    with path.open("rb") as file:
        return list(LogReader(file))


def test_mavsdk(make_rig: MakeRig, start_peer: Start, python: Path) -> None:
    rig = make_rig("udpout")
    rig.start_alone()
    peer = start_peer(rig, [python, HERE / "mavsdk_station.py", f"udpin://127.0.0.1:{rig.port}", XML])
    found = peer.answer("found")["found"]
    assert found == {"system": 1, "components": [191], "autopilot": False}
    received = peer.answer("heard")["heard"]
    assert received["MAG_FIELD"]["total_field"] == pytest.approx(TOTAL, abs=20)
    assert received["MAG_RAW"]["z"] == pytest.approx(TRUTH[2], abs=0.1)
    assert received["MAG_STATUS"]["sensor_state"] == 1
    parameters = peer.answer("parameters")["parameters"]
    assert parameters["MB_GAP_FACTOR"] == 2.5
    assert parameters["MB_R_HEARTBEAT"] == 5
    assert peer.answer("read back")["read back"] == 4.0
    assert peer.answer("kept")["kept"] == 4.0


def layout(name: str) -> dict[str, object]:
    """Return the layout of one of magbridge's messages for node-mavlink."""
    message = spec(name)
    fields = [
        {"name": field.name, "offset": field.offset, "size": field.struct.size, "type": TYPES[field.code]}
        for field in message.fields.values()
    ]
    return {"id": message.id, "name": name, "size": message.size, "extra": message.extra, "fields": fields}


def test_node_mavlink(make_rig: MakeRig, start_peer: Start, modules: Path) -> None:
    rig = make_rig("tcpin")
    rig.start_alone()
    rig.until(lambda: rig.logs and rig.logs[0].stat().st_size > 500)
    ours = json.dumps([layout(name) for name in ("MAG_RAW", "MAG_FIELD", "MAG_STATUS")])
    peer = start_peer(rig, ["node", HERE / "node_station.cjs", modules, str(rig.port), ours])
    result = peer.answer("result")["result"]
    assert result["bad"] == 0
    latest = result["latest"]
    assert latest["HEARTBEAT"]["from"] == [1, 191]
    assert latest["HEARTBEAT"]["autopilot"] == 8
    assert latest["MAG_FIELD"]["total_field"] == pytest.approx(TOTAL, abs=20)
    assert latest["MAG_RAW"]["x"] == pytest.approx(TRUTH[0], abs=0.1)
    assert latest["MAG_STATUS"]["sensor_state"] == 1
    assert latest["HIGHRES_IMU"]["zmag"] == pytest.approx(TRUTH[2] * 1e-5, abs=2e-4)
    assert result["parameters"]["MB_GAP_FACTOR"] == 2.5
    assert len(result["parameters"]) == latest["PARAM_VALUE"]["paramCount"]
