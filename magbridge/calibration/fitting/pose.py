r"""Inputs of a fit: the samples with their monomials, and the prior of the coefficients.

The prior has physical widths (:mod:`magbridge.estimation.priors`), or consists of dipoles at measured
positions, or follows from earlier deployments of the vehicle (:class:`Known`).

Notes
-----
Coefficients of two deployments can be compared only for the same scaling of the positions and the same field
F_0. With :math:`x = s x' + t` for each parameter, an old monomial is a polynomial in the new positions,

.. math:: x^p = \sum_q \prod_k \binom{p_k}{q_k} s_k^{q_k} t_k^{p_k - q_k} x'^q,

so the new coefficients are linear in the old ones (:func:`rescaling`).

A known prior N(m, S) enters the fit as ``c = L z + m`` with ``S = L L^T``. All z have one common width, with
a prior about 1, which maximises the evidence. If a deployment differs from the earlier ones, S becomes wider.

A mounted mass has twelve latent unknowns: permanent moment (3), induced moment (3), error of its measured
position (3) and of its measured travel (3). The free polynomials remain, with far smaller widths, for effects
that dipoles do not describe (extended masses, a sensor misaligned by a degree). The coefficients are linear
in the moments. In the errors of position and travel the fit linearises them again in each iteration.
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
from magbridge.estimation.blocks import ParameterBlock, with_blocks
from magbridge.estimation.priors import FACTOR_MASS, PriorFamily, gain_rotation, polynomial_prior
from magbridge.estimation.residual import ResidualSamples
from magbridge.toml import check_entries, convert, load_toml

# ---- Dipoles at measured positions ----

Vector = tuple[float, float, float]

MOMENT, INDUCED = 2000.0, 30.0
"""Prior median of a mass's permanent and induced moment, as a field at the sensor, nT; the values are those
of a battery pack at arm's length."""
INDUCED_APART = 0.4
"""1-sigma of the susceptibilities' differences between axes, as a fraction of the induced moment."""
TRAVEL_SIGMA = 0.03
"""1-sigma of the travel's error, as a fraction of the travel, for a misalignment of one or two degrees."""
REST_T, REST_A = 1.0, 0.25
"""Prior median of the change of T and of a that the dipole does not describe, nT over half the range."""
LATENT = 12
"""Number of latent unknowns of a mass."""


