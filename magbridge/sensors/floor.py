"""The straight line that lies below a stream of points: what is left of delays that are never negative.

Each block of points gives its lowest one, and a line is fitted to the lowest points of the last blocks.
"""

from __future__ import annotations

from math import inf

__all__ = ["TOLERANCE", "Floor"]

BLOCK = 8
"""Readings in the first blocks."""
POINTS = 16
"""Lowest points that the line is fitted to."""
SPAN = 4.0
"""s that a block grows to, and for which every point is late before the line is believed to be another: a
computer that is busy with something else delays them for a second."""
TOLERANCE = 20_000.0
"""µs by which an arrival may contradict the line."""
DELAY = 5_000.0
"""µs, the mean delay before anything is known."""
STALL = 100_000.0
"""µs, a delay that tells nothing of the usual ones any more."""
WANDER = 0.05
"""Part of that which always remains: rates change with temperature."""
BOUND = 5.0
"""Widths of the prior that a rate may be off."""


class Floor:
    """The straight line below the points (x, y): x in s, y in µs.

    Notes
    -----
    With the lowest points (x_k, y_k) of the blocks, their mean (X, Y), and b_0 what was known of the slope::

        b   = b_0 + sum (x_k - X) (y_k - Y - b_0 (x_k - X)) / S,   S = sum (x_k - X)^2 + (s / s_b)^2
        s_b = s / sqrt(S)                                          afterwards

    which is least squares with a Gaussian prior of width `s_b` on the slope; s, the scatter of the lowest
    points, is the mean delay over the number of readings in a block, as it is for exponential delays.
    """

    def __init__(self, slope_sigma: float) -> None:
        self._prior_sigma = slope_sigma
        self.slope = 0.0
        self.delay = DELAY
        self.restart(0.0, 0.0)

    def restart(self, x: float, y: float) -> None:
        """Begin anew at a point; the slope is kept as what is known of it."""
        self._prior = self.slope
        self._sigma = self._prior_sigma
        self._points: list[tuple[float, float]] = []
        self._x, self._y = x, y
        self._drop = 0.0
        self._size = BLOCK
        self._count = 0
        self._began, self._least, self.lowest = x, inf, (x, y)
        self._late_from = inf

    def at(self, x: float) -> float:
        """Return the line at `x`, in µs."""
        return self._y + self.slope * (x - self._x) + self._drop

    @property
    def scatter(self) -> float:
        """How far the lowest points of blocks scatter, in µs."""
        return self.delay / self._size + 1.0

    def tolerance(self, x: float) -> float:
        """Return by how much a point at `x` may reasonably contradict the line, in µs."""
        return TOLERANCE + 3.0 * self._sigma * abs(x - self._x)

    def add(self, x: float, y: float, above: float, limit: float) -> float:
        """Take a point, `above` the line; return by how much all of `SPAN` exceeded `limit` (else 0).

        Such a block is not taken; `lowest` is its lowest point until the next one is added.
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
        if len(self._points) == POINTS:
            self._thin(x - self._began)
        self._fit()
        return 0.0

    def _thin(self, duration: float) -> None:
        """Make room: join blocks in pairs while they are short, else forget the oldest."""
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
