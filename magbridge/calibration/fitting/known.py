r"""Prior of a vehicle's coefficients before its runs, and the information that the runs alone add to it.

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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents
from magbridge.errors import CalibrationError
from magbridge.estimation.priors import PriorFamily

__all__ = ["DEPARTURE", "Known", "rescaling"]

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
    """nT, the F_0 that the coefficients refer to."""
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

    Parameters
    ----------
    exponents : sequence of tuple of int
        The m monomials: all up to a degree.
    old, new : sequence of Parameter
        The same ones, scaled in two ways.
    field_old, field_new : float
        nT, F_0.
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
