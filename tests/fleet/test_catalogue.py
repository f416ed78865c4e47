"""Test the catalogue: unique rows for any number of writers; one line for a newer or damaged catalogue."""

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import polars as pl
import pytest
from commands import Command
from fleets import fly

from magbridge.arrays import FloatArray
from magbridge.calibration.file import load
from magbridge.calibration.fitting.pose import LATENT, MOMENT, Mounting, mass_columns, rescaling
from magbridge.calibration.model import Parameter
from magbridge.cli import main
from magbridge.errors import ConfigError, FormatError, WriteError, WrongUse
from magbridge.fleet import catalogue as room
from magbridge.fleet import register
from magbridge.fleet.catalogue import FolderCatalogue as Catalogue
from magbridge.fleet.learn import shape_groups, shapes_of
from magbridge.fleet.memory import fleet_of, lessons
from magbridge.fleet.page import write_pages
from magbridge.fleet.process import work

MAY = register.Deployment("may", ())


@pytest.fixture
def empty(tmp_path: Path) -> Catalogue:
    return Catalogue(tmp_path / "fleet", create=True)


def line(n: int) -> dict[str, str | int]:
    return {"job": str(n), "attempt": 1, "vehicle": "v", "deployment": "d", "line": f"failure {n}"}


def test_a_row_is_there_once(empty: Catalogue) -> None:
    assert empty.add("failures", [line(1), line(2)]) == 2
    assert empty.add("failures", [line(2), line(3), line(3)]) == 1
    assert sorted(row["job"] for row in empty.rows("failures")) == ["1", "2", "3"]
    assert {*empty.rows("failures", ["job"])[0]} == {"job"}


