"""A calibration compiled into one table, so that a sample costs a few microseconds.

Notes
-----
With regressors ``phi(x)`` (the monomials, and what effects add) the nine coefficients are
``theta = phi^T W``, and their covariance is ``sum_mn phi_m phi_n C_mn``, a sum over the *products* of
regressors. Many products coincide (``x^2 . x`` and ``x . x^2``): 28 remain of 55 for a cubic in two
positions. So both are one sum over products ``psi``::

    (theta, covariance of theta) = table psi

A matrix product rounds in an order that depends on its shape and on the machine. So psi and table are
split into a coarse and a fine part of 21 bits each: products of parts and their sums then fit a
double *exactly*, in whatever order (Ozaki et al. 2012, Numer. Algorithms 59:95), and one sample live
gives the same bits as a million in a batch, here and on any other computer. What the split leaves
out is 2e-13 of the largest: 1e-8 nT.

That leaves too little of the constant when a regressor is large beside it, as a pressure in Pa. So what effects
follow is first multiplied by a power of two: it is counted in what makes about 1,000 nT of difference.

The nine become twelve in body axes: ``A' = R A`` (nine, R the boresight) and T. For the covariance V of the
corrected vector ``b = A' d, d = H_r - T``, write ``db = dA' d - A' dT``: V is quadratic in d, and the table holds
the covariance in just the combinations that V needs: 36 for the quadratic part Q, 27 for ``S_a'T``, 6 for
``S_TT`` (with the sensor's own noise, which acts like T's).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import frexp, ldexp, nan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.terms import Exponents

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration

__all__ = ["Kernel", "compile_kernel"]

FloatArray = NDArray[np.float64]

BITS = 21
COARSE, FINE = 1.5 * 2.0 ** (52 - BITS), 1.5 * 2.0 ** (52 - 2 * BITS)
"""Adding and taking away rounds to a multiple of 2^-21, of 2^-42."""
EXPONENT = 3
"""psi is kept below 2^3, by a power of two where positions lie far outside the range seen: then
2^24 . 2^21 . 256 products still fit 53 bits."""
FARTHEST = 2.0**BITS
"""A regressor as large is beyond use: beside its square the constant falls out of the split."""

ORDINARY = 1024.0
"""nT that a regressor of 1 makes, once it is counted as an effect's."""

COLUMNS = 81
"""Of the table: the twelve, then the 69 combinations of their covariance."""
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
SLOT = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
"""Where ``A[i, k]`` stands among the nine."""


