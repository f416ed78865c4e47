"""Test the posterior Cramér-Rao bound in cases with a closed form."""

from dataclasses import replace as changed
from math import hypot

import numpy as np
import pytest
import xarray as xr
from msgspec.structs import replace
from voyages import GLIDER, Map, dived, sail, synthetic, track_over

from magbridge.calibration.model import Noise, Reference, identity
from magbridge.cli.navigate import _continued
from magbridge.errors import OutOfRange
from magbridge.field.continuation import continued, smoothed
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate import NavigationOptions, position_bound
from magbridge.navigate.bound import as_dataset
from magbridge.navigate.options import at_depth, informed, lasting_errors

TRACK = ([1.4e9, 1.4e9 + 7200, 1.4e9 + 14400], [49.48, 49.5, 49.5], [-57.95, -57.9, -57.85])
STILL = NavigationOptions(start_sigma=100.0, current_sigma=1e-9, drift=1e-9, bias_sigma=1e-9, map_sigma=1e-9)


def slope(grid: AnomalyGrid, per_degree: float) -> AnomalyGrid:
    x, _ = np.meshgrid(grid.longitude, grid.latitude)
    return AnomalyGrid(grid.longitude, grid.latitude, (x + 57.9) * per_degree)


def test_on_a_plane_it_is_the_line_fit(grid: AnomalyGrid) -> None:
    """Along a slope g, N samples of sigma: 1/var = 1/start² + N g²/sigma²; across it stays at its start.

    The main field's own slope, 4 nT/km, adds to the plane's 100 nT/km: 6 %.
    """
    g = 0.1
    bound = position_bound(slope(grid, g * 72_400.0), *TRACK, STILL, sigma=5.0, every=4.0)
    along, across = np.sqrt(np.linalg.eigvalsh(bound.covariance[-1, :2, :2]))
    expected = 1 / np.sqrt(1 / 100.0**2 + 3600 * g**2 / 25.0)
    assert along == pytest.approx(expected, rel=0.06)
    assert across == pytest.approx(100.0, rel=0.01)


def test_off_the_map_it_is_dead_reckoning(grid: AnomalyGrid, options: NavigationOptions) -> None:
    moved = AnomalyGrid(grid.longitude + 10.0, grid.latitude, grid.anomaly)
    bound = position_bound(moved, *TRACK, options)
    np.testing.assert_allclose(bound.sigma, bound.unaided)


@pytest.mark.parametrize("way", [1, -1], ids=["east", "west"])
def test_across_the_date_line(grid: AnomalyGrid, options: NavigationOptions, way: int) -> None:
    """The bound equals that of any other place, except for the main field."""
    turn = 180.0 - 57.9
    there = AnomalyGrid(grid.longitude - turn, grid.latitude, grid.anomaly)
    time, latitude, longitude = TRACK[0], TRACK[1][::way], TRACK[2][::way]
    crossing = [(degrees - turn + 180.0) % 360.0 - 180.0 for degrees in longitude]
    bound = position_bound(there, time, latitude, crossing, options)
    assert np.ptp(bound.longitude) > 359.0
    assert (np.abs(bound.longitude) <= 180.0).all()
    expected = position_bound(grid, time, latitude, longitude, options)
    assert bound.sigma[-1] == pytest.approx(expected.sigma[-1], rel=0.15)


def test_time_must_increase(grid: AnomalyGrid) -> None:
    with pytest.raises(OutOfRange, match="must increase"):
        position_bound(grid, TRACK[0][::-1], *TRACK[1:])
    with pytest.raises(OutOfRange, match="track = 1 positions: at least two are needed"):
        position_bound(grid, [1.4e9], [49.48], [-57.95])
    with pytest.raises(OutOfRange, match=r"track = 3 s: at least \d+ s are needed"):
        position_bound(grid, [0.0, 3.0], [49.48] * 2, [-57.95] * 2)


def test_its_sentence_says_when_it_is_best(grid: AnomalyGrid, options: NavigationOptions) -> None:
    bound = position_bound(grid, *TRACK, options)
    for sigma, words in (
        (np.linspace(50.0, 90.0, bound.time.size), "at best 50 m at the start, at the end 90 m"),
        (np.linspace(90.0, 50.0, bound.time.size), f"at best 50 m after {np.ptp(bound.time) / 3600.0:.1f} h"),
    ):
        assert as_dataset(bound._replace(sigma=sigma), grid).attrs["findings"].startswith(words)


def test_more_samples_allow_a_smaller_error(grid: AnomalyGrid, options: NavigationOptions) -> None:
    """Twenty times as many of the same noise: a filter at 5 Hz must not beat the bound that was printed."""
    slow, fast = (position_bound(grid, *TRACK, options, 50.0, every=every).sigma[-1] for every in (4.0, 0.2))
    assert fast < 0.8 * slow


# ---- Errors of map and level, and navigation on a map above a diving vehicle -------------------------------


