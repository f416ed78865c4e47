"""Test netCDF files with different layouts of third-party programs, compared with xarray."""

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
from commands import Command
from pages import blocks

from magbridge import logs
from magbridge.logs.deployment import deployment, named_losses

N = 6
T0 = 1.7e9
TIME = {"units": "seconds since 1970-01-01T00:00:00Z", "standard_name": "time"}
Variables = dict[str, tuple[str, Any, dict[str, Any]]]


def made(path: Path, dimensions: dict[str, int], variables: Variables) -> Path:
    """Write a file: name -> dimensions, values, attributes (``_FillValue`` and all)."""
    with netCDF4.Dataset(path, "w") as file:
        for name, size in dimensions.items():
            file.createDimension(name, size)
        for name, (along, values, attrs) in variables.items():
            fill = attrs.pop("_FillValue", None)
            one = file.createVariable(name, np.asarray(values).dtype, tuple(along.split()), fill_value=fill)
            one.set_auto_maskandscale(False)
            one.setncatts(attrs)
            one[...] = values
    return path


def flown(along: str, **names: str) -> Variables:
    """Return the variables of a flight along a dimension, with other `names` for some."""
    k = np.arange(float(N))
    columns: Variables = {
        "time": (along, T0 + 10.0 * k, dict(TIME)),
        "latitude": (along, 47.0 + 1e-4 * k, {"units": "degrees_north", "standard_name": "latitude"}),
        "longitude": (along, -52.0 - 1e-4 * k, {"units": "degree_east", "standard_name": "longitude"}),
        "depth": (along, 3.0 * k, {"units": "m", "standard_name": "depth", "positive": "down"}),
        "pitch": (along, np.radians(5.0 * k), {"units": "rad", "standard_name": "platform_pitch_angle"}),
        "mag_x": (along, 20.0 + k, {"units": "microtesla"}),
        "mag_y": (along, 2.0 + k, {"units": "microtesla"}),
        "mag_z": (along, 45.0 + k, {"units": "microtesla"}),
        "battpos": (along, (0.1 * k).astype("f4"), {"units": "cm"}),
    }
    return {names.get(name, name): one for name, one in columns.items()}


