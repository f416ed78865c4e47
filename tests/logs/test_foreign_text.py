"""Test third-party text files: the reader finds and reports their meaning, or rejects them."""

from __future__ import annotations

import bz2
import gzip
import lzma
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs import Options
from magbridge.logs.deployment import passed_over

NOON = 1_651_665_600.0  # 2022-05-04T12:00:00Z
GPS = NOON - 315_964_800 + 18


def read(tmp_path: Path, text: str | bytes, name: str = "log.csv", **options: Any) -> xr.Dataset:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return logs.read(path, options=Options(**options))


STAMPS = {
    "a date of digits": ("date,time", "20220504,120000.5", "20220504,120001.5"),
    "an ISO date, digits": ("Date,UTC", "2022-05-04,120000.50", "2022-05-04,120001.50"),
    "seconds of the day": ("date,timeofday", "20220504,43200.5", "20220504,43201.5"),
    "the month's name": ("Date,Time", "04-May-2022,12:00:00.5", "04-May-2022,12:00:01.5"),
    "two digits of the year": ("Date,Time", "31.05.22,12:00:00.5", "31.05.22,12:00:01.5"),
    "a comma's fraction": ("Datum;Uhrzeit", "04.05.2022;12:00:00,5", "04.05.2022;12:00:01,5"),
    "a colon's fraction": ("date,time", "2022-05-04,12:00:00:500", "2022-05-04,12:00:01:500"),
    "fourteen digits": ("timestamp", "20220504120000.5", "20220504120001.5"),
    "digits on either side": ("time", "20220504_120000.5", "20220504T120001.5"),
    "a day of the year": ("time", "2022-124T12:00:00.5", "2022-124T12:00:01.5"),
    "a C program's": ("time", "Wed May  4 12:00:00 2022", "Wed May  4 12:00:01 2022"),
    "six columns": ("year,month,day,hour,min,sec", "2022,5,4,12,0,0.5", "2022,5,4,12,0,1.5"),
    "the day in five": ("YYYY,DOY,hh,minute,ss", "2022,124,12,0,0.5", "2022,124,12,0,1.5"),
    "ROS 2": ("header.stamp.sec,header.stamp.nanosec", f"{NOON:.0f},500000000", f"{NOON + 1:.0f},500000000"),
    "ROS 1": ("%time,field.header.seq", f"{NOON * 1e9 + 5e8:.0f},1", f"{NOON * 1e9 + 15e8:.0f},2"),
    "GPS week": ("GPS Week,TOW [s]", f"2208,{GPS % 604800 + 0.5}", f"2208,{GPS % 604800 + 1.5}"),
    "GPS week, ms": (
        "GWk,GMS",
        f"2208,{GPS % 604800 * 1e3 + 500:.0f}",
        f"2208,{GPS % 604800 * 1e3 + 1500:.0f}",
    ),
    "a spreadsheet's days": ("Date", f"{44_685.5 + 0.5 / 86_400:.9f}", f"{44_685.5 + 1.5 / 86_400:.9f}"),
    "days under our name": ("time", f"{44_685.5 + 0.5 / 86_400:.9f}", f"{44_685.5 + 1.5 / 86_400:.9f}"),
    "a heading of its own": (
        "loggingTime(txt)",
        "2022-05-04T09:30:00.5-02:30",
        "2022-05-04T09:30:01.5-02:30",
    ),
}


@pytest.mark.parametrize("kind", STAMPS)
def test_times_that_stand_in_many_ways(kind: str, tmp_path: Path) -> None:
    header, first, second = STAMPS[kind]
    separator = ";" if ";" in header else ","
    rows = [f"{stamp}{separator}{value}" for stamp, value in ((first, 30_000), (second, 30_001))]
    log = read(tmp_path, "\n".join([f"{header}{separator}mag_x", *rows]) + "\n")
    expected = NOON + (27 * 86_400 if "31.05" in first else 0) + np.array([0.5, 1.5])
    whole = kind == "a C program's"
    np.testing.assert_allclose(log["time"], np.floor(expected) if whole else expected, atol=2e-3)
    assert log["mag_x"].values.tolist() == [30_000.0, 30_001.0]
    assert "time_reference" not in log.attrs


