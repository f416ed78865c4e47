"""Read one anomaly map from every format; refuse files that are not maps."""

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from grids import LAT, LON, MAP, esri, esri_corner, geosoft, geotiff, surfer_6, surfer_7, surfer_text, table
from hypothesis import given, settings
from hypothesis import strategies as st

from magbridge.errors import FormatError
from magbridge.field.grid import AnomalyGrid
from magbridge.field.read import read_grid, read_polygon


def metres(unit: int) -> tuple[int, ...]:
    """Return the keys of a grid in UTM's zone 32, its coordinates in a unit by EPSG's number."""
    return (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32632, 3076, 0, 1, unit)


def vast(path: Path) -> None:
    """Write a GeoTIFF in which one byte of the width is damaged."""
    geotiff(path)
    width = struct.pack("<HHII", 256, 4, 1, LON.size)
    path.write_bytes(path.read_bytes().replace(width, width[:-1] + b"\x70"))


def cut(path: Path, write: Callable[[Path], None], size: int) -> None:
    write(path)
    os.truncate(path, size)


def cf(
    path: Path,
    unit: str = "nT",
    scale: float = 1.0,
    names: tuple[str, str] = ("lat", "lon"),
    altitude: str | float = 305.0,
    **of_longitude: str,
) -> None:
    grid = xr.DataArray(MAP * scale, {names[0]: LAT, names[1]: LON}, names, attrs={"units": unit})
    grid[names[1]].attrs = of_longitude
    xr.Dataset({"tfa": grid, "survey_flag": ((), 1)}, attrs={"altitude": altitude}).to_netcdf(path)


def gmt(path: Path) -> None:
    """Write a netCDF grid as GMT does: x, y, z, rows ascending; long names, no standard names."""
    cf(path, unit="", names=("y", "x"), long_name="longitude")


def old_gmt(path: Path) -> None:
    xr.Dataset(
        {
            "x_range": ("side", [LON[0], LON[-1]]),
            "y_range": ("side", [LAT[0], LAT[-1]]),
            "dimension": ("side", [LON.size, LAT.size]),
            "z": ("xysize", MAP[::-1].ravel(), {"node_offset": 0}),
        }
    ).to_netcdf(path, format="NETCDF3_CLASSIC")


def folder(path: Path, altitude: tuple[float, ...] = (305.0,)) -> None:
    path.mkdir()
    for name, values in (("xx", LON[None]), ("yy", LAT[None]), ("alt", altitude), ("map", MAP)):
        np.savetxt(path / f"{name}.csv", values, delimiter=",")


def marked(path: Path, write: Callable[[Path], None]) -> None:
    """Write a grid by `write`, then add a byte order mark to each of its files."""
    write(path)
    for file in path.iterdir() if path.is_dir() else [path]:
        file.write_text("\ufeff" + file.read_text(), encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.grd", surfer_text),
        ("b.grd", surfer_6),
        ("c.grd", surfer_7),
        ("blank.grd", lambda path: surfer_7(path, blank=-9999.0)),
        ("d.grd", old_gmt),
        ("e.grd", gmt),
        ("a.nc", cf),
        ("a.asc", esri),
        ("b.asc", esri_corner),
        ("a.csv", table),
        ("a.xyz", lambda path: table(path, "# lon lat z\n", " ")),
        ("b.csv", lambda path: table(path, "lon;lat;mag [nT]\n", ";")),
        ("c.csv", lambda path: table(path, "lon,lat,mag (uT)\n", scale=1e-3)),
        ("d.csv", lambda path: table(path, "\ufefflongitude,latitude,anomaly\n")),  # as Excel writes it
        ("e.csv", lambda path: table(path, "\ufeffx,y,z,mag\n", height=True)),
        ("f.csv", lambda path: table(path, "Lon_DD,Lat_DD,Mag Anomaly (nT)\n")),
        ("g.csv", lambda path: table(path, "/ XYZ\n# Lon_DD,Lat_DD,tmi [uT]\n", scale=1e-3)),
        ("b.xyz", lambda path: table(path, "/ XYZ EXPORT\n/ x y mag\nLine L100:0\n", " ")),
        ("c.xyz", lambda path: table(path, "# a grid\n\n# made by hand\nlon lat nT\n", " ")),
        ("c.asc", lambda path: marked(path, esri)),
        ("b.nc", lambda path: cf(path, "T", 1e-9)),
        ("a.tif", geotiff),
        ("f.grd", geosoft),
        ("g.grd", lambda path: geosoft(path, compressed=True)),
        ("magnav", folder),
        ("marked", lambda path: marked(path, folder)),
    ],
)
def test_every_format_gives_the_same_map(tmp_path: Path, name: str, write: Callable[[Path], None]) -> None:
    write(tmp_path / name)
    grid = read_grid(tmp_path / name)
    np.testing.assert_allclose(grid.longitude, LON, atol=1e-6)
    np.testing.assert_allclose(grid.latitude, LAT, atol=1e-6)
    np.testing.assert_allclose(grid.anomaly, MAP, atol=1e-4)


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    holed = MAP.copy()
    holed[2, 3] = np.nan
    stated: dict[str, Any] = {"altitude": 90.0, "sigma_length": 700.0, "level_sigma": 145.0}
    grid = AnomalyGrid(LON, LAT, holed, sigma=np.abs(MAP) / 10, **stated)
    grid.save(tmp_path / "g.nc")
    back = read_grid(tmp_path / "g.nc")
    np.testing.assert_allclose(back.anomaly, holed, rtol=1e-6)
    np.testing.assert_allclose(back.sigma, grid.sigma, rtol=1e-6)
    assert {name: getattr(back, name) for name in stated} == stated
    assert list(tmp_path.iterdir()) == [tmp_path / "g.nc"]


