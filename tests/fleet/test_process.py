"""Test processing: a deployment's rows, faults of a log, a killed and repeated run, and two workers."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from fleets import catalogue_of, content, fly
from machine import full_disk

from magbridge.calibration.file import decode_calibration, load
from magbridge.errors import WriteError, WrongUse
from magbridge.field.grid import AnomalyGrid
from magbridge.fleet.catalogue import FolderCatalogue
from magbridge.fleet.catalogue import FolderCatalogue as Catalogue
from magbridge.fleet.memory import lessons
from magbridge.fleet.page import PAGE_COLOURS
from magbridge.fleet.process import client_of, work
from magbridge.fleet.register import (
    Deployment,
    Vehicle,
    add_logs,
    add_vehicle,
    current,
    jobs,
    new_jobs,
    status,
)
from magbridge.logs import read, write

MAY = Deployment("may", ())


def test_every_deployment_is_done_once(done: Catalogue) -> None:
    found = content(done)
    assert {(row["vehicle"], row["deployment"]) for row in found["calibrations"]} == {
        ("one", "first"), ("one", "second"), ("two", "first"),
    }  # fmt: skip
    assert len(found["calibrations"]) == len(found["logs"]) == len(found["corrected"]) == 3
    assert all((done.results / row["path"]).is_file() for row in found["corrected"])
    assert all(row["rms"] < 2.0 and row["flagged"] == 0 for row in found["calibrations"] if "flagged" in row)
    assert not new_jobs(done, jobs(done))


def test_a_fault_of_one_log_is_a_line_and_the_rest_goes_on(catalogue: Catalogue, tmp_path: Path) -> None:
    add_vehicle(catalogue, "comet", Vehicle(parameters=("battpos",), sensor="HMR 1"))
    logs = [
        fly(tmp_path / "good.nc", 1, 0, sensor="HMR 1"),
        fly(tmp_path / "other.nc", 1, 0, sensor="HMR 2"),
        fly(tmp_path / "boot.nc", 1, 0, start=100.0, sensor="HMR 1"),
    ]
    (tmp_path / "text.nc").write_text("no log")
    add_logs(catalogue, "comet", MAY, [*logs, tmp_path / "text.nc"])
    (job,) = jobs(catalogue)
    tables = work(job, tmp_path / "results").tables
    assert len(tables["calibrations"]) == len(tables["corrected"]) == 1
    lines = " | ".join(sorted(row["line"] for row in tables["failures"]))
    assert "boot.nc: expected a date, got 1970-01-01T00:01:40; give it one" in lines
    assert "other.nc: expected a log of sensor 'HMR 1', which comet may carries, got 'HMR 2'" in lines
    assert "text.nc" in lines
    assert len(tables["failures"]) == 3


def test_a_failure_is_tried_again_when_asked(flown: Path, tmp_path: Path) -> None:
    catalogue = catalogue_of(tmp_path, flown)
    every = jobs(catalogue)
    job = every[0]
    # as an older version left it, which could not read a log
    failed = {**job.mark, "vehicle": "one", "deployment": "first", "line": "no such format"}
    catalogue.add("failures", [failed])
    catalogue.add("done", [{**each.mark, "diagnosed": False, "mapped": False} for each in every])
    assert status(catalogue)["failures"] == ["no such format"]
    assert not new_jobs(catalogue, every)
    (again,) = new_jobs(catalogue, every, retry=True)
    assert (again.name, again.attempt) == (job.name, 2)
    catalogue.add_tables(work(again, catalogue.results).tables)
    assert not current(catalogue, "calibrations")  # killed before it was done
    catalogue.add("done", [{**again.mark, "diagnosed": False, "mapped": False}])
    assert [row["attempt"] for row in current(catalogue, "calibrations")] == [2]
    assert status(catalogue)["failures"] == []
    assert not new_jobs(catalogue, every, retry=True)


def test_which_sensor_flew_where_is_on_record(catalogue: Catalogue, tmp_path: Path) -> None:
    add_vehicle(catalogue, "comet", Vehicle(parameters=("battpos",), sensor="HMR 1"))
    for number, sensor in enumerate(("HMR 1", "HMR 2", "HMR 2")):
        log = fly(tmp_path / f"{number}.nc", 1, number, sensor=sensor)
        add_logs(catalogue, "comet", Deployment(f"d{number}", (), "spring", "HMR 2" * (number == 1)), [log])
    lines = []
    for job in jobs(catalogue):
        tables = work(job, catalogue.results).tables
        lines += [row["line"] for row in tables.pop("failures", [])]
        catalogue.add_tables(tables)
    assert lines[0].endswith("2.nc: expected a log of sensor 'HMR 1', which comet d2 carries, got 'HMR 2'")
    assert {row["sensor"] for row in catalogue.rows("sensors")} == {"HMR 1", "HMR 2"}
    # another sensor is as good as a refit
    assert [one.refit for one in lessons(catalogue, "comet")] == ["spring, HMR 1", "spring"]


def test_what_is_wrong_with_the_moment_is_not_on_record(catalogue: Catalogue, tmp_path: Path) -> None:
    log = fly(tmp_path / "log.nc", 1, 0)
    add_logs(catalogue, "comet", MAY, [log])
    (job,) = jobs(catalogue)
    kept = log.read_bytes()
    log.write_bytes(kept + b" ")
    changed = work(job, tmp_path / "results")
    assert changed == ({}, f"comet may: {log} has changed since it was catalogued: add it again")
    log.unlink()
    assert work(job, tmp_path / "results").tables == {}
    log.write_bytes(kept)
    blocked = tmp_path / "results" / "comet"
    blocked.parent.mkdir(exist_ok=True)
    blocked.write_text("where a folder should be")
    refused = work(job, tmp_path / "results")
    assert refused.tables == {}
    assert "comet may" in refused.hindrance


def test_a_full_disk_is_a_line_and_nothing_is_on_record(flown: Path, tmp_path: Path) -> None:
    catalogue = catalogue_of(tmp_path, flown)
    job = jobs(catalogue)[0]
    rows = [{**job.mark, "job": str(k), "diagnosed": 0, "mapped": 0} for k in range(999)]
    with full_disk(2000):
        refused = work(job, catalogue.results)
        assert refused.tables == {}
        assert refused.hindrance.startswith("one first: ")
        assert refused.hindrance.endswith(".nc: cannot be written: File too large")
        with pytest.raises(WriteError, match=r"done/.*\.parquet: cannot be written: File too large"):
            catalogue.add("done", rows)
    assert catalogue.rows("done") == []
    assert [path for path in catalogue.folder.rglob("*") if "partial" in path.name] == []
    assert len(new_jobs(catalogue, jobs(catalogue))) == 3


def test_a_change_is_dated_and_reported(catalogue: Catalogue, tmp_path: Path, command: Command) -> None:
    for number in range(5):
        log = fly(tmp_path / f"{number}.nc", 1, number)
        if number == 4:  # a magnetised screw
            changed = read(log)
            changed["mag_y"] = changed["mag_y"] + 400.0
            write(changed, log)
        add_logs(catalogue, "comet", Deployment(f"d{number}", (), "spring"), [log])
    for job in jobs(catalogue):
        catalogue.add_tables(work(job, tmp_path / "results").tables)
    place, page = catalogue.folder, tmp_path / "page.html"
    reported = command("fleet", "show", "comet", "--catalogue", place, "--html", page).out.splitlines()
    assert reported[0] == "comet: 5 deployments, 1 change"
    assert "d4 (refit spring): hard iron, y moved by +" in reported[1]
    assert reported[1].endswith("iron that was magnetised, fitted or removed, and no refit is on record")
    pages = tmp_path / "pages"
    command("fleet", "show", "--catalogue", place, "--html", pages)
    assert {path.name for path in pages.iterdir()} == {"index.html", "comet.html", "fleet.json"}
    for text in (page.read_text(), (pages / "comet.html").read_text()):
        assert "<td class=changed>hard iron, y</td>" in text
        assert text.count("<svg") == 12
        assert not any(colour in text for colour in PAGE_COLOURS)
        assert "src=" not in text
        assert 'href="http' not in text
    assert '<a href="comet.html">' in (pages / "index.html").read_text()
    comet = json.loads((pages / "fleet.json").read_text())["vehicles"]["comet"]
    (change,) = comet["deployments"][4]["changes"]
    assert change["what"] == "hard iron, y"
    # a finding with its improvement, and the last map
    job, grid = jobs(catalogue)[-1], tmp_path / "results" / "map.nc"
    axes = np.linspace(10.0, 10.01, 8), np.linspace(48.0, 48.01, 9)
    AnomalyGrid(*axes, np.add.outer(np.arange(9.0), np.arange(8.0)), 5.0, 0.0).save(grid)
    cause = {**job.mark, "cause": "temperature_offset", "channel": "sensor_temperature"}
    catalogue.add("findings", [{**cause, "verdict": "explained", "signal_to_noise": 9.0}])
    catalogue.add("improvements", [{**cause, "ratio": 0.42, "low": 0.37, "high": 0.49}])
    catalogue.add("maps", [{**job.mark, "path": str(grid), "rms": 1.0, "sigma": 2.0}])
    command("fleet", "show", "--catalogue", place, "--html", page)
    text = page.read_text()
    assert "<td>temperature offset</td><td>0.42 times (0.37 to 0.49)</td>" in text
    assert 'alt="Anomaly map of deployment d4" src="data:image/png;base64,' in text
    assert "Of many coefficients, some lie outside their bands by chance." in text


def test_a_fit_starts_from_its_fleet(done: Catalogue, flown: Path, tmp_path: Path, command: Command) -> None:
    log = fly(tmp_path / "third.nc", 1, 2)
    few = read(log)
    write(few.isel(time=np.isin(few["run"], np.unique(few["run"])[:2])), log)
    options = "--fleet", done.folder, "-o", "cal.json"
    assert "name the vehicle with --vehicle" in command("calibrate", log, *options, code=2).err
    found = command.json("calibrate", log, *options, "--vehicle", "one", "--refit", "spring")["fleet"]
    assert (found["deployments"], found["deployments_of_others"]) == (2, 1)
    assert found["expected_nT"] < 0.5 * found["expected_alone_nT"]
    # a log that is catalogued has its vehicle there, and is not learned from twice
    again = command.json("calibrate", flown / "one/second.nc", *options)
    assert again["fleet"]["deployments"] == 1


def test_what_is_expected_is_a_calibration(done: Catalogue, command: Command) -> None:
    command("fleet", "export", "one", "--catalogue", done.folder, "-o", "cal.json")
    known = load("cal.json")
    assert known.method == "fleet"
    assert known.warnings
    (own, other) = (row for row in done.rows("calibrations") if row["vehicle"] == "one")
    assert known.noise.sensor**2 == pytest.approx((own["noise"] ** 2 + other["noise"] ** 2) / 2)
    off = known.coefficients[6:9] - decode_calibration(own["calibration"].encode()).coefficients[6:9]
    assert (np.abs(off) < 4.0 * np.sqrt(np.diag(known.covariance)[6:9])).all()


# ---- Killed processes --------------------------------------------------------------------------------------


PATIENCE = 120.0
"""Time limit on a busy computer, s."""


def until(what: Callable[[], bool], *processes: subprocess.Popen[str]) -> None:
    """Wait until a condition holds; fail if one of the processes ends before."""
    end = time.monotonic() + PATIENCE
    while not what():
        assert time.monotonic() < end
        for process in processes:
            assert process.poll() is None, process.communicate()
        time.sleep(0.1)  # reading the catalogue takes a processor from the processes


def start(*command: str | Path, module: str = "magbridge") -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", module, *map(str, command)],
        text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip


def test_killed_and_run_again_it_is_the_same(done: FolderCatalogue, flown: Path, tmp_path: Path) -> None:
    folder, where = tmp_path / "fleet", tmp_path / "scheduler.json"
    catalogue = catalogue_of(tmp_path, flown)

    def finished(count: int) -> Callable[[], bool]:
        return lambda: len(catalogue.rows("done")) >= count

    options = "--port", "0", "--no-dashboard", "--scheduler-file"
    scheduler = start(*options, where, module="distributed.cli.dask_scheduler")
    try:
        until(where.exists, scheduler)
        worker = start(
            "--scheduler-file", where, "--nthreads", "1", "--no-dashboard", "--no-nanny",
            "--local-directory", tmp_path / "worker", module="distributed.cli.dask_worker",
        )  # fmt: skip
        address = json.loads(where.read_text())["address"]
        command = start("fleet", "process", "--catalogue", folder, "--scheduler", address)
        until(finished(1), scheduler, worker, command)
    finally:
        scheduler.kill()
        scheduler.communicate()
    out, output = command.communicate(timeout=PATIENCE)
    worker.kill()
    worker.communicate()
    early = len(catalogue.rows("done")) < 3  # it was not too late to be killed
    if early:
        assert command.returncode == 1, (out, output)
        lost = f"magbridge: {address}: the dask scheduler was lost; run magbridge fleet process again"
        assert lost in output
        assert "Traceback" not in output
    two = [start("fleet", "process", "--catalogue", folder, "--workers", "1") for _ in range(2)]
    if early:  # two people at once, of whom one is killed
        until(finished(2), *two)
        two[0].send_signal(signal.SIGKILL)
        two.pop(0).communicate()
    for one in two:
        out, output = one.communicate(timeout=PATIENCE)
        lines = [line for line in output.splitlines() if not line.startswith("magbridge: deployments: ")]
        assert (one.returncode, lines) == (0, []), out  # a busy computer prints the progress
    # except the last results, which the fixture's run did not learn
    mine, theirs = content(catalogue), content(done)
    assert len(mine.pop("populations")) == 1
    theirs.pop("populations")
    assert mine == theirs
    for row in mine["corrected"]:
        logs = [xr.load_dataset(one.results / row["path"]) for one in (catalogue, done)]
        for log in logs:
            assert "written by magbridge" in log.attrs.pop("history")  # with its time
        xr.testing.assert_identical(*logs)


@pytest.mark.parametrize("memory", ["lots", "4", "-1 GiB"])
def test_a_worker_needs_an_amount_of_memory(memory: str) -> None:
    with pytest.raises(WrongUse, match="--memory: expected an amount"), client_of("", 1, memory):
        pass
