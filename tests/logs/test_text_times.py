"""Test the times of text files: the reader finds what they count from, or asks for it."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from texts import NOON, lines, read

from magbridge import logs
from magbridge.columns import counts_from_boot, decoded
from magbridge.datasets import in_standard_units
from magbridge.errors import FormatError
from magbridge.logs.deployment import from_frame, named_losses, to_frame
from magbridge.logs.mapping import Options

GPS = NOON - 315_964_800 + 18
DAY = 86_400.0

STAMPS = {
    # headings, cells at 0.5 s and 1.5 s past noon
    "a date of digits": ("date,time", "20220504,120000.5", "20220504,120001.5"),
    "an ISO date, digits": ("Date,UTC", "2022-05-04,120000.50", "2022-05-04,120001.50"),
    "ISO, zone": ("time", "2022-05-04T14:00:00.5+02:00", "2022-05-04T14:00:01.5+02:00"),
    "ISO, Z": ("time", "2022-05-04T12:00:00.500Z", "2022-05-04T12:00:01.500Z"),
    "slashes": ("time", "2022/05/04 12:00:00.5", "2022/05/04 12:00:01.5"),
    "dots": ("time", "31.05.2022 12:00:00.5", "31.05.2022 12:00:01.5"),
    "noon": ("time", "05/31/2022 12:00:00.5 PM", "05/31/2022 12:00:01.5 PM"),
    "seconds of the day": ("date,timeofday", "20220504,43200.5", "20220504,43201.5"),
    "the month's name": ("Date,Time", "04-May-2022,12:00:00.5", "04-May-2022,12:00:01.5"),
    "two digits of the year": ("Date,Time", "31.05.22,12:00:00.5", "31.05.22,12:00:01.5"),
    "a comma's fraction": ("Datum;Uhrzeit", "04.05.2022;12:00:00,5", "04.05.2022;12:00:01,5"),
    "a colon's fraction": ("date,time", "2022-05-04,12:00:00:500", "2022-05-04,12:00:01:500"),
    "fourteen digits": ("timestamp", "20220504120000.5", "20220504120001.5"),
    "digits on either side": ("time", "20220504_120000.5", "20220504T120001.5"),
    "a day of the year": ("time", "2022-124T12:00:00.5", "2022-124T12:00:01.5"),
    "a C program's": ("time", "Wed May  4 12:00:00 2022", "Wed May  4 12:00:01 2022"),
    "its order in the heading": ("time,mm/dd/yyyy", "12:00:00.5,05/04/2022", "12:00:01.5,05/04/2022"),
    "six columns": ("year,month,day,hour,min,sec", "2022,5,4,12,0,0.5", "2022,5,4,12,0,1.5"),
    "the day in five": ("YYYY,DOY,hh,minute,ss", "2022,124,12,0,0.5", "2022,124,12,0,1.5"),
    "ROS 2": ("header.stamp.sec,header.stamp.nanosec", f"{NOON:.0f},500000000", f"{NOON + 1:.0f},500000000"),
    "ROS 1": ("%time,field.header.seq", f"{NOON * 1e9 + 5e8:.0f},1", f"{NOON * 1e9 + 15e8:.0f},2"),
    "ms": ("time [ms]", f"{NOON * 1e3 + 500:.0f}", f"{NOON * 1e3 + 1500:.0f}"),
    "us by its size": ("timestamp", f"{NOON * 1e6 + 5e5:.0f}", f"{NOON * 1e6 + 15e5:.0f}"),
    "a telephone's ns": ("time", f"{NOON * 1e9 + 5e8:.0f}", f"{NOON * 1e9 + 15e8:.0f}"),
    "GPS week": ("GPS Week,TOW [s]", f"2208,{GPS % 604800 + 0.5}", f"2208,{GPS % 604800 + 1.5}"),
    "GPS week, ms": (
        "GWk,GMS", f"2208,{GPS % 604800 * 1e3 + 500:.0f}", f"2208,{GPS % 604800 * 1e3 + 1500:.0f}"
    ),
    "GPS time": ("GPS time", f"{GPS + 0.5}", f"{GPS + 1.5}"),
    "GPS time by its unit": ("time [gps]", f"{GPS + 0.5}", f"{GPS + 1.5}"),
    "a spreadsheet's days": ("Date", f"{44_685.5 + 0.5 / DAY:.9f}", f"{44_685.5 + 1.5 / DAY:.9f}"),
    "days under our name": ("time", f"{44_685.5 + 0.5 / DAY:.9f}", f"{44_685.5 + 1.5 / DAY:.9f}"),
    "days by their unit": ("time [excel]", f"{44_685.5 + 0.5 / DAY:.9f}", f"{44_685.5 + 1.5 / DAY:.9f}"),
    "Julian days": ("julian date", f"{2_459_704 + 0.5 / DAY:.9f}", f"{2_459_704 + 1.5 / DAY:.9f}"),
    "modified Julian days": ("MJD", f"{59_703.5 + 0.5 / DAY:.9f}", f"{59_703.5 + 1.5 / DAY:.9f}"),
    "modified days under our name": ("time", f"{59_703.5 + 0.5 / DAY:.9f}", f"{59_703.5 + 1.5 / DAY:.9f}"),
    "a heading of its own": (
        "loggingTime(txt)", "2022-05-04T09:30:00.5-02:30", "2022-05-04T09:30:01.5-0230"
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", STAMPS)
def test_times_that_stand_in_many_ways(kind: str, tmp_path: Path) -> None:
    header, first, second = STAMPS[kind]
    separator = ";" if ";" in header else ","
    rows = [f"{stamp}{separator}{value}" for stamp, value in ((first, 30_000), (second, 30_001))]
    log = read(tmp_path, "\n".join([f"{header}{separator}mag_x", *rows]) + "\n")
    expected = NOON + (27 * DAY if "31" in first[:5] else 0) + np.array([0.5, 1.5])
    whole = kind == "a C program's"
    np.testing.assert_allclose(log["time"], np.floor(expected) if whole else expected, atol=2e-3)
    assert log["mag_x"].values.tolist() == [30_000.0, 30_001.0]
    assert log.attrs.get("time_reference", "utc") == "utc"


BEFORE_1980 = {
    # heading and two cells: 1965-06-01 and 1972-06-01 at 12:00:00 and 12:00:01
    "ISO": ("time", "{year}-06-01T12:00:00Z", "{year}-06-01T12:00:01Z"),
    "slashes": ("time", "{year}/06/01 12:00:00", "{year}/06/01 12:00:01"),
    "Unix": ("clock [unix]", "{since}", "{later}"),
    "seconds since": ("clock [seconds since 1970-01-01]", "{since}", "{later}"),
    "days": ("MJD", "{day:.9f}", "{next_day:.9f}"),
}


@pytest.mark.parametrize("year", [1965, 1972])
@pytest.mark.parametrize("kind", BEFORE_1980)
def test_a_date_before_1980_is_a_date(kind: str, year: int, tmp_path: Path) -> None:
    since = pd.Timestamp(f"{year}-06-01T12:00Z").timestamp()
    day, later = 40_587 + since / DAY, since + 1
    names = {"year": year, "since": since, "later": later, "day": day, "next_day": day + 1 / DAY}
    heading, *stamps = (text.format(**names) for text in BEFORE_1980[kind])
    text = "".join([f"{heading},mag_x\n", *(f"{stamp},30000\n" for stamp in stamps)])
    log = read(tmp_path, text)
    np.testing.assert_allclose(log["time"], [since, later], atol=1e-4)
    dated = read(tmp_path, text, date=1e9)
    np.testing.assert_array_equal(dated["time"], log["time"])
    assert "--date was not used" in dated.attrs["notes"]
    for suffix in ("csv", "nc", "parquet"):
        logs.write(log, tmp_path / f"again.{suffix}")
        again = logs.read(tmp_path / f"again.{suffix}")
        assert not counts_from_boot(again)
        assert not counts_from_boot(in_standard_units(decoded(again)))
    assert not counts_from_boot(from_frame(to_frame(log)))


def test_a_count_from_a_boot_stays_one(tmp_path: Path) -> None:
    log = read(tmp_path, "time,mag_x\n0.5,30000\n1.5,30001\n")
    for suffix in ("csv", "nc", "parquet"):
        logs.write(log, tmp_path / f"again.{suffix}")
        assert counts_from_boot(logs.read(tmp_path / f"again.{suffix}"))
    assert counts_from_boot(from_frame(to_frame(log)))
    date = pd.Timestamp("1972-06-01T00:00Z").timestamp()
    dated = logs.read(tmp_path / "again.nc", options=Options(date=date))
    assert (dated["time"].values.tolist(), counts_from_boot(dated)) == ([date + 0.5, date + 1.5], False)


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
    assert "start that the file does not tell" in log.attrs["guessed"]


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
        ("time,mag_x\n" + "1,1\n" * 9 + "2,1\n" * 9, "9 have the same: if in whole seconds, give the rate"),
        ("date,time,mag_x\n04/05/22,12:00:00,1\n", r"day or month first\? '04/05/22 12:00:00'"),
        ("GPS Week,TOW,mag_x\n,,1\n", r"row 2, column 'time': expected a"),
        ("GPS Week,TOW,mag_x\n2208,345600 7 8,1\n", r"row 2, column 'time': expected a"),
        (f"time [s],mag_x\n{NOON * 1e9:.0f},1\n", "expected seconds since 1970"),
    ],
)
def test_times_that_may_be_this_or_that_are_asked_about(text: str, expected: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=expected):
        read(tmp_path, text)


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


def test_leap_seconds_are_those_of_the_day(tmp_path: Path) -> None:
    """16 s since July 2012, 17 since July 2015: at 2015-06-30T23:59:59.5Z GPS time is 16 s ahead."""
    gps = 1_435_708_799.5 - 315_964_800 + 16
    log = read(tmp_path, f"gps_time,mag_x\n{gps!r},1\n{gps + 2!r},2\n")
    np.testing.assert_array_equal(log["time"], [1_435_708_799.5, 1_435_708_800.5])


def test_a_zone_may_be_declared(tmp_path: Path) -> None:
    (tmp_path / "columns.toml").write_text('zone = "America/St_Johns"\n')
    text = "time,mag_x\n2022-05-04 09:30:00,1\n"
    assert float(read(tmp_path, text)["time"][0]) == NOON - 9_000
    assert float(read(tmp_path, text, columns=tmp_path / "columns.toml")["time"][0]) == NOON


@pytest.mark.parametrize("row", ["2026-10-25 02:30:00", "2026-03-29 02:30:00"])
def test_a_local_time_at_a_change_of_summer_time_is_named_as_such(tmp_path: Path, row: str) -> None:
    """It occurs twice or never; with its offset it can be read."""
    (tmp_path / "columns.toml").write_text('zone = "Europe/Berlin"\n')
    columns = tmp_path / "columns.toml"
    with pytest.raises(FormatError, match=r"expected a time that Europe/Berlin has once, .*in UTC"):
        read(tmp_path, f"time,mag_x\n{row},1\n", columns=columns)
    assert len(read(tmp_path, f"time,mag_x\n{row}+01:00,1\n", columns=columns)["time"]) == 1


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


# ---- counts that start again, or have no times -------------------------------------------------------------


def in_pieces(tmp_path: Path, text: str, rows: int) -> tuple[np.ndarray, list[str]]:
    """Return the times of a text that is read in pieces of `rows` rows, and its losses."""
    (tmp_path / "log.csv").write_text(text)
    pieces = list(logs.read_chunks(tmp_path / "log.csv", rows))
    losses = [line for piece in pieces for line in named_losses(piece.attrs)]
    return np.concatenate([piece["time"] for piece in pieces]), losses


@pytest.mark.parametrize("rows", [7, 20, 1 << 16])
def test_counts_go_on(rows: int, tmp_path: Path) -> None:
    """Times of day beyond midnight, a count of 32 bits beyond its end, a logger beyond its restart."""
    stamps = [*pd.date_range("2022-05-04T23:59:50", periods=2000, freq="60s").strftime("%H:%M:%S")]
    stamps[610] = "23:59:59"  # damaged: it costs itself
    time, _ = in_pieces(tmp_path, "time,mag_x\n" + "".join(f"{stamp},1\n" for stamp in stamps), rows)
    np.testing.assert_allclose(np.delete(np.diff(time), 609), 60.0)
    first = 2**32 - 20 * 250_000
    wraps = lines("time_us,mag_x,mag_y,mag_z", lambda k: f"{(first + 250_000 * k) % 2**32},1,2,45000")
    time, _ = in_pieces(tmp_path, wraps, rows)
    np.testing.assert_allclose(np.diff(time), [0.25] * 39)
    for heading, step in (("millis", 100), ("time", 0.1)):
        text = lines(f"{heading},mag_x,mag_y,mag_z", lambda k: f"{step * (5 + k % 25)},1,2,45000", 50)  # noqa: B023
        time, losses = in_pieces(tmp_path, text, rows)
        assert (len(time), sum("started again" in line for line in losses)) == (50, 1)
        assert (np.diff(time) > 0).all()
        assert np.flatnonzero(np.diff(time) > 1.0).tolist() == [24]


@pytest.mark.parametrize("rows", [50, 1 << 16])
@pytest.mark.parametrize("late", [4, 2000])
@pytest.mark.parametrize("form", ["%Y-%m-%d,%H:%M:%S", "%Y,%m,%d,%H,%M,%S"])
def test_a_date_that_stays_at_midnight(form: str, late: int, rows: int, tmp_path: Path) -> None:
    """The date never changes, or some rows too late; one wrong time costs its own row."""
    true = pd.date_range("2024-02-28T23:59:30", periods=2000, freq="60s")
    dates = (true - pd.Timedelta(minutes=late)).map(lambda one: max(one, true[0])).strftime(form[:-8])
    cells = [*(dates + true.strftime(form[-8:]))]
    cells[610] = cells[610][:-8] + cells[0][-8:]
    header = "date,time" if ":" in form else "year,month,day,hour,min,sec"
    time, losses = in_pieces(tmp_path, f"{header},mag_x\n" + "".join(f"{one},1\n" for one in cells), rows)
    np.testing.assert_array_equal(time, np.delete(true.to_numpy("datetime64[s]").astype(float), 610))
    assert sum("passes midnight" in line for line in losses) == 1


def test_rows_without_times_come_at_a_rate_and_a_bad_one_leaves_its_place(tmp_path: Path) -> None:
    column = ["time=row [20 Hz]", *(f"mag_{axis}=column_{k}" for k, axis in enumerate("xyz", 1))]
    log = read(tmp_path, "187\t-420\t-538\n187\t-420\n190\t-410\t-530\n", name="sphere.txt", column=column)
    assert log["time"].values.tolist() == [0.0, 0.1]
    assert log["mag_x"].values.tolist() == [187.0, 190.0]
    assert log.attrs["time_reference"] == "boot"
    with_headings = read(tmp_path, "mx,my,mz\n1,2,3\n4,5,6\n", column=["time=row [4 Hz]"])
    assert with_headings["time"].values.tolist() == [0.0, 0.25]
    assert with_headings["mag_y"].values.tolist() == [2.0, 5.0]
