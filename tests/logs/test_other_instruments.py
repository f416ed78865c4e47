"""Test other instruments' text files: units, sensors, validity and clocks are found and reported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs import Options
from magbridge.logs.deployment import named_losses, passed_over

START = 1_700_000_000.0  # 2023-11-14T22:13:20Z
HEADER = "time,mag_x [nT],mag_y [nT],mag_z [nT]"


def read(tmp_path: Path, text: str, name: str = "log.csv", **options: Any) -> xr.Dataset:
    path = tmp_path / name
    path.write_text(text)
    return logs.read(path, options=Options(**options))


def table(header: str, row: Callable[[int], str], rows: int = 40) -> str:
    return "\n".join([header, *map(row, range(rows))]) + "\n"


def test_a_remark_in_brackets_is_not_a_unit_and_a_declaration_wins(tmp_path: Path) -> None:
    text = table(
        "time,Bx(raw),By(raw),Bz(raw),Hdg(mag)", lambda k: f"{START + k},20000,100,45000,{0.1 * k}", 5
    )
    log = read(tmp_path, text)
    assert log.attrs["heading_reference"] == "magnetic"
    assert float(log["mag_x"][0]) == 20_000.0
    declared = read(tmp_path, text, column=("heading=Hdg(mag) [rad]", "mag_x=Bx(raw) [mG]"))
    assert float(declared["heading"][1]) == pytest.approx(np.degrees(0.1))
    assert float(declared["mag_x"][0]) == 2_000_000.0


def test_latitude_and_longitude_come_from_one_pair_of_columns(tmp_path: Path) -> None:
    header = f"{HEADER},INS_LAT,INS_LON,LAT,LONG"
    log = read(tmp_path, table(header, lambda k: f"{START + k},1,2,45000,0.78,-1.32,45,-76"))
    assert (float(log["latitude"][0]), float(log["longitude"][0])) == (45.0, -76.0)
    header = f"{HEADER},Latitude,Longitude,Fish_Lat,Fish_Lon"
    towed = read(tmp_path, table(header, lambda k: f"{START + k},1,2,45000,45,-76,45.1,-76.1"))
    assert (float(towed["latitude"][0]), float(towed["longitude"][0])) == (45.1, -76.1)


def test_an_attitude_in_radians_is_recognised(tmp_path: Path) -> None:
    def row(k: int) -> str:
        yaw = (0.1 * k + np.pi) % (2 * np.pi) - np.pi
        return f"{START + k},1,2,45000,{0.4 * np.sin(k)},{0.3 * np.cos(k)},{yaw}"

    text = table(f"{HEADER},roll,pitch,yaw", row, 1_000)
    log = read(tmp_path, text)
    assert float(log["roll"].max()) == pytest.approx(np.degrees(0.4), rel=0.01)
    assert float(log["heading"].max()) > 175.0
    assert "in rad" in log.attrs["guessed"]
    declared = read(tmp_path, text, column=("heading=yaw [deg]",))
    assert float(declared["heading"].max()) < np.pi
    north = table(f"{HEADER},roll,pitch,yaw", lambda k: f"{START + k},1,2,45000,1,1,{0.1 * (k % 20)}")
    assert float(read(tmp_path, north)["heading"].max()) == pytest.approx(1.9)


def test_a_quoted_blank_is_an_empty_field(tmp_path: Path) -> None:
    header = (
        "Reading_Date,Reading_Time,Magnetic_Field,Weak_Signal,Measurement_Time,Mag_Latitude,Mag_Longitude"
    )
    text = table(header, lambda k: f'02-Jan-2020,03:04:{k % 60:02d}.000,{48_000 + k}," ",465,10,-20')
    log = read(tmp_path, text)
    assert float(log["total_field"][1]) == 48_001.0
    assert float(log["time"][1] - log["time"][0]) == 1.0
    assert float(log["longitude"][0]) == -20.0
    assert np.isnan(log["Weak_Signal"]).all()


def test_units_behind_the_numbers(tmp_path: Path) -> None:
    header = "/Date,Time,Field_Mag1,Alt_Mag1,Depth_Mag1,Longitude,Latitude,Zone"
    text = "/ SeaLINK\n" + table(
        header, lambda k: f"2020/01/02,03:04:{k:02d}.0,48000.0,20.50m,{30 + k}cm,-20,10,27P"
    )
    log = read(tmp_path, text, "line.xyz")
    assert float(log["depth"][1]) == pytest.approx(0.31)
    assert float(log["Alt_Mag1"][0]) == 20.5
    assert log["Alt_Mag1"].attrs["units"] == "m"
    assert float(log["total_field"][0]) == 48_000.0


def test_the_exchange_format_of_marine_cruises(tmp_path: Path) -> None:
    header = "SURVEY_ID\tTIMEZONE\tDATE\tTIME\tLAT\tLON\tMAG_TOT\tMAG_RES"
    text = table(header, lambda k: f"MADE\t0\t20050607\t{1730 + 0.5 * k:.3f}\t-30\t10\t{27_000 + k}\t3")
    for name in ("cruise.txt", "cruise.m77t"):
        log = read(tmp_path, text, name)
        np.testing.assert_allclose(log["time"][:2], [1_118_165_400.0, 1_118_165_430.0])  # 17:30:00, 17:30:30
        assert float(log["total_field"][1]) == 27_001.0


def test_a_count_of_32_bits_wraps_around(tmp_path: Path) -> None:
    start = 2**32 - 20 * 250_000
    text = table("time_us,mag_x,mag_y,mag_z", lambda k: f"{(start + 250_000 * k) % 2**32},1,2,45000")
    for rows in (1 << 16, 7):
        (tmp_path / "log.csv").write_text(text)
        pieces = list(logs.read_chunks(tmp_path / "log.csv", rows))
        time = np.concatenate([piece["time"] for piece in pieces])
        np.testing.assert_allclose(np.diff(time), 0.25)
        assert len(time) == 40


def test_a_logger_that_was_restarted_has_two_runs(tmp_path: Path) -> None:
    text = table("millis,mag_x,mag_y,mag_z", lambda k: f"{500 + 100 * (k % 25)},1,2,45000", 50)
    for rows in (1 << 16, 20):
        (tmp_path / "log.csv").write_text(text)
        pieces = list(logs.read_chunks(tmp_path / "log.csv", rows))
        time = np.concatenate([piece["time"] for piece in pieces])
        assert len(time) == 50
        steps = np.diff(time)
        assert (steps > 0).all()
        assert np.flatnonzero(steps > 1.0).tolist() == [24]
        lines = [line for piece in pieces for line in named_losses(piece.attrs)]
        assert sum("started again" in line for line in lines) == 1


def test_datcon_and_two_sensors_of_a_drone(tmp_path: Path) -> None:
    names = ("roll:C", "pitch:C", "yaw:C", "magX", "magY", "magZ")
    header = ["Tick#", "offsetTime", "GPS:Long", "GPS:Lat", "GPS:dateTimeStamp", "IMU_ATTI(0):Latitude"]
    header += [f"IMU_ATTI(0):{name}" for name in names] + [f"IMU_ATTI(1):mag{axis}" for axis in "XYZ"]

    def row(k: int) -> str:
        stamp = f"2023-11-14T22:13:{20 + k // 10}Z"
        return f"{k},{0.1 * k:.1f},-76,45,{stamp},0.785,1,2,{k},180,{k},500,170,{k},490"

    log = read(tmp_path, table(",".join(header), row))
    assert float(log["time"][0]) == pytest.approx(START, abs=0.11)
    np.testing.assert_allclose(np.diff(log["time"]), 0.1, atol=1e-6)
    assert (float(log["mag_x"][0]), float(log["mag2_x"][0])) == (18_000.0, 17_000.0)  # mG by the length
    assert (float(log["latitude"][0]), float(log["heading"][3])) == (45.0, 3.0)
    other = read(tmp_path, table(",".join(header), row), compass="1")
    assert float(other["mag_x"][0]) == 17_000.0


def test_sensys_is_dated_by_the_time_of_its_gps(tmp_path: Path) -> None:
    header = (
        "Timestamp [ms];B1x [nT];B1y [nT];B1z [nT];B2x [nT];B2y [nT];B2z [nT];GPSDate;GPSTime [hh:mm:ss.sss]"
    )

    def row(k: int) -> str:
        return f"{60 + 5 * k};18000;0;46000;18300;-200;46090;2026/11/27;10:10:36.{398 + 5 * k}"

    log = read(tmp_path, table(header, row))
    np.testing.assert_allclose(log["time"][:2], 1_795_774_236.398 + np.array([0.0, 0.005]), atol=1e-4)
    assert float(log["mag2_z"][0]) == 46_090.0
    assert "time_reference" not in log.attrs


def test_the_heading_of_a_date_states_its_order(tmp_path: Path) -> None:
    text = table(
        "time,nT,lat,lon,mm/dd/yyyy", lambda k: f"10:00:{k:02d}.00,{50_000 + k},56.8,24.1,11/05/2026"
    )
    log = read(tmp_path, text)
    assert np.datetime64(int(log["time"][0]), "s") == np.datetime64("2026-11-05T10:00:00")


def test_columns_that_state_what_is_valid(tmp_path: Path) -> None:
    header = "Date,Time,Latitude,Longitude,Valid,TMI,Bx,By,Bz"
    rows = table(
        header, lambda k: f"2026/11/27,10:00:{k:02d}.0,56.8,24.1,{int(k != 7)},50000,20000,100,45000"
    )
    log = read(tmp_path, rows)
    assert log.sizes["time"] == 39
    assert passed_over(log.attrs) == {"rows_dropped": 1}
    assert float(log["total_field"][0]) == 50_000.0
    quality = read(
        tmp_path,
        table(
            f"{HEADER},depth,DEPTH_QC,Flag",
            lambda k: f"{START + k},1,2,45000,5,{4 if k == 3 else 1},{int(k == 9)}",
        ),
    )
    assert quality.sizes["time"] == 39
    assert int(quality["depth"].isnull().sum()) == 1
    assert passed_over(quality.attrs) == {"rows_dropped": 1, "values_dropped": 1}


def test_json_lines_and_the_sentences_of_an_explorer(tmp_path: Path) -> None:
    def one(k: int) -> str:
        return (
            f'{{"ts":"27 Nov 2026 10:00:{k:02d}", "rt":20.1, "lt":21.0, "x":20.0, "y":-1.2, "z":45.1, '
            '"rx":1500, "ry":-90, "rz":3380}'
        )

    log = read(tmp_path, "\n".join(map(one, range(20))) + "\nbroken\n", "runmag.jsonl")
    assert (float(log["mag_x"][0]), float(log["sensor_temperature"][0])) == (20_000.0, 20.1)
    assert log.sizes["time"] == 20
    assert any("row 21" in line for line in named_losses(log.attrs))
    text = "\n".join(
        f"*26.331/10:00:{k:02d}.0 F:5000{k}.1 S:150 D:+003.0m A:008.2m L0 Q:99" for k in range(9)
    )
    explorer = read(tmp_path, text + "\n", "explorer.txt")
    assert np.datetime64(int(explorer["time"][1]), "s") == np.datetime64("2026-11-27T10:00:01")
    assert (float(explorer["total_field"][2]), float(explorer["depth"][0])) == (50_002.1, 3.0)


def test_a_format_that_is_not_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="GnssLogger"):
        read(tmp_path, "# \n# Header Description:\n# \n# UncalMag,utcTimeMillis\nUncalMag,1,2\n", "log.txt")


def test_the_total_field_of_an_observatory_has_one_source(tmp_path: Path) -> None:
    header = f"{' Format                 IAGA-2002':69}|\n"
    header += "DATE       TIME         DOY     TSTX      TSTY      TSTZ      TSTF   |\n"
    totals = ["99999.00" if k % 3 else "49260.00" for k in range(30)]
    rows = [
        f"2024-01-01 00:{k:02d}:00.000 001     20000.00   1000.00  45000.00  {total}"
        for k, total in enumerate(totals)
    ]
    log = read(tmp_path, header + "\n".join(rows) + "\n", "station.txt")
    assert len(np.unique(log["total_field"].dropna("time"))) == 1


def test_a_value_measured_at_a_row_is_the_value_of_that_row(tmp_path: Path) -> None:
    header = "dbd_label: DBD_ASC(dinkum_binary_data_ascii)file\nencoding_ver: 2\nnum_ascii_tags: 3\n"
    names = "m_present_time m_roll m_depth\ntimestamp rad m\n8 4 4\n"
    rows = "\n".join(f"{START + 60 * k} {0.1 if k % 10 == 0 else 'NaN'} {k}" for k in range(60))
    log = read(tmp_path, header + names + rows + "\n", "rare.dba")
    np.testing.assert_allclose(log["roll"][::10], np.degrees(0.1))