SINCE_A_START = {
    "time_ms": ("100", "200"),
    "TimeUS": ("100000", "200000"),
    "Elapsed Time (s)": ("0.1", "0.2"),
    "Millis": ("100", "200"),
    "timestamp (ns)": ("100000000", "200000000"),
}


@pytest.mark.parametrize("heading", SINCE_A_START)
def test_counts_since_a_start_by_their_heading(heading: str, tmp_path: Path) -> None:
    first, second = SINCE_A_START[heading]
    log = read(tmp_path, f"{heading},mag_x\n{first},1\n{second},2\n")
    np.testing.assert_allclose(log["time"], [0.1, 0.2])
    assert log.attrs["time_reference"] == "boot"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "timestamp,mag_x\n3000000,1\n4000000,2\n",
            r'in a unit that .* tell: --column time="timestamp \[ms\]" or',
        ),
        ("timestamp,mag_x\n98765432100000,1\n98765442100000,2\n", r"a count with steps of 1e\+07"),
        ("date,time,mag_x\n040522,120000,1\n040522,120001,2\n", r"year first\?.* \[%d%m%y %H%M%S\]\" or "),
        ("time,mag_x\n9,1\n8,2\n7,3\n6,4\n", "they run backwards: sort the rows by time"),
        (
            "time,mag_x\n" + "1,1\n" * 9 + "2,1\n" * 9,
            "9 have the same: if in whole seconds, give the rate",
        ),
        ("date,time,mag_x\n04/05/22,12:00:00,1\n", r"day or month first\? '04/05/22 12:00:00'"),
    ],
)
def test_times_that_may_be_this_or_that_are_asked_about(text: str, expected: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=expected):
        read(tmp_path, text)


def test_the_answer_is_heeded(tmp_path: Path) -> None:
    text = "date,time,mag_x\n040522,120000,1\n040522,120001,2\n"
    log = read(tmp_path, text, column=["time=time [%d%m%y %H%M%S]"])
    assert log["time"].values.tolist() == [NOON, NOON + 1]


def test_columns_without_headings_may_be_declared_as_parts_of_a_time(tmp_path: Path) -> None:
    """As LEMI's fluxgates write: year, month, day, hour, minute, second, the field."""
    rows = "".join(f"2022 05 04 12 00 0{k} 20500.0 -10250.0 45000.0 21.1\n" for k in range(3))
    names = ["year", "month", "day", "hour", "minute", "second", "mag_x", "mag_y", "mag_z"]
    log = read(tmp_path, rows, "lemi.txt", column=[f"{name}=column_{k}" for k, name in enumerate(names, 1)])
    assert log["time"].values.tolist() == [NOON, NOON + 1, NOON + 2]
    assert log["mag_y"].values.tolist() == [-10_250.0] * 3


def test_times_of_day_go_on_after_midnight(tmp_path: Path) -> None:
    stamps = pd.date_range("2022-05-04T23:59:50", periods=2000, freq="60s").strftime("%H:%M:%S")
    log = read(tmp_path, "time,mag_x\n" + "".join(f"{stamp},1\n" for stamp in stamps))
    np.testing.assert_allclose(np.diff(log["time"]), 60.0)
    pieces = logs.read_chunks(tmp_path / "log.csv", rows=7)
    np.testing.assert_array_equal(np.concatenate([piece["time"] for piece in pieces]), log["time"])


