"""Diagnostics: messages with a code for programs, values, and a text for people.

Calibration, survey, diagnosis and navigation return codes with values. The file ``diagnostics.toml`` has the
text of each code.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from math import floor, isfinite, log10
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

__all__ = ["CONDITION_CODES", "Diagnostic", "number", "write_text"]

TEXTS: dict[str, str] = {
    code: text
    for table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8")).values()
    for code, text in table.items()
}
"""Code -> text, with the names of the values in braces."""
CONDITION_CODES = tuple(code.removeprefix("condition.") for code in TEXTS if code.startswith("condition."))
"""Codes of the reasons against use that a condition removes, the weightiest first."""


ERRORS = {"unsupported_fit"}
"""Codes of diagnostics that stop a command unless it is forced; all others are warnings."""


class Diagnostic(NamedTuple):
    """A message: its code, and the values in its text."""

    code: str
    values: Mapping[str, Any] = {}
    about: str = ""
    """Name of the finding that the message is about, for a message outside of the finding; or empty."""

    @property
    def severity(self) -> str:
        """``error`` if it stops a command, else ``warning``."""
        return "error" if self.code in ERRORS else "warning"

    @property
    def text(self) -> str:
        """Text for people, in plain words."""
        own = write_text(self.code, **self.values)
        return write_text("of_finding", name=self.about, text=own) if self.about else own

    @property
    def numbers(self) -> dict[str, float]:
        """Values that are floating-point numbers, by name."""
        return {name: value for name, value in self.values.items() if isinstance(value, float)}


class _Numbers(Formatter):
    """Formatter with two more formats of a number: a count of significant digits, and ``%``."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as text in the format `format_spec`."""
        if format_spec == "%":
            return f"{100.0 * value:.0f} %"
        return number(value, int(format_spec)) if format_spec.isdigit() else format(value, format_spec)


def write_text(code: str, **values: Any) -> str:
    """Return the text of a code with its values filled in."""
    return _Numbers().format(TEXTS[code], **values)


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant `digits` and without an exponent: 1070, not 1.07e+03."""
    rounded = float(f"{value:.{digits}g}")
    if not rounded or not isfinite(rounded):
        return f"{rounded:g}"
    places = max(digits - 1 - floor(log10(abs(rounded))), 0)
    return f"{rounded:.{places}f}".replace("-", "\N{MINUS SIGN}")
