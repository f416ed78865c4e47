"""Test the readers of Seaglider, SeaExplorer and Slocum logs."""

import datetime
import gzip
import shutil
from pathlib import Path

import netCDF4
import numpy as np
import ppigrf
import pytest
import xarray as xr
from log_files import CRC, segment

from magbridge import logs
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError
from magbridge.logs.deployment import named_losses, passed_over

SIZES = {"sg_data_point": 7, "ctd_data_point": 3, "gc_event": 2}
DIVE = {
    "time": ("sg_data_point", 1e9 + 10.0 * np.arange(7)),
    **{f"eng_mag_{axis}": ("sg_data_point", np.full(7, 200.0)) for axis in "xyz"},
    "eng_head": ("sg_data_point", np.array([350.0, 355, 0, 5, 10, 15, 20])),
    "ctd_time": ("ctd_data_point", 1e9 + 30.0 * np.arange(3)),
    "latitude": ("ctd_data_point", np.full(3, -17.0)),
    "longitude": ("ctd_data_point", np.array([179.97, -180.0, -179.97])),
    "gc_st_secs": ("gc_event", 1e9 + np.array([10.0, 50.0])),
    "gc_end_secs": ("gc_event", 1e9 + np.array([25.0, 50.0])),
    "gc_vbd_i": ("gc_event", np.array([1.5, 2.0])),
}
"""Variables of a dive by name: dimension and values."""


def dive(path: Path, **changed: tuple[str, np.ndarray]) -> xr.Dataset:
    """Read a file of the dive, with some variables changed."""
    with netCDF4.Dataset(path, "w") as file:
        for dimension, rows in SIZES.items():
            file.createDimension(dimension, rows)
        for name, (dimension, values) in (DIVE | changed).items():
            file.createVariable(name, "f8", (dimension,) if dimension else ())[...] = values
    return logs.read(path)


def test_a_dive_across_the_date_line(tmp_path: Path) -> None:
    """The dive's positions are at the times of its CTD, and rows between them are interpolated."""
    read = dive(tmp_path / "p1670001.nc")
    east = np.array([-3, -2, -1, 0, 1, 2, 3]) * 0.01
    np.testing.assert_allclose((read["longitude"] + 360.0) % 360.0, 180.0 + east, atol=1e-9)
    assert float(np.abs(read["longitude"]).max()) <= 180.0
    # a motor's current is that of its manoeuvre
    np.testing.assert_array_equal(read["vbd_current"], [0.0, 1.5, 1.5, 0.0, 0.0, 2.0, 0.0])


def test_variables_of_another_length_than_their_times_are_left_out(tmp_path: Path) -> None:
    """A truncated file has such variables; the reader reports a missing channel of the magnetometer."""
    path, short = tmp_path / "p1670001.nc", ("gc_event", np.zeros(2))
    whole = set(dive(path))
    for name, column in (("latitude", "latitude"), ("eng_head", "heading")):
        assert set(dive(path, **{name: short})) == whole - {column}
    assert set(dive(path, gc_end_secs=("ctd_data_point", np.zeros(3)))) == whole - {"vbd_current"}
    with pytest.raises(FormatError, match="column 'eng_mag_y': expected this variable, as of a Seaglider"):
        dive(path, eng_mag_y=short)
    # most Seagliders log no raw compass: attitude and masses can still be planned with, and simulated
    read = dive(path, **dict.fromkeys((f"eng_mag_{axis}" for axis in "xyz"), short))
    assert set(read) == whole - {*CHANNELS}
    assert "no raw compass" in "".join(named_losses(read.attrs))


def device(number: float, use: float = 4.0) -> dict[str, tuple[str, np.ndarray]]:
    return {"log_COMPASS_DEVICE": ("", np.array(number)), "log_COMPASS_USE": ("", np.array(use))}


@pytest.mark.parametrize(
    ("number", "count"), [(33, 100), (34, 100), (97, 100), (18, 100), (66, 56), (65, 56)]
)
def test_a_count_is_what_the_compass_says(number: float, count: float, tmp_path: Path) -> None:
    read = dive(tmp_path / "p1670001.nc", **device(number))
    assert (read["mag_x"] == 200.0 * count).all()
    assert read.attrs["mag_scale_nT_per_count"] == count
    assert not named_losses(read.attrs)
    second = {**device(33, 2048 + 4), "log_COMPASS2_DEVICE": ("", np.array(number))}
    assert (dive(tmp_path / "p1670001.nc", **second)["mag_x"] == 200.0 * count).all()


