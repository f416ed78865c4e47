"""One sample against its reference, which samples are learned from, and the terms that are learned.

The equations of :func:`observe` are those of :mod:`magbridge.estimation.residual`, for one sample and without
scipy: the live path runs here. At most ``max_rate`` samples a second are learned from, each once newer
telemetry has come.

The terms are the calibration's own, and offsets that follow the temperature or a current
(:class:`~magbridge.calibration.effects.ChannelEffect`). The coefficients of the latter start at zero with
zero variance; a hypothesis or an alarm gives them a variance. A learned calibration contains the terms with
non-zero coefficients.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import hypot, isnan, nan, sqrt
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.model import Calibration, coefficient_tensor
from magbridge.columns import TEMPERATURE
from magbridge.errors import CalibrationError
from magbridge.estimation.track_process import Course
from magbridge.field.geodesy import separation
from magbridge.records import Vector

__all__ = ["Intake", "LearnedTerms", "LearningSample", "Observation", "Way", "observe"]


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

    `nine` (9,) are the coefficients of A (as ``(A - I) F_0``) and of T at the sample's positions, nT; `kappa`
    is the noise of the reference over the sensor's.
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


MAX_WAITING_SAMPLES: Final = 64
"""Samples that wait for newer telemetry, at most: the first are then left out."""
SHORTAGE_US: Final = 3_600_000_000
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
    """Hold the samples until newer telemetry has come, at most `max_rate` (Hz) of them."""

    def __init__(self, max_rate: float) -> None:
        self._period_us = round(1e6 / max_rate)
        self._held: deque[LearningSample] = deque(maxlen=MAX_WAITING_SAMPLES)
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
        if time_us - self._last_us <= SHORTAGE_US or self._reported_us == self._last_us:
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


class LearnedTerms:
    """A calibration's terms, and offsets that follow the temperature and `currents` (telemetry in ampere).

    Attributes
    ----------
    parameters, watched, further : tuple of str
        Names of the calibration's parameters; the temperature and the currents; and those of them that the
        calibration does not follow itself.
    size : int
        Number of coefficients K with those of the further terms, three a channel.
    offsets : (3,) int array
        Which coefficients are the constant offset of x, y and z.

    Raises
    ------
    CalibrationError
        The calibration has no constant offset.
    """

    def __init__(self, calibration: Calibration, currents: tuple[str, ...]) -> None:
        self._base = calibration
        self.parameters = tuple(parameter.name for parameter in calibration.parameters)
        self.watched = (TEMPERATURE, *currents)
        self._further = [k for k, name in enumerate(self.watched) if name not in calibration.channels]
        self.further = tuple(self.watched[k] for k in self._further)
        self._origins = [nan if name == TEMPERATURE else 0.0 for name in self.watched]
        self._regressors = [0.0] * len(self._further)
        extended = self._extended(self._further)
        self.size, self._own = extended.coefficients.size, calibration.coefficients.size
        # the nine coefficients are linear in the coefficients and in the regressors: a tensor (K, m, 9)
        self._tensor, exponents = coefficient_tensor(extended)
        self._flat = self._tensor.reshape(len(self._tensor), -1)
        self._terms = self._tensor.shape[1] - len(self._further)
        self._rows = {
            name: row
            for k, name in enumerate(self.parameters)
            for row, powers in enumerate(exponents)
            if sum(powers) == powers[k] == 1
        }
        row = len(exponents)
        for effect in extended.effects:
            if isinstance(effect, ChannelEffect):
                self._rows[effect.channel] = row
            row += effect.columns(calibration.reference.field).shape[1]
        offsets = self._offset_slots(0)
        if offsets is None:
            raise CalibrationError("a calibration without a constant offset is not learned")
        self.offsets = offsets

    def _extended(self, terms: Sequence[int]) -> Calibration:
        """Return the calibration with further terms, whose coefficients are 0."""
        base = self._base
        effects = tuple(
            ChannelEffect(
                cause="temperature_offset" if self.watched[k] == TEMPERATURE else "current_field",
                channel=self.watched[k],
                origin=0.0 if isnan(self._origins[k]) else self._origins[k],
            )
            for k in terms
        )
        own, more = base.coefficients.size, 3 * len(effects)
        covariance = np.zeros((own + more, own + more))
        # the further terms have no variance until a hypothesis or an alarm gives them one
        covariance[:own, :own] = base.covariance
        return replace(
            base,
            effects=base.effects + effects,
            coefficients=np.concatenate([base.coefficients, np.zeros(more)]),
            covariance=covariance,
        )

    def _offset_slots(self, row: int) -> IndexArray | None:
        """Return which coefficients add one regressor to the offset of x, y and z, and do nothing else."""
        found = []
        for axis in range(3):
            only = np.zeros(self._tensor.shape[1:])
            # a coefficient of the offset moves one of the last three of the nine, by one regressor
            only[row, 6 + axis] = 1.0
            same = np.flatnonzero((self._tensor == only).all(axis=(1, 2)))
            if not same.size:
                return None
            found.append(int(same[0]))
        return np.array(found)

    def slots(self, name: str) -> IndexArray | None:
        """Return the coefficients (3,) by which the offset follows a parameter or channel, if it may."""
        row = self._rows.get(name)
        return None if row is None else self._offset_slots(row)

    def origin(self, name: str) -> float:
        """Return the value of a channel at which its term is zero; 0 for a parameter, which is scaled."""
        if name in self.watched and self.watched.index(name) in self._further:
            return self._origins[self.watched.index(name)]
        effects = [effect for effect in self._base.effects if isinstance(effect, ChannelEffect)]
        return next((effect.origin for effect in effects if effect.channel == name), 0.0)

    def scaled(self, values: Sequence[float]) -> list[float]:
        """Return the parameters' values (the first of the calibration's channels) in their scale."""
        return [(v - one.centre) / one.scale for v, one in zip(values, self._base.parameters, strict=False)]

    def regressors(self, calibrated: Sequence[float], watched: Sequence[float]) -> FloatArray:
        """Return all regressors (m,): the calibration's `calibrated`, and those of the `watched` channels."""
        for place, k in enumerate(self._further):
            value = watched[k]
            if not isnan(value):  # while the value is unknown, the last one holds
                # the first known temperature is the origin, so that the term starts at zero
                if isnan(self._origins[k]):
                    self._origins[k] = value
                self._regressors[place] = value - self._origins[k]
        return np.array([*calibrated[: self._terms], *self._regressors])

    def weights(self, coefficients: FloatArray) -> FloatArray:
        """Return (m, 9) what each regressor adds to the nine coefficients, nT."""
        return np.asarray((coefficients @ self._flat).reshape(self._tensor.shape[1:]))

    def derivative(self, phi: FloatArray, by_nine: FloatArray) -> FloatArray:
        """Return (K,) derivative by the coefficients of what changes with the nine by `by_nine` (9,)."""
        return np.asarray(self._flat @ np.outer(phi, by_nine).ravel())

    def _index(self, used: Sequence[int]) -> IndexArray:
        """Return which of the K coefficients a calibration has that carries the further terms `used`."""
        places = [self._further.index(k) for k in used]
        further = [self._own + 3 * place + axis for place in places for axis in range(3)]
        return np.array([*range(self._own), *further])

    def coefficients(self, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
        """Return (K,) and covariance (K, K) of a calibration that :meth:`calibration` made, or the first."""
        names = [name for name in calibration.channels if name not in self._base.channels]
        index = self._index([self.watched.index(name) for name in names])
        coefficients, covariance = np.zeros(self.size), np.zeros((self.size, self.size))
        coefficients[index] = calibration.coefficients
        covariance[np.ix_(index, index)] = calibration.covariance
        return coefficients, covariance

    def calibration(self, coefficients: FloatArray, covariance: FloatArray) -> Calibration:
        """Return the calibration with coefficients (K,) and covariance (K, K), without terms of zero."""
        by_further = coefficients[self._own :].reshape(-1, 3)
        used = [k for k, three in zip(self._further, by_further, strict=True) if three.any()]
        index = self._index(used)
        return replace(
            self._extended(used),
            coefficients=coefficients[index],
            covariance=covariance[np.ix_(index, index)],
        )
