"""The learned calibration as a file: complete or unchanged, and never a reason not to fly."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from disks import full_disk
from turning import bridge, events, named, received

from magbridge.bridge.learning import LearningService, keep, kept_path
from magbridge.bridge.pipeline import Pipeline
from magbridge.calibration.file import calibration_id, load
from magbridge.config import load as load_config

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
    """Fly until something is learned; return the folder, the bridge and its learning."""
    pipeline, feed = bridge(tmp_path), iter(events(tmp_path))
    assert pipeline.learning is not None
    while not pipeline.learning.to_keep:
        pipeline.feed(next(feed))
    return tmp_path, pipeline, pipeline.learning


def test_it_is_kept_next_to_the_first(flown: Flown) -> None:
    """An ordinary calibration with its provenance; only changes are written."""
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


def test_killed_while_it_is_written_the_old_one_stays_and_the_first_flies(flown: Flown) -> None:
    """The next saved file removes the remains."""
    folder, _, learning = flown
    path, first = folder / "cal-learned.json", calibration_id(load(folder / "cal.json"))
    assert keep(learning, path) == ""
    before = path.read_bytes()
    command = [sys.executable, "-c", KILLED, str(folder / "cal.json"), str(path)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    (left,) = folder.glob(".cal-learned.*")
    assert left.stat().st_size > 0
    assert path.read_bytes() == before
    again = bridge(folder).learning
    assert again is not None
    assert calibration_id(again.learner.calibration) == first
    again.to_keep.append(learning.learner.calibration)
    assert keep(again, path) == ""
    assert not left.exists()


def test_one_that_somebody_cut_short_is_not_read(flown: Flown) -> None:
    """The bridge starts with its first calibration, and writes the learned one again."""
    folder, _, learning = flown
    path = folder / "cal-learned.json"
    path.write_text('{"format": "magbri', encoding="utf-8")
    again = bridge(folder).learning
    assert again is not None
    assert calibration_id(again.learner.calibration) == calibration_id(load(folder / "cal.json"))
    again.to_keep.append(learning.learner.calibration)
    assert keep(again, path) == ""
    assert calibration_id(load(path)) == calibration_id(learning.learner.calibration)
