"""Generate the reference pages of the documentation from the code, as a hook of mkdocs.

The commands come from their docstrings, the keys of files from the structs that hold them, parameters and
columns from their tables, and messages from the dialect's XML. So the pages always agree with the
program. The other pages are templates in ``reference_pages``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints
from xml.etree.ElementTree import parse

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from mkdocs.structure.files import File
from msgspec import NODEFAULT

import magbridge
from magbridge.cli import app
from magbridge.columns import COLUMNS, CORRECTED, NT_PER_UNIT
from magbridge.config import Align, Config, Telemetry
from magbridge.link.parameters import alignment, file_rate, rates, telemetry_ages
from magbridge.link.publish import DEFAULT_RATES_HZ, LIMITS
from magbridge.navigate import NavigationOptions
from magbridge.records import Quality
from magbridge.sensors import DRIVERS
from magbridge.sensors.options import attributes_of, options_of
from magbridge.toml import Table

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

TOOLS = Path(__file__).parent
DIALECT = TOOLS.parent / "magbridge" / "mavlink" / "magbridge.xml"
TWICE = re.compile(r"^(magbridge (?:fleet )?)(?:fleet )?(\w+) (?:fleet )?\2(?=\s)", re.MULTILINE)
ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):(<code>)(?:~[\w.]*\.)?([\w.]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the files of the site."""
    loader = FileSystemLoader(TOOLS / "reference_pages")
    pages = Environment(loader=loader, undefined=StrictUndefined, keep_trailing_newline=True)
    pages.filters["words"] = lambda text: " ".join(str(text).split())
    values = {
        "required": NODEFAULT, "attributes_of": attributes_of, "options_of": options_of, "DRIVERS": DRIVERS,
        "NavigationOptions": NavigationOptions, "COLUMNS": COLUMNS, "CORRECTED": CORRECTED,
        "NT_PER_UNIT": NT_PER_UNIT, "Quality": Quality, "dialect": parse(DIALECT).getroot(),
        "tables": tables(), "parameters": parameters(), "names": public_names(),
    }  # fmt: skip
    texts = {"commands": commands()}
    for name in ("configuration", "parameters", "columns", "messages", "python"):
        texts[name] = pages.get_template(f"{name}.md.j2").render(values)
    for name, text in texts.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def on_page_content(html: str, **_: object) -> str:
    """Replace a docstring's ``:func:`~a.b.c``` by the last name, and ``::`` before a block by one colon."""
    return ROLE.sub(r"\1\2", html).replace("::</p>", ":</p>")


def commands() -> str:
    """Return the Markdown page with the help of every command."""
    page = app.generate_docs(output_format="markdown", recursive=True, include_hidden=False)
    start = page.index("\n## Table of Contents")
    listed = page.index("**Commands**", start)
    # remove the command's name where both cyclopts and the custom usage state it
    return "# Commands\n\n" + TWICE.sub(r"\1\2", page[listed:])


def tables() -> list[tuple[str, type[Table] | None]]:
    """Return the tables of ``bridge.toml`` in order, with their structs; ``publish`` has none."""
    found = []
    for name, held in get_type_hints(Config).items():
        kinds = [one for one in (held, *get_args(held)) if isinstance(one, type) and issubclass(one, Table)]
        if kinds or name == "publish":
            found.append((name, kinds[0] if kinds else None))
    return found


def parameters() -> tuple[Any, ...]:
    """Return the MAVLink parameters of a bridge with the telemetry ``battpos``."""
    telemetry = {"battpos": Telemetry("NAMED_VALUE_FLOAT", "value")}
    return (*alignment(Align()), *telemetry_ages(telemetry), *file_rate(), *rates(DEFAULT_RATES_HZ, LIMITS))


def public_names() -> list[str]:
    """Return the public Python names with their modules."""
    names = (name for name in magbridge.__all__ if not name.startswith("_") and name != "plot")
    return [f"magbridge.{magbridge._HOMES[name]}.{name}" for name in names]  # noqa: SLF001
