"""Print lines and modules of each part of the project against its budget in tools/limits.toml.

    python tools/size.py             the table
    python tools/size.py --gate      also code and comments of each numerical package, and exit code 1 where a
                                     part exceeds its ceiling or has too few comments

Standard library only.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / "tools" / "limits.toml"
GENERATED = "mavlink/enums.py"
"""Module that tools/dialect.py writes; it does not count."""

NUMERICAL = "estimation", "calibration", "diagnose", "learning", "health", "survey", "field", "navigate"
"""Packages with a required number of comments, because readers must relate lines to equations."""
INSTRUCTIONS = "# noqa", "# fmt:", "# type:", "# pragma", "# ruff"


def count(folder: Path) -> tuple[int, int]:
    """Return the numbers of lines and modules of the Python files in a folder."""
    paths = [path for path in folder.rglob("*.py") if not path.as_posix().endswith(GENERATED)]
    return sum(len(path.read_bytes().splitlines()) for path in paths), len(paths)


def length(path: str) -> int:
    """Return the number of lines of a file, whose path is relative to the project's root."""
    return len((ROOT / path).read_bytes().splitlines())


def parts(groups: dict[str, list[str]]) -> dict[str, tuple[int, int]]:
    """Return lines and modules of each part; modules of ``magbridge`` in no other part count as top level."""
    counts = {
        name: tuple(map(sum, zip(*(count(ROOT / folder) for folder in folders), strict=True)))
        for name, folders in groups.items()
    }
    counts["package"] = count(ROOT / "magbridge")
    inside = [folder for folders in groups.values() for folder in folders if "magbridge/" in folder]
    named = [count(ROOT / folder) for folder in inside]
    rest = [counts["package"][i] - sum(part[i] for part in named) for i in (0, 1)]
    top = counts["fleet, monitor, cli, top level"]
    counts["fleet, monitor, cli, top level"] = top[0] + rest[0], top[1] + rest[1]
    return {name: (lines, modules) for name, (lines, modules) in counts.items()}


def code_and_comments(source: str) -> tuple[int, int]:
    """Return the lines of code and the lines with a comment of a module.

    A docstring, a blank line and an instruction to a tool (``noqa``, ``fmt``, ``type``) count as neither.
    """
    strings = {  # a statement that is only a string: the docstring of a module, class, function or constant
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    code: set[int] = set()
    comments: set[int] = set()
    layout = tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if not token.string.startswith(INSTRUCTIONS):
                comments.add(token.start[0])
        elif token.type not in layout and token.start[0] not in strings:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code), len(comments)


def print_comments(required: dict[str, float]) -> bool:
    """Print code and comments of each numerical package; return True if a package has too few comments."""
    too_few = False
    print(f"{'package':34} {'code':>7} {'comments':>8} {'per 100':>7} {'required':>8} {'one in':>7}")
    for name in NUMERICAL:
        paths = (ROOT / "magbridge" / name).rglob("*.py")
        counts = [code_and_comments(path.read_text(encoding="utf-8")) for path in paths]
        code, comments = map(sum, zip(*counts, strict=True))
        per_100 = 100 * comments / code
        least = required.get(name, required.get("default", 0.0))
        too_few |= per_100 < least
        one_in = f"{code / comments:.0f}" if comments else "-"
        print(f"{name:34} {code:7,} {comments:8} {per_100:7.1f} {least:8.1f} {one_in:>7}")
    return too_few


def main() -> int:
    """Print the tables; return the exit code."""
    limits = tomllib.loads(LIMITS.read_text(encoding="utf-8"))["size"]
    gate = "--gate" in sys.argv
    over = False
    if gate:
        over = print_comments(limits.get("comments", {}))
        print()
    later = [path for paths in limits["added"].values() for path in paths]
    print(f"{'part':34} {'lines':>7} {'budget':>7} {'added':>7} {'excess':>7} {'modules':>8}")
    for name, (lines, modules) in parts(limits["folders"]).items():
        budget = limits["budget"][name]
        folders = tuple(limits["folders"].get(name, ["magbridge"]))
        added = sum(
            length(path)
            for path in later
            if path.startswith(folders) or ("top level" in name and path.count("/") == 1)
        )
        over |= lines > limits["ceiling"].get(name, budget)
        excess = max(0, lines - budget - added)
        print(f"{name:34} {lines:7,} {budget:7,} {added:7,} {excess:7,} {modules:8}")
    print(f"modules of the package: budget {limits['max_modules']}. Abilities added after the budgets:")
    for ability, paths in limits["added"].items():
        print(f"    {ability}: {sum(map(length, paths)):,} lines")
    return int(over and gate)


if __name__ == "__main__":
    sys.exit(main())
