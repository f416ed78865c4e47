"""The straight line below a stream of points whose vertical distances, delays, are never negative.

Each block of points gives its lowest one, and a line is fitted to the lowest points of the last blocks.
"""

from __future__ import annotations

from math import inf
from typing import Final

__all__ = ["TOLERANCE", "Floor"]

FIRST_BLOCK_READINGS: Final = 8
"""Readings in the first blocks."""
LINE_POINTS: Final = 16
"""Lowest points that the line is fitted to."""
SPAN: Final = 4.0
"""s: blocks grow to this duration, and every point must be late for this long before the line is given up,
since a busy computer may delay all points for a second."""
TOLERANCE: Final = 20_000.0
"""µs by which an arrival may contradict the line."""
INITIAL_DELAY_US: Final = 5_000.0
"""µs, the mean delay before anything is known."""
STALL: Final = 100_000.0
"""µs; longer delays enter the mean delay as this, because they say nothing about the usual ones."""
WANDER: Final = 0.05
"""Fraction of the prior sigma below which the slope's sigma never falls: rates change with temperature."""
BOUND: Final = 5.0
"""Largest slope, in prior sigmas."""


class Floor:
    """The straight line below the points (x, y): x in s, y in µs.

    Notes
    -----
    With the lowest points (x_k, y_k) of the blocks, their mean (X, Y), and b_0 the prior mean of the slope::

        b   = b_0 + sum (x_k - X) (y_k - Y - b_0 (x_k - X)) / S,   S = sum (x_k - X)^2 + (s / s_b)^2
        s_b = s / sqrt(S)                                          afterwards

    which is least squares with a Gaussian prior of width `s_b` on the slope; s, the scatter of the lowest
    points, is the mean delay over the number of readings in a block, as it is for exponential delays.
    """

    def __init__(self, slope_sigma: float) -> None:
        self._prior_sigma = slope_sigma
        self.slope = 0.0
        self.delay = INITIAL_DELAY_US
        self.restart(0.0, 0.0)

    def restart(self, x: float, y: float) -> None:
        """Begin a new line at a point; the slope so far becomes the mean of its prior."""
        self._prior = self.slope
        self._sigma = self._prior_sigma
        self._points: list[tuple[float, float]] = []
        self._x, self._y = x, y
        self._drop = 0.0
        self._size = FIRST_BLOCK_READINGS
        self._count = 0
        self._began, self._least, self.lowest = x, inf, (x, y)
        self._late_from = inf

    def value_at(self, x: float) -> float:
        """Return the line at `x`, in µs."""
        return self._y + self.slope * (x - self._x) + self._drop

    @property
    def scatter(self) -> float:
        """1-sigma scatter of the blocks' lowest points, in µs."""
        return self.delay / self._size + 1.0

    def tolerance(self, x: float) -> float:
        """Return by how much a point at `x` may reasonably contradict the line, in µs."""
        return TOLERANCE + 3.0 * self._sigma * abs(x - self._x)

    def add(self, x: float, y: float, above: float, limit: float) -> float:
        """Take a point that lies `above` the line (µs); return by how much the line has risen, else 0.

        That is the height of a block's lowest point above the line, once all blocks for `SPAN` lay more than
        `limit` above it. Such blocks are left out of the fit; `lowest` is the lowest point of the last one
        until a point is added.
        """
        if not self._count:
            self._began, self._least = x, inf
        self.delay += (max(0.0, min(above, STALL)) - self.delay) * 0.02
        if above < self._least:
            self._least, self.lowest = max(above, 0.0), (x, y)
            self._drop += min(above, 0.0)
        self._count += 1
        if self._count < self._size:
            return 0.0
        self._count = 0
        if self._least > limit:
            self._late_from = min(self._late_from, self._began)
            return self._least if x - self._late_from >= SPAN else 0.0
        self._late_from = inf
        self._points.append(self.lowest)
        if len(self._points) == LINE_POINTS:
            self._thin(x - self._began)
        self._fit()
        return 0.0

    def _thin(self, duration: float) -> None:
        """Shorten the list: join short blocks in pairs; once they last `SPAN`, drop the oldest instead."""
        if duration >= SPAN:
            del self._points[0]
            return
        self._size *= 2
        pairs = zip(self._points[::2], self._points[1::2], strict=True)
        self._points = [min(pair, key=lambda point: point[1] - self.slope * point[0]) for pair in pairs]

    def _fit(self) -> None:
        points = self._points
        x = y = sxx = sxy = 0.0
        for x_k, y_k in points:  # in loops: sum() adds differently in Python 3.12 than before, and compiled
            x += x_k
            y += y_k
        x, y = x / len(points), y / len(points)
        for x_k, y_k in points:
            sxx += (x_k - x) ** 2
            sxy += (x_k - x) * (y_k - y)
        information = sxx + (self.scatter / self._prior_sigma) ** 2
        slope = self._prior + (sxy - self._prior * sxx) / information
        self.slope = max(-BOUND * self._prior_sigma, min(slope, BOUND * self._prior_sigma))
        self._sigma = max(self.scatter / information**0.5, WANDER * self._prior_sigma)
        self._x, self._y, self._drop = x, y, 0.0
