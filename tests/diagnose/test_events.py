"""What has a moment: a step of the offsets, and a source that passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.causes.masses import actuator_order, hysteresis
from magbridge.diagnose.compare.columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.descriptions import Description
from magbridge.diagnose.inference.events import MOMENTS, passage, step
from magbridge.diagnose.inference.joint import fit_joint


def with_(problem: Problem, planted: NDArray[np.float64]) -> Problem:
    noise = np.random.default_rng(5).normal(size=len(problem))
    return replace(problem, residual=planted + noise)


def explained(columns: Columns, planted: NDArray[np.float64]) -> float:
    X = columns(slice(None))
    left = planted - X @ np.linalg.lstsq(X, planted, rcond=None)[0]
    return 1.0 - float(left @ left) / float(planted @ planted)


def test_a_step_is_found_at_the_nearest_moment(problem: Problem) -> None:
    onset = int(0.37 * len(problem))
    after = np.arange(len(problem)) >= onset
    given = with_(problem, (-problem.slopes[:, 6:] @ [3.0, -2.0, 4.0]) * after)
    columns, trials = step(given, fit_joint(given, [], 1))
    found = int(np.argmax(np.abs(columns(slice(None))).sum(axis=1) > 0.0))
    assert abs(found - onset) <= len(problem) / MOMENTS
    assert trials == MOMENTS


def test_a_dipole_that_passes_is_told_by_three_numbers(problem: Problem) -> None:
    """Against a dipole's field on a straight course, along the Earth's: Anderson's functions hold it."""
    t = problem.survey.time - problem.survey.time[0]
    speed, nearest = 900.0 / (0.02 * t[-1]), 0.6 * t[-1]
    r = np.column_stack([speed * (t - nearest), np.full(len(t), 900.0), np.full(len(t), -50.0)])
    far = np.linalg.norm(r, axis=1)[:, None]
    m, earth = np.array([0.3, -0.8, 0.5]), np.array([0.5, 0.1, 0.85])
    field = (3.0 * r * (r @ m)[:, None] / far**2 - m) / far**3
    planted = problem.gain * (field @ earth)
    planted *= 6.0 / np.abs(planted).max()
    given = with_(problem, planted)
    columns, trials = passage(given, fit_joint(given, [], 1))
    assert explained(columns, planted) > 0.9
    assert 100 < trials < 10 * len(problem)


def test_a_curve_through_a_mass_position_covers_its_order_and_its_memory_the_hysteresis(
    problem: Problem, listed: list[Description]
) -> None:
    order = actuator_order(problem)[0]
    back = next(one for one in hysteresis(problem) if one.channel == "battpos")
    curve, memory, *late = (one for one in listed if one.channel == "battpos")
    assert (curve.covers([order]), curve.covers([back])) == (True, False)
    assert (memory.covers([order]), memory.covers([back])) == (False, True)
    assert not any(one.covers([order]) or one.covers([back]) for one in late)


def test_every_description_has_as_many_columns_as_widths(listed: list[Description]) -> None:
    for one in listed:
        columns = one.columns(slice(0, 50))
        assert np.isfinite(columns).all()
        assert {columns.shape[1]} == {len(width) for _, width in one.widths}
