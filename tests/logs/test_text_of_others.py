"""Test third-party text files: separators, times, headings, units, and declared columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from magbridge import logs
from magbridge.errors import ConfigError, FormatError, WrongUse
from magbridge.logs import Options

NOON = 1_651_665_600.0  # 2022-05-04T12:00:00Z


def read(tmp_path: Path, text: str | bytes, name: str = "log.csv", **options: Any) -> xr.Dataset:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return logs.read(path, options=Options(**options))


def table(header: str, separator: str = ",", decimal: str = ".", end: str = "\n", quote: str = "") -> str:
    """Return `header`, and two rows of a time, 30.5 uT and 1.25 or -1.25 in."""
    rows = [["1600000000", "30.5", "1.25"], ["1600000001", "30.5", "-1.25"]]
    written = [[f"{quote}{cell.replace('.', decimal)}{quote}" for cell in row] for row in rows]
    return header + "\n" + "".join(separator.join(row) + end for row in written)


LAYOUTS = {
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


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_other_encodings(encoding: str, tmp_path: Path) -> None:
    log = read(tmp_path, "time,mag_x (µT)\n1600000000,30\n".encode(encoding))
    assert float(log["mag_x"][0]) == 30_000.0


TIMES = {
    "2022-05-04T12:00:00.000Z": 0.0,
    "2022-05-04 12:00:00.25": 0.25,
    "2022-05-04T14:00:00+02:00": 0.0,
    "2022-05-04T09:30:00.5-0230": 0.5,
    "2022/05/04 12:00:00": 0.0,
    "31.05.2022 12:00:00": 27 * 86_400.0,
    "05/31/2022 12:00:00 PM": 27 * 86_400.0,
}


@pytest.mark.parametrize("text", TIMES)
def test_dates(text: str, tmp_path: Path) -> None:
    log = read(tmp_path, f"time,mag_x\n{text},1\n")
    assert float(log["time"][0]) == pytest.approx(NOON + TIMES[text], abs=1e-6)


COUNTS = {
    "time": (NOON, NOON + 1),
    "time [ms]": (NOON * 1e3, NOON * 1e3 + 1e3),
    "timestamp": (NOON * 1e6, NOON * 1e6 + 1e6),  # by its size
    "Time ": (44_685.5, 44_685.5 + 1 / 86_400),  # a spreadsheet's days, by size and step
    "time [excel]": (44_685.5, 44_685.5 + 1 / 86_400),
    "julian date": (2_459_704.0, 2_459_704.0 + 1 / 86_400),
    "MJD": (59_703.5, 59_703.5 + 1 / 86_400),
    "GPS time": (NOON - 315_964_800 + 18, NOON - 315_964_800 + 19),
    "time [gps]": (NOON - 315_964_800 + 18, NOON - 315_964_800 + 19),
}


@pytest.mark.parametrize("heading", COUNTS)
def test_counts_of_time(heading: str, tmp_path: Path) -> None:
    first, second = COUNTS[heading]
    log = read(tmp_path, f"{heading},mag_x\n{first!r},1\n{second!r},2\n")
    np.testing.assert_allclose(log["time"], [NOON, NOON + 1], atol=1e-4)


def test_nanoseconds_under_our_own_name_are_known_by_their_size(tmp_path: Path) -> None:
    """Telephone recorders write nanoseconds; the rule does not apply if seconds are declared."""
    rows = f"{NOON * 1e9:.0f},1\n{NOON * 1e9 + 1e9:.0f},2\n"
    log = read(tmp_path, f"time,mag_x\n{rows}")
    np.testing.assert_allclose(log["time"], [NOON, NOON + 1], atol=1e-6)
    assert "ns since 1970, by its size" in log.attrs["guessed"]
    with pytest.raises(FormatError, match="expected seconds since 1970"):
        read(tmp_path, f"time [s],mag_x\n{rows}")


def test_times_of_day_are_of_a_day_that_is_given(tmp_path: Path) -> None:
    text = "time,mag_x\n12:00:00.5,1\n12:00:01.5,2\n"
    log = read(tmp_path, text)
    assert (log["time"].values.tolist(), log.attrs["time_reference"]) == ([43_200.5, 43_201.5], "boot")
    dated = read(tmp_path, text, date=NOON - 43_200.0)
    np.testing.assert_allclose(dated["time"], [NOON + 0.5, NOON + 1.5], atol=1e-6)


@pytest.mark.parametrize("heading", ["time", "UTC", "time [%H%M%S.%f]"])
def test_six_digits_that_step_over_sixty_are_times_of_day(heading: str, tmp_path: Path) -> None:
    """Proton magnetometers and NMEA write such times; a minute has 60 s, but a count would reach 99."""
    column = ["time=time [%H%M%S.%f]"] if "%" in heading else []
    heading = heading.partition(" ")[0]
    log = read(tmp_path, f"{heading},nT\n120058.0,48120\n120059.0,48121\n120100.0,48122\n", column=column)
    assert log["time"].values.tolist() == [43_258.0, 43_259.0, 43_260.0]
    assert log.attrs["time_reference"] == "boot"
    count = read(tmp_path, "time,nT\n120058.0,48120\n120060.0,48121\n120062.0,48122\n")
    assert count["time"].values.tolist() == [120_058.0, 120_060.0, 120_062.0]


def test_the_greek_letter_is_the_micro_sign(tmp_path: Path) -> None:
    log = read(tmp_path, "time,MAGNETIC FIELD X (\N{GREEK SMALL LETTER MU}T)\n1600000000,30.5\n")
    assert log["MAGNETIC FIELD X"].attrs["units"] == "\N{GREEK SMALL LETTER MU}T"
    axes = ",".join(f"B{axis} [\N{GREEK SMALL LETTER MU}T]" for axis in "xyz")
    assert read(tmp_path, f"time,{axes}\n1600000000,30.5,1,2\n")["mag_x"].values.tolist() == [30_500.0]


def test_leap_seconds_are_those_of_the_day(tmp_path: Path) -> None:
    """16 s since July 2012, 17 since July 2015: at 2015-06-30T23:59:59.5Z GPS time is 16 s ahead."""
    gps = 1_435_708_799.5 - 315_964_800 + 16
    log = read(tmp_path, f"gps_time,mag_x\n{gps!r},1\n{gps + 2!r},2\n")
    np.testing.assert_array_equal(log["time"], [1_435_708_799.5, 1_435_708_800.5])


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


def test_seconds_since_a_start_are_not_dated(tmp_path: Path) -> None:
    log = read(tmp_path, '"Time (s)","Magnetic field x (µT)"\n0.0,3.0E+01\n1.0E-02,3.1E+01\n')
    assert log.attrs["time_reference"] == "boot"
    assert "start that the file does not tell" in log.attrs["guessed"]


def test_a_zone_may_be_declared(tmp_path: Path) -> None:
    (tmp_path / "columns.toml").write_text('zone = "America/St_Johns"\n')
    text = "time,mag_x\n2022-05-04 09:30:00,1\n"
    assert float(read(tmp_path, text)["time"][0]) == NOON - 9_000
    assert float(read(tmp_path, text, columns=tmp_path / "columns.toml")["time"][0]) == NOON


@settings(max_examples=30, deadline=None)
@given(
    times=st.lists(st.integers(0, 4_000_000_000_000), min_size=1, max_size=8, unique=True).map(sorted),
    zone=st.sampled_from(["Z", "+00:00", ""]),
)
def test_iso_times_come_back_to_the_microsecond(
    times: list[int], zone: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    stamps = pd.to_datetime(times, unit="ms").strftime("%Y-%m-%dT%H:%M:%S.%f").tolist()
    text = "\n".join(["time,mag_x", *(f"{stamp}{zone},1" for stamp in stamps)]) + "\n"
    log = read(tmp_path_factory.mktemp("iso"), text)
    np.testing.assert_allclose(log["time"], np.array(times) * 1e-3, rtol=0, atol=1e-6)


THEIRS = "Zeit;Bx [mG];By [mG];Bz [mG];Batt;Kurs\n2022-05-04T12:00:00Z;300,0;50,0;450,0;12,7;90\n"


def test_columns_are_declared_one_by_one(tmp_path: Path) -> None:
    log = read(tmp_path, THEIRS, column=("time=Zeit", "battpos=Batt [mm]", "heading=Kurs", "mag_x=By [mG]"))
    assert float(log["battpos"][0]) == 12.7
    assert log["battpos"].attrs["units"] == "mm"
    assert float(log["heading"][0]) == 90.0
    assert float(log["mag_x"][0]) == 5_000.0


def test_columns_without_headings_are_called_by_their_numbers(tmp_path: Path) -> None:
    """As an AUV's lines are published: place, Unix time, depth, height, attitude, the field in oersted."""
    rows = "".join(f"-104.29 9.83 {NOON + k} 2450 70 1.5 -3 359 0.25 -0.02 0.3{k}\n" for k in range(3))
    theirs = {"longitude": 1, "latitude": 2, "time": 3, "depth": 4, "roll": 6, "pitch": 7, "heading": 8}
    column = [f"{name}=column_{number}" for name, number in theirs.items()]
    axes = [f"mag_{axis}=column_{number} [Oe]" for axis, number in zip("xyz", (9, 10, 11), strict=True)]
    log = read(tmp_path, rows, name="dive.txt", column=column + axes)
    assert log["time"].values.tolist() == [NOON, NOON + 1, NOON + 2]
    assert log["mag_z"].values == pytest.approx([30_000.0, 31_000.0, 32_000.0])
    assert log["mag_x"].attrs["units"] == "nT"
    assert (log["longitude"].values[0], log["heading"].values[0]) == (-104.29, 359.0)
    assert log["column_5"].values.tolist() == [70.0, 70.0, 70.0]


