"""Test each driver with any bytes in any chunks, and with the output of its encoder."""

import gc
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instruments import CASES, instrument

from magbridge.errors import ConfigError
from magbridge.records import Reading
from magbridge.sensors import Driver, open_driver
from magbridge.sensors.clock import DeviceClock
from sitl.fluxgate import Encoder

FIELDS = st.tuples(*[st.floats(-150_000, 150_000)] * 3)


def fed(driver: Driver, chunks: Iterator[bytes]) -> tuple[list[bytes], int, int]:
    """Return the readings (packed, so that NaN equals NaN) and the counters."""
    readings = [reading for chunk in chunks for reading in driver.feed(chunk)]
    return [msgspec.msgpack.encode(reading) for reading in readings], driver.bytes_skipped, driver.frames_bad


def stream(encoder: Encoder, fields: list[tuple[float, float, float]]) -> list[bytes]:
    return [encoder.encode(Reading(field, device_time=0.1 * k)) for k, field in enumerate(fields)]


@st.composite
def damaged(draw: st.DrawFn, case: str) -> list[bytes]:
    """Return frames with garbage between, and lost and changed bytes, cut into chunks."""
    _, encoder = instrument(case)
    parts = []
    for frame in stream(encoder, draw(st.lists(FIELDS, max_size=12))):
        match draw(st.integers(0, 5)):
            case 0:
                parts.append(draw(st.binary(max_size=40)))
            case 1:
                at = draw(st.integers(0, len(frame) - 1))
                parts.append(frame[:at] + frame[at + 1 :])
                continue
            case 2:
                at = draw(st.integers(0, len(frame) - 1))
                parts.append(frame[:at] + bytes([draw(st.integers(0, 255))]) + frame[at + 1 :])
                continue
        parts.append(frame)
    data = b"".join(parts)
    cuts = sorted(draw(st.lists(st.integers(0, len(data)), max_size=8)))
    return [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]


@pytest.mark.parametrize("case", CASES)
@given(data=st.data())
@settings(max_examples=60)
def test_whole_or_in_pieces_is_the_same(case: str, data: st.DataObject) -> None:
    chunks = data.draw(damaged(case))
    whole = b"".join(chunks)
    expected = fed(instrument(case)[0], iter([whole]))
    assert fed(instrument(case)[0], iter(chunks)) == expected
    assert fed(instrument(case)[0], (whole[k : k + 1] for k in range(len(whole)))) == expected


@pytest.mark.parametrize("case", CASES)
@given(chunks=st.lists(st.binary(max_size=200), max_size=10))
@settings(max_examples=60)
def test_any_bytes_give_readings_or_counted_loss(case: str, chunks: list[bytes]) -> None:
    driver, _ = instrument(case)
    skipped = driver.bytes_skipped
    readings = [reading for chunk in chunks for reading in driver.feed(chunk)]
    assert all(isfinite(value) for reading in readings for value in reading.field)
    assert 0 <= driver.bytes_skipped - skipped <= sum(map(len, chunks))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("byte", [b"\x00", b"\x0d", b"\x0a", b"\xc0", b"\xdb", b"1", b"\xff"])
def test_memory_is_bounded(case: str, byte: bytes) -> None:
    driver, _ = instrument(case)
    skipped = driver.bytes_skipped
    tracemalloc.start()
    for _ in range(20):
        driver.feed(byte * 2_500)
    gc.collect()  # Python's own lists of free tuples
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 10_000  # of 50,000 bytes; threads of earlier tests may allocate, too
    assert driver.bytes_skipped <= skipped + 50_000


@pytest.mark.parametrize("case", CASES)
def test_garbage_costs_a_few_readings_at_most(case: str) -> None:
    driver, encoder = instrument(case)
    fields = [(20_000.0 + 37 * k, -3000.0 + 11 * k, 30_000.0 - 23 * k) for k in range(40)]
    frames = stream(encoder, fields)
    got = [driver.feed(frame) for frame in frames[:20]]
    driver.feed(bytes(range(256)) * 3)
    got += [driver.feed(frame) for frame in frames[20:]]
    right = [reading for readings in got for reading in readings if reading.field[2] < 31_000]
    assert len(right) >= 38
    for reading in right[-10:]:
        nearest = min(fields, key=lambda field: abs(field[0] - reading.field[0]))
        assert reading.field == pytest.approx(nearest, abs=4)
    assert driver.bytes_skipped > 0


