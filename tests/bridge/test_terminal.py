"""What somebody sees who starts a bridge by hand."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from pathlib import Path

CONFIG = """
[sensor]
driver = "hmr2300"
port = "ttyNone"
[link]
url = "udpout:127.0.0.1:9"
"""


def test_a_terminal_is_told_what_the_link_is(tmp_path: Path) -> None:
    (tmp_path / "bridge.toml").write_text(CONFIG)
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "magbridge", "run", "--config", "bridge.toml"], cwd=tmp_path, stderr=theirs
    )
    os.close(theirs)
    os.set_blocking(ours, False)
    seen, wanted = (
        "",
        ("until Ctrl-C", "no calibration: raw field", "hmr2300 lost: No such file or directory"),
    )
    deadline = time.monotonic() + 15.0
    try:
        while not all(words in seen for words in wanted) and time.monotonic() < deadline:
            time.sleep(0.05)
            try:
                seen += os.read(ours, 4096).decode()
            except BlockingIOError:
                continue
        assert [words for words in wanted if words not in seen] == []
    finally:
        process.terminate()
        assert process.wait(10.0) == 0
        os.close(ours)