CAPITALS = {name: name.upper() for name in flown("x")}
DAYS = 7305.0 + (T0 + 10.0 * np.arange(N)) / 86_400.0
"""Times, days since 1950."""
NANOSECONDS = ((T0 + 10.0 * np.arange(N)) * 1e9).astype("i8")
NORTH = {"standard_name": "latitude", "units": "degree_north"}
SHAPES: dict[str, tuple[dict[str, int], Variables]] = {
    "pyglider": ({"time": N}, flown("time")),
    "IOOS Glider DAC": (
        {"time": N, "traj_strlen": 4},
        flown("time", pitch="m_pitch", mag_x="magnetometer_x", mag_y="magnetometer_y", mag_z="magnetometer_z")
        | {"profile_time": ("", np.array(T0), dict(TIME)), "time_uv": ("", np.array(T0), dict(TIME))},
    ),
    "OG1.0": (
        {"N_MEASUREMENTS": N, "N_PARAM": 3},
        flown("N_MEASUREMENTS", **CAPITALS)
        | {"TIME_GPS": ("N_PARAM", T0 + np.arange(3.0), dict(TIME))}
        | {"LATITUDE_GPS": ("N_MEASUREMENTS", np.full(N, 48.0), NORTH)},
    ),
    "EGO": (
        {"TIME": N, "TIME_GPS": 2},
        flown("TIME", **CAPITALS) | {"TIME_GPS": ("TIME_GPS", T0 + np.arange(2.0), dict(TIME))},
    ),
    "discrete samplings": ({"trajectory": 1, "obs": N}, {
        name: ("trajectory obs", values[None], attrs) for name, (_, values, attrs) in flown("obs").items()
    }),
    "Argo": (
        {"N_MEASUREMENT": N},
        flown("N_MEASUREMENT", **CAPITALS | {"time": "JULD"})
        | {"JULD": ("N_MEASUREMENT", DAYS, {
            "units": "days since 1950-01-01 00:00:00 UTC", "standard_name": "time"})},
    ),
    "nanoseconds": (
        {"row": N},
        flown("row", time="when")
        | {"when": ("row", NANOSECONDS, {"units": "nanoseconds since 1970-01-01"})},
    ),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_any_trajectory_is_read_by_its_meaning(shape: str, tmp_path: Path) -> None:
    path = made(tmp_path / "log.nc", *SHAPES[shape])
    back, k = logs.read(path), np.arange(float(N))
    np.testing.assert_allclose(back["time"], T0 + 10.0 * k, atol=1e-3)
    np.testing.assert_allclose(back["latitude"], 47.0 + 1e-4 * k)
    np.testing.assert_allclose(back["longitude"], -52.0 - 1e-4 * k)
    np.testing.assert_allclose(back["depth"], 3.0 * k)
    np.testing.assert_allclose(back["pitch"], 5.0 * k)
    np.testing.assert_allclose(back["mag_z"], 1e3 * (45.0 + k))
    np.testing.assert_array_equal(back["battpos"], (0.1 * k).astype("f4"))
    assert back["battpos"].attrs["units"] == "cm"
    with xr.open_dataset(path, decode_times=False) as other:  # each column as another reader has it
        for name in ("latitude", "depth", "battpos"):
            theirs = next(one for one in other.variables if str(one).lower() == name)
            np.testing.assert_array_equal(other[theirs].values.ravel(), back[name])


@pytest.mark.parametrize("kind", ["f4", "f8", "i2", "i4"])
@pytest.mark.parametrize(
    "declared", [np.float64(-999.0), np.float32(-999.0), np.int32(-999), "-999", [-999.0, -99.0]]
)
@pytest.mark.parametrize("attribute", ["missing_value", "_FillValue"])
def test_a_fill_value_of_any_type(attribute: str, declared: Any, kind: str, tmp_path: Path) -> None:
    if attribute == "_FillValue":
        declared = np.dtype(kind).type(-999)  # netCDF demands the variable's own type
    values = np.array([1, -999, 3, 4, 5, 6]).astype(kind)
    variables = flown("time") | {"pump": ("time", values, {"units": "1", attribute: declared})}
    back = logs.read(made(tmp_path / "log.nc", {"time": N}, variables))
    np.testing.assert_array_equal(back["pump"], [1, np.nan, 3, 4, 5, 6])


MEANINGS = (
    "no_qc good_data probably_good probably_bad bad_data changed not_used not_used estimated missing_value"
)


@pytest.mark.parametrize("output", [True, False])
@pytest.mark.parametrize("kind", ["i1", "S1"])
def test_a_value_that_a_flag_calls_bad_is_not_known(kind: str, output: bool, tmp_path: Path) -> None:
    flags = np.array([1, 4, 2, 9, 8, 3]).astype(kind)
    attrs = {"flag_meanings": MEANINGS, "flag_values": np.arange(10, dtype="i1")} if output else {}
    variables = flown("N_MEASUREMENTS", **CAPITALS) | {"DEPTH_QC": ("N_MEASUREMENTS", flags, attrs)}
    back = logs.read(made(tmp_path / "log.nc", {"N_MEASUREMENTS": N}, variables))
    assert back["depth"].isnull().values.tolist() == [False, True, False, True, False, True]
    assert not [name for name in back.data_vars if "qc" in str(name)]


def test_a_flag_of_another_name_is_ancillary(tmp_path: Path) -> None:
    variables = flown("time")
    variables["depth"][2]["ancillary_variables"] = "qartod_gross"
    meanings = {
        "flag_values": np.array([1, 2, 3, 4, 9], "i1"),
        "flag_meanings": "pass unknown suspect fail missing",
    }
    variables["qartod_gross"] = ("time", np.array([1, 2, 3, 4, 9, 1], "i1"), meanings)
    back = logs.read(made(tmp_path / "log.nc", {"time": N}, variables))
    assert back["depth"].isnull().values.tolist() == [False, False, False, True, True, False]


def test_signs_and_references_as_the_file_declares_them(tmp_path: Path) -> None:
    variables = flown("time") | {
        "tilt": ("time", np.full(N, 7.0), {"units": "degree", "standard_name": "platform_roll_starboard_up"}),
        "course": ("time", np.full(N, 9.0), {"standard_name": "platform_orientation", "comment": "Magnetic"}),
    }
    variables["depth"][2]["positive"] = "up"
    back = logs.read(made(tmp_path / "log.nc", {"time": N}, variables))
    assert (back["roll"] == -7.0).all()
    assert (back["heading"] == 9.0).all()
    assert back.attrs["heading_reference"] == "magnetic"
    np.testing.assert_array_equal(back["depth"], -3.0 * np.arange(N))


def test_a_column_in_a_unit_of_something_else_costs_itself(tmp_path: Path) -> None:
    variables = flown("time")
    variables["depth"][2]["units"] = "dbar"
    path = made(tmp_path / "log.nc", {"time": N}, variables)
    back = logs.read(path)
    assert "depth" not in back
    assert named_losses(back.attrs) == [f"{path}: column 'depth': expected m, not dbar: left out"]


# ---- OceanGliders OG1.0: all required content is written, and missing input gives one line ---------------


START = 1.6e9  # 2020-09-13T12:26:40Z
ROWS = 40
DEMANDED = {
    *("title", "platform", "platform_vocabulary", "id", "contributor_name", "contributor_email"),
    *("rtqc_method", "featureType", "Conventions"),
    *("contributor_role", "contributor_role_vocabulary", "contributing_institutions", "start_date"),
    *("contributing_institutions_role", "contributing_institutions_role_vocabulary", "date_created"),
}
"""Global attributes that are mandatory: OG_Format, 'Global attributes'."""
VARIABLES = {
    *("TIME", "LATITUDE", "LONGITUDE", "DEPTH", "TIME_GPS", "LATITUDE_GPS", "LONGITUDE_GPS", "TRAJECTORY"),
    *("WMO_IDENTIFIER", "PLATFORM_MODEL", "PLATFORM_SERIAL_NUMBER"),
    *("DEPLOYMENT_TIME", "DEPLOYMENT_LATITUDE", "DEPLOYMENT_LONGITUDE"),
}


@pytest.fixture
def metadata(here: Path) -> Path:
    """Write the metadata.toml that the documentation shows; return its path."""
    (text,) = (one.text for one in blocks("toml") if "[platform]" in one.text)
    (here / "metadata.toml").write_text(text)
    return here / "metadata.toml"


def mission(**columns: np.ndarray) -> xr.Dataset:
    columns = {
        **{f"mag_{axis}": np.full(ROWS, 20_000.0) for axis in "xyz"},
        "latitude": np.r_[np.nan, np.linspace(48.0, 48.1, ROWS - 1)],
        "longitude": np.r_[np.nan, np.linspace(-52.0, -52.1, ROWS - 1)],
        "depth": np.linspace(-0.02, 80.0, ROWS),
        **columns,
    }
    return deployment("raw", START + np.arange(ROWS), columns)


@pytest.mark.parametrize("has_fixes", [True, False])
def test_all_that_the_format_demands(has_fixes: bool, here: Path, metadata: Path, command: Command) -> None:
    """Fixes that the log does not have are reported as unknown."""
    fixes = np.where(np.arange(ROWS) % 20 == 5, 48.05, np.nan)
    logs.write(
        mission(**({"gps_latitude": fixes, "gps_longitude": fixes - 100.0} if has_fixes else {})), "raw.nc"
    )
    command("convert", "raw.nc", "-o", "mission.nc", "--metadata", metadata)
    with xr.open_dataset("mission.nc") as file:
        assert set(file.attrs) >= DEMANDED
        assert set(file.variables) >= VARIABLES
        assert "OG-1.0" in file.attrs["Conventions"]
        assert file.attrs["id"] == "unit_345_20200913T122641_delayed"  # the first row with a place
        assert file["TRAJECTORY"].item() == "unit_345_20200913T122641"
        assert file["DEPLOYMENT_LATITUDE"].item() == 48.0
        for name in ("TIME_GPS", "LATITUDE_GPS"):
            assert int(file[name].notnull().sum()) == 2 * has_fixes
        assert ("does not say" in file["TIME_GPS"].attrs.get("comment", "")) != has_fixes
        sensor = file["MAG_X"].attrs["sensor"]
        assert file[sensor].attrs["sensor_serial_number"] == "1021"
    assert float(logs.read("mission.nc")["depth"][0]) == -0.02
    np.testing.assert_array_equal(logs.read("mission.nc")["mag_x"], 20_000.0)


@pytest.mark.parametrize("key", ["title", "WMO_IDENTIFIER", "sensor_model"])
def test_what_is_missing_is_one_line_and_no_file(
    key: str, here: Path, metadata: Path, command: Command
) -> None:
    lines = metadata.read_text().splitlines(keepends=True)
    metadata.write_text("".join(line for line in lines if not line.startswith(f"{key} ")))
    logs.write(mission(), "raw.nc")
    line = command.refuses("convert", "raw.nc", "-o", "mission.nc", "--metadata", metadata, code=2)
    assert f".{key}: missing key" in line
    assert not Path("mission.nc").exists()


def test_a_log_without_depths_is_refused(here: Path, metadata: Path, command: Command) -> None:
    logs.write(mission().drop_vars("depth"), "raw.nc")
    line = command.refuses("convert", "raw.nc", "-o", "mission.nc", "--metadata", metadata)
    assert "column 'depth': expected this column: OG1.0 demands it" in line
    assert "expected a netCDF (.nc) to write" in command.refuses(
        "convert", "raw.nc", "-o", "mission.csv", "--metadata", metadata, code=2
    )
    assert sorted(path.name for path in here.iterdir()) == ["metadata.toml", "raw.nc"]
