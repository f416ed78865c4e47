"""The model: what a strapdown magnetometer among moving masses reads, and how to invert it.

Notes
-----
The instrument reads ``H_r = D(p) H + T(p)``. The corrected field is::

    H_c = A(p) (H_r - T(p)),   |H_c| = H_e = |IGRF| + anomaly             (paper, eqs. 3, 4 and 7)

The paper is Claus & Bachmayer 2016, Field and Service Robotics, doi:10.1007/978-3-319-27702-8_6. Its eq. 2
puts the rotation M where it drops out of the magnitude; with its eq. 3 the corrected vector is in the
ellipsoid's own axes. We take ``A = M S^-1 M^T``, **symmetric**: the same ellipsoid, six numbers, and a vector
that stays in sensor axes (:func:`to_paper`). Each of the nine coefficients is a polynomial in the positions
scaled to the range seen, ``x = (p - centre) / scale``. All are kept in nT: ``A = I + a / F_0``, with F_0 the
field at calibration.

Compiled into the table of its :class:`~magbridge.calibration.kernel.Kernel`, the nine coefficients become
twelve in body axes: ``A' = R A`` (nine, R the boresight) and T. For the covariance V of the corrected vector
``b = A' d, d = H_r - T``, write ``db = dA' d - A' dT``: V is quadratic in d, and the table holds the
covariance in just the combinations that V needs: 36 for the quadratic part Q, 27 for ``S_a'T``, 6 for
``S_TT`` (with the sensor's own noise, which acts like T's).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.heading import DEFAULT_TILT_SIGMA_DEG
from magbridge.calibration.kernel import TABLE_SUMS, Kernel
from magbridge.calibration.scalar import ScalarSensor
from magbridge.calibration.terms import Effect, Exponents, Parameter, Polynomial, PositionTerm
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS, symmetric
from magbridge.wording import counted

__all__ = [
    "LEVEL_STEP_SIGMA", "MIN_HALF_RANGE", "Boresight", "CalibratedRange", "CalibratedSensor", "Calibration",
    "Noise", "Parameter", "Reference", "Run", "coefficient_tensor", "facts", "identity", "to_paper",
]  # fmt: skip

SLOT = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
"""Index of ``A[i, k]`` among the nine coefficients."""
LEVEL_STEP_SIGMA = 0.01
"""Of its 1-sigma, by which the level is raised to see what that does."""


def compile_kernel(calibration: Calibration) -> Kernel:
    """Compile `calibration`; see the module's notes."""
    P, exponents = coefficient_tensor(calibration)
    row = {exponent: i for i, exponent in enumerate(exponents)}
    P[:, :, :6] /= calibration.reference.field
    W = np.tensordot(calibration.coefficients, P, 1)
    W[0, :3] += 1.0
    first, second, table = _table(P, W, calibration, exponents)
    return Kernel(
        centre=tuple(parameter.centre for parameter in calibration.parameters),
        scale=tuple(parameter.scale for parameter in calibration.parameters),
        field=calibration.reference.field,
        parents=tuple((row[_parent(e)[0]], _parent(e)[1]) for e in exponents[1:]),
        weights=W,
        first=first,
        second=second,
        table=np.ascontiguousarray(table.T),
    )


def coefficient_tensor(calibration: Calibration) -> tuple[FloatArray, list[Exponents]]:
    """Return the contribution of each coefficient to each regressor's nine slots, and the monomials.

    Returns `tensor` (K, m, 9): nT at F_0, as :class:`~magbridge.calibration.terms.Expansion`; the regressors
    are the monomials, then those of the effects. Returns `exponents`: The monomials in the kernel's order:
    each follows from one before it.
    """
    expansions = [term.expand(calibration.parameters) for term in calibration.terms]
    exponents = _closed({e for expansion in expansions for e in expansion.exponents}, calibration)
    row = {exponent: i for i, exponent in enumerate(exponents)}
    effects = [effect.columns(calibration.reference.field) for effect in calibration.effects]
    m = len(exponents) + sum(columns.shape[1] for columns in effects)
    tensor = np.zeros((calibration.coefficients.size, m, 9))
    k, r = 0, len(exponents)
    for expansion in expansions:
        rows = [row[exponent] for exponent in expansion.exponents]
        tensor[k : k + len(expansion.columns), rows] = expansion.columns
        k += len(expansion.columns)
    for columns in effects:
        tensor[k : k + columns.shape[0], r : r + columns.shape[1]] = columns
        k, r = k + columns.shape[0], r + columns.shape[1]
    return tensor, exponents


