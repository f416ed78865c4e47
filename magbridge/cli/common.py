"""What the commands share: the application, common arguments, how a result and a complaint are told."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import App, Parameter

from magbridge import __version__
from magbridge.errors import WrongUse

__all__ = ["Json", "Output", "app", "complain", "some", "tell"]

app = App(
    name="magbridge",
    help="A magnetometer bridge for vehicles whose own iron moves.",
    version=__version__,
    help_format="plaintext",
)
Output = Annotated[Path, Parameter(name=["--output", "-o"])]
Json = Annotated[bool, Parameter(name="--json", negative="")]


def some(files: tuple[Path, ...]) -> tuple[Path, ...]:
    """Return `files`, if there are any."""
    if not files:
        raise WrongUse("expected at least one FILE")
    return files


def tell(result: dict[str, Any], sentence: str, as_json: bool) -> None:
    """Print the result, for people or for machines."""
    print(msgspec.json.encode(result).decode() if as_json else sentence)


def complain(sentence: str, code: int) -> int:
    """Print one line to stderr and return `code`."""
    print("magbridge:", " ".join(sentence.split()), file=sys.stderr)
    return code
