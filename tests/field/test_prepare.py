"""Test map preparation: continuation against the field of a real source, the merge, the mask, the kernel."""

from pathlib import Path

import numpy as np
import pytest
from commands import Command

from magbridge.errors import OutOfRange, WrongUse
from magbridge.field.continuation import continued, draw_steps, merge, prepare, smoothed, surveyed_at
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.field.grid_netcdf import write
from magbridge.field.read import read_grid

LON, LAT = np.linspace(-58.1, -57.9, 81), np.linspace(49.45, 49.55, 61)


def monopole(altitude: float, depth: float = 800.0) -> np.ndarray:
    """Return the vertical field of a magnetic pole under the map's centre, nT, at any height."""
    per_lat, per_lon = metres_per_degree(49.5)
    x, y = np.meshgrid((LON + 58.0) * per_lon, (LAT - 49.5) * per_lat)
    z = altitude + depth
    return 2e8 * z / (x * x + y * y + z * z) ** 1.5


def test_continuation_is_the_field_at_the_new_height() -> None:
    """The edges of a finite map cost some nT; in its middle half the error is under 2 % of the peak."""
    low, high = AnomalyGrid(LON, LAT, monopole(60.0), altitude=60.0), monopole(260.0)
    raised = continued(low, -260.0).grid
    assert raised.altitude == 260.0
    middle = slice(15, -15), slice(20, -20)
    assert np.abs(raised.anomaly - high)[middle].max() < 0.02 * high.max()
    assert np.abs(low.anomaly - high)[middle].max() > 0.3 * high.max()


def test_continuation_keeps_a_constant_and_the_holes() -> None:
    values = np.full((61, 81), 7.0)
    values[30, 40] = np.nan
    raised = continued(AnomalyGrid(LON, LAT, values, altitude=0.0), -100.0).grid
    assert np.isnan(raised.anomaly).sum() == 1
    np.testing.assert_allclose(raised.anomaly[~np.isnan(values)], 7.0, atol=1e-9)


@pytest.mark.parametrize(
    ("up", "ragged"), [(-60.0, False), (80.0, False), (250.0, False), (250.0, True), (700.0, True)]
)
def test_sigma_covers_what_a_continuation_takes_from_outside(up: float, *, ragged: bool) -> None:
    """Poles at random places, also beyond the map: standardised errors are near 1 at the edges and inside."""
    per_lat, per_lon = metres_per_degree(49.5)
    lon, lat = LON[::2], LAT[::2]
    x, y = np.meshgrid((lon + 58.0) * per_lon, (lat - 49.5) * per_lat)
    rng, standardised, at_edge = np.random.default_rng(5), [], []
    for _ in range(12):
        places, depths = rng.uniform(-20e3, 20e3, (2, 300)), rng.uniform(800.0, 1600.0, 300)
        sources = [*zip(*places, depths, rng.normal(0.0, 1e7, 300), strict=True)]

        def field(height: float, sources: list[tuple[float, ...]] = sources) -> np.ndarray:
            of_each = [
                strength * (z + height) / ((x - e) ** 2 + (y - n) ** 2 + (z + height) ** 2) ** 1.5
                for e, n, z, strength in sources
            ]
            return np.asarray(np.sum(of_each, axis=0))

        surveyed = field(100.0)
        if ragged:
            surveyed[x + y > 5_000.0] = surveyed[14:16, 12:15] = np.nan
        there, missing, _ = continued(AnomalyGrid(lon, lat, surveyed, altitude=100.0), -100.0 - up)
        sigma = np.hypot(there.sigma, missing)
        standardised.append((there.anomaly - field(100.0 + up)) / sigma)
        at_edge.append(sigma > np.quantile(sigma[~np.isnan(surveyed)], 0.8))
    z, edge = np.array(standardised), np.array(at_edge)
    for part in (edge, ~edge):
        assert 0.8 < np.sqrt(np.nanmean(z[part] ** 2)) < 1.25


