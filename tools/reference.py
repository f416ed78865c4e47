"""Generate the reference pages of the documentation from the code, as a hook of mkdocs.

The commands come from their docstrings, the keys of files from the structs that hold them, parameters and
columns from their tables, and messages from the dialect's XML. So the pages always agree with the
program.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, get_args, get_type_hints
from xml.etree.ElementTree import Element, parse

from mkdocs.structure.files import File
from msgspec import NODEFAULT

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

    from magbridge.sensors.options import Option

ROOT = Path(__file__).resolve().parents[1]
TWICE = re.compile(r"^(magbridge (?:fleet )?)(?:fleet )?(\w+) (?:fleet )?\2(?=\s)", re.MULTILINE)
ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):(<code>)(?:~[\w.]*\.)?([\w.]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the files of the site."""
    pages = {
        "commands": commands(),
        "configuration": "\n".join(configuration()),
        "parameters": "\n".join(parameters()),
        "columns": "\n".join(columns()),
        "messages": "\n".join(messages()),
        "python": python(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def on_page_content(html: str, **_: object) -> str:
    """Replace a docstring's ``:func:`~a.b.c``` by the last name, and ``::`` before a block by one colon."""
    return ROLE.sub(r"\1\2", html).replace("::</p>", ":</p>")


def commands() -> str:
    """Return the Markdown page with the help of every command."""
    from magbridge.cli import app  # noqa: PLC0415 - imports the program only where pages are made

    page = app.generate_docs(output_format="markdown", recursive=True, include_hidden=False)
    start = page.index("\n## Table of Contents")
    listed = page.index("**Commands**", start)
    # remove the command's name where both cyclopts and the custom usage state it
    return "# Commands\n\n" + TWICE.sub(r"\1\2", page[listed:])


def configuration() -> Iterator[str]:
    """Yield the lines of the page of ``bridge.toml``: its tables in order, and the options of each driver."""
    from magbridge.config import Config  # noqa: PLC0415 - imports the program only where pages are made
    from magbridge.navigate import NavigationOptions  # noqa: PLC0415
    from magbridge.sensors import DRIVERS  # noqa: PLC0415
    from magbridge.sensors.options import attributes_of, options_of  # noqa: PLC0415

    yield "# bridge.toml\n\nWhat every key means, its type and its default. Paths are relative to the file.\n"
    for name, held in get_type_hints(Config).items():
        table = next((one for one in (held, *get_args(held)) if _is_table(one)), None)
        if table is not None:
            yield from (f"## {name}", "", " ".join(str(table.__doc__).split()), "")
            yield from _keys(attributes_of(table))
        elif name == "publish":
            yield from (
                "## publish",
                "",
                "`[publish]`: message = rate in Hz; 0 with every sample, negative never.",
                "",
            )
    yield "## sensor.options\n\nThe keys that each driver has; `magbridge drivers NAME` prints them.\n"
    for driver in sorted(DRIVERS):
        yield f"### {driver}\n"
        yield from _keys(options_of(driver))
    yield "## navigation.options\n"
    yield from _keys(attributes_of(NavigationOptions))


def _keys(options: Iterable[Option]) -> Iterator[str]:
    rows = ((f"`{one.name}`", one.kind, _default(one.default), one.meaning) for one in options)
    return _table(("key", "type", "default", ""), rows)


def _is_table(kind: object) -> bool:
    from magbridge.toml import Table  # noqa: PLC0415

    return isinstance(kind, type) and issubclass(kind, Table)


def _default(value: object) -> str:
    return "required" if value is NODEFAULT else f"`{value!r}`"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    yield from (f"| {' | '.join(header)} |", "|---" * len(header) + "|")
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
    yield ""


def parameters() -> Iterator[str]:
    """Yield the lines of the page of MAVLink parameters, for a bridge with the telemetry ``battpos``."""
    from magbridge.config import Align, Telemetry  # noqa: PLC0415
    from magbridge.link.parameters import alignment, file_rate, rates, telemetry_ages  # noqa: PLC0415
    from magbridge.link.publish import DEFAULT_RATES_HZ, LIMITS  # noqa: PLC0415

    table = (
        *alignment(Align()),
        *telemetry_ages({"battpos": Telemetry("NAMED_VALUE_FLOAT", "value")}),
        *file_rate(),
        *rates(DEFAULT_RATES_HZ, LIMITS),
    )
    yield "# MAVLink parameters\n"
    yield (
        "Each takes effect at once and is kept over restarts in `bridge.parameters.json`, where it overrules "
        "the key of `bridge.toml`. All are REAL32. `MB_AGE_...` exists for each `[telemetry.NAME]`; here for "
        "`battpos`.\n"
    )
    yield from _table(
        ("parameter", "key", "unit", "default", "lowest", "highest", ""),
        (
            (
                f"`{one.name}`",
                f"`{one.key}`",
                one.unit,
                *(f"{x:g}" for x in (one.default, one.low, one.high)),
                one.doc,
            )
            for one in table
        ),
    )


def columns() -> Iterator[str]:
    """Yield the lines of the page of the columns with a defined meaning, and of the quality flags."""
    from magbridge.columns import COLUMNS, CORRECTED, NT_PER_UNIT  # noqa: PLC0415
    from magbridge.records import Quality  # noqa: PLC0415

    yield "# Every column\n\nWhat a user must know of them: [columns of a log](../columns.md).\n"
    yield from _table(
        ("column", "unit", "meaning", "written by"),
        (
            (f"`{name}`", one.units, one.long_name, "`correct`" if name in CORRECTED else "")
            for name, one in COLUMNS.items()
        ),
    )
    units = ", ".join(f"`{unit}`" for unit in NT_PER_UNIT)
    yield f"A field may be declared in {units}; it is converted to nT.\n"
    yield "## quality\n\nBits of the column `quality` and of `MAG_FIELD.flags`.\n"
    yield from _table(("bit", "flag"), ((str(int(one)), f"`{one.names()}`") for one in Quality))
    yield "::: magbridge.records.Quality\n    options: {heading_level: 3}\n"


def python() -> str:
    """Return the Markdown page of the public Python names."""
    import magbridge  # noqa: PLC0415

    public = (name for name in magbridge.__all__ if not name.startswith("_") and name != "plot")
    entries = (f"::: magbridge.{magbridge._HOMES[name]}.{name}\n" for name in public)  # noqa: SLF001
    header = "::: magbridge\n    options: {members: false}\n"
    return "\n".join(("# Python", "", header, *entries, "::: magbridge.plot\n"))


def messages() -> Iterator[str]:
    """Yield the lines of the page of messages and enumerations."""
    dialect = parse(ROOT / "magbridge/mavlink/magbridge.xml").getroot()
    yield from (
        "# MAVLink messages",
        "",
        "Messages that the bridge sends in addition to the standard ones.",
        "",
    )
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
