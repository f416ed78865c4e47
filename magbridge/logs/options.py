"""What a user can say about logs that they do not say themselves."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Options"]


@dataclass(frozen=True)
class Options:
    """How logs are to be read.

    Attributes
    ----------
    strict : bool
        A log of which anything would be dropped is refused.
    date : float or None
        s since 1970 UTC of the boot, for logs whose times count from it.
    compass : str or None
        Number (from 0) or device id of the compass to use, of several; None: the one that was in use.
    """

    strict: bool = False
    date: float | None = None
    compass: str | None = None
