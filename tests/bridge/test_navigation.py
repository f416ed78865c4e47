"""Test live navigation: fixes from telemetry and samples, in the message that the autopilot uses."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from math import radians
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from fed import fed, named, received, texts
from passages import PLACE, hills
from small import bridge_text

from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.pipeline import Pipeline, set_up
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
SPEED, HEADING, OFF, DEPTH = 0.5, 60.0, 150.0, 1.0
PLACE_E7 = {"lat": round(PLACE[0] * 1e7), "lon": round(PLACE[1] * 1e7)}
ORIGIN, ORIGIN_ALTITUDE = (49.51, -57.93), 12.0
"""Origin of the autopilot's local frame (deg, deg, m), on a hill near the water."""
QUATERNION = (0.8487626, 0.0993347, -0.1720527, 0.4900333)
"""Attitude with a yaw of 60 deg and a pitch of -0.4 rad."""
SENSOR = {"sensitivity": 5e-5, "reference_voltage": 5.0}
CONFIG = bridge_text(
    "digitizer",
    "sensitivity = 5e-5, reference_voltage = 5.0",
    masses={},
    log=False,
    more="""
[navigation]
map = "grid.nc"
fix = "FIX"
options = {start_sigma = 200.0, current_sigma = 0.02, bias_sigma = 1.0, interval = 10.0}
""",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a map (hills of 80 to 300 m and 37 nT) and a calibration that changes nothing."""
    path = tmp_path_factory.mktemp("navigation")
    perfect = replace(identity(), covariance=1e-4 * np.eye(9), noise=Noise(1.0), method="nominal")
    save(perfect, path / "cal.json")
    hills().save(path / "grid.nc")
    return path


@cache
def events(folder: Path) -> tuple[Event, ...]:
    """Return the events of a glider on one heading for an hour, with dead reckoning wrong by 150 m."""
    return tuple(glide(read_grid(folder / "grid.nc")))


def glide(grid: AnomalyGrid) -> Iterator[Event]:
    autopilot, fluxgate = Codec(1, 1), open_encoder("digitizer", SENSOR)
    origin = offset(*PLACE, OFF, -OFF)  # where it is; it believes to be at PLACE
    fix = {**PLACE_E7, "fix_type": 3, "h_acc": 200_000}
    origin_e7 = {"latitude": round(ORIGIN[0] * 1e7), "longitude": round(ORIGIN[1] * 1e7)}
    data = autopilot.pack("GPS_GLOBAL_ORIGIN", altitude=round(1e3 * ORIGIN_ALTITUDE), **origin_e7)
    yield Event(START + 4, Channel.LINK, data + autopilot.pack("GPS_RAW_INT", **fix))
    ahead = SPEED * 4.0 * np.arange(1, 901)
    course = radians(HEADING)
    places = np.array([offset(*origin, along * np.cos(course), along * np.sin(course)) for along in ahead])
    times = START * 1e-6 + 4.0 * np.arange(1, 901)
    main = total_field(places[:, 1], places[:, 0], 0.0, times).tolist()
    for k, (latitude, longitude) in enumerate(places.tolist(), 1):
        time_us = START + 4_000_000 * k
        data = autopilot.pack("ATTITUDE", yaw=radians(HEADING), pitch=-0.4)
        data += autopilot.pack("VFR_HUD", airspeed=SPEED)
        data += autopilot.pack("GLOBAL_POSITION_INT", **PLACE_E7, alt=round(-1e3 * DEPTH))
        yield Event(time_us, Channel.LINK, data)
        total = main[k - 1] + grid.look_up(longitude, latitude).anomaly
        field = (0.4 * total, 0.3 * total, float(np.sqrt(0.75)) * total)
        yield Event(time_us + 2000, Channel.SENSOR, fluxgate.encode(Reading(field, device_time=4.0 * k)))


def bridge(folder: Path, fix: str) -> Pipeline:
    path = folder / f"{fix}.toml"
    path.write_text(CONFIG.replace("FIX", fix))
    return set_up(load(path), StartEvent(START))


def frames(pipeline: Pipeline, given: Iterable[Event]) -> list[tuple[int, bytes]]:
    return [sent for event in given for sent in pipeline.feed(event)]


def where(time_us: int) -> tuple[float, float]:
    """Return the true position of the vehicle at a time."""
    along = SPEED * (time_us - START) * 1e-6
    start = offset(*PLACE, OFF, -OFF)
    return offset(*start, along * np.cos(radians(HEADING)), along * np.sin(radians(HEADING)))


MESSAGES = {
    "EXTERNAL_POSITION_ESTIMATE": "COMMAND_INT",
    "GLOBAL_POSITION_SENSOR": "GLOBAL_POSITION_SENSOR",
    "ODOMETRY": "ODOMETRY",
}


class Sailed(NamedTuple):
    """Result of a run: the kind of fix, the bridge, its frames with their times, and its fixes."""

    kind: str
    pipeline: Pipeline
    sent: list[tuple[int, bytes]]
    fixes: list[Message]


@pytest.fixture(scope="module", params=MESSAGES)
def sailed(request: pytest.FixtureRequest, folder: Path) -> Sailed:
    pipeline = bridge(folder, request.param)
    sent = frames(pipeline, events(folder))
    return Sailed(request.param, pipeline, sent, named(received(sent), MESSAGES[request.param]))


def test_a_fix_says_where_the_vehicle_is_when_it_is_sent(sailed: Sailed) -> None:
    """Each decoded fix is within its sigma of the truth, in the frame of its message."""
    kind, _, sent, fixes = sailed
    last = named(received(sent), "MAG_NAVIGATION")[-1]
    honest = np.sqrt(0.5 * (last["covariance_nn"] + last["covariance_ee"]))
    assert len(fixes) > 50
    for fix in fixes[-40::8]:
        when_us = next(time_us for time_us, frame in sent if frame == fix.frame)
        north, east = separation(*PLACE, *where(when_us))
        if kind == "ODOMETRY":
            x, y = separation(*PLACE, *ORIGIN)
            got = fix["x"] + x, fix["y"] + y
            assert fix["z"] == pytest.approx(ORIGIN_ALTITUDE + DEPTH), "down from the origin"
            assert fix["q"] == pytest.approx(QUATERNION, abs=1e-6)
            covariance = fix["pose_covariance"]
            claimed = np.sqrt([covariance[0], covariance[6]])
        elif kind == "GLOBAL_POSITION_SENSOR":
            got = separation(*PLACE, fix["lat"] * 1e-7, fix["lon"] * 1e-7)
            assert fix["alt"] == pytest.approx(-DEPTH)
            claimed = np.array([fix["eph"]])
        else:
            got = separation(*PLACE, fix["x"] * 1e-7, fix["y"] * 1e-7)
            assert fix["param1"] == pytest.approx(when_us * 1e-6 % 1e5, abs=0.01)
            claimed = np.array([fix["param3"]])
        if kind != "EXTERNAL_POSITION_ESTIMATE":
            assert fix["time_usec"] == when_us
        if kind != "ODOMETRY":
            assert (fix["target_system"], fix["target_component"]) == (1, 1)
        assert np.hypot(got[0] - north, got[1] - east) < 4.0 * honest + 5.0
        assert (claimed > 0.5 * honest).all()
        if kind == "EXTERNAL_POSITION_ESTIMATE":
            # it replaces what the autopilot claims: no wider than it is
            assert (claimed < 2.0 * honest).all()


def test_no_fix_before_the_position_is_valid(sailed: Sailed) -> None:
    _, _, sent, fixes = sailed
    messages = received(sent)
    tracking = next(one for one in named(messages, "MAG_NAVIGATION") if one["state"] == TRACKING)["time_usec"]
    first_us = next(time_us for time_us, frame in sent if frame == fixes[0].frame)
    assert first_us > tracking
    reported = texts(messages)
    assert any(text.startswith("navigation: tracking") for text in reported)
    assert [text for text in reported if "fixes" in text][:3] == [
        "no fixes to the autopilot: GPS is good",
        "no fixes to the autopilot: no valid position",
        "fixes go to the autopilot: GPS is lost",
    ]


def test_odometry_goes_on_between_updates(sailed: Sailed, folder: Path) -> None:
    """The bridge sends ODOMETRY at 5 Hz with a growing uncertainty, until the field ends."""
    if sailed.kind != "ODOMETRY":
        pytest.skip("the others go out with each update")
    times = np.array([one["time_usec"] for one in sailed.fixes])
    assert np.median(np.diff(times)) == 200_000
    beat = Codec(1, 1).pack("ATTITUDE") + Codec(1, 1).pack("GLOBAL_POSITION_INT", **PLACE_E7, alt=-1000)
    last_us = events(folder)[-1].time_us
    silence = [Event(last_us + 200_000 * k, Channel.LINK, beat) for k in range(600)]
    after = named(fed(sailed.pipeline, *silence), "ODOMETRY")
    grown = [one["pose_covariance"][0] for one in after]
    assert grown == sorted(grown)
    assert 2.0 < (after[-1]["time_usec"] - times[-1]) * 1e-6 < 45.0


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"FIX"', '"TELEPATHY"', "navigation.fix: expected one of EXTERNAL_POSITION_ESTIMATE"),
        ("options = {start", "rate = 2\noptions = {start", "navigation.rate: expected at least 4 Hz"),
        ("start_sigma", "start_sgma", "navigation.options.start_sgma: unknown key"),
    ],
)
def test_a_wrong_key_is_one_line(folder: Path, tmp_path: Path, old: str, new: str, line: str) -> None:
    path = folder / f"{tmp_path.name}.toml"
    path.write_text(CONFIG.replace(old, new).replace('"FIX"', '"ODOMETRY"'))
    with pytest.raises(ConfigError, match=re.escape(line)):
        set_up(load(path), StartEvent(START))
