"""Measured in a process of its own: what it takes at most is then of nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

__all__ = ["apart"]


def apart(script: str, *arguments: object) -> Any:
    """Run a script, which finds the arguments in ``sys.argv``; return what it prints as JSON."""
    command = [sys.executable, "-c", script, *map(str, arguments)]
    place = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