def _parent(exponent: Exponents) -> tuple[Exponents, int]:
    """Return the monomial that is lower by one power of one position, and the index of that position."""
    k = max(i for i, power in enumerate(exponent) if power)
    return (*exponent[:k], exponent[k] - 1, *exponent[k + 1 :]), k


def _closed(exponents: set[Exponents], calibration: Calibration) -> list[Exponents]:
    """Return `exponents` and all their parents, by degree: each follows from one before it."""
    todo = [*exponents, (0,) * len(calibration.parameters)]
    closed: set[Exponents] = set()
    while todo:
        exponent = todo.pop()
        if exponent not in closed:
            closed.add(exponent)
            if any(exponent):
                todo.append(_parent(exponent)[0])
    return sorted(closed, key=lambda e: (sum(e), [-power for power in e]))


def _body_axes(calibration: Calibration) -> FloatArray:
    """Return the matrix (9, 12) from A's six entries and T to the nine of ``R A``, row by row, and T."""
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
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return the two regressors of each product, (q,) and (q,), and each product's share of the 81 sums."""
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
    table = np.zeros((len(products), TABLE_SUMS))
    table[:m, :12] = W @ B
    for q, pairs in enumerate(products.values()):
        S = np.sum([C[i, :, j] + (C[j, :, i] if i != j else 0.0) for i, j in pairs], axis=0)
        if q == 0:  # the sensor's noise adds to the reading just as an error of T does
            S[9:, 9:] += calibration.noise.sensor**2 * np.eye(3)
        table[q, 12:] = _combinations(S)
    first, second = np.array([pairs[0] for pairs in products.values()]).T
    return first, second, table


def _combinations(S: FloatArray) -> FloatArray:
    """Return (69,): Q (V's six entries by the six products of d), ``S_a'T`` (9 x 3), ``S_TT`` (6)."""
    Q = [
        S[3 * i + k, 3 * j + l] + (S[3 * i + l, 3 * j + k] if k != l else 0.0)
        for i, j in PAIRS
        for k, l in PAIRS  # noqa: E741  (the index of the equation)
    ]
    return np.array([*Q, *S[:9, 9:].ravel(), *(S[9 + i, 9 + j] for i, j in PAIRS)])


class CalibratedSensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which instrument was calibrated, and in which of its power cycles (None: unknown)."""

    name: str = ""
    power_cycle: int | None = None
    filter_cutoff: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    """Cutoff frequency of the anti-alias filter that correcting undoes, Hz; 0: none."""

    def may_be(self, name: str) -> bool:
        """Return True if this may be the sensor of that name; either may be unknown (empty)."""
        return "" in (self.name, name) or self.name == name


UNKNOWN = CalibratedSensor()


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Noise of the samples: 1-sigma of each channel (nT), of the reference (nT), autocorrelation.

    A share `white` of the variance is white; the rest has, with the next sample's, `interval` s later, this
    `autocorrelation`: AR(1), of the memory ``-interval / log(autocorrelation)`` s.
    """

    sensor: Annotated[float, Meta(ge=0.0, le=1e15)]
    reference: float = 0.0
    autocorrelation: float = 0.0
    interval: float = 0.0
    white: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


