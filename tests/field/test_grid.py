"""Test the spline of an anomaly map against scipy's spline and finite differences."""

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from magbridge.errors import FormatError, OutOfRange
from magbridge.field.geodesy import metres_per_degree, offset, separation, worse_axis
from magbridge.field.grid import AnomalyGrid

LON, LAT = np.linspace(10.0, 10.5, 51), np.linspace(54.0, 54.4, 41)

Places = tuple[np.ndarray, np.ndarray]


def hills(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    return 40 * np.sin(lon * 40) * np.cos(lat * 35) + 5 * (lat - 54)


@pytest.fixture(scope="module")
def grid() -> AnomalyGrid:
    return AnomalyGrid(LON, LAT, hills(*np.meshgrid(LON, LAT)), sigma=2.0)


@pytest.fixture(scope="module")
def places() -> Places:
    rng = np.random.default_rng(1)
    return rng.uniform(10.0, 10.5, 300), rng.uniform(54.0, 54.4, 300)


def test_agrees_with_scipys_spline_inside(grid: AnomalyGrid) -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(10.15, 10.35, 200), rng.uniform(54.15, 54.25, 200)
    other = RectBivariateSpline(LAT, LON, grid.anomaly)
    local = grid.evaluate(x, y)
    per_lat, per_lon = metres_per_degree(y)
    np.testing.assert_allclose(local.anomaly, other(y, x, grid=False), atol=2e-4)
    np.testing.assert_allclose(local.north * per_lat, other(y, x, dx=1, grid=False), atol=0.1)
    np.testing.assert_allclose(local.east * per_lon, other(y, x, dy=1, grid=False), atol=0.1)


def test_gradient_and_hessian_are_derivatives(grid: AnomalyGrid, places: Places) -> None:
    """Central differences on metres: 1e-2 m step on the gradient, whose error is then rounding."""
    lon, lat = (p[5:50] * 0.9 + 0.1 * p.mean() for p in places)
    local = grid.evaluate(lon, lat)
    per_lat, per_lon = metres_per_degree(lat)
    h = 0.5
    for (dlon, dlat), slope, curve, mixed in (
        ((0, h / per_lat), local.north, local.north_north, local.north_east),
        ((h / per_lon, 0), local.east, local.north_east, local.east_east),
    ):
        ahead, behind = grid.evaluate(lon + dlon, lat + dlat), grid.evaluate(lon - dlon, lat - dlat)
        np.testing.assert_allclose((ahead.anomaly - behind.anomaly) / (2 * h), slope, atol=1e-7)
        np.testing.assert_allclose((ahead.north - behind.north) / (2 * h), curve, atol=2e-8)
        np.testing.assert_allclose((ahead.east - behind.east) / (2 * h), mixed, atol=2e-8)


def test_one_place_and_many_are_the_same(grid: AnomalyGrid, places: Places) -> None:
    many = np.stack(grid.evaluate(*places), axis=1)
    one = np.array([grid.look_up(lon, lat) for lon, lat in zip(*map(np.ndarray.tolist, places), strict=True)])
    np.testing.assert_allclose(one, many, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("flip", [(1, -1), (-1, 1), (-1, -1)])
def test_a_descending_axis_is_the_same_map(grid: AnomalyGrid, places: Places, flip: tuple[int, int]) -> None:
    y, x = flip
    turned = AnomalyGrid(LON[::x], LAT[::y], grid.anomaly[::y, ::x], sigma=2.0)
    np.testing.assert_allclose(turned.anomaly_at(*places), grid.anomaly_at(*places), atol=1e-10)


@pytest.mark.parametrize("start", [179.8, -180.2, 359.9])
def test_longitude_goes_round(grid: AnomalyGrid, places: Places, start: float) -> None:
    """A map has equal values over the antimeridian and over Greenwich, for both ranges of longitude."""
    axis = LON - 10.0 + start
    for stored in (axis, (axis + 180) % 360 - 180, axis % 360):
        moved = AnomalyGrid(stored, LAT, grid.anomaly)
        lon = places[0] - 10.0 + start
        for asked in (lon, (lon + 180) % 360 - 180, lon % 360):
            np.testing.assert_allclose(
                moved.anomaly_at(asked, places[1]), grid.anomaly_at(*places), atol=1e-6
            )
            assert moved.look_up(float(asked[0]), float(places[1][0])).anomaly == pytest.approx(
                grid.anomaly_at(*places)[0], abs=1e-6
            )


def test_longitude_reads_as_usual(grid: AnomalyGrid) -> None:
    """Across the antimeridian it is unwound inside; a map of the whole globe reads as its file does."""
    for first, reported in ((179.8, "179.8000 to -179.7000"), (190.0, "-170.0000 to -169.5000")):
        assert repr(AnomalyGrid(LON - 10.0 + first, LAT, grid.anomaly)).endswith(f"longitude {reported})")
    around = AnomalyGrid(np.arange(0.0, 360.0), np.arange(5.0), np.zeros((5, 360)))
    assert repr(around).endswith("longitude 0.0000 to 359.0000)")


def test_a_hole_is_a_hole_and_no_more(grid: AnomalyGrid) -> None:
    values = grid.anomaly.copy()
    values[20, 25] = 1.70141e38
    holed = AnomalyGrid(LON, LAT, values)
    assert np.isnan(holed.look_up(10.245, 54.195).anomaly)
    assert np.isnan(holed.evaluate(10.245, 54.195).anomaly).all()
    far = holed.evaluate([10.1, 10.4], [54.1, 54.3]).anomaly
    np.testing.assert_allclose(far, grid.evaluate([10.1, 10.4], [54.1, 54.3]).anomaly, atol=0.01)
    assert np.isfinite(holed.look_up(10.265, 54.195).anomaly)


def test_off_the_map_is_nan_or_refused(grid: AnomalyGrid) -> None:
    assert np.isnan(grid.evaluate([9.99, 10.1, np.nan], [54.1, 54.41, 54.1]).anomaly).all()
    assert np.isnan(grid.look_up(9.99, 54.1).north)
    assert np.isnan(grid.look_up(np.nan, 54.1).north)
    with pytest.raises(OutOfRange, match=r"position = 54.41000 10.10000: grid \(latitude"):
        grid.anomaly_at([10.1, 10.1], [54.1, 54.41])


def test_a_map_covers_its_own_edges() -> None:
    """Coordinates of even spacing, rounded: the last node may exceed the first plus n steps by 1 ulp."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        (x0, y0), step = rng.uniform((-170.0, -70.0), (160.0, 70.0)).round(4), rng.choice([0.001, 0.01, 0.05])
        lon, lat = x0 + step * np.arange(rng.integers(5, 60)), y0 + step * np.arange(rng.integers(5, 60))
        own = AnomalyGrid(lon, lat, rng.normal(size=(lat.size, lon.size)))
        x, y = (one.ravel() for one in np.meshgrid(lon, lat))
        np.testing.assert_allclose(own.anomaly_at(x, y), own.anomaly.ravel(), atol=1e-6)


def test_a_missing_vertical_slope_is_missing_there_only() -> None:
    values, slope = hills(*np.meshgrid(LON, LAT)), np.full((41, 51), 0.01)
    values[20, 20] = slope[20, 20] = np.nan
    holed = AnomalyGrid(LON, LAT, values, altitude=0.0, vertical=slope)
    flat = AnomalyGrid(LON, LAT, values, altitude=0.0)
    risen = holed.look_up(10.1, 54.05, 30.0).anomaly - flat.look_up(10.1, 54.05).anomaly
    assert risen == pytest.approx(0.3, abs=1e-6)


def test_sigma_lies_between_its_nodes() -> None:
    grid = AnomalyGrid(LON, LAT, np.zeros((41, 51)), sigma=np.meshgrid(np.arange(51.0), LAT)[0])
    assert grid.look_up(10.105, 54.1).variance == pytest.approx((10**2 + 11**2) / 2)
    assert grid.evaluate(10.105, 54.1).variance[0] == pytest.approx((10**2 + 11**2) / 2)


def test_roughness_of_a_known_map() -> None:
    """exp(-r²/2L²) by summing many waves with Gaussian wavenumbers: L comes back to 10 %."""
    rng = np.random.default_rng(4)
    lon, lat = np.linspace(0, 0.5, 250), np.linspace(0, 0.5, 250)
    per_lat, per_lon = metres_per_degree(0.25)
    x, y = np.meshgrid(lon * per_lon, lat * per_lat)
    k, phase = rng.normal(size=(300, 2)) / 1500.0, rng.uniform(0, 2 * np.pi, 300)
    a = 20 * np.sqrt(2 / 300) * sum(np.cos(kx * x + ky * y + p) for (kx, ky), p in zip(k, phase, strict=True))
    grid = AnomalyGrid(lon, lat, a)
    assert grid.rms == pytest.approx(20, rel=0.15)
    assert grid.correlation_length == pytest.approx(1500, rel=0.1)
    assert AnomalyGrid(lon, lat, np.zeros_like(a)).correlation_length == np.inf


@pytest.mark.parametrize(
    ("lon", "lat", "values", "message"),
    [
        (LON * 1e4, LAT, 0.0, "column 'longitude': expected degrees, found 105000: projected coordinates"),
        (LON, LAT * 1e4, 0.0, "column 'latitude': expected degrees"),
        (LON**8, LAT, 0.0, "expected degrees"),
        (np.concatenate([LON[:25], LON[26:], [10.6]]), LAT, 0.0, "evenly spaced"),
        (LON[:3], LAT, 0.0, "at least 4"),
        (LON, LAT, 52_000.0, "median of 52000 nT: subtract the IGRF"),
        (LON, LAT, np.nan, "nothing but holes"),
    ],
)
def test_refuses_what_is_not_a_map(lon: np.ndarray, lat: np.ndarray, values: float, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        AnomalyGrid(lon, lat, np.full((len(lat), len(lon)), values).astype(float))


def test_refuses_another_shape() -> None:
    with pytest.raises(FormatError, match="expected 41 rows of 51 values, found 51 x 41"):
        AnomalyGrid(LON, LAT, np.zeros((51, 41)))


def test_offset_and_separation_are_inverse() -> None:
    there = offset(60.0, 179.9, 12_000.0, 15_000.0)
    assert there[1] < -179
    assert separation(60.0, 179.9, *there) == pytest.approx((12_000.0, 15_000.0), abs=1e-6)
    north, east = np.array([12_000.0, -3e4]), np.array([15_000.0, -2e4])
    many = offset(60.0, 179.9, north, east)
    assert (many[0][0], many[1][0]) == there
    np.testing.assert_allclose(separation(60.0, 179.9, *many), [north, east], atol=1e-6)


def test_the_worse_axis_is_the_larger_eigenvalue() -> None:
    roots = np.random.default_rng(3).normal(0.0, 100.0, (50, 2, 2))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    expected = np.sqrt(np.linalg.eigvalsh(covariances)[:, 1])
    nn, ne, ee = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    np.testing.assert_allclose(worse_axis(nn, ne, ee), expected)
    assert worse_axis(float(nn[0]), float(ne[0]), float(ee[0])) == pytest.approx(expected[0])


@pytest.mark.parametrize("depth", [0.5, 1.0, 1.5])
def test_what_lies_between_the_nodes_is_predicted(depth: float) -> None:
    """The predicted spline error is right within a factor of 2, for sources `depth` spacings deep."""
    rng, n = np.random.default_rng(7), 241
    k = 2.0 * np.pi * np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n))
    waves = np.fft.fft2(rng.normal(size=(n, n))) * np.exp(-4.0 * depth * k)
    fine = np.fft.ifft2(waves).real
    fine *= 50.0 / fine.std()
    axis = np.arange(n) * 1e-3
    coarse = AnomalyGrid(10.0 + axis[::4], 54.0 + axis[::4], fine[::4, ::4])
    x, y = np.meshgrid(10.0 + axis, 54.0 + axis)
    error = coarse.evaluate(x.ravel(), y.ravel()).anomaly - fine.ravel()
    middle = (np.abs(x - 10.12) < 0.1) & (np.abs(y - 54.12) < 0.1)
    truth = np.sqrt(np.mean(error.reshape(n, n)[middle] ** 2))
    assert 0.5 < coarse.interpolation_sigma / truth < 2.0
