r"""Inputs of a fit: the samples with their monomials, and the prior of the coefficients.

The prior is one of physical widths (:mod:`magbridge.estimation.priors`), of dipoles at measured places,
or from earlier deployments of the vehicle (:class:`Known`).

Notes
-----
Coefficients of two deployments can be compared only for the same scaling of the positions and the same field
F_0. With :math:`x = s x' + t` for each parameter, a monomial of the old is a polynomial in the new,

.. math:: x^p = \sum_q \prod_k \binom{p_k}{q_k} s_k^{q_k} t_k^{p_k - q_k} x'^q,

so that the new coefficients are linear in the old (:func:`rescaling`).

A known prior N(m, S) enters the fit as ``c = L z + m``, where ``S = L L^T`` and z has one common width, with
a prior about 1, chosen by the evidence: where a deployment is unlike all that was known, S widens.

Latent numbers of a mounted mass: permanent moment (3), induced moment (3), error of its measured place (3)
and of its measured travel (3). The free polynomials remain, with far smaller widths, for what dipoles do not
describe (extended masses, a sensor a degree out of alignment). The coefficients are linear in the moments. In
the errors of place and travel they are linearised again in each round of the fit, so that no place is held
more certain than `at_sigma`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.polynomial import chebyshev

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.dipole import dipole_columns, expand_dipole
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents, full_order
from magbridge.errors import CalibrationError
from magbridge.estimation.priors import FACTOR_MASS, PriorFamily, gain_rotation, polynomial_prior
from magbridge.estimation.residual import ResidualSamples
from magbridge.toml import check_entries, convert, load_toml

# ---- Dipoles at measured places ----

Vector = tuple[float, float, float]

MOMENT, INDUCED = 2000.0, 30.0
"""Permanent and induced moment of a mass, nT at the sensor: a battery pack at arm's length."""
INDUCED_APART = 0.4
"""Difference of the susceptibilities of the three axes, as a fraction of the induced moment."""
TRAVEL_SIGMA = 0.03
"""1-sigma of the travel, as a fraction: sensor and vehicle are a degree or two out of alignment."""
REST_T, REST_A = 1.0, 0.25
"""Size of what the dipole does not describe, nT over half the range, in T and in a."""
LATENT = 12
"""Latent numbers of a mass."""