@pytest.mark.parametrize("depth", [0.0, 60.0, 150.0])
def test_below_a_map_the_error_is_reported(depth: float) -> None:
    """Continuation restores half of the lost amplitude, and sigma predicts the remainder within a third."""
    low = AnomalyGrid(LON, LAT, monopole(90.0), altitude=90.0)
    there = continued(low, depth)
    middle = slice(15, -15), slice(20, -20)
    truth = monopole(-depth)
    error = (there.grid.anomaly - truth)[middle]
    assert np.std(error) < 0.5 * np.std((low.anomaly - truth)[middle])
    assert there.grid.altitude == -depth
    everywhere = np.sqrt(np.mean((there.grid.anomaly - truth) ** 2))
    assert there.sigma == pytest.approx(everywhere, rel=0.35)
    assert 200.0 < there.length < 2_000.0, "as wide as the pole is deep"


@pytest.mark.parametrize("spacings", [5.0, 9.0, 40.0])
def test_far_below_a_map_the_sum_of_the_series_stays_finite(spacings: float) -> None:
    """exp(-k h) of the shortest wave is below the rounding from 8 spacings on; NaN depths are ignored."""
    low = AnomalyGrid(LON, LAT, monopole(90.0), altitude=90.0)
    there = continued(low, np.array([spacings * low.spacing - 90.0, np.nan]))
    assert np.isfinite(there.grid.anomaly).all()
    assert 0.0 < there.sigma < 1e4
    assert there.grid.altitude == pytest.approx(90.0 - spacings * low.spacing)


def test_a_dive_is_followed_through_the_map() -> None:
    """About the middle of a dive the vertical gradient takes most of what the depth changes."""
    there = continued(AnomalyGrid(LON, LAT, monopole(0.0), altitude=0.0), np.linspace(0.0, 120.0))
    lon, lat = (axis[15:-15:5, 20:-20:5].ravel() for axis in np.meshgrid(LON, LAT))
    for depth in (0.0, 120.0):
        truth = AnomalyGrid(LON, LAT, monopole(-depth)).anomaly_at(lon, lat)
        followed = there.grid.evaluate(lon, lat, depth).anomaly
        assert np.std(followed - truth) < 0.3 * np.std(there.grid.anomaly_at(lon, lat) - truth)
        one = there.grid.look_up(lon[7], lat[7], depth)
        np.testing.assert_allclose(one.anomaly, followed[7], rtol=1e-12)


def test_a_map_of_unknown_height_stays_as_it_is() -> None:
    grid = AnomalyGrid(LON, LAT, monopole(90.0))
    assert continued(grid, 50.0) == (grid, 0.0, np.inf)


def test_nothing_is_prepared_downward() -> None:
    with pytest.raises(OutOfRange, match="surveyed at 90 m: a field can only be continued upward"):
        prepare([AnomalyGrid(LON, LAT, monopole(90.0), altitude=90.0, name="a.grd")], altitude=60.0)


def test_a_survey_of_unknown_height_is_not_continued_until_it_is_declared() -> None:
    """The command refuses a survey of unknown height if an altitude is requested."""
    silent = AnomalyGrid(LON, LAT, monopole(60.0), name="a.grd")
    known = AnomalyGrid(LON, LAT, monopole(90.0), altitude=90.0, name="b.nc")
    for grids, altitude in (([silent], 90.0), ([known, silent], None)):
        with pytest.raises(OutOfRange, match=r"90 m: a.grd does not say how high it was surveyed"):
            prepare(grids, altitude)
    reported = surveyed_at([known, silent], [60.0])
    assert [grid.altitude for grid in reported] == [90.0, 60.0]
    assert surveyed_at([silent, silent], [60.0, 70.0])[1].altitude == 70.0
    lifted, _ = prepare(reported[1:], 90.0)
    off = (lifted.anomaly - monopole(90.0))[10:-10, 10:-10]
    assert np.abs(off).max() < 0.1 * np.abs(monopole(60.0) - monopole(90.0)).max()
    with pytest.raises(WrongUse, match="2 altitudes for 1 grids"):
        surveyed_at([silent], [60.0, 70.0])


