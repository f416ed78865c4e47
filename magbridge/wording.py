"""Words of messages that depend on a number."""

__all__ = ["counted"]


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, as ``1 row`` or ``2 rows``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
