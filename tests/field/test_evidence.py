"""Test that units, names, reference system and range identify axes and columns, not their order."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from magbridge.errors import FormatError
from magbridge.field.read import read_grid

LON, LAT = np.linspace(10.0, 10.5, 11), np.linspace(54.0, 54.4, 9)
X, Y = np.meshgrid(LON, LAT)
MAP = 30.0 * np.sin(9.0 * X) + 100.0 * (Y - 54.0)


def columns(path: Path, header: str, *values: np.ndarray) -> None:
    rows = np.column_stack([v.ravel() for v in values])
    np.savetxt(path, rows, delimiter=",", header=header, comments="")


def grid(path: Path, x: np.ndarray, y: np.ndarray, values: np.ndarray = MAP, units: str = "") -> None:
    """Write a grid; `units` are those of both axes, "degrees" with their directions."""
    array = xr.DataArray(values, {"y": y, "x": x}, ("y", "x"), "z", {"units": "nT"})
    for name, way in (("x", "_east"), ("y", "_north")):
        array[name].attrs["units"] = units + way * (units == "degrees")
    array.to_netcdf(path)


def geotiff(path: Path, values: np.ndarray, tags: dict[int, tuple[int, object]]) -> None:
    """Write a GeoTIFF with tags of (TIFF type, value)."""
    directory = ImageFileDirectory_v2()
    for tag, (kind, value) in tags.items():
        directory[tag], directory.tagtype[tag] = value, kind
    Image.fromarray(values[::-1].astype(np.float32)).save(path, tiffinfo=directory)


def placed(x0: float, y1: float, step: float, *keys: int) -> dict[int, tuple[int, object]]:
    """Return the tags of a grid whose north-west node is (x0, y1)."""
    return {
        33550: (12, (step, step, 0.0)),
        33922: (12, (0.0, 0.0, 0.0, x0, y1, 0.0)),
        34735: (3, (1, 1, 0, len(keys) // 4 + 1, 1025, 0, 1, 2, *keys)),
    }


@pytest.mark.parametrize(
    ("header", "values"),
    [
        ("x,y,z,mag", (X, Y, X * 0 + 120, MAP)),
        ("lon,lat,z,anomaly", (X, Y, X * 9, MAP)),
        ("lat,lon,mag_nT", (Y, X, MAP)),
        ("line,mag [uT],lon,lat", (X * 0 + 3, MAP * 1e-3, X, Y)),
        ("easting,northing,longitude,latitude,tmi", (X * 1e5, Y * 1e5, X, Y, MAP)),
    ],
)
def test_a_column_is_what_its_name_says(tmp_path: Path, header: str, values: tuple[np.ndarray, ...]) -> None:
    columns(tmp_path / "a.csv", header, *values)
    found = read_grid(tmp_path / "a.csv")
    np.testing.assert_allclose(found.longitude, LON)
    np.testing.assert_allclose(found.anomaly, MAP, atol=1e-6)


def test_without_names_only_the_range_tells(tmp_path: Path) -> None:
    """A number beyond 90 cannot be a latitude; two candidates give one message."""
    path = tmp_path / "a.xyz"
    for values in ((Y, X + 100.0, MAP), (X + 100.0, Y, MAP)):
        columns(path, "", *values)
        path.write_text(path.read_text().lstrip())
        np.testing.assert_allclose(read_grid(path).longitude, LON + 100.0)
    columns(path, "", Y, X, MAP)
    path.write_text(path.read_text().lstrip())
    with pytest.raises(FormatError, match="longitude or latitude first"):
        read_grid(path)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p: grid(p, 2.0 * np.arange(11), 2.0 * np.arange(9), units="meters"), "projected"),
        (lambda p: grid(p, LON, LAT, units="km"), "projected"),
        (lambda p: grid(p, 0.5 * np.arange(11), 0.5 * np.arange(9)), "degrees, or local coordinates"),
        (lambda p: grid(p, np.arange(11) - 5.0, np.arange(9) - 4.0), "degrees, or local coordinates"),
        (lambda p: grid(p, 500.0 + np.arange(11), 54.0 + np.arange(9)), "projected"),
        (
            lambda p: xr.Dataset({"z": (("y", "x"), MAP)}).to_netcdf(p),
            "expected the coordinates of this axis",
        ),
        (lambda p: grid(p, np.radians(LON), np.radians(LAT), units="rad"), "found radians"),
    ],
)
def test_other_units_are_not_taken_for_degrees(
    tmp_path: Path, write: Callable[[Path], object], words: str
) -> None:
    write(tmp_path / "a.nc")
    with pytest.raises(FormatError, match=words):
        read_grid(tmp_path / "a.nc")


def test_longitudes_beyond_360_are_the_same_meridians(tmp_path: Path) -> None:
    grid(tmp_path / "a.nc", LON + 380.0, LAT, units="degrees")
    found = read_grid(tmp_path / "a.nc")
    assert found.look_up(30.2, 54.2).anomaly == pytest.approx(found.look_up(390.2, 54.2).anomaly)


@pytest.mark.parametrize("bend", [0.0, 0.01])
def test_longitudes_and_latitudes_node_by_node(tmp_path: Path, bend: float) -> None:
    lat = Y + bend * np.sin(X * 9)
    array = xr.DataArray(MAP, {"lat": (("j", "i"), lat), "lon": (("j", "i"), X)}, ("j", "i"), "anomaly")
    array.to_netcdf(tmp_path / "a.nc")
    if bend:
        with pytest.raises(FormatError, match="not an even grid"):
            read_grid(tmp_path / "a.nc")
    else:
        np.testing.assert_allclose(read_grid(tmp_path / "a.nc").latitude, LAT)


@pytest.mark.parametrize("stated", ["grid_mapping", "prj", "hole", "tiff", "feet"])
def test_metres_of_a_known_projection_become_degrees(tmp_path: Path, stated: str) -> None:
    """A smooth field of longitude and latitude, sampled every 500 m in UTM zone 32."""
    pyproj = pytest.importorskip("pyproj")
    crs = pyproj.CRS("EPSG:32632")
    there = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    east, north = 560_000.0 + 500.0 * np.arange(60), 5_990_000.0 + 500.0 * np.arange(50)
    lon, lat = there.transform(*np.meshgrid(east, north))

    def field(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        return np.asarray(100.0 * np.sin(40.0 * (lon - 10.0)) + 80.0 * np.cos(60.0 * (lat - 54.0)))

    values = field(lon, lat)
    path = tmp_path / ("a.tif" if stated in ("tiff", "feet") else "a.nc")
    if path.suffix == ".tif":
        unit, per_metre = (9003, 3937.0 / 1200.0) if stated == "feet" else (9001, 1.0)
        keys = 1024, 0, 1, 1, 3072, 0, 1, 32632, 3076, 0, 1, unit
        geotiff(path, values, placed(east[0] * per_metre, north[-1] * per_metre, 500.0 * per_metre, *keys))
    else:
        if stated == "hole":  # which a spline would carry far, were it a value
            values[25, 30] = 1e32
        array = xr.DataArray(values, {"y": north, "x": east}, ("y", "x"), "z", {"units": "nT"})
        array["x"].attrs["units"] = array["y"].attrs["units"] = "m"
        data = array.to_dataset()
        if stated in ("prj", "hole"):
            path.with_suffix(".prj").write_text(crs.to_wkt("WKT1_ESRI"))
        else:
            data["crs"] = ((), 0, crs.to_cf())
            data["z"].attrs["grid_mapping"] = "crs"
        data.to_netcdf(path)
    found = read_grid(path)
    x, y = np.meshgrid(found.longitude, found.latitude)
    known = np.isfinite(found.anomaly)
    assert known.mean() > 0.8
    error = (found.anomaly - field(x, y))[known]
    assert np.abs(error).max() < (4.0 if stated == "hole" else 0.5)


def test_a_geotiffs_scale_offset_and_unit(tmp_path: Path) -> None:
    items = (
        '<Item name="SCALE" sample="0" role="scale">0.001</Item>'
        '<Item name="OFFSET" sample="0" role="offset">0.05</Item>'
        '<Item name="UNITTYPE" sample="0" role="unittype">uT</Item>'
    )
    tags = placed(LON[0], LAT[-1], 0.05, 1024, 0, 1, 2)
    tags[42112] = 2, f"<GDALMetadata>{items}</GDALMetadata>"
    geotiff(tmp_path / "a.tif", MAP, tags)
    np.testing.assert_allclose(read_grid(tmp_path / "a.tif").anomaly, MAP + 50.0, atol=1e-3)


@pytest.mark.parametrize("fill", [-9999.0, 99999.0, -999.0, 32767.0])
def test_a_hole_that_is_not_declared_is_one(tmp_path: Path, fill: float) -> None:
    values = MAP.copy()
    values[2:4, 3] = values[7, 9] = fill
    grid(tmp_path / "a.nc", LON, LAT, values, units="degrees")
    found = read_grid(tmp_path / "a.nc")
    assert np.isnan(found.anomaly).sum() == 3
    known = np.isfinite(found.anomaly)
    np.testing.assert_allclose(found.anomaly[known], MAP[known])


def test_a_fill_value_among_values_is_asked_about(tmp_path: Path) -> None:
    values = MAP * 180.0
    values[2, 3] = -9999.0
    grid(tmp_path / "a.nc", LON, LAT, values, units="degrees")
    with pytest.raises(FormatError, match="1 nodes are exactly -9999: holes, or values"):
        read_grid(tmp_path / "a.nc")


def test_a_node_that_is_there_twice(tmp_path: Path) -> None:
    columns(tmp_path / "a.csv", "lon,lat,mag", *(np.append(v, v[0, 0]) for v in (X, Y, MAP)))
    with pytest.raises(FormatError, match="one row for each node"):
        read_grid(tmp_path / "a.csv")
