"""One sample against its reference, and which samples are learned from.

The equations of :func:`observe` are those of :mod:`magbridge.estimation.residual`, for one sample and without
scipy: the live path runs here. At most ``max_rate`` samples a second are learned from, each once newer
telemetry has come.
"""

from __future__ import annotations

from collections import deque
from math import hypot, sqrt
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.estimation.track_process import Course
from magbridge.field.geodesy import separation
from magbridge.records import Vector

__all__ = ["Intake", "LearningSample", "Observation", "Way", "observe"]


class Observation(NamedTuple):
    """Residual ``e = (|A (H_r - T)| - H_e) / s`` (nT), s, and de by the nine coefficients (9,)."""

    e: float
    s: float
    by_nine: FloatArray

    @property
    def direction(self) -> FloatArray:
        """Direction of the field in sensor axes (3,), up to the soft iron."""
        return -self.s * self.by_nine[6:]


def observe(field: Vector, nine: FloatArray, F_0: float, reference: float, kappa: float = 0.0) -> Observation:
    """Compare one sample with its reference.

    Parameters
    ----------
    field : tuple of 3 float
        nT, raw, sensor axes.
    nine : (9,) array
        nT, the coefficients of A (as ``(A - I) F_0``) and of T at the sample's positions.
    F_0 : float
        nT, the total field that they refer to.
    reference : float
        nT, H_e.
    kappa : float
        Noise of the reference over the sensor's.
    """
    axx, ayy, azz, axy, axz, ayz, tx, ty, tz = nine.tolist()
    # A and b = A (H_r - T), written out: numpy would cost ten times as much
    xx, yy, zz = 1.0 + axx / F_0, 1.0 + ayy / F_0, 1.0 + azz / F_0
    xy, xz, yz = axy / F_0, axz / F_0, ayz / F_0
    dx, dy, dz = field[0] - tx, field[1] - ty, field[2] - tz
    bx, by, bz = xx * dx + xy * dy + xz * dz, xy * dx + yy * dy + yz * dz, xz * dx + yz * dy + zz * dz
    F = sqrt(bx * bx + by * by + bz * bz)
    ux, uy, uz = bx / F, by / F, bz / F
    # w = A^T u; s^2 = kappa^2 + w^T w, the variance of the residual over the sensor's
    wx, wy, wz = xx * ux + xy * uy + xz * uz, xy * ux + yy * uy + yz * uz, xz * ux + yz * uy + zz * uz
    s2 = kappa * kappa + wx * wx + wy * wy + wz * wz
    s = sqrt(s2)
    e = (F - reference) / s
    # derivative of s: dA enters by A w
    vx, vy, vz = xx * wx + xy * wy + xz * wz, xy * wx + yy * wy + yz * wz, xz * wx + yz * wy + zz * wz
    # the part of v along the field does not turn it, so it is left out of the derivative by the direction
    along = ux * vx + uy * vy + uz * vz
    k = e / s2
    kF = k / F
    zx, zy, zz_ = (
        ux / s - kF * (vx - ux * along),
        uy / s - kF * (vy - uy * along),
        uz / s - kF * (vz - uz * along),
    )
    # first the six of A, diagonal then off-diagonal, then the three of T
    by_nine = np.array(
        (
            (zx * dx - k * wx * ux) / F_0,
            (zy * dy - k * wy * uy) / F_0,
            (zz_ * dz - k * wz * uz) / F_0,
            (zx * dy + zy * dx - k * (wx * uy + wy * ux)) / F_0,
            (zx * dz + zz_ * dx - k * (wx * uz + wz * ux)) / F_0,
            (zy * dz + zz_ * dy - k * (wy * uz + wz * uy)) / F_0,
            -(xx * zx + xy * zy + xz * zz_),
            -(xy * zx + yy * zy + yz * zz_),
            -(xz * zx + yz * zy + zz * zz_),
        )
    )
    return Observation(e, s, by_nine)


MOST_HELD: Final = 64
"""Samples that wait for newer telemetry, at most: the first are then left out."""
SHORT_US: Final = 3_600_000_000
"""Time without a usable sample after which the bridge sends a notification, µs."""


class LearningSample(NamedTuple):
    """One that may be learned from, unless it is `faulty`: see :meth:`.Learner.sample`.

    ``phi`` (m,) are all regressors, ``positions`` the masses', scaled.
    """

    time_us: int
    field: Vector
    reference: float
    phi: FloatArray
    positions: list[float]
    where: tuple[float, float]
    watched: tuple[float, ...]
    faulty: bool


class Way(NamedTuple):
    """The way from one sample to the next."""

    metres: float
    seconds: float
    turn: float
    """Change of the course, rad."""


class Intake:
    """Holds the samples that wait.

    Parameters
    ----------
    max_rate : float
        Hz.
    """

    def __init__(self, max_rate: float) -> None:
        self._period_us = round(1e6 / max_rate)
        self._held: deque[LearningSample] = deque(maxlen=MOST_HELD)
        self._last_us = self._looked_us = self._taken_us = self._reported_us = 0
        self._where: tuple[float, float] | None = None
        self._newest = False
        self._course = Course()

    def due(self, time_us: int, *, fit: bool) -> bool:
        """Return whether it is time for another sample, `fit` to learn from or not."""
        return not 0 <= time_us - (self._taken_us if fit else self._looked_us) < 0.99 * self._period_us

    def drop(self) -> None:
        """Discard the waiting sample, because a mass had begun to move or the sensor was power-cycled."""
        self._held.clear()

    def confirmed(self, time_us: int, age: float) -> list[LearningSample]:
        """Return those that waited for a sample now, at which nothing moves, with telemetry `age` (s) old."""
        self._looked_us = time_us
        out = []
        # a sample is confirmed by telemetry that is newer than it
        while self._held and self._held[0].time_us < time_us - age * 1e6:
            out.append(self._held.popleft())
        return out

    def wait(self, sample: LearningSample) -> None:
        """Store a sample until newer telemetry arrives."""
        if not sample.faulty:
            self._taken_us = sample.time_us
        self._held.append(sample)
        self._newest = True

    def settle(self, field: Vector | None) -> None:
        """Correct the waiting sample's field (nT) from the next reading, if a sample waits."""
        if self._newest and self._held and field is not None:
            self._held[-1] = self._held[-1]._replace(field=field)
        self._newest = False

    def short(self, time_us: int) -> bool:
        """Count an unusable sample; return True if a notification of the shortage is due."""
        self._last_us = self._last_us or time_us
        if time_us - self._last_us <= SHORT_US or self._reported_us == self._last_us:
            return False
        self._reported_us = self._last_us
        return True

    def moved(self, sample: LearningSample) -> Way:
        """Return the way from the last sample that was taken, which this one is now."""
        before, last_us = self._where or sample.where, self._last_us or sample.time_us
        self._where, self._last_us = sample.where, sample.time_us
        north, east = separation(*before, *sample.where)
        seconds = max(sample.time_us - last_us, 0) * 1e-6
        return Way(hypot(north, east), seconds, self._course.move(north, east))
