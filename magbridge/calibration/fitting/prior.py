r"""What physics expects of the coefficients before any data: Gaussians whose widths are themselves learnt.

Notes
-----
A mass at distance |r| that travels q |r| either way (q small) adds a field ``~ |r_0 + t x|^-3``, whose
n-th power of x has the size ``(n + 1)(n + 2)/2 q^n`` of the whole: against its first power::

    w_n = w_1 (n + 1)(n + 2)/6 q^(n - 1)

So each parameter has three widths, all logarithmic: the first power in T, the first power in A, and q.
Masses do not see each other to first order: cross terms have widths of their own, expected far
smaller. The constant terms: a gain common to all axes, soft iron, hard iron. Every width is
``log w = constant + design . eta``; eta has a broad Gaussian prior about sizes found on vehicles, and
its values maximise the evidence (:mod:`.evidence`), so data that want another size get it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.terms import Exponents

__all__ = ["Structure", "free_structure"]

FloatArray = NDArray[np.float64]

GAIN, SOFT_IRON = 0.02, 0.015  # of the field
HARD_IRON = 3000.0  # nT
FIRST_T, FIRST_A, RATIO = 200.0, 8.0, 0.05  # nT and nT over half the range seen; travel over distance
CROSS_T, CROSS_A = 0.1, 0.1  # nT
FACTOR_FIXED, FACTOR_MASS, FACTOR_RATIO = np.log(2.0), np.log(3.3), np.log(1.8)  # one sigma is a factor of


@dataclass(frozen=True, eq=False)
class Structure:
    """How coefficients follow from latent numbers z, and how wide those are expected.

    Attributes
    ----------
    E : (K, q) array
        ``c = E z + offset``; z is expected about 0.
    offset : (K,) array
    constant, design : (q,) array, (q, h) array
        Log widths of z are ``constant + design @ eta``.
    centre, spread : (h,) arrays
        Prior of eta.
    names : tuple of str
        Of eta's numbers: what ``exp(eta)`` is the width of.
    renew : callable, optional
        ``z -> (Structure, z)``: the structure linearised anew at z, and the same place in it.
    """

    E: FloatArray
    offset: FloatArray
    constant: FloatArray
    design: FloatArray
    centre: FloatArray
    spread: FloatArray
    names: tuple[str, ...]
    renew: Callable[[FloatArray], tuple[Structure, FloatArray]] | None = None

    def widths(self, eta: FloatArray) -> FloatArray:
        """(q,) prior 1-sigma of z."""
        return np.asarray(np.exp(self.constant + self.design @ eta))

    def coefficients(self, z: FloatArray) -> FloatArray:
        """``c = E z + offset``."""
        return np.asarray(self.E @ z + self.offset)


def gain_rotation() -> FloatArray:
    """(3, 3) orthonormal: the common gain of three axes, then two differences."""
    return np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]).T / np.sqrt([3.0, 2.0, 6.0])


def free_structure(exponents: tuple[Exponents, ...], names: tuple[str, ...], unit: float) -> Structure:
    """Polynomials with physical widths, nothing known about where the masses sit.

    Parameters
    ----------
    exponents : tuple of tuple of int
        The monomials; the constant one first.
    names : tuple of str
        Of the parameters.
    unit : float
        nT, F_0.
    """
    labels = ["gain", "soft iron", "hard iron"]
    centre = [np.log(np.sqrt(3.0) * GAIN * unit), np.log(SOFT_IRON * unit), np.log(HARD_IRON)]
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
    E[:3, :3] = gain_rotation()
    return Structure(
        E=E,
        offset=np.zeros(len(E)),
        constant=constant.ravel(),
        design=design.reshape(len(E), -1),
        centre=np.array(centre),
        spread=np.array(spread),
        names=tuple(labels),
    )


def _log_widths(powers: Exponents, constant: FloatArray, design: FloatArray) -> None:
    """Fill one monomial's rows: which of eta's numbers make its nine widths."""
    degree = sum(powers)
    moved = [k for k, power in enumerate(powers) if power]
    if not moved:
        design[0, 0] = design[1:6, 1] = design[6:, 2] = 1.0
    elif len(moved) == 1:
        k = 3 + 3 * moved[0]
        constant[:] = np.log((degree + 1) * (degree + 2) / 6.0)
        design[6:, k] = design[:6, k + 1] = 1.0
        design[:, k + 2] = degree - 1
    else:  # two masses by each other: as small as their ratios beyond the first cross term
        design[6:, -2] = design[:6, -1] = 1.0
        for k in moved:
            design[:, 3 + 3 * k + 2] = (degree - 2) * powers[k] / degree
