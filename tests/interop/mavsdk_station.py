"""Run a MAVSDK ground station that prints JSON lines. Arguments: URL of the link, magbridge's XML."""

import contextlib
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.param import Param, ParamError, ProtocolVersion

url, xml = sys.argv[1], Path(sys.argv[2])
BRIDGE = 191


def notify(name: str, what: object) -> None:
    print(json.dumps({name: what}), flush=True)


station = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
result = station.add_any_connection(url)
systems: list[Any] = []
while not systems or BRIDGE not in systems[0].component_ids():
    systems = station.get_systems()
    time.sleep(0.05)
system = systems[0]
notify(
    "found",
    {
        "system": system.get_system_id(),
        "components": system.component_ids(),
        "autopilot": system.has_autopilot(),
    },
)

direct = MavlinkDirect(system)
direct.load_custom_xml(xml.read_text())
received: dict[str, Any] = {}
ready = threading.Event()


def receive(message: Any, _: object) -> None:
    received[message.message_name] = json.loads(message.fields_json)
    # where the machine stands still, the sensor is silent for a moment
    speaks = received.get("MAG_STATUS", {}).get("sensor_state") == 1
    if speaks and {"MAG_FIELD", "MAG_RAW"} <= received.keys():
        ready.set()


for name in ("MAG_FIELD", "MAG_RAW", "MAG_STATUS"):
    direct.subscribe_message(name, receive)
ready.wait(20)
notify("heard", received)

param = Param(system)
with contextlib.suppress(ParamError):  # MAVSDK 4.1.0 says "unknown" when it has selected it
    param.select_component(BRIDGE, ProtocolVersion.V1)
notify("parameters", {one.name: one.value for one in param.get_all_params().float_params})
param.set_param_float("MB_GAP_FACTOR", 4.0)
notify("read back", param.get_param_float("MB_GAP_FACTOR"))
try:
    param.set_param_float("MB_GAP_FACTOR", 0.5)
    notify("refused", None)
except ParamError as error:
    notify("refused", str(error))
notify("kept", param.get_param_float("MB_GAP_FACTOR"))
sys.stdin.read()
