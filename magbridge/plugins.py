"""Load plug-ins of other packages by entry points: drivers, formats, terms, emulated instruments.

An exception in a plug-in becomes a one-line error with the plug-in's name, its package and the line of code,
so that the user can report it to the author.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING, Any

from magbridge.errors import MagbridgeError, PluginError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

__all__ = ["blamed", "load", "plugins"]


def plugins(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group, such as ``magbridge.formats``, by name."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - slow to import, and rarely needed

    return {point.name: point for point in entry_points(group=group)}


def load(point: EntryPoint) -> Any:
    """Import and return the object of an entry point; PluginError: it cannot be imported."""
    with blamed(point):
        return point.load()


@contextmanager
def blamed(point: EntryPoint) -> Iterator[None]:
    """Raise a :class:`PluginError` in place of any exception except :class:`MagbridgeError` and OSError."""
    try:
        yield
    except (MagbridgeError, OSError):
        raise
    except Exception as error:  # a plug-in may raise anything
        called = extract_tb(error.__traceback__)[-1]
        place = f"{Path(called.filename).name}, line {called.lineno}"
        raise PluginError(_name(point), f"{type(error).__name__}: {error} ({place})") from error


def _name(point: EntryPoint) -> str:
    kind = point.group.removeprefix("magbridge.").removesuffix("s")
    package = point.dist.name if point.dist else point.value
    return f"{kind} {point.name!r} of the package {package}"
