"""Test that the navigator finds the vehicle or reports that it has not, and that replays are equal."""

import numpy as np
import pytest
import xarray as xr
from msgspec.structs import replace
from voyages import PLACE, Map, carried, sail, synthetic, track_over

from magbridge.field.geodesy import offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate import NavigationOptions, NavigationState, Navigator, Record
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.records import Corrected, Quality

START_US = 1_386_201_600_000_000

Followed = tuple[list[Record], np.ndarray]


def feed(navigator: Navigator, ds: xr.Dataset, rows: slice = slice(None)) -> Followed:
    """Run a track through the navigator; return records and errors (m)."""
    records, errors = [], []
    time_us = np.round(ds["time"].to_numpy()[rows] * 1e6).astype(int).tolist()
    names = ("velocity_north", "velocity_east", "total_field", "away_north", "away_east")
    v_north, v_east, field, north, east = (ds[name].to_numpy()[rows].tolist() for name in names)
    for i, t in enumerate(time_us):
        navigator.telemetry(t - 4_000_000, velocity_north=v_north[i], velocity_east=v_east[i], depth=30.0)
        record = navigator.measure(t, field[i], 1.0)
        if record is not None:
            records.append(record)
            errors.append(np.hypot(record.north - north[i], record.east - east[i]))
    return records, np.array(errors)


@pytest.fixture(scope="module")
def ds(grid: AnomalyGrid, options: NavigationOptions) -> xr.Dataset:
    return track_over(grid, options, 11, hours=3.0)


@pytest.fixture(scope="module")
def followed(grid: AnomalyGrid, options: NavigationOptions, ds: xr.Dataset) -> Followed:
    return feed(_fresh(grid, options), ds)


def test_it_holds_the_position(
    grid: AnomalyGrid, options: NavigationOptions, ds: xr.Dataset, followed: Followed
) -> None:
    records, error = followed
    score = sail(ds, grid, options).score()
    assert score["drms"] < 2.0 * score["bound"]  # one track: errors follow each other
    assert score["drms"] < 0.5 * score["unaided"]
    assert sum(r.state is NavigationState.TRACKING for r in records) > 0.7 * len(records)
    sigma = np.array([np.sqrt(r.covariance_nn + r.covariance_ee) for r in records])
    assert np.mean(error < 3 * sigma) > 0.95
    z = np.array([r.innovation**2 / r.innovation_variance for r in records])
    assert 0.7 < z.mean() < 1.3


def _fresh(grid: AnomalyGrid, options: NavigationOptions) -> Navigator:
    navigator = Navigator(grid, options)
    navigator.fix(START_US, *PLACE)
    return navigator


def test_a_wide_start_is_found(grid: AnomalyGrid, options: NavigationOptions) -> None:
    wide = replace(options, start_sigma=1500.0)
    run = sail(track_over(grid, wide, 4, hours=4.0), grid, wide)
    assert run.error[0] > 300.0
    assert run.score()["drms"] < 200.0
    assert run.state[0] == NavigationState.SEARCHING or run.state[0] == NavigationState.DEAD_RECKONING
    assert run.state[-1] == NavigationState.TRACKING
    assert NavigationState.LOST not in run.state


