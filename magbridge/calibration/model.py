"""Model of the readings of a strapdown magnetometer among moving masses, and its inverse.

Notes
-----
The instrument reads ``H_r = D(p) H + T(p)``. The corrected field is::

    H_c = A(p) (H_r - T(p)),   |H_c| = H_e = |IGRF| + anomaly             (paper, eqs. 3, 4 and 7)

The paper is Claus & Bachmayer 2016, Field and Service Robotics, doi:10.1007/978-3-319-27702-8_6. Its eq. 2
places the rotation M so that it drops out of the magnitude; with its eq. 3 the corrected vector is in the
ellipsoid's own axes. This module uses a **symmetric** ``A = M S^-1 M^T``: it describes the same ellipsoid
with six numbers, and the corrected vector stays in sensor axes (:func:`to_paper`). Each of the nine
coefficients (six of A, three of T) is a polynomial in the positions, scaled to the calibrated range: ``x = (p
- centre) / scale``. All nine are in nT: ``A = I + a / F_0``, with F_0 the field at calibration.

The table of the :class:`~magbridge.calibration.kernel.Kernel` holds twelve coefficients in body axes: ``A' =
R A`` (nine, R the boresight) and T. The corrected vector is ``b = A' d`` with ``d = H_r - T``, and its error
``db = dA' d - A' dT``. So its covariance V is quadratic in d. The table holds the combinations of covariances
that V needs: 36 for the quadratic part Q, 27 for ``S_a'T``, 6 for ``S_TT``. The sensor's noise, which acts
like an error of T, is part of ``S_TT``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations, product
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.heading import DEFAULT_TILT_SIGMA_DEG
from magbridge.calibration.kernel import TABLE_SUMS, Kernel
from magbridge.calibration.scalar import ScalarSensor
from magbridge.calibration.terms import Effect, Exponents, Parameter, Polynomial
from magbridge.columns import COLUMNS
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS, symmetric
from magbridge.wording import counted

__all__ = [
    "LEVEL_STEP_SIGMA", "MIN_HALF_RANGE", "SLOT", "Boresight", "CalibratedRange", "CalibratedSensor",
    "Calibration", "Noise", "Parameter", "Reference", "Run", "coefficient_tensor", "facts", "identity",
    "rotation_matrix", "skew", "to_paper",
]  # fmt: skip

SLOT = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
"""Index of ``A[i, k]`` among the nine coefficients."""
LEVEL_STEP_SIGMA = 0.01
"""Step of the corrected field's mean in :meth:`Calibration.at_level`, as a fraction of ``level_sigma``."""


def compile_kernel(calibration: Calibration) -> Kernel:
    """Return the calibration in the form with which samples are corrected; the module's notes explain it."""
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

    Returns `tensor` (K, m, 9), nT at F_0: coefficient k times ``tensor[k, r]`` adds to the slots of regressor
    r. The regressors are the monomials, then those of the effects. Returns `exponents`: the monomials in the
    kernel's order, each after its parent.
    """
    polynomials = [exponent for term in calibration.terms for exponent in term.exponents]
    exponents = _closed(set(polynomials), calibration)
    row = {exponent: i for i, exponent in enumerate(exponents)}
    effects = [effect.columns(calibration.reference.field) for effect in calibration.effects]
    m = len(exponents) + sum(columns.shape[1] for columns in effects)
    tensor = np.zeros((calibration.coefficients.size, m, 9))
    k, r = 0, len(exponents)
    for exponent in polynomials:  # nine coefficients of a monomial, one for each slot
        tensor[k : k + 9, row[exponent]] = np.eye(9)
        k += 9
    for columns in effects:
        tensor[k : k + columns.shape[0], r : r + columns.shape[1]] = columns
        k, r = k + columns.shape[0], r + columns.shape[1]
    return tensor, exponents


def _parent(exponent: Exponents) -> tuple[Exponents, int]:
    """Return the parent monomial, lower by one power of its last position, and that position's index."""
    k = max(i for i, power in enumerate(exponent) if power)
    return (*exponent[:k], exponent[k] - 1, *exponent[k + 1 :]), k


def _closed(exponents: set[Exponents], calibration: Calibration) -> list[Exponents]:
    """Return `exponents` and all their parents, by degree, so that each parent precedes its children."""
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
    """Return the matrix (9, 12) that turns A's six entries and T into the nine entries of ``R A`` and T."""
    R = np.eye(3) if calibration.boresight is None else calibration.boresight.matrix()
    B = np.zeros((9, 12))
    for i, j, k in product(range(3), repeat=3):
        B[SLOT[j][k], 3 * i + k] += R[i, j]
    B[6:, 9:] = np.eye(3)
    return B


