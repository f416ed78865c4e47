r"""Batch fit of all samples so far, while the calibration is too uncertain for a filter.

A vehicle's hard iron moves the reading by thousands of nanotesla, over which the field's magnitude is not
linear: a Kalman filter that was linearised at a wrong guess stays wrong. The samples since the start are
therefore stored, and refitted by Gauss-Newton when their number has doubled. Residuals and derivatives are
whitened by the filter of :class:`.Nuisance`; with :math:`c = c_0 + L z, z \sim N(0, I)`, a step solves

.. math:: (I + L^T J^T J L)\, z = -L^T J^T (r + J (c_0 - c))
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.estimation.priors import polynomial_prior
from magbridge.learning.estimator import STATES, Nuisance
from magbridge.learning.model import LearnedTerms
from magbridge.learning.samples import Observation, Way, observe
from magbridge.records import Vector

__all__ = ["LAST_FIT_SAMPLES", "BatchFit", "BatchResult", "class_prior"]

FIRST: Final = 32
LAST_FIT_SAMPLES: Final = 4096
"""Samples at which they are fitted first and last: 2 minutes and 4.5 hours of 0.25 Hz."""
MAX_GAUSS_NEWTON_STEPS: Final = 12
"""Of Gauss-Newton, at most."""
MIN_STEP_SIGMA: Final = 0.01
"""Prior sigmas: a step this small is the last."""
NOISE: Final = 2.0
"""1-sigma of a channel's noise, until the samples say more, nT."""
MIN_SAMPLES_FOR_NOISE: Final = 256
"""Samples from which on they do."""


def class_prior(parameters: tuple[Parameter, ...], field: float = 50_000.0, order: int = 3) -> Calibration:
    """Return the prior of any vehicle: an identity and its uncertainty.

    Parameters
    ----------
    parameters : tuple of Parameter
        Moving masses of the vehicle.
    field : float
        Reference field F_0, nT.
    order : int
        Highest total degree of the polynomials.

    Notes
    -----
    The widths are those that the fit begins with (:mod:`magbridge.estimation.priors`), each with its
    own uncertainty: the mean of a log-normal's square.
    """
    exponents = full_order(len(parameters), order)
    family = polynomial_prior(exponents, tuple(one.name for one in parameters), field)
    # mean of the square of a log-normal width: exp(2 mu + 2 sigma^2)
    square = np.exp(2.0 * (family.constant + family.design @ family.centre))
    square *= np.exp(2.0 * ((family.design * family.spread) ** 2).sum(axis=1))
    return Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=exponents),),
        coefficients=np.zeros(len(square)),
        covariance=(family.E * square) @ family.E.T,
        noise=Noise(NOISE),
        reference=Reference(field),
        method="none",
    )


class BatchResult(NamedTuple):
    """What the samples say."""

    coefficients: FloatArray
    """(K,)."""
    nuisances: FloatArray
    """(4,): The nuisance after the last sample."""
    covariance: FloatArray
    """(K + 4, K + 4): Of both."""
    noise: float
    """Noise of a channel, nT, 1-sigma."""


class BatchFit:
    """Keeps the samples since the start.

    Parameters
    ----------
    model : LearnedTerms
    coefficients, covariance : (K,), (K, K) arrays
        The prior.
    field : float
        nT, F_0.
    """

    def __init__(
        self, model: LearnedTerms, coefficients: FloatArray, covariance: FloatArray, field: float
    ) -> None:
        self._model, self._prior, self._field = model, coefficients, field
        values, vectors = np.linalg.eigh(covariance)
        # square root L of a prior that may be singular
        seen = values > values[-1] * 1e-14
        self._root = vectors[:, seen] * np.sqrt(values[seen])
        self._samples: list[tuple[Vector, FloatArray, float, Way]] = []
        self._next = FIRST

    def add(self, field: Vector, phi: FloatArray, reference: float, way: Way) -> bool:
        """Keep a sample, its regressors (m,), reference and way from the last; return whether to fit."""
        self._samples.append((field, phi, reference, way))
        if len(self._samples) < self._next:
            return False
        self._next *= 2
        return True

    @property
    def fitted(self) -> bool:
        """Return True if a fit was made; before it, the filter is linearised at the prior of the class."""
        return self._next > FIRST

    @property
    def is_over(self) -> bool:
        """Whether a filter can go on alone."""
        return len(self._samples) >= LAST_FIT_SAMPLES

    def fit(self, coefficients: FloatArray, nuisance: Nuisance) -> BatchResult:
        """Fit all samples, beginning at `coefficients` (K,)."""
        c, z = coefficients, np.full(self._root.shape[1], np.inf)
        for _ in range(MAX_GAUSS_NEWTON_STEPS):
            # Gauss-Newton step in the whitened prior's coordinates z, as in the module
            r, J, nuisances, B, Pb = self._whitened(c, nuisance)
            JL = J @ self._root
            H = np.eye(JL.shape[1]) + JL.T @ JL
            before, z = z, np.asarray(np.linalg.solve(H, -JL.T @ (r + J @ (self._prior - c))))
            step = self._prior + self._root @ z - c
            c, nuisances, r = c + step, nuisances + B @ step, r + J @ step
            if float(np.abs(z - before).max()) < MIN_STEP_SIGMA:
                break
        rms = float(np.sqrt(np.mean(r * r)))
        noise = float(np.sqrt(nuisance.white_variance)) * (rms if len(r) >= MIN_SAMPLES_FOR_NOISE else 1.0)
        # joint covariance: the nuisance depends on the coefficients by B, and has Pb of its own
        both = np.vstack([np.eye(len(c)), B])  # coefficients, and the nuisance as it depends on them
        covariance = both @ (self._root @ np.linalg.solve(H, self._root.T)) @ both.T
        covariance[-STATES:, -STATES:] += Pb
        return BatchResult(c, nuisances, covariance, noise)

    def _whitened(
        self, c: FloatArray, nuisance: Nuisance
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residuals (n,) and derivatives (n, K), white; nuisance, its derivative and covariance."""
        weights = self._model.weights(c)
        n, K = len(self._samples), len(c)
        out = np.empty((n, K + 1))
        states, P = np.zeros((STATES, K + 1)), nuisance.initial.copy()
        for k, (field, phi, reference, way) in enumerate(self._samples):
            F, Q = nuisance.transition(*way)
            one: Observation = observe(field, phi @ weights, self._field, reference)
            row = np.concatenate([[one.e], self._model.derivative(phi, one.by_nine)])
            h = nuisance.row(one.s)
            # Kalman filter of the residual and of every column of J: innovations are white
            P, states = F @ P @ F.T + Q, F @ states
            Ph = P @ h
            S = float(h @ Ph) + nuisance.white_variance
            row += h @ states
            states -= np.outer(Ph / S, row)
            P -= np.outer(Ph / S, Ph)
            out[k] = row / np.sqrt(S)
        return out[:, 0], out[:, 1:], states[:, 0], states[:, 1:], P
