"""Test ``[learning]``: messages to a station, and equal results live, in a replay and offline."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from fed import logged, named, received
from machine import full_disk
from small import ASCII_OPTIONS, START, polynomial, write_bridge

from magbridge import logs
from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.learning import LearningService, keep, kept_path
from magbridge.bridge.pipeline import Pipeline, set_up
from magbridge.calibration.file import calibration_id, load
from magbridge.config import load as load_config
from magbridge.learning.alarms import CAUSE_UNITS
from magbridge.mavlink import Codec, Message
from magbridge.mavlink.enums import MAG_CAUSE, MAG_LEARNING_STATE, MAV_PARAM_TYPE
from magbridge.records import Channel, Quality

PLACE = (49.52, -57.87)
SAMPLES = 700
COUNT = 1.0 / 64.0
"""Resolution of a reading, nT."""
SHIFT = np.array([14.0, -11.0, 13.0])
LEARNING = "[learning]\nenabled = true\n"


def bridge(folder: Path, learning: str = LEARNING, *, known: bool = True) -> Pipeline:
    """Set up a bridge with a nominal calibration (1 nT, 1-sigma), or without a calibration if not `known`."""
    coefficients = np.random.default_rng(1).normal(size=9) * 100.0
    config = write_bridge(
        folder,
        polynomial(coefficients, field_nt=51_900.0, method="nominal"),
        options=f'unit = "counts", scale = {COUNT}, {ASCII_OPTIONS}',
        masses={},
        calibration=known,
        publish={"MAG_FIELD": 0},
        more=learning,
    )
    return set_up(load_config(config), StartEvent(START))


def events(folder: Path) -> list[Event]:
    """Return the events of a vehicle that turns and pitches, whose offset differs from its calibration."""
    rng, autopilot = np.random.default_rng(2), Codec(1, 1)
    cal = load(folder / "cal.json")
    A, T = (one[0] for one in cal.matrices(np.empty((1, 0))))
    made = []
    for k in range(SAMPLES):
        time_us = START + k * 4_000_000
        place = {"lat": round(PLACE[0] * 1e7) + k * 120, "lon": round(PLACE[1] * 1e7)}
        frame = autopilot.pack("GLOBAL_POSITION_INT", time_boot_ms=k * 4000, **place)
        made.append(Event(time_us - 400_000, Channel.LINK, frame))
        yaw = 0.7 * (k // 40) + 0.1 * rng.normal()
        pitch = (0.45 if k // 40 % 2 else -0.4) + 0.05 * rng.normal()
        unit = np.array([0.4 * np.cos(yaw) - 0.9 * pitch, 0.4 * np.sin(yaw), 0.9 + 0.4 * pitch * np.cos(yaw)])
        total = 51_900.0 + 40.0 * np.sin(k / 400.0)
        x, y, z = np.linalg.solve(A, total * unit / np.linalg.norm(unit)) + T + SHIFT + rng.normal(size=3)
        counts = (round(x / COUNT), round(y / COUNT), round(z / COUNT))
        made.append(Event(time_us, Channel.SENSOR, b"%d %d %d 4.0 %d 7\r\n" % (*counts, k)))
    return made


Flight = tuple[Path, Pipeline, list[tuple[int, bytes]]]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Simulate a flight once, with a log."""
    folder = tmp_path_factory.mktemp("flight")
    pipeline = bridge(folder)
    return folder, pipeline, logged(pipeline, events(folder), folder / "logs")


def test_what_was_learned_is_announced_and_named_in_every_message(flight: Flight) -> None:
    """The id in MAG_FIELD and MAG_STATUS changes when the bridge publishes the learned calibration."""
    folder, pipeline, sent = flight
    messages = received(sent)
    first = calibration_id(load(folder / "cal.json"))
    assert pipeline.learning is not None
    last = calibration_id(pipeline.learning.learner.calibration)
    fields = named(messages, "MAG_FIELD")
    assert fields[0]["calibration_id"] == first
    assert fields[-1]["calibration_id"] == last != first
    assert named(messages, "MAG_STATUS")[-1]["calibration_id"] == last
    state = named(messages, "MAG_LEARNING")[-1]
    assert (state["first_calibration_id"], state["calibration_id"]) == (first, last)
    assert state["state"] == MAG_LEARNING_STATE.LEARNED
    assert state["rms_learned"] < state["rms_first"]
    assert state["samples"] > 300
    assert any(message["text"].startswith("learned ") for message in named(messages, "STATUSTEXT"))