@pytest.mark.parametrize(
    ("name", "options", "line"),
    [
        ("fluxgate", {}, "sensor.driver: expected one of ascii, digitizer, hmr2300, rm3100, twinleaf"),
        ("digitizer", {}, "sensor.options.sensitivity: missing key"),
        ("digitizer", {"sensitivity": 0.0}, "sensor.options.sensitivity: expected `float` >= 1e-12"),
        ("hmr2300", {"rate": 21}, "sensor.options.rate: expected one of 10, 20, 25, 30, 40, 50, 60, 100,"),
        ("hmr2300", {"speed": 21}, "sensor.options.speed: unknown key"),
        ("twinleaf", {"columns": ["x"]}, "sensor.options.columns: expected `array` of length 3"),
        ("twinleaf", {"unit": "ell"}, "sensor.options.unit: expected one of"),
        ("ascii", {"columns": ["x", "y"]}, "sensor.options.columns: expected x, y and z, or total_field"),
        ("ascii", {"columns": ["x", "y", "z", "q"]}, "sensor.options.columns: 'q' is none of x y z"),
        ("ascii", {"columns": ["x", "y", "z", "z"]}, "sensor.options.columns: 'z' stands there twice"),
        ("ascii", {"scale": float("inf")}, "sensor.options.scale: expected a finite number, got inf"),
        ("ascii", {"scale": 0.0}, "sensor.options.scale: expected a number other than 0"),
        ("ascii", {"keys": ["rx"]}, "sensor.options.keys: expected one for each of the 3 columns"),
        ("ascii", {"range": float("inf")}, "sensor.options.range: expected a finite number, got inf"),
        ("ascii", {"checksum": "crc8"}, "sensor.options.checksum: expected one of 'crc32', 'nmea', 'sum',"),
    ],
)
def test_wrong_options_name_the_key(name: str, options: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError) as error:
        open_driver(name, options, source="my.toml")
    assert str(error.value).startswith(f"my.toml: {line}")
    assert "\n" not in str(error.value)


def test_other_packages_can_add_a_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "from magbridge.sensors.ascii import Ascii\nclass Sensor(Ascii):\n    pass\n"
    other_driver(tmp_path, monkeypatch, "other", text)
    (reading,) = open_driver("other", {"unit": "uT"}).feed(b"1 2 3\n")
    assert reading.field == (1000.0, 2000.0, 3000.0)


def other_driver(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> None:
    """Install a driver of another package."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[magbridge.sensors]\n{name} = {name}_sensor:Sensor\n")
    (folder / f"{name}_sensor.py").write_text(text)
    monkeypatch.syspath_prepend(str(folder))


def test_a_driver_that_inherits_needs_only_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = """
import msgspec
from magbridge.records import Reading
from magbridge.sensors import Driver
class Sensor(Driver):
    class Options(msgspec.Struct):
        pass
    bytes_skipped = frames_bad = 0
    def __init__(self, options):
        pass
    def feed(self, data):
        return [Reading((float(byte), 0.0, 0.0)) for byte in data]
"""
    other_driver(tmp_path, monkeypatch, "least", text)
    driver = open_driver("least", {})
    assert driver.start() == ()
    stamps = DeviceClock.for_driver(driver).stamp(driver.feed(b"12"), 10**15)
    assert [stamp.missing for stamp in stamps] == [0, 0]


@pytest.mark.parametrize(
    ("text", "lacks"),
    [
        ("class Sensor: pass", "Options, feed, start"),
        (
            """
from magbridge.sensors.ascii import AsciiOptions
class Sensor:
    Options = AsciiOptions
    feed = start = frames_bad = lambda self: ()
    def __init__(self, options): pass
""",
            "range_nt, nt_per_count, sequence_modulo, time_modulo, period, bytes_skipped",
        ),
    ],
)
def test_a_driver_that_lacks_a_member_is_named_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, lacks: str
) -> None:
    name = f"lacking{len(text)}"
    other_driver(tmp_path, monkeypatch, name, text)
    with pytest.raises(ConfigError, match=f"sensor.driver: driver '{name}' lacks {lacks}$"):
        open_driver(name, {}, source="my.toml")


def test_opening_a_driver_imports_that_one_and_nothing_heavy() -> None:
    code = (
        "import sys; from magbridge.sensors import open_driver; open_driver('hmr2300', {});"
        "print(*(m for m in sys.modules if m.split('.')[0] in {'scipy', 'xarray', 'numpy', 'pymavlink'}"
        " or m.startswith('magbridge.sensors.')))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert set(out.split()) == {"magbridge.sensors.hmr2300", "magbridge.sensors.framing"}
