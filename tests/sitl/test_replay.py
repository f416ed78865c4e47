"""Test replays, which send real bytes through a pty and a socket to the real bridge."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from magbridge.bridge.events import Event, StartEvent
from magbridge.calibration.file import save
from magbridge.calibration.model import Noise, identity
from magbridge.cli import bridge as commands
from magbridge.cli.common import FailedResult
from magbridge.config import load as load_config
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.errors import DataError, FormatError, PortError, WrongUse
from magbridge.field.geodesy import offset
from magbridge.logs import Options, read, write
from magbridge.mavlink import Codec, LogReader
from magbridge.records import Channel
from sitl import Twin, load, segments, simulate
from sitl.demo import demo
from sitl.replay.emulation import Autopilot, with_motion
from sitl.replay.listener import Listener
from sitl.replay.own_log import Recorded, is_own_log
from sitl.replay.run import replay, summary
from sitl.replay.setup import bridge_toml, short_names
from sitl.replay.stage import Stage


@pytest.fixture(scope="module")
def flown() -> xr.Dataset:
    """Return a simulated survey."""
    return segments(simulate(load("demo"), 3))["survey"]


@pytest.fixture(scope="module")
def survey(flown: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the first ten minutes of the simulated survey."""
    path = tmp_path_factory.mktemp("survey") / "survey.nc"
    write(flown.isel(time=slice(0, 150)), path)
    return path


