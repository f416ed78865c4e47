"""OceanGliders OG1.0: all required content is written, and missing input gives one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from pages import blocks

from magbridge import logs
from magbridge.logs.deployment import deployment

START = 1.6e9  # 2020-09-13T12:26:40Z
N = 40
DEMANDED = {
    *(
        "title",
        "platform",
        "platform_vocabulary",
        "id",
        "contributor_name",
        "contributor_email",
        "rtqc_method",
    ),
    *("contributor_role", "contributor_role_vocabulary", "contributing_institutions", "start_date"),
    *("contributing_institutions_role", "contributing_institutions_role_vocabulary", "date_created"),
    *("featureType", "Conventions"),
}
"""Global attributes that are mandatory: OG_Format, 'Global attributes'."""
VARIABLES = {
    *("TIME", "LATITUDE", "LONGITUDE", "DEPTH", "TIME_GPS", "LATITUDE_GPS", "LONGITUDE_GPS", "TRAJECTORY"),
    *("WMO_IDENTIFIER", "PLATFORM_MODEL", "PLATFORM_SERIAL_NUMBER"),
    *("DEPLOYMENT_TIME", "DEPLOYMENT_LATITUDE", "DEPLOYMENT_LONGITUDE"),
}


@pytest.fixture
def metadata(here: Path) -> Path:
    """The page's own."""
    (text,) = (one.text for one in blocks("toml") if "[platform]" in one.text)
    (here / "metadata.toml").write_text(text)
    return here / "metadata.toml"


def mission(**columns: np.ndarray) -> xr.Dataset:
    columns = {
        **{f"mag_{axis}": np.full(N, 20_000.0) for axis in "xyz"},
        "latitude": np.r_[np.nan, np.linspace(48.0, 48.1, N - 1)],
        "longitude": np.r_[np.nan, np.linspace(-52.0, -52.1, N - 1)],
        "depth": np.linspace(-0.02, 80.0, N),
        **columns,
    }
    return deployment("raw", START + np.arange(N), columns)


def test_all_that_the_format_demands(here: Path, metadata: Path, command: Command) -> None:
    fixes = np.where(np.arange(N) % 20 == 5, 48.05, np.nan)
    logs.write(mission(gps_latitude=fixes, gps_longitude=fixes - 100.0), "raw.nc")
    command("convert", "raw.nc", "-o", "mission.nc", "--metadata", metadata)
    with xr.open_dataset("mission.nc") as file:
        assert set(file.attrs) >= DEMANDED
        assert set(file.variables) >= VARIABLES
        assert "OG-1.0" in file.attrs["Conventions"]
        assert file.attrs["id"] == "unit_345_20200913T122641_delayed"  # the first row with a place
        assert file["TRAJECTORY"].item() == "unit_345_20200913T122641"
        assert file["DEPLOYMENT_LATITUDE"].item() == 48.0
        assert int(file["TIME_GPS"].notnull().sum()) == int(file["LATITUDE_GPS"].notnull().sum()) == 2
        sensor = file["MAG_X"].attrs["sensor"]
        assert file[sensor].attrs["sensor_serial_number"] == "1021"
    assert float(logs.read("mission.nc")["depth"][0]) == -0.02
    np.testing.assert_array_equal(logs.read("mission.nc")["mag_x"], 20_000.0)


def test_unknown_fixes_are_reported_as_unknown(here: Path, metadata: Path, command: Command) -> None:
    logs.write(mission(), "raw.nc")
    command("convert", "raw.nc", "-o", "mission.nc", "--metadata", metadata)
    with xr.open_dataset("mission.nc") as file:
        assert not file["LATITUDE_GPS"].notnull().any()
        assert "does not say" in file["TIME_GPS"].attrs["comment"]


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
