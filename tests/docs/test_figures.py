"""Every figure that a page shows was measured by a command on the page, which exists with its options."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import PAGES, ROOT

PAGES = sorted({*PAGES, *ROOT.glob("tools/**/README.md"), ROOT / "tests" / "bridge" / "README.md"})
CODE = re.compile(r"```.*?```|`[^`]+`", re.DOTALL)
COMMAND = re.compile(r"(?<![\w/-])(tools/)?([a-z_]+)\.py\b((?:[ \\\n]+(?![#`])[^\s`|;)]+)*)")
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
FIGURE = re.compile(r"\d ?(?:%|nT|km|µs|ms|s|m)(?!\w)|\d\.\d")
"""A number with its unit, or with a decimal point: what a measurement gives."""
SOME = 4


def commands(text: str) -> list[tuple[Path, list[str]]]:
    """The tools that are named as code, each with its options; a module of the package is none of them."""
    return [
        (ROOT / "tools" / f"{found[2]}.py", re.findall(r"(?<=\s)--[a-z][\w-]*", found[3]))
        for code in CODE.findall(text)
        for found in COMMAND.finditer(code)
        if found[1] or (ROOT / "tools" / f"{found[2]}.py").exists()
    ]


def source_of(tool: Path) -> str:
    """The text of a tool and of the tools that it imports or runs, whose options it has, too."""
    text = tool.read_text(encoding="utf-8")
    names = re.findall(r"^(?:from|import) (\w+)|tools/(\w+)\.py", text, re.MULTILINE)
    parts = [ROOT / "tools" / f"{imported or called}.py" for imported, called in names]
    return "".join([text, *(part.read_text(encoding="utf-8") for part in parts if part.is_file())])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_tool_that_a_page_names_is_there_and_has_those_options(page: Path) -> None:
    for tool, options in commands(page.read_text(encoding="utf-8")):
        assert tool.exists(), tool.name
        source = source_of(tool)
        assert [one for one in options if f'"{one}"' not in source] == [], tool.name


@pytest.mark.parametrize("page", sorted(ROOT.glob("docs/results/*.md")), ids=lambda page: page.name)
def test_a_table_of_figures_stands_on_a_page_that_says_how_they_are_measured(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    if any(len(FIGURE.findall(one)) >= SOME for one in TABLE.findall(text)):
        assert commands(text)


@pytest.mark.parametrize("page", ["README.md", "docs/results/index.md"])
def test_a_page_of_many_tools_names_one_next_to_every_table(page: str) -> None:
    """A row that names none is of the tool before it, in its table or in what stands above that."""
    text = (ROOT / page).read_text(encoding="utf-8")
    tables = [one for one in TABLE.finditer(text) if len(FIGURE.findall(one[0])) >= SOME]
    assert tables
    for table in tables:
        section = text[text.rindex("\n## ", 0, table.start()) : table.start()]
        first = next(row for row in table[0].splitlines()[2:] if FIGURE.search(row))
        assert commands(section + first), first


def test_the_examination_finds_what_is_missing() -> None:
    assert commands("see `python3 tools/nowhere.py --size 3`") == [(ROOT / "tools/nowhere.py", ["--size"])]
    assert commands("see `faults.py \\\n  --hours 3` and `turns.py`") == [
        (ROOT / "tools/faults.py", ["--hours"])
    ]
    assert len(FIGURE.findall("| 1.04 | 3 % | 12 nT | 7 m | 8 months | 11 |")) == SOME
