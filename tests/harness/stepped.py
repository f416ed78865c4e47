"""Run magbridge with a host clock that a test can set: ``stepped.py OFFSET_FILE ARGUMENT...``.

The program is unmodified, except that ``time.time_ns`` and ``time.time`` return the host's UTC plus the
microseconds in a file. (A time namespace shifts only the monotonic clocks, and a change of the host's
clock would affect all its processes.)
"""

import sys
import time
from pathlib import Path

offset = Path(sys.argv.pop(1))
host = time.time_ns
time.time_ns = lambda: host() + 1000 * int(offset.read_text())
time.time = lambda: time.time_ns() * 1e-9

from magbridge.cli import main  # noqa: E402 - replace the clock first

sys.exit(main())
