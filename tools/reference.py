"""Pages of the documentation that are made from the code: mkdocs calls this file as a hook.

The commands come from their docstrings, the messages from the dialect's XML, the columns from their table, so
that a page cannot say otherwise than the program.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, parse

from mkdocs.structure.files import File

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[1]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages made from the code."""
    pages = {
        "commands": commands(),
        "configuration": configuration(),
        "messages": "\n".join(messages()),
        "python": python(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def commands() -> str:
    """Return the help of every command."""
    from magbridge.cli import app  # noqa: PLC0415 - imports the program only where pages are made

    page = app.generate_docs(output_format="markdown", recursive=True, include_hidden=False)
    start = page.index("\n## Table of Contents")
    listed = page.index("**Commands**", start)
    return "# Commands\n\n" + page[listed:]


def configuration() -> str:
    """Return the page of ``bridge.toml``: its tables are documented where they are defined."""
    tables = ("Sensor", "Link", "Telemetry", "CalibrationFile", "Align", "Log", "Navigation")
    head = "# bridge.toml\n\nWhat every key means, its type and its default.\n"
    return "\n".join((head, *(f"::: magbridge.config.{name}\n" for name in tables)))


def python() -> str:
    """Return the page of the public Python names."""
    from magbridge import __all__ as names  # noqa: PLC0415

    public = (name for name in names if not name.startswith("_"))
    return "\n".join(("# Python", "", "::: magbridge\n    options: {members: false}\n", *map(_entry, public)))


def _entry(name: str) -> str:
    from magbridge import _HOMES  # noqa: PLC0415 - where each name is defined

    return f"::: magbridge.{_HOMES[name]}.{name}\n"


def messages() -> Iterator[str]:
    """Yield the lines of the page of messages and enumerations."""
    dialect = parse(ROOT / "magbridge/mavlink/magbridge.xml").getroot()
    yield from ("# MAVLink messages", "", "What the bridge sends beside the standard messages.", "")
    for message in dialect.iterfind("messages/message"):
        yield from (f"## {message.get('name')} ({message.get('id')})", "", _text(message), "")
        yield from ("| field | type | unit | |", "|---|---|---|---|")
        for field in message.iterfind("field"):
            unit, kind = field.get("units", ""), (field.get("type") or "").removesuffix("_t")
            yield f"| `{field.get('name')}` | {kind} | {unit} | {' '.join((field.text or '').split())} |"
        yield ""
    for enum in dialect.iterfind("enums/enum"):
        yield from (f"## {enum.get('name')}", "", _text(enum), "", "| value | name | |", "|---|---|---|")
        for entry in enum.iterfind("entry"):
            yield f"| {entry.get('value')} | `{entry.get('name')}` | {_text(entry)} |"
        yield ""


def _text(element: Element) -> str:
    return " ".join((element.findtext("description") or "").split())
