"""One line of the table."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

__all__ = ["Row"]


class Row(NamedTuple):
    """A measured figure, with its floor in the same run and its target.

    Attributes
    ----------
    what : str
    value : float
    unit : str
    floor : float or None
        The same work at its barest, in the same unit; `floor_is` says how.
    ratio : float or None
        The figure that `most` or `least` limits, where it is not `value` itself: the median over the
        repetitions of value divided by floor.
    most, least : float or None
        The target: upper or lower limit.
    detail : mapping
        For ``--json``.
    """

    what: str
    value: float
    unit: str
    floor: float | None = None
    floor_is: str = ""
    ratio: float | None = None
    most: float | None = None
    least: float | None = None
    detail: Mapping[str, Any] = MappingProxyType({})

    @property
    def holds(self) -> bool | None:
        """True if the target is met; None without a target."""
        judged = self.value if self.ratio is None else self.ratio
        if self.most is not None:
            return judged <= self.most
        return judged >= self.least if self.least is not None else None