def test_a_table_over_the_antimeridian(tmp_path: Path) -> None:
    x, y = np.meshgrid((LON + 169.75 + 180) % 360 - 180, LAT)
    np.savetxt(tmp_path / "a.xyz", np.column_stack([x.ravel(), y.ravel(), MAP.ravel()]))
    grid = read_grid(tmp_path / "a.xyz")
    np.testing.assert_allclose(grid.anomaly, MAP, atol=1e-9)
    assert grid.look_up(-179.9, 54.2).anomaly == pytest.approx(grid.look_up(180.1, 54.2).anomaly)


def test_a_grid_over_the_antimeridian_from_west_to_east_by_number(tmp_path: Path) -> None:
    longitude = (LON + 169.75 + 180) % 360 - 180
    order = np.argsort(longitude)
    axes = {"lat": LAT, "lon": longitude[order]}
    xr.DataArray(MAP[:, order], axes, ("lat", "lon"), "anomaly").to_netcdf(tmp_path / "a.nc")
    grid = read_grid(tmp_path / "a.nc")
    np.testing.assert_allclose(grid.anomaly, MAP, atol=1e-9)
    np.testing.assert_allclose(grid.longitude, LON + 169.75)


def test_a_gap_in_a_table_is_a_hole(tmp_path: Path) -> None:
    x, y = np.meshgrid(LON, LAT)
    rows = np.column_stack([x.ravel(), y.ravel(), MAP.ravel()])
    np.savetxt(tmp_path / "a.xyz", np.delete(rows, 45, axis=0), header="lon lat anomaly")
    assert np.isnan(read_grid(tmp_path / "a.xyz").anomaly).sum() == 1


def stated(path: Path, sigma: str = "nT", **attrs: str | float) -> None:
    """Write the map in uT, with a sigma of 2 in a unit, and further statements."""
    grid = AnomalyGrid(LON, LAT, MAP, 2.0, 328.084, level_sigma=3.0)
    grid.save(path)
    data = xr.load_dataset(path).assign_attrs(attrs)
    data["anomaly"] = data["anomaly"].copy(data=MAP / 1000.0).assign_attrs(units="uT")
    data["sigma"] = data["sigma"].assign_attrs(units=sigma)
    data.to_netcdf(path)


@pytest.mark.parametrize(
    ("unit", "altitude"), [("m above the ellipsoid", 328.084), ("ft", 100.0), ("Feet above sea level", 100.0)]
)
@pytest.mark.parametrize(("of_sigma", "sigma"), [("nT", 2.0), ("pT", 0.002), ("", 2000.0)])
def test_each_number_of_a_netcdf_grid_has_its_own_unit(
    tmp_path: Path, unit: str, altitude: float, of_sigma: str, sigma: float
) -> None:
    """Without a unit, sigma is in that of the anomaly."""
    stated(tmp_path / "a.nc", of_sigma, altitude_units=unit, level_sigma_units="uT")
    grid = read_grid(tmp_path / "a.nc")
    np.testing.assert_allclose(grid.anomaly, MAP, atol=1e-4)
    np.testing.assert_allclose(grid.sigma, sigma, rtol=1e-6)
    assert grid.altitude == pytest.approx(altitude)
    assert grid.level_sigma == 3000.0


def with_columns(path: Path, **columns: np.ndarray) -> None:
    """Write the map as a table with further columns (ny, nx)."""
    x, y = np.meshgrid(LON, LAT)
    fields = {"longitude": x, "latitude": y, "anomaly": MAP} | columns
    rows = np.column_stack([field.ravel() for field in fields.values()])
    np.savetxt(path, rows, delimiter=",", header=",".join(fields), comments="")


