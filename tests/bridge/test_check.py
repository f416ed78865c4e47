"""``run --check``: all that would go wrong with a configuration, and nothing opened."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from magbridge.bridge.check import findings
from magbridge.calibration.file import save
from magbridge.calibration.model import Calibration, Parameter, Sensor, identity
from magbridge.calibration.terms import Polynomial

GOOD = """
[sensor]
driver = "hmr2300"
port = "/dev/null"
[link]
url = "udpout:127.0.0.1:14550"
[telemetry.battpos]
message = "NAMED_VALUE_FLOAT"
match = {name = "battpos"}
field = "value"
unit = "in"
[calibration]
file = "cal.json"
[log]
directory = "logs"
"""


def of(*names: str) -> Calibration:
    """Return a calibration that needs these parameters, in inches."""
    parameters = tuple(Parameter(name, "in", -1.0, 1.0, 0.0, 1.0) for name in names)
    terms = (Polynomial(exponents=((0,) * len(names),)),)
    return replace(identity(), sensor=Sensor("hmr2300"), parameters=parameters, terms=terms)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    save(of("battpos"), tmp_path / "cal.json")
    path = tmp_path / "bridge.toml"
    path.write_text(GOOD)
    return path


def lines(config: Path, *, fatal: bool | None = None) -> list[str]:
    found = [one for one in findings(config) if fatal is None or one.fatal == fatal]
    return [one.text.removeprefix(f"{config}: ") for one in found]


def test_nothing_is_wrong_with_a_good_one(config: Path) -> None:
    assert not lines(config, fatal=True)
    assert not (config.parent / "logs").exists()


def test_everything_is_said_at_once(config: Path) -> None:
    text = GOOD.replace(
        '"/dev/null"', '"/dev/no_such_device"\nbaudrat = 1\n[sensor.options]\nrate = 21\nspeed = 3'
    )
    text = text.replace("udpout:127.0.0.1:14550", "udp:127.0.0.1:1").replace(
        "NAMED_VALUE_FLOAT", "NAMED_VALUE"
    )
    config.write_text(
        text.replace("cal.json", "none.json") + "[publish]\nMAG_FELD = 1\nMAG_RAW = 1e9\n[lgo]\n"
    )
    texts = "\n".join(lines(config, fatal=True))
    for words in (
        "sensor.baudrat: unknown key; did you mean baudrate?",
        "lgo: unknown key; did you mean log?",
        "sensor.options.rate: invalid enum value 21",
        "sensor.options.speed: unknown key",
        "link.url: expected udpin, udpout",
        "telemetry.battpos.message: unknown MAVLink message 'NAMED_VALUE'",
        "calibration.file: no such file",
        "publish.MAG_FELD: expected one of",
        "publish.MAG_RAW: expected a rate from",
    ):
        assert words in texts
    assert any("no /dev/no_such_device now" in line for line in lines(config, fatal=False))


def test_each_parameter_that_is_lacking(config: Path) -> None:
    save(of("fin", "battpos", "ballast"), config.parent / "cal.json")
    config.write_text(GOOD.replace('unit = "in"', 'unit = "cm"'))
    assert lines(config, fatal=True) == [
        "telemetry.fin: missing: the calibration needs this parameter",
        "telemetry.battpos.unit: expected 'in', the calibration's unit, not 'cm'",
        "telemetry.ballast: missing: the calibration needs this parameter",
    ]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('[learning]\nprior = "bridge.toml"', "not a calibration"),
        ('[learning]\nreference = "bridge.toml"', "expected a grid"),
        ("[learning]\nranges = {fin = [0.0, 1.0]}", "telemetry.fin: missing"),
        ('[navigation]\nmap = "none.nc"\nfix = "TELEPATHY"', "navigation.fix: expected one of"),
    ],
)
def test_what_run_would_end_at_without_a_calibration(table: str, words: str, config: Path) -> None:
    config.write_text(GOOD.replace('[calibration]\nfile = "cal.json"\n', "") + table)
    assert any(words in line for line in lines(config, fatal=True))


def test_a_calibration_of_another_sensor(config: Path) -> None:
    config.write_text(GOOD.replace("hmr2300", "twinleaf"))
    assert any("every sample would be uncalibrated" in line for line in lines(config, fatal=False))


def test_a_log_that_cannot_be_written(config: Path) -> None:
    (config.parent / "logs").write_text("a file")
    assert any("logs is a file" in line for line in lines(config, fatal=False))


@pytest.mark.parametrize(
    "text", ["", "x = ", "[sensor]\n", "sensor = 3\nlink = 4\n", "[sensor]\ndriver = 'none'\n"]
)
def test_whatever_the_file_there_are_lines(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bridge.toml"
    path.write_text(text)
    assert all(one.startswith(str(path)) for one in (found.text for found in findings(path)))
    assert [one for one in findings(path) if one.fatal]


def test_a_device_that_may_not_be_opened_says_which_group(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda name, _: str(name) != "/dev/null")
    (line,) = [line for line in lines(config) if line.startswith("sensor.port")]
    assert line.startswith("sensor.port: /dev/null may not be opened by this user: it belongs to the group ")
    assert "sudo usermod -aG" in line
