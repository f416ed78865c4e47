"""Test the rules of the estimate: what a start resets, the number of hypotheses, the search width."""

from math import atan2, cos, degrees, log, radians, sin, sqrt

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation
from voyages import OUTSIDE, PLACE, Map, blocks, misled, sail, track_over

from magbridge.calibration.model import rotation_matrix
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.attitude import AttitudeFilter, rotation
from magbridge.navigate.deadreckoning import DeadReckoning
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


@pytest.mark.parametrize(("sigmas", "jumps"), [(2.0, 0), (20.0, 1)])
def test_a_fix_restarts_the_filter_only_beyond_its_own_sigma(
    grid: AnomalyGrid,
    options: NavigationOptions,
    measured: list[tuple[Block, float]],
    sigmas: float,
    jumps: int,
) -> None:
    estimate = begun(grid, options, measured[0][0], 5.0)
    estimate.update(*measured[0])
    estimate.correct(estimate.x[:2] + np.array([sigmas * 100.0, 0.0]), 100.0)
    assert len(estimate.jumps) == jumps


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


# ---- Integrity: what the filter claims ---------------------------------------------------------------------


PERIOD = 700.0


@pytest.fixture(scope="module")
def alike() -> AnomalyGrid:
    """Return a map on which every place has a twin 700 m away, which no measurement can distinguish."""
    per_latitude, per_longitude = metres_per_degree(PLACE[0])
    metres = np.arange(-6_000.0, 6_001.0, 50.0)
    waves = np.cos(2.0 * np.pi * metres / PERIOD)
    places = PLACE[1] + metres / per_longitude, PLACE[0] + metres / per_latitude
    return AnomalyGrid(*places, 40.0 * (waves[:, None] + waves[None, :]))


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


# ---- Attitude from rates and the field's direction while the autopilot's is wrong; gaps in telemetry -------


MAIN = np.array([18_000.0, -5_000.0, 48_000.0])


def flown(*, wrong: bool) -> tuple[float, float, float]:
    """Return errors (deg) of the filter's and the autopilot's heading after two minutes, and the sigma (deg).

    The aircraft turns left and right. From 60 s on, the autopilot's bias and attitude are wrong if `wrong`.
    """
    rng = np.random.default_rng(4)
    attitude, filter_ = np.eye(3), AttitudeFilter()
    for tick in range(1200):
        time = 0.1 * tick
        rates = np.array([0.2 * sin(time), 0.1 * cos(0.7 * time), 0.15 * sin(0.2 * time)])
        attitude = attitude @ rotation_matrix(rates * 0.1)
        bad = wrong and time > 60.0
        bias = radians(3.0) * np.array([1.0, -1.0, 2.0]) if bad else np.zeros(3)
        tilt = rotation(radians(15.0), radians(-10.0), radians(40.0)) if bad else np.eye(3)
        claimed = tilt @ attitude
        yaw, pitch, roll = Rotation.from_matrix(claimed).as_euler("ZYX")
        angles = roll, pitch, yaw
        later = rates + np.array([0.2 * cos(time), -0.07 * sin(0.7 * time), 0.03 * cos(0.2 * time)]) * 0.05
        filter_.rotate(time, time, angles, later + bias, vouched=not bad)
        filter_.gyro(time + 0.05, later)
        filter_.direct(time, attitude.T @ MAIN + rng.normal(0.0, 100.0, 3), MAIN)
    true = atan2(attitude[1, 0], attitude[0, 0])
    own, autopilot = ((degrees(yaw - true) + 180.0) % 360.0 - 180.0 for yaw in (filter_.heading, angles[2]))
    assert filter_.agrees is not wrong
    return own, autopilot, degrees(filter_.heading_sigma)


def test_the_heading_holds_while_the_autopilot_is_wrong() -> None:
    own, autopilot, sigma = flown(wrong=True)
    assert abs(autopilot) > 25.0
    assert abs(own) < min(6.0, 3.0 * sigma)


def test_the_autopilot_is_used_while_it_is_right() -> None:
    own, autopilot, _ = flown(wrong=False)
    assert abs(autopilot) < 0.1
    assert abs(own) < 3.0


@pytest.mark.parametrize("reports", [1, 5])
def test_a_turn_during_a_gap_is_uncertain_by_the_speed_times_the_gap(reports: int) -> None:
    """Reports that have waited arrive at once; their changes belong to the gap."""
    where = DeadReckoning()
    where.telemetry(0.0, {"heading": 0.0, "speed": 20.0})
    where.telemetry(1.0, {"heading": 0.0, "speed": 20.0})
    for number in range(1, reports + 1):
        where.telemetry(6.0 + 0.01 * number, {"heading": 90.0 * number / reports, "speed": 20.0})
    noise = where.noise
    # the velocity changes by 20 sqrt(2) m/s at an unknown moment of 5 s
    assert sqrt(noise.nn + noise.ee) >= 0.95 * 20.0 * sqrt(2.0) * 5.0 / sqrt(12.0)
    assert sqrt(noise.nn + noise.ee) < 20.0 * 5.0
