"""Write ``magbridge/mavlink/dialect.py`` from ``magbridge.xml`` and the definitions that pymavlink ships.

The XML is read with pymavlink's own parser (mavgen's), so lengths, order and CRC are its work. What is
written is a table, not the classes of mavgen: those take 0.4 s and 115 MB to import for the same messages.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pymavlink
from pymavlink.generator import mavparse

ROOT = Path(__file__).parents[1]
XML = ROOT / "magbridge" / "mavlink" / "magbridge.xml"
OUT = XML.with_name("dialect.py")
DEFINITIONS = Path(pymavlink.__file__).parent / "dialects" / "v20"
INCLUDED = "all.xml"
"""More than our own messages: any that an autopilot sends can become a parameter, and is in logs."""
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
"""The enumerations that the code uses, and which of their entries; an empty list means all."""
CODES = {
    "char": "s", "int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H", "int32_t": "i",
    "uint32_t": "I", "int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d",
}  # fmt: skip


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
  </messages>
</mavlink>
"""
"""Messages that upstream has added since the definitions in pymavlink; known by their id and checksum."""
EXTENSIONS = {"TIMESYNC": ("B:target_system::", "B:target_component::")}
"""Fields that upstream has added since the definitions in pymavlink; extensions leave the
checksum as it is."""


def collect(path: Path, seen: dict[Path, Any]) -> dict[Path, Any]:
    """Parse `path` and what it includes, each file once."""
    if path not in seen:
        seen[path] = parsed = mavparse.MAVXML(str(path), mavparse.PROTOCOL_2_0)
        for name in parsed.include:
            collect(DEFINITIONS / name, seen)
    return seen


def invalid(one: Any) -> str:
    """Return the number that stands for 'not known'; empty if there is none, or if it is NaN."""
    text = one.invalid.strip("[]:,")
    if match := re.fullmatch(r"(U?)INT(\d+)_(MAX|MIN)", text):
        bits = int(match[2]) - (match[1] == "")
        return str((1 << bits) - 1 if match[3] == "MAX" else -(1 << bits))
    return text if re.fullmatch(r"-?\d+", text) else ""


def field(one: Any) -> str:
    """Return ``code:name:unit:invalid`` of a field, the code as in `struct`, with its count for an array."""
    count = str(one.array_length) if one.array_length else ""
    text = f"{count}{CODES[one.type]}:{one.name}:{one.units.strip('[]')}:{invalid(one)}"
    if text.count(":") != 3 or "," in text:
        raise ValueError(f"a unit that the table cannot hold: {text}")
    return text


def render() -> str:
    """Return the text of the module."""
    files = collect(DEFINITIONS / INCLUDED, collect(XML, {}))
    with TemporaryDirectory() as folder:
        newer = Path(folder) / "upstream.xml"
        newer.write_text(UPSTREAM, encoding="utf-8")
        collect(newer, files)
    messages = {m.id: m for xml in files.values() for m in xml.message}
    if len(messages) != sum(len(xml.message) for xml in files.values()):
        raise ValueError("two messages with one id")
    lines = [
        (
            '"""The messages of MAVLink and of magbridge as a table: generated by tools/dialect.py, do not '
            'edit."""'
        ),
        "",
        "from enum import IntEnum",
        "",
        "MESSAGES: dict[int, tuple[str, int, str]] = {",
        "    # id: (name, CRC_EXTRA, fields in the order of the wire as code:name:unit:invalid)",
    ]
    lines += [
        f'    {m.id}: ("{m.name}", {m.crc_extra}, '
        f'"{",".join((*map(field, m.ordered_fields), *EXTENSIONS.get(m.name, ())))}"),'
        for _, m in sorted(messages.items())
    ]
    lines += ["}", "", "# the enumerations that the code uses"]
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
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="only compare; exit 1 where they differ")
    text = render()
    if parser.parse_args().check:
        return int(text != OUT.read_text(encoding="utf-8"))
    OUT.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