def test_counts_of_unknown_size_are_as_long_as_the_field(tmp_path: Path) -> None:
    """The unit is estimated for any iron, and it is reported."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(7, 3))
    counts = 731.0 * direction / np.linalg.norm(direction, axis=1)[:, None] + [90.0, -300.0, 40.0]
    channels = {f"eng_mag_{axis}": ("sg_data_point", counts[:, k]) for k, axis in enumerate("xyz")}
    path = tmp_path / "p1670001.nc"
    read = dive(path, **channels, **device(16 * 9 + 2))
    east, north, up = (
        float(one.item()) for one in ppigrf.igrf(180.0, -17.0, 0.0, np.datetime64(10**9, "s").item())
    )
    assert read.attrs["mag_scale_nT_per_count"] == pytest.approx(
        np.hypot(np.hypot(east, north), up) / 731.0, rel=1e-3
    )
    (line,) = named_losses(read.attrs)
    assert line.startswith(f"{path}: COMPASS_DEVICE 146 is not known: counts of unknown size, taken as ")
    (line,) = named_losses(dive(path).attrs)
    assert line == f"{path}: no COMPASS_DEVICE: a count of the compass is taken as 100 nT"


MEASURED = {
    "gc_pitch_ad_start": ("gc_event", np.array([110.0, 2600.0])),
    "gc_pitch_ad": ("gc_event", np.array([2600.0, 2800.0])),
    "log_C_PITCH": ("", np.array(2840.0)),
    "log_PITCH_CNV": ("", np.array(0.003)),
}


def test_masses_move_in_manoeuvres_and_rest_between(tmp_path: Path) -> None:
    """Manoeuvres from 10 to 25 s and at 50 s; samples every 10 s."""
    commanded = {"gc_pitch_ctl": ("gc_event", np.array([-0.7, 1.5]))}
    read = dive(tmp_path / "p1670001.nc", **commanded)["pitchCtl"]
    np.testing.assert_allclose(read, [np.nan, np.nan, np.nan, -0.7, -0.7, 1.5, 1.5])
    read = dive(tmp_path / "p1670001.nc", **commanded, **MEASURED)["pitchCtl"]
    at, rest, last = (0.003 * (ad - 2840.0) for ad in (110.0, 2600.0, 2800.0))
    np.testing.assert_allclose(read, [np.nan, at, at + (rest - at) * 10 / 15, rest, rest, last, last])
    logged = {"eng_pitchCtl": ("sg_data_point", np.arange(7.0))}  # with every sample
    read = dive(tmp_path / "p1670001.nc", **logged, **MEASURED)["pitchCtl"]
    np.testing.assert_array_equal(read, np.arange(7.0))


ENG = """%version: 67.01
%glider: 272
%mission: 2
%dive: 2
%start: 02 03 126 19 35 52
%columns: elaps_t_0000,elaps_t,depth,head,pitchAng,rollAng,rec,mag.x,mag.y,mag.z
%data:
70570.029 18.0 142.0 105.6 -63.0 -1.5 0.0 1088.0 184.0 575.0
70580.033 28.0 149.0 94.0 -57.6 9.7 1.0 1073.0 271.0 640.0
70590.025 38.0 161.0 93.0 -57.6
70600.025 48.0 171.0 92.0 -50.6 9.0 3.0 1070.0 270.0 641.0
"""
LOG = """version: 67.01
glider: 272
mission: 2
dive: 2
start: 2 3 126 19 35 52
data:
$C_PITCH,2240
$PITCH_CNV,0.0041299998
$COMPASS_USE,16388
$COMPASS_DEVICE,66
$GPS2,030226,193532,4654.710,-12454.180,3,0.8,3,15.3
$GCHEAD,st_secs,pitch_ctl,pitch_ad_start,end_secs,pitch_i,pitch_ad
$GC,7.46,-1.35,235.8,27.46,0.3,1911.81
$GC,damaged
$GPS,030226,200233,4654.708,-12454.235,1,0.9,3,15.3
"""


def test_a_dive_as_the_glider_sends_it(tmp_path: Path) -> None:
    (tmp_path / "p2720002.eng").write_text(ENG)
    (tmp_path / "p2720002.log").write_text(LOG)
    read = logs.read(tmp_path / "p2720002.eng")
    assert logs.read(sorted(tmp_path.iterdir())).equals(read)
    assert logs.read(tmp_path / "p2720002.log").equals(read)
    start = np.datetime64("2026-02-03T19:35:52").astype(float)
    np.testing.assert_array_equal(read["time"], start + np.array([18.0, 28.0, 48.0]))
    np.testing.assert_allclose(read["depth"], [1.42, 1.49, 1.71])
    np.testing.assert_array_equal(read["mag_y"], 56.0 * np.array([184.0, 271.0, 270.0]))
    np.testing.assert_allclose(read["pitchCtl"][1:], (1911.81 - 2240) * 0.0041299998)
    assert float(read["pitch_current"][0]) == 0.3
    np.testing.assert_allclose(read["latitude"], 46 + 54.71 / 60, atol=1e-5)
    assert read.attrs["heading_reference"] == "magnetic"
    (tmp_path / "p2720002.log").unlink()
    assert "pitchCtl" not in logs.read(tmp_path / "p2720002.eng")


# ---- a SeaExplorer's files and an observatory's, made by hand after the formats ----------------------------


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
    """The mass positions are interpolated between the navigation's samples of one dive only."""
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
    both = logs.read([tmp_path / "sea035.12.gli.sub.36.gz", tmp_path / name])
    assert not both.attrs.get("duplicate_rows")  # the navigation is not read twice
    np.testing.assert_array_equal(both["time"], back["time"])


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
    rows = ["3000.00 4000.00 12000.00 13000.00", "3000.00 4000.00 12000.00 99999.00", "99999.00 " * 4]
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


