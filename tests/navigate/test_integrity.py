"""Test when a position is valid: only if the field can distinguish places, and agrees with it."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from voyages import OUTSIDE, PLACE, Map, misled, sail, track_over

from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.model import transition
from magbridge.navigate.options import NavigationOptions, wider_level
from magbridge.navigate.record import NavigationState

PERIOD = 700.0


@pytest.fixture(scope="module")
def alike() -> AnomalyGrid:
    """Return a map on which every place has a twin 700 m away, which no measurement can distinguish."""
    per_latitude, per_longitude = metres_per_degree(PLACE[0])
    metres = np.arange(-6_000.0, 6_001.0, 50.0)
    waves = np.cos(2.0 * np.pi * metres / PERIOD)
    return AnomalyGrid(
        PLACE[1] + metres / per_longitude,
        PLACE[0] + metres / per_latitude,
        40.0 * (waves[:, None] + waves[None, :]),
    )


def test_indistinguishable_places_are_never_valid(alike: AnomalyGrid, options: NavigationOptions) -> None:
    """The filter tracks, and is right, but has only its claim to know in which of the twins it is."""
    claimed = replace(options, start_sigma=40.0)
    run = sail(track_over(alike, claimed, 3, hours=2.0), alike, claimed)
    assert np.median(run.error) < 100.0
    assert not run.valid.any()


def test_a_start_as_wide_as_its_rivals_needs_none(grid: AnomalyGrid, options: NavigationOptions) -> None:
    """What narrows it down is then the field alone: it is valid as soon as one place is left."""
    wide = replace(options, start_sigma=1500.0)
    run = sail(track_over(grid, wide, 4, hours=3.0), grid, wide)
    tracking = run.state == NavigationState.TRACKING
    assert run.valid.any()
    assert run.valid.sum() > 0.9 * tracking.sum()
    assert not (run.valid & (run.nees > OUTSIDE)).any()


@pytest.mark.parametrize("level", [60.0, -60.0])
def test_a_calibration_that_is_off_is_not_answered_by_another_place(
    grid: AnomalyGrid, options: NavigationOptions, level: float
) -> None:
    """60 nT where 1 nT is claimed: lost at once, and the level found with the place, not instead of it."""
    ds = track_over(grid, options, 11, hours=3.0)
    run = sail(ds.assign(total_field=ds["total_field"] + level), grid, options)
    assert NavigationState.LOST in run.state
    assert not (run.valid & (run.nees > OUTSIDE)).any()


def test_a_misled_filter_does_not_stand_by_it() -> None:
    hours_valid, hours_lost = misled(Map(30, 1500), 6)
    assert hours_lost > 0.0
    assert hours_valid < 0.5


def test_a_level_that_may_be_any_wanders_no_faster(grid: AnomalyGrid, options: NavigationOptions) -> None:
    loose = wider_level(options, grid.rms)
    assert loose.bias_sigma == grid.rms
    assert wider_level(loose, grid.rms) == loose
    wander = [transition(o, 20.0, 7.0)[1][4, 4] for o in (options, loose)]
    assert wander[1] == pytest.approx(wander[0], rel=0.01)