def _table(
    P: FloatArray, W: FloatArray, calibration: Calibration, exponents: list[Exponents]
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return the indices of each product's two regressors, (q,) and (q,), and the table as (q, 81)."""
    m, B = len(W), _body_axes(calibration)
    flat = (P @ B).reshape(len(P), -1)
    C = (flat.T @ calibration.covariance @ flat).reshape(m, 12, m, 12)

    def key(i: int, j: int) -> tuple[tuple[int, ...], ...]:
        powers = [exponents[r] for r in (i, j) if r < len(exponents)]
        others = [r for r in (i, j) if r >= len(exponents)]
        return tuple(map(sum, zip(*powers, strict=True))), tuple(others)

    products: dict[tuple[tuple[int, ...], ...], list[tuple[int, int]]] = {}
    for i in range(m):
        for j in range(i, m):
            products.setdefault(key(i, j), []).append((i, j))
    table = np.zeros((len(products), TABLE_SUMS))
    table[:m, :12] = W @ B
    for q, pairs in enumerate(products.values()):
        S = np.sum([C[i, :, j] + (C[j, :, i] if i != j else 0.0) for i, j in pairs], axis=0)
        if q == 0:  # the sensor's noise adds to the reading as an error of T does
            S[9:, 9:] += calibration.noise.sensor**2 * np.eye(3)
        # Q (V's six entries by the six products of d), S_a'T (9 x 3) and S_TT (6)
        Q = [
            S[3 * i + k, 3 * j + l] + (S[3 * i + l, 3 * j + k] if k != l else 0.0)
            for i, j in PAIRS
            for k, l in PAIRS  # noqa: E741  (the index of the equation)
        ]
        table[q, 12:] = [*Q, *S[:9, 9:].ravel(), *(S[9 + i, 9 + j] for i, j in PAIRS)]
    first, second = np.array([pairs[0] for pairs in products.values()]).T
    return first, second, table


class CalibratedSensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Identity of the calibrated instrument, and its anti-alias filter."""

    name: str = ""
    """Name of the instrument; empty: unknown."""
    power_cycle: int | None = None
    """Number of the power cycle in which the data were recorded; None: unknown."""
    filter_cutoff: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    """Cutoff frequency (Hz) of the anti-alias filter whose effect the correction inverts; 0: no filter."""

    def may_be(self, name: str) -> bool:
        """Return True if `name` equals the sensor's name, or one of the two names is empty (unknown)."""
        return "" in (self.name, name) or self.name == name


UNKNOWN = CalibratedSensor()


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Noise of the samples: a white part, and an AR(1) part.

    The correlation time of the AR(1) part is ``-interval / log(autocorrelation)``, in s.
    """

    sensor: Annotated[float, Meta(ge=0.0, le=1e15)]
    reference: float = 0.0
    """`sensor`, `reference`: 1-sigma of each channel of the sensor, and of the reference field, nT."""
    autocorrelation: float = 0.0
    """Correlation between successive samples of the AR(1) part."""
    interval: float = 0.0
    """Time between successive samples, s."""
    white: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """White fraction of the variance."""


class Reference(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reference field with which the fit compared the magnitude of the corrected field."""

    field: Annotated[float, Meta(gt=0.0)]
    """F_0, the field at calibration, nT."""
    model: str = ""
    """Name of the field model."""
    bias: float = 0.0
    """Constant bias of the reference at the site, as the fit found it, nT."""
    bias_sigma: float = 0.0
    """Prior 1-sigma of this bias, nT."""
    level_sigma: float = 0.0
    """Part of the corrected field's sigma that is common to all samples, nT."""


class Boresight(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Rotation from corrected sensor axes to body axes, which a fit to the magnitude cannot determine."""

    rotation: tuple[float, float, float]
    """Rotation vector, rad."""
    covariance: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    """Covariance of the error, a small further rotation in body axes, rad²."""
    tilt_sigma: float = DEFAULT_TILT_SIGMA_DEG
    """1-sigma of roll and of pitch in the runs that determined the rotation, deg."""

    def matrix(self) -> FloatArray:
        """Return the rotation matrix (3, 3)."""
        return rotation_matrix(self.rotation)


def skew(vector: Sequence[float] | FloatArray) -> FloatArray:
    """Return the matrix (3, 3) of the cross product ``v x``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_matrix(vector: Sequence[float] | FloatArray) -> FloatArray:
    """Return the rotation (3, 3) by a rotation vector (3,), rad, by Rodrigues' formula."""
    # R = I + sinc(a) K + (1 - cos a)/a^2 K^2; 1 - cos a = 2 sin^2(a/2), so that both factors stay
    # finite at a = 0
    K = skew(vector)
    angle = float(np.linalg.norm(vector))
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * K @ K
    )


MIN_HALF_RANGE = {"depth": 10.0, "sensor_temperature": 2.0}

"""Conditions whose range a fit records, and the smallest half range of each (m, degC). A calibration at one
depth or temperature is valid within this half range of it."""


class CalibratedRange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Range of depth or sensor temperature in the data of a fit that does not model this condition."""

    name: str
    """A key of :data:`MIN_HALF_RANGE`."""
    low: float
    high: float
    """`low`, `high`: Range in the data; depth in m (0 above the surface), temperature in degC."""

    @property
    def unit(self) -> str:
        """Return the unit of `low` and `high`."""
        return COLUMNS[self.name].units

    @property
    def middle_and_half(self) -> tuple[float, float]:
        """Return the middle and the half of the range in which the calibration is valid."""
        half = max(0.5 * (self.high - self.low), MIN_HALF_RANGE[self.name])
        return 0.5 * (self.low + self.high), half

    def excess(self, value: float) -> float:
        """Return the distance of a value from the range, in half ranges; 0 if it lies inside or is NaN."""
        # in half ranges from the middle: 1 is the edge
        middle, half = self.middle_and_half
        distance = abs(value - middle) / half
        return distance - 1.0 if distance > 1.0 else 0.0


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Summary of one calibration run."""

    label: str
    samples: int
    """Number of samples."""
    rms: float
    """RMS of the residual, nT as the sensor measures (before the scale factors of A)."""
    parameters: tuple[float, ...]
    """Mean value of each parameter, in its unit."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of a vector magnetometer with its uncertainty; immutable."""

    parameters: tuple[Parameter, ...]
    terms: tuple[Polynomial, ...]
    coefficients: FloatArray
    """(K,): Coefficients of the terms, nT, then of the effects, whose class states the unit."""
    covariance: FloatArray
    """(K, K): Covariance of the coefficients."""
    noise: Noise
    reference: Reference
    effects: tuple[Effect, ...] = ()
    sensor: CalibratedSensor = UNKNOWN
    boresight: Boresight | None = None
    runs: tuple[Run, ...] = ()
    method: str = ""
    """Name of the fitting method; with ``"none"`` every sample is flagged as uncalibrated."""
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of each input file, by the file's name."""
    software: str = ""
    """Version of magbridge that made the calibration."""
    warnings: tuple[str, ...] = ()
    """Reasons why the data do not support the calibration; empty if they support it."""
    level: tuple[float, ...] = ()
    """Change of the first coefficients (nT) when the mean of the corrected field rises by the reference's
    ``level_sigma``; empty if the reference was known exactly."""
    sensors: tuple[ScalarSensor, ...] = ()
    """Scalar magnetometers in addition to the vector sensor."""
    conditions: tuple[CalibratedRange, ...] = ()
    """Ranges of depth and temperature in the data of the fit."""

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
        """Names of the telemetry channels for the correction: parameters, then channels of effects."""
        names = [parameter.name for parameter in self.parameters]
        for effect in self.effects:
            names += [name for name in effect.channels() if name not in names]
        return tuple(names)

    @property
    def unmodelled_conditions(self) -> tuple[CalibratedRange, ...]:
        """Conditions without a parameter or effect."""
        return tuple(one for one in self.conditions if one.name not in self.channels)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter, by the parameter's name."""
        return {parameter.name: parameter.unit for parameter in self.parameters}

    @cached_property
    def kernel(self) -> Kernel:
        """Compiled form of the calibration, with which samples are corrected; compiled at first use."""
        return compile_kernel(self)

    def without_effects(self) -> Calibration:
        """Return the calibration with its position terms, their coefficients and covariance only."""
        # position terms come first in the vector, effects after them
        own = slice(sum(term.size for term in self.terms))
        return replace(
            self, effects=(), coefficients=self.coefficients[own], covariance=self.covariance[own, own],
            level=self.level[own],
        )  # fmt: skip

    def at_level(self) -> Calibration:
        """Return the calibration with its coefficients moved by :data:`LEVEL_STEP_SIGMA` times `level`.

        A whole 1-sigma may move the offset by 100 nT across the field, beyond where the length is linear.
        """
        # a change of the constant bias moves the first coefficients together, along one direction
        moved = self.coefficients.copy()
        many = min(len(moved), len(self.level))
        moved[:many] += LEVEL_STEP_SIGMA * np.asarray(self.level[:many])
        return replace(self, coefficients=moved)

    def matrices(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``A`` and ``T`` by the position terms, without effects, at n sets of positions.

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
    """Return a calibration that leaves readings unchanged and flags every sample ``uncalibrated``.

    `field`: F_0, nT.
    """
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
    """Return the paper's rotation M (3, 3) and scales S (3,), nT, of a symmetric positive ``A`` (3, 3).

    `field`: H_e, nT. The function orders and signs the axes so that M is as near to I as possible.
    """
    values, axes = np.linalg.eigh(A)
    order = max(permutations(range(3)), key=lambda p: sum(abs(axes[i, k]) for i, k in enumerate(p)))
    axes, values = axes[:, order], values[list(order)]
    axes = axes * np.where(np.diag(axes) < 0.0, -1.0, 1.0)
    if np.linalg.det(axes) < 0.0:
        axes[:, np.argmin(np.abs(np.diag(axes)))] *= -1.0
    return axes, field / values


def facts(calibration: Calibration) -> dict[str, Any]:
    """Return M, S (nT) and T (nT) without effects, at the centre of each parameter, as values for JSON."""
    middle = {parameter.name: parameter.centre for parameter in calibration.parameters}
    A, T = calibration.matrices(np.array([[*middle.values()]]))
    M, S = to_paper(A[0], calibration.reference.field)
    return {"at": middle, "M": M.tolist(), "S_nT": S.tolist(), "T_nT": T[0].tolist()}