def test_rows_without_times_come_at_a_rate_and_a_bad_one_leaves_its_place(tmp_path: Path) -> None:
    column = ["time=row [20 Hz]", *(f"mag_{axis}=column_{k}" for k, axis in enumerate("xyz", 1))]
    log = read(tmp_path, "187\t-420\t-538\n187\t-420\n190\t-410\t-530\n", name="sphere.txt", column=column)
    assert log["time"].values.tolist() == [0.0, 0.1]
    assert log["mag_x"].values.tolist() == [187.0, 190.0]
    assert log.attrs["time_reference"] == "boot"
    with_headings = read(tmp_path, "mx,my,mz\n1,2,3\n4,5,6\n", column=["time=row [4 Hz]"])
    assert with_headings["time"].values.tolist() == [0.0, 0.25]
    assert with_headings["mag_y"].values.tolist() == [2.0, 5.0]


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


def test_a_blackbox_as_csv(tmp_path: Path) -> None:
    """In a file of blackbox_decode an index in brackets is not a unit."""
    header = "loopIteration,time (us),magADC[0],magADC[1],magADC[2],amperageLatest (A),motor[0]\n"
    rows = "".join(
        f"{k},{1_000_000 + 2000 * k}, {200 + k}, -100, 350, {0.1 * k}, {1100 + k}\n" for k in range(9)
    )
    log = read(
        tmp_path, header + rows, column=[f"mag_{axis}=magADC[{k}] [mG]" for k, axis in enumerate("xyz")]
    )
    np.testing.assert_allclose(log["time"], 1.0 + 0.002 * np.arange(9))
    np.testing.assert_allclose(log["mag_x"], 20_000.0 + 100.0 * np.arange(9))
    np.testing.assert_allclose(log["motor[0]"], 1100.0 + np.arange(9))
    assert log["amperageLatest"].attrs["units"] == "A"
    assert log.attrs["time_reference"] == "boot"


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
    ("option", "error", "words"),
    [
        ({"column": ("mag_x",)}, WrongUse, 'expected NAME="THEIRS \\[unit\\]"'),
        (
            {"column": ("mag_x=Cx [nT]",)},
            FormatError,
            "column 'Cx \\[nT\\]': expected this column; there are: Zeit",
        ),
        ({"columns": "[columns.mag_x]\nfro = 'x'\n"}, ConfigError, "columns.mag_x.fro: unknown key"),
        ({"columns": "[columns.mag_x]\nscale = 0.0\n"}, ConfigError, "a scale other than 0"),
        ({"columns": "heading_reference = 'north'\n"}, ConfigError, "heading_reference: "),
    ],
)
def test_what_is_declared_wrongly_is_one_line(
    option: dict[str, Any], error: type[Exception], words: str, tmp_path: Path
) -> None:
    if "columns" in option:
        (tmp_path / "c.toml").write_text(str(option["columns"]))
        option = {"columns": tmp_path / "c.toml"}
    with pytest.raises(error, match=words):
        read(tmp_path, THEIRS, **option)


