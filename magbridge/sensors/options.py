"""The options of a driver, told from its own struct: for help, and for a commented configuration."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import msgspec

from magbridge.plugins import plugins
from magbridge.sensors import DRIVERS, driver_class

__all__ = ["Option", "driver_names", "options_of"]


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

    Raises
    ------
    ConfigError
        No such driver.
    """
    struct: Any = driver_class(driver, "options").Options
    told = _attributes(struct.__doc__ or "")
    options = [
        Option(field.name, *told.get(field.name, ("", "")), field.default)._replace(default=_default(field))
        for field in msgspec.structs.fields(struct)
    ]
    return sorted(
        (Option(one.name, one.kind, one.default, told.get(one.name, ("", ""))[1]) for one in options),
        key=lambda one: not one.required,
    )


def _default(field: Any) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def _attributes(docstring: str) -> dict[str, tuple[str, str]]:
    """Return name -> type and meaning of the section 'Attributes' of a numpydoc docstring."""
    section = docstring.partition("Attributes\n")[2]
    found: dict[str, tuple[str, str]] = {}
    name = ""
    for line in section.splitlines():
        if match := re.fullmatch(r" {4}(\w+) : (.+)", line):
            name = match[1]
            found[name] = match[2], ""
        elif name and line.startswith(" " * 8):
            kind, meaning = found[name]
            found[name] = kind, f"{meaning} {line.strip()}".strip()
    return found
