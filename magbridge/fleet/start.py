"""Where a new calibration starts: what a vehicle's past and its fleet predict; and the value of that."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

from magbridge.calibration.fitting.fit import Fit
from magbridge.calibration.fitting.pose import DEPARTURE, Known
from magbridge.fleet.catalogue import open_catalogue
from magbridge.fleet.memory import fleet_of, owner
from magbridge.wording import counted

__all__ = ["UNLIKE", "FleetPrediction", "gained", "start"]

UNLIKE = 3.0
"""Times as wide as expected, from which on a deployment is not as its vehicle's past predicts."""


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
    """Return what the fleet was worth, for machines and as lines.

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
