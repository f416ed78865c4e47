"""Test text files of other programs: the reader finds and reports what columns mean, or rejects the file."""

import bz2
import gzip
import lzma
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from texts import NOON, lines, read

from magbridge import logs
from magbridge.columns import COLUMNS
from magbridge.errors import ConfigError, FormatError, WrongUse
from magbridge.logs import Options
from magbridge.logs.deployment import from_frame, passed_over
from magbridge.logs.info import info
from magbridge.logs.mapping import split

HEADER = "time,mag_x [nT],mag_y [nT],mag_z [nT]"


# ---- layouts ----------------------------------------------------------------------------------------------


def table(header: str, separator: str = ",", decimal: str = ".", end: str = "\n", quote: str = "") -> str:
    """Return `header`, and two rows of a time, 30.5 uT and 1.25 or -1.25 in."""
    rows = [["1600000000", "30.5", "1.25"], ["1600000001", "30.5", "-1.25"]]
    written = [[f"{quote}{cell.replace('.', decimal)}{quote}" for cell in row] for row in rows]
    return header + "\n" + "".join(separator.join(row) + end for row in written)


LAYOUTS: dict[str, str | bytes] = {
    "semicolons, decimal commas": table("time;mag_x [uT];battpos [in]", ";", ","),
    "tabs": table("time\tmag_x [uT]\tbattpos [in]", "\t"),
    "blanks": table("time mag_x_uT battpos(in)", "   "),
    "quotes": table('"time","mag_x [uT]","battpos [in]"', quote='"'),
    "parentheses": table("time,mag_x (uT),battpos (in)"),
    "quoted decimal commas": table("time,mag_x [uT],battpos [in]", decimal=",", quote='"'),
    "a row of units": table("time,mag_x,battpos\ns,uT,in"),
    "commented headings": table("# a station\n# time, mag_x [uT], battpos [in]"),
    "a preamble": table("Logger 3\nSite;B\ntime;mag_x [uT];battpos [in]", ";"),
    "a separator at the end": table("time,mag_x [uT],battpos [in]", end=",\n"),
    "capitals": table("Time,MAG_X [uT],battpos [in]"),
    "a mark of the byte order": table("\ufefftime,mag_x [µT],battpos [in]"),
    "lines of another system": table("time,mag_x [µT],battpos [in]", end="\r\n"),
    "Latin": table("time,mag_x [µT],battpos [in]").encode("latin-1"),
    "16 bits a letter": table("time,mag_x [µT],battpos [in]").encode("utf-16"),
    "texts and booleans": (
        "time,mode,mag_x [uT],ok,battpos [in]\n1600000000,a,30.5,True,1.25\n1600000001,b,30.5,False,-1.25\n"
    ),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_whatever_the_layout_the_numbers_are_the_same(name: str, tmp_path: Path) -> None:
    log = read(tmp_path, LAYOUTS[name])
    np.testing.assert_array_equal(log["time"], [1.6e9, 1.6e9 + 1])
    np.testing.assert_allclose(log["mag_x"], 30_500.0, rtol=1e-15)
    np.testing.assert_array_equal(log["battpos"], [1.25, -1.25])
    assert log["battpos"].attrs["units"] == "in"
    assert "mode" not in log


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
        ("log.csv.zst", b"\x28\xb5\x2f\xfd\0", "it is compressed: unpack it first"),
        ("a.BIN.gz", gzip.compress(b"\xa3\x95\x80\x80" * 9, mtime=0), "it is compressed: unpack it first"),
        ("log.csv.gz", gzip.compress(PLAIN, mtime=0)[:-9], "expected a whole compressed file|cannot be read"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "save it as CSV"),
        ("a.csv", b"<!DOCTYPE html><html>", "a document, no table"),
        ("a.csv", b'{"time": 1}\n', "JSON: save it as CSV"),
        ("a.txt", b"OTT MAY0422 124 12 XYZF R OTT 04462844 000000", "ask for IAGA-2002"),
        ("a.txt", b"# \n# Header Description:\n# \n# UncalMag,utcTimeMillis\nUncalMag,1,2\n", "GnssLogger"),
        ("a.dat", bytes(range(200)), "expected text, the file is binary"),
    ],
)
def test_a_file_that_is_not_read_is_named_by_its_kind(
    name: str, start: bytes, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=expected):
        read(tmp_path, start, name)


