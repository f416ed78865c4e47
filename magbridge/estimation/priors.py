r"""Physical priors of the coefficients: Gaussians whose widths are estimated.

Notes
-----
A mass at distance |r| that travels q |r| either way (q small) adds a field ``~ |r_0 + t x|^-3``, whose
n-th power of x has the size ``(n + 1)(n + 2)/2 q^n`` of the whole: against its first power::

    w_n = w_1 (n + 1)(n + 2)/6 q^(n - 1)

So each parameter has three widths, all logarithmic: the first power in T, the first power in A, and q. To
first order masses do not affect each other: cross terms have widths of their own, expected to be far
smaller. The constant terms have three: the gain common to all axes, soft iron, hard iron. Every width is
``log w = constant + design . eta``. eta has a broad Gaussian prior about sizes found on vehicles and is
chosen to maximise the evidence (:mod:`.hyperparameters`), so the data can overrule those sizes.
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
"""nT in T and in a over half the range seen, of a mass; its travel over its distance."""
CROSS_T, CROSS_A = 0.1, 0.1
"""Prior sigma of cross terms, in T and in a, nT: masses hardly magnetise each other."""
FACTOR_FIXED, FACTOR_MASS, FACTOR_RATIO = np.log(2.0), np.log(3.3), np.log(1.8)
"""1-sigma of the logarithms of the widths: of fixed iron, of a mass, of travel over distance."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of z about 0 with its precision (q, q); and ``c = E z + offset``, E (K, q)."""

    precision: FloatArray
    E: FloatArray
    offset: FloatArray | float = 0.0

    def coefficients(self, z: FloatArray) -> FloatArray:
        """Return (K,) ``c = E z + offset`` of z (q,)."""
        return np.asarray(self.E @ z + self.offset)


@dataclass(frozen=True, eq=False)
class PriorFamily:
    """A hierarchical prior: coefficients follow from latent numbers z, whose widths follow from eta."""

    E: FloatArray
    """(K, q): ``c = E z + offset``; the prior of z is centred at 0."""
    offset: FloatArray
    """(K,)."""
    constant: FloatArray
    design: FloatArray
    """`constant`, `design`, (q,): Log widths of z are ``constant + design @ eta``."""
    centre: FloatArray
    spread: FloatArray
    """`centre`, `spread`, (h,): Prior of eta."""
    names: tuple[str, ...]
    """What ``exp(eta)`` is the width of, number by number."""
    renew: Callable[[FloatArray], PriorFamily] | None = None
    """``z -> PriorFamily``: the family linearised at another z."""

    def widths(self, eta: FloatArray) -> FloatArray:
        """Return (q,) prior 1-sigma of z at `eta` (h,)."""
        return np.asarray(np.exp(self.constant + self.design @ eta))

    def nearest_latent(self, start: FloatArray) -> FloatArray:
        """Return the smallest z (q,) whose constant terms are `start` (9,), nT."""
        return np.asarray(np.linalg.lstsq(self.E[:9], start - self.offset[:9], rcond=None)[0])

    def prior(self, eta: FloatArray) -> Prior:
        """Return the family's prior at `eta` (h,)."""
        return Prior(np.diag(self.widths(eta) ** -2.0), self.E, self.offset)


def gain_rotation() -> FloatArray:
    """Return an orthonormal matrix (3, 3): the common gain of three axes, then two differences."""
    return np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]).T / np.sqrt([3.0, 2.0, 6.0])


def polynomial_prior(exponents: tuple[Exponents, ...], names: tuple[str, ...], F_0: float) -> PriorFamily:
    """Return the prior of polynomials with physical widths, the masses' places being unknown.

    Parameters
    ----------
    exponents : tuple of tuple of int
        The monomials; the constant one first.
    names : tuple of str
        Of the parameters.
    F_0 : float
        nT, as in :class:`~magbridge.estimation.residual.ResidualSamples`.
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
    """Fill one monomial's rows, in place: the constants and eta's weights of its nine log widths."""
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
