"""Terms to learn: a calibration's own, and offsets that follow the temperature or a current.

The latter are terms of the same model (:class:`~magbridge.calibration.effects.ChannelEffect`). Their
coefficients start at zero with zero variance; a hypothesis or an alarm gives them a variance. A learned
calibration contains the terms with non-zero coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isnan, nan

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.model import Calibration, coefficient_tensor
from magbridge.columns import TEMPERATURE
from magbridge.errors import CalibrationError

__all__ = ["LearnedTerms"]


class LearnedTerms:
    """A calibration's terms, and further ones.

    Parameters
    ----------
    calibration : Calibration
    currents : tuple of str
        Names of telemetry in ampere.

    Attributes
    ----------
    parameters : tuple of str
        Names of the calibration's.
    watched : tuple of str
        The temperature and the currents.
    further : tuple of str
        Of these, which the calibration does not follow itself.
    size : int
        K, of coefficients with those of the further terms, three a channel.
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
        """Return a calibration of these (K,) and (K, K), with the further terms that are not zero."""
        by_further = coefficients[self._own :].reshape(-1, 3)
        used = [k for k, three in zip(self._further, by_further, strict=True) if three.any()]
        index = self._index(used)
        return replace(
            self._extended(used),
            coefficients=coefficients[index],
            covariance=covariance[np.ix_(index, index)],
        )