def test_two_writers_of_equal_rows_write_one_file(empty: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    other = Catalogue(empty.folder)
    monkeypatch.setattr(other, "_files", lambda _: [])  # it looked before the first had written
    empty.add("failures", [line(1), line(2)])
    other.add("failures", [line(2), line(1)])
    other.add("failures", [line(2), line(3)])
    assert len(list((empty.folder / "failures").iterdir())) == 2
    assert len(empty.rows("failures")) == 3


def test_many_files_become_one_and_say_the_same(empty: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "MAX_SMALL_FILES", 5)
    for n in range(7):
        empty.add("failures", [line(n)])
    before = empty.rows("failures")
    empty.compact()
    assert len(list((empty.folder / "failures").iterdir())) == 1
    assert empty.rows("failures") == before
    empty.compact()
    assert empty.add("failures", [line(3)]) == 0


def test_a_newer_catalogue_is_refused_and_none_is_not_made(empty: Catalogue, tmp_path: Path) -> None:
    (empty.folder / "catalogue.json").write_text(json.dumps({"format": 2}))
    with pytest.raises(FormatError, match="format 1 at most, got 2"):
        Catalogue(empty.folder)
    with pytest.raises(FormatError, match="expected a fleet's catalogue"):
        Catalogue(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()
    (empty.folder / "catalogue.json").write_text("{")
    with pytest.raises(FormatError, match="expected"):
        Catalogue(empty.folder)


def test_a_damaged_file_is_named(empty: Catalogue) -> None:
    empty.add("failures", [line(1)])
    (damaged := next((empty.folder / "failures").iterdir())).write_bytes(b"PAR1 not so")
    with pytest.raises(FormatError, match=damaged.name):
        empty.rows("failures")


def test_a_folder_that_cannot_be_written_is_one_line(empty: Catalogue) -> None:
    (empty.folder / "failures").write_text("a file where the table should be")
    with pytest.raises((WriteError, FileExistsError)):
        empty.add("failures", [line(1)])


def test_two_vehicles_of_one_name(empty: Catalogue) -> None:
    assert register.add_vehicle(empty, "comet", register.Vehicle(parameters=("battpos",), serial="1")) == 1
    assert register.add_vehicle(empty, "comet", register.Vehicle(parameters=("battpos",), serial="1")) == 0
    with pytest.raises(WrongUse, match=r"another vehicle of that name: serial 1, .* not serial 2"):
        register.add_vehicle(empty, "comet", register.Vehicle(parameters=("battpos",), serial="2"))
    where = {"battpos": Mounting((-0.5, 0.0, 0.0), (0.0254, 0.0, 0.0))}
    for mass in (where, {}, where, where):  # measured, taken back, and given again
        register.add_vehicle(empty, "comet", register.Vehicle(parameters=("battpos",), serial="1", mass=mass))
        assert register.masses(register.vehicles(empty)["comet"]) == mass
    assert len(empty.rows("vehicles")) == 4
    for given in ((), ("battpos", "ballast")):
        with pytest.raises(WrongUse, match=f"not so for {given[-1] if given else 'battpos'}$"):
            register.add_vehicle(empty, "u", register.Vehicle(parameters=given, mass=where))
    assert "u" not in register.vehicles(empty)
    # two people at once, who could not see each other
    first = empty.rows("vehicles")[0]
    empty.add("vehicles", [{**first, "serial": "2"}])
    with pytest.raises(FormatError, match="expected one vehicle 'comet', got two"):
        register.vehicles(empty)


def test_a_log_that_changed_is_another_version(catalogue: Catalogue, tmp_path: Path) -> None:
    log = fly(tmp_path / "log.nc", 1, 0)
    assert register.add_logs(catalogue, "comet", MAY, [log]) == (1, [])
    assert register.add_logs(catalogue, "comet", MAY, [log]) == (0, [])
    first, kept = register.jobs(catalogue)[0].name, log.read_bytes()
    fly(log, 1, 1)
    count, (output,) = register.add_logs(catalogue, "comet", MAY, [log])
    assert count == 1
    assert output.endswith("log.nc: has changed since it was catalogued; its present contents count")
    (now,) = register.current_files(catalogue.rows("files"))
    assert now["version"] == 2
    assert register.jobs(catalogue)[0].name != first
    log.write_bytes(kept)  # and back
    register.add_logs(catalogue, "comet", MAY, [log])
    assert register.jobs(catalogue)[0].name == first
    count, (output,) = register.add_logs(catalogue, "comet", register.Deployment("june", ()), [log])
    assert count == 1
    assert output.endswith("log.nc: belonged to comet, may; now to comet, june")


@pytest.mark.parametrize("name", ["", "../up", "a\\b", ".hidden", "two\nlines"])
def test_a_name_that_can_be_no_folders_is_refused(empty: Catalogue, tmp_path: Path, name: str) -> None:
    """Names in a catalogue never form a path outside the folder of the pages."""
    with pytest.raises(WriteError, match="expected a name without slashes"):
        write_pages({name: cast(Any, None)}, tmp_path / "pages", {})
    assert not (tmp_path / "pages").exists()
    with pytest.raises(WrongUse, match="a vehicle's name without slashes"):
        register.add_vehicle(empty, name, register.Vehicle())
    register.add_vehicle(empty, "comet", register.Vehicle())
    with pytest.raises(WrongUse, match="a deployment's name without slashes"):
        register.add_logs(empty, "comet", register.Deployment(name, ()), [])


def test_an_unknown_vehicle_and_a_missing_log(empty: Catalogue, tmp_path: Path) -> None:
    with pytest.raises(WrongUse, match="it has no vehicle yet; magbridge fleet add --vehicle nemo"):
        register.add_logs(empty, "nemo", MAY, [])
    register.add_vehicle(empty, "comet", register.Vehicle())
    count, (output,) = register.add_logs(empty, "comet", MAY, [tmp_path / "gone.nc"])
    assert count == 0
    assert "gone.nc: expected a file, there is none" in output


def test_a_fleet_toml_names_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('[vehicle.comet]\nparameter = ["battpos"]\n')
    with pytest.raises(ConfigError, match=r"vehicle\.comet\.parameter: unknown key"):
        register.read_fleet(path)
    path.write_text("[vehicle.comet.mass.battpos]\nat = [-0.5, 0.0]\ntravel = [0.0254, 0.0, 0.0]\n")
    with pytest.raises(ConfigError, match=r"vehicle\.comet\.mass.*\.at: expected `array` of length 3"):
        register.read_fleet(path)


@pytest.mark.parametrize(
    ("name", "value", "kind", "words"),
    [
        ("version", "first", pl.String, "column 'version': expected a column of Int64, got String"),
        ("version", None, pl.Int64, "column 'version': table vehicles: expected Int64, got None"),
        ("mass", "nonsense", pl.String, "vehicle comet: mass: expected places of masses"),
    ],
)
def test_a_damaged_or_foreign_catalogue_is_one_line(
    name: str, value: object, kind: type[pl.DataType], words: str, catalogue: Catalogue,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (path,) = (catalogue.folder / "vehicles").glob("*.parquet")
    table = pl.read_parquet(path)
    table.with_columns(pl.lit(value, dtype=kind()).alias(name)).write_parquet(path)
    for command in ("status", "show", "process"):
        code = main(["fleet", command, "--catalogue", catalogue.name])
        err = capsys.readouterr().err
        assert "Traceback" not in err
        assert code in {0, 1}
        assert all(text.startswith("magbridge: ") for text in err.splitlines())
    with pytest.raises(FormatError, match=words):
        list(map(register.masses, register.vehicles(catalogue).values()))


# ---- A calibration made elsewhere: recorded, and learned from once, as far as its data determined it -----


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write a log of a sensor, and its calibration."""
    folder = tmp_path_factory.mktemp("made")
    log, cal = fly(folder / "log.nc", 1, 0, sensor="HMR 1"), folder / "cal.json"
    assert main(["calibrate", str(log), "--parameter", "battpos", "-o", str(cal)]) == 0
    return log, cal


def adding(catalogue: Catalogue, cal: Path, vehicle: str = "comet") -> tuple[object, ...]:
    of = "--vehicle", vehicle, "--deployment", "may", "--catalogue", catalogue.name
    return "fleet", "add", cal, *of


def test_it_teaches_what_its_data_determined(
    catalogue: Catalogue, made: tuple[Path, Path], command: Command
) -> None:
    log, cal = made
    for _ in range(2):
        command(*adding(catalogue, cal), "--date", "2026-05-01")
    assert register.status(catalogue)["vehicles"][0]["given"] == 1
    (given,) = lessons(catalogue, "comet")
    known = fleet_of(catalogue, "comet").known("comet", "may")
    L = rescaling(known.exponents, known.parameters, load(cal).parameters, known.field, given.field)
    sigma = np.sqrt(np.diag(L @ known.covariance @ L.T))
    assert (np.abs(L @ known.mean - load(cal).coefficients) < 3.0 * sigma).all()
    assert sigma[6:9].max() < 200.0  # against 3,000 of a vehicle of which nothing is known
    # the same data calibrated here, too, count once
    register.add_logs(catalogue, "comet", register.Deployment("may", ()), [log])
    (job,) = register.jobs(catalogue)
    catalogue.add_tables(work(job, catalogue.results).tables)
    assert len(catalogue.rows("calibrations")) == 2
    (own,) = lessons(catalogue, "comet")
    # the fleet learns the information of its data, in the directions that these determine
    off = given.information.vector - given.information.precision @ load(cal).coefficients
    own_off = own.information.vector - own.information.precision @ load(cal).coefficients
    scale = np.sqrt(np.diag(own.information.precision))
    assert (np.abs(off - own_off) < 3.0 * scale).all()


def test_what_does_not_fit_is_a_line(
    catalogue: Catalogue, made: tuple[Path, Path], tmp_path: Path, command: Command
) -> None:
    _, cal = made
    register.add_vehicle(catalogue, "other", register.Vehicle(parameters=("ballast",)))
    when = "--date", "2026-05-01"
    for arguments, words in (
        (adding(catalogue, cal), "expected --date YYYY-MM-DD, the day on which its deployment began"),
        ((*adding(catalogue, cal), *when, "--sensor", "HMR 9"),
         "comet may: expected a calibration of sensor 'HMR 9', got one of 'HMR 1'"),
        ((*adding(catalogue, cal, "other"), *when),
         "other: expected a calibration with the parameters ballast, got battpos"),
    ):  # fmt: skip
        assert words in command(*arguments, code=2).err
    command(*adding(catalogue, cal), *when)
    (other := tmp_path / "other.json").write_text(cal.read_text().replace('"auto"', '"mine"'))
    line = command(*adding(catalogue, other), *when, code=2).err
    assert "comet may: has another calibration; name another deployment" in line
    (broken := tmp_path / "broken.json").write_text("{")
    command(*adding(catalogue, broken), *when, code=1)


# ---- How a refit moves coefficients is how a dipole's coefficients move when it is exchanged or shifted ----


AT, TRAVEL = np.array([-0.5, 0.02, 0.05]), np.array([0.0254, 0.0, 0.0])
BATTPOS = Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0)
EXPONENTS = ((0,), (1,), (2,), (3,))


def coefficients(at: FloatArray, moment: FloatArray) -> FloatArray:
    """Return the coefficients (36,), nT, of a mass at `at` with a permanent moment (nT from :data:`AT`)."""
    numbers = np.zeros(LATENT)
    numbers[:3] = moment
    numbers[6:9] = at - AT
    return (mass_columns(AT, TRAVEL, BATTPOS, 3, numbers)[..., :6] @ numbers[:6]).ravel()


def test_another_pack_moves_all_powers_together_and_a_shift_by_the_moment_that_was_found() -> None:
    """The position of the mass is wrong by 2 cm."""
    moment = np.array([1500.0, -800.0, 2100.0])
    where = {"battpos": Mounting(tuple(np.add(AT, [0.02, -0.01, 0.0])), tuple(TRAVEL))}
    P = np.diag(np.tile([0.1] * 6 + [1.0] * 3, 4) ** 2)
    shapes = shapes_of(where, EXPONENTS, (BATTPOS,), 50_000.0, coefficients(AT, moment), P)
    assert shapes.shape == (36, len(shape_groups(1)))
    changed = np.array([600.0, 900.0, -300.0])
    moved = coefficients(AT, moment + changed) - coefficients(AT, moment)
    foretold = shapes[:, :3] @ changed / MOMENT
    assert np.linalg.norm(foretold - moved) < 0.1 * np.linalg.norm(moved)
    first, foretold_first = moved[9:18], foretold[9:18]  # a small part of the whole, and what matters
    assert np.linalg.norm(foretold_first - first) < 0.15 * np.linalg.norm(first)
    for axis in range(3):
        shift = 0.005 * np.eye(3)[axis]
        moved = coefficients(AT + shift, moment) - coefficients(AT, moment)
        foretold = shapes[:, 6 + axis] * 0.005 / 0.05
        assert np.linalg.norm(foretold - moved) < 0.15 * np.linalg.norm(moved)