AXES = {
    "its length, uT": "time,mag_x,mag_y,mag_z\n1.6e9,20.5,-10.25,45\n",
    "its length, mG": "timestamp,RAW_IMU.xmag,RAW_IMU.ymag,RAW_IMU.zmag\n1.6e9,205,-102.5,450\n",
    "its length, T": "__time,/imu/magnetic_field/x,/imu/magnetic_field/y,/imu/magnetic_field/z\n"
    "1.6e9,2.05e-5,-1.025e-5,4.5e-5\n",
    "one axis": "time,Mag_X (uT),Mag_Y,Mag_Z\n1.6e9,20.5,-10.25,45\n",
    "written out": "time,X (micro-Teslas),Y (micro-Teslas),Z (micro-Teslas)\n1.6e9,20.5,-10.25,45\n",
    "mGauss": "time,MagX (mGauss),MagY (mGauss),MagZ (mGauss)\n1.6e9,205,-102.5,450\n",
    "each its own": "time,mag_x [uT],mag_y [mG],mag_z [nT]\n1.6e9,20.5,-102.5,45000\n",
    "behind a comma": "time;Bx, uT;By, uT;Bz, uT\n1.6e9;20.5;-10.25;45\n",
    "Fortran": "time,mag_x,mag_y,mag_z\n1.6D+09,2.05D+04,-1.025D+04,4.5D+04\n",
    "thousands": 'time,mag_x,mag_y,mag_z\n1.6e9,"20,500","-10,250.0","45,000.00"\n',
    "German thousands": "time;mag_x [nT];mag_y [nT];mag_z [nT]\n1600000000;20.500;-10.250;45.000,00\n",
    "PX4": "timestamp,device_id,magnetometer_ga[0],magnetometer_ga[1],magnetometer_ga[2]\n"
    "5000000,7,0.205,-0.1025,0.45\n5100000,7,0.205,-0.1025,0.45\n",
    "PX4's sensor": "timestamp,device_id,x,y,z,error_count\n5000000,7,0.205,-0.1025,0.45,0\n",
    "Geosoft": "/ XYZ EXPORT\n/\n/ Date UTCTime FluxX FluxY FluxZ Mag\n/=== ====== ==== ==== ==== ====\n"
    "Line L100:0\n"
    "2022/05/04 12:00:00.0 20500 -10250 45000 *\nTie 7\n2022/05/04 12:00:01.0 20500 -10250 45000 5e4\n",
}


