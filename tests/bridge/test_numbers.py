"""No number that a sensor or an autopilot may say stops the bridge, or comes out as a good sample."""

from __future__ import annotations

from math import inf, isfinite, isnan, nan
from pathlib import Path

import numpy as np
import pytest

from magbridge.bridge.events import Event
from magbridge.bridge.pipeline import Pipeline, Start
from magbridge.bridge.run import set_up
from magbridge.calibration.file import save
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.config import load
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel, Quality

START = 1_780_000_000_000_000
CONFIG = """
[sensor]
driver = "ascii"
port = "/dev/null"
options = {columns = ["x", "y", "z", "temperature", "time", "sequence"]}
[link]
url = "udpout:127.0.0.1:14550"
[calibration]
file = "cal.json"
[telemetry.battpos]
message = "NAMED_VALUE_FLOAT"
match = {name = "battpos"}
field = "value"
[publish]
MAG_RAW = 0
MAG_FIELD = 0
HIGHRES_IMU = 0
NAMED_VALUE_FLOAT = 0
DEBUG_VECT = 0
[log]
directory = "logs"
"""
WILD = ("1e300", "-1e39", "1e20", "99999999999999999999", "3e9", "-32768", "0", "1e-320", "nan", "inf", "x")
DOUBTFUL = int(Quality.STALE_TELEMETRY | Quality.EXTRAPOLATED | Quality.MOVING)
TELEMETRY = (-9999.0, 65535.0, 1e9, 1e15, 3.4e38, -3.4e38, nan, inf)


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    size = 4 * 9
    cal = Calibration(
        parameters=(Parameter("battpos", "", -0.4, 0.6, 0.1, 0.5),),
        terms=(Polynomial(exponents=full_order(1, 3)),),
        coefficients=np.random.default_rng(1).normal(size=size) * 300.0,
        covariance=np.eye(size),
        noise=Noise(1.0),
        reference=Reference(50_000.0),
        method="auto",
    )
    save(cal, tmp_path / "cal.json")
    (tmp_path / "bridge.toml").write_text(CONFIG, encoding="utf-8")
    return set_up(load(tmp_path / "bridge.toml"), Start(START))


@pytest.mark.parametrize("column", range(6))
def test_in_a_line_of_the_sensor(pipeline: Pipeline, column: int) -> None:
    battery = Codec(1, 1).pack("NAMED_VALUE_FLOAT", name="battpos", value=0.1)
    pipeline.feed(Event(START, Channel.LINK, battery))
    for k, wild in enumerate((*WILD, None)):
        words = ["20000", "-100", "40000", "4", str(0.1 * k), str(k)]
        words[column] = wild or words[column]
        line = f"{' '.join(words)}\n".encode()
        told = fields(pipeline.feed(Event(START + 100_000 * (k + 1), Channel.SENSOR, line)))
        for one in told:
            assert one["total_field_sigma"] >= 1.0
    assert len(told) == 1  # the last line was a good one
    assert told[0]["total_field_sigma"] < 1e4


@pytest.mark.parametrize("value", TELEMETRY)
def test_in_the_telemetry(pipeline: Pipeline, value: float) -> None:
    autopilot = Codec(1, 1)
    for k, battery in enumerate((0.1, value, value, 0.1, value, 0.1, 0.1)):
        at_us = START + 1_000_000 * k
        frame = autopilot.pack("NAMED_VALUE_FLOAT", name="battpos", value=battery)
        pipeline.feed(Event(at_us, Channel.LINK, frame))
        line = f"20000 -100 40000 4 {k} {k}\n".encode()
        (one,) = fields(pipeline.feed(Event(at_us + 4, Channel.SENSOR, line)))
        if isnan(one["total_field"]) or battery != 0.1:
            assert one["flags"] & DOUBTFUL
            assert one["total_field_sigma"] > 1e3 or not isfinite(value)  # then the last value holds a while
        assert one["total_field_sigma"] >= 1.0


def fields(told: list[tuple[int, bytes]]) -> list[Message]:
    """Return each MAG_FIELD that was said."""
    messages = Codec(0, 0).parse(b"".join(frame for _, frame in told))
    return [one for one in messages if one.name == "MAG_FIELD"]
