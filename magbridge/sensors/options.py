"""Descriptions of a driver's options, for the help and for a commented configuration."""

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
    """Description of one key of ``[sensor.options]``."""

    name: str
    kind: str
    """Type of the value, as text."""
    default: Any
    """Default value; ``msgspec.NODEFAULT`` if the key is required."""
    meaning: str

    @property
    def required(self) -> bool:
        """True if a configuration must set the key."""
        return self.default is msgspec.NODEFAULT


def driver_names() -> list[str]:
    """Return the names of all drivers, including drivers of other packages, sorted."""
    return sorted({*DRIVERS, *plugins("magbridge.sensors")})


def options_of(driver: str) -> list[Option]:
    """Return the options of a driver in the order of its struct, with required options first.

    ConfigError: the driver does not exist.
    """
    return sorted(attributes_of(driver_class(driver, "options").Options), key=lambda one: not one.required)


def attributes_of(struct: Any) -> list[Option]:
    """Return the fields of a msgspec struct, with the docstring below each field as its meaning."""
    kinds, meanings = get_type_hints(struct), _meanings(struct)
    return [
        Option(one.name, _words(kinds[one.name]), _default(one), meanings.get(one.name, ""))
        for one in msgspec.structs.fields(struct)
    ]


def _words(kind: Any) -> str:
    """Return a Python type as text for a reader of a configuration."""
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
    """Return the docstring below each field of a struct, by the field's name.

    A docstring that begins with several field names is the meaning of all these fields.
    """
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
