"""Write ``magbridge/mavlink/dialect.py`` and ``enums.py`` from ``magbridge.xml`` and pymavlink's definitions.

pymavlink's mavgen writes ``dialect.py``: the classes of magbridge's messages and of the few upstream messages
that the wheel lacks. ``enums.py`` holds definitions that mavgen's Python modules omit: enumerations as
``IntEnum``, and for each field the value that means "not known".

    python tools/dialect.py [--check]
"""

from __future__ import annotations

import argparse
import re
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pymavlink
from pymavlink.generator import mavgen, mavparse

ROOT = Path(__file__).parents[1]
XML = ROOT / "magbridge" / "mavlink" / "magbridge.xml"
DIALECT, ENUMS_FILE = XML.with_name("dialect.py"), XML.with_name("enums.py")
DEFINITIONS = Path(pymavlink.__file__).parent / "dialects" / "v20"
INCLUDED = "all.xml"
"""Dialect of all messages, because any message of an autopilot can be a parameter or be in a log."""
ENUMS: dict[str, tuple[str, ...]] = {
    "FIRMWARE_VERSION_TYPE": ("OFFICIAL",),
    "GLOBAL_POSITION_SRC": ("MAGNETIC",),
    "MAG_CAUSE": (),
    "MAG_LEARNING_STATE": (),
    "MAG_LOG_STATE": (),
    "MAG_NAVIGATION_STATE": (),
    "MAG_PORT_NAME": (),
    "MAG_PORT_STATE": (),
    "MAG_RAW_FLAGS": (),
    "MAV_AUTOPILOT": ("GENERIC", "ARDUPILOTMEGA", "INVALID", "PX4"),
    "MAV_CMD": (
        "GET_MESSAGE_INTERVAL",
        "SET_MESSAGE_INTERVAL",
        "REQUEST_MESSAGE",
        "REQUEST_PROTOCOL_VERSION",
        "REQUEST_AUTOPILOT_CAPABILITIES",
        "EXTERNAL_POSITION_ESTIMATE",
        "PREFLIGHT_CALIBRATION",
        "FIXED_MAG_CAL",
        "FIXED_MAG_CAL_FIELD",
        "FIXED_MAG_CAL_YAW",
        "DO_START_MAG_CAL",
        "DO_ACCEPT_MAG_CAL",
        "DO_CANCEL_MAG_CAL",
    ),
    "MAV_ESTIMATOR_TYPE": ("VISION",),
    "MAV_FRAME": ("GLOBAL", "LOCAL_NED", "BODY_FRD", "LOCAL_FRD"),
    "MAV_PARAM_TYPE": ("REAL32",),
    "MAV_PROTOCOL_CAPABILITY": ("PARAM_FLOAT", "COMMAND_INT", "FTP", "MAVLINK2", "PARAM_ENCODE_C_CAST"),
    "MAV_RESULT": (),
    "MAV_SEVERITY": (),
    "MAV_STATE": ("ACTIVE", "CRITICAL"),
    "MAV_TYPE": ("GCS", "SUBMARINE", "ONBOARD_CONTROLLER"),
}
"""Enumerations that the code uses, and the entries that it needs; an empty tuple selects all entries."""


UPSTREAM = """<?xml version="1.0"?>
<mavlink>
  <messages>
    <message id="396" name="COMPONENT_INFORMATION_BASIC">
      <description>Basic component information data; to be requested.</description>
      <field type="uint32_t" name="time_boot_ms" units="ms">Time since system boot.</field>
      <field type="uint64_t" name="capabilities">Component capability flags.</field>
      <field type="uint32_t" name="time_manufacture_s" units="s" invalid="0">Date of manufacture.</field>
      <field type="char[32]" name="vendor_name">Name of the component vendor.</field>
      <field type="char[32]" name="model_name">Name of the component model.</field>
      <field type="char[24]" name="software_version">Software version.</field>
      <field type="char[24]" name="hardware_version">Hardware version.</field>
      <field type="char[32]" name="serial_number">Hardware serial number.</field>
    </message>
    <message id="397" name="COMPONENT_METADATA">
      <description>Where the general metadata file is, which names the others.</description>
      <field type="uint32_t" name="time_boot_ms" units="ms">Time since system boot.</field>
      <field type="uint32_t" name="file_crc">CRC-32 of the general metadata file.</field>
      <field type="char[100]" name="uri">MAVLink FTP URI of the general metadata file.</field>
    </message>
    <message id="111" name="TIMESYNC">
      <description>Time synchronization, with the address.</description>
      <field type="int64_t" name="tc1" units="ns">Time sync timestamp 1.</field>
      <field type="int64_t" name="ts1" units="ns">Time sync timestamp 2.</field>
      <extensions/>
      <field type="uint8_t" name="target_system">Target system id. Request: 0 (broadcast).</field>
      <field type="uint8_t" name="target_component">Target component id. Request: 0 (broadcast).</field>
    </message>
  </messages>
</mavlink>
"""
"""XML of upstream messages that pymavlink's definitions lack."""


