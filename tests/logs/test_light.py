"""What must not be there: directories in the user's home, tracebacks for a missing extra."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest


def run(script: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_slocum_leaves_the_home_alone(tmp_path: Path) -> None:
    pytest.importorskip("dbdreader")
    assert run("import os, magbridge.logs.slocum; print(os.environ['HOME'])", HOME=str(tmp_path)) == str(
        tmp_path
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("suffix", "package", "extra"),
    [
        (".parquet", "pyarrow", "formats"),
        (".ulg", "pyulog", "formats"),
        (".dbd", "dbdreader", "formats"),
        (".nc", "netCDF4", "analysis"),
        (".mcap", "rosbags", "ros"),
    ],
)
def test_a_missing_extra_is_named(suffix: str, package: str, extra: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(b"x")
    script = f"""
import sys
sys.modules[{package!r}] = None
from magbridge import logs
from magbridge.errors import MissingExtra
try:
    logs.read({str(path)!r})
except MissingExtra as error:
    print(error)
"""
    assert re.fullmatch(rf"{package} is not installed: pip install '.+\[{extra}\]'", run(script))


def test_a_package_can_bring_a_format(tmp_path: Path) -> None:
    """An entry point: the suffix, and a module with ``chunks``."""
    info = tmp_path / "other-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[magbridge.formats]\nother = other_format\n")
    (tmp_path / "other_format.py").write_text(
        "from magbridge.logs.deployment import deployment\n"
        "def chunks(path, rows):\n    yield deployment(path, [1.0], {'mag_x': [float(path.read_text())]})\n"
    )
    (tmp_path / "log.other").write_text("5")
    script = f"from magbridge import logs; print(logs.read({str(tmp_path / 'log.other')!r})['mag_x'].item())"
    assert run(script, PYTHONPATH=str(tmp_path)) == "5.0"