class Mounting(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[mass.NAME]``: where the mass that parameter NAME moves sits, seen from the sensor."""

    at: Vector
    """Position in the body frame where the parameter is 0, m."""
    travel: Vector
    """m per unit of the parameter."""
    at_sigma: Annotated[float, Meta(gt=0)] = 0.05
    """1-sigma of `at`, m."""


class _VehicleFile(msgspec.Struct, forbid_unknown_fields=True):
    mass: dict[str, Mounting]


def read_vehicle(path: str | Path) -> dict[str, Mounting]:
    """Read ``vehicle.toml``; ConfigError: the file, a key or a type is not as expected."""
    table = load_toml(path)
    check_entries(table, "mass", Mounting, path)
    return convert(table, _VehicleFile, path).mass


@dataclass(frozen=True, eq=False)
class _Mass:
    """A mounted mass in the fit: its monomials, and the line along which it travels."""

    rows: IndexArray  # of its monomials x, x^2 ...
    at: FloatArray
    travel: FloatArray
    sigma: float
    parameter: Parameter

    def columns(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``dc/dl`` (order, 9, 12) and c (order, 9): its coefficients c at latent numbers l."""
        # linear in the first six latent numbers (moments), so that c is their product with the derivative
        by = mass_columns(self.at, self.travel, self.parameter, len(self.rows), latent)
        moved = by[1:]  # the constant is absorbed by the hard iron
        return moved, moved[..., :6] @ latent[:6]


def mass_columns(
    place: FloatArray, travel: FloatArray, parameter: Parameter, order: int, latent: FloatArray
) -> FloatArray:
    """Return ``dc/dl`` (order + 1, 9, 12): coefficients of a mass, the constant first, by its latent numbers.

    `place`, `travel` (3,): m, and m per unit of the parameter. `latent` (12,): moment and induced moment
    (nT), shift (m), change of the travel (m per unit).
    """
    # A dipole's field is evaluated at Chebyshev points of the travel, together with its derivatives, and
    # expanded in powers of the position: these are the coefficients of the monomials x, x^2 ...
    moment, pulled, shift, stretch = latent.reshape(4, 3)
    induced = gain_rotation() @ pulled
    p = parameter.centre + parameter.scale * chebyshev.chebpts1(4 * order + 4)
    r = place + shift + p[:, None] * (travel + stretch)
    # moments stay scaled by the measured distance, or a shift would change them too
    by = dipole_columns(r, moment, induced, float(np.linalg.norm(place)))
    by[3:6] = np.tensordot(gain_rotation().T, by[3:6], 1)
    # a change of the travel moves the mass by p times it
    by = np.concatenate([by, by[6:] * p[:, None]])
    return np.moveaxis(expand_dipole(by, order), 0, -1)


def mounted_prior(
    free: PriorFamily,
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
    vehicle: Mapping[str, Mounting | Mapping[str, Any]],
) -> PriorFamily:
    """Add to the free polynomials `free` a dipole for each mass of `vehicle`.

    CalibrationError: `vehicle` names a mass that no parameter moves, or one too near the sensor for a power
    series.
    """
    names = [parameter.name for parameter in parameters]
    masses = [_mass(name, found, exponents, parameters) for name, found in vehicle.items()]
    # Latent numbers: those of the free polynomials, then for each mass 3 of the moment, 3 of the induced
    # moment, 3 of the shift and 3 of the travel. log sigma = constant + design @ eta for each.
    labels = tuple(f"{name} {kind}" for name in vehicle for kind in ("moment", "induced"))
    q, h, extra = free.design.shape[0], free.design.shape[1], len(labels)
    design = np.zeros((q + LATENT * len(masses), h + extra))
    design[:q, :h] = free.design
    constant = np.append(free.constant, np.zeros(LATENT * len(masses)))
    for i, mass in enumerate(masses):
        first = q + LATENT * i
        design[first : first + 3, h + 2 * i] = 1.0
        design[first + 3 : first + 6, h + 2 * i + 1] = 1.0
        constant[first + 3] = np.log(np.sqrt(3.0))
        constant[first + 4 : first + 6] = np.log(INDUCED_APART)
        constant[first + 6 : first + 9] = np.log(mass.sigma)
        constant[first + 9 : first + 12] = np.log(TRAVEL_SIGMA * np.linalg.norm(mass.travel))
    centre = np.append(free.centre, np.log([MOMENT, INDUCED] * len(masses)))
    # what the dipole does not describe is small: narrow the mass's own polynomials
    for name in vehicle:
        k = 3 + 3 * names.index(name)
        centre[k], centre[k + 1] = np.log(REST_T), np.log(REST_A)
    whole = PriorFamily(
        E=free.E,
        offset=free.offset,
        constant=constant,
        design=design,
        centre=centre,
        spread=np.append(free.spread, np.full(extra, FACTOR_MASS)),
        names=free.names + labels,
    )
    return _linearised(whole, masses, np.zeros((len(masses), LATENT)))


def _mass(
    name: str,
    found: Mounting | Mapping[str, Any],
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
) -> _Mass:
    """Return a mass with the rows of its parameter's pure powers; refuse one that is unknown or too near."""
    mounting = found if isinstance(found, Mounting) else msgspec.convert(found, Mounting)
    names = [parameter.name for parameter in parameters]
    if name not in names:
        raise CalibrationError(f"vehicle: mass {name!r}: the fit's parameters are {', '.join(names)}")
    k = names.index(name)
    order = max(powers[k] for powers in exponents)
    rows = [exponents.index(tuple(n * (i == k) for i in range(len(names)))) for n in range(1, order + 1)]
    parameter, travel = parameters[k], np.array(mounting.travel)
    # a power series in x converges only if the mass stays well away from the sensor
    middle = np.linalg.norm(np.array(mounting.at) + parameter.centre * travel)
    if middle < 3.0 * parameter.scale * np.linalg.norm(travel) or middle == 0.0:
        raise CalibrationError(f"vehicle: mass {name!r} passes within three half-travels of the sensor")
    return _Mass(np.array(rows), np.array(mounting.at), travel, mounting.at_sigma, parameter)


def _linearised(family: PriorFamily, masses: list[_Mass], latent: FloatArray) -> PriorFamily:
    """Return the prior with the dipoles linearised about `latent`: ``c(l) ~ c(l_0) + J (l - l_0)``."""
    size, q = family.E.shape
    # c = E z + offset, with the dipoles' columns appended to E and their remainder in the offset
    J = np.zeros((size, q + LATENT * len(masses)))
    J[:, :q] = family.E
    offset = np.zeros(size)
    for i, (mass, at) in enumerate(zip(masses, latent, strict=True)):
        by, value = mass.columns(at)
        place = (9 * mass.rows[:, None] + np.arange(9)).ravel()
        J[place, q + LATENT * i : q + LATENT * (i + 1)] = by.reshape(-1, LATENT)
        offset[place] += (value - by @ at).ravel()

    def renew(z: FloatArray) -> PriorFamily:
        return _linearised(family, masses, z[q:].reshape(-1, LATENT))

    return replace(family, E=J, offset=offset, renew=renew)


# ---- A prior that is known ----

DEPARTURE = "departure from the prior"
"""Name of the width of z: 1 where a deployment is as it was expected."""
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
    """Return the matrix (9 m, 9 m) from coefficients in `old` scales of the positions to `new` ones.

    `exponents`: the m monomials, all up to a degree. `field_old`, `field_new`: F_0, nT.
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
    """Return the problem of fitting polynomials up to the total degree `order` to `data`.

    `vehicle`: where the masses sit, by parameter. `known`: expected coefficients, with their own order.

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