def test_grids_of_unknown_heights_are_not_merged_in_silence(here: Path, command: Command) -> None:
    for name in ("low.nc", "high.nc"):
        AnomalyGrid(LON, LAT, monopole(90.0)).save(name)
    said = "no grid says how high it was surveyed"
    assert said in command("map", "low.nc", "high.nc", "-o", "map.nc").err
    assert said not in command("map", "low.nc", "-o", "map.nc").err
    assert said not in command("map", "low.nc", "high.nc", "--survey-altitude", "90", "-o", "map.nc").err


def test_merge_is_the_mean_in_the_overlap() -> None:
    west = AnomalyGrid(LON[:50], LAT, np.full((61, 50), 10.0), sigma=3.0)
    east = AnomalyGrid(LON[30:], LAT[10:], np.full((51, 51), 12.0), sigma=4.0)
    both, _ = merge([west, east])
    assert both.look_up(-58.09, 49.5).anomaly == pytest.approx(10.0)
    assert both.look_up(-57.91, 49.5).anomaly == pytest.approx(12.0)
    overlap = both.look_up(-58.0, 49.5)
    assert overlap.anomaly == pytest.approx(11.0)
    assert np.sqrt(overlap.variance) == pytest.approx(2.5)
    assert np.isnan(both.look_up(-57.91, 49.455).anomaly)


def test_surveys_that_disagree_are_not_exact() -> None:
    """Each of two surveys that differ by 10 nT has an error of 7 nT, and their mean an error of 5 nT."""
    west = AnomalyGrid(LON[:50], LAT, np.full((61, 50), 10.0))
    east = AnomalyGrid(LON[30:], LAT, np.full((61, 51), 20.0), sigma=8.0)
    both, _ = merge([west, east])
    sigma = [float(np.sqrt(both.look_up(place, 49.5).variance)) for place in (-58.09, -58.0, -57.91)]
    assert sigma == pytest.approx([10.0 / np.sqrt(2.0), 5.0, 8.0])


def test_the_difference_of_surveys_is_reported() -> None:
    """Two maps are compared by their difference, three by each pair; distance in space does not count."""

    def merged(*surveys: AnomalyGrid) -> str:
        return prepare(surveys)[1][-1].title

    a, b, c = (AnomalyGrid(LON, LAT, monopole(60.0) + offset) for offset in (0.0, 3.0, 9.0))
    assert merged(a, b) == "merged, 3.0 nT RMS difference in their overlap"
    rms = np.sqrt((3**2 + 9**2 + 6**2) / 3)
    assert merged(a, b, c) == f"merged, {rms:.1f} nT RMS difference in their overlap"
    west, east = (AnomalyGrid(LON[part], LAT, a.anomaly[:, part]) for part in (slice(30), slice(40, None)))
    assert merged(west, east) == "merged, no two of them overlap"


def test_a_map_that_would_fill_the_memory_is_refused() -> None:
    """Two fine surveys of opposite coasts would need nodes in the whole area between them."""
    west = AnomalyGrid(LON, LAT, monopole(60.0))
    east = AnomalyGrid(LON + 40.0, LAT + 10.0, monopole(60.0))
    with pytest.raises(OutOfRange, match=r"146\d{6} nodes: at most 10000000: set a spacing of 0\.0067 deg"):
        merge([west, east])
    assert 1e6 < merge([west, east], spacing=0.01)[0].anomaly.size < 1e7


def test_merge_across_the_antimeridian() -> None:
    values = np.full((61, 50), 5.0)
    west = AnomalyGrid(LON[:50] + 238.0, LAT, values)
    east = AnomalyGrid(LON[:50] + 238.1 - 360.0, LAT, values)
    both, _ = merge([west, east])
    np.testing.assert_allclose(both.anomaly_at([179.95, -179.9], 49.5), 5.0, atol=1e-9)


