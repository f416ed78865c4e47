"""Live navigation: telemetry and samples in, fixes out, in the message that the stack takes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

from magbridge.bridge.drive import set_up
from magbridge.bridge.events import Event, Start
from magbridge.calibration.file import save
from magbridge.calibration.model import Noise, identity
from magbridge.config import load
from magbridge.errors import ConfigError
from magbridge.field.geodesy import offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.field.read import read_grid
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel, Reading
from sitl.fluxgate import open_encoder

TRACKING = 2
START = 1_780_000_000_000_000
PLACE = (49.5, -57.9)
SPEED, HEADING, OFF = 0.5, 60.0, 150.0
CONFIG = """
[sensor]
driver = "digitizer"
port = "/dev/null"
[sensor.options]
sensitivity = 5e-5
reference_voltage = 5.0
[link]
url = "udpout:127.0.0.1:14550"
[calibration]
file = "cal.json"
[navigation]
map = "grid.nc"
fix = "FIX"
options = {start_sigma = 200.0, current_sigma = 0.02, bias_sigma = 1.0, interval = 10.0}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map with hills of 300 m and 40 nT, and a calibration that changes nothing."""
    path = tmp_path_factory.mktemp("navigation")
    perfect = replace(identity(), covariance=1e-4 * np.eye(9), noise=Noise(1.0), method="nominal")
    save(perfect, path / "cal.json")
    latitude = PLACE[0] + np.linspace(-0.05, 0.08, 131)
    longitude = PLACE[1] + np.linspace(-0.05, 0.12, 121)
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(longitude * 72_000.0, latitude * 111_000.0)
    anomaly = sum(
        15.0 * np.sin((x * np.cos(a) + y * np.sin(a)) / length + phase)
        for a, length, phase in zip(
            rng.uniform(0, 3.1, 12), rng.uniform(80, 300, 12), rng.uniform(0, 6.3, 12), strict=True
        )
    )
    AnomalyGrid(longitude, latitude, anomaly).save(path / "grid.nc")
    return path


def events(grid: AnomalyGrid, config: Path) -> Iterator[Event]:
    """A glider whose dead reckoning is 150 m off: an hour on one heading."""
    autopilot, fluxgate = Codec(1, 1), open_encoder("digitizer", load(config).sensor.options)
    origin = offset(*PLACE, OFF, -OFF)  # where it is; it believes to be at PLACE
    fix = {"lat": round(PLACE[0] * 1e7), "lon": round(PLACE[1] * 1e7), "fix_type": 3, "h_acc": 200_000}
    yield Event(START + 4, Channel.LINK, autopilot.pack("GPS_RAW_INT", **fix))
    for k in range(1, 901):
        time_us = START + 4_000_000 * k
        data = autopilot.pack("ATTITUDE", yaw=radians(HEADING), pitch=-0.4)
        data += autopilot.pack("VFR_HUD", airspeed=SPEED)
        yield Event(time_us, Channel.LINK, data)
        along = SPEED * 4.0 * k
        here = offset(*origin, along * np.cos(radians(HEADING)), along * np.sin(radians(HEADING)))
        total = (
            float(total_field(here[1], here[0], 0.0, time_us * 1e-6)[0])
            + grid.look_up(here[1], here[0]).anomaly
        )
        field = (0.4 * total, 0.3 * total, float(np.sqrt(0.75)) * total)
        yield Event(time_us + 2000, Channel.SENSOR, fluxgate.encode(Reading(field, device_time=4.0 * k)))


def run(folder: Path, fix: str) -> bytes:
    path = folder / f"{fix}.toml"
    path.write_text(CONFIG.replace("FIX", fix))
    pipeline = set_up(load(path), Start(START))
    return b"".join(
        frame for event in events(read_grid(folder / "grid.nc"), path) for _, frame in pipeline.feed(event)
    )


def heard(stream: bytes) -> dict[str, list[Message]]:
    messages: dict[str, list[Message]] = {}
    for message in Codec(255, 190).parse(stream):
        messages.setdefault(message.name, []).append(message)
    return messages


def truth(message: Message) -> tuple[float, float]:
    """Return where the vehicle is at the time of a message."""
    along = SPEED * (message["time_usec"] - START) * 1e-6
    start = offset(*PLACE, OFF, -OFF)
    return offset(*start, along * np.cos(radians(HEADING)), along * np.sin(radians(HEADING)))


@pytest.mark.parametrize(
    ("fix", "message"),
    [
        ("EXTERNAL_POSITION_ESTIMATE", "COMMAND_INT"),
        ("GLOBAL_POSITION_SENSOR", "GLOBAL_POSITION_SENSOR"),
        ("ODOMETRY", "ODOMETRY"),
    ],
)
def test_the_field_finds_what_dead_reckoning_lost(folder: Path, fix: str, message: str) -> None:
    stream = run(folder, fix)
    messages = heard(stream)
    last = messages["MAG_NAVIGATION"][-1]
    latitude, longitude = truth(last)
    north, east = (last["lat"] * 1e-7 - latitude) * 111_000.0, (last["lon"] * 1e-7 - longitude) * 72_000.0
    sigma = np.sqrt(last["covariance_nn"] + last["covariance_ee"])
    assert np.hypot(north, east) < max(4.0 * sigma, 15.0)
    assert sigma < 60.0
    assert messages[message], "a fix is sent once it is valid"
    valid = sum(one["state"] == TRACKING for one in messages["MAG_NAVIGATION"])
    assert valid < len(messages["MAG_NAVIGATION"])
    if fix != "ODOMETRY":
        assert len(messages[message]) <= valid, "and not before"
    sent = messages[message][-1]
    if fix == "EXTERNAL_POSITION_ESTIMATE":
        assert (sent["command"], sent["target_system"], sent["target_component"]) == (43003, 1, 1)
        assert (sent["x"], sent["y"]) == (last["lat"], last["lon"])
        assert 0.0 < sent["param3"] <= sigma
    elif fix == "GLOBAL_POSITION_SENSOR":
        assert (sent["lat"], sent["lon"]) == (last["lat"], last["lon"])
    else:
        begun = next(one for one in messages["MAG_NAVIGATION"] if one["state"] == TRACKING)["time_usec"]
        assert messages[message][0]["time_usec"] >= begun, "and not before"
        assert sent["pose_covariance"][0] >= last["covariance_nn"] * (1 - 1e-6), "it grows between updates"
    assert any(re.match("navigation: tracking", text["text"]) for text in messages["STATUSTEXT"])


def test_odometry_goes_on_between_updates(folder: Path) -> None:
    """At 5 Hz, where the vehicle is by then, its doubt growing; and it ends when the field does."""
    path = folder / "odometry.toml"
    path.write_text(CONFIG.replace("FIX", "ODOMETRY"))
    pipeline = set_up(load(path), Start(START))
    given = list(events(read_grid(folder / "grid.nc"), path))
    stream = b"".join(frame for event in given for _, frame in pipeline.feed(event))
    silent = b"".join(
        frame
        for k in range(600)
        for _, frame in pipeline.feed(Event(given[-1].time_us + 200_000 * k, Channel.LINK, b""))
    )
    sent = heard(stream)["ODOMETRY"]
    times = np.array([one["time_usec"] for one in sent])
    assert np.median(np.diff(times)) == 200_000
    for one in sent[-200::50]:
        latitude, longitude = truth(one)
        start = separation(*PLACE, latitude, longitude)
        sigma = np.sqrt(one["pose_covariance"][0] + one["pose_covariance"][6])
        assert np.hypot(one["x"] - start[0], one["y"] - start[1]) < max(4.0 * sigma, 15.0)
    after = heard(silent)["ODOMETRY"]
    grown = [one["pose_covariance"][0] for one in after]
    assert grown == sorted(grown)
    assert 2.0 < (after[-1]["time_usec"] - times[-1]) * 1e-6 < 45.0


def test_the_same_events_give_the_same_fixes(folder: Path) -> None:
    assert run(folder, "ODOMETRY") == run(folder, "ODOMETRY")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"FIX"', '"TELEPATHY"', "navigation.fix: expected one of EXTERNAL_POSITION_ESTIMATE"),
        ("start_sigma", "start_sgma", "navigation.options.start_sgma: unknown key"),
    ],
)
def test_a_wrong_key_is_one_line(folder: Path, tmp_path: Path, old: str, new: str, line: str) -> None:
    path = folder / f"{tmp_path.name}.toml"
    path.write_text(CONFIG.replace(old, new).replace('"FIX"', '"ODOMETRY"'))
    with pytest.raises(ConfigError, match=re.escape(line)):
        set_up(load(path), Start(START))
