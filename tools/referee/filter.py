"""An autopilot's horizontal position filter, without its inertial part."""

from __future__ import annotations

from math import hypot, sqrt

Pair = tuple[float, float]


class PositionFilter:
    """Position and wind on two axes, which share one covariance: all inputs have equal variances on both.

    `position` (m) and `wind` (m/s, what carries the vehicle besides its known motion) are north and east,
    `velocity` (m/s) is over ground; `pp`, `pw`, `ww` (m², m²/s, m²/s²) are their covariance. `walk` is the
    spectral density, (m/s)²/s, of the wind's (or the velocity error's) random walk.
    """

    def __init__(self, walk: float) -> None:
        self._walk = walk
        self.position: Pair = 0.0, 0.0
        self.wind: Pair = 0.0, 0.0
        self.velocity: Pair = 0.0, 0.0
        self.pp, self.pw, self.ww = 1e6, 0.0, 1.0

    @property
    def sigma(self) -> float:
        """m, 1-sigma of the position on each axis."""
        return sqrt(self.pp)

    def predict(self, motion: Pair, dt: float) -> None:
        """Move along for `dt` s with a known `motion`, m/s.

        Notes
        -----
        A position that integrates a random walk of density q: ``Q = q [[dt³/3, dt²/2], [dt²/2, dt]]``.
        """
        self.velocity = motion[0] + self.wind[0], motion[1] + self.wind[1]
        self.position = (
            self.position[0] + self.velocity[0] * dt,
            self.position[1] + self.velocity[1] * dt,
        )
        q = self._walk
        self.pp += (2.0 * self.pw + self.ww * dt) * dt + q * dt**3 / 3.0
        self.pw += self.ww * dt + q * dt**2 / 2.0
        self.ww += q * dt

    def distance(self, place: Pair, variance: float) -> float:
        """Return how many sigmas a measured position is away."""
        away = place[0] - self.position[0], place[1] - self.position[1]
        return hypot(*away) / sqrt(2.0 * (self.pp + variance))

    def fuse(self, place: Pair, variance: float) -> None:
        """Fuse a measured position (m), as a Kalman filter does."""
        s = self.pp + variance
        self._shift(place, self.pp / s, self.pw / s)
        self.pp, self.pw, self.ww = (
            self.pp * variance / s,
            self.pw * variance / s,
            self.ww - self.pw * self.pw / s,
        )

    def force(self, place: Pair, variance: float) -> None:
        """Fuse a measured position with a position gain of 1, the wind learning from it as ever.

        Notes
        -----
        ``P = (1 - K H) P (1 - K H)' + K R K'`` with K = (1, k).
        """
        k = self.pw / (self.pp + variance)
        self._shift(place, 1.0, k)
        ww = self.ww - 2.0 * k * self.pw + k * k * (self.pp + variance)
        self.pp, self.pw, self.ww = variance, k * variance, ww

    def reset(self, place: Pair, variance: float) -> None:
        """Put the position there; nothing else is learned."""
        self.position = place
        self.pp, self.pw = variance, 0.0

    def _shift(self, place: Pair, gain: float, learned: float) -> None:
        away = place[0] - self.position[0], place[1] - self.position[1]
        self.position = self.position[0] + gain * away[0], self.position[1] + gain * away[1]
        self.wind = self.wind[0] + learned * away[0], self.wind[1] + learned * away[1]