class Reference(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the magnitude was compared with: F_0 (nT), which model, and the site bias found (nT).

    `bias_sigma` is how well the reference's level was known, `level_sigma` how well that of the corrected
    field is: the part of its sigma that is common to all samples.
    """

    field: Annotated[float, Meta(gt=0.0)]
    model: str = ""
    bias: float = 0.0
    bias_sigma: float = 0.0
    level_sigma: float = 0.0


class Boresight(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The rotation from corrected sensor axes to body axes that a scalar fit leaves free.

    `rotation` is a rotation vector (rad), `covariance` that of a small further rotation in body
    axes (rad²). `tilt_sigma` is the 1-sigma of roll and of pitch in the runs of which it was found (deg).
    """

    rotation: tuple[float, float, float]
    covariance: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    tilt_sigma: float = DEFAULT_TILT_SIGMA_DEG

    def matrix(self) -> FloatArray:
        """Return (3, 3) rotation matrix: Rodrigues' formula."""
        # R = I + sinc(a) K + (1 - cos a)/a^2 K^2; 1 - cos a = 2 sin^2(a/2), so that both factors stay
        # finite at a = 0
        x, y, z = self.rotation
        angle = float(np.sqrt(x * x + y * y + z * z))
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(
            np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * K @ K
        )


MIN_HALF_RANGE = {"depth": 10.0, "sensor_temperature": 2.0}

"""Conditions that a fit records, and the least half range of each, m and degC: a calibration at one depth, or
at one temperature, holds for this much more."""


class CalibratedRange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The range of a condition in the data of a fit that does not model its effect: depth, temperature."""

    name: str
    """A key of :data:`MIN_HALF_RANGE`."""
    low: float
    high: float
    """`low`, `high`: The range seen, m (above the surface: 0) or degC."""

    def excess(self, value: float) -> float:
        """Return how far a value lies outside the range, in half ranges; 0 inside, or where it is NaN."""
        # in half ranges from the middle: 1 is the edge
        half = max(0.5 * (self.high - self.low), MIN_HALF_RANGE[self.name])
        distance = abs(value - 0.5 * (self.low + self.high)) / half
        return distance - 1.0 if distance > 1.0 else 0.0


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One calibration run: number of samples, RMS residual (nT in the sensor's own units), mean positions."""

    label: str
    samples: int
    rms: float
    parameters: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration with its uncertainty. It is immutable: a fit returns a new one."""

    parameters: tuple[Parameter, ...]
    terms: tuple[PositionTerm, ...]
    coefficients: FloatArray
    """(K,) of the terms, then the effects, nT (a dipole's displacement: m; an effect's: see its class)."""
    covariance: FloatArray
    """(K, K)."""
    noise: Noise
    reference: Reference
    effects: tuple[Effect, ...] = ()
    sensor: CalibratedSensor = UNKNOWN
    boresight: Boresight | None = None
    runs: tuple[Run, ...] = ()
    method: str = ""
    """Which fit made it; ``"none"`` marks every sample as uncalibrated."""
    inputs: dict[str, str] = field(default_factory=dict)
    """File -> SHA-256 of the inputs."""
    software: str = ""
    """Version that made it."""
    warnings: tuple[str, ...] = ()
    """Why the data that it was fitted to do not support it; empty where they do."""
    level: tuple[float, ...] = ()
    """How the first coefficients move together where the level of the reference is off by 1-sigma (nT); empty
    where that was known."""
    sensors: tuple[ScalarSensor, ...] = ()
    """Scalar magnetometers in addition to the vector sensor."""
    conditions: tuple[CalibratedRange, ...] = ()
    """Ranges of depth and temperature in the data that it was fitted to."""

    def __post_init__(self) -> None:
        # every term checks its own settings; then the vector must have one number for each coefficient
        names = tuple(parameter.name for parameter in self.parameters)
        for term in (*self.terms, *self.effects):
            term.check(names)
        size = sum(term.size for term in (*self.terms, *self.effects))
        if self.coefficients.shape != (size,):
            raise CalibrationError(
                f"coefficients: expected {size}, one for each term's number, found {self.coefficients.size}"
            )
        if self.covariance.shape != (size, size):
            raise CalibrationError(
                f"covariance: expected {size} x {size}, found {' x '.join(map(str, self.covariance.shape))}"
            )
        for name in ("coefficients", "covariance"):
            own = np.array(getattr(self, name), float)  # a copy: the caller's array stays the caller's
            own.setflags(write=False)
            object.__setattr__(self, name, own)

    def __repr__(self) -> str:
        ranges = (f"{one.name} {one.low:g} to {one.high:g} {one.unit}".rstrip() for one in self.parameters)
        held = f"{counted(len(self.coefficients), 'coefficient')}", f"noise {self.noise.sensor:.3g} nT"
        return f"<Calibration {self.method or 'by hand'}: {', '.join((*ranges, *held))}>"

    @property
    def channels(self) -> tuple[str, ...]:
        """Telemetry that correcting needs, in order: the parameters, then the channels of effects."""
        names = [parameter.name for parameter in self.parameters]
        for effect in self.effects:
            names += [name for name in effect.channels() if name not in names]
        return tuple(names)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return {parameter.name: parameter.unit for parameter in self.parameters}

    @cached_property
    def kernel(self) -> Kernel:
        """The calibration compiled for correcting samples, made once."""
        return compile_kernel(self)

    def without_effects(self) -> Calibration:
        """Return the position terms alone, with their part of coefficients and covariance."""
        # position terms come first in the vector, effects after them
        own = slice(sum(term.size for term in self.terms))
        return replace(
            self, effects=(), coefficients=self.coefficients[own], covariance=self.covariance[own, own],
            level=self.level[own],
        )  # fmt: skip

    def at_level(self) -> Calibration:
        """Return the calibration with its level, and all that follows, :data:`LEVEL_STEP_SIGMA` 1-sigma up.

        A whole one may move the offset by 100 nT across the field: the total field is not linear in that.
        """
        # the level moves the first coefficients together, along one direction
        moved = self.coefficients.copy()
        many = min(len(moved), len(self.level))
        moved[:many] += LEVEL_STEP_SIGMA * np.asarray(self.level[:many])
        return replace(self, coefficients=moved)

    def matrices(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``A`` and ``T`` of the position terms.

        Parameters
        ----------
        positions : (n, k) array
            One column for each parameter, in its unit.

        Returns
        -------
        A : (n, 3, 3) array
        T : (n, 3) array
            nT.
        """
        # theta (n, 9): the six entries of A - I, then T
        theta = self.kernel.monomials_of(positions).T @ self.kernel.position_weights
        return symmetric(theta), theta[:, 6:]


def identity(parameters: tuple[Parameter, ...] = (), field: float = 50_000.0) -> Calibration:
    """Return the calibration that changes nothing; every sample is flagged ``uncalibrated``."""
    return Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=((0,) * len(parameters),)),),
        coefficients=np.zeros(9),
        covariance=np.diag(np.full(9, field**2)),
        noise=Noise(0.0),
        reference=Reference(field),
        method="none",
    )


def to_paper(A: FloatArray, field: float) -> tuple[FloatArray, FloatArray]:
    """Return rotation M (3, 3) and scale S (3,), nT, of a symmetric positive ``A``; `field` is H_e, nT.

    The axes are ordered and signed so that M is as near to I as possible.
    """
    values, axes = np.linalg.eigh(A)
    order = max(permutations(range(3)), key=lambda p: sum(abs(axes[i, k]) for i, k in enumerate(p)))
    axes, values = axes[:, order], values[list(order)]
    axes = axes * np.where(np.diag(axes) < 0.0, -1.0, 1.0)
    if np.linalg.det(axes) < 0.0:
        axes[:, np.argmin(np.abs(np.diag(axes)))] *= -1.0
    return axes, field / values


def facts(calibration: Calibration) -> dict[str, Any]:
    """Return M, S and T (nT) of the terms, at the middle of each parameter's range, as plain values."""
    middle = {parameter.name: parameter.centre for parameter in calibration.parameters}
    A, T = calibration.matrices(np.array([[*middle.values()]]))
    M, S = to_paper(A[0], calibration.reference.field)
    return {"at": middle, "M": M.tolist(), "S_nT": S.tolist(), "T_nT": T[0].tolist()}
