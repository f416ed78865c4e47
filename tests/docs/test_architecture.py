"""The page on the architecture shows the layers, modules and types that there are."""

from __future__ import annotations

import importlib
import re
import tomllib

from pages import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading."""
    section = PAGE[PAGE.index(f"## {heading}\n") :].split("\n## ")[0]
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
    assert not [
        one for one in places if not any((root / one).exists() for root in (ROOT, ROOT / "magbridge"))
    ]


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
