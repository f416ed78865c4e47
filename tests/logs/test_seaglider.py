"""A Seaglider's dive, made by hand: the real ones are not ours to keep here."""

from __future__ import annotations

from pathlib import Path

import netCDF4
import numpy as np
import ppigrf
import pytest
import xarray as xr

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.deployment import named_losses

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
"""Variable -> its dimension, and its values."""


def dive(path: Path, **changed: tuple[str, np.ndarray]) -> xr.Dataset:
    """Read a file of the dive, with some variables changed."""
    with netCDF4.Dataset(path, "w") as file:
        for dimension, rows in SIZES.items():
            file.createDimension(dimension, rows)
        for name, (dimension, values) in (DIVE | changed).items():
            file.createVariable(name, "f8", (dimension,) if dimension else ())[...] = values
    return logs.read(path)


def test_a_dive_across_the_date_line(tmp_path: Path) -> None:
    """Its positions are at the times of its CTD, and rows between two of them are interpolated."""
    read = dive(tmp_path / "p1670001.nc")
    east = np.array([-3, -2, -1, 0, 1, 2, 3]) * 0.01
    np.testing.assert_allclose((read["longitude"] + 360.0) % 360.0, 180.0 + east, atol=1e-9)
    assert float(np.abs(read["longitude"]).max()) <= 180.0


def test_a_motor_s_current_is_that_of_its_manoeuvre(tmp_path: Path) -> None:
    read = dive(tmp_path / "p1670001.nc")
    np.testing.assert_array_equal(read["vbd_current"], [0.0, 1.5, 1.5, 0.0, 0.0, 2.0, 0.0])


def test_variables_of_another_length_than_their_times_are_left_out(tmp_path: Path) -> None:
    """As in a file that somebody has cut: a channel of the magnetometer is missed aloud."""
    path, short = tmp_path / "p1670001.nc", ("gc_event", np.zeros(2))
    whole = set(dive(path))
    for name, column in (("latitude", "latitude"), ("eng_head", "heading")):
        assert set(dive(path, **{name: short})) == whole - {column}
    assert set(dive(path, gc_end_secs=("ctd_data_point", np.zeros(3)))) == whole - {"vbd_current"}
    with pytest.raises(FormatError, match="column 'eng_mag_y': expected this variable, as of a Seaglider"):
        dive(path, eng_mag_y=short)


def test_a_dive_whose_compass_was_not_logged_raw(tmp_path: Path) -> None:
    """Most Seagliders': attitude and masses can still be planned with, and simulated."""
    short = dict.fromkeys((f"eng_mag_{axis}" for axis in "xyz"), ("gc_event", np.zeros(2)))
    read = dive(tmp_path / "p1670001.nc", **short)
    assert {"heading", "longitude", "vbd_current"} <= set(read)
    assert not {"mag_x", "mag_y", "mag_z"} & set(read)
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


def test_the_second_compass_may_be_in_use(tmp_path: Path) -> None:
    second = {**device(33, 2048 + 4), "log_COMPASS2_DEVICE": ("", np.array(66.0))}
    assert (dive(tmp_path / "p1670001.nc", **second)["mag_x"] == 200.0 * 56).all()


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


def test_masses_that_are_logged_with_every_sample_stay(tmp_path: Path) -> None:
    logged = {"eng_pitchCtl": ("sg_data_point", np.arange(7.0))}
    np.testing.assert_array_equal(
        dive(tmp_path / "p1670001.nc", **logged, **MEASURED)["pitchCtl"], np.arange(7.0)
    )


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
