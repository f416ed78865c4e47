"""The options of a driver, told from its own struct: for help, and for a commented configuration."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import msgspec

from magbridge.plugins import plugins
from magbridge.sensors import DRIVERS, driver_class

__all__ = ["Option", "attributes_of", "documented_of", "driver_names", "options_of"]


class Option(NamedTuple):
    """A key of ``[sensor.options]``.

    Attributes
    ----------
    name : str
    kind : str
        Its type, as the driver's documentation says it.
    default : object
        ``msgspec.NODEFAULT`` where it is required.
    meaning : str
    """

    name: str
    kind: str
    default: Any
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
    """Return the fields of a msgspec struct with what its docstring tells of each."""
    documented = _attributes(struct.__doc__ or "")
    return [
        Option(name, kind, _default(field), meaning)
        for field in msgspec.structs.fields(struct)
        for name, (kind, meaning) in [(field.name, documented.get(field.name, ("", "")))]
    ]


def documented_of(struct: Any) -> str:
    """Return a struct's docstring up to its attributes, as one paragraph."""
    return " ".join((struct.__doc__ or "").partition("Attributes\n")[0].split())


def _default(field: Any) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def _attributes(docstring: str) -> dict[str, tuple[str, str]]:
    """Return name -> type and meaning of the section 'Attributes' of a numpydoc docstring."""
    section = docstring.partition("Attributes\n")[2]
    found: dict[str, tuple[str, str]] = {}
    names: list[str] = []  # several may share a line: ``scale, offset : float``
    for line in section.splitlines():
        if match := re.fullmatch(r" {4}(\w+(?:, \w+)*) : (.+)", line):
            names = match[1].split(", ")
            found |= dict.fromkeys(names, (match[2], ""))
        elif names and line.startswith(" " * 8):
            kind, meaning = found[names[0]]
            found |= dict.fromkeys(names, (kind, f"{meaning} {line.strip()}".strip()))
    return found