def test_a_known_position_that_has_become_vague_is_lost(
    grid: AnomalyGrid, options: NavigationOptions, ds: xr.Dataset
) -> None:
    """After the map has confirmed the position, samples become useless: the sigma grows past the limit."""
    names = ("velocity_north", "velocity_east", "total_field")
    time_us = np.round(ds["time"].to_numpy() * 1e6).astype(int)
    rows = list(zip(time_us.tolist(), *(ds[name].to_numpy().tolist() for name in names), strict=True))
    lost = {}
    for limit in (200.0, 500.0):
        navigator = _fresh(grid, replace(options, sigma_limit=limit))
        feed(navigator, ds, slice(0, len(rows) // 2))
        seen = []
        for t, north, east, field in rows[len(rows) // 2 :]:
            navigator.telemetry(t - 4_000_000, velocity_north=north, velocity_east=east, depth=30.0)
            if (record := navigator.measure(t, field, 300.0)) is not None:
                ne = record.covariance_ne
                P = [[record.covariance_nn, ne], [ne, record.covariance_ee]]
                seen.append((float(np.linalg.eigvalsh(P)[1]) ** 0.5, record.state))
        assert max(sigma for sigma, _ in seen) > 300.0
        lost[limit] = [sigma for sigma, state in seen if state is NavigationState.LOST]
    assert min(lost[200.0]) > 200.0
    assert max(lost[200.0]) > 300.0
    assert not lost[500.0]


def test_carried_off_it_says_that_it_is_lost_and_finds_itself_again() -> None:
    hours_valid, hours_lost = carried(Map(30, 1500), 3)
    assert 0.0 < hours_lost < 2.0
    assert hours_valid < 0.5


def test_samples_that_cannot_be_used(grid: AnomalyGrid, options: NavigationOptions) -> None:
    nav = _fresh(grid, options)
    nav.telemetry(START_US, heading=0.0, speed=0.35)
    bad = Corrected(9e4, 1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), int(Quality.SATURATED))
    nan = Corrected(np.nan, 1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0)
    for k in range(1, 20):
        assert nav.sample(START_US + k * 4_000_000, bad) is None
        assert nav.sample(START_US + k * 4_000_000, nan) is None
    assert nav.finish() is None
    nav.measure(START_US + 100_000_000, 52_300.0, 1.0)
    nav.measure(START_US + 96_000_000, 52_300.0, 1.0)
    assert nav.dropped == 1


def test_samples_from_before_a_fix_keep_the_covariance_positive(
    grid: AnomalyGrid, options: NavigationOptions
) -> None:
    """A sensor hands over what it has stored, or its clock stands still, while GPS positions come."""
    nav = _fresh(grid, options)
    nav.telemetry(START_US, heading=0.0, speed=0.35)
    for k in range(1, 40):
        nav.measure(START_US + k * 4_000_000, 52_300.0, 1.0)
    later_us = START_US + 3_600_000_000
    nav.gnss_position(later_us, float(grid.latitude.mean()), float(grid.longitude.mean()), 5.0)
    for k in range(40, 60):
        assert nav.measure(START_US + k * 4_000_000, 52_300.0, 1.0) is None
    assert nav.dropped == 20
    for k in range(20):
        nav.gnss_position(later_us + k * 4_000_000, nav.reckoned(0)[0], nav.reckoned(0)[1], 5.0)
        nav.measure(later_us + k * 4_000_000 - 1_000_000, 52_300.0, 1.0)
        assert np.linalg.eigvalsh(nav.estimate.P)[0] > 0.0
    assert nav.dropped == 20


def test_nothing_before_a_start(grid: AnomalyGrid) -> None:
    nav = Navigator(grid)
    assert nav.estimate.state is NavigationState.OFF
    nav.telemetry(START_US, heading=0.0, speed=0.35)
    nav.fix(START_US, np.nan, 1.0)
    assert nav.measure(START_US + 4_000_000, 52_300.0, 1.0) is None
    assert nav.estimate.state is NavigationState.OFF


def test_a_fix_is_taken_in_and_a_contradiction_believed(
    grid: AnomalyGrid, options: NavigationOptions, ds: xr.Dataset
) -> None:
    nav = _fresh(grid, options)
    records, _ = feed(nav, ds, slice(0, 600))
    t = records[-1].time_us + 30_000_000
    near = offset(records[-1].latitude, records[-1].longitude, 20.0, 0.0)
    nav.fix(t, *near, 5.0)
    assert np.sqrt(nav.estimate.P[0, 0]) < 6.0
    assert not nav.estimate.jumps
    far = offset(*near, 3000.0, -2000.0)
    nav.fix(t + 1_000_000, *far, 5.0)
    assert nav.estimate.jumps[0].cause == "a fix contradicts the filter"
    assert nav.estimate.jumps[0][1:3] == pytest.approx((3000.0, -2000.0), abs=30.0)


def test_off_the_map_it_reckons(grid: AnomalyGrid, options: NavigationOptions, ds: xr.Dataset) -> None:
    small = AnomalyGrid(grid.longitude[:70], grid.latitude, grid.anomaly[:, :70])
    nav = _fresh(small, options)
    records, _ = feed(nav, ds, slice(0, 200))
    assert np.isnan(small.look_up(PLACE[1], PLACE[0]).anomaly)
    assert {r.state for r in records} <= {NavigationState.DEAD_RECKONING, NavigationState.SEARCHING}
    assert not any(r.valid for r in records)
    assert nav.estimate.P[0, 0] > options.start_sigma**2


def test_a_flat_map_says_nothing(grid: AnomalyGrid, options: NavigationOptions, ds: xr.Dataset) -> None:
    flat = AnomalyGrid(grid.longitude, grid.latitude, np.zeros_like(grid.anomaly))
    even = ds.assign(total_field=ds["total_field"] * 0 + 52_300.0)
    records, _ = feed(_fresh(flat, options), even, slice(0, 300))
    assert not any(r.valid for r in records)


def test_across_the_antimeridian(grid: AnomalyGrid, options: NavigationOptions) -> None:
    """Map and track moved to 180 degrees: only the main field differs."""
    moved = AnomalyGrid(grid.longitude - PLACE[1] + 180.0, grid.latitude, grid.anomaly)
    nav = Navigator(moved, replace(options, start_sigma=20.0))
    nav.fix(START_US, PLACE[0], 179.9999)
    records = []
    where = (PLACE[0], 179.9999)
    nav.telemetry(START_US, heading=90.0, speed=1.0, depth=0.0)
    for k in range(1, 300):
        where = offset(*where, 0.0, 4.0)
        t = START_US + 4_000_000 * k
        z = float(total_field(where[1], where[0], 0.0, t * 1e-6)[0] + moved.anomaly_at(where[1], where[0])[0])
        if record := nav.measure(t, z, 1.0):
            records.append(record)
    assert records[-1].longitude < -179.9
    assert abs(records[-1].east) < 60.0
    assert all(np.isfinite(r.map_anomaly) for r in records)


def test_the_main_field_is_that_of_the_day_to_which_the_clock_was_set(
    ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions
) -> None:
    """A computer without a clock of its own wakes up in 1970; the field there has lost 1.8 µT since."""
    innovations = []
    for offset_us in (0, START_US):
        navigator = Navigator(grid, options)
        navigator.utc_offset_us = offset_us
        navigator.fix(START_US - offset_us, *PLACE)
        moved = ds.assign_coords(time=ds["time"] - offset_us * 1e-6)
        records, _ = feed(navigator, moved, slice(0, 60))
        innovations.append([record.innovation for record in records])
    assert len(innovations[0]) > 2
    assert innovations[1] == pytest.approx(innovations[0], abs=1e-3)


def test_lost_is_not_ended_by_the_next_fix(grid: AnomalyGrid, options: NavigationOptions) -> None:
    """Over an unrelated field five times as rough, fixes give the position, but the navigator stays lost."""
    elsewhere = synthetic(Map(150, 1500), 9)
    unrelated = track_over(elsewhere, options, 5, hours=1.0)
    nav = _fresh(grid, options)
    feed(nav, unrelated, slice(0, 600))
    assert nav.estimate.state is NavigationState.LOST
    for row in range(600, 900, 10):
        time_us = round(1e6 * float(unrelated["time"][row])) - 1_000_000
        latitude, longitude = (float(unrelated[f"truth_{name}"][row]) for name in ("latitude", "longitude"))
        nav.fix(time_us, latitude, longitude, 5.0)
        more, _ = feed(nav, unrelated, slice(row, row + 10))
        assert not any(record.valid for record in more)
        assert {record.state for record in more} <= {NavigationState.LOST}


# ---- dead reckoning from each kind of telemetry, on a course whose end is known ----------------------------


START = (54.0, 15.0)


def sailed(rows: list[tuple[float, dict[str, float]]], end: float = 1000.0) -> tuple[float, float]:
    where = DeadReckoning()
    where.place(*START)
    for time, values in rows:
        where.telemetry(time, values)
    where.advance(end)
    return separation(*START, where.latitude, where.longitude)


@pytest.mark.parametrize(
    "rows",
    [
        [(0.0, {"velocity_north": 0.3, "velocity_east": 0.4})],
        [(0.0, {"speed": 0.5, "heading": np.degrees(np.arctan2(0.4, 0.3))})],
        [(t, {"north": 0.3 * t + 77.0, "east": 0.4 * t}) for t in np.arange(0.0, 1001.0, 10.0)],
        [
            (t, {"dr_latitude": 10.0 + 0.3 * t / 110608.0, "dr_longitude": 179.999 + 0.4 * t / 109639.0})
            for t in np.arange(0.0, 1001.0, 10.0)
        ],
    ],
)
def test_each_kind_of_telemetry_leads_to_the_same_place(rows: list[tuple[float, dict[str, float]]]) -> None:
    assert sailed(rows) == pytest.approx((300.0, 400.0), abs=1.0)


def test_a_glider_moves_by_its_sink_rate_and_pitch() -> None:
    """26 degrees down at 0.17 m/s of depth is 0.35 m/s along; after the turn it continues."""
    rows = []
    for t in np.arange(0.0, 1000.0, 4.0):
        depth = 0.17 * min(t, 1000 - t)
        pitch = 0.0 if 490 < t < 510 else -26.0 if t < 500 else 26.0
        rows.append((t, {"depth": depth, "pitch": pitch, "heading": 90.0}))
    north, east = sailed(rows)
    assert east == pytest.approx(0.17 / np.tan(np.radians(26.0)) * 1000, rel=0.03)
    assert north == pytest.approx(0.0, abs=1e-6)


def test_a_long_silence_is_not_sailed_through() -> None:
    where = DeadReckoning()
    where.place(*START)
    where.telemetry(0.0, {"speed": 1.0, "heading": 0.0})
    where.advance(86_400.0)
    assert where.latitude == START[0]
