"""How a refit moves coefficients is how a dipole's coefficients move when it is exchanged or shifted."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.pose import LATENT, MOMENT, Mounting, mass_columns
from magbridge.calibration.model import Parameter
from magbridge.fleet.learn import shape_groups, shapes_of

AT, TRAVEL = np.array([-0.5, 0.02, 0.05]), np.array([0.0254, 0.0, 0.0])
BATTPOS = Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0)
EXPONENTS = ((0,), (1,), (2,), (3,))


def coefficients(at: FloatArray, moment: FloatArray) -> FloatArray:
    """(36,) nT, of a mass with a permanent moment (nT at the sensor, from :data:`AT`) at a place."""
    numbers = np.zeros(LATENT)
    numbers[:3] = moment
    numbers[6:9] = at - AT
    return (mass_columns(AT, TRAVEL, BATTPOS, 3, numbers)[..., :6] @ numbers[:6]).ravel()


@pytest.fixture
def known() -> tuple[FloatArray, FloatArray]:
    """The vehicle's moment, and the shapes found where the mass was measured 2 cm off."""
    moment = np.array([1500.0, -800.0, 2100.0])
    where = {"battpos": Mounting(tuple(np.add(AT, [0.02, -0.01, 0.0])), tuple(TRAVEL))}
    P = np.diag(np.tile([0.1] * 6 + [1.0] * 3, 4) ** 2)
    return moment, shapes_of(where, EXPONENTS, (BATTPOS,), 50_000.0, coefficients(AT, moment), P)


def test_another_pack_moves_all_powers_together(known: tuple[FloatArray, FloatArray]) -> None:
    moment, shapes = known
    assert shapes.shape == (36, len(shape_groups(1)))
    changed = np.array([600.0, 900.0, -300.0])
    moved = coefficients(AT, moment + changed) - coefficients(AT, moment)
    foretold = shapes[:, :3] @ changed / MOMENT
    assert np.linalg.norm(foretold - moved) < 0.1 * np.linalg.norm(moved)
    first, foretold_first = moved[9:18], foretold[9:18]  # a small part of the whole, and what matters
    assert np.linalg.norm(foretold_first - first) < 0.15 * np.linalg.norm(first)


def test_a_shift_moves_them_by_the_moment_that_was_found(known: tuple[FloatArray, FloatArray]) -> None:
    moment, shapes = known
    for axis in range(3):
        shift = 0.005 * np.eye(3)[axis]
        moved = coefficients(AT + shift, moment) - coefficients(AT, moment)
        foretold = shapes[:, 6 + axis] * 0.005 / 0.05
        assert np.linalg.norm(foretold - moved) < 0.15 * np.linalg.norm(moved)
