"""Check commit messages: ``area: imperative verb + object``, at most 72 characters.

    python tools/commits.py           the commits that origin's main branch does not have
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
MAX_SUBJECT_CHARACTERS = 72
SUBJECT = re.compile(r"^(?P<area>[\w./, -]+): (?P<verb>[A-Za-z-]+) (?P<object>.+)$")
ENDS_IN_S = "address assess bypass compress cross discuss express focus miss pass process suppress"
NOT_A_VERB = (
    "a an the this that these those it its what where when who how why no not of in on at by for from "
    "to with and or but as is are was were be been so more less also still now new old every each all some"
)


def problem(message: str) -> str:
    """Return the fault of a commit message, or an empty string."""
    subject, *rest = message.rstrip().split("\n")
    parts = SUBJECT.match(subject)
    if subject.startswith(("Merge ", "Revert ")):
        fault = ""
    elif len(subject) > MAX_SUBJECT_CHARACTERS:
        fault = f"{len(subject)} characters: expected at most {MAX_SUBJECT_CHARACTERS}; use the body"
    elif not parts:
        fault = "expected 'area: verb object', such as 'learning: reject late telemetry'"
    elif not is_imperative(parts["verb"].lower()):
        fault = f"expected an imperative verb, got {parts['verb']!r}"
    elif subject.endswith("."):
        fault = "expected no full stop at the end"
    elif rest and rest[0].strip():
        fault = "expected an empty line between subject and body"
    else:
        fault = ""
    return fault


def is_imperative(word: str) -> bool:
    """Return True if a word can be an imperative: not an article, not another form of a verb."""
    if word in NOT_A_VERB.split():
        return False
    if word.endswith("s"):
        return word in ENDS_IN_S.split()
    return not word.endswith("ing") and (
        not word.endswith("ed") or word in {"embed", "feed", "need", "speed"}
    )


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
        found = commits(sys.argv[1] if sys.argv[1:] else "origin/HEAD..HEAD")
    faults = [(name, text.split("\n")[0], problem(text)) for name, text in found]
    for name, subject, fault in faults:
        if fault:
            print(f"{name}: {subject}: {fault}")
    return int(any(fault for _, _, fault in faults))


if __name__ == "__main__":
    sys.exit(main())
