"""Run optional parts of the live path so that an error in one does not end the bridge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

__all__ = ["OptionalParts"]

T = TypeVar("T")


class OptionalParts:
    """Call checks, navigation, learning and position; switch a part off when it raises.

    An exception of such a part is a fault of the program. The sample is published from the remaining parts,
    because a vehicle under way is better served by a field without a check than by none. `report` receives
    the text for the operator; `failures` has the exception of each part that is switched off.
    """

    propagate: ClassVar[bool] = False
    """True in tests: exceptions pass through, so that this class hides no fault."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self.failures: dict[str, str] = {}

    def call(self, part: str, default: T, function: Callable[..., T], *arguments: Any) -> T:
        """Return the function's value; `default` if the part raises now or is switched off."""
        if part in self.failures:
            return default
        try:
            return function(*arguments)
        except Exception as error:
            if self.propagate:
                raise
            self.failures[part] = f"{type(error).__name__}: {error}"
            self._report(f"{part} is off after an internal error: {self.failures[part]}")
            return default