# ---- A Slocum's segments, made by hand after the format that dbdreader reads -----------------------------


dbdreader = pytest.importorskip("dbdreader")

T0_SLOCUM = 1_704_067_200.0


K = np.arange(50.0)
FLIGHT = {
    "m_present_time": T0_SLOCUM + 4.0 * K, "m_depth": 0.5 * K, "m_battpos": np.cos(K),
    "m_pitch": 0.4 * np.sin(K),
}  # fmt: skip
SCIENCE = {
    "sci_m_present_time": T0_SLOCUM + 1.0 + 4.0 * K,
    "sci_water_temp": np.where(K > 3, 9.0 + 0.01 * K, 0.0),
    "sci_water_pressure": np.where(K > 3, 0.05 * K, 0.0),
}


def test_every_column_is_dbdreaders(tmp_path: Path) -> None:
    segment(tmp_path / "a.sbd", FLIGHT)
    segment(tmp_path / "a.tbd", SCIENCE)
    back = logs.read(tmp_path / "a.sbd")
    other = dbdreader.DBD(str(tmp_path / "a.sbd"))
    for theirs, ours, factor in (
        ("m_depth", "depth", 1.0), ("m_battpos", "battpos", 1.0), ("m_pitch", "pitch", 180.0 / np.pi),
    ):  # fmt: skip
        when, what = other.get(theirs)
        np.testing.assert_array_equal(np.interp(back["time"], when, what * factor), back[ours])
    assert back.sizes["time"] == 49  # dbdreader leaves the first cycle out: it repeats earlier values
    # what a science computer starts with was not measured
    back = logs.read(tmp_path / "a.tbd")
    assert (back["water_temperature"] > 9.0).all()
    assert float(back["water_pressure"].min()) == 0.05 * 4
    # a temperature of zero at depth is one
    segment(tmp_path / "a.tbd", SCIENCE | {"sci_water_temp": np.zeros(50)})
    assert (logs.read(tmp_path / "a.tbd")["water_temperature"] == 0.0).all()


@pytest.mark.parametrize("folder", [".", "cac", "../cac", "cache"])
def test_the_list_of_sensors_may_be_in_a_folder(folder: str, tmp_path: Path) -> None:
    logged = tmp_path / "logs"
    logged.mkdir()
    segment(logged / "a.sbd", FLIGHT, factored=True)
    (logged / folder).mkdir(exist_ok=True)
    (logged / f"{CRC}.cac").rename(logged / folder / f"{CRC}.cac")
    assert logs.read(logged / "a.sbd")["battpos"].notnull().all()


# ---- Measured data -----------------------------------------------------------------------------------------


pytestmark = pytest.mark.real


@pytest.fixture
def seaglider(real_data: Path) -> list[Path]:
    return sorted((real_data / "seaglider_sg167").glob("*.nc"))


def test_seaglider_axes_and_scale_are_ours(seaglider: list[Path]) -> None:
    """Regression of the channels on IGRF turned by the logged attitude: one to one, axis by axis."""
    back = logs.read(seaglider, required=CHANNELS)
    assert back.sizes["time"] == 1336 + 1322 + 1383 + 1321 + 1378
    assert back.attrs["heading_reference"] == "magnetic"
    east, north, up = (float(f.item()) for f in ppigrf.igrf(84.7, 8.15, 0, datetime.datetime(2014, 9, 16)))
    horizontal = np.hypot(east, north)
    roll, pitch, heading = (np.radians(back[name].values) for name in ("roll", "pitch", "heading"))
    ahead, right, down = horizontal * np.cos(heading), -horizontal * np.sin(heading), -up
    expected = np.column_stack([
        np.cos(pitch) * ahead - np.sin(pitch) * down,
        np.cos(roll) * right + np.sin(roll) * (np.sin(pitch) * ahead + np.cos(pitch) * down),
        -np.sin(roll) * right + np.cos(roll) * (np.sin(pitch) * ahead + np.cos(pitch) * down),
        np.ones(len(roll)),
    ])  # fmt: skip
    measured = np.column_stack([back[name] for name in CHANNELS])
    matrix, *_ = np.linalg.lstsq(expected, measured)
    np.testing.assert_allclose(np.diag(matrix[:3]), 1, atol=0.06)
    np.testing.assert_allclose(matrix[:3] - np.diag(np.diag(matrix[:3])), 0, atol=0.01)
    np.testing.assert_allclose(np.std(measured - expected @ matrix, axis=0), 0, atol=350)  # nT: 3.5 counts