def test_one_bad_row_costs_itself(tmp_path: Path) -> None:
    rows = [f"{1_600_000_000 + k},{k}" for k in range(20)]
    rows[3], rows[7], rows[11] = "1600000003", "1600000007,x", "later,1"
    text = "\n".join(["time,mag_x", *rows]) + "\n16000000"  # cut off in the middle of a row
    log = read(tmp_path, text)
    assert log.sizes["time"] == 18
    assert np.isnan(log["mag_x"][6])
    assert (log.attrs["rows_dropped"], log.attrs["values_dropped"]) == (3, 1)
    assert log.attrs["losses"].splitlines() == [
        f"{tmp_path}/log.csv: row 5: expected 2 fields, not 1",
        f"{tmp_path}/log.csv: row 13, column 'time': expected seconds since 1970, not 'later'",
        f"{tmp_path}/log.csv: row 9, column 'mag_x': expected a number, not 'x'",
    ]
    with pytest.raises(FormatError, match="row 5: expected 2 fields, not 1"):
        read(tmp_path, text, strict=True)


def test_a_name_may_stand_twice_and_a_column_have_none(tmp_path: Path) -> None:
    """As pandas writes its index, and a sheet that has two thermometers."""
    log = read(tmp_path, ",time,temp,mag_x,temp,\n0,1600000000,20,30000,21,\n1,1600000001,20,30000,21,\n")
    assert (log["temp"].values.tolist(), log["temp_5"].values.tolist()) == ([20, 20], [21, 21])
    assert log["mag_x"].values.tolist() == [30_000.0, 30_000.0]
    assert "left out, no heading: column 1, 6" in log.attrs["guessed"]


# ---- axes, fields and places ------------------------------------------------------------------------------


