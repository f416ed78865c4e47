"""Test that the page on the architecture shows the existing layers, modules and types."""

import importlib
import re
import tomllib
from pathlib import Path

import pytest
from pages import PAGES, ROOT

from magbridge.config import Align
from magbridge.link.parameters import alignment, file_rate, learning

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def rows(heading: str, page: str = PAGE) -> list[list[str]]:
    """Return the cells of the table below a heading."""
    section = page[page.index(f"## {heading}\n") :].split("\n## ", maxsplit=1)[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_the_layers_are_those_that_import_linter_checks() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = [set(re.findall(r"[\w.]+", layer.replace("magbridge.", ""))) for layer in contracts[0]["layers"]]
    shown = [set(re.findall(r"`([\w]+)`", row[1])) for row in rows("Layers")]
    assert shown == layers


def test_every_place_exists() -> None:
    places = re.findall(r"`([\w/]+(?:\.py|\.xml|/))`", PAGE)
    assert len(places) > 20
    assert not [one for one in places if not ((ROOT / one).exists() or (ROOT / "magbridge" / one).exists())]


def test_every_parameter_of_the_link_is_in_the_table() -> None:
    page = (ROOT / "docs" / "mavlink.md").read_text(encoding="utf-8")
    shown = re.findall(r"`(MB_\w+)`", " ".join(row[0] for row in rows("Parameters", page)))
    assert sorted(shown) == sorted(one.name for one in [*alignment(Align()), *file_rate(), *learning(False)])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_key_of_the_alignment_exists(page: Path) -> None:
    named = re.findall(r"`align\.(?!py`)(\w+)`", page.read_text(encoding="utf-8"))
    assert set(named) <= set(Align.__struct_fields__)


def test_every_central_type_is_in_its_module() -> None:
    table = rows("Central types")
    assert len(table) > 4
    for name, module, _ in table:
        assert hasattr(importlib.import_module(f"magbridge.{module.strip('`')}"), name.strip("`")), name


def test_every_module_that_the_method_names_exists() -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    names = re.findall(r"`(magbridge(?:\.\w+)+)`", text)
    assert len(names) > 10
    paths = [ROOT / name.replace(".", "/") for name in names]
    assert not [path for path in paths if not path.is_dir() and not path.with_suffix(".py").is_file()]


# ---- Every figure that a page shows was measured by a command on the page ----------------------------------


PAGES = sorted({*PAGES, *ROOT.glob("tools/**/README.md"), ROOT / "tests" / "bridge" / "README.md"})
CODE = re.compile(r"```.*?```|`[^`]+`", re.DOTALL)
COMMAND = re.compile(r"(?<![\w/-])(tools/)?([a-z_]+)\.py\b((?:[ \\\n]+(?![#`])[^\s`|;)]+)*)")
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
FIGURE = re.compile(r"\d ?(?:%|nT|km|µs|ms|s|m)(?!\w)|\d\.\d")
"""Measured figure in a text: a number with its unit or with a decimal point."""
SOME = 4


def commands(text: str) -> list[tuple[Path, list[str]]]:
    """Return the tools that a text names as code, each with its options, without modules of the package."""
    return [
        (ROOT / "tools" / f"{found[2]}.py", re.findall(r"(?<=\s)--[a-z][\w-]*", found[3]))
        for code in CODE.findall(text)
        for found in COMMAND.finditer(code)
        if found[1] or (ROOT / "tools" / f"{found[2]}.py").exists()
    ]


def source_of(tool: Path) -> str:
    """Return the source of a tool and of the tools that it imports or runs, whose options it shares."""
    text = tool.read_text(encoding="utf-8")
    names = re.findall(r"^(?:from|import) (\w+)|tools/(\w+)\.py", text, re.MULTILINE)
    parts = [ROOT / "tools" / f"{imported or called}.py" for imported, called in names]
    return "".join([text, *(part.read_text(encoding="utf-8") for part in parts if part.is_file())])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_tool_that_a_page_names_is_there_and_has_those_options(page: Path) -> None:
    for tool, options in commands(page.read_text(encoding="utf-8")):
        assert tool.exists(), tool.name
        source = source_of(tool)
        missing = [one for one in options if f'"{one}"' not in source and f" {_name(one)}=" not in source]
        assert missing == [], tool.name


def _name(option: str) -> str:
    """Return the keyword that declares an option in ``command_line``."""
    return option.removeprefix("--").replace("-", "_")


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
