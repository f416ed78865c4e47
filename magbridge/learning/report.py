"""What a learner says of itself: changes as they come, and how it stands."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["Notice", "State"]


class Notice(NamedTuple):
    """A change to announce, and when (s); `grave` where someone should look."""

    text: str
    time: float
    grave: bool = False

    @property
    def date(self) -> str:
        """The time, UTC."""
        return f"{np.datetime64(round(self.time), 's')}Z"


class State(NamedTuple):
    """What MAG_LEARNING says: see there."""

    learned_samples: int
    rms: tuple[float, float, float]
    better: float
    causes: tuple[str, ...]
    since_us: int
    size: float
