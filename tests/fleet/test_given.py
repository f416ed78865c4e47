"""A calibration made elsewhere: recorded, and learned from once, as far as its data determined it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleets import fly

from magbridge.calibration.file import load
from magbridge.cli import main
from magbridge.fleet.catalogue import FolderCatalogue
from magbridge.fleet.memory import fleet_of, lessons
from magbridge.fleet.process import work
from magbridge.fleet.register import Deployment, Vehicle, add_logs, add_vehicle, jobs, status


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log of a sensor, and its calibration."""
    folder = tmp_path_factory.mktemp("made")
    log, cal = fly(folder / "log.nc", 1, 0, sensor="HMR 1"), folder / "cal.json"
    assert main(["calibrate", str(log), "--parameter", "battpos", "-o", str(cal)]) == 0
    return log, cal


@pytest.fixture
def catalogue(tmp_path: Path) -> FolderCatalogue:
    catalogue = FolderCatalogue(tmp_path / "fleet", create=True)
    add_vehicle(catalogue, "comet", Vehicle(parameters=("battpos",)))
    return catalogue


def add(catalogue: FolderCatalogue, cal: Path, *more: str) -> int:
    of = "--vehicle", "comet", "--deployment", "may", "--catalogue", catalogue.name
    return main(["fleet", "add", str(cal), *of, *more])


def test_it_teaches_what_its_data_determined(catalogue: FolderCatalogue, made: tuple[Path, Path]) -> None:
    log, cal = made
    assert add(catalogue, cal, "--date", "2026-05-01") == 0
    assert add(catalogue, cal, "--date", "2026-05-01") == 0
    assert status(catalogue)["vehicles"][0]["given"] == 1
    (given,) = lessons(catalogue, "comet")
    known = fleet_of(catalogue, "comet").known("comet", "may").rescaled(load(cal).parameters, given.field)
    sigma = np.sqrt(np.diag(known.covariance))
    assert (np.abs(known.mean - load(cal).coefficients) < 3.0 * sigma).all()
    assert sigma[6:9].max() < 200.0  # against 3,000 of a vehicle of which nothing is known
    # the same data calibrated here, too, count once
    add_logs(catalogue, "comet", Deployment("may", ()), [log])
    (job,) = jobs(catalogue)
    for table, rows in work(job, catalogue.results).tables.items():
        catalogue.add(table, rows)
    assert len(catalogue.rows("calibrations")) == 2
    (own,) = lessons(catalogue, "comet")
    # the fleet learns the information of its data, in the directions that these determine
    off = given.information.vector - given.information.precision @ load(cal).coefficients
    own_off = own.information.vector - own.information.precision @ load(cal).coefficients
    scale = np.sqrt(np.diag(own.information.precision))
    assert (np.abs(off - own_off) < 3.0 * scale).all()


def test_what_does_not_fit_is_a_line(
    catalogue: FolderCatalogue, made: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, cal = made

    def output(*more: str) -> str:
        assert add(catalogue, cal, *more) == 2
        return capsys.readouterr().err

    when = "--date", "2026-05-01"
    assert "expected --date YYYY-MM-DD, the day on which its deployment began" in output()
    reported = output(*when, "--sensor", "HMR 9")
    assert "comet may: expected a calibration of sensor 'HMR 9', got one of 'HMR 1'" in reported
    add_vehicle(catalogue, "other", Vehicle(parameters=("ballast",)))
    of = "--vehicle", "other", "--deployment", "may", "--catalogue", catalogue.name
    assert main(["fleet", "add", str(cal), *of, *when]) == 2
    assert "other: expected a calibration with the parameters ballast, got battpos" in capsys.readouterr().err
    assert add(catalogue, cal, *when) == 0
    (other := tmp_path / "other.json").write_text(cal.read_text().replace('"auto"', '"mine"'))
    assert add(catalogue, other, *when) == 2
    assert "comet may: has another calibration already; name another deployment" in capsys.readouterr().err
    (broken := tmp_path / "broken.json").write_text("{")
    assert add(catalogue, broken, *when) == 1