GREEK = "\N{GREEK SMALL LETTER MU}T"
AXES = {
    "its length, uT": "time,mag_x,mag_y,mag_z\n1.6e9,20.5,-10.25,45\n",
    "its length, mG": "timestamp,RAW_IMU.xmag,RAW_IMU.ymag,RAW_IMU.zmag\n1.6e9,205,-102.5,450\n",
    "its length, T": "__time,/imu/magnetic_field/x,/imu/magnetic_field/y,/imu/magnetic_field/z\n"
    "1.6e9,2.05e-5,1.025e-5,-4.5e-5\n",
    "one axis": "time,Mag_X (uT),Mag_Y,Mag_Z\n1.6e9,20.5,-10.25,45\n",
    "written out": "time,X (micro-Teslas),Y (micro-Teslas),Z (micro-Teslas)\n1.6e9,20.5,-10.25,45\n",
    "mGauss": "time,MagX (mGauss),MagY (mGauss),MagZ (mGauss)\n1.6e9,205,-102.5,450\n",
    "a Greek letter": f"time,Bx [{GREEK}],By [{GREEK}],Bz [{GREEK}]\n1.6e9,20.5,-10.25,45\n",
    "each its own": "time,mag_x [uT],mag_y [mG],mag_z [nT]\n1.6e9,20.5,-102.5,45000\n",
    "behind a comma": "time;Bx, uT;By, uT;Bz, uT\n1.6e9;20.5;-10.25;45\n",
    "Fortran": "time,mag_x,mag_y,mag_z\n1.6D+09,2.05D+01,-1.025D+01,4.5D+01\n",
    "thousands": 'time,mag_x,mag_y,mag_z\n1.6e9,"20,500","-10,250.0","45,000.00"\n',
    "German thousands": "time;mag_x [nT];mag_y [nT];mag_z [nT]\n1600000000;20.500;-10.250;45.000,00\n",
    "a remark in brackets": "time,Bx(raw),By(raw),Bz(raw)\n1.6e9,20500,-10250,45000\n",
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


@pytest.mark.parametrize("path", ["/imu/mag/magnetic_field/", "field.magnetic_field.", "magnetic_field."])
def test_ros_topics_in_a_table_are_turned_as_those_of_a_bag(path: str, tmp_path: Path) -> None:
    """PlotJuggler's and rostopic's tables are in FLU axes; a declared axis, or another program's, is not."""
    headings = [f"{path}{axis}" for axis in "xyz"]
    text = f"%time,{','.join(headings)}\n" + "1600000000000000000,2.05e-5,1.025e-5,-4.5e-5\n"
    log = read(tmp_path, text)
    axes = [log[f"mag_{axis}"].values[0] for axis in "xyz"]
    assert axes == pytest.approx([20_500.0, -10_250.0, 45_000.0])
    assert "ROS axes turned from FLU to FRD: mag_y, mag_z reversed" in log.attrs["guessed"]
    declared = [f"mag_{axis}={heading} [T]" for axis, heading in zip("xyz", headings, strict=True)]
    log = read(tmp_path, text, column=declared)
    assert log["mag_y"].values == pytest.approx([10_250.0])
    assert "ROS" not in log.attrs["guessed"]
    phone = "time,Magnetic Field x (T),Magnetic Field y (T),Magnetic Field z (T)\n1.6e9,2e-5,1e-5,4e-5\n"
    assert read(tmp_path, phone)["mag_y"].values == pytest.approx([10_000.0])


def test_three_columns_in_units_of_a_field_are_its_axes(tmp_path: Path) -> None:
    text = (
        "Messfahrt;12\nDatum;Uhrzeit;X;Y;Z;Kolben;Breite\n;;µT;µT;µT;mm;°\n"
        "04.05.2022;12:00:00;30,5;1,0;45,0;6,9;49,5\n04.05.2022;12:00:01;30,5;1,0;45,0;6,8;49,5\n"
    )
    log = read(tmp_path, text.encode("cp1252"))
    np.testing.assert_array_equal(log["time"], [NOON, NOON + 1])
    np.testing.assert_allclose([log[f"mag_{axis}"][0] for axis in "xyz"], [30_500.0, 1_000.0, 45_000.0])
    assert log["Kolben"].attrs["units"] == "mm"
    assert float(log["latitude"][0]) == 49.5
    assert "mag_x is 'X'" in log.attrs["guessed"]
    # places are in metres, and a fourth field leaves it open which three are meant
    for units in ("m;m;m", "µT;µT;m"):
        assert "mag_x" not in read(tmp_path, text.replace("µT;µT;µT", units).encode("cp1252"))
    assert "mag_x" not in read(tmp_path, "time,x [nT],y [nT],z [nT],F [nT]\n1.6e9,1,2,3,4\n")


def test_a_field_of_another_length_in_our_own_file_is_as_it_is(tmp_path: Path) -> None:
    """In a shielded room; a third-party file has no unit, ours are in nanotesla."""
    shielded = read(tmp_path, f"{HEADER}\n1.6e9,20.5,-10.25,45\n")
    logs.write(shielded, tmp_path / "again.csv")
    assert float(logs.read(tmp_path / "again.csv")["mag_z"][0]) == 45.0


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


PLACES = {
    "a telephone's": ("locationLatitude(WGS84),locationLongitude(WGS84)", "47.5,-52.75", "47.5,-52.75"),
    "a receiver's": ("GPS_Lat,GPS_Lon", "47.5,-52.75", "47.5,-52.75"),
    "with their unit": ("latitude_deg,longitude_dd", "47.5,-52.75", "47.5,-52.75"),
    "one pair of two": ("INS_LAT,INS_LON,LAT,LONG", "0.7,-1,47.5,-52.75", "0.7,-1,47.5,-52.75"),
    "towed": ("Latitude,Longitude,Fish_Lat,Fish_Lon", "47,-52,47.5,-52.75", "47,-52,47.5,-52.75"),
    "columns of letters": ("lat,NS,lon,EW", "47.5,N,52.75,W", "47.5,N,52.75,W"),
    "letters behind": ("lat,lon", "47.5N,52.75W", "47.5 N,52.75 W"),
    "letters before": ("latitude,longitude", "N47.5,W52.75", "N 47.5,W 52.75"),
    "a sign beside": ("latitude,longitude", "47.5,-52.75", "47.5,-52.75 W"),
    "an exponent beside": ("latitude,longitude", "47.5,-5.275E+01", "47.5N,52.75W"),
}


@pytest.mark.parametrize("kind", PLACES)
def test_west_is_west(kind: str, tmp_path: Path) -> None:
    header, *rows = PLACES[kind]
    log = read(tmp_path, lines(f"time,{header}", lambda k: f"{1600000000 + k},{rows[k]}", 2))
    assert log["latitude"].values.tolist() == [47.5, 47.5]
    assert log["longitude"].values.tolist() == [-52.75, -52.75]


def test_a_place_without_its_hemisphere_or_at_0_0_is_not_known(tmp_path: Path) -> None:
    log = read(tmp_path, "time,lat,NS,lon,EW\n1600000000,47.5,N,52.7,W\n1600000001,47.5,N,52.7,\n")
    np.testing.assert_array_equal(log["longitude"], [-52.7, np.nan])
    assert "row 3, column 'longitude': expected E or W beside it" in log.attrs["losses"]
    # a receiver without a fix
    log = read(tmp_path, "time,lat,lon\n1600000000,0,0\n1600000001,0,9.5\n1600000002,47.5,0\n")
    assert np.isnan(log["latitude"].values).tolist() == [True, False, False]
    assert np.isnan(log["longitude"].values).tolist() == [True, False, False]


def test_an_attitude_in_radians_is_recognised(tmp_path: Path) -> None:
    def row(k: int) -> str:
        yaw = (0.1 * k + np.pi) % (2 * np.pi) - np.pi
        return f"{NOON + k},1,2,45000,{0.4 * np.sin(k)},{0.3 * np.cos(k)},{yaw}"

    text = lines(f"{HEADER},roll,pitch,yaw", row, 1_000)
    log = read(tmp_path, text)
    assert float(log["roll"].max()) == pytest.approx(np.degrees(0.4), rel=0.01)
    assert float(log["heading"].max()) > 175.0
    assert "in rad" in log.attrs["guessed"]
    declared = read(tmp_path, text, column=("heading=yaw [deg]",))
    assert float(declared["heading"].max()) < np.pi
    north = lines(f"{HEADER},roll,pitch,yaw", lambda k: f"{NOON + k},1,2,45000,1,1,{0.1 * (k % 20)}")
    assert float(read(tmp_path, north)["heading"].max()) == pytest.approx(1.9)


# ---- values that are not known ----------------------------------------------------------------------------


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


def test_a_field_of_nothing_is_none_and_one_axis_at_0_is(tmp_path: Path) -> None:
    rows = [f"{NOON + k},{20_000 * (k % 3 - 1)},0,45000" for k in range(20)]
    rows[5] = f"{NOON + 5},0,0,0"
    rows[6] = f"{NOON + 6},-9999,0,45000"  # among the others: may be one
    log = read(tmp_path, "\n".join(["time,mag_x,mag_y,mag_z", *rows]) + "\n")
    assert np.flatnonzero(np.isnan(log["mag_x"])).tolist() == [5]
    assert float(log["mag_x"][6]) == -9999.0


def test_a_column_that_is_mostly_unknown_costs_no_more_than_itself(tmp_path: Path) -> None:
    """A CTD that was switched off, a receiver that never had a fix, blanks in quotes."""
    text = lines(
        "time,lat,lon,mag_x,ctd,air [degC],weak",
        lambda k: f'{NOON + k},0,0,{30_000 + k},{-9999 if k else 12.5},-9999," "',
        20,
    )
    log = read(tmp_path, text)
    known = {name: int(np.isfinite(log[name].values).sum()) for name in log.data_vars}
    assert known == {"latitude": 0, "longitude": 0, "mag_x": 20, "ctd": 1, "air": 0, "weak": 0}


def other_formats(path: Path, columns: dict[str, Any]) -> list[xr.Dataset]:
    """Return columns, a row a second from noon on, as netCDF and Parquet of other programs are read."""
    rows = len(next(iter(columns.values())))
    attrs = {"units": "seconds since 1970-01-01"}
    theirs = xr.Dataset(
        {name: ("time", np.asarray(values, float)) for name, values in columns.items()},
        {"time": ("time", NOON + np.arange(rows), attrs)},
    )
    theirs.to_netcdf(path / "a.nc", encoding={name: {"_FillValue": None} for name in columns})
    theirs.to_dataframe().reset_index().to_parquet(path / "a.parquet")
    return [logs.read(path / name) for name in ("a.nc", "a.parquet")]


def test_codes_in_the_netcdf_and_parquet_of_other_programs(tmp_path: Path) -> None:
    for log in other_formats(tmp_path, {f"mag_{axis}": [20_000.0, -9999.0, -15_000.0] for axis in "xyz"}):
        assert np.isnan(log["mag_z"].values).tolist() == [False, True, False]
        assert "column 'mag_z': expected a value, or nothing where it is not known" in log.attrs["losses"]


def test_columns_that_state_what_is_valid(tmp_path: Path) -> None:
    columns = {"total_field": 5e4 + np.arange(6), "MagValid": [1, 1, 0, 1, 1, 1], "Valid": [1, 1, 1, 1, 0, 1]}
    text = lines(
        ",".join(["time", *columns]), lambda k: f"{NOON + k},{50_000 + k},{int(k != 2)},{int(k != 4)}", 6
    )
    for log in (*other_formats(tmp_path, columns), read(tmp_path, text)):
        assert (log["time"].values - NOON).tolist() == [0, 1, 2, 3, 5]
        assert np.isnan(log["total_field"].values).tolist() == [False, False, True, False, False]
        assert passed_over(log.attrs) == {"rows_dropped": 1, "values_dropped": 1}
        assert "not valid by 'valid'" in log.attrs["losses"].lower()
    header = f"{HEADER},depth,DEPTH_QC,Flag"
    text = lines(header, lambda k: f"{NOON + k},1,2,45000,5,{4 if k == 3 else 1},{int(k == 9)}")
    quality = read(tmp_path, text)
    assert quality.sizes["time"] == 39
    assert np.flatnonzero(quality["depth"].isnull()).tolist() == [3]
    assert passed_over(quality.attrs) == {"rows_dropped": 1, "values_dropped": 1}


# ---- Parquet of other programs ----------------------------------------------------------------------------


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


def test_parquet_with_letters_next_to_its_places_and_a_time_in_two_columns(tmp_path: Path) -> None:
    columns = {"date": [*["2022-05-04"] * 3, None], "time": [f"12:00:0{k}" for k in range(4)]}
    places = {"lat": 47.5, "NS": "S", "lon": 52.75, "EW": ["W", None, "E", "W"]}
    pd.DataFrame(columns | places).to_parquet(tmp_path / "a.parquet")
    log = logs.read(tmp_path / "a.parquet")
    assert log["time"].values.tolist() == [NOON, NOON + 1, NOON + 2]
    assert log["latitude"].values.tolist() == [-47.5] * 3
    np.testing.assert_array_equal(log["longitude"], [-52.75, np.nan, 52.75])


# ---- columns that the user declares -----------------------------------------------------------------------


THEIRS = "Zeit;Bx [mG];By [mG];Bz [mG];Batt;Kurs\n2022-05-04T12:00:00Z;300,0;50,0;450,0;12,7;90\n"


UNITS_IN_NAMES = {
    "roll_rad": 57.29577951308232, "Roll/rad": 57.29577951308232, "ins_pitch_rad": 57.29577951308232,
    "yaw_rad": 57.29577951308232, "heading_degree": 1.0, "lat_rad": 57.29577951308232, "depth_cm": 0.01,
    "depth/ft": 0.3048, "sensor_temperature_degC": 1.0, "velocity_north_m/s": 1.0, "water_speed_mps": 1.0,
    "velocity_east/cm/s": 0.01, "local_north_km": 1e3,
}  # fmt: skip


@pytest.mark.parametrize("heading", UNITS_IN_NAMES)
def test_a_unit_behind_the_name_of_a_standard_column_is_its_unit(heading: str, tmp_path: Path) -> None:
    """Angles in rad of such a name were telemetry without a unit; a rate beside them is no angle."""
    others = "time,roll_rad/s,depth_min,current_A"
    log = read(tmp_path, lines(f"{others},{heading}", lambda k: f"{NOON + k},9,8,7,{0.01 * k}"))
    (column,) = {*log.data_vars} - {"roll_rad/s", "depth_min", "current_A"}
    assert column in COLUMNS
    assert log[column].attrs["units"] == COLUMNS[column].units
    np.testing.assert_allclose(log[column], 0.01 * np.arange(40) * UNITS_IN_NAMES[heading])
    frame = pd.DataFrame({"time": NOON + np.arange(3.0), "depth_m": 1.0, "depth": 2.0, "roll_rad": np.pi})
    assert {name: one.values[0] for name, one in from_frame(frame).items()} == {
        "depth_m": 1.0, "depth": 2.0, "roll": pytest.approx(180.0),
    }  # fmt: skip


HEIGHTS = ["altitude [m]", "altitude [ft]", "alt_ft", "GPS height", "Altitude_m", "alt_msl"]


@pytest.mark.parametrize("heading", HEIGHTS)
def test_a_height_is_the_opposite_of_the_depth(heading: str, tmp_path: Path) -> None:
    """Ignored, it was 22 nT of total field at 1,000 m; declared as the depth, 50 nT."""
    unit = 0.3048 if "ft" in heading else 1.0
    text = lines(f"time,latitude,longitude,{heading}", lambda k: f"{NOON + k},45.0,-75.0,{1000.0 / unit}")
    for column in ((), (f"depth={heading}",)):
        log = read(tmp_path, text, column=column)
        assert log["depth"].values == pytest.approx([-1000.0] * 40)
        assert f"depth is minus '{split(heading)[0]}" in log.attrs["guessed"]
        assert not [hint for hint in info(log)["hints"] if "depth" in hint]


@pytest.mark.parametrize(("unit", "scale"), [("dbar", "0.99"), ("bar", "9.9"), ("hPa", "")])
def test_a_pressure_is_not_the_depth_and_a_note_says_so(unit: str, scale: str, tmp_path: Path) -> None:
    """The note's remedy gives the depth: 198 m at 200 dbar. Air pressure, in hPa, gets no note."""
    text = lines(f"time,latitude,longitude,press [{unit}]", lambda k: f"{NOON + k},45.0,-75.0,200")
    notes = read(tmp_path, text).attrs.get("notes", "")
    assert ("no depth: taken as 0 m; if press is the water's" in notes) == bool(scale)
    if scale:
        assert notes.endswith(f'from = "press", unit = "m", scale = {scale}')
        remedy = notes.partition("columns.toml, ")[2].replace(", ", "\n")
        (tmp_path / "columns.toml").write_text(f"[columns.depth]\n{remedy}\n")
        log = read(tmp_path, text, columns=tmp_path / "columns.toml")
        assert log["depth"].values == pytest.approx([200.0 * float(scale)] * 40)
        assert "notes" not in log.attrs


def test_a_height_beside_a_depth_or_without_positions_is_telemetry(tmp_path: Path) -> None:
    """An underwater vehicle's altitude is its distance from the seabed."""
    text = lines("time,latitude,longitude,depth,altitude [m]", lambda k: f"{NOON + k},45.0,-75.0,20,8")
    log = read(tmp_path, text)
    assert (log["depth"].values[0], log["altitude"].values[0]) == (20.0, 8.0)
    log = read(tmp_path, lines("time,altitude [m]", lambda k: f"{NOON + k},8"))
    assert "depth" not in log
    assert any("altitude is not used" in hint for hint in info(log)["hints"])


def test_columns_without_headings_are_called_by_their_numbers(tmp_path: Path) -> None:
    """As an AUV's lines are published: place, Unix time, depth, height, attitude, the field in oersted."""
    rows = "".join(f"-104.29 9.83 {NOON + k} 2450 70 1.5 -3 359 0.25 -0.02 0.3{k}\n" for k in range(3))
    theirs = {"longitude": 1, "latitude": 2, "time": 3, "depth": 4, "roll": 6, "pitch": 7, "heading": 8}
    column = [f"{name}=column_{number}" for name, number in theirs.items()]
    axes = [f"mag_{axis}=column_{number} [Oe]" for axis, number in zip("xyz", (9, 10, 11), strict=True)]
    log = read(tmp_path, rows, name="dive.txt", column=column + axes)
    assert log["time"].values.tolist() == [NOON, NOON + 1, NOON + 2]
    assert log["mag_z"].values == pytest.approx([30_000.0, 31_000.0, 32_000.0])
    assert (log["longitude"].values[0], log["heading"].values[0]) == (-104.29, 359.0)
    assert log["column_5"].values.tolist() == [70.0, 70.0, 70.0]
    # as LEMI's fluxgates write: the parts of a time, the field
    rows = "".join(f"2022 05 04 12 00 0{k} 20500.0 -10250.0 45000.0 21.1\n" for k in range(3))
    names = ["year", "month", "day", "hour", "minute", "second", "mag_x", "mag_y", "mag_z"]
    log = read(tmp_path, rows, "lemi.txt", column=[f"{name}=column_{k}" for k, name in enumerate(names, 1)])
    assert log["time"].values.tolist() == [NOON, NOON + 1, NOON + 2]
    assert log["mag_y"].values.tolist() == [-10_250.0] * 3


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        ([], "row 1: expected a header row .* without one, say what each column is"),
        (["time=column_9"], "column 'column_9': expected this column; there are: column_1 column_2 column_3"),
        (["mag_x=column_1"], "column 'time': expected this column; there are: column_1 .*row \\[20 Hz\\]"),
        (["time=row [0 Hz]", "mag_x=column_1"], "column 'time': expected a rate other than 0 Hz"),
        (["mag_x=x"], "row 1: expected a header row"),
    ],
)
def test_a_file_without_headings_says_what_to_declare(
    column: list[str], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=expected):
        read(tmp_path, "1\t2\t3\n4\t5\t6\n", column=column)


