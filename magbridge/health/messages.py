"""Messages for the operator, each kind once."""

from __future__ import annotations

__all__ = ["Messages"]


class Messages:
    """Collect messages.

    Attributes
    ----------
    lines : list of str
        Messages since the caller last emptied it.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._kinds: set[str] = set()

    def report(self, kind: str, text: str) -> None:
        """Add a message, unless there was one of this kind."""
        if kind not in self._kinds:
            self._kinds.add(kind)
            self.lines.append(text)