def test_smoothing_is_by_wavelength_and_what_goes_becomes_sigma() -> None:
    """A wave of the cutoff length keeps half its amplitude, twice the length 84 %; sigma is the RMS loss."""
    per_latitude, _ = metres_per_degree(49.5)
    north = (LAT - LAT[0]) * per_latitude
    middle = slice(20, -20), slice(20, -20)
    for length, kept in ((2_000.0, 0.5), (4_000.0, 2**-0.25)):
        wave = np.repeat(100.0 * np.cos(2.0 * np.pi * north / length)[:, None], LON.size, axis=1)
        less = smoothed(AnomalyGrid(LON, LAT, wave, sigma=3.0), 2_000.0)
        share = np.sum(less.anomaly[middle] * wave[middle]) / np.sum(wave[middle] ** 2)
        assert share == pytest.approx(kept, abs=0.02)
        gone = (1.0 - kept) * 100.0 / np.sqrt(2.0)
        assert np.sqrt(np.mean(less.sigma[middle] ** 2)) == pytest.approx(np.hypot(3.0, gone), rel=0.1)


def test_a_smoothing_error_is_correlated_over_a_quarter_of_its_wavelength_in_the_file_too(
    tmp_path: Path,
) -> None:
    rough = AnomalyGrid(LON, LAT, np.random.default_rng(0).normal(size=(61, 81)))
    less, _ = prepare([rough], smooth=2.0)
    assert (rough.sigma_length, less.sigma_length) == (0.0, 500.0)
    raised = continued(AnomalyGrid(LON, LAT, rough.anomaly, 1.0, 60.0, sigma_length=9.0), -110.0).grid
    assert raised.sigma_length == 9.0
    write(less, tmp_path / "map.nc")
    assert read_grid(tmp_path / "map.nc").sigma_length == 500.0
    write(rough, tmp_path / "map.nc")
    assert read_grid(tmp_path / "map.nc").sigma_length == 0.0


def test_smoothing_keeps_a_constant_and_the_holes() -> None:
    flat = np.where(np.random.default_rng(0).normal(size=(61, 81)) > 2.0, np.nan, 3.0)
    kept = smoothed(AnomalyGrid(LON, LAT, flat), 3_000.0).anomaly
    np.testing.assert_array_equal(np.isnan(kept), np.isnan(flat))
    np.testing.assert_allclose(kept[~np.isnan(flat)], 3.0)


def test_the_whole_preparation_and_its_pictures(tmp_path: Path) -> None:
    low = AnomalyGrid(LON[:60], LAT, monopole(60.0)[:, :60], altitude=60.0, name="low.grd")
    high = AnomalyGrid(LON[40:], LAT, monopole(90.0)[:, 40:], altitude=90.0, name="high.grd")
    outline = [(-58.08, 49.46), (-57.92, 49.46), (-57.92, 49.54), (-58.08, 49.54)]
    grid, steps = prepare([low, high], smooth=1.0, mask=outline)
    assert grid.altitude == 90.0
    first = "as surveyed: low.grd", "as surveyed: high.grd", "continued +30 m: low.grd"
    last = "merged", "masked", "smoothed over 1 km: 1.5 nT RMS removed"
    assert [step.title.partition(",")[0] for step in steps] == [*first, *last]
    assert np.isnan(grid.look_up(-58.09, 49.5).anomaly)
    inside = grid.look_up(-58.02, 49.51).anomaly
    true = AnomalyGrid(LON, LAT, monopole(90.0)).look_up(-58.02, 49.51).anomaly
    assert inside == pytest.approx(true, rel=0.2)
    draw_steps(steps, tmp_path / "steps.png")
    assert (tmp_path / "steps.png").stat().st_size > 20_000


def test_a_mask_next_to_the_map_is_refused() -> None:
    with pytest.raises(OutOfRange, match="no node of"):
        prepare([AnomalyGrid(LON, LAT, monopole(60.0))], mask=[(0, 0), (1, 0), (1, 1)])
