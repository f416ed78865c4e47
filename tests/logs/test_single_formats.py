"""Test properties of single formats: their layout, their limits, and third-party files."""

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from magbridge import logs
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError, WriteError
from magbridge.logs.deployment import deployment, join


def test_csv_is_as_plain_as_can_be(tmp_path: Path) -> None:
    dataset = deployment(
        "made", [1.5, 2], {"mag_x": [1, np.nan], "battpos": [0.1, 2], "quality": [0, 3]}, {"battpos": "in"}
    )
    logs.write(dataset, tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines() == [
        "time,mag_x,battpos [in],quality",
        "1.5,1.0,0.1,",
        "2.0,,2.0,stale_telemetry extrapolated",
    ]


def test_csv_opens_elsewhere_and_keeps_its_attributes(tmp_path: Path) -> None:
    attrs = {"heading_reference": "magnetic", "align.lag": 0.5, "history": "made\nand corrected"}
    columns = {"heading": [10.0, 20.0], "pump": [1.0, 2.0]}
    logs.write(deployment("made", [1.5, 2], columns, {"pump": "A"}, attrs), tmp_path / "a.csv")
    theirs = pd.read_csv(tmp_path / "a.csv")
    assert list(theirs.columns) == ["time", "heading [deg magnetic]", "pump [A]"]
    assert {name: logs.read(tmp_path / "a.csv").attrs[name] for name in attrs} == attrs
    (tmp_path / "a.csv").rename(tmp_path / "moved.csv")
    assert logs.read(tmp_path / "moved.csv").attrs["heading_reference"] == "magnetic"
    (tmp_path / "moved.csv-metadata.json").write_text("{")
    with pytest.raises(FormatError, match=r"moved\.csv-metadata\.json: expected the metadata of a CSV file"):
        logs.read(tmp_path / "moved.csv")


@pytest.mark.parametrize("heading", ["Magnetic heading", "heading [deg, magnetic]", "heading (magnetic)"])
def test_csv_heading_says_what_it_refers_to(heading: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f'time,"{heading}"\n1,2\n')
    log = logs.read(tmp_path / "a.csv")
    assert (log.attrs["heading_reference"], float(log["heading"][0])) == ("magnetic", 2.0)


@pytest.mark.parametrize("rows", [1, 1000])
def test_csv_says_which_number_stands_for_none(rows: int, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "# fill_value = -9999\ntime,mag_x,pump [A],latitude\n1,-9999.0,2,50\n2,-9998,-9999,-9999\n"
    )
    read = join(list(logs.read_chunks(path, rows)))
    np.testing.assert_array_equal(read["mag_x"], [np.nan, -9998.0])
    np.testing.assert_array_equal(read["pump"], [2.0, np.nan])
    np.testing.assert_array_equal(read["latitude"], [50.0, np.nan])
    assert "fill_value" not in read.attrs


@pytest.mark.parametrize("og1", [False, True])
def test_netcdf_has_the_documented_names_or_those_of_og1(og1: bool, tmp_path: Path) -> None:
    names = ("latitude", "longitude", "depth", "mag_x", "battpos")
    log = deployment("made", 1_466_705_388.25 + np.arange(5.0), dict.fromkeys(names, np.ones(5)))
    options: Any = {"og1": True} if og1 else {}
    with logs.Writer(tmp_path / "a.nc", None, **options) as writer:
        writer.append(log)

    def written(name: str) -> str:
        return name.upper() if og1 else name

    with netCDF4.Dataset(tmp_path / "a.nc") as file:
        assert file.dimensions["N_MEASUREMENTS" if og1 else "time"].isunlimited()
        assert set(map(written, (*names, "time", "trajectory"))) == set(file.variables)
        assert file[written("time")].units == "seconds since 1970-01-01T00:00:00Z"
        assert file[written("trajectory")].cf_role == "trajectory_id"
        assert file.featureType == "trajectory"
        assert file.time_coverage_start == "20160623T180948"
        assert file[written("latitude")].standard_name == "latitude"
    assert set(logs.read(tmp_path / "a.nc").data_vars) == set(names)


@pytest.mark.parametrize("suffix", [".nc", ".csv", ".tlog", ".parquet"])
def test_a_deployment_with_decoded_times_is_written_as_one_with_seconds(suffix: str, tmp_path: Path) -> None:
    time = 1_466_705_388.0 + 0.25 * np.arange(5.0)
    log = deployment("made", time, {"mag_x": np.ones(5), "mag_time_x": time + 0.125})
    logs.write(log, tmp_path / "seconds.nc")
    with xr.open_dataset(tmp_path / "seconds.nc") as theirs:
        decoded = theirs.drop_vars("trajectory").load()
    assert decoded["time"].dtype.kind == "M"
    ours = logs.read(tmp_path / "seconds.nc", decode_times=True)
    apart = np.abs(ours["time"].to_numpy() - decoded["time"].to_numpy())
    assert apart.max() < np.timedelta64(1, "us")  # xarray computes in float64
    assert ours["mag_time_x"].dtype.kind == "M"
    for dataset in (decoded, ours):
        logs.write(dataset, tmp_path / f"out{suffix}")
        back = logs.read(tmp_path / f"out{suffix}")
        np.testing.assert_allclose(back["time"], time, atol=1e-6)
        np.testing.assert_allclose(back["mag_time_x"], time + 0.125, atol=1e-6)


@pytest.mark.parametrize(
    ("units", "calendar", "first"),
    [
        ("milliseconds since 1970-01-01", "", 1.6e12),
        ("days since 1950-01-01T00:00:00Z", "gregorian", 25_823.5185185185),
        ("hours since 2020-09-13 14:26:40 +02:00", "", 0.0),
        ("days since 0001-01-01", "proleptic_gregorian", 737_680.5185185185),
        ("days since 0001-01-01", "", 737_682.5185185185),  # CF's calendar is the Julian one before 1582
    ],
)
def test_netcdf_counts_time_from_any_date(units: str, calendar: str, first: float, tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "a.nc", "w") as file:
        file.createDimension("N_MEASUREMENTS", 1)
        time = file.createVariable("TIME", "f8", ("N_MEASUREMENTS",))
        time.units, time[:] = units, first
        if calendar:
            time.calendar = calendar
    assert float(logs.read(tmp_path / "a.nc")["time"][0]) == pytest.approx(1.6e9, abs=1e-4)


def test_og1_file_of_someone_else(tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "a.nc", "w") as file:
        file.createDimension("N_MEASUREMENTS", 3)
        for name, dtype, values, fill, attrs in (
            ("TIME", "f8", [0, 60, 120], -1.0, {"units": "minutes since 2020-01-01"}),
            ("LATITUDE", "f8", [50, -9999.9, 51], -9999.9, {"units": "degrees_north"}),
            ("DEPTH", "f4", [-0.02, 5, 6], None, {"units": "metres", "valid_min": np.float32(0)}),
            ("TEMP", "f4", [10, 11, 12], -9999.9, {"units": "Celsius"}),
            ("PHASE", "i1", [1, 2, 2], 0, {}),
            ("FLAG", "i1", [1, -127, 2], None, {}),
            ("BALLAST", "f4", [10, -999, 12], None, {"missing_value": np.float32(-999)}),
            ("PACKED", "i2", [100, -32767, 300], None, {"scale_factor": 0.01, "add_offset": 1.0}),
        ):
            file.createVariable(name, dtype, ("N_MEASUREMENTS",), fill_value=fill).setncatts(attrs)
            file[name].set_auto_maskandscale(False)
            file[name][:] = np.array(values)
        file.createVariable("DEPLOYMENT_TIME", "f8", ())[...] = 5
        file.createVariable("NEVER_WRITTEN", "f4", ("N_MEASUREMENTS",))
    back = logs.read(tmp_path / "a.nc")
    np.testing.assert_array_equal(back["time"], 1577836800 + np.array([0, 3600, 7200]))
    np.testing.assert_array_equal(back["latitude"], [50, np.nan, 51])
    np.testing.assert_allclose(back["depth"], [-0.02, 5, 6], rtol=1e-6)
    assert back["water_temperature"].attrs["units"] == "Celsius"
    np.testing.assert_array_equal(back["phase"], [1, 2, 2])
    np.testing.assert_array_equal(back["flag"], [1, -127, 2])
    np.testing.assert_array_equal(back["ballast"], [10, np.nan, 12])
    np.testing.assert_allclose(back["packed"], [2, np.nan, 4])
    assert back["never_written"].isnull().all()
    assert back["latitude"].attrs["units"] == "deg"


def test_netcdf_packed_by_words_is_one_line(tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "a.nc", "w") as file:
        file.createDimension("N_MEASUREMENTS", 1)
        file.createVariable("TIME", "f8", ("N_MEASUREMENTS",)).units = "seconds since 1970-01-01"
        file["TIME"][:] = 1.0
        file.createVariable("PUMP", "i2", ("N_MEASUREMENTS",)).scale_factor = "one"
    with pytest.raises(FormatError, match=r"a.nc: column 'PUMP': expected numbers as scale_factor"):
        logs.read(tmp_path / "a.nc")


@pytest.mark.parametrize("suffix", ["tlog", "mcap"])
def test_a_format_of_unsigned_stamps_refuses_times_before_1970(suffix: str, tmp_path: Path) -> None:
    log = deployment("made", [-2.0, -1.0], {name: [1.0, 2.0] for name in CHANNELS})
    with pytest.raises(WriteError, match=rf"log\.{suffix}: cannot be written: .* no times before 1970"):
        logs.write(log, tmp_path / f"log.{suffix}")


def test_an_attribute_whose_name_netcdf_forbids_is_left_out(tmp_path: Path) -> None:
    logs.write(deployment("made", [1.0], {}, attrs={"telemetry.a/b.max_age": 3.0}), tmp_path / "log.nc")
    assert logs.read(tmp_path / "log.nc").attrs.keys() == {"source", "history", "time_reference"}


def test_any_longitude_and_any_count_fit_a_telemetry_log(tmp_path: Path) -> None:
    """302 degrees are -58: as 32 bits of 1e-7 deg they would not fit."""
    east = np.array([-58.0, 0.0, 58.0, 179.5, 180.5, 200.0, 302.0, np.nan])
    columns = {"mag_x": np.ones(8), "latitude": np.where(np.isnan(east), np.nan, 49.5), "longitude": east}
    columns["power_cycle"] = np.array([3.0, np.inf, -1e300, *[np.nan] * 5])
    logs.write(deployment("made", np.arange(8.0), columns), tmp_path / "log.tlog")
    read = logs.read(tmp_path / "log.tlog")
    np.testing.assert_allclose(read["longitude"][:7], (east[:7] + 180.0) % 360.0 - 180.0, atol=2e-7)
    np.testing.assert_array_equal(read["power_cycle"], [3.0, *[np.nan] * 7])


def test_geosoft_xyz_keeps_its_lines(tmp_path: Path) -> None:
    row = "-122.0 37.9 2021/03/04 10:00:0{}.00 4850{} {}\n"
    path, again = tmp_path / "lines.xyz", tmp_path / "again.xyz"
    path.write_text(
        "/ LONGITUDE LATITUDE DATE TIME MAG ALT\n/====\nLine 100\n"
        + "".join(row.format(k, k, 100.0) for k in range(3))
        + "Tie L9000\n"
        + "".join(row.format(k, k, "*") for k in range(3, 6))
        + "LINE A1\n"
        + row.format(6, 6, 1.0)
    )
    log = logs.read(path)
    assert log["line"].to_numpy().tolist() == [100.0] * 3 + [9000.0] * 3 + [1_000_002.0]
    assert np.isnan(log["depth"].to_numpy()).tolist() == [False] * 3 + [True] * 3 + [False]
    logs.write(log.assign(quality=("time", [1.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0])), again)
    assert again.read_text().splitlines()[:2] == [
        "/ time,longitude,latitude,total_field,depth,quality", "LINE 100"
    ]  # fmt: skip
    back = logs.read(again)
    for name in log.variables:
        assert np.array_equal(log[name].to_numpy(), back[name].to_numpy(), equal_nan=True), name
    assert back["quality"].to_numpy().tolist()[:3] == [1.0, 3.0, 0.0]
