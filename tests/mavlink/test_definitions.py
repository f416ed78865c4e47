"""What ``magbridge dialect`` writes is what other programs take, as it stands."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from magbridge.mavlink import Codec
from magbridge.mavlink.definitions import write_definitions


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("dialect")
    names = [path.name for path in write_definitions(made)]
    ardupilot = "magbridge_ardupilotmega"
    assert names == ["magbridge.xml", "magbridge_dialect.py", f"{ardupilot}.xml", f"{ardupilot}.py"]
    return made


def load(path: Path) -> Any:
    found = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["magbridge_dialect", "magbridge_ardupilotmega"])
def test_a_module_reads_what_the_bridge_sends(folder: Path, name: str) -> None:
    station = load(folder / f"{name}.py").MAVLink(None)
    frame = Codec(1, 191).pack("MAG_FIELD", total_field=48123.25, sequence=7, x=1.5)
    (message,) = station.parse_buffer(frame)
    assert (message.get_type(), message.total_field, message.sequence) == ("MAG_FIELD", 48123.25, 7)
    assert hasattr(station, "rangefinder_send") is (name == "magbridge_ardupilotmega")  # one of ArduPilot's


def test_mavgen_takes_the_xml_as_it_stands(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pymavlink.tools.mavgen", "--lang=Python3", "--wire-protocol=2.0"]
    out = tmp_path / "again.py"
    subprocess.run([*command, "-o", out, folder / "magbridge.xml"], check=True, capture_output=True)
    assert load(out).MAVLINK_MSG_ID_MAG_FIELD == 60101


def test_it_can_be_written_twice(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.glob("*.xml")}
    write_definitions(folder)
    assert {path.name: path.read_bytes() for path in folder.glob("*.xml")} == before
