r"""A calibration that was made elsewhere, put on record and used.

A cal.json holds a posterior N(c, P), not what the data alone say. Its prior is taken to have been the
physical one, N(0, W) (:mod:`magbridge.estimation.priors`), and only directions that the data have
determined count: with :math:`W^{-1/2} P W^{-1/2} = \sum \lambda_k v_k v_k^T`, those with
:math:`\lambda_k` below :data:`DETERMINED`, with the precision :math:`\lambda_k^{-1} - 1`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magbridge.calibration.file import encode_calibration
from magbridge.calibration.terms import Polynomial
from magbridge.errors import WrongUse
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import polynomial_prior
from magbridge.fleet.job import GIVEN
from magbridge.fleet.learn import packed
from magbridge.fleet.register import Deployment, vehicle_named

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration
    from magbridge.fleet.catalogue import Catalogue, Row

__all__ = ["add_calibration"]

DETERMINED = 0.25
"""Share of the prior's variance that is left, below which the data have determined a direction."""


def add_calibration(
    catalogue: Catalogue, vehicle: str, deployment: Deployment, start: float, calibration: Calibration
) -> int:
    """Put a calibration on record, unless it is; return how many were added.

    Parameters
    ----------
    catalogue : Catalogue
        Where to put it.
    vehicle : str
        Its vehicle's name.
    deployment : Deployment
        The deployment's name, refit and sensor.
    start : float
        s since 1970, when that began.
    calibration : Calibration
        The calibration of it.

    Raises
    ------
    WrongUse
        There is no such vehicle, its masses are others, or the deployment has another calibration.
    """
    of = vehicle_named(catalogue, vehicle)
    names = [one.name for one in calibration.parameters]
    if names != of["parameters"]:
        both = [", ".join(each) or "none" for each in (names, of["parameters"])]
        raise WrongUse(f"the calibration's parameters are {both[0]}, and {vehicle}'s {both[1]}")
    sensor = deployment.sensor or of["sensor"]
    if not calibration.sensor.may_be(sensor):
        raise WrongUse(
            f"a calibration of sensor {calibration.sensor.name!r}, but {vehicle} {deployment.name} carries "
            f"{sensor!r}"
        )
    row = _row(vehicle, deployment, calibration.sensor.name or sensor, start, calibration, of["order"])
    before = [
        one
        for one in catalogue.rows("calibrations", ["job", "vehicle", "deployment", "calibration"])
        if one["job"] == GIVEN and (one["vehicle"], one["deployment"]) == (vehicle, deployment.name)
    ]
    if any(one["calibration"] != row["calibration"] for one in before):
        raise WrongUse(f"{vehicle} {deployment.name}: has another calibration; name another deployment")
    return catalogue.add("calibrations", [row])


def _row(
    vehicle: str, deployment: Deployment, sensor: str, start: float, calibration: Calibration, order: int
) -> Row:
    samples = sum(run.samples for run in calibration.runs)
    squares = sum(run.samples * run.rms**2 for run in calibration.runs)
    return {
        "job": GIVEN, "attempt": 1, "vehicle": vehicle, "deployment": deployment.name,
        "refit": deployment.refit or deployment.name, "start": start, "sensor": sensor,
        "method": calibration.method, "rms": float(np.sqrt(squares / max(samples, 1))),
        "noise": calibration.noise.sensor, "expected": None, "supported": not calibration.warnings,
        "warnings": list(calibration.warnings), "calibration": encode_calibration(calibration).decode(),
        **packed(_information(calibration, order)),
    }  # fmt: skip


def _information(calibration: Calibration, order: int) -> GaussianInformation | None:
    """Return what its data have determined; None unless it is a polynomial of that order alone."""
    term, *others = calibration.terms
    if others or not isinstance(term, Polynomial) or max(map(sum, term.exponents)) != order:
        return None
    size = term.size
    family = polynomial_prior(
        term.exponents, tuple(one.name for one in calibration.parameters), calibration.reference.field
    )
    to_z = np.linalg.inv(family.E * family.widths(family.centre))
    left, v = np.linalg.eigh(to_z @ calibration.covariance[:size, :size] @ to_z.T)
    left = np.maximum(left, 1e-12)
    known = left < DETERMINED
    J = (v[:, known] * (1.0 / left[known] - 1.0)) @ v[:, known].T
    h = (v[:, known] / left[known]) @ (v[:, known].T @ to_z @ calibration.coefficients[:size])
    return GaussianInformation(to_z.T @ J @ to_z, to_z.T @ h)
