"""What was found, each once."""

from __future__ import annotations

__all__ = ["Notices"]


class Notices:
    """Lines for the user.

    Attributes
    ----------
    lines : list of str
        What was found since the caller has last emptied it.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._keys: set[str] = set()

    def report(self, key: str, text: str) -> None:
        """Take a line, unless there was one of this key."""
        if key not in self._keys:
            self._keys.add(key)
            self.lines.append(text)
