r"""Physical priors of the coefficients: Gaussians whose widths are estimated.

Notes
-----
A mass at distance |r| that travels q |r| either way (q small) adds a field ``~ |r_0 + t x|^-3``. The term in
``x^n`` is ``(n + 1)(n + 2)/2 q^n`` of the whole field. So the prior widths w_n of the terms are related by::

    w_n = w_1 (n + 1)(n + 2)/6 q^(n - 1)

Each mass has three widths, estimated by their logarithms: the first power in T, the first power in A, and q.
To first order masses do not affect each other, so cross terms have separate, far smaller widths. The constant
terms have three widths: the gain common to all axes, soft iron, hard iron. Every width is
``log w = constant + design . eta``. The prior of eta is a broad Gaussian about values found on vehicles. The
estimate of eta maximises the evidence (:mod:`.hyperparameters`), so the data can overrule these values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray

Exponents = tuple[int, ...]

__all__ = [
    "FACTOR_MASS", "GAIN_SIGMA", "HARD_IRON_SIGMA_NT", "SOFT_IRON_SIGMA", "WIDE_HARD_IRON_SIGMA", "Prior",
    "PriorFamily", "gain_rotation", "polynomial_prior",
]  # fmt: skip


GAIN_SIGMA = 0.02
"""Standard deviation of the gain common to all axes, as a fraction of the field."""
SOFT_IRON_SIGMA = 0.015
"""Standard deviation of soft iron, and of the differences of scales, as a fraction of the field."""
HARD_IRON_SIGMA_NT = 3000.0
"""Standard deviation of hard iron, nT."""
WIDE_HARD_IRON_SIGMA = 0.6
"""Standard deviation of hard iron as a fraction of the field, for a fit that does not estimate its width."""
FIRST_T, FIRST_A, RATIO = 200.0, 8.0, 0.05
"""Prior medians for a mass: change of T and of a over half its range, nT; travel divided by distance."""
CROSS_T, CROSS_A = 0.1, 0.1
"""Prior medians of the widths of cross terms in T and in a, nT: masses hardly magnetise each other."""
FACTOR_FIXED, FACTOR_MASS, FACTOR_RATIO = np.log(2.0), np.log(3.3), np.log(1.8)
"""1-sigma of the logarithms of the widths: of fixed iron, of a mass, of travel over distance."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of z with mean 0 and `precision` (q, q); coefficients are ``E z + offset``, E (K, q)."""

    precision: FloatArray
    E: FloatArray
    offset: FloatArray | float = 0.0

    def coefficients(self, z: FloatArray) -> FloatArray:
        """Return the coefficients (K,), nT, at z (q,)."""
        return np.asarray(self.E @ z + self.offset)


@dataclass(frozen=True, eq=False)
class PriorFamily:
    """Hierarchical prior: eta determines the widths of the latent unknowns z, and z the coefficients c."""

    E: FloatArray
    """(K, q): ``c = E z + offset``; the prior of z is centred at 0."""
    offset: FloatArray
    """(K,): Coefficients at z = 0, nT."""
    constant: FloatArray
    design: FloatArray
    """`constant` (q,), `design` (q, h): Log widths of z are ``constant + design @ eta``."""
    centre: FloatArray
    spread: FloatArray
    """`centre`, `spread` (h,): Mean and 1-sigma of the prior of eta."""
    names: tuple[str, ...]
    """Name of each width in ``exp(eta)``."""
    renew: Callable[[FloatArray], PriorFamily] | None = None
    """Function that returns the family linearised at another z; None if c is linear in z."""

    def widths(self, eta: FloatArray) -> FloatArray:
        """Return the prior 1-sigma of z (q,) at `eta` (h,)."""
        return np.asarray(np.exp(self.constant + self.design @ eta))

    def nearest_latent(self, start: FloatArray) -> FloatArray:
        """Return the smallest z (q,) whose constant terms are `start` (9,), nT."""
        return np.asarray(np.linalg.lstsq(self.E[:9], start - self.offset[:9], rcond=None)[0])

    def prior(self, eta: FloatArray) -> Prior:
        """Return the family's prior at `eta` (h,)."""
        return Prior(np.diag(self.widths(eta) ** -2.0), self.E, self.offset)


def gain_rotation() -> FloatArray:
    """Return an orthonormal matrix (3, 3): its columns are the common gain of the axes, two differences."""
    return np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]).T / np.sqrt([3.0, 2.0, 6.0])


def polynomial_prior(exponents: tuple[Exponents, ...], names: tuple[str, ...], F_0: float) -> PriorFamily:
    """Return the prior of polynomial coefficients with physical widths, for masses at unknown places.

    Parameters
    ----------
    exponents : tuple of tuple of int
        Powers of each monomial; the constant monomial first.
    names : tuple of str
        Names of the masses' positions (regressors).
    F_0 : float
        Total field, nT, as in :class:`~magbridge.estimation.residual.ResidualSamples`.
    """
    # widths of the constant terms, then three for each mass, then those of the cross terms
    labels = ["gain", "soft iron", "hard iron"]
    widths = (np.sqrt(3.0) * GAIN_SIGMA * F_0, SOFT_IRON_SIGMA * F_0, HARD_IRON_SIGMA_NT)
    centre = [float(np.log(width)) for width in widths]
    spread = [FACTOR_FIXED] * 3
    for name in names:
        labels += [f"{name} in T", f"{name} in A", f"{name} travel over distance"]
        centre += [np.log(FIRST_T), np.log(FIRST_A), np.log(RATIO)]
        spread += [FACTOR_MASS, FACTOR_MASS, FACTOR_RATIO]
    labels += ["cross terms in T", "cross terms in A"]
    centre += [np.log(CROSS_T), np.log(CROSS_A)]
    spread += [FACTOR_MASS, FACTOR_MASS]
    constant, design = np.zeros((len(exponents), 9)), np.zeros((len(exponents), 9, len(labels)))
    for m, powers in enumerate(exponents):
        _log_widths(powers, constant[m], design[m])
    E = np.eye(9 * len(exponents))
    # the common gain has a width of its own: rotate the three diagonal entries
    E[:3, :3] = gain_rotation()
    return PriorFamily(
        E=E,
        offset=np.zeros(len(E)),
        constant=constant.ravel(),
        design=design.reshape(len(E), -1),
        centre=np.array(centre),
        spread=np.array(spread),
        names=tuple(labels),
    )


def _log_widths(powers: Exponents, constant: FloatArray, design: FloatArray) -> None:
    """Fill, in place, the constants (9,) and the weights of eta (9, h) for one monomial's log widths."""
    degree = sum(powers)
    moved = [k for k, power in enumerate(powers) if power]
    # Monomials without a mass: gain and soft iron in A, hard iron in T.
    if not moved:
        design[0, 0] = design[1:6, 1] = design[6:, 2] = 1.0
    elif len(moved) == 1:
        k = 3 + 3 * moved[0]
        # A dipole at distance d, moved by s: term n over the first is (n + 1)(n + 2) / 6 (s / d)^(n - 1).
        constant[:] = np.log((degree + 1) * (degree + 2) / 6.0)
        design[6:, k] = design[:6, k + 1] = 1.0
        design[:, k + 2] = degree - 1
    else:  # cross terms: each power beyond the first adds a factor of travel over distance
        design[6:, -2] = design[:6, -1] = 1.0
        for k in moved:
            design[:, 3 + 3 * k + 2] = (degree - 2) * powers[k] / degree
