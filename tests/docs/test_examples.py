"""Test the code that the documentation shows: run it, or parse it."""

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from pages import PAGES, ROOT, Block, blocks, commands

from magbridge.calibration.fitting.pose import read_vehicle
from magbridge.cli.common import app
from magbridge.config import load
from magbridge.fleet.register import read_fleet
from magbridge.logs.mapping import declared
from magbridge.logs.og import read_metadata
from magbridge.navigate.options import NavigationOptions
from magbridge.toml import convert
from sitl import scenario

SHELL = blocks("sh", "bash")
SITE = "https://magbridge.github.io/magbridge/"
HERE = "https://github.com/magbridge/magbridge/"
RAW = "https://raw.githubusercontent.com/magbridge/magbridge/main/"
LEAST = {
    "sensor": '[sensor]\ndriver = "hmr2300"\nport = "/dev/ttyUSB0"\n',
    "link": '[link]\nurl = "udpout:192.0.2.1:14550"\n',
}
"""Tables that every bridge.toml needs, added to a block that shows only some tables."""


def ours() -> Iterator[tuple[str, list[str]]]:
    """Yield each ``magbridge`` command that a page shows, with its place."""
    for block in SHELL:
        for words in commands(block):
            if words[0].endswith("magbridge") and len(words) > 1 and words[1] in app:
                yield f"{block} {' '.join(words[:2])}", words[1:]


OURS = list(ours())


@pytest.mark.parametrize("words", [words for _, words in OURS], ids=[where for where, _ in OURS])
def test_a_command_is_one_that_the_program_takes(words: list[str], here: Path) -> None:
    if "--help" in words:
        assert words[0] in app
        return
    app.parse_args(words, exit_on_error=False, print_error=False)


def test_the_pages_show_commands() -> None:
    assert len(OURS) > 50
    shown = {words[0] for _, words in OURS}
    assert shown >= {name for name in app if not name.startswith("-")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_command_in_a_sentence_has_the_options_that_it_shows(page: Path) -> None:
    for span in re.findall(r"(?<!`)`magbridge ([^`\n]+)`(?!`)", page.read_text(encoding="utf-8")):
        name, *words = span.split()
        if not re.fullmatch("[a-z]+", name):
            continue
        assert name in app, span
        found = app[name]
        while words and words[0] in found and not words[0].startswith("-"):
            found = found[words.pop(0)]
        if not found.default_command:  # a group of commands, named as such
            assert not words, span
            continue
        taken = {one for argument in found.assemble_argument_collection() for one in argument.names}
        assert not [w for w in words if w.startswith("--") and w not in taken | {"--help"}], span


@pytest.mark.parametrize("block", blocks("toml"), ids=str)
def test_a_block_of_toml_is_read_by_what_reads_such_a_file(block: Block, here: Path) -> None:
    file = here / "block.toml"
    file.write_text(block.text, encoding="utf-8")
    if re.search(r"^\[columns\.", block.text, re.MULTILINE):
        assert declared((), file).columns
    elif re.search(r"^\[mass\.", block.text, re.MULTILINE):
        assert read_vehicle(file)
    elif "[vehicle." in block.text:
        assert read_fleet(file)
    elif "[platform]" in block.text:
        assert read_metadata(file)
    elif "[[mission]]" in block.text:
        assert scenario.load(file)
    elif "[project]" in block.text:
        templates = ROOT.glob("examples/*/pyproject.toml")
        points = [tomllib.loads(one.read_text("utf-8"))["project"]["entry-points"] for one in templates]
        assert tomllib.loads(block.text)["project"]["entry-points"] in points  # which are installed and used
    else:
        missing = [
            text
            for table, text in LEAST.items()
            if not re.search(rf"^\[{table}[.\]]", block.text, re.MULTILINE)
        ]
        file.write_text("".join(missing) + block.text, encoding="utf-8")
        for name in re.findall(
            r'^(?:file|map|signing_key|calibration) = "([^"]+)"', block.text, re.MULTILINE
        ):
            (here / name).touch()
        config = load(file)
        if config.navigation:
            assert convert(config.navigation.options, NavigationOptions, file)


@pytest.mark.parametrize("block", blocks("json"), ids=str)
def test_a_block_of_json_is_json(block: Block) -> None:
    assert json.loads(block.text)


def test_the_page_of_a_calibration_has_its_keys(survey_and_runs: Path) -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    table = page[page.index("## cal.json") : page.index(":::")]
    keys = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    written = json.loads((survey_and_runs / "cal.json").read_text())
    assert [key for key in keys if key in written] == list(written)
    assert set(keys) - set(written) <= {"doubts", "level", "sensors"}


RUN_ELSEWHERE = "docs/scalar.md"
"""Its commands and code are run in order, on a drone's files, by tests/survey/test_scalar_survey.py."""


@pytest.mark.parametrize("block", [b for b in blocks("python") if b.page != RUN_ELSEWHERE], ids=str)
def test_a_block_of_python_runs(block: Block, survey_and_runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(survey_and_runs)
    exec(compile(block.text, str(block), "exec"), {"__name__": "example"})


@pytest.mark.parametrize("block", blocks("py"), ids=str)
def test_a_block_for_a_cluster_is_python(block: Block) -> None:
    """What needs a machine that is not here is marked ``py``, and only read."""
    assert "Cluster" in block.text
    compile(block.text, str(block), "exec")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_an_address_of_ours_leads_somewhere(page: Path) -> None:
    """Links that survive on a package index are absolute: what they name is in the repository."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(re.escape(SITE) + r"([\w/-]+)\.html", text):
        made = name.startswith("reference/")
        assert made or (ROOT / "docs" / f"{name}.md").is_file(), name
    for name in re.findall(re.escape(HERE) + r"(?:blob|tree)/main/([\w./-]*[\w])", text):
        assert (ROOT / name).exists(), name
    for name in re.findall(re.escape(RAW) + r"([\w./-]*\w)", text):
        assert (ROOT / name).is_file(), name


def test_the_readme_has_no_link_that_a_package_index_would_break() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert not re.findall(r"\]\((?!https://)[^)]+\)|(?:src|href)=\"(?!https://)", text)
    assert len(text.splitlines()) <= 130
