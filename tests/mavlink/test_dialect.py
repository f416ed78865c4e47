"""Test that the XML, the generated table and pymavlink's classes agree."""

import importlib.util
import random
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree.ElementTree import parse

import pytest
from pymavlink.dialects.v20 import all as everything

from magbridge.mavlink import Codec, spec
from magbridge.mavlink.definitions import write_definitions
from magbridge.mavlink.messages import EXTRA, Field
from magbridge.records import Quality

ROOT = Path(__file__).parents[2]
OURS = [number for number in EXTRA if number >= 60100]


def test_generated_module_agrees_with_the_xml() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools" / "dialect.py", "--check"], check=False)
    assert done.returncode == 0, "run tools/dialect.py"


def test_flags_are_those_of_the_records() -> None:
    entries = parse(ROOT / "magbridge/mavlink/magbridge.xml").iterfind(".//enum[@name='MAG_QUALITY']/entry")
    told = {one.attrib["name"].removeprefix("MAG_QUALITY_"): int(one.attrib["value"]) for one in entries}
    assert told == {flag.name: flag.value for flag in Quality}


def test_ids_are_in_the_free_range() -> None:
    assert min(OURS) == 60100  # up to 60099 everything is allocated
    assert max(OURS) <= 0xFFFF  # MESSAGE_INTERVAL has 16 bits for an id


LIMITS = {"b": 7, "B": 8, "h": 15, "H": 16, "i": 31, "I": 32, "q": 63, "Q": 64}


def draw(field: Field, rng: random.Random) -> tuple[Any, Any]:
    """Return a random value of a field as each of the two libraries takes it: ours, theirs."""
    if field.code == "s":
        text = "".join(rng.choices("abcdefghXYZ_0123456789", k=rng.randint(1, field.count or 1)))
        return text, text.encode()
    if field.count and field.code == "B":
        data = rng.randbytes(field.count)
        return data, list(data)
    numbers = [
        rng.uniform(-1e5, 1e5) if field.code in "fd" else rng.getrandbits(LIMITS[field.code])
        for _ in range(field.count or 1)
    ]
    return (numbers, numbers) if field.count else (numbers[0], numbers[0])


@pytest.mark.parametrize("dialect", ["ours", "everything"])
def test_every_message_is_packed_and_read_as_by_pymavlink(peer: ModuleType, dialect: str) -> None:
    module = peer if dialect == "ours" else everything
    rng = random.Random(7)
    codec, station = Codec(1, 191), module.MAVLink(None, 1, 191)
    for number, theirs in module.mavlink_map.items():
        layout = spec(number)
        if layout.name == "TIMESYNC":  # newer than pymavlink's definitions
            continue
        drawn = {name: draw(field, rng) for name, field in layout.fields.items()}
        twin = theirs(**{name: drawn[name][1] for name in theirs.fieldnames})
        if layout.name == "HEARTBEAT":  # pymavlink sets the version itself
            twin.mavlink_version = drawn["mavlink_version"][0]
        station.seq = codec._mav.seq
        frame = codec.pack(layout.name, **{name: one for name, (one, _) in drawn.items()})
        assert frame == twin.pack(station), layout.name
        for payload in (bytes(layout.size), rng.randbytes(layout.size)):
            (message,) = Codec(0, 0).parse(codec.frame(layout, payload))
            decoded = station.decode(bytearray(message.frame))
            for name, value in message.fields.items():
                listed = list(value) if isinstance(value, tuple | bytes) else value
                assert repr(listed) == repr(getattr(decoded, name)), f"{layout.name}.{name}"


def test_import_is_light() -> None:
    """The process has to start in 0.3 s within 65 MB; pymavlink's classes of the dialect `all` take 14 MB."""
    program = (
        "import resource, time\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "import magbridge.mavlink, sys\n"
        "after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(after - before, 'pymavlink.mavutil' in sys.modules)"
    )
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    memory, heavy = out.stdout.split()
    assert heavy == "False"
    assert int(memory) < 35_000  # kB, msgspec included


# ---- what ``magbridge dialect`` writes is what other programs take, as it stands ---------------------------


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