def collect(path: Path, seen: dict[Path, Any]) -> dict[Path, Any]:
    """Parse `path` and its includes, each file once; return the parsed files by path."""
    if path not in seen:
        seen[path] = parsed = mavparse.MAVXML(str(path), mavparse.PROTOCOL_2_0)
        for name in parsed.include:
            collect(DEFINITIONS / name, seen)
    return seen


def invalid(one: Any) -> str:
    """Return the value of a field that means "not known", as text; empty if there is none or if it is NaN."""
    text = one.invalid.strip("[]:,")
    if match := re.fullmatch(r"(U?)INT(\d+)_(MAX|MIN)", text):
        bits = int(match[2]) - (match[1] == "")
        return str((1 << bits) - 1 if match[3] == "MAX" else -(1 << bits))
    return text if re.fullmatch(r"-?\d+", text) else ""


def definitions() -> dict[Path, Any]:
    """Return the parsed XML of pymavlink's dialect ``all`` and of magbridge's dialect, by path."""
    return collect(DEFINITIONS / INCLUDED, collect(XML, {}))


HEADER = '''"""Our messages, and those that pymavlink's wheel lacks: written by tools/dialect.py."""

from __future__ import annotations

import struct
from typing import Dict

from pymavlink.dialects.v20.all import MAVLink_message, mavlink_msg_deprecated_name_property
'''


def render_dialect() -> str:
    """Return the part of mavgen's module with magbridge's messages and the messages that the wheel lacks."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        ours = XML.read_text(encoding="utf-8").replace("  <include>common.xml</include>\n", "")
        newer = UPSTREAM.split("<messages>", 1)[1].split("</messages>", 1)[0]
        (folder / "magbridge.xml").write_text(
            ours.replace("</messages>", f"{newer}</messages>"), encoding="utf-8"
        )
        options = mavgen.Opts(
            str(folder / "dialect.py"), wire_protocol="2.0", language="Python3", validate=False
        )
        with redirect_stdout(StringIO()):
            mavgen.mavgen(options, [str(folder / "magbridge.xml")])
        text = (folder / "dialect.py").read_text(encoding="utf-8")
    # omit the rest of the module, which is equal in each dialect of the wheel
    begin, end = text.index("MAVLINK_MSG_ID_MAG_RAW ="), text.index("class MAVError(")
    return f"{HEADER}\n{text[begin:end].rstrip()}\n"


def render_enums() -> str:
    """Return the text of ``enums.py``."""
    files = definitions()
    lines = [
        '"""Enumerations, and values that mean "not known": generated by tools/dialect.py, do not edit."""',
        "",
        "from enum import IntEnum",
        "",
    ]
    for name, wanted in ENUMS.items():
        entries = {
            entry.name.removeprefix(f"{name}_"): entry.value
            for xml in files.values()
            for enum in xml.enum
            if enum.name == name
            for entry in enum.entry
            if not entry.name.endswith("_ENUM_END")
        }
        chosen = ", ".join(f'"{key}": {entries[key]}' for key in wanted or entries)
        lines.append(f'{name} = IntEnum("{name}", {{{chosen}}})')
    lines += [
        "",
        "INVALID: dict[str, dict[str, int]] = {",
        "    # message: {field: the value that means not known}",
    ]
    messages = {message.id: message for xml in files.values() for message in xml.message}
    for _, message in sorted(messages.items()):
        unknown = ", ".join(
            f'"{field.name}": {value}' for field in message.ordered_fields if (value := invalid(field))
        )
        if unknown:
            lines.append(f'    "{message.name}": {{{unknown}}},')
    return "\n".join([*lines, "}"]) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="only compare; exit 1 where they differ")
    check = parser.parse_args().check
    for path, text in ((DIALECT, render_dialect()), (ENUMS_FILE, render_enums())):
        if check and text != path.read_text(encoding="utf-8"):
            return 1
        if not check:
            path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