def test_errors_of_the_map_add_up() -> None:
    drawn = synthetic(Map(30, 1500), 3)
    flown = AnomalyGrid(drawn.longitude, drawn.latitude, drawn.anomaly, altitude=90.0)
    depth, options = (
        np.append(np.linspace(0.0, 120.0, 50), np.nan),
        NavigationOptions(map_sigma=1.5, map_length=800.0),
    )
    there, known = at_depth(flown, options, depth)
    left = continued(flown, depth[:-1])
    assert there.altitude == pytest.approx(-60.0)
    at_edges = float(np.median(left.grid.sigma))
    assert 0.0 < at_edges < left.sigma
    assert known.map_sigma == pytest.approx(hypot(1.5, left.sigma, at_edges))
    assert min(left.length, 800.0) < known.map_length < max(left.length, 800.0)
    assert at_depth(drawn, options, depth) == (drawn, options), "an unknown altitude"


@pytest.mark.parametrize(
    ("depth", "texts"), [(60.0, "60 m below the surface"), (-60.0, "60 m above the surface")]
)
def test_a_level_is_reported_on_its_side_of_the_surface(
    depth: float, texts: str, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = synthetic(Map(30, 1500), 3)
    flown = AnomalyGrid(drawn.longitude, drawn.latitude, drawn.anomaly, altitude=90.0)
    _continued(flown, NavigationOptions(), xr.Dataset({"depth": ("time", [depth] * 9)}))
    assert f"continued to {texts}" in capsys.readouterr().err


def test_a_glider_that_dives_under_it_is_found() -> None:
    """Taken for the field below it, the map leads the filter away; continued to the depth, it does not."""
    flown, below = dived(2)
    assert below["error"] < 0.2 * flown["error"]
    assert below["nees"] < 2.0
    assert below["valid"] > 0.5


def test_what_lies_between_nodes_counts_as_map_error() -> None:
    """Sources at the depth of the node spacing: some nT between the nodes, over half their distance."""
    rng, n = np.random.default_rng(7), 60
    k = 2.0 * np.pi * np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n))
    values = np.fft.ifft2(np.fft.fft2(rng.normal(size=(n, n))) * np.exp(-k)).real
    axis = 0.01 * np.arange(n)
    coarse = AnomalyGrid(10.0 + axis, 54.0 + axis, values * 100.0 / values.std())
    there, known = at_depth(coarse, NavigationOptions(map_sigma=0.0), 0.0)
    assert there is coarse
    assert known.map_sigma == pytest.approx(coarse.interpolation_sigma)
    assert known.map_sigma > 1.0
    assert known.map_length == pytest.approx(0.5 * coarse.spacing)


def test_an_infinite_sigma_of_the_map_is_refused() -> None:
    unknown = AnomalyGrid(
        [-58.0, -57.9, -57.8, -57.7], [49.4, 49.5, 49.6, 49.7], np.eye(4), np.inf, sigma_length=500.0
    )
    with pytest.raises(OutOfRange, match="map's sigma = inf nT"):
        lasting_errors(unknown, NavigationOptions())


def test_a_map_whose_level_is_uncertain_leaves_the_bias_open() -> None:
    surveyed = synthetic(Map(40, 1000), 0).replaced(level_sigma=100.0)
    there, known = lasting_errors(surveyed, NavigationOptions(bias_sigma=5.0))
    assert known.bias_sigma == pytest.approx(hypot(100.0, 5.0))
    assert lasting_errors(there, known) == (there, known), "counted once"


def test_what_was_smoothed_away_is_a_map_error_that_lasts_and_a_flight_holds_its_position() -> None:
    """A rough field without its waves below 1 km: near the bound, consistent; counted with every measurement
    instead, a field that has nothing to do with the map explained the flight better, and it was lost.
    """
    raw = synthetic(Map(40, 1000, rough=True), 0)
    less = smoothed(raw, 1_000.0)
    lasting, known = lasting_errors(less, NavigationOptions(map_sigma=0.0))
    assert known.map_sigma == pytest.approx(float(np.std(less.anomaly - raw.anomaly)), rel=0.3)
    assert known.map_length == pytest.approx(less.sigma_length)
    assert lasting.error(4.0 * known.map_sigma**2)[0] == pytest.approx(2.0)
    assert lasting_errors(lasting, known) == (lasting, known), "counted once"
    assert lasting_errors(raw, known) == (raw, known)
    options = replace(GLIDER, start_sigma=150.0)
    flown = sail(track_over(raw, options, 1000, hours=3.0), less, options).score()
    assert not flown["lost"]
    assert flown["drms"] < 2.0 * flown["bound"] < flown["unaided"]
    assert flown["nees"] < 3.0


def test_level_is_a_bias_that_lasts() -> None:
    """It widens the bias, whose changes stay as large as before: 2 sigma²/tau."""
    plain = changed(identity(), noise=Noise(1.0))
    levelled = changed(plain, reference=Reference(50_000.0, "IGRF", 0.0, 145.0, 150.0))
    without = informed(NavigationOptions(), plain, 2.0)
    known = informed(NavigationOptions(), levelled, (2.0**2 + 150.0**2) ** 0.5)
    assert known.noise == without.noise
    assert known.bias_sigma == pytest.approx((without.bias_sigma**2 + 150.0**2) ** 0.5)
    assert known.bias_sigma**2 / known.bias_time == pytest.approx(without.bias_sigma**2 / without.bias_time)
