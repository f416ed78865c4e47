"""What was found, each once."""

from __future__ import annotations

__all__ = ["Told"]


class Told:
    """Lines for the user.

    Attributes
    ----------
    notices : list of str
        What was found since the caller has last emptied it.
    """

    def __init__(self) -> None:
        self.notices: list[str] = []
        self._keys: set[str] = set()

    def tell(self, key: str, text: str) -> None:
        """Take a line, unless there was one of this key."""
        if key not in self._keys:
            self._keys.add(key)
            self.notices.append(text)
