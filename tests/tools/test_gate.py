"""Test the programs of the gate: wording, names, commit messages, size."""

import tomllib
from pathlib import Path

import commits
import names
import prose
import pytest
import size


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("The sensor is powered anew.", "anew"),
        ("Of a spreadsheet the reader asks nothing.", "opens-of"),
        ("The map shows rock.", "rock"),
        ("'X' is no message of any dialect.", "is-no"),
        ("One two three four five six seven eight nine ten " * 3 + "words.", "long"),
        ("It took 1, 2, 3, 4 and 5 s.", "numbers"),
    ],
    ids=lambda value: value if " " not in value else None,
)
def test_a_page_is_checked_by_sentence(tmp_path: Path, text: str, rule: str) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# Title anew\n\nA good sentence.\n{text}\n\n```sh\nanew rock\n```\n\n| anew | 1 |\n")
    assert {finding.rule for finding in prose.check(page)[1]} == {rule}
    assert prose.check(page)[1][0].line == 3


def test_code_is_checked_once_in_docstrings_comments_and_messages(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text(
        '"""Start anew."""\n\nLIMIT = 3.0\n"""nT."""\n# nobody knows\n'
        'raise SystemExit("what is learned is lost")\nanew = 1\n'
    )
    assert [(line, rule) for line, rule, *_ in prose.check(module)[1]] == [
        (1, "anew"), (4, "unit-only"), (5, "nobody"), (6, "what-is"),
    ]  # fmt: skip


def test_names_are_found_by_kind(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("MOST = 3\nSAME = 1\nclass State: ...\ndef at(time, own): ...\n")
    (tmp_path / "b.py").write_text("MOST: int = 4\nSAME = 1\nclass State: ...\ndef update(*, now): ...\n")
    found = names.check(tmp_path)
    assert {kind: len(findings) for kind, findings in found.items()} == {
        "constants": 1, "classes": 1, "functions": 1, "parameters": 2,
    }  # fmt: skip
    assert "MOST has 2 values" in found["constants"][0]


@pytest.mark.parametrize(
    ("message", "is_good"),
    [
        ("learning: reject late telemetry\n\nWhy.", True),
        ("docs/results: address the bound", True),
        ("tests: embed the need", True),
        ("Learned from nothing says so", False),
        ("learning: rejected late telemetry", False),
        ("learning: rejects late telemetry", False),
        ("learning: the telemetry", False),
        ("learning: reject late telemetry\nWhy.", False),
        ("learning: reject " + "x" * 60, False),
    ],
    ids=str,
)
def test_commit_messages(message: str, is_good: bool) -> None:
    assert (commits.problem(message) == "") is is_good


def test_the_parts_of_the_package_add_up() -> None:
    folders = {
        "logs": ["magbridge/logs"],
        "fleet, monitor, cli, top level": ["magbridge/fleet", "magbridge/monitor", "magbridge/cli"],
    }
    counts = size.parts(folders)
    others = [size.count(path) for path in (size.ROOT / "magbridge").iterdir() if path.is_dir()]
    top = [size.count(size.ROOT / "magbridge" / name) for name in ("fleet", "monitor", "cli")]
    assert counts["package"] == size.count(size.ROOT / "magbridge")
    files = counts["package"][0] - sum(lines for lines, _ in others)
    assert files > 0
    named = counts["fleet, monitor, cli, top level"][0]
    assert named == counts["package"][0] - counts["logs"][0] >= files + sum(lines for lines, _ in top)


def test_every_part_has_its_folders_and_its_budget() -> None:
    limits = tomllib.loads(size.LIMITS.read_text("utf-8"))["size"]
    assert {*limits["folders"], "package"} == set(limits["budget"])
    assert set(size.parts(limits["folders"])) == set(limits["budget"])


def test_comments_are_counted_separately_from_code_and_docstrings() -> None:
    source = (
        '"""A module\nof two lines."""\n\nLIMIT = 3\n"""Its meaning."""\n'
        "# Normal equations:\ntotal = (  # with the prior\n    1\n\n)\nimport os  # noqa: E402\n"
    )
    assert size.code_and_comments(source) == (5, 2)


def test_a_package_with_too_few_comments_fails_the_gate() -> None:
    assert not size.print_comments({"default": 0.0})
    assert size.print_comments({"default": 0.0, "health": 100.0})
