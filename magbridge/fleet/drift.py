r"""What changed on a vehicle, and when.

Each deployment is compared with what its vehicle's earlier ones, and the fleet, predict: a Gaussian
:math:`N(m, S)` that is wider where the vehicle was refitted. With its own data the coefficients move to
:math:`N(m', P)`, and under the model the move has the covariance

.. math:: \mathrm{Cov}(m' - m) = S - P,

so each coefficient's move over its own sigma is a standard normal number, whatever the runs determine. A
change is reported where one exceeds :data:`ALARM` for as many coefficients as are looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.stats import norm

from magbridge.arrays import FloatArray
from magbridge.fleet.learn import Fleet, Lesson

__all__ = ["ALARM", "Change", "History", "facts", "history"]

FIXED = "hard iron"
ALARM = 1e-3
"""Chance of a false alarm in a deployment, over all its coefficients."""


@dataclass(frozen=True)
class Change:
    """One coefficient that left its band."""

    what: str
    """As a technician would say it."""
    by: float
    """Change of the coefficient, nT."""
    sigmas: float
    """Change divided by its standard deviation."""
    chance: float
    """Of one as large in any coefficient of a deployment like the others."""
    cause: str
    """What does such a thing, and whether a refit was on record."""


@dataclass(frozen=True, eq=False)
class History:
    """A vehicle's coefficients from deployment to deployment."""

    names: tuple[str, ...]
    """The k quantities: hard iron, and what each mass changes over half its range."""
    lessons: tuple[Lesson, ...]
    """In the order of time."""
    expected: FloatArray
    expected_sigma: FloatArray
    """`expected`, `expected_sigma`, (n, k), nT, from the earlier value."""
    found: FloatArray
    found_sigma: FloatArray
    """`found`, `found_sigma`, (n, k), nT, with its own data."""
    changes: tuple[tuple[Change, ...], ...]
    """Of each deployment."""


def history(fleet: Fleet, vehicle: str) -> History:
    """Return the history of a vehicle's coefficients, and where they left their bands."""
    mine = tuple(one for one in fleet.lessons if one.vehicle == vehicle)
    names, places = _looked_at(fleet)
    rows: list[tuple[FloatArray, ...]] = []
    changes: list[tuple[Change, ...]] = []
    for lesson in mine:
        before = fleet.known(vehicle, lesson.refit, lesson.time)
        evidence = lesson.brought(fleet.parameters, np.eye(len(fleet.basis)))
        S = before.covariance
        gain = np.linalg.solve(np.eye(len(S)) + S @ evidence.precision, S)  # (S^-1 + J)^-1
        P = 0.5 * (gain + gain.T)
        after = P @ evidence.vector + np.linalg.solve(np.eye(len(S)) + S @ evidence.precision, before.mean)
        moved = np.maximum(np.diag(S) - np.diag(P), 0.0)[places]
        rows.append(
            (before.mean[places], np.sqrt(np.diag(S))[places], after[places], np.sqrt(np.diag(P))[places])
        )
        if len(rows) == 1:  # it has no past
            changes.append(())
            continue
        refitted = lesson.refit not in {one.refit for one in mine[: len(rows) - 1]}
        changes.append(
            tuple(_significant_changes(names, (after - before.mean)[places], np.sqrt(moved), refitted))
        )
    expected, sigma, found, left = np.array(rows).reshape(len(mine), 4, len(places)).swapaxes(0, 1)
    return History(names, mine, expected, sigma, found, left, tuple(changes))


def facts(history: History) -> dict[str, Any]:
    """Return a history as a dictionary that JSON can hold; nT."""
    columns = history.expected, history.expected_sigma, history.found, history.found_sigma
    keys = "expected_nT", "expected_sigma_nT", "found_nT", "found_sigma_nT"
    return {
        "coefficients": list(history.names),
        "deployments": [
            {
                "deployment": lesson.deployment, "refit": lesson.refit,
                "date": datetime.fromtimestamp(lesson.time, UTC).date().isoformat(),
                **{key: column[k].tolist() for key, column in zip(keys, columns, strict=True)},
                "changes": [
                    {
                        "what": one.what, "by_nT": one.by, "sigmas": one.sigmas, "chance": one.chance,
                        "cause": one.cause,
                    }
                    for one in history.changes[k]
                ],
            }
            for k, lesson in enumerate(history.lessons)
        ],
    }  # fmt: skip


def _significant_changes(
    names: tuple[str, ...], moves: FloatArray, sigmas: FloatArray, refitted: bool
) -> list[Change]:
    """Return the moves (k,) beyond their sigmas (k,), the farthest first."""
    found = []
    for name, move, sigma in zip(names, moves, sigmas, strict=True):
        z = abs(move) / max(sigma, 1e-12)
        chance = min(2.0 * float(norm.sf(z)) * len(names), 1.0)
        if chance < ALARM:
            found.append(Change(name, float(move), float(z), chance, _cause(name, refitted)))
    return sorted(found, key=lambda one: -one.sigmas)


def _cause(name: str, refitted: bool) -> str:
    """Return the likely cause, for a technician."""
    mass, _, _ = name.rpartition(",")
    what = (
        "iron that was magnetised, fitted or removed"
        if mass == FIXED
        else f"another pack, moment or place of what {mass} moves"
    )
    return f"{what}, {'more than refits do' if refitted else 'and no refit is on record'}"


def _looked_at(fleet: Fleet) -> tuple[tuple[str, ...], list[int]]:
    """Return names and places among the coefficients of those that a technician can do something about."""
    names, places = [], []
    for m, powers in enumerate(fleet.exponents):
        if sum(powers) > 1:
            continue
        mass = next((one.name for one, power in zip(fleet.parameters, powers, strict=True) if power), "")
        for k, axis in enumerate("xyz"):
            names.append(f"{mass or FIXED}, {axis}")
            places.append(9 * m + 6 + k)
    return tuple(names), places
