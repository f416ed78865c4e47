"""An error of the map, as the search describes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from magbridge.diagnose.causes.reference import map_error
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.joint import fit_joint


def test_what_a_map_as_flown_lacks_grows_with_depth(right: Callable[[int], Problem]) -> None:
    """A line there and back at other depths: without them, one place has two errors."""
    n, k, flown = 1500, 2.0 * np.pi / 1600.0, -90.0
    north = 2000.0 * (1.0 - np.abs(np.linspace(-1.0, 1.0, n)))
    down = 75.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(n) / 170.0))
    missing = 60.0 * (np.exp(k * (down - 150.0)) - np.exp(k * (flown - 150.0))) * np.sin(k * north)
    whole = right(n)
    whole = replace(whole, residual=whole.residual + missing)
    place = np.stack([north, np.zeros(n), down], axis=1)
    left = []
    for known in (place, place[:, :2]):
        problem = replace(whole, survey=replace(whole.survey, place=known))
        (chart,) = map_error(problem)
        fit = fit_joint(problem, [chart.columns], 1, spectra=[chart.spectra])
        left.append(float(np.std(fit.left)))
        assert chart.shapeless
    assert left[0] < 0.1 * np.std(missing) < 0.2 * np.std(missing) < left[1], left
