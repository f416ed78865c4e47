"""Words of messages that depend on a number, or on the names that are valid."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = ["counted", "nearest_name", "one_of", "suggestion"]


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, as ``1 row`` or ``2 rows``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def nearest_name(name: str, valid: Iterable[str]) -> str:
    """Return the valid name that is nearest to one that does not exist; empty if none is near."""
    by_lower = {candidate.lower(): candidate for candidate in valid}
    found = get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[found[0]] if found else ""


def suggestion(name: str, valid: Iterable[str]) -> str:
    """Return ``; did you mean X?`` with the nearest valid name; empty if none is near."""
    near = nearest_name(name, valid)
    return f"; did you mean {near}?" if near else ""


def one_of(name: str, valid: Iterable[str]) -> str:
    """Return ``expected one of A, B, not X; did you mean A?``."""
    known = list(valid)
    return f"expected one of {', '.join(known)}, not {name}{suggestion(name, known)}"