def test_ashore_it_learns_what_it_learned_live(flight: Flight, command: Command) -> None:
    """Offline, the bridge's own log gives the same calibration bit for bit."""
    folder, pipeline, sent = flight
    out, learned = folder / "out.nc", folder / "learned.json"
    log = sorted((folder / "logs").iterdir())
    order = ["correct", *log, "--calibration", folder / "cal.json", "-o", out]
    assert "learned from" in command(*order, "--learn", "--save", learned).out
    total = logs.read(out)["total_field"].to_numpy()
    live = np.array([message["total_field"] for message in named(received(sent), "MAG_FIELD")])
    np.testing.assert_array_equal(total, live)
    assert pipeline.learning is not None
    kept = load(learned)
    np.testing.assert_array_equal(kept.coefficients, pipeline.learning.learner.calibration.coefficients)


@pytest.mark.parametrize(("command", "accepts"), [(1.0, True), (2.0, False)])
def test_a_station_accepts_or_forgets_freezes_and_disables(
    tmp_path: Path, command: float, *, accepts: bool
) -> None:
    """The command parameter returns to 0; the bridge no longer publishes a discarded calibration."""
    pipeline = bridge(tmp_path)
    station = Codec(255, 190)
    to = {"target_system": 1, "target_component": 191, "param_type": MAV_PARAM_TYPE.REAL32}
    feed = events(tmp_path)
    now = 1300
    for event in feed[:now]:
        pipeline.feed(event)
    assert pipeline.learning is not None
    learner = pipeline.learning.learner
    initial = learner.first
    assert learner.calibration is not initial
    beat = station.pack("HEARTBEAT", type=6, autopilot=8, mavlink_version=3)
    pipeline.feed(Event(feed[now].time_us, Channel.LINK, beat))

    def order(name: str, value: float) -> list[Message]:
        frame = station.pack("PARAM_SET", param_id=name, param_value=value, **to)
        return received(pipeline.feed(Event(feed[now].time_us + 1, Channel.LINK, frame)))

    answer = named(order("MB_LEARN_CMD", command), "PARAM_VALUE")[-1]
    assert (answer["param_id"], answer["param_value"]) == ("MB_LEARN_CMD", 0.0)
    assert learner.calibration is learner.first
    samples = learner.samples
    assert (learner.first is not initial, samples > 0) == (accepts, accepts)
    order("MB_LEARN_FREEZE", 1.0)
    for event in feed[now + 2 :]:
        pipeline.feed(event)
    assert learner.samples == samples
    assert learner.frozen
    order("MB_LEARN", 0.0)
    assert not learner.enabled


def test_the_causes_bits_are_those_of_the_dialect() -> None:
    """The bits of the causes have the order of the dialect's enumeration."""
    assert [str(cause.name).lower() for cause in MAG_CAUSE] == list(CAUSE_UNITS)


def test_from_nothing_live_and_ashore(tmp_path: Path, command: Command) -> None:
    """Without a calibration, the field is flagged until one is published; the log reproduces this."""
    sent = logged(bridge(tmp_path, known=False), events(tmp_path), tmp_path / "logs")
    fields = named(received(sent), "MAG_FIELD")
    assert int(fields[0]["flags"]) & Quality.UNCALIBRATED
    assert fields[0]["total_field_sigma"] > 1000.0
    assert not int(fields[-1]["flags"]) & Quality.UNCALIBRATED
    assert fields[-1]["total_field_sigma"] < 500.0  # includes the unobservable level
    assert abs(fields[-1]["total_field"] - 51_900.0) < 2.0 * fields[-1]["total_field_sigma"]
    assert np.std([one["total_field"] for one in fields[-100:]]) < 15.0
    out, log_file = tmp_path / "out.nc", sorted((tmp_path / "logs").iterdir())
    command("correct", *log_file, "--learn", "--config", "bridge.toml", "-o", out)
    live = np.array([one["total_field"] for one in fields])
    np.testing.assert_array_equal(logs.read(out)["total_field"].to_numpy(), live)
    assert kept_path(load_config(tmp_path / "bridge.toml")) == tmp_path / "cal-learned.json"