@dataclass(frozen=True, eq=False)
class Kernel:
    """What :mod:`.correct` needs, and nothing else.

    Attributes
    ----------
    centre, scale : tuple of float
        Of each parameter.
    parents : tuple of (int, int)
        Monomial ``i + 1`` is monomial ``parents[i][0]`` times position ``parents[i][1]``.
    monomials : int
        How many; the remaining regressors belong to effects.
    weights : (m, 9) array
        W, with ``A`` itself (not ``a``) in the first six.
    units : tuple of float or None
        Powers of two that the regressors are multiplied by; None where all are 1.
    first, second : (q,) int arrays
        Product q is ``phi[first] * phi[second]``, of regressors in their units; the first m are the regressors.
    coarse, fine : (81, q) arrays
        The table in two parts.
    """

    centre: tuple[float, ...]
    scale: tuple[float, ...]
    parents: tuple[tuple[int, int], ...]
    monomials: int
    weights: FloatArray
    units: tuple[float, ...] | None
    first: NDArray[np.intp]
    second: NDArray[np.intp]
    coarse: FloatArray
    fine: FloatArray

    def sums(self, phi: FloatArray) -> FloatArray:
        """Return ``table psi`` (81, n) of many samples' regressors (m, n)."""
        if self.units is not None:
            phi = phi * np.array(self.units)[:, None]
        psi = np.empty((len(self.pairs), phi.shape[1]))
        for row, (i, j) in zip(psi, self.pairs, strict=True):
            np.multiply(phi[i], phi[j], out=row)
        largest = max(float(phi.max()), -float(phi.min()))
        scale = None if largest * largest < 2.0**EXPONENT else _scales(phi)
        if scale is not None:
            psi *= scale
        coarse = psi + COARSE
        coarse -= COARSE
        fine = np.subtract(psi, coarse, out=psi)
        fine += FINE
        fine -= FINE
        found = self.fine @ coarse
        found += self.coarse @ fine
        found += self.coarse @ coarse
        return np.asarray(found if scale is None else found / scale)

    def sums_of_one(self, phi: list[float]) -> list[float]:
        """Return the same 81 sums of one sample's regressors: one product, so that it is quick."""
        if self.units is not None:
            phi = [value * unit for value, unit in zip(phi, self.units, strict=True)]
        largest = max(*phi, -min(phi))
        scale = ldexp(1.0, min(EXPONENT - frexp(largest * largest)[1], 0)) if largest < FARTHEST else nan
        psi = np.array([phi[i] * phi[j] * scale for i, j in self.pairs])
        parts = np.empty((len(psi), 2))
        coarse = np.add(psi, COARSE, out=parts[:, 0])
        coarse -= COARSE
        fine = np.subtract(psi, coarse, out=parts[:, 1])
        fine += FINE
        fine -= FINE
        found = self.both @ parts
        sums: list[float] = ((found[COLUMNS:, 0] + found[:COLUMNS, 1] + found[:COLUMNS, 0]) / scale).tolist()
        return sums

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """`first` and `second` as numbers that Python multiplies by at once."""
        return list(zip(self.first.tolist(), self.second.tolist(), strict=True))

    @cached_property
    def both(self) -> FloatArray:
        """(162, q) `coarse` above `fine`."""
        return np.concatenate([self.coarse, self.fine])

    def powers(self, values: Sequence[Any], one: Any) -> list[Any]:
        """Return the monomials, of floats or of arrays: the same multiplications in the same order."""
        x = [
            (value - centre) / scale
            for value, centre, scale in zip(values, self.centre, self.scale, strict=False)
        ]
        phi = [one]
        for parent, k in self.parents:
            phi.append(phi[parent] * x[k])
        return phi

    def monomials_of(self, positions: FloatArray) -> FloatArray:
        """(m, n) monomials of (n, k) positions."""
        return np.stack(self.powers(list(positions.T), np.ones(len(positions))))


def _scales(phi: FloatArray) -> FloatArray:
    """(n,) power of two by which the products of each sample are made small enough, 1 for most; NaN: too far."""
    largest = np.abs(phi).max(axis=0)
    scales = np.ldexp(1.0, np.minimum(EXPONENT - np.frexp(largest * largest)[1], 0))
    return np.where(largest < FARTHEST, scales, np.nan)


def compile_kernel(calibration: Calibration) -> Kernel:
    """Compile `calibration`; see the module's notes."""
    expansions = [term.expand(calibration) for term in calibration.terms]
    exponents = _closed({e for expansion in expansions for e in expansion.exponents}, calibration)
    row = {exponent: i for i, exponent in enumerate(exponents)}
    effects = [effect.columns(calibration.reference.field) for effect in calibration.effects]
    m = len(exponents) + sum(columns.shape[1] for columns in effects)
    P = np.zeros((calibration.coefficients.size, m, 9))
    k, r = 0, len(exponents)
    for expansion in expansions:
        rows = [row[exponent] for exponent in expansion.exponents]
        P[k : k + len(expansion.columns), rows] = expansion.columns
        k += len(expansion.columns)
    for columns in effects:
        P[k : k + columns.shape[0], r : r + columns.shape[1]] = columns
        k, r = k + columns.shape[0], r + columns.shape[1]
    P[:, :, :6] /= calibration.reference.field
    W = np.tensordot(calibration.coefficients, P, 1)
    W[0, :3] += 1.0
    first, second, table = _table(P, W, calibration, exponents)
    units = _units(P[:, len(exponents) :], W[len(exponents) :], calibration)
    units = np.concatenate([np.ones(len(exponents)), units])
    table /= (units[first] * units[second])[:, None]
    size = 2.0 ** np.frexp(np.abs(table).max(axis=0))[1]  # a power of two above each column
    coarse = ((table / size + COARSE) - COARSE).T * size[:, None]
    fine = ((table / size - coarse.T / size + FINE) - FINE).T * size[:, None]
    return Kernel(
        centre=tuple(parameter.centre for parameter in calibration.parameters),
        scale=tuple(parameter.scale for parameter in calibration.parameters),
        parents=tuple((row[_parent(e)[0]], _parent(e)[1]) for e in exponents[1:]),
        monomials=len(exponents),
        weights=W,
        units=tuple(units.tolist()) if effects else None,
        first=first,
        second=second,
        coarse=coarse,
        fine=fine,
    )


