r"""Inputs of a fit: the samples with their monomials, and the prior of the coefficients.

The prior is one of physical widths (:mod:`magbridge.estimation.priors`), of dipoles at measured places
(:mod:`.mounted_masses`), or from earlier deployments of the vehicle (:class:`Known`).

Notes
-----
Coefficients of two deployments can be compared only for the same scaling of the positions and the same field
F_0. With :math:`x = s x' + t` for each parameter, a monomial of the old is a polynomial in the new,

.. math:: x^p = \sum_q \prod_k \binom{p_k}{q_k} s_k^{q_k} t_k^{p_k - q_k} x'^q,

so that the new coefficients are linear in the old (:func:`rescaling`).

A known prior N(m, S) enters the fit as ``c = L z + m``, where ``S = L L^T`` and z has one common width, with
a prior about 1, chosen by the evidence: where a deployment is unlike all that was known, S widens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.mounted_masses import Mounting, mounted_prior
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents, full_order
from magbridge.errors import CalibrationError
from magbridge.estimation.priors import PriorFamily, polynomial_prior
from magbridge.estimation.residual import ResidualSamples

__all__ = ["DEPARTURE", "Known", "Posed", "Vehicle", "pose", "rescaling"]

# ---- A prior that is known ----

DEPARTURE = "departure from the prior"
"""Name of the width of z among ``widths_nT``: 1 where a deployment is as it was expected."""
SPREAD = np.log(1.5)
"""1-sigma of the logarithm of that width."""


@dataclass(frozen=True, eq=False)
class Known:
    """A Gaussian expectation of the coefficients."""

    parameters: tuple[Parameter, ...]
    """How the positions are scaled, with the range that was seen."""
    exponents: tuple[Exponents, ...]
    """The m monomials, all of them up to a degree."""
    field: float
    """F_0 that the coefficients refer to, nT."""
    mean: FloatArray
    """(9 m,), nT."""
    covariance: FloatArray
    """(9 m, 9 m), nT², positive definite."""

    def ranges(self, data: Observations) -> tuple[Parameter, ...]:
        """Return the parameters, their ranges widened to what `data` have.

        CalibrationError: the data have others, or in other units.
        """
        # names, units and order must agree: coefficients have no meaning for other positions
        mine = [(one.name, one.unit) for one in self.parameters]
        theirs = list(zip(data.names, data.units, strict=True))
        if mine != theirs:
            listed = [
                ", ".join(f"{name} [{unit}]" for name, unit in both) or "none" for both in (mine, theirs)
            ]
            raise CalibrationError(f"known are coefficients for {listed[0]}, and the log has {listed[1]}")
        return tuple(
            _widened(one, column) for one, column in zip(self.parameters, data.parameters.T, strict=True)
        )

    def prior(self, F_0: float) -> PriorFamily:
        """Return the prior of a fit whose coefficients refer to the field `F_0` (nT)."""
        # c = L mean + chol(L P L^T) z: z is N(0, 1) times a width that the evidence chooses
        L = rescaling(self.exponents, self.parameters, self.parameters, self.field, F_0)
        size = len(self.mean)
        return PriorFamily(
            E=np.asarray(np.linalg.cholesky(L @ self.covariance @ L.T)),
            offset=L @ self.mean,
            constant=np.zeros(size),
            design=np.ones((size, 1)),
            centre=np.zeros(1),
            spread=np.array([SPREAD]),
            names=(DEPARTURE,),
        )

    def rescaled(self, parameters: tuple[Parameter, ...], field: float) -> Known:
        """Return the same for other scales of the positions and another F_0 (nT)."""
        L = rescaling(self.exponents, self.parameters, parameters, self.field, field)
        P = L @ self.covariance @ L.T
        return replace(self, parameters=parameters, field=field, mean=L @ self.mean, covariance=P)


def _widened(parameter: Parameter, column: FloatArray) -> Parameter:
    """Return a parameter whose range takes in a column (n,), on the same scale."""
    low, high = min(parameter.low, float(column.min())), max(parameter.high, float(column.max()))
    return Parameter(parameter.name, parameter.unit, low, high, parameter.centre, parameter.scale)


def rescaling(
    exponents: Sequence[Exponents],
    old: Sequence[Parameter],
    new: Sequence[Parameter],
    field_old: float,
    field_new: float,
) -> FloatArray:
    """Return the matrix (9 m, 9 m) that makes coefficients in `new` scales of those in `old`.

    `exponents`: the m monomials: all up to a degree. `old`, `new`: the same ones, scaled in two ways.
    `field_old`, `field_new`: nT, F_0.
    """
    # x_old = s x_new + t, so x_old^p = sum of binom(p, q) s^q t^(p-q) x_new^q; A is over F_0, T is not
    s = [n.scale / o.scale for o, n in zip(old, new, strict=True)]
    t = [(n.centre - o.centre) / o.scale for o, n in zip(old, new, strict=True)]
    M = np.zeros((len(exponents), len(exponents)))
    for column, p in enumerate(exponents):
        for row, q in enumerate(exponents):
            if all(b <= a for a, b in zip(p, q, strict=True)):
                powers = zip(p, q, s, t, strict=True)
                M[row, column] = np.prod([comb(a, b) * s_k**b * t_k ** (a - b) for a, b, s_k, t_k in powers])
    return np.asarray(np.kron(M, np.diag([field_new / field_old] * 6 + [1.0] * 3)))


# ---- The problem of a fit ----

Vehicle = Mapping[str, Mounting | Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class Posed:
    """A fit as a problem: ranges of the positions, monomials in them, samples, prior."""

    ranges: tuple[Parameter, ...]
    exponents: tuple[Exponents, ...]
    samples: ResidualSamples
    family: PriorFamily


def pose(data: Observations, order: int, vehicle: Vehicle | None = None, known: Known | None = None) -> Posed:
    """Return the problem of fitting polynomials up to `order` to `data`.

    `data`: the calibration runs. `order`: highest total degree; of no account where `known` is given, which
    has its own. `vehicle`: where the masses sit, by parameter. `known`: what the coefficients are expected
    to be.

    CalibrationError: both are given, or `known` is of other parameters.
    """
    # without an expectation: priors of physical width, and dipoles where masses have a place
    if known is None:
        ranges = data.ranges()
        exponents = full_order(len(ranges), order)
        samples = polynomial_samples(data, exponents, ranges=ranges)
        family = polynomial_prior(exponents, data.names, samples.F_0)
        family = mounted_prior(family, exponents, ranges, vehicle) if vehicle else family
        return Posed(ranges, exponents, samples, family)
    if vehicle:
        raise CalibrationError("vehicle: the masses' places are of no use where the coefficients are known")
    ranges = known.ranges(data)
    samples = polynomial_samples(data, known.exponents, ranges=ranges)
    return Posed(ranges, known.exponents, samples, known.prior(samples.F_0))