def test_a_mapping_file_renames_scales_and_declares(tmp_path: Path) -> None:
    mapping = tmp_path / "columns.toml"
    mapping.write_text(
        'heading_reference = "magnetic"\nfill_value = 90\n[columns.battpos]\nfrom = "Batt"\nunit = "in"\n'
        'scale = 0.03937007874015748\noffset = 1.0\n[columns.heading]\nfrom = "Kurs"\n'
    )
    log = read(tmp_path, THEIRS, columns=mapping)
    assert float(log["battpos"][0]) == pytest.approx(1.5)
    assert log["battpos"].attrs["units"] == "in"
    assert np.isnan(log["heading"][0])
    assert log.attrs["heading_reference"] == "magnetic"
    assert float(read(tmp_path, THEIRS, columns=mapping, column=("battpos=Batt",))["battpos"][0]) == 12.7


def test_columns_of_any_format_are_declared(tmp_path: Path) -> None:
    plain = read(tmp_path, "time,mag_x,piston [cm]\n1600000000,1,2\n")
    logs.write(plain, tmp_path / "log.parquet")
    (tmp_path / "c.toml").write_text('[columns.ballast]\nfrom = "piston"\nunit = "cm3"\nscale = 10.0\n')
    log = logs.read(tmp_path / "log.parquet", options=Options(columns=tmp_path / "c.toml"))
    assert float(log["ballast"][0]) == 20.0
    assert log["ballast"].attrs["units"] == "cm3"
    assert "piston" not in log


