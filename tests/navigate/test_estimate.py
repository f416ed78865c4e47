"""Test the rules of the estimate: what a start resets, the number of hypotheses, the search width."""

from __future__ import annotations

from math import log, sqrt

import numpy as np
import pytest
from voyages import blocks, track_over

from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.estimate import Estimate
from magbridge.navigate.model import Block
from magbridge.navigate.options import NavigationOptions, with_level
from magbridge.navigate.record import NavigationState, Rival

HOUR_US = 3_600_000_000


def begun(grid: AnomalyGrid, options: NavigationOptions, first: Block, sigma: float) -> Estimate:
    estimate = Estimate(grid, options)
    estimate.start(first.time_us - 1, sigma)
    return estimate


@pytest.fixture(scope="module")
def measured(grid: AnomalyGrid, options: NavigationOptions) -> list[tuple[Block, float]]:
    return list(blocks(track_over(grid, options, 3, hours=1.0), grid, options))


def test_a_start_forgets_what_dead_reckoning_had_gathered(
    grid: AnomalyGrid, options: NavigationOptions, measured: list[tuple[Block, float]]
) -> None:
    first = measured[0][0]
    fresh = begun(grid, options, first, 30.0)
    late = Estimate(grid, options)
    late.start(first.time_us - 24 * HOUR_US, 30.0)
    late.predict(first.time_us - 1, 0.0)
    assert late.P[0, 0] > 100.0 * fresh.P[0, 0]
    late.start(first.time_us - 1, 30.0)
    for block, metres in measured[:40]:
        for one in (fresh, late):
            one.update(block, metres)
        assert late.state is fresh.state
    np.testing.assert_array_equal(late.P, fresh.P)
    for one in (fresh, late):
        one.correct(one.x[:2] + 1e4, 30.0)
    assert late.jumps[-1] == fresh.jumps[-1], "and so is what dead reckoning alone is allowed"
    assert fresh.jumps[-1].allowed < 100.0


@pytest.mark.parametrize("sigma", [5.0, 2_000.0])
def test_a_wide_start_has_many_hypotheses_and_a_narrow_one_has_one(
    grid: AnomalyGrid, options: NavigationOptions, measured: list[tuple[Block, float]], sigma: float
) -> None:
    estimate = begun(grid, options, measured[0][0], sigma)
    block, metres = measured[0]
    there = grid.look_up(block.longitude, block.latitude, block.depth).anomaly
    seen = estimate.update(block._replace(anomaly=there), metres)
    assert (estimate.hypotheses > 100) == (sigma > 1_000.0)
    assert (estimate.hypotheses == 1) == (sigma < 1_000.0)
    assert seen.accepted
    block, metres = measured[1]
    assert not estimate.update(block._replace(anomaly=block.anomaly + 1e4), metres).accepted


def test_other_places_have_the_level_that_was_met_where_the_position_was_known(
    grid: AnomalyGrid, options: NavigationOptions, measured: list[tuple[Block, float]]
) -> None:
    """A level known to 145 nT fits many places; met at a known start, it is the same at all of them."""
    levels = {}
    for sigma in (20.0, 2_000.0):
        estimate = begun(grid, with_level(options, 145.0), measured[0][0], sigma)
        for block, metres in measured:
            estimate.update(block, metres)
        levels[sigma] = estimate._levels()[0]
    assert levels[20.0] < 20.0
    assert levels[2_000.0] == pytest.approx(145.0, abs=0.1)


def test_a_search_begins_where_dead_reckoning_since_the_last_fix_is(
    grid: AnomalyGrid, options: NavigationOptions, measured: list[tuple[Block, float]]
) -> None:
    """A fix has shown that dead reckoning is 500 m off; then the field contradicts the map."""
    estimate = begun(grid, options, measured[0][0], 300.0)
    estimate.update(*measured[0])
    fix = np.array([400.0, -300.0])
    estimate.correct(fix, 10.0)
    for block, travelled in measured[1:]:
        estimate.update(block._replace(anomaly=-3.0 * block.anomaly), travelled)
        if estimate.state is NavigationState.LOST:
            break
    assert estimate.jumps[-1].cause == "the map does not explain the field"
    assert np.linalg.norm(estimate.x[:2] - fix) < 3.0 * sqrt(estimate.alone[0, 0])


@pytest.mark.parametrize("share", [0.1, 0.6])
def test_another_position_widens_the_covariance_and_one_that_is_likelier_means_lost(
    grid: AnomalyGrid, options: NavigationOptions, measured: list[tuple[Block, float]], share: float
) -> None:
    estimate = begun(grid, options, measured[0][0], options.start_sigma)
    for block, metres in measured[:40]:
        estimate.update(block, metres)
    estimate.correct(estimate.x[:2], options.start_sigma)
    P = estimate.P[0, 0]
    estimate.rivals = [Rival(np.add(estimate.x[:2], (3e3, 0.0)), 9.0 * np.eye(2), log(share / (1.0 - share)))]
    widened = estimate.position_covariance[0, 0]
    assert widened == pytest.approx((1.0 - share) * P + share * (9.0 + 3000.0**2))
    estimate.update(*measured[40])
    assert (estimate.state is NavigationState.LOST) == (share > 0.5)
