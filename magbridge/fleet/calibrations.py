r"""Calibrations that enter a fleet's memory, and those that it predicts.

A cal.json made elsewhere holds a posterior N(c, P), not what the data alone say. Its prior is taken to have
been the physical one, N(0, W) (:mod:`magbridge.estimation.priors`), and only directions that the data have
determined count: with :math:`W^{-1/2} P W^{-1/2} = \sum \lambda_k v_k v_k^T`, those with
:math:`\lambda_k` below :data:`DETERMINED`, with the precision :math:`\lambda_k^{-1} - 1`.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from magbridge.calibration.file import encode_calibration
from magbridge.calibration.fitting.pose import DEPARTURE, Known
from magbridge.calibration.model import Calibration, Noise, Reference
from magbridge.calibration.terms import Polynomial
from magbridge.errors import WrongUse
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import polynomial_prior
from magbridge.fleet.catalogue import open_catalogue
from magbridge.fleet.job import GIVEN
from magbridge.fleet.learn import Fleet, packed
from magbridge.fleet.memory import fleet_of, owner
from magbridge.fleet.register import Deployment, vehicle_named
from magbridge.version import __version__
from magbridge.wording import counted

if TYPE_CHECKING:
    from magbridge.calibration.fitting.fit import Fit
    from magbridge.fleet.catalogue import Catalogue, Row

__all__ = ["UNLIKE", "FleetPrediction", "add_calibration", "gained", "start", "unflown"]

DETERMINED = 0.25
"""Share of the prior's variance that is left, below which the data have determined a direction."""
UNLIKE = 3.0
"""Times as wide as expected, from which on a deployment is not as its vehicle's past predicts."""


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
    """Return the information of its data; None unless it is a polynomial of that order alone."""
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


def unflown(fleet: Fleet, vehicle: str, refit: str = "") -> Calibration:
    """Return the prediction of a vehicle's next deployment as a calibration.

    Its noise is what that of its deployments was in the mean (of power), or of its fleet's, if it has none.

    Parameters
    ----------
    fleet : Fleet
        The estimates.
    vehicle, refit : str
        As for :meth:`Fleet.known`.
    """
    known = fleet.known(vehicle, refit)
    own = [one.noise for one in fleet.lessons if one.vehicle == vehicle]
    noise = float(np.sqrt(np.mean(np.square(own or [one.noise for one in fleet.lessons]))))
    return Calibration(
        known.parameters, (Polynomial(exponents=known.exponents),), np.asarray(known.mean), known.covariance,
        Noise(noise), Reference(known.field), method="fleet", software=f"magbridge {__version__}",
        warnings=("no run of this deployment: its coefficients are its fleet's prediction",),
    )  # fmt: skip


class FleetPrediction(NamedTuple):
    """The prior; of how many deployments of the vehicle itself, and of other vehicles."""

    known: Known
    vehicle: str
    refit: str
    own: int
    others: int

    @property
    def names(self) -> tuple[str, ...]:
        """The columns that move its masses."""
        return tuple(one.name for one in self.known.parameters)


def start(location: str | Path, member: str, refit: str, digests: Collection[str]) -> FleetPrediction:
    """Return the prediction of a catalogue for logs.

    Parameters
    ----------
    location : str or path
        The catalogue: a folder, or a server's URL.
    member, refit : str
        The logs' vehicle, and which refit it flew with; empty: as the catalogue has them.
    digests : collection of str
        SHA-256 of the logs: estimates from them do not count.

    Raises
    ------
    WrongUse
        There is no such vehicle, or the logs' is not known.
    DataError
        Nothing has been calibrated yet.
    """
    catalogue = open_catalogue(location)
    if not member:
        member, on_record = owner(catalogue, digests)
        refit = refit or on_record
    fleet = fleet_of(catalogue, member, excluded=digests)
    own = sum(one.vehicle == member for one in fleet.lessons)
    return FleetPrediction(fleet.known(member, refit), member, refit, own, len(fleet.lessons) - own)


def gained(found: Fit, single: Fit | None, began: FleetPrediction) -> tuple[dict[str, Any], list[str]]:
    """Return the benefit of the fleet, as values and as lines of text.

    Parameters
    ----------
    found, single : Fit
        With the fleet, and by its own data; None where those allow no fit.
    began : FleetPrediction
        Where the first began.
    """
    with_it, without = (
        one and one.details["expected_over_noise"] * one.calibration.noise.sensor for one in (found, single)
    )
    departure = found.details.get("widths_nT", {}).get(DEPARTURE, 1.0)
    facts = {
        "vehicle": began.vehicle, "deployments": began.own, "deployments_of_others": began.others,
        "expected_nT": with_it, "expected_alone_nT": without, "departure": departure,
    }  # fmt: skip
    otherwise = f"instead of {without:.1f}" if without is not None else "where these runs alone allow no fit"
    past = f"{counted(began.own, 'deployment')} of {began.vehicle} and {began.others} of its fleet"
    lines = [f"{past}: expect {with_it:.1f} nT of error {otherwise}"]
    if departure > UNLIKE:
        lines.append(
            f"{began.vehicle} differs from its past by {departure:.1f} times the expected: another "
            "vehicle, or something on it has changed"
        )
    return facts, lines