@pytest.mark.parametrize(
    ("name", "value", "altitude"),
    [
        ("altitude", 100.0, 100.0),
        ("Alt [ft]", 328.084, 100.0),
        ("height_km", 0.1, 100.0),
        ("depth", 30.0, -30.0),
    ],
)
def test_a_table_states_sigma_and_height(tmp_path: Path, name: str, value: float, altitude: float) -> None:
    columns = {"error [uT]": np.abs(MAP) / 1000.0, name: np.full_like(MAP, value)}
    with_columns(tmp_path / "a.csv", **columns)
    grid = read_grid(tmp_path / "a.csv")
    np.testing.assert_allclose(grid.sigma, np.abs(MAP))
    assert grid.altitude == pytest.approx(altitude)


def scattered(path: Path) -> None:
    np.savetxt(path, np.random.default_rng(0).uniform(10, 11, (50, 3)), header="lon lat anomaly")


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("none.nc", None, "expected a file, there is none"),
        ("a.nc", os.mkfifo, "expected a file, not a pipe or a device"),
        ("a.png", lambda p: p.write_bytes(b"x"), "expected a grid: one of .nc"),
        ("a.nc", lambda p: p.write_bytes(b"not netCDF"), "expected a netCDF grid"),
        ("a.nc", lambda p: cf(p, "mGal"), "expected a magnetic field in nT, found the unit 'mGal'"),
        ("a.nc", lambda p: cf(p, names=("northing", "easting")), "projected coordinates of an unknown"),
        ("a.nc", lambda p: cf(p, names=("y", "x"), units="m"), "projected coordinates of an unknown"),
        ("a.nc", lambda p: cf(p, altitude="300 m"), "expected altitude as a number, found '300 m'"),
        ("a.nc", lambda p: stated(p, altitude_units="fathom"), "expected a height in m, found the unit 'f"),
        ("a.nc", lambda p: stated(p, sigma="mGal"), "expected a magnetic field in nT, found the unit 'mGal'"),
        ("a.nc", lambda p: stated(p, level_sigma="none"), "expected level_sigma as a number"),
        ("a.csv", lambda p: with_columns(p, altitude=MAP), "column 'altitude': expected one height of all"),
        ("a.csv", lambda p: with_columns(p, **{"alt [mi]": 0 * MAP}), "expected a height in m, found"),
        ("a.nc", lambda p: cf(p, "", 1e-3), "no value is beyond 1: state the unit, nT, uT or T"),
        ("a.grd", lambda p: surfer_7(p, rotation=30.0), "rotated by 30 degrees: expected rows along x"),
        (
            "a.tif",
            lambda p: geotiff(p, keys=metres(9999)),
            "expected axes in degrees or metres, found a unit",
        ),
        ("a.grd", lambda p: p.write_bytes(b"DSBB" + bytes(20)), "expected a Surfer grid"),
        ("a.grd", lambda p: p.write_text("DSAA 4 4 0 1 0 1 0 1 7 7 7"), "expected a Surfer grid"),
        ("a.grd", lambda p: p.write_bytes(bytes(600)), "Geosoft"),
        ("a.asc", lambda p: p.write_text("ncols 3\nnrows 2\n1 2 3"), "expected an ESRI ASCII grid"),
        ("a.asc", lambda p: p.write_text("ncols 3\nncols 3\n1 2 3"), "expected an ESRI ASCII grid"),
        ("a.asc", lambda p: p.write_text("ncols inf\nnrows 2\n1 2 3"), "expected an ESRI ASCII grid"),
        ("a.tif", lambda p: p.write_bytes(b"II*\0"), "expected a GeoTIFF"),
        ("a.tif", lambda p: p.write_bytes(b"BM" + bytes(60)), "expected a GeoTIFF"),
        ("a.tif", lambda p: cut(p, geotiff, 100), "expected a GeoTIFF"),
        ("a.tif", lambda p: cut(p, geotiff, 300), "expected a GeoTIFF"),
        ("a.tif", vast, "expected a GeoTIFF"),
        ("a.tif", lambda p: geotiff(p, scale=0.05), "expected a GeoTIFF"),
        ("a.tif", lambda p: geotiff(p, keys=(1, 1, 0, 1, 1024)), "expected a GeoTIFF"),
        ("a.tif", lambda p: geotiff(p, hole="none"), "expected a GeoTIFF"),
        ("a.csv", lambda p: p.write_text("lon,lat,depth\n1,2,3\n"), "row 1: expected the columns"),
        ("a.csv", lambda p: p.write_text("lon,lat,mag\n1,2,x\n"), "row 2, column '3': expected numbers"),
        ("a.xyz", scattered, "50 scattered points"),
        ("dir", lambda p: p.mkdir(), "expected xx.csv"),
        ("dir", lambda p: folder(p, altitude=()), "expected xx.csv"),
    ],
)
def test_one_clear_line(
    tmp_path: Path, name: str, write: Callable[[Path], object] | None, message: str
) -> None:
    if write:
        write(tmp_path / name)
    with pytest.raises(FormatError, match=message) as caught:
        read_grid(tmp_path / name)
    one_line(caught.value, tmp_path / name)


