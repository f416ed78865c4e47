r"""How a refit moves a vehicle's coefficients together, where it is known where its masses sit.

A refit changes the moment of a mass, its susceptibility, and its place. Each of these moves the coefficients
along a shape of its own, the derivative of the mass's polynomials (``mass_columns``). That by the place
needs the moment: so a dipole is first fitted to what the vehicle's deployments say together, N(m, P),

.. math:: l = \arg\min\ (c(l) - m)^T P^{-1} (c(l) - m) + l^T W^{-1} l,

with W the dipole's usual widths, linearised again in each of :data:`SHAPE_ITERATIONS`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.pose import LATENT, Mounting, mass_columns, mounted_prior
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents
from magbridge.estimation.priors import polynomial_prior

__all__ = ["shape_groups", "shapes_of"]

SHAPE_ITERATIONS = 4
SHAPE_KINDS = 3
"""Of shapes of a mass: moment, susceptibility, place; three numbers each."""


def shapes_of(
    mounted: Mapping[str, Mounting],
    exponents: tuple[Exponents, ...],
    parameters: tuple[Parameter, ...],
    field: float,
    mean: FloatArray,
    covariance: FloatArray,
) -> FloatArray:
    """Return the shapes (K, 9 n) of a vehicle's n masses, nT for the usual width of each dipole's number.

    Parameters
    ----------
    mounted : mapping of Mounting
        Where each mass sits.
    exponents, parameters, field
        As in :class:`.Known`.
    mean, covariance : (K,), (K, K) arrays
        nT, of the vehicle's coefficients.
    """
    free = polynomial_prior(exponents, tuple(one.name for one in parameters), field)
    family = mounted_prior(free, exponents, parameters, mounted)
    weight = np.linalg.inv(covariance)
    for _ in range(SHAPE_ITERATIONS):
        prior = family.prior(family.centre)
        pull = prior.E.T @ weight
        z = np.asarray(np.linalg.solve(pull @ prior.E + prior.precision, pull @ (mean - prior.offset)))
        assert family.renew is not None
        family = family.renew(z)
    size, order = len(mean), max(map(sum, exponents))
    shapes = np.zeros((len(exponents), 9, len(mounted), 3 * SHAPE_KINDS))
    latents = z[size:].reshape(-1, LATENT), family.widths(family.centre)[size:].reshape(-1, LATENT)
    for i, (name, mass, latent, width) in enumerate(
        zip(mounted.keys(), mounted.values(), *latents, strict=True)
    ):
        k = [one.name for one in parameters].index(name)
        by = mass_columns(np.array(mass.at), np.array(mass.travel), parameters[k], order, latent) * width
        for n in range(order + 1):
            row = exponents.index(tuple(n * (j == k) for j in range(len(parameters))))
            shapes[row, :, i] = by[n, :, : 3 * SHAPE_KINDS]
    return shapes.reshape(size, -1)


def shape_groups(masses: int) -> IndexArray:
    """Return the number of the group of each shape (9 n,): kinds of a mass have a variance each."""
    return np.repeat(np.arange(SHAPE_KINDS * masses), 3)
