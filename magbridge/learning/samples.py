"""Compute the residual of a sample, select the samples for learning, and define the learned terms.

The equations of :func:`observe` are those of :mod:`magbridge.estimation.residual`, for one sample and
without scipy, because they run in the live path. Learning uses at most ``max_rate`` samples a second, each
once newer telemetry has come.

The terms are the calibration's own, and offsets that follow the temperature or a current
(:class:`~magbridge.calibration.effects.ChannelEffect`). The coefficients of these offsets start at zero with
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
from magbridge.records import NEVER, Vector


class Observation(NamedTuple):
    """Residual ``e = (|A (H_r - T)| - H_e) / s`` of one sample (nT), and its scale s.

    `by_nine` (9,) is the derivative of e by the nine coefficients of A and T, see :func:`observe`.
    """

    e: float
    s: float
    by_nine: FloatArray

    @property
    def direction(self) -> FloatArray:
        """Direction of the field in sensor axes (3,), exact for A = I."""
        return -self.s * self.by_nine[6:]


def observe(field: Vector, nine: FloatArray, F_0: float, reference: float) -> Observation:
    """Return the residual of one sample's raw `field` (nT) against its `reference` total field (nT).

    `nine` (9,) are the coefficients at the sample's mass positions, nT: six of A (as ``(A - I) F_0``: xx, yy,
    zz, xy, xz, yz) and three of T.
    """
    xx, yy, zz, xy, xz, yz = (nine[:6] / F_0).tolist()
    A = np.array(((1.0 + xx, xy, xz), (xy, 1.0 + yy, yz), (xz, yz, 1.0 + zz)))
    # corrected vector A (H_r - T), its length F and direction u
    d = np.array(field) - nine[6:]
    b = A @ d
    F = sqrt(b @ b)
    u = b / F
    # w = A^T u; s^2 = w^T w, the variance of the residual over the sensor's
    w = A @ u
    s2 = float(w @ w)
    s = sqrt(s2)
    e = (F - reference) / s
    # derivative of e by b, through F and through s; the part of A w along u cancels
    v, k = A @ w, e / s2
    z = u / s - k / F * (v - u * (u @ v))
    # derivative by the elements of A; an off-diagonal element occurs at two places
    by_A = z[:, None] * d - k * (w[:, None] * u)
    both = by_A + by_A.T
    by_six = np.array((by_A[0, 0], by_A[1, 1], by_A[2, 2], both[0, 1], both[0, 2], both[1, 2]))
    return Observation(e, s, np.concatenate([by_six / F_0, -(A @ z)]))


MAX_WAITING_SAMPLES: Final = 64
"""Largest number of samples that wait for newer telemetry; the oldest are then discarded."""
SHORTAGE_US: Final = 3_600_000_000
"""Time without a usable sample after which the bridge sends a notification, µs."""


class LearningSample(NamedTuple):
    """Sample to learn from; a sample of a `faulty` sensor only serves the test of late telemetry.

    `field` is raw (nT, sensor axes), `reference` the reference total field (nT), `phi` (m,) all regressors.
    `positions` are the scaled mass positions, `where` latitude and longitude (deg), and `watched` the values
    of the channels :attr:`.Learner.watched`.
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
    """Distance (m), time (s) and change of course from one sample to the next."""

    metres: float
    seconds: float
    turn: float
    """Change of the course, rad."""


class Intake:
    """Queue of samples that wait for newer telemetry; it accepts samples at `max_rate` (Hz) at most."""

    def __init__(self, max_rate: float) -> None:
        self._period_us = round(1e6 / max_rate)
        self._held: deque[LearningSample] = deque(maxlen=MAX_WAITING_SAMPLES)
        self._last_us = self._looked_us = self._taken_us = self._reported_us = NEVER
        self._where: tuple[float, float] | None = None
        self._newest = False
        self._course = Course()

    def due(self, time_us: int, *, fit: bool) -> bool:
        """Return True if another sample is due; `fit` is True if learning can use the present sample."""
        return not 0 <= time_us - (self._taken_us if fit else self._looked_us) < 0.99 * self._period_us

    def drop(self) -> None:
        """Discard the waiting samples, because a mass had begun to move or the sensor was power-cycled."""
        self._held.clear()

    def confirmed(self, time_us: int, age: float) -> list[LearningSample]:
        """Remove and return the samples older than the telemetry, whose age is `age` (s) at `time_us`."""
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
        """Replace the newest sample's field by a more exact `field` (nT), if the sample still waits."""
        if self._newest and self._held and field is not None:
            self._held[-1] = self._held[-1]._replace(field=field)
        self._newest = False

    def short(self, time_us: int) -> bool:
        """Record an unusable sample; return True if a notification about the lack of samples is due."""
        if self._last_us == NEVER:
            self._last_us = time_us
        if time_us - self._last_us <= SHORTAGE_US or self._reported_us == self._last_us:
            return False
        self._reported_us = self._last_us
        return True

    def moved(self, sample: LearningSample) -> Way:
        """Return distance, time and turn from the previous call's sample to `sample`."""
        before = self._where or sample.where
        last_us = sample.time_us if self._last_us == NEVER else self._last_us
        self._where, self._last_us = sample.where, sample.time_us
        north, east = separation(*before, *sample.where)
        seconds = max(sample.time_us - last_us, 0) * 1e-6
        return Way(hypot(north, east), seconds, self._course.move(north, east))