def _parent(exponent: Exponents) -> tuple[Exponents, int]:
    """Return the monomial with one power less, and of which position."""
    k = max(i for i, power in enumerate(exponent) if power)
    return (*exponent[:k], exponent[k] - 1, *exponent[k + 1 :]), k


def _closed(exponents: set[Exponents], calibration: Calibration) -> list[Exponents]:
    """All `exponents` with all their parents, by degree: each can be made from one before it."""
    todo = [*exponents, (0,) * len(calibration.parameters)]
    closed: set[Exponents] = set()
    while todo:
        exponent = todo.pop()
        if exponent not in closed:
            closed.add(exponent)
            if any(exponent):
                todo.append(_parent(exponent)[0])
    return sorted(closed, key=lambda e: (sum(e), [-power for power in e]))


def _units(P: FloatArray, W: FloatArray, calibration: Calibration) -> FloatArray:
    """(r,) powers of two near ``s / ORDINARY``, s what 1 of each effect's regressor makes, or may make, in nT."""
    variance = np.einsum("kri,kl,lri->ri", P, calibration.covariance, P)
    field = np.array([calibration.reference.field] * 6 + [1.0] * 3)
    s = (np.sqrt(W * W + np.abs(variance)) * field).max(axis=1)
    return np.ldexp(1.0, np.where(s > 0.0, np.frexp(s / ORDINARY)[1], 0))


def _body_axes(calibration: Calibration) -> FloatArray:
    """(9, 12): from A's six entries and T's three to those of ``R A``, row by row, and T."""
    R = np.eye(3) if calibration.boresight is None else calibration.boresight.matrix()
    B = np.zeros((9, 12))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                B[SLOT[j][k], 3 * i + k] += R[i, j]
    B[6:, 9:] = np.eye(3)
    return B


def _table(
    P: FloatArray, W: FloatArray, calibration: Calibration, exponents: list[Exponents]
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return the products of regressors and what each contributes."""
    m, B = len(W), _body_axes(calibration)
    flat = (P @ B).reshape(len(P), -1)
    C = (flat.T @ calibration.covariance @ flat).reshape(m, 12, m, 12)

    def key(i: int, j: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        powers = [np.array(exponents[r]) for r in (i, j) if r < len(exponents)]
        return tuple(np.sum(powers, axis=0).astype(int)) if powers else (), tuple(
            sorted(r for r in (i, j) if r >= len(exponents))
        )

    products: dict[tuple[tuple[int, ...], tuple[int, ...]], list[tuple[int, int]]] = {}
    for i in range(m):
        for j in range(i, m):
            products.setdefault(key(i, j), []).append((i, j))
    table = np.zeros((len(products), COLUMNS))
    table[:m, :12] = W @ B
    for q, pairs in enumerate(products.values()):
        S = np.sum([C[i, :, j] + (C[j, :, i] if i != j else 0.0) for i, j in pairs], axis=0)
        if q == 0:  # the sensor's noise adds to what it reads just as T does
            S[9:, 9:] += calibration.noise.sensor**2 * np.eye(3)
        table[q, 12:] = _combinations(S)
    first, second = np.array([pairs[0] for pairs in products.values()]).T
    return first, second, table


def _combinations(S: FloatArray) -> FloatArray:
    """(69,): Q of V's six entries by the six products of d, then ``S_a'T`` (9 x 3), then ``S_TT``."""
    Q = [
        S[3 * i + k, 3 * j + l] + (S[3 * i + l, 3 * j + k] if k != l else 0.0)
        for i, j in PAIRS
        for k, l in PAIRS  # noqa: E741  (the index of the equation)
    ]
    return np.array([*Q, *S[:9, 9:].ravel(), *(S[9 + i, 9 + j] for i, j in PAIRS)])