def test_slocum(real_data: Path) -> None:
    files = sorted((real_data / "slocum_comet").glob("*.?bd"))
    back = logs.read(files)
    flight_only = logs.read([path for path in files if path.suffix == ".dbd"])
    # a pair is one deployment, however named
    np.testing.assert_array_equal(back["battpos"], flight_only["battpos"])
    assert back.sizes["time"] == flight_only.sizes["time"] > 3000
    assert not back.attrs.get("duplicate_rows")  # nor is one read twice
    assert not set(CHANNELS) & set(back.data_vars)
    assert back["battpos"].attrs["units"] == "in"
    for name, low, high in (
        ("battpos", 0.05, 1.5), ("ballast", -232, 232), ("pitch", -40, 35), ("roll", -25, 45),
        ("heading", 0, 360), ("coulomb_current", 0.1, 3.2), ("latitude", 54.7, 54.8), ("longitude", 15, 15.2),
        ("depth", -0.1, 42), ("water_temperature", 5, 18), ("vehicle_temperature", 14, 19),
    ):  # fmt: skip
        assert low <= back[name].min(), name
        assert back[name].max() <= high, name
        assert np.isfinite(back[name]).mean() > 0.98, name


def test_slocum_without_its_list_of_sensors(real_data: Path, tmp_path: Path) -> None:
    shutil.copy(real_data / "slocum_comet" / "comet-2016-174-05-001.dbd", tmp_path)
    with pytest.raises(
        FormatError, match=r"001\.dbd: expected 11d38bfd\.cac, the list of its sensors, next to it or in"
    ):
        logs.read(tmp_path / "comet-2016-174-05-001.dbd")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_truncated_slocum(real_data: Path, tmp_path: Path, kept: float) -> None:
    for path in (real_data / "slocum_comet").glob("*.cac"):
        shutil.copy(path, tmp_path)
    data = (real_data / "slocum_comet" / "comet-2016-174-05-001.dbd").read_bytes()
    (tmp_path / "a.dbd").write_bytes(data[: int(kept * len(data))])
    assert logs.read(tmp_path / "a.dbd").sizes["time"] < 700


def test_compressed_slocum(real_data: Path, tmp_path: Path) -> None:
    """A ``.dcd`` is a ``.dbd`` in LZ4 blocks of 32 KiB, each after its size."""
    block = pytest.importorskip("lz4.block")
    folder = real_data / "slocum_comet"
    for path in folder.glob("*.cac"):
        shutil.copy(path, tmp_path)
    for suffix, packed in ((".dbd", ".dcd"), (".ebd", ".ecd")):
        data = (folder / f"comet-2016-174-05-001{suffix}").read_bytes()
        pieces = [block.compress(data[k : k + 32768], store_size=False) for k in range(0, len(data), 32768)]
        (tmp_path / f"a{packed}").write_bytes(b"".join(len(p).to_bytes(2, "big") + p for p in pieces))
    back, plain = logs.read(tmp_path / "a.dcd"), logs.read(folder / "comet-2016-174-05-001.dbd")
    for name in plain.variables:
        np.testing.assert_array_equal(back[name].values, plain[name].values, err_msg=str(name))


def test_damaged_ardusub_is_read_to_its_end(real_data: Path) -> None:
    back = logs.read(real_data / "ardusub" / "damaged.tlog")
    assert back.sizes["time"] == 627
    assert float(back["time"][-1] - back["time"][0]) == pytest.approx(312.9, abs=0.1)
    assert back.attrs["damages"] > 1900
    assert 80_000 < back.attrs["bytes_skipped"] < 90_000
    streamed = list(logs.read_chunks(real_data / "ardusub" / "damaged.tlog", 100))
    assert passed_over(*(piece.attrs for piece in streamed)) == passed_over(back.attrs)
    np.testing.assert_array_equal(np.concatenate([piece["mag_y"] for piece in streamed]), back["mag_y"])
