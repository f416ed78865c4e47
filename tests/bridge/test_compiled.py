"""Compiled and in plain Python, the bridge says and logs the same bytes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from magbridge import align

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import hashlib, sys
from pathlib import Path
from benchmarks.processor import Edge
from benchmarks.workload import BEGIN_US, Feed, write_config
from magbridge import align
from magbridge.bridge.drive import set_up
from magbridge.bridge.events import Start
from magbridge.config import load

pipeline = set_up(load(write_config(Path(sys.argv[1]))), Start(BEGIN_US))
digest, logged = hashlib.sha256(), []
for moving in (False, True):
    edge = Edge(list(Feed(moving=moving).events(20, 50, BEGIN_US + moving * 20_000_000)))
    for event in edge.events(lambda: 0):
        for time_us, frame in pipeline.feed(event):
            digest.update(time_us.to_bytes(8, "big") + frame)
        for time_us, channel, frame in pipeline.recorder.drain():
            digest.update((time_us | channel).to_bytes(8, "big") + frame)
print(align.__file__[-3:], digest.hexdigest(), pipeline.recorder.count)
"""


def outcome(folder: Path, *places: Path) -> list[str]:
    environment = {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(map(str, places))}
    command = [sys.executable, "-c", SCRIPT, str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.skipif(str(align.__file__).endswith(".py"), reason="nothing is compiled here")
def test_the_same_bytes_as_in_plain_python(tmp_path: Path) -> None:
    compiled = outcome(tmp_path, ROOT / "tools")
    plain = outcome(tmp_path, ROOT / "tools", ROOT)
    assert plain[0] == ".py" != compiled[0]
    assert compiled[1:] == plain[1:]
    assert int(plain[2]) > 4000
