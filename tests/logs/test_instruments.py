"""Test text files as instruments and their programs write them."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from texts import NOON, lines, read

import magbridge as mb
from magbridge.errors import FormatError
from magbridge.logs import Options, write
from magbridge.records import Quality


class Case(NamedTuple):
    """A file of an instrument, and what its first row must be."""

    name: str
    text: str
    row: dict[str, float]
    """Values of the first row; ``time`` in s since 2022-05-04T12:00:00Z, or since the start if `boot`."""
    rows: int = 40
    boot: bool = False
    guessed: str = ""
    lost: str = ""
    """Parts of the notes on assumptions and losses."""
    options: Mapping[str, Any] = MappingProxyType({})


DATCON = ["Tick#", "offsetTime", "GPS:Long", "GPS:Lat", "GPS:dateTimeStamp", "IMU_ATTI(0):Latitude"]
DATCON += [f"IMU_ATTI(0):{name}" for name in ("roll:C", "pitch:C", "yaw:C", "magX", "magY", "magZ")]
DATCON += [f"IMU_ATTI(1):mag{axis}" for axis in "XYZ"]
DATCON_FLIGHT = lines(
    ",".join(DATCON),
    lambda k: (
        f"{k},{0.1 * k:.1f},-76,45,2022-05-04T12:00:{k // 10:02d}Z,0.785,1,2,{k},180,{k},500,170,{k},490"
    ),
)
SENSYS = (
    "MagDroneR3: 000058\nDate: 03.06.2021\n###---GPS---###\n"
    "Timestamp [ms]; B1x [nT]; B1y [nT]; B1z [nT]; B2x [nT]; B2y [nT]; B2z [nT]; "
    "Latitude [Decimal Degrees]; Quality; GPSTime; GPSTime [hh:mm:ss.sss]\n"
    "5; 30000; 5000; 45000; 30001; 5001; 45001; 47.6; 1; 134542.000; 13:45:42.000\n"
    "10; 30000; 5000; 45000; 30001; 5001; 45001; ; ; ; \n"
)
SENSYS_DATED = (
    "Timestamp [ms];B1x [nT];B1y [nT];B1z [nT];B2x [nT];B2y [nT];B2z [nT];GPSDate;GPSTime [hh:mm:ss.sss]"
)
MAGARROW = """\
Counter,Date,Time,Latitude,Longitude,Mag, MagValid,CompassX, CompassY, CompassZ,Track,GgaSentence,R
0,2022/05/04,12:00:00.000,47.6,-52.7,50800.5,1,30000,-5000,45000,90,$GPGGA,12,N,$GPRMC,1,2
1,2022/05/04,12:00:00.100,47.6,-52.7,50801.5,0,30000,-5000,45000,90,,
"""
MOTIONCAL = ["w:0,0,8192,0", *(f"Raw:0,0,8192,0,0,0,{300 + k},50,450" for k in range(9)), "Raw:0,0,81"]
RUNMAG = '"rt":20.1, "lt":21.0, "x":20.0, "y":-1.2, "z":45.1, "rx":1500, "ry":-90, "rz":3380'
GEM = "/Gem Systems GSM-19WV\n/ID 1 file 01survey.wmv 04 V 22\n/X Y nT sq cor-nT time\nline  0.00\n"
CASES = {
    "MotionCal": Case(
        "log.csv", "\r\n".join(MOTIONCAL), {"mag_x": 3e4, "mag_y": 5e3}, 9, True, "100 nT a count", "row 1:",
    ),
    "MotionCal with more digits": Case(
        "log.txt", "Raw:0,0,8192,0,0,0,305,50,450\nUni:0,0,9.8,0,0,0,30.51,5.02,45.03\n" * 3 + "Uni:0",
        {"mag_x": 30_510.0}, 3, True, "1000 nT a count", "row 4:",
    ),
    # in a file of blackbox_decode an index in brackets is not a unit
    "a blackbox": Case(
        "log.csv",
        lines(
            "loopIteration,time (us),magADC[0],magADC[1],magADC[2],amperageLatest (A),motor[0]",
            lambda k: f"{k},{1_000_000 + 2000 * k}, {200 + k}, -100, 350, {0.1 * k}, {1100 + k}",
        ),
        {"time": 1.0, "mag_x": 20_000.0, "motor[0]": 1100.0, "amperageLatest": 0.0}, boot=True,
        options={"column": [f"mag_{axis}=magADC[{k}] [mG]" for k, axis in enumerate("xyz")]},
    ),
    # its x is to the right, its y aft; sentences with commas of their own end some rows
    "MagArrow": Case(
        "log.csv", MAGARROW,
        {"time": 0.0, "mag_x": 5_000.0, "mag_y": 30_000.0, "mag_z": 45_000.0, "total_field": 50_800.5}, 2,
        guessed="columns as MagArrow writes them", lost="not valid by 'MagValid'",
    ),
    "Sensys": Case(
        "log.csv", SENSYS, {"mag_x": 3e4, "mag_y": 5e3, "mag_z": 4.5e4, "mag2_x": 30_001.0, "latitude": 47.6},
        2, True,
    ),
    "Sensys, declared": Case(
        "log.csv", SENSYS, {"mag_x": 30_001.0, "mag_y": 5_001.0, "mag_z": 45_001.0, "B1x": 3e4}, 2, True,
        options={"column": [f"mag_{axis}=B2{axis} [nT]" for axis in "xyz"]},
    ),
    "Sensys, dated by its GPS": Case(
        "log.csv",
        lines(SENSYS_DATED, lambda k: (
            f"{60 + 5 * k};18000;0;46000;18300;-200;46090;2022/05/04;12:00:00.{398 + 5 * k}")),
        {"time": 0.398, "mag2_z": 46_090.0},
    ),
    "DatCon": Case(
        "log.csv", DATCON_FLIGHT,
        {"time": 0.05, "mag_x": 18_000.0, "mag2_x": 17_000.0, "latitude": 45.0, "heading": 0.0},
    ),
    "DatCon, the second sensor": Case(
        "log.csv", DATCON_FLIGHT, {"mag_x": 17_000.0}, options={"compass": "1"}
    ),
    "SeaLINK's units behind the numbers": Case(
        "line.xyz",
        "/ SeaLINK\n" + lines(
            "/Date,Time,Field_Mag1,Alt_Mag1,Depth_Mag1,Longitude,Latitude,Zone",
            lambda k: f"2022/05/04,12:00:{k:02d}.0,48000.0,20.50m,{30 + k}cm,-20,10,27P",
        ),
        {"time": 0.0, "depth": 0.3, "Alt_Mag1": 20.5, "total_field": 48_000.0, "longitude": -20.0},
    ),
    **{
        f"a cruise's {name}": Case(
            name,
            lines(
                "SURVEY_ID\tTIMEZONE\tDATE\tTIME\tLAT\tLON\tMAG_TOT\tMAG_RES",
                lambda k: f"MADE\t0\t20220504\t{1200.5 + 0.5 * k:.3f}\t-30\t10\t{27_000 + k}\t3",
            ),
            {"time": 30.0, "total_field": 27_000.0, "latitude": -30.0}, guessed="HHMM.mmm",
        )
        for name in ("cruise.txt", "cruise.m77t")
    },
    "JSON lines": Case(
        "runmag.jsonl",
        "".join(f'{{"ts":"04 May 2022 12:00:{k:02d}", {RUNMAG}}}\n' for k in range(20)) + "broken\n",
        {"time": 0.0, "mag_x": 20_000.0, "sensor_temperature": 20.1}, 20, lost="row 21",
    ),
    "an Explorer": Case(
        "explorer.txt",
        "".join(f"*22.124/12:00:0{k}.0 F:50000.1 S:150 D:+003.0m A:008.2m L0 Q:99\n" for k in range(9)),
        {"time": 0.0, "total_field": 50_000.1, "depth": 3.0, "altitude": 8.2}, 9,
    ),
    "MagMap": Case(
        "m.dat", "X Y READING_1 TIME DATE LINE MARK\n0.5 0 50905.7 12:00:00.25 05/04/22 0 1\n",
        {"time": 0.25, "total_field": 50_905.7, "line": 0.0}, 1,
    ),
    "BOB": Case(
        "b.csv", "/ BOB\nReading_Date,Reading_Time,Field,Depth\n2022-05-04,12:00:00.250,50905.7,3\n",
        {"time": 0.25, "total_field": 50_905.7}, 1,
    ),
    "GEM": Case(
        "g.txt",
        GEM + "0372.36  5262.88  50905.70 99 0.00 120000.25\n0372.36  5262.88  50905.70 99 0.00 120100.25\n",
        {"time": 43_200.25, "total_field": 50_905.7}, 2, True,
    ),
    "a base station": Case(
        "f.csv", "Timestamp,F [uT]\n2022-05-04 12:00:00.25,50.9057\n", {"total_field": 50_905.7}, 1
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_file_of_an_instrument(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    log = read(tmp_path, case.text, case.name, **case.options)
    assert log.sizes["time"] == case.rows
    assert (log.attrs.get("time_reference") == "boot") == case.boot
    for column, value in case.row.items():
        zero = NOON if column == "time" and not case.boot else 0.0
        assert float(log[column][0]) - zero == pytest.approx(value, abs=1e-4 + 0.06 * ("DatCon" in name)), (
            column
        )
    assert (np.diff(log["time"]) > 0).all()
    assert case.guessed in log.attrs.get("guessed", "")
    assert case.lost in log.attrs.get("losses", "")
    assert bool(case.lost) == ("losses" in log.attrs)


TAGS = "dbd_label: DBD_ASC(dinkum_binary_data_ascii)file\nencoding_ver: 2\nnum_ascii_tags: 14\n"


def test_a_slocums_text(tmp_path: Path) -> None:
    """What dbd2asc writes: tags, names, units, sizes, then a cycle a line."""
    head = "m_battpos m_depth m_heading m_lat m_present_time\nin m rad lat timestamp\n4 4 4 8 8\n"
    rows = [f"0.25 {k} 1.5707963267948966 4730.0 {NOON + k}" for k in range(5)]
    rows[2] = f"NaN 2 NaN 69696969 {NOON + 2}"
    log = read(tmp_path, TAGS + head + " \n".join(rows) + "\n", "unit.dba")
    np.testing.assert_allclose(log["time"], NOON + np.arange(5))
    np.testing.assert_allclose(log["latitude"], 47.5)
    np.testing.assert_allclose(log["heading"], 90.0)
    np.testing.assert_allclose(log["depth"], np.arange(5))
    with pytest.raises(FormatError, match="expected names, units, sizes and rows"):
        read(tmp_path, TAGS + head[:60], "cut.dba")


def test_a_value_measured_at_a_row_is_the_value_of_that_row(tmp_path: Path) -> None:
    names = "m_present_time m_roll m_depth\ntimestamp rad m\n8 4 4"
    text = lines(TAGS + names, lambda k: f"{NOON + 60 * k} {0.1 if k % 10 == 0 else 'NaN'} {k}", 60)
    np.testing.assert_allclose(read(tmp_path, text, "rare.dba")["roll"][::10], np.degrees(0.1))


# ---- Exchange of files with programs for drone surveys: MagComPy and GeoHammer -----------------------------


MAGCOMPY = """\
# Counter,Date,Time,X_NAD83UTM10N_m,Y_NAD83UTM10N_m,Altitude_m,Total_Field_nT,Flux_X_nT,Flux_Y_nT,Flux_Z_nT
000000,2020-09-28,12:00:00.000,553000.000,4183000.000,50.00,48500.34558,20000.0,-0.0,44000.0
000001,2020-09-28,12:00:00.100,553000.500,4183001.000,50.00,48500.82162,19999.0,-200.0,44000.0
000002,2020-09-28,12:00:00.200,553001.000,4183002.000,50.00,48500.33044,19996.0,-400.0,43999.0
"""


def test_a_file_of_magcompy_has_its_position_in_degrees(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(MAGCOMPY)
    log = mb.read(path)
    # 553 km east and 4,183 km north in zone 10 is San Francisco; by PROJ's cs2cs
    assert log["latitude"].to_numpy()[0] == pytest.approx(37.79282906, abs=1e-7)
    assert log["longitude"].to_numpy()[0] == pytest.approx(-122.39802929, abs=1e-7)
    assert log["total_field"].to_numpy()[1] == 48500.82162
    # the instrument's x is to the right and its y aft
    assert [float(log[f"mag_{axis}"][1]) for axis in "xyz"] == [200.0, 19999.0, 44000.0]
    assert "EPSG:32610" in log.attrs["guessed"]


def test_eastings_are_declared_with_their_code(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text("time [s],East,North,mag_x [nT],mag_y [nT],mag_z [nT]\n1.6e9,500000,0,1,2,48000\n")
    declared = ("longitude=East [EPSG:32631]", "latitude=North [EPSG:32631]")
    log = mb.read(path, options=Options(column=declared))
    # the central meridian of zone 31 meets the equator at easting 500 km, northing 0
    assert [float(log[name][0]) for name in ("latitude", "longitude")] == pytest.approx([0.0, 3.0], abs=1e-9)
    wrong = tuple(text.replace("32631", "99999") for text in declared)
    with pytest.raises(FormatError, match="EPSG:99999"):
        mb.read(path, options=Options(column=wrong))


def survey() -> xr.Dataset:
    columns = {
        "latitude": [56.862286, 56.862287, np.nan],
        "longitude": [-24.1136, -24.1137, np.nan],
        "depth": [-31.5, -31.6, -31.7],
        "total_field": [51383.1835, 51383.468, np.nan],
        "mag_x": [9052.0, 9053.0, 9054.0],
        "mag_y": [20440.0, 20441.0, 20442.0],
        "mag_z": [55188.0, 55189.0, 55190.0],
        "quality": [0.0, float(next(iter(Quality))), 0.0],
        "line": [100.0, 100.0, 200.0],
    }
    time = 1_601_300_273.0 + 0.001 * np.arange(3)
    return xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": time})


def test_a_magarrow_file_has_the_columns_that_the_programs_read(tmp_path: Path) -> None:
    path = tmp_path / "out.magarrow.csv"
    write(survey(), path)
    table = pd.read_csv(path)
    # MagComPy reads columns by their number, from 0; GeoHammer finds its template by these headings
    assert [table.columns[k] for k in (1, 2, 3, 4, 5, 6, 7, 8, 9, 22)] == [
        "Date", "Time", "Latitude", "Longitude", "Mag", "MagValid",
        "CompassX", "CompassY", "CompassZ", "Altitude",
    ]  # fmt: skip
    assert table["Date"].tolist() == ["2020/09/28"] * 3
    assert table["Time"].tolist() == ["13:37:53.000", "13:37:53.001", "13:37:53.002"]
    assert table["MagValid"].tolist() == [1, 0, 0]
    assert table["Altitude"].tolist() == [31.5, 31.6, 31.7]
    assert path.read_text().splitlines()[3].split(",")[3:7] == ["NaN", "NaN", "NaN", "0"]


def test_a_log_without_a_position_is_not_written_for_survey_programs(tmp_path: Path) -> None:
    path = tmp_path / "out.magarrow.csv"
    with pytest.raises(FormatError, match=r"out\.magarrow\.csv: column 'latitude': expected this column"):
        write(survey().drop_vars("latitude"), path)
    assert not list(tmp_path.iterdir())
