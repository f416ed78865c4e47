"""Fixtures of the command-line tests: the file of a simulated deployment, and its calibration."""

from pathlib import Path

import pytest
from demos import demo_log

from magbridge.cli import main
from magbridge.logs import write


@pytest.fixture(scope="session")
def deployment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("deployment") / "deployment.csv"
    write(demo_log(), path)
    return path


@pytest.fixture(scope="session")
def calibration(deployment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "cal.json"
    assert main(["calibrate", str(deployment), "--method", "nominal", "-o", str(path)]) == 0
    return path