def test_what_was_guessed_is_kept_in_the_history_of_what_is_written(tmp_path: Path) -> None:
    log = read(tmp_path, THEIRS.replace("Zeit", "Timestamp"))
    assert "time is 'Timestamp'" in log.attrs["guessed"]
    for name in ("again.nc", "again.parquet", "again.csv"):
        logs.write(log, tmp_path / name)
        again = logs.read(tmp_path / name)
        assert "decimal commas; fields separated by ';'" in again.attrs["history"], name
        assert "guessed" not in again.attrs  # nothing was, this time


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


def test_motioncal(tmp_path: Path) -> None:
    lines = ["w:0,0,8192,0", *(f"Raw:0,0,8192,0,0,0,{300 + k},50,450" for k in range(9)), "Raw:0,0,81"]
    log = read(tmp_path, "\r\n".join(lines))
    assert log.sizes["time"] == 9
    np.testing.assert_allclose(log["mag_x"], 30_000.0 + 100.0 * np.arange(9))
    np.testing.assert_allclose(np.diff(log["time"]), 0.01)
    assert log.attrs["time_reference"] == "boot"
    assert "100 nT a count" in log.attrs["guessed"]
    assert log.attrs["rows_dropped"] == 2


def test_motioncal_with_more_digits(tmp_path: Path) -> None:
    pair = "Raw:0,0,8192,0,0,0,305,50,450\nUni:0.0,0.0,9.8,0.0,0.0,0.0,30.51,5.02,45.03\n"
    assert read(tmp_path, pair * 3, "log.txt")["mag_x"].values == pytest.approx([30_510.0] * 3)


