"""Measuring: in a process of its own, whose peak memory is of nothing else; and processor time."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["in_own_process", "processor_time"]


def in_own_process(script: str, *arguments: object) -> Any:
    """Run a script, which finds the arguments in ``sys.argv``; return its output as JSON, if anything."""
    command = [sys.executable, "-c", script, *map(str, arguments)]
    place = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    return json.loads(done.stdout or "null")


def processor_time(work: Callable[[], object]) -> float:
    """Return the processor time, in s, that `work` takes in all threads."""
    begun = time.process_time()
    work()
    return time.process_time() - begun
