"""Inputs of a fit: the samples with their monomials, and the prior of the coefficients.

The prior is one of physical widths (:mod:`magbridge.estimation.priors`), of dipoles at measured places
(:mod:`.mounted_masses`), or from earlier deployments of the vehicle (:mod:`.known`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from magbridge.calibration.fitting.known import Known
from magbridge.calibration.fitting.mounted_masses import Mounting, mounted_prior
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Exponents, full_order
from magbridge.errors import CalibrationError
from magbridge.estimation.priors import PriorFamily, polynomial_prior
from magbridge.estimation.residual import ResidualSamples

__all__ = ["Posed", "Vehicle", "pose"]

Vehicle = Mapping[str, Mounting | Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class Posed:
    """A fit as a problem: ranges of the positions, monomials in them, samples, prior."""

    ranges: tuple[Parameter, ...]
    exponents: tuple[Exponents, ...]
    samples: ResidualSamples
    family: PriorFamily


def pose(data: Observations, order: int, vehicle: Vehicle | None = None, known: Known | None = None) -> Posed:
    """Return the problem of fitting polynomials up to `order` to `data`.

    Parameters
    ----------
    data : Observations
        The calibration runs.
    order : int
        Highest total degree; of no account where `known` is given, which has its own.
    vehicle : mapping of Mounting (or of its fields), optional
        Where the masses sit, by parameter.
    known : Known, optional
        What the coefficients are expected to be.

    Raises
    ------
    CalibrationError
        Both are given, or `known` is of other parameters.
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