class Mounting(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[mass.NAME]`` of ``vehicle.toml``: position from the sensor of the mass that parameter NAME moves."""

    at: Vector
    """Position of the mass from the sensor at parameter value 0, body axes, m."""
    travel: Vector
    """Change of the position for one unit of the parameter, body axes, m."""
    at_sigma: Annotated[float, Meta(gt=0)] = 0.05
    """1-sigma of `at`, m."""


class _VehicleFile(msgspec.Struct, forbid_unknown_fields=True):
    mass: dict[str, Mounting]


def read_vehicle(path: str | Path) -> dict[str, Mounting]:
    """Return the mounting of each mass in a ``vehicle.toml``; ConfigError: a key or type is wrong."""
    table = load_toml(path)
    check_entries(table, "mass", Mounting, path)
    return convert(table, _VehicleFile, path).mass


@dataclass(frozen=True, eq=False)
class _Mass:
    """Mounted mass in a fit."""

    rows: IndexArray
    """Indices of the monomials x, x^2 ... of its parameter."""
    at: FloatArray
    travel: FloatArray
    sigma: float
    """`at`, `travel`, `sigma`: as in :class:`Mounting`."""
    parameter: Parameter

    def columns(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``dc/dl`` (order, 9, 12) and c (order, 9): coefficients c at latent unknowns l (12,)."""
        # c is linear in the first six unknowns (moments): it is their product with the derivative
        by = mass_columns(self.at, self.travel, self.parameter, len(self.rows), latent)
        moved = by[1:]  # the constant is part of the hard iron
        return moved, moved[..., :6] @ latent[:6]


def mass_columns(
    place: FloatArray, travel: FloatArray, parameter: Parameter, order: int, latent: FloatArray
) -> FloatArray:
    """Return the derivatives ``dc/dl`` (order + 1, 9, 12) of a mass's coefficients, the constant first.

    `place`, `travel` (3,): m, and m per unit of the parameter. `latent` (12,): unknowns l, namely moment and
    induced moment (nT), shift (m), change of the travel (m per unit).
    """
    # A dipole's field is evaluated at Chebyshev points of the travel, together with its derivatives, and
    # expanded in powers of the position: these are the coefficients of the monomials x, x^2 ...
    moment, pulled, shift, stretch = latent.reshape(4, 3)
    induced = gain_rotation() @ pulled
    p = parameter.centre + parameter.scale * chebyshev.chebpts1(4 * order + 4)
    r = place + shift + p[:, None] * (travel + stretch)
    # the moments refer to the measured distance, so that a shift does not change them
    by = dipole_columns(r, moment, induced, float(np.linalg.norm(place)))
    by[3:6] = np.tensordot(gain_rotation().T, by[3:6], 1)
    # a change of the travel moves the mass by p times this change
    by = np.concatenate([by, by[6:] * p[:, None]])
    return np.moveaxis(expand_dipole(by, order), 0, -1)


def mounted_prior(
    free: PriorFamily,
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
    vehicle: Mapping[str, Mounting | Mapping[str, Any]],
) -> PriorFamily:
    """Return the prior `free` of polynomials with the unknowns of a dipole added for each mass of `vehicle`.

    CalibrationError: no parameter moves a mass, or it is too near the sensor for a power series.
    """
    names = [parameter.name for parameter in parameters]
    masses = [_mass(name, found, exponents, parameters) for name, found in vehicle.items()]
    # after the unknowns of the free polynomials: 3 of each mass's moment, induced moment, shift and travel
    blocks: list[ParameterBlock] = []
    alike, none = np.ones(3), np.empty((0, 3))
    for name, mass in zip(vehicle, masses, strict=True):
        apart = np.array([np.sqrt(3.0), INDUCED_APART, INDUCED_APART])
        travel = float(TRAVEL_SIGMA * np.linalg.norm(mass.travel))
        blocks += [
            ParameterBlock(f"{name} moment", none, alike, MOMENT, FACTOR_MASS),
            ParameterBlock(f"{name} induced", none, apart, INDUCED, FACTOR_MASS),
            ParameterBlock(f"{name} shift", none, alike, mass.sigma),
            ParameterBlock(f"{name} travel", none, alike, travel),
        ]
    whole = with_blocks(free, tuple(blocks))
    # the remainder is small: give the mass's own polynomials a narrow prior
    for name in vehicle:
        k = 3 + 3 * names.index(name)
        whole.centre[k : k + 2] = np.log([REST_T, REST_A])
    return _linearised(whole, masses, np.zeros((len(masses), LATENT)))


def _mass(
    name: str,
    found: Mounting | Mapping[str, Any],
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
) -> _Mass:
    """Return a mass of the fit; CalibrationError: no parameter moves it, or it is too near the sensor."""
    mounting = found if isinstance(found, Mounting) else msgspec.convert(found, Mounting)
    names = [parameter.name for parameter in parameters]
    if name not in names:
        raise CalibrationError(f"vehicle: mass {name!r}: the fit's parameters are {', '.join(names)}")
    k = names.index(name)
    order = max(powers[k] for powers in exponents)
    rows = [exponents.index(tuple(n * (i == k) for i in range(len(names)))) for n in range(1, order + 1)]
    parameter, travel = parameters[k], np.array(mounting.travel)
    # a power series in x converges only if the mass is far from the sensor, compared with its travel
    middle = np.linalg.norm(np.array(mounting.at) + parameter.centre * travel)
    if middle < 3.0 * parameter.scale * np.linalg.norm(travel) or middle == 0.0:
        raise CalibrationError(f"vehicle: mass {name!r} passes within three half-travels of the sensor")
    return _Mass(np.array(rows), np.array(mounting.at), travel, mounting.at_sigma, parameter)


def _linearised(family: PriorFamily, masses: list[_Mass], latent: FloatArray) -> PriorFamily:
    """Return the prior with the dipoles linearised about `latent`: ``c(l) ~ c(l_0) + J (l - l_0)``."""
    # c = E z + offset, with the dipoles' columns at the end of E and their remainder in the offset
    J, offset = family.E.copy(), np.zeros(len(family.E))
    q = J.shape[1] - LATENT * len(masses)
    for i, (mass, at) in enumerate(zip(masses, latent, strict=True)):
        by, value = mass.columns(at)
        place = (9 * mass.rows[:, None] + np.arange(9)).ravel()
        J[place, q + LATENT * i : q + LATENT * (i + 1)] = by.reshape(-1, LATENT)
        offset[place] += (value - by @ at).ravel()

    def renew(z: FloatArray) -> PriorFamily:
        return _linearised(family, masses, z[q:].reshape(-1, LATENT))

    return replace(family, E=J, offset=offset, renew=renew)


# ---- A known prior ----

DEPARTURE = "departure from the prior"
"""Name of the common width of z, which is 1 if a deployment is as expected."""
SPREAD = np.log(1.5)
"""1-sigma of the logarithm of the common width of z."""


@dataclass(frozen=True, eq=False)
class Known:
    """Gaussian prior of the coefficients, from earlier deployments."""

    parameters: tuple[Parameter, ...]
    """Scaling of the positions, and their range in the earlier deployments."""
    exponents: tuple[Exponents, ...]
    """The m monomials: all up to one degree."""
    field: float
    """Reference field F_0 of the coefficients, nT."""
    mean: FloatArray
    """(9 m,): Mean of the coefficients, nT."""
    covariance: FloatArray
    """(9 m, 9 m): Covariance of the coefficients, nT², positive definite."""

    def ranges(self, data: Observations) -> tuple[Parameter, ...]:
        """Return the parameters with ranges that include the positions in `data`.

        CalibrationError: names, units or order of the parameters in `data` differ.
        """
        # names, units and order must agree: coefficients have no meaning for other positions
        mine = [(one.name, one.unit) for one in self.parameters]
        theirs = list(zip(data.names, data.units, strict=True))
        if mine != theirs:
            listed = [
                ", ".join(f"{name} [{unit}]" for name, unit in both) or "none" for both in (mine, theirs)
            ]
            raise CalibrationError(f"known are coefficients for {listed[0]}, and the log has {listed[1]}")
        low = np.minimum([one.low for one in self.parameters], data.parameters.min(axis=0)).tolist()
        high = np.maximum([one.high for one in self.parameters], data.parameters.max(axis=0)).tolist()
        ends = zip(self.parameters, low, high, strict=True)
        return tuple(msgspec.structs.replace(one, low=least, high=most) for one, least, most in ends)

    def prior(self, F_0: float) -> PriorFamily:
        """Return the prior of a fit whose coefficients refer to the field `F_0` (nT)."""
        # c = L mean + chol(L P L^T) z: z is N(0, 1) times a width that maximises the evidence
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


def rescaling(
    exponents: Sequence[Exponents],
    old: Sequence[Parameter],
    new: Sequence[Parameter],
    field_old: float,
    field_new: float,
) -> FloatArray:
    """Return the matrix (9 m, 9 m) from coefficients for the scaling of `old` to those for that of `new`.

    `exponents`: the m monomials, all up to one degree. `field_old`, `field_new`: F_0, nT.
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


# ---- Samples and prior of a fit ----

Vehicle = Mapping[str, Mounting | Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class Posed:
    """Input of a fit: ranges and monomials of the positions, samples, and prior of the coefficients."""

    ranges: tuple[Parameter, ...]
    exponents: tuple[Exponents, ...]
    samples: ResidualSamples
    family: PriorFamily


def pose(data: Observations, order: int, vehicle: Vehicle | None = None, known: Known | None = None) -> Posed:
    """Return the input of a fit of polynomials up to the total degree `order` to `data`.

    `vehicle`: mounting of the masses, by parameter. `known`: prior with its own monomials, not `order`.

    CalibrationError: `vehicle` and `known` are both given, or `known` has other parameters than `data`.
    """
    # without a known prior: physical widths, and dipoles for masses with a measured position
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