class LearnedTerms:
    """Terms that learning estimates: the calibration's, and offsets that follow temperature or currents.

    `currents` are the names of telemetry in ampere, `parameters` those of the calibration's parameters.
    `watched` are the temperature and the currents; `further` are the watched channels for which the
    calibration has no term. `size` is the number K of coefficients, with three for each further channel.
    `offsets` (3,) are the indices of the constant offset. `field` is the reference field F_0, nT.

    Raises
    ------
    CalibrationError
        The calibration has no constant offset.
    """

    def __init__(self, calibration: Calibration, currents: tuple[str, ...]) -> None:
        self._base, self.field = calibration, calibration.reference.field
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
        """Return the calibration with further `terms` (indices of `watched`), whose coefficients are 0."""
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
        """Return the indices (3,) of the coefficients that only add the regressor `row` to the offsets.

        Return None if an axis has no such coefficient.
        """
        found = []
        for axis in range(3):
            only = np.zeros(self._tensor.shape[1:])
            # a coefficient of the offset changes one of the three coefficients of T, by one regressor
            only[row, 6 + axis] = 1.0
            same = np.flatnonzero((self._tensor == only).all(axis=(1, 2)))
            if not same.size:
                return None
            found.append(int(same[0]))
        return np.array(found)

    def slots(self, name: str) -> IndexArray | None:
        """Return the indices (3,) of the coefficients by which the offset follows a parameter or channel.

        Return None if the offset has no such coefficients.
        """
        row = self._rows.get(name)
        return None if row is None else self._offset_slots(row)

    def origin(self, name: str) -> float:
        """Return the value of a channel at which its term is zero; 0 for a parameter, which is scaled."""
        if name in self.watched and self.watched.index(name) in self._further:
            return self._origins[self.watched.index(name)]
        effects = [effect for effect in self._base.effects if isinstance(effect, ChannelEffect)]
        return next((effect.origin for effect in effects if effect.channel == name), 0.0)

    def scaled(self, values: Sequence[float]) -> list[float]:
        """Return the parameters (the first of the `values`), centred and divided by their scales."""
        return [(v - one.centre) / one.scale for v, one in zip(values, self._base.parameters, strict=False)]

    def regressors(self, calibrated: Sequence[float], watched: Sequence[float]) -> FloatArray:
        """Return all regressors (m,): the calibration's `calibrated`, and the further ones of `watched`."""
        for place, k in enumerate(self._further):
            value = watched[k]
            if not isnan(value):  # an unknown value leaves the last one in force
                # the first known temperature is the origin, so that the term starts at zero
                if isnan(self._origins[k]):
                    self._origins[k] = value
                self._regressors[place] = value - self._origins[k]
        return np.array([*calibrated[: self._terms], *self._regressors])

    def weights(self, coefficients: FloatArray) -> FloatArray:
        """Return the weights (m, 9) of the regressors in the nine coefficients of :func:`observe`, nT."""
        return np.asarray((coefficients @ self._flat).reshape(self._tensor.shape[1:]))

    def observe(
        self, field: Vector, phi: FloatArray, coefficients: FloatArray, reference: float
    ) -> Observation:
        """Observe a raw field (nT), as :func:`observe`, with coefficients (K,) at the regressors (m,)."""
        return observe(field, phi @ self.weights(coefficients), self.field, reference)

    def derivative(self, phi: FloatArray, by_nine: FloatArray) -> FloatArray:
        """Convert a derivative by the nine coefficients (9,) to a derivative by all K coefficients (K,)."""
        return np.asarray(self._flat @ (phi[:, None] * by_nine).ravel())

    def _index(self, used: Sequence[int]) -> IndexArray:
        """Return the indices of the coefficients of a calibration with the further channels `used`."""
        places = [self._further.index(k) for k in used]
        further = [self._own + 3 * place + axis for place in places for axis in range(3)]
        return np.array([*range(self._own), *further])

    def coefficients(self, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
        """Return a calibration's coefficients (K,) and covariance (K, K), 0 for terms that it lacks."""
        names = [name for name in calibration.channels if name not in self._base.channels]
        index = self._index([self.watched.index(name) for name in names])
        coefficients, covariance = np.zeros(self.size), np.zeros((self.size, self.size))
        coefficients[index] = calibration.coefficients
        covariance[np.ix_(index, index)] = calibration.covariance
        return coefficients, covariance

    def calibration(self, coefficients: FloatArray, covariance: FloatArray) -> Calibration:
        """Return the calibration with coefficients (K,) and covariance (K, K), without further terms of 0."""
        by_further = coefficients[self._own :].reshape(-1, 3)
        used = [k for k, three in zip(self._further, by_further, strict=True) if three.any()]
        index = self._index(used)
        return replace(
            self._extended(used),
            coefficients=coefficients[index],
            covariance=covariance[np.ix_(index, index)],
        )
