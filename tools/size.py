"""Print lines and modules of each part of the project against its budget in tools/limits.toml.

    python tools/size.py          the table
    python tools/size.py --gate   the table, and exit code 1 where a part exceeds its ceiling

Standard library only.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / "tools" / "limits.toml"
GENERATED = "mavlink/dialect.py", "mavlink/enums.py"
"""Modules that tools/dialect.py writes; the budget is for code that people maintain."""


def count(folder: Path) -> tuple[int, int]:
    """Return lines and modules of the Python files of a folder."""
    paths = [path for path in folder.rglob("*.py") if not path.as_posix().endswith(GENERATED)]
    return sum(len(path.read_bytes().splitlines()) for path in paths), len(paths)


def parts(groups: dict[str, list[str]]) -> dict[str, tuple[int, int]]:
    """Return lines and modules of each part; the rest of ``magbridge`` is in the top level."""
    counts = {
        name: tuple(map(sum, zip(*(count(ROOT / folder) for folder in folders), strict=True)))
        for name, folders in groups.items()
    }
    counts["package"] = count(ROOT / "magbridge")
    named = [
        count(ROOT / folder) for folders in groups.values() for folder in folders if "magbridge/" in folder
    ]
    rest = [counts["package"][i] - sum(part[i] for part in named) for i in (0, 1)]
    top = counts["fleet, monitor, cli, top level"]
    counts["fleet, monitor, cli, top level"] = top[0] + rest[0], top[1] + rest[1]
    return {name: (lines, modules) for name, (lines, modules) in counts.items()}


def main() -> int:
    """Print the table; return the exit code."""
    limits = tomllib.loads(LIMITS.read_text(encoding="utf-8"))["size"]
    over = False
    print(f"{'part':34} {'lines':>7} {'budget':>7} {'excess':>7} {'modules':>8}")
    for name, (lines, modules) in parts(limits["folders"]).items():
        budget = limits["budget"][name]
        over |= lines > limits["ceiling"].get(name, budget)
        print(f"{name:34} {lines:7,} {budget:7,} {max(0, lines - budget):7,} {modules:8}")
    print(f"modules of the package: budget {limits['max_modules']}")
    return int(over and "--gate" in sys.argv)


if __name__ == "__main__":
    sys.exit(main())
