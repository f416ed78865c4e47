"""Exchange of files with programs for drone surveys: MagComPy and GeoHammer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import magbridge as mb
from magbridge.errors import FormatError
from magbridge.logs import Options, write
from magbridge.records import Quality

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


def test_a_magarrow_file_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "out.magarrow.csv"
    write(survey(), path)
    back = mb.read(path)
    np.testing.assert_allclose(back["mag_x"], survey()["mag_x"])
    np.testing.assert_allclose(back["mag_y"], survey()["mag_y"])
    np.testing.assert_allclose(back["total_field"], [51383.1835, np.nan, np.nan])
    np.testing.assert_allclose(back["line"], [100.0, 100.0, 200.0])


def test_a_log_without_a_position_is_not_written_for_survey_programs(tmp_path: Path) -> None:
    path = tmp_path / "out.magarrow.csv"
    with pytest.raises(FormatError, match=r"out\.magarrow\.csv: column 'latitude': expected this column"):
        write(survey().drop_vars("latitude"), path)
    assert not list(tmp_path.iterdir())


def test_names_of_survey_lines_become_numbers(tmp_path: Path) -> None:
    path = tmp_path / "sea.csv"
    rows = [(0, "L10"), (1, "L10"), (2, "north tie"), (3, "L20"), (4, "L10"), (5, "")]
    text = "".join(f"9-Sep-2020,12:00:0{k},5000{k}.0,56.0,24.1,{name}\n" for k, name in rows)
    path.write_text("Reading_Date,Reading_Time,Magnetic_Field,Mag_Latitude,Mag_Longitude,Line_Name\n" + text)
    lines = mb.read(path)["line"].to_numpy()
    np.testing.assert_array_equal(lines, [10.0, 10.0, 1_000_001.0, 20.0, 10.0, np.nan])
