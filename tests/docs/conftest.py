"""Fixtures of the documentation tests: small files with the names that the pages use."""

import shutil
from pathlib import Path

import pytest
from demos import demo_log

from magbridge.calibration.file import save
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.logs import write
from sitl import load
from sitl.twin import Twin


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    log = demo_log().isel(time=slice(None, None, 3))
    for name in ("runs.nc", "flight.nc"):
        write(log, folder / name)
    for name in ("survey.nc", "glider.nc"):
        write(log.isel(time=slice(-300, None)), folder / name)
    Twin.draw(load("demo"), 5).anomaly_map().save(folder / "grid.nc")
    save(fit(observations(log, ("battpos",)), method="nominal").calibration, folder / "cal.json")
    return folder


@pytest.fixture
def survey_and_runs(made: Path, tmp_path: Path) -> Path:
    """Return a folder that holds runs.nc, flight.nc, survey.nc, glider.nc, grid.nc and cal.json."""
    for file in made.iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path