@pytest.mark.parametrize(
    ("column", "mapping", "error", "words"),
    [
        ("mag_x", "", WrongUse, 'expected NAME="THEIRS \\[unit\\]"'),
        ("mag_x=Cx [nT]", "", FormatError, "column 'Cx \\[nT\\]': expected this column; there are: Zeit"),
        ("", "[columns.mag_x]\nfro = 'x'\n", ConfigError, "columns.mag_x.fro: unknown key"),
        ("", "[columns.mag_x]\nscale = 0.0\n", ConfigError, "a scale other than 0"),
        ("", "heading_reference = 'north'\n", ConfigError, "heading_reference: "),
        ("", 'separator = "1e5"', ConfigError, "separator: expected one character"),
        ("", 'zone = "Nowhere"', ConfigError, "zone: expected a time zone"),
        pytest.param("", f"a = {'[' * 50_000}", ConfigError, "at most 100 deep", id="nested arrays"),
        pytest.param("", f"{'.'.join('a' * 50_000)} = 1", ConfigError, "at most 100 deep", id="nested keys"),
    ],
)
def test_what_is_declared_wrongly_is_one_line(
    column: str, mapping: str, error: type[Exception], words: str, tmp_path: Path
) -> None:
    (tmp_path / "c.toml").write_text(mapping)
    columns = tmp_path / "c.toml" if mapping else None
    with pytest.raises(error, match=words):
        read(tmp_path, THEIRS, column=(column,) if column else (), columns=columns)
