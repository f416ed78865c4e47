"""Check that two processes collect the same tests in the same order.

    python tools/collection.py

pytest-xdist's workers collect independently. If an identifier depends on the time, on random numbers or on
the order of a set, the run ends before the first test. The two collections start some seconds after each
other and use different hash seeds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from difflib import unified_diff

PAUSE_S = 3.0
"""Time between the two collections, s: longer than the resolution of a time stamp in an archive."""


def collect(seed: str) -> list[str]:
    """Return the identifiers of all tests, collected by a process with the given hash seed."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONHASHSEED": seed}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stdout[-4000:] + done.stderr[-4000:])
    return [line for line in done.stdout.splitlines() if "::" in line]


def main() -> None:
    """Collect the tests twice; exit with the differences if the two collections differ."""
    first = collect("1")
    time.sleep(PAUSE_S)
    second = collect("2")
    if first != second:
        print(*unified_diff(first, second, "first", "second", lineterm="", n=0), sep="\n")
        sys.exit("the tests' identifiers differ between two processes: give the parameters ids")
    print(f"{len(first)} tests, the same in both collections")


if __name__ == "__main__":
    main()
