"""Test bridge.toml: accepted settings, and a message of one line for every other."""

from pathlib import Path

import msgspec
import pytest

from magbridge.bridge.sensor import needed_units, unmet
from magbridge.calibration.model import Calibration, Parameter, identity
from magbridge.config import (
    Align,
    CalibrationFile,
    Learning,
    Link,
    Log,
    Navigation,
    Sensor,
    Telemetry,
    load,
)
from magbridge.errors import ConfigError
from magbridge.navigate import NavigationOptions
from magbridge.sensors.options import attributes_of

GOOD = """
[sensor]
driver = "hmr2300"
port = "/dev/ttyUSB0"
[link]
url = "udpout:192.0.2.1:14550"
[telemetry.battpos]
message = "NAMED_VALUE_FLOAT"
match = {name = "battpos"}
field = "value"
unit = "in"
[publish]
MAG_FIELD = 0
HIGHRES_IMU = 0
NAMED_VALUE_FLOAT = 1
[log]
directory = "logs"
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "bridge.toml"
    path.write_text(text)
    return path


def test_the_contract_s_example_is_read(tmp_path: Path) -> None:
    config = load(write(tmp_path, GOOD))
    assert config.sensor.driver == "hmr2300"
    assert (config.link.system, config.link.component) == (1, 191)
    assert config.telemetry["battpos"].match == {"name": "battpos"}
    assert config.telemetry["battpos"].max_age == 30.0
    assert config.publish == {"MAG_FIELD": 0, "HIGHRES_IMU": 0, "NAMED_VALUE_FLOAT": 1}
    assert config.resolve("cal.json") == tmp_path / "cal.json"
    assert len(config.digest) == 16


def test_a_file_from_windows_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bridge.toml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert load(path).sensor == load(write(tmp_path, GOOD)).sensor


def test_another_encoding(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    path.write_bytes(GOOD.encode("utf-16"))
    with pytest.raises(ConfigError, match=r"toml: expected text in UTF-8$"):
        load(path)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("port =", "prt =", "sensor.prt: unknown key"),
        ('port = "/dev/ttyUSB0"', "port = 3", "sensor.port: expected `str`, got `int`"),
        ('port = "/dev/ttyUSB0"', "", "sensor.port: missing key"),
        ("[log]", "[calibration]\nfile = 'cal.json'\n[log]", "calibration.file: no such file"),
        ("[log]", "[log", "not TOML"),
        ("[telemetry", "signing_key = 'key.bin'\n[telemetry", "link.signing_key: no such file"),
        ("[log]", "[navigation]\nmap = 'grid.nc'\n[log]", "navigation.map: no such file"),
        ('unit = "in"', "max_age = inf", "telemetry.battpos.max_age: expected `float` <= 1000000000"),
        ('unit = "in"', "scale = 0.0", "telemetry.battpos.scale: expected a finite number other than 0"),
        ('unit = "in"', "offset = nan", "telemetry.battpos.offset: expected a finite number, got nan"),
        ('unit = "in"', "delay = 1e4", "battpos.delay: expected at most 600 s either way, got 10000.0"),
        ("HIGHRES_IMU = 0", "HIGHRES_IMU = 'fast'", "publish.HIGHRES_IMU: expected `float`, got `str`"),
        ("[telemetry", "system = 256\n[telemetry", "link.system: expected `int` <= 255"),
        ('port = "/dev/ttyUSB0"', 'port = ""', "sensor.port: expected `str` of length >= 1"),
        ("[telemetry", "component = 1\n[telemetry", "link.component: expected another number than the"),
        ("HIGHRES_IMU = 0", "HIGHRES_IMU = inf", "publish.HIGHRES_IMU: expected `float` <= 1000000000"),
        ("[sensor]", "path = 'x'\n[sensor]", "path: unknown key"),
    ],
)
def test_one_clear_line_names_the_key(tmp_path: Path, old: str, new: str, line: str) -> None:
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert line in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def calibrated_in(unit: str) -> Calibration:
    return identity((Parameter("battpos", unit, -0.5, 0.5, 0.0, 0.5),))


@pytest.mark.parametrize("unit", ["in", "inches", "", "1"])
def test_a_unit_may_be_undeclared_and_spelled_otherwise(tmp_path: Path, unit: str) -> None:
    """1 is what a calibration says that was fitted to a CSV whose header declares no unit."""
    assert unmet(needed_units(calibrated_in(unit)), load(write(tmp_path, GOOD))) == []


def test_telemetry_in_another_unit_than_the_calibration_s(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    (error,) = unmet(needed_units(calibrated_in("mm")), load(path))
    line = f"{path}: telemetry.battpos.unit: expected 'mm', the calibration's unit, not 'in'"
    assert str(error) == line


@pytest.mark.parametrize(
    "table", [Sensor, Link, Telemetry, CalibrationFile, Align, Navigation, Learning, Log, NavigationOptions]
)
def test_every_key_says_what_it_means(table: type[msgspec.Struct]) -> None:
    """Also where several share a string: the documentation's tables are made of these."""
    assert [one.name for one in attributes_of(table) if not one.meaning] == []