THREADS = """
import sys
from threadpoolctl import threadpool_info
from magbridge.__main__ import main
main(sys.argv[1:])
import numpy
print({one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"})
"""


@pytest.mark.parametrize("name", ["run", "replay", "correct"])
def test_the_same_bytes_on_another_number_of_cores(name: str) -> None:
    """Linear algebra uses one thread while samples are processed: several threads round differently."""
    free = {key: value for key, value in os.environ.items() if "NUM_THREADS" not in key}
    command = [sys.executable, "-c", THREADS, name, "nowhere.toml"]
    reported = subprocess.run(command, env=free, capture_output=True, text=True, check=True).stdout
    assert reported.splitlines()[-1] == "{1}"


# ---- the learned calibration as a file ---------------------------------------------------------------------


KILLED = """
import os, signal, sys
from pathlib import Path
from magbridge.calibration.file import load, save

def half(path, data, write=Path.write_bytes):
    write(path, data[: len(data) // 2])
    os.kill(os.getpid(), signal.SIGKILL)

learned = load(sys.argv[1])
Path.write_bytes = half
save(learned, sys.argv[2])
"""
Flown = tuple[Path, Pipeline, LearningService]


@pytest.fixture
def flown(tmp_path: Path) -> Flown:
    """Simulate a flight until a calibration is published; return the folder, the bridge and its learner."""
    pipeline, feed = bridge(tmp_path), iter(events(tmp_path))
    assert pipeline.learning is not None
    while not pipeline.learning.to_keep:
        pipeline.feed(next(feed))
    return tmp_path, pipeline, pipeline.learning


def test_it_is_kept_next_to_the_first(flown: Flown) -> None:
    """The file is an ordinary calibration with its provenance; the bridge writes it only after changes."""
    folder, _, learning = flown
    path = kept_path(load_config(folder / "bridge.toml"))
    assert path == folder / "cal-learned.json"
    assert keep(learning, path) == ""
    kept = load(path)
    assert calibration_id(kept) == calibration_id(learning.learner.calibration)
    assert any(name.startswith("calibration ") for name in kept.inputs)
    path.unlink()
    assert keep(learning, path) == ""
    assert not path.exists()


@pytest.mark.parametrize(("to", "why"), [("", "File too large"), ("nowhere/", "No such file or directory")])
def test_a_disk_that_does_not_take_it_leaves_the_old_one(flown: Flown, to: str, why: str) -> None:
    """The learned calibration is published anyway, and the reason fits into one STATUSTEXT."""
    folder, pipeline, learning = flown
    path = folder / "cal-learned.json"
    path.write_bytes(before := (folder / "cal.json").read_bytes())
    names = {one.name for one in folder.iterdir()}
    with full_disk(64):
        reported = keep(learning, folder / f"{to}cal-learned.json")
    assert reported == f"learned, but not kept: {why}"
    assert len(reported) <= 50
    assert path.read_bytes() == before
    assert {one.name for one in folder.iterdir()} == names
    sent = [frame for event in events(folder)[-2:] for frame in pipeline.feed(event)]
    learned = calibration_id(learning.learner.calibration)
    assert named(received(sent), "MAG_FIELD")[-1]["calibration_id"] == learned


def kept_after_restart(folder: Path, learning: LearningService) -> None:
    """Restart the bridge, which starts with its first calibration; keep what the other one learned."""
    again = bridge(folder).learning
    assert again is not None
    assert calibration_id(again.learner.calibration) == calibration_id(load(folder / "cal.json"))
    again.to_keep.append(learning.learner.calibration)
    assert keep(again, folder / "cal-learned.json") == ""


def test_killed_while_it_is_written_the_old_one_stays_and_the_first_flies(flown: Flown) -> None:
    """The next write of the file removes the remains of the interrupted write."""
    folder, _, learning = flown
    path = folder / "cal-learned.json"
    assert keep(learning, path) == ""
    before = path.read_bytes()
    command = [sys.executable, "-c", KILLED, str(folder / "cal.json"), str(path)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    (left,) = folder.glob(".cal-learned.*")
    assert left.stat().st_size > 0
    assert path.read_bytes() == before
    kept_after_restart(folder, learning)
    assert not left.exists()
