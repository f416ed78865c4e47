"""A source that passes is described by few numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from posed import missed

from magbridge.diagnose.joint import fit_joint
from magbridge.diagnose.packets import passage
from magbridge.diagnose.problem import Problem


def test_a_dipole_that_passes_is_reported_by_three_numbers(problem: Problem) -> None:
    """Against a dipole's field on a straight course, along the Earth's: Anderson's functions hold it."""
    t = problem.survey.time - problem.survey.time[0]
    speed, nearest = 900.0 / (0.02 * t[-1]), 0.6 * t[-1]
    r = np.column_stack([speed * (t - nearest), np.full(len(t), 900.0), np.full(len(t), -50.0)])
    far = np.linalg.norm(r, axis=1)[:, None]
    m, earth = np.array([0.3, -0.8, 0.5]), np.array([0.5, 0.1, 0.85])
    field = (3.0 * r * (r @ m)[:, None] / far**2 - m) / far**3
    planted = problem.reference_jacobian * (field @ earth)
    planted *= 6.0 / np.abs(planted).max()
    noise = np.random.default_rng(5).normal(size=len(problem))
    given = replace(problem, residual=planted + noise)
    columns, look_elsewhere = passage(given, fit_joint(given, [], 1))
    assert missed(planted, columns(slice(None))) < 0.1
    assert 100 < look_elsewhere < 10 * len(problem)
