"""How often a message goes out."""

from __future__ import annotations

__all__ = ["Rate", "period_us"]

NEVER_US = 1e15
"""µs, 31 years: a longer period is none."""


def period_us(hertz: float) -> int:
    """Return the µs between two messages at a rate above 0, which may be 1e-300 Hz."""
    return round(min(1e6 / hertz, NEVER_US))


class Rate:
    """Thins a stream of samples to a rate, in event time and without drift.

    Parameters
    ----------
    hertz : float
        1/s; 0 lets every sample through, a negative rate none.
    """

    __slots__ = ("_next_us", "_period_us", "hertz")

    def __init__(self, hertz: float) -> None:
        self.set(hertz)

    def set(self, hertz: float) -> None:
        """Change the rate; the next sample goes out."""
        self.hertz = hertz
        self._period_us = period_us(hertz) if hertz > 0 else 0
        self._next_us = 0

    def due(self, t_us: int) -> bool:
        """Say whether the sample at `t_us` goes out.

        Slots lie a period apart, and a sample may be early by a quarter of it, so that a jittering stream at
        just this rate passes completely. After a pause, or a step far back in time, the slots start again at
        the sample.
        """
        if self.hertz <= 0:
            return self.hertz == 0
        ahead = self._next_us - t_us
        if ahead * 4 > self._period_us:
            if ahead <= 2 * self._period_us:
                return False
        elif ahead > -self._period_us:
            self._next_us += self._period_us
            return True
        self._next_us = t_us + self._period_us
        return True