@pytest.mark.parametrize("kind", AXES)
def test_the_axes_are_in_nanotesla(kind: str, tmp_path: Path) -> None:
    log = read(tmp_path, AXES[kind], "log.txt")
    axes = np.column_stack([log[f"mag_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(axes, np.broadcast_to([20_500.0, -10_250.0, 45_000.0], axes.shape))
    assert "rows_dropped" not in log.attrs


def test_a_field_of_another_length_in_our_own_file_is_as_it_is(tmp_path: Path) -> None:
    """In a shielded room; a third-party file has no unit, ours are in nanotesla."""
    shielded = read(tmp_path, "time,mag_x [nT],mag_y [nT],mag_z [nT]\n1.6e9,20.5,-10.25,45\n")
    logs.write(shielded, tmp_path / "again.csv")
    assert float(logs.read(tmp_path / "again.csv")["mag_z"][0]) == 45.0


@pytest.mark.parametrize("code", ["99999", "-9999", "1e31", "-1.0e+34", "88888.88", "-999.25", "32767"])
def test_a_code_for_not_known_is_not_a_value(code: str, tmp_path: Path) -> None:
    rows = [f"{NOON + k},{500 * k},{-300 * k},{45_000 + k},{0.1 * (k % 3)}" for k in range(20)]
    rows[5] = f"{NOON + 5},{code},{code},{code},0.1"
    rows[8] = f"{NOON + 8},4000,-2400,45008,{code}"
    log = read(tmp_path, "\n".join(["time,mag_x,mag_y,mag_z,battpos [in]", *rows]) + "\n")
    for name, row in (("mag_x", 5), ("mag_y", 5), ("mag_z", 5), ("battpos", 8)):
        assert np.flatnonzero(np.isnan(log[name])).tolist() == [row], name
    assert log.attrs["values_dropped"] == 4
    assert "row 7, column 'mag_x': expected a value, or nothing where it is not known" in log.attrs["losses"]


def test_codes_in_the_netcdf_and_parquet_of_other_programs(tmp_path: Path) -> None:
    axes = {f"mag_{axis}": ("time", [20_000.0, -9999.0, -15_000.0]) for axis in "xyz"}
    time = xr.DataArray([NOON, NOON + 1, NOON + 2], dims="time", attrs={"units": "seconds since 1970-01-01"})
    theirs = xr.Dataset(axes, {"time": time})
    theirs.to_netcdf(tmp_path / "a.nc", encoding={name: {"_FillValue": None} for name in axes})
    theirs.to_dataframe().reset_index().to_parquet(tmp_path / "a.parquet")
    for name in ("a.nc", "a.parquet"):
        log = logs.read(tmp_path / name)
        assert np.isnan(log["mag_z"].values).tolist() == [False, True, False]
        assert "column 'mag_z': expected a value, or nothing where it is not known" in log.attrs["losses"]


def test_validity_columns_of_netcdf_and_parquet(tmp_path: Path) -> None:
    columns = {"TMI": 50_000.0 + np.arange(6), "MagValid": [1, 1, 0, 1, 1, 1], "Valid": [1, 1, 1, 1, 0, 1]}
    time = xr.DataArray(NOON + np.arange(6), dims="time", attrs={"units": "seconds since 1970-01-01"})
    theirs = xr.Dataset({name: ("time", np.asarray(values, float)) for name, values in columns.items()})
    theirs = theirs.rename(TMI="total_field").assign_coords(time=time)
    theirs.to_netcdf(tmp_path / "a.nc")
    theirs.to_dataframe().reset_index().to_parquet(tmp_path / "a.parquet")
    for name in ("a.nc", "a.parquet"):
        log = logs.read(tmp_path / name)
        assert (log["time"].values - NOON).tolist() == [0, 1, 2, 3, 5]
        assert np.isnan(log["total_field"].values).tolist() == [False, False, True, False, False]
        assert passed_over(log.attrs) == {"rows_dropped": 1, "values_dropped": 1}
        assert "row 5: not valid by 'valid'" in log.attrs["losses"].lower()


def test_a_field_of_nothing_is_none_and_one_axis_at_0_is(tmp_path: Path) -> None:
    rows = [f"{NOON + k},{20_000 * (k % 3 - 1)},0,45000" for k in range(20)]
    rows[5] = f"{NOON + 5},0,0,0"
    rows[6] = f"{NOON + 6},-9999,0,45000"  # among the others: may be one
    log = read(tmp_path, "\n".join(["time,mag_x,mag_y,mag_z", *rows]) + "\n")
    assert np.flatnonzero(np.isnan(log["mag_x"])).tolist() == [5]
    assert float(log["mag_x"][6]) == -9999.0


def test_a_column_that_is_mostly_unknown_costs_no_more_than_itself(tmp_path: Path) -> None:
    """A CTD that was switched off, a receiver that never had a fix."""
    rows = [f"{NOON + k},0,0,{30_000 + k},{-9999 if k else 12.5},-9999" for k in range(20)]
    log = read(tmp_path, "\n".join(["time,lat,lon,mag_x,ctd,air [degC]", *rows]) + "\n")
    assert log.sizes["time"] == 20
    assert not np.isfinite(log["air"].values).any()
    assert int(np.isfinite(log["ctd"].values).sum()) == 1
    assert not np.isfinite(log["latitude"].values).any()


def test_a_place_at_0_0_is_a_receiver_without_a_fix(tmp_path: Path) -> None:
    log = read(tmp_path, "time,lat,lon\n1600000000,0,0\n1600000001,0,9.5\n1600000002,47.5,0\n")
    assert np.isnan(log["latitude"].values).tolist() == [True, False, False]
    assert np.isnan(log["longitude"].values).tolist() == [True, False, False]


PLACES = {
    "a telephone's": ("locationLatitude(WGS84),locationLongitude(WGS84)", "47.5,-52.75", "47.5,-52.75"),
    "a receiver's": ("GPS_Lat,GPS_Lon", "47.5,-52.75", "47.5,-52.75"),
    "with their unit": ("latitude_deg,longitude_dd", "47.5,-52.75", "47.5,-52.75"),
    "columns of letters": ("lat,NS,lon,EW", "47.5,N,52.75,W", "47.5,N,52.75,W"),
    "letters behind": ("lat,lon", "47.5N,52.75W", "47.5 N,52.75 W"),
    "letters before": ("latitude,longitude", "N47.5,W52.75", "N 47.5,W 52.75"),
    "a sign beside": ("latitude,longitude", "47.5,-52.75", "47.5,-52.75 W"),
    "an exponent beside": ("latitude,longitude", "47.5,-5.275E+01", "47.5N,52.75W"),
}


@pytest.mark.parametrize("kind", PLACES)
def test_west_is_west(kind: str, tmp_path: Path) -> None:
    header, *rows = PLACES[kind]
    log = read(
        tmp_path, f"time,{header}\n" + "".join(f"{1600000000 + k},{row}\n" for k, row in enumerate(rows))
    )
    assert log["latitude"].values.tolist() == [47.5, 47.5]
    assert log["longitude"].values.tolist() == [-52.75, -52.75]


def test_a_place_without_its_hemisphere_is_not_known(tmp_path: Path) -> None:
    log = read(tmp_path, "time,lat,NS,lon,EW\n1600000000,47.5,N,52.7,W\n1600000001,47.5,N,52.7,\n")
    np.testing.assert_array_equal(log["longitude"], [-52.7, np.nan])
    assert "row 3, column 'longitude': expected E or W beside it" in log.attrs["losses"]


@pytest.mark.parametrize("cell", ["", "345600 7 8"])
def test_a_time_in_two_columns_that_is_none_is_a_line(cell: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"row 2, column 'time': expected a"):
        read(tmp_path, f"GPS Week,TOW,mag_x\n{'2208' if cell else ''},{cell},1\n")


def test_what_proton_magnetometers_write_is_the_total_field(tmp_path: Path) -> None:
    magmap = "X Y READING_1 TIME DATE LINE MARK\n0.5 0 50905.7 12:00:00.25 05/04/22 0 1\n"
    bob = "/ BOB\nReading_Date,Reading_Time,Field,Depth\n2022-05-04,12:00:00.250,50905.7,3\n"
    gem = "/Gem Systems GSM-19WV\n/ID 1 file 01survey.wmv 04 V 22\n/X Y nT sq cor-nT time\nline  0.00\n"
    gem += "0372.36  5262.88  50905.70 99 0.00 120000.25\n0372.36  5262.88  50905.70 99 0.00 120100.25\n"
    base = "Timestamp,F [uT]\n2022-05-04 12:00:00.25,50.9057\n"
    for name, text in {"m.dat": magmap, "b.csv": bob, "g.txt": gem, "f.csv": base}.items():
        log = read(tmp_path, text, name)
        assert float(log["total_field"][0]) == pytest.approx(50_905.7)
        assert float(log["time"][0]) % 86_400.0 == pytest.approx(43_200.25)


@pytest.mark.parametrize(
    "text",
    [
        "time,F,Mag\n1.6e9,50000,50001\n",  # which?
        "time,F [V]\n1.6e9,50000\n",
        "time,Bz [nT]\n1.6e9,45000\n",
        "time,residual [nT]\n1.6e9,-12\n",
        "time,mag_x,mag_y,mag_z,F\n1.6e9,30000,0,40000,50000\n",  # its own sensor's length, perhaps
    ],
)
def test_what_may_be_no_total_field_is_none(text: str, tmp_path: Path) -> None:
    assert "total_field" not in read(tmp_path, text)


def test_a_name_may_stand_twice_and_a_column_have_none(tmp_path: Path) -> None:
    """As pandas writes its index, and a sheet that has two thermometers."""
    log = read(tmp_path, ",time,temp,mag_x,temp,\n0,1600000000,20,30000,21,\n1,1600000001,20,30000,21,\n")
    assert (log["temp"].values.tolist(), log["temp_5"].values.tolist()) == ([20, 20], [21, 21])
    assert log["mag_x"].values.tolist() == [30_000.0, 30_000.0]
    assert "left out, no heading: column 1, 6" in log.attrs["guessed"]


PLAIN = b"time,mag_x\n# a remark\n1600000000,1\n% another, with a comma\n1600000001,2\n"


@pytest.mark.parametrize(
    ("name", "packed"),
    [
        ("log.csv.gz", gzip.compress(PLAIN, mtime=0)),
        ("log.txt.bz2", bz2.compress(PLAIN)),
        ("log.csv.xz", lzma.compress(PLAIN)),
        ("packed.csv", gzip.compress(PLAIN, mtime=0)),
        ("wide.csv", PLAIN.decode().encode("utf-16-le")),
    ],
)
def test_compressed_text_is_read(name: str, packed: bytes, tmp_path: Path) -> None:
    log = read(tmp_path, packed, name)
    assert log["mag_x"].values.tolist() == [1.0, 2.0]
    assert "rows_dropped" not in log.attrs


@pytest.mark.parametrize(
    ("name", "start", "expected"),
    [
        ("book.xlsx", b"PK\x03\x04", "a spreadsheet, or an archive: save it as CSV, or unpack it"),
        ("book.csv", b"PK\x03\x04", "a spreadsheet, or an archive"),
        ("log.csv.zst", b"\x28\xb5\x2f\xfd\0", "it is compressed: unpack it first"),
        (
            "flight.BIN.gz",
            gzip.compress(b"\xa3\x95\x80\x80" * 9, mtime=0),
            "it is compressed: unpack it first",
        ),
        ("log.csv.gz", gzip.compress(PLAIN, mtime=0)[:-9], "expected a whole compressed file|cannot be read"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "save it as CSV"),
        ("a.csv", b"<!DOCTYPE html><html>", "a document, no table"),
        ("a.csv", b'{"time": 1}\n', "JSON: save it as CSV"),
        ("a.txt", b"OTT MAY0422 124 12 XYZF R OTT 04462844 000000", "ask for IAGA-2002"),
        ("a.dat", bytes(range(200)), "expected text, the file is binary"),
    ],
)
def test_a_file_that_is_not_text_is_named_by_its_kind(
    name: str, start: bytes, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=expected):
        read(tmp_path, start, name)


def test_parquet_of_other_programs(tmp_path: Path) -> None:
    stamps = pd.date_range("2022-05-04T12:00", periods=3, freq="1s", tz="America/St_Johns")
    axes = {f"B{axis} [uT]": [20.5] * 3 for axis in "xyz"}
    frame = pd.DataFrame({"Timestamp": stamps, **axes, "note": "x"})
    for times in (stamps, stamps.strftime("%Y-%m-%dT%H:%M:%S%z"), stamps.astype("int64") // 10**3):
        frame.assign(Timestamp=times).to_parquet(tmp_path / "log.parquet")
        log = logs.read(tmp_path / "log.parquet")
        assert log["time"].values.tolist() == [NOON + 9_000 + k for k in range(3)]
        assert log["mag_x"].values.tolist() == [20_500.0] * 3
        assert "left out, no numbers: note" in log.attrs["guessed"]
    frame.drop(columns="Timestamp").to_parquet(tmp_path / "none.parquet")
    with pytest.raises(FormatError, match="expected this column; there are: 'Bx"):
        logs.read(tmp_path / "none.parquet")


def test_parquet_of_other_programs_with_letters_next_to_its_places_and_a_time_in_two_columns(
    tmp_path: Path,
) -> None:
    columns = {"date": [*["2022-05-04"] * 3, None], "time": [f"12:00:0{k}" for k in range(4)]}
    places = {"lat": 47.5, "NS": "S", "lon": 52.75, "EW": ["W", None, "E", "W"]}
    pd.DataFrame(columns | places).to_parquet(tmp_path / "a.parquet")
    log = logs.read(tmp_path / "a.parquet")
    assert log["time"].values.tolist() == [NOON, NOON + 1, NOON + 2]
    assert log["latitude"].values.tolist() == [-47.5] * 3
    np.testing.assert_array_equal(log["longitude"], [-52.75, np.nan, 52.75])


def test_a_slocums_text(tmp_path: Path) -> None:
    """What dbd2asc writes: tags, names, units, sizes, then a cycle a line."""
    tags = "dbd_label: DBD_ASC(dinkum_binary_data_ascii)file\nencoding_ver: 2\nnum_ascii_tags: 14\n"
    head = "m_battpos m_depth m_heading m_lat m_present_time\nin m rad lat timestamp\n4 4 4 8 8\n"
    rows = [f"0.25 {k} 1.5707963267948966 4730.0 {NOON + k}" for k in range(5)]
    rows[2] = f"NaN 2 NaN 69696969 {NOON + 2}"
    log = read(tmp_path, tags + head + " \n".join(rows) + "\n", "unit.dba")
    np.testing.assert_allclose(log["time"], NOON + np.arange(5))
    np.testing.assert_allclose(log["latitude"], 47.5)
    np.testing.assert_allclose(log["heading"], 90.0)
    np.testing.assert_allclose(log["depth"], np.arange(5))
    with pytest.raises(FormatError, match="expected names, units, sizes and rows"):
        read(tmp_path, tags + head[:60], "cut.dba")