def test_magarrow(tmp_path: Path) -> None:
    """Its x is to the right, its y aft; sentences with commas of their own end some rows."""
    header = (
        "Counter,Date,Time,Latitude,Longitude,Mag, MagValid,CompassX, CompassY, CompassZ,Track,GgaSentence,R"
    )
    rows = [
        "0,2022/05/04,12:00:00.000,47.6,-52.7,50800.5,1,30000,-5000,45000,90,$GPGGA,12,N,$GPRMC,1,2",
        "1,2022/05/04,12:00:00.100,47.6,-52.7,50801.5,0,30000,-5000,45000,90,,",
    ]
    log = read(tmp_path, "\n".join([header, *rows]) + "\n")
    np.testing.assert_allclose(log["time"], [NOON, NOON + 0.1], atol=1e-6)
    assert [float(log[name][0]) for name in ("mag_x", "mag_y", "mag_z")] == [5_000.0, 30_000.0, 45_000.0]
    np.testing.assert_array_equal(log["total_field"], [50_800.5, np.nan])
    assert "columns as MagArrow writes them" in log.attrs["guessed"]


def test_sensys(tmp_path: Path) -> None:
    text = (
        "MagDroneR3: 000058\nDate: 03.06.2021\n###---GPS---###\n"
        "Timestamp [ms]; B1x [nT]; B1y [nT]; B1z [nT]; B2x [nT]; B2y [nT]; B2z [nT]; "
        "Latitude [Decimal Degrees]; Quality; GPSTime; GPSTime [hh:mm:ss.sss]\n"
        "5; 30000; 5000; 45000; 30001; 5001; 45001; 47.6; 1; 134542.000; 13:45:42.000\n"
        "10; 30000; 5000; 45000; 30001; 5001; 45001; ; ; ; \n"
    )
    log = read(tmp_path, text)
    assert [float(log[name][0]) for name in ("mag_x", "mag_y", "mag_z", "mag2_x")] == [
        3e4,
        5e3,
        4.5e4,
        30_001.0,
    ]
    np.testing.assert_array_equal(log["latitude"], [47.6, np.nan])
    assert log.attrs["time_reference"] == "boot"
    np.testing.assert_allclose(np.diff(log["time"]), 0.005)
    other = read(tmp_path, text, column=("mag_x=B2x [nT]", "mag_y=B2y [nT]", "mag_z=B2z [nT]"))
    assert [float(other[name][0]) for name in ("mag_x", "mag_y", "mag_z", "B1x")] == [
        30_001.0,
        5_001.0,
        45_001.0,
        3e4,
    ]