def grid_or_one_line(path: Path) -> None:
    try:
        assert read_grid(path).anomaly.size >= 16
    except FormatError as error:
        one_line(error, path)


def one_line(error: FormatError, path: Path) -> None:
    assert str(error).startswith(f"{path}: ")
    assert "\n" not in str(error)


WORDS = (
    b"DSAA DSBB DSRB GRID DATA ncols nrows xllcorner yllcenter cellsize "
    b"lon lat mag 1 -9 nan inf 1e400 , ; ( ["
)


def test_a_polygon_may_have_a_header(tmp_path: Path) -> None:
    corners = "10.1,54.1\n10.4,54.1\n10.2,54.3\n"
    for text in (corners, "\ufefflongitude,latitude\n" + corners):
        (tmp_path / "mask.csv").write_text(text, encoding="utf-8")
        polygon = read_polygon(tmp_path / "mask.csv")
        np.testing.assert_array_equal(polygon, [[10.1, 54.1], [10.4, 54.1], [10.2, 54.3]])
    for text, words in (
        ("place,longitude,latitude\n", r"mask.csv: row 1: expected longitude,latitude \(deg\), not .place"),
        (corners + "10.2,nan\n", r"mask.csv: row 4: expected .* not '10.2,nan'"),
        (corners[:10], "at least three rows"),
    ):
        (tmp_path / "mask.csv").write_text(text)
        with pytest.raises(FormatError, match=words):
            read_polygon(tmp_path / "mask.csv")


@pytest.mark.parametrize(
    ("name", "answer"),
    [
        ("files/geosoft_unbound.grd", "damaged"),
        ("files/geosoft_zlib.grd", "damaged"),
        ("files/surfer7_memory.grd", "claims 1076101120 x 0 values"),
        ("grids/latfirst_nohdr.csv", "longitude or latitude first"),
        ("grids/local_meters.nc", "unknown projection"),
        ("grids/c2d.nc", ""),
        ("grids/uT.csv", ""),
        ("grids/xyz_mag.csv", ""),
    ],
)
def test_grids_that_once_failed(cases: Path, name: str, answer: str) -> None:
    """The three readable grids are the same map."""
    if answer:
        with pytest.raises(FormatError, match=answer) as error:
            read_grid(cases / name)
        one_line(error.value, cases / name)
        return
    grid = read_grid(cases / name)
    assert (grid.longitude[0], grid.latitude[0]) == pytest.approx((-56.995, 49.005))
    assert np.abs(grid.anomaly).max() == pytest.approx(156.451, abs=1e-3)


@given(
    suffix=st.sampled_from([".grd", ".asc", ".csv", ".xyz", ".tif"]),
    raw=st.one_of(
        st.binary(max_size=300),
        st.lists(st.sampled_from([*WORDS.split(), b"\n"]), max_size=40).map(b" ".join),
    ),
)
def test_whatever_a_file_holds_the_answer_is_a_grid_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, raw: bytes
) -> None:
    path = tmp_path_factory.mktemp("any") / f"a{suffix}"
    path.write_bytes(raw)
    grid_or_one_line(path)


@pytest.mark.real
@settings(max_examples=25, deadline=None, derandomize=True)  # HDF5 itself may not live through any damage
@given(places=st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 255)), min_size=1, max_size=30))
def test_a_damaged_grid_is_a_grid_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, places: list[tuple[int, int]]
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "map.nc"
    AnomalyGrid(LON, LAT, MAP).save(path)
    content = bytearray(path.read_bytes())
    for place, byte in places:
        content[place % len(content)] = byte
    path.write_bytes(content)
    grid_or_one_line(path)


def test_magnavs_published_map_matches_its_own_flight(real_data: Path) -> None:
    """The example's compensated magnetometer against its map, at the true track: other programs made both."""
    grid = read_grid(real_data / "magnav_example" / "map")
    flight = np.genfromtxt(real_data / "magnav_example" / "xyz.csv", delimiter=",", names=True)
    left = flight["mag_1_c"] - grid.anomaly_at(flight["lon"], flight["lat"])
    assert np.std(left) < 5.0 < 0.05 * np.std(flight["mag_1_c"])
