"""The recent telemetry of a parameter: its value at a time, how old that is, and whether it moves."""

from __future__ import annotations

from collections import deque
from math import isfinite, nan
from typing import Final, NamedTuple

__all__ = ["NEVER", "Input", "Track"]

NEVER: Final = -(1 << 62)
TRACK_LENGTH: Final = 1024
"""Telemetry values kept for each parameter: enough for 20 s at 50 Hz."""


class Input(NamedTuple):
    """A parameter that the calibration needs: name, calibrated range, and age (s) from which it is stale.

    `is_mass` is False where a change is not a motion: a current, a temperature.
    """

    name: str
    low: float
    high: float
    max_age: float
    is_mass: bool = True


class Track:
    """The recent telemetry of one parameter.

    The parameter is moving when it differs from an anchor, an earlier value, by more than ``moving_rate``
    (fraction of its calibrated range per second) times the time elapsed, which counts as at least 1 s: over
    shorter times the noise of the telemetry would look like motion. The first value that comes 1 s or more
    after the anchor becomes the next anchor.
    """

    __slots__ = (
        "anchor", "before", "first_us", "guess", "guess_us", "history", "input", "lacking", "last", "last_us",
        "max_age", "moved_us",
    )  # fmt: skip

    def __init__(self, quantity: Input) -> None:
        self.input, self.max_age = quantity, quantity.max_age
        self.history: deque[tuple[int, float]] = deque(maxlen=TRACK_LENGTH)
        self.last_us, self.last, self.before = NEVER, nan, nan  # the newest, and the value before it
        self.first_us = NEVER
        # between these times its values are guessed, and lie between these
        self.guess_us, self.guess = (NEVER, NEVER), (nan, nan)
        self.lacking = True
        self.anchor: tuple[int, float] | None = None
        self.moved_us = NEVER

    def update(self, time_us: int, value: float, moving_rate: float, since_us: int = 0) -> None:
        """Take a telemetry value; NaN means unknown from now on. One older than the last is ignored.

        One that was true at an unknown time since `since_us` (µs, if not 0) is taken as of `time_us`.
        """
        self.lacking = not isfinite(value)
        if self.lacking:
            return
        if time_us < self.last_us:
            return
        if since_us:
            low, high = self.guess if self.guess_us[0] == since_us else (self.last, self.last)
            self.guess_us = since_us, time_us
            self.guess = (min(low, value), max(high, value)) if isfinite(low) else (value, value)
        if time_us == self.last_us:  # of several that came at once, the newest
            self.history.pop()
        else:
            self.before = self.last if self.history else value
        self.last_us, self.last = time_us, value
        self.history.append((time_us, value))
        self.first_us = self.history[0][0]
        if self.anchor is None:
            self.anchor = time_us, value
        anchor_us, anchor = self.anchor
        elapsed = (time_us - anchor_us) * 1e-6
        if abs(value - anchor) > moving_rate * (self.input.high - self.input.low) * max(elapsed, 1.0):
            self.moved_us = time_us
        if elapsed >= 1.0:
            self.anchor = time_us, value

    def stale(self, time_us: int) -> bool:
        """Return True if the value is unknown, or older than ``max_age``, at `time_us`."""
        return self.lacking or time_us - self.last_us > self.max_age * 1e6

    @property
    def reported_before_us(self) -> int:
        """Time of the report before the last one, µs."""
        return self.history[-2][0] if len(self.history) > 1 else self.last_us

    def extremes_since(self, begin_us: int) -> tuple[float, float]:
        """Return the least and the greatest value since `begin_us`, including the value held then."""
        low = high = self.last
        for then_us, value in reversed(self.history):
            low, high = min(low, value), max(high, value)
            if then_us <= begin_us:
                break
        return low, high

    def value_at(self, time_us: int) -> tuple[float, float, float, float]:
        """Return the value at `time_us`, its age in s, and two values between which a moving mass is.

        Between two values it is interpolated (age 0); after the last it is held; before the first, the first
        is taken, and the age is the time until then.
        """
        after_us, after = self.last_us, self.last
        if after_us <= time_us:
            return after, (time_us - after_us) * 1e-6, self.before, after
        for then_us, value in reversed(self.history):
            if then_us <= time_us:
                weight = (time_us - then_us) / (after_us - then_us)
                return value + weight * (after - value), 0.0, value, after
            after_us, after = then_us, value
        return after, (after_us - time_us) * 1e-6, after, after
