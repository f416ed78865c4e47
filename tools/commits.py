"""Check commit messages: ``area: imperative verb + object``, at most 72 characters.

    python tools/commits.py           the commits that origin's main branch does not have, at least the last
    python tools/commits.py RANGE     the commits of a range of git log
    python tools/commits.py --file F  a message in a file; as a hook: .git/hooks/commit-msg

Standard library only.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_A_VERB = (
    "a an the this that these those it its what where when who how why no not of in on at by for from "
    "to with and or but as is are was were be been so more less also still now new old every each all some"
).replace(" ", "|")
IMPERATIVES = (
    "address assess bypass compress cross discuss express focus miss pass press process suppress embed feed "
    "need speed"
).replace(" ", "|")
"""Imperatives that end like another form of a verb."""
FAULTS = {
    r".{73,}": "more than 72 characters; use the body",
    r"(?![\w./, -]+: [a-z-]+ .)": "expected 'area: verb object', such as 'learning: reject late telemetry'",
    rf"[^:]+: (?!({IMPERATIVES}) )({NOT_A_VERB}|[a-z-]*(s|ed|ing)) ": "expected an imperative verb",
    r".*\.(\n|$)": "expected no full stop at the end",
    r".*\n.": "expected an empty line between subject and body",
}
"""Patterns of a faulty message, in the order in which they are tried, with their faults."""


def problem(message: str) -> str:
    """Return the fault of a commit message, or an empty string."""
    if message.startswith(("Merge ", "Revert ")):
        return ""
    faults = (fault for form, fault in FAULTS.items() if re.match(form, message.rstrip(), re.IGNORECASE))
    return next(faults, "")


def commits(span: str) -> list[tuple[str, str]]:
    """Return (short hash, message) of the commits of a range; an empty list for a range unknown to git."""
    command = ["git", "log", "--no-merges", "--format=%h%x00%B%x01", span]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    records = [record.strip("\n").split("\0") for record in done.stdout.split("\x01")]
    return [(record[0], record[1]) for record in records if len(record) == 2]


def main() -> int:
    """Run the check; return the exit code."""
    if sys.argv[1:2] == ["--file"]:
        found = [("message", Path(sys.argv[2]).read_text())]
    else:
        found = commits(sys.argv[1]) if sys.argv[1:] else commits("origin/HEAD..HEAD") or commits("-1")
    faulty = [(name, text.split("\n")[0], problem(text)) for name, text in found if problem(text)]
    for finding in faulty:
        print(*finding, sep=": ")
    return int(bool(faulty))


if __name__ == "__main__":
    sys.exit(main())
