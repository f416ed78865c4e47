"""What the tools have in common: the form of their tables, and their own docstring as the help."""

from __future__ import annotations

import argparse
from collections.abc import Collection

from rich.table import Table

__all__ = ["command_line", "table"]


def command_line(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help begins with a tool's docstring, as it stands there."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def table(title: str, *headings: str, left: Collection[str] = ("",)) -> Table:
    """Return an empty table, its numbers to the right."""
    made = Table(title=title, title_justify="left")
    for heading in headings:
        made.add_column(heading, justify="left" if heading in left else "right")
    return made
