"""A SeaExplorer's files and an observatory's, made by hand after the formats."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.deployment import passed_over

GLI = """Timestamp;NavState;Heading;Declination;Pitch;Roll;Depth;Lat;Lon;BallastPos;LinPos;AngPos;Voltage;
21/07/2019 23:24:49;117;106.41;16;63.25;-1.97;4.3;4854.554;-13036.442;404.0;20.1;-0.5;28.5;
21/07/2019 23:24:59;115;116.68;16;46.56;1.72;3.4;4854.560;-13036.450;348.5;61.8;-0.5;28.8;
damaged;1;2;3;4;5;6;7;8;9;10;11;12;13;14;15;
21/07/2019 23:25:09;115;118.68;16;46.56;1.72;3.4;9999;9999;300.5;61.8;-0.5;28.8;
"""
PLD = """PLD_REALTIMECLOCK;NAV_LONGITUDE;NAV_LATITUDE;NAV_DEPTH;MAG_X;MAG_Y;MAG_Z;LEGATO_TEMPERATURE;OTHER;
21/07/2019 23:25:02.737;-13036.442;4854.554;3.424;17000;100;50000;15.653;9999.00;
21/07/2019 23:25:32.745;-13036.442;4854.554;2.514;17010;;50010;;7;
"""
T0 = float(np.datetime64("2019-07-21T23:24:49").astype(int))


@pytest.mark.parametrize("packed", [False, True])
def test_navigation_of_a_seaexplorer(packed: bool, tmp_path: Path) -> None:
    path = tmp_path / ("sea035.12.gli.sub.36" + ".gz" * packed)
    path.write_bytes(gzip.compress(GLI.encode()) if packed else GLI.encode())
    back = logs.read(path)
    np.testing.assert_array_equal(back["time"], T0 + np.array([0.0, 10.0, 20.0]))
    np.testing.assert_allclose(back["latitude"], [48 + 54.554 / 60, 48 + 54.56 / 60, np.nan])
    np.testing.assert_allclose(back["longitude"], [-130 - 36.442 / 60, -130 - 36.45 / 60, np.nan])
    np.testing.assert_array_equal(back["ballast"], [404.0, 348.5, 300.5])
    np.testing.assert_array_equal(back["battpos"], [20.1, 61.8, 61.8])
    assert back["battpos"].attrs["units"] == "mm"
    assert passed_over(back.attrs) == {"rows_dropped": 1}
    assert "headings are taken as true" in back.attrs["losses"]


@pytest.mark.parametrize("name", ["sea035.12.pld1.sub.36", "sea035.12.pld1.raw.36"])
def test_the_payload_s_rows_know_where_the_masses_were(name: str, tmp_path: Path) -> None:
    """Between the navigation's samples of the same dive, not of another."""
    (tmp_path / "sea035.12.gli.sub.36.gz").write_bytes(gzip.compress(GLI.encode()))
    (tmp_path / "sea035.12.gli.sub.3").write_text(GLI.replace("20.1", "99.9"))
    (tmp_path / name).write_text(PLD)
    back = logs.read(tmp_path / name)
    assert back.sizes["time"] == 2
    np.testing.assert_allclose(back["ballast"][0], 348.5 + (300.5 - 348.5) * 0.3737, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(back["battpos"], [61.8, 61.8])
    np.testing.assert_allclose(back["heading"], [116.68 + 2 * 0.3737, 118.68], rtol=0, atol=1e-4)
    assert back["battpos"].attrs["units"] == "mm"
    np.testing.assert_allclose(back["depth"], [3.424, 2.514])
    assert "between the samples of sea035.12.gli.sub.36.gz" in back.attrs["history"]


def test_payload_of_a_seaexplorer(tmp_path: Path) -> None:
    path = tmp_path / "sea035.12.pld1.sub.36"
    path.write_text(PLD)
    back = logs.read(path, required=("mag_x", "mag_y", "mag_z"))
    np.testing.assert_allclose(back["time"], T0 + np.array([13.737, 43.745]), atol=1e-6)
    np.testing.assert_array_equal(back["mag_y"], [100.0, np.nan])
    np.testing.assert_array_equal(back["water_temperature"], [15.653, np.nan])
    np.testing.assert_array_equal(back["other"], [np.nan, 7.0])
    (tmp_path / "sea035.12.gli.sub.36").write_text(GLI)
    assert logs.read(sorted(tmp_path.iterdir())).sizes["time"] == 5


def test_a_gzip_file_that_is_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "sea035.12.gli.sub.36.gz"
    path.write_bytes(gzip.compress(GLI.encode())[:-30])
    with pytest.raises(FormatError, match="expected a whole compressed file"):
        logs.read(path)


IAGA = """ Format                 IAGA-2002                                    |
 Source of Data         Made                                         |
 IAGA Code              MDE                                          |
 Geodetic Latitude      48.500                                       |
 Geodetic Longitude     301.500                                      |
 Reported               {elements}                                         |
DATE       TIME         DOY     {heads}   |
2024-05-10 00:00:00.000 131     {rows[0]}
2024-05-10 00:01:00.000 131     {rows[1]}
nonsense
2024-05-10 00:02:00.000 131     {rows[2]}
"""


@pytest.mark.parametrize(("elements", "first"), [("XYZF", 3.0), ("HDZF", 3.0), ("XYZS", 3.0)])
def test_an_observatory(elements: str, first: float, tmp_path: Path) -> None:
    path = tmp_path / "mde20240510vmin.min"
    rows = [
        "3000.00 4000.00 12000.00 13000.00",
        "3000.00 4000.00 12000.00 99999.00",
        " ".join(["99999.00"] * 4),
    ]
    heads = "   ".join(f"MDE{one}" for one in elements)
    path.write_text(IAGA.format(elements=elements, heads=heads, rows=rows))
    back = logs.read(path)
    start = float(np.datetime64("2024-05-10").astype("datetime64[s]").astype(int))
    np.testing.assert_array_equal(back["time"], start + np.array([0.0, 60.0, 120.0]))
    np.testing.assert_allclose(back["total_field"], [13000.0, np.nan, np.nan])  # one source for all rows
    np.testing.assert_array_equal(back[f"observatory_{elements[0].lower()}"], [3000.0, 3000.0, np.nan])
    assert float(back["longitude"][0]) == -58.5
    assert back.attrs["observatory"] == "MDE"
    assert passed_over(back.attrs) == {"rows_dropped": 1}
