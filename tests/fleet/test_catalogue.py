"""The catalogue: each row once for any number of writers; newer and damaged ones are refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
from fleets import fly

from magbridge.calibration.fitting.pose import Mounting
from magbridge.cli import main
from magbridge.errors import ConfigError, FormatError, WriteError, WrongUse
from magbridge.fleet import catalogue as room
from magbridge.fleet.catalogue import FolderCatalogue as Catalogue
from magbridge.fleet.register import (
    Deployment,
    Vehicle,
    add_logs,
    add_vehicle,
    current_files,
    jobs,
    masses,
    read_fleet,
    vehicles,
)

MAY = Deployment("may", ())


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


def test_two_writers_of_the_same_rows_write_one_file(
    empty: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Catalogue(empty.folder)
    monkeypatch.setattr(other, "_files", lambda _: [])  # it looked before the first had written
    empty.add("failures", [line(1), line(2)])
    other.add("failures", [line(2), line(1)])
    other.add("failures", [line(2), line(3)])
    assert len(list((empty.folder / "failures").iterdir())) == 2
    assert len(empty.rows("failures")) == 3


def test_many_files_become_one_and_say_the_same(empty: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "MANY", 5)
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
    assert add_vehicle(empty, "comet", Vehicle(parameters=("battpos",), serial="1")) == 1
    assert add_vehicle(empty, "comet", Vehicle(parameters=("battpos",), serial="1")) == 0
    with pytest.raises(WrongUse, match=r"another vehicle of that name: serial 1, .* not serial 2"):
        add_vehicle(empty, "comet", Vehicle(parameters=("battpos",), serial="2"))
    where = {"battpos": Mounting((-0.5, 0.0, 0.0), (0.0254, 0.0, 0.0))}
    for mass in (where, {}, where, where):  # measured, taken back, and given again
        add_vehicle(empty, "comet", Vehicle(parameters=("battpos",), serial="1", mass=mass))
        assert masses(vehicles(empty)["comet"]) == mass
    assert len(empty.rows("vehicles")) == 4
    for given in ((), ("battpos", "ballast")):
        with pytest.raises(WrongUse, match=f"not so for {given[-1] if given else 'battpos'}$"):
            add_vehicle(empty, "u", Vehicle(parameters=given, mass=where))
    assert "u" not in vehicles(empty)
    # two people at once, who could not see each other
    first = empty.rows("vehicles")[0]
    empty.add("vehicles", [{**first, "serial": "2"}])
    with pytest.raises(FormatError, match="expected one vehicle 'comet', got two"):
        vehicles(empty)


def test_a_log_that_changed_is_another_version(empty: Catalogue, tmp_path: Path) -> None:
    log = fly(tmp_path / "log.nc", 1, 0)
    add_vehicle(empty, "comet", Vehicle(parameters=("battpos",)))
    assert add_logs(empty, "comet", MAY, [log]) == (1, [])
    assert add_logs(empty, "comet", MAY, [log]) == (0, [])
    first, kept = jobs(empty)[0].name, log.read_bytes()
    fly(log, 1, 1)
    count, (output,) = add_logs(empty, "comet", MAY, [log])
    assert count == 1
    assert output.endswith("log.nc: has changed since it was catalogued; its present contents count")
    (now,) = current_files(empty.rows("files"))
    assert now["version"] == 2
    assert jobs(empty)[0].name != first
    log.write_bytes(kept)  # and back
    add_logs(empty, "comet", MAY, [log])
    assert jobs(empty)[0].name == first


@pytest.mark.parametrize("name", ["", "../up", "a\\b", ".hidden", "two\nlines"])
def test_a_name_that_can_be_no_folders_is_refused(empty: Catalogue, name: str) -> None:
    with pytest.raises(WrongUse, match="a vehicle's name without slashes"):
        add_vehicle(empty, name, Vehicle())
    add_vehicle(empty, "comet", Vehicle())
    with pytest.raises(WrongUse, match="a deployment's name without slashes"):
        add_logs(empty, "comet", Deployment(name, ()), [])


def test_an_unknown_vehicle_and_a_missing_log(empty: Catalogue, tmp_path: Path) -> None:
    with pytest.raises(WrongUse, match=r"nemo: .* has no vehicle yet"):
        add_logs(empty, "nemo", MAY, [])
    add_vehicle(empty, "comet", Vehicle())
    count, (output,) = add_logs(empty, "comet", MAY, [tmp_path / "gone.nc"])
    assert count == 0
    assert "gone.nc: expected a file, there is none" in output


def test_a_fleet_toml_names_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('[vehicle.comet]\nparameter = ["battpos"]\n')
    with pytest.raises(ConfigError, match=r"vehicle\.comet\.parameter: unknown key"):
        read_fleet(path)
    path.write_text("[vehicle.comet.mass.battpos]\nat = [-0.5, 0.0]\ntravel = [0.0254, 0.0, 0.0]\n")
    with pytest.raises(ConfigError, match=r"vehicle\.comet\.mass.*\.at: expected `array` of length 3"):
        read_fleet(path)


@pytest.mark.parametrize(
    ("name", "value", "kind", "words"),
    [
        ("version", "first", pl.String, "column 'version': expected a column of Int64, got String"),
        ("version", None, pl.Int64, "column 'version': table vehicles: expected Int64, got None"),
        ("mass", "nonsense", pl.String, "vehicle comet: mass: expected places of masses"),
    ],
)
def test_a_damaged_or_foreign_catalogue_is_one_line(
    name: str,
    value: object,
    kind: type[pl.DataType],
    words: str,
    empty: Catalogue,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    add_vehicle(empty, "comet", Vehicle(parameters=("battpos",)))
    (path,) = (tmp_path / "fleet" / "vehicles").glob("*.parquet")
    table = pl.read_parquet(path)
    table.with_columns(pl.lit(value, dtype=kind()).alias(name)).write_parquet(path)
    for command in ("status", "show", "process"):
        code = main(["fleet", command, "--catalogue", str(tmp_path / "fleet")])
        err = capsys.readouterr().err
        assert "Traceback" not in err
        assert code in {0, 1}
        assert all(text.startswith("magbridge: ") for text in err.splitlines())
    with pytest.raises(FormatError, match=words):
        list(map(masses, vehicles(empty).values()))