@pytest.fixture(scope="module")
def recorded(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the configuration of a bridge that replayed the ten minutes, and its log."""
    folder = tmp_path_factory.mktemp("recorded")
    path = config(folder)
    replay([survey], path, log=folder / "logs")
    (log,) = (folder / "logs").glob("*.tlog")
    return path, log


def config(folder: Path, driver: str = "digitizer", options: str = "") -> Path:
    path = folder / "bridge.toml"
    text = bridge_toml({}, (), calibrated=False, log="logs")  # type: ignore[arg-type]
    if driver != "digitizer":
        begin, end = text.index("[sensor.options]"), text.index("[link]")
        text = text[:begin] + f"[sensor.options]\n{options}\n" + text[end:]
    path.write_text(text.replace('driver = "digitizer"', f'driver = "{driver}"'))
    return path


@pytest.mark.parametrize(
    ("driver", "options", "step"),
    [
        ("digitizer", "", 0.02),
        ("hmr2300", "", 6.7),
        ("twinleaf", "", 0.01),
        ("ascii", 'columns = ["time", "x", "y", "z"]', 0.001),
    ],
)
def test_every_instrument_s_protocol_arrives_whole(
    survey: Path, tmp_path: Path, driver: str, options: str, step: float
) -> None:
    """A ground station receives the measured raw field, to the resolution of the instrument."""
    result = replay([survey], config(tmp_path, driver, options))
    assert result["samples"] == result["rows"] == 150
    part = result["parts"][0]
    assert part["corrected_rms_nT"] == pytest.approx(part["raw_rms_nT"], abs=30 * step + 15)
    flags = result["flags"]
    # without a clock, a reading after a gap may have waited instead
    assert flags.pop("late_join", 0) <= (flags["gap"] if driver == "hmr2300" else 0)
    assert set(flags) <= {"uncalibrated", "no_boresight", "gap"}
    assert "no_boresight" in summary(result)
    assert any("sends readings" in text for text in result["said"])


def test_a_log_of_a_replay_is_replayed_bit_for_bit(
    survey: Path, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    path, log = recorded
    assert is_own_log(log)
    assert not is_own_log(survey)
    with pytest.raises(WrongUse, match="is a bridge's own log: it is read as it is"):
        replay([log], path, options=Options(strict=True))
    (run,) = replay([log], path, log=tmp_path / "again")["runs"]
    assert run["identical"]
    assert run["same_config"]
    assert run["messages"] > 450
    # and its own log is the same file
    (again,) = sorted((tmp_path / "again").glob("*.tlog"))
    first, second = Recorded([log]), Recorded([again])
    assert [event for event in first.events() if event.data] == [
        event for event in second.events() if event.data
    ]
    assert first.published == second.published


def test_a_log_that_breaks_off_is_the_same_as_far_as_it_goes_and_no_further(
    recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    """Cut between a reading and its messages, after them, and within the next record."""
    path, log = recorded
    whole, cut = log.read_bytes(), tmp_path / "cut.tlog"
    with log.open("rb") as file:
        records = list(LogReader(file))
    ends = np.cumsum([8 + len(record.frame) for record in records])
    assert ends[-1] == len(whole)
    channels = [record.channel for record in records]
    reading = channels.index(Channel.SENSOR, len(records) // 2)
    last = next(k for k in range(reading + 1, len(records)) if channels[k + 1] != Channel.SENT)
    for size, lacks in ((ends[reading], True), (ends[last], False), (ends[last] + 11, False)):
        cut.write_bytes(whole[:size])
        (run,) = replay([cut], path)["runs"]
        assert run["first_difference"] == (run["bytes"] if lacks else None)
        assert run["identical"] != lacks
        assert run["is_cut"] == lacks
        assert 0 < run["beyond"] < 1000 or not lacks
        assert ("to the end of the log" in summary({"runs": [run]})) == lacks
        if lacks:
            commands.replay(cut, config=path)  # without FailedResult


def test_another_configuration_is_distinguished(recorded: tuple[Path, Path], tmp_path: Path) -> None:
    path, log = recorded
    other = tmp_path / "bridge.toml"
    other.write_text(path.read_text().replace("HIGHRES_IMU = 0", "HIGHRES_IMU = -1"))
    result = replay([log], other)
    (run,) = result["runs"]
    assert not run["identical"]
    assert not run["same_config"]
    assert "not identical" in summary(result)
    with pytest.raises(FailedResult, match="other values than the log holds"):
        commands.replay(log, config=other)


@pytest.mark.parametrize("motion", ["glide", "position"])
def test_a_replay_finds_its_way_by_the_field(flown: xr.Dataset, tmp_path: Path, motion: str) -> None:
    """The bridge receives the motion in every form of telemetry: its filter has a start, and is not lost."""
    Twin.draw(load("demo"), 3).anomaly_map().save(tmp_path / "grid.nc")
    save(
        replace(identity(), covariance=1e-4 * np.eye(9), noise=Noise(1.0), method="nominal"),
        tmp_path / "c.json",
    )
    log = flown.isel(time=slice(0, 400))
    log = log.assign({f"mag_{axis}": log[f"truth_field_{axis}"] for axis in "xyz"})
    write(log if motion == "glide" else log.drop_vars("pitch"), tmp_path / "log.nc")
    path = config(tmp_path)
    tables = (
        '[calibration]\nfile = "c.json"\n[navigation]\nmap = "grid.nc"\nfix = "ODOMETRY"\ndepth = 140.0\n'
    )
    path.write_text(path.read_text() + tables)
    result = replay([tmp_path / "log.nc"], path)
    assert sum(result["navigation"].values()) > 50
    assert not {"off", "lost"} & set(result["navigation"])
    assert "position updates" in summary(result)


def test_a_velocity_is_sent_as_a_track() -> None:
    """Its integral: the same, to what trapezoids lose, as the track it was taken from."""
    time = np.arange(0.0, 400.0, 4.0)
    north, east = 200 * np.sin(time / 100), 150 * np.cos(time / 80)
    place = offset(49.5, -57.9, north, east)
    columns = dict(zip(("latitude", "longitude"), (("time", angle) for angle in place), strict=True))
    log = xr.Dataset(columns, {"time": time})
    rates = {
        "velocity_north": ("time", 2 * np.cos(time / 100)),
        "velocity_east": ("time", -1.875 * np.sin(time / 80)),
    }
    track, integral = with_motion(log), with_motion(log.assign(rates))
    for name in ("local_north", "local_east"):
        np.testing.assert_allclose(integral[name], track[name], atol=4.0)
    assert integral["gps_latitude"].to_numpy()[0] == log["latitude"].to_numpy()[0]
    assert np.isnan(integral["gps_latitude"].to_numpy()[1:]).all()


def test_a_position_of_any_turn_and_a_depth_that_is_none_are_reported(tmp_path: Path) -> None:
    row = {"latitude": 49.5, "longitude": 302.0, "depth": 1e300, "water_speed": 1e300}
    texts = Codec(255, 190).parse(b"".join(Autopilot(load_config(config(tmp_path)), 0).row(4, row)))
    (sent,) = [message for message in texts if message.name == "GLOBAL_POSITION_INT"]
    assert (sent["lat"], sent["lon"], sent["alt"]) == (495_000_000, -580_000_000, 0)
    assert [message.name for message in texts] == ["GLOBAL_POSITION_INT"]


def test_speed_is_kept(survey: Path, tmp_path: Path) -> None:
    """Ten minutes at 300 times real time take at least two seconds."""
    result = replay([survey], config(tmp_path), speed=300.0)
    assert result["seconds"] > 1.9


def test_a_bridge_s_own_log_needs_its_configuration(
    survey: Path, recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    path, log = recorded
    with pytest.raises(WrongUse, match="--config"):
        replay([log])
    for files in ([log, survey], [survey, log]):
        with pytest.raises(
            WrongUse, match=r"survey\.nc: cannot be replayed together with .*\.tlog, a bridge"
        ):
            replay(files, path)
    with pytest.raises(WrongUse, match=r"^\S*none\.toml: expected a file, there is none"):
        replay([log], tmp_path / "none.toml")


def test_a_log_that_does_not_begin_a_run_is_refused(recorded: tuple[Path, Path], tmp_path: Path) -> None:
    tail = tmp_path / "tail.tlog"
    tail.write_bytes(recorded[1].read_bytes()[2000:])
    with pytest.raises(FormatError, match=r"tail\.tlog: expected the log of a bridge, from its start"):
        Recorded([tail])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda ds: ds.isel(time=slice(0, 1)), "one row: at least 2 needed"),
        (lambda ds: ds.assign(mag_y=ds["mag_y"] * np.nan), "no row holds a reading of all three channels"),
        (lambda ds: ds.drop_vars("mag_z"), "column 'mag_z': expected this column"),
    ],
)
def test_a_log_of_which_nothing_comes_is_one_line(
    spoil: Callable[[xr.Dataset], xr.Dataset], words: str, survey: Path, tmp_path: Path
) -> None:
    write(spoil(read(survey)), tmp_path / "bad.nc")
    with pytest.raises(DataError, match=words):
        replay([tmp_path / "bad.nc"], config(tmp_path))


def test_a_bridge_that_cannot_start_says_why(survey: Path, tmp_path: Path) -> None:
    path = config(tmp_path)
    path.write_text(path.read_text().replace("MAG_RAW = 0", "MAG_RAW = 0\nNO_SUCH = 1"))
    with pytest.raises(WrongUse, match=r"^\S*bridge\.toml: publish\.NO_SUCH"):
        replay([survey], path)


def test_a_bridge_that_ends_before_it_connects_says_why_at_once(tmp_path: Path) -> None:
    begun = time.monotonic()
    with pytest.raises(WrongUse, match=r"none\.toml: expected a file, there is none"):
        Stage(tmp_path / "none.toml", bytearray().extend)
    assert time.monotonic() - begun < 15.0  # it waits for a connection for 30 s


def lines(count: int) -> Event:
    """Return the lines of a number of readings, received at once."""
    return Event(1_700_000_000_000_000, Channel.SENSOR, b"20000 1000 40000\n" * count)


def test_more_than_a_pty_holds_is_read_at_once(tmp_path: Path) -> None:
    """A bridge that was stopped for a while has a backlog in its line, as a replay of its log has."""
    received = Listener()
    stage = Stage(config(tmp_path, "ascii", 'columns = ["x", "y", "z"]'), received.receive)
    stage.play(StartEvent(1_700_000_000_000_000), [lines(4000)])
    assert received.counts["MAG_FIELD"] == 4000


def test_a_bridge_that_dies_does_not_block_the_replay(tmp_path: Path) -> None:
    stage = Stage(config(tmp_path, "ascii", 'columns = ["x", "y", "z"]'), bytearray().extend)
    (bridge,) = map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())

    def events() -> Iterator[Event]:
        yield lines(1)
        os.kill(bridge, signal.SIGKILL)
        yield lines(4000)

    with pytest.raises(PortError, match="the bridge ended with -9"):
        stage.play(StartEvent(1_700_000_000_000_000), events())


def test_a_value_that_its_message_cannot_hold_ends_the_replay(survey: Path, tmp_path: Path) -> None:
    """The bridge detects the end of the input, and ends, too."""
    path = config(tmp_path)
    table = '[telemetry.battpos]\nmessage = "SERVO_OUTPUT_RAW"\nfield = "servo1_raw"\nscale = 1e-9\n'
    path.write_text(path.read_text() + table)
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    before = children.read_text()
    with pytest.raises(DataError, match=r"does not fit SERVO_OUTPUT_RAW\.servo1_raw"):
        replay([survey], path)
    assert children.read_text() == before


def test_short_names_differ() -> None:
    names = short_names(["pitch_current_a", "pitch_current_b", "roll"])
    assert list(names.values()) == ["pitch_curr", "pitch_0000", "roll"]


def test_the_demonstration_shows_what_calibration_is_worth(tmp_path: Path) -> None:
    texts: list[str] = []
    result = demo(tmp_path / "demo", seed=2, notify=texts.append)
    assert result["raw_rms_nT"] > 1000.0 > result["nominal_rms_nT"] > 5 * result["unflagged_rms_nT"]
    assert result["unflagged_rms_nT"] < 5.0
    assert 0.8 < result["unflagged_rms_nT"] / result["unflagged_sigma_nT"] < 1.25
    assert all(Path(file).exists() for file in result["files"])
    assert len(texts) == 5


def test_a_log_of_few_samples_is_not_a_silent_sensor(flown: xr.Dataset, tmp_path: Path) -> None:
    """Seagliders sample every 20 s: at the bridge's 10 s their sensor would fall silent after each."""
    write(flown.isel(time=slice(0, None, 5)), tmp_path / "log.nc")
    result = replay([tmp_path / "log.nc"])
    assert result["samples"] > 200
    assert not any("silent" in texts for texts in result["said"])


@pytest.mark.real
def test_measured_counts_and_moving_masses_go_through(real_data: Path) -> None:
    """Seaglider 167: the dive that was left out of the fit is right to about one count (100 nT).

    Its sigma includes the mean crustal field, which the IGRF does not have.
    """
    result = replay(sorted((real_data / "seaglider_sg167").glob("*.nc")))
    last = result["parts"][-1]
    assert last["held_out"]
    assert result["samples"] == result["rows"] == 6740
    assert 50.0 < last["corrected_rms_nT"] < 110.0 < 1000.0 < last["raw_rms_nT"]
    assert np.isclose(last["sigma_nT"], np.hypot(last["corrected_rms_nT"], MAIN_FIELD_SIGMA_NT), rtol=0.25)


@pytest.mark.real
def test_a_damaged_log_is_read_to_its_end(real_data: Path) -> None:
    result = replay([real_data / "ardusub" / "damaged.tlog"])
    assert result["samples"] == 627
    assert result["skipped"]["damages"] > 1000
    assert "uncalibrated" in result["flags"]


@pytest.mark.real
def test_real_telemetry_with_a_simulated_field(real_data: Path) -> None:
    pytest.importorskip("dbdreader", reason="Slocum logs need the extra 'formats'")
    result = replay(sorted((real_data / "slocum_comet").glob("*-00[0-2].[de]bd")))
    assert result["simulated_field"]
    assert result["parts"][-1]["corrected_rms_nT"] < 0.1 * result["parts"][-1]["raw_rms_nT"]


def test_a_log_can_be_calibrated_from_whatever_was_published(survey: Path, tmp_path: Path) -> None:
    """Raw readings stand in the log even where MAG_RAW is switched off, and a replay of it is the same."""
    path = config(tmp_path)
    path.write_text(path.read_text().replace("MAG_RAW = 0", "MAG_RAW = -1"))
    replay([survey], path, log=tmp_path / "logs")
    logs = sorted((tmp_path / "logs").glob("*.tlog"))
    raw, truth = read(logs), read(survey)
    assert raw.sizes["time"] == 150
    np.testing.assert_allclose(raw["mag_x"], truth["mag_x"], atol=0.02)
    assert replay(logs, path)["runs"][0]["identical"]
