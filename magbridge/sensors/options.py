"""The options of a driver, read from its own struct: for help, and for a commented configuration."""

from __future__ import annotations

import ast
import inspect
import re
from itertools import pairwise
from textwrap import dedent
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import msgspec

from magbridge.plugins import plugins
from magbridge.sensors import DRIVERS, driver_class

__all__ = ["Option", "attributes_of", "driver_names", "options_of"]


class Option(NamedTuple):
    """A key of ``[sensor.options]``."""

    name: str
    kind: str
    """Its type, in words."""
    default: Any
    """``msgspec.NODEFAULT`` where it is required."""
    meaning: str

    @property
    def required(self) -> bool:
        """Whether a configuration must set it."""
        return self.default is msgspec.NODEFAULT


def driver_names() -> list[str]:
    """Return the names of all drivers, also those that packages add."""
    return sorted({*DRIVERS, *plugins("magbridge.sensors")})


def options_of(driver: str) -> list[Option]:
    """Return the options of a driver, in its own order; those without a default first.

    ConfigError: no such driver.
    """
    return sorted(attributes_of(driver_class(driver, "options").Options), key=lambda one: not one.required)


def attributes_of(struct: Any) -> list[Option]:
    """Return the fields of a msgspec struct with what its source says below each."""
    kinds, meanings = get_type_hints(struct), _meanings(struct)
    return [
        Option(one.name, _words(kinds[one.name]), _default(one), meanings.get(one.name, ""))
        for one in msgspec.structs.fields(struct)
    ]


def _words(kind: Any) -> str:
    """Return a type as a reader of a configuration knows it."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(repr, get_args(kind)))}"
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(_words, get_args(kind)))
    if kind is NoneType:
        return "None"
    return str(kind).replace("typing.", "") if get_args(kind) else kind.__name__


def _default(field: Any) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def _meanings(struct: Any) -> dict[str, str]:
    """Return field -> the string below it; one that begins with several names is of all of them."""
    try:
        (defined,) = ast.parse(dedent(inspect.getsource(struct))).body
    except OSError:  # a package without its source
        return {}
    assert isinstance(defined, ast.ClassDef)
    found: dict[str, str] = {}
    for field, below in pairwise(defined.body):
        match field, below:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(value=str(text))):
                names, _, meaning = text.partition(": ")
                several = re.fullmatch(r"`\w+`(, `\w+`)+", names)
                shared = re.findall(r"\w+", names) if several else [name]
                found |= dict.fromkeys(shared, " ".join((meaning if several else text).split()))
    return found
