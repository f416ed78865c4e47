"""Test that a command rejects bad input with one clear line, its exit code, and no partial file."""

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from machine import full_disk

from magbridge.calibration.file import save as save_calibration
from magbridge.calibration.fitting.fit import METHODS
from magbridge.calibration.model import CalibratedSensor, Parameter, identity
from magbridge.columns import CHANNELS
from magbridge.logs import read, write

METHOD_NAMES = ", ".join(f'"{name}"' for name in METHODS)


def test_what_is_read_is_not_written_over(deployment: Path, command: Command) -> None:
    log, link, folder = Path("log.csv"), Path("link.csv"), Path("calibration.json")
    log.write_bytes(deployment.read_bytes())
    link.symlink_to(log)
    for written, arguments in (
        (log, ["convert", log, "-o", log]),
        (link, ["convert", log, "-o", link]),
        (log, ["correct", deployment, "--calibration", log, "-o", log]),
        (folder, ["calibrate", deployment, "--grid", folder, "-o", folder]),
        (folder, ["calibrate", deployment, "--vehicle", folder, "-o", folder]),
        (log, ["simulate", "demo", "--trajectory-from", log, "-o", log]),
        (log, ["simulate", log, "-o", log]),
        (log, ["navigate", deployment, "--map", log, "--bound", "-o", log]),
        (folder, ["diagnose", deployment, "--calibration", folder, "-o", "."]),
    ):
        line = command.refuses(*arguments, code=2)
        assert line.endswith(": is one of the files to read; choose another file to write")
        assert Path(line.partition(": is one of")[0]).resolve() == written.resolve()
    assert log.read_bytes() == deployment.read_bytes()
    loop = Path("loop.csv")
    loop.symlink_to(loop)
    assert "expected a file, there is none" in command.refuses("convert", loop, "-o", "x.csv")


@pytest.mark.parametrize("name", ["correct", "navigate"])
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e9])
def test_a_log_in_another_unit_is_not_corrected(
    unit: float, name: str, deployment: Path, calibration: Path, here: Path, command: Command
) -> None:
    """Tesla, µT or worse under the name of nT would otherwise be corrected to a field, unflagged."""
    rows = read(deployment).isel(time=slice(0, 60))
    write(rows.assign({channel: unit * rows[channel] for channel in CHANNELS}), "log.nc")
    line = command.refuses(name, "log.nc", "--calibration", calibration, "-o", "x.nc")
    assert line.startswith("log.nc (deployment.csv): mag_x mag_y mag_z: the length of the vector is ")
    assert line.endswith(" nT: expected nT")
    assert [path.name for path in here.iterdir()] == ["log.nc"]


@pytest.mark.parametrize(
    "arguments",
    ["correct log.nc -o x.nc", "navigate log.nc -o x.nc", "diagnose log.nc -o out", "plan --mission log.nc"],
    ids=lambda arguments: arguments.split()[0],
)
def test_a_position_in_another_unit_is_refused(
    arguments: str, deployment: Path, here: Path, command: Command
) -> None:
    """Metres taken for inches were corrected to a field that was off by hundreds of nT, unflagged."""
    rows = read(deployment).isel(time=slice(0, 60))
    rows["battpos"] = (0.0254 * rows["battpos"]).assign_attrs(units="m")
    write(rows, "log.nc")
    save_calibration(identity((Parameter("battpos", "in", -0.5, 0.5, 0.0, 0.5),)), Path("cal.json"))
    line = command.refuses(*arguments.split(), "--calibration", "cal.json")
    assert line.endswith(": column 'battpos': expected 'in', the calibration's unit, not 'm'")
    assert {path.name for path in here.iterdir()} == {"log.nc", "cal.json"}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ("convert -o x.csv", 2, "expected at least one FILE"),
        ("convert {d} -o x.foo", 2, "must end in .csv or .magarrow.csv or .mcap or .nc or .parquet or .tlog"),
        ("simulate demo -o x.bin", 2, "must end in .csv"),
        ("convert {d}", 2, "parameter --output is required"),
        ("convert {d} -o", 2, "parameter -o requires an argument"),
        ("info", 2, "expected at least one FILE"),
        ("fly", 2, "fly"),
        ("replay {d} --speed fast", 2, "--speed fast: expected a positive number"),
        ("replay {d} --speed -1", 2, "expected a positive number"),
        ("replay {d} --speed 1e-300", 2, "0.001 or more, or max"),
        ("plan --calibration {d} --mission {d} --runs 101", 2, "--runs. Must be <= 100"),
        ("calibrate {d} --parameter heading -o x.json", 1, "heading, clockwise from north: it moves no mass"),
        ("simulate none -o x.csv", 2, "none: scenario: expected one of battery, bolt, bonne_bay, "),
        ("correct {d} --calibration {d} -o x.csv", 1, "not a calibration as magbridge "),
        ("simulate seaglider -o x.nc", 2, "has no mission: drive it with a log (--trajectory-from)"),
        ("calibrate {d} --parameter nose -o x.json", 1, "column 'nose'"),
        ("calibrate {d} --parameter mag_x -o x.json", 1, "'mag_x' is raw magnetic field, sensor x (forward)"),
        ("calibrate {d} --filter-cutoff 1e-9 -o x.json", 1, "filter corner = 1e-09 Hz"),
        ("calibrate {d} --method magic -o x.json", 2, f"Choose from: {METHOD_NAMES}"),
        ("calibrate {d} --method cubic --vehicle v.toml -o x.json", 2, "--vehicle: "),
        ("calibrate {d} --order 0 -o x.json", 2, "order"),
        ("calibrate {d} --parameter run --parameter run -o x.json", 1, "'run' is named twice"),
        ("calibrate {d} --site-bias 1e300 -o x.json", 2, "--site-bias. Must be <= 100000"),
        ("map none.nc -o x.foo", 2, "must end in .nc"),
        ("map none.nc -o x.nc --altitude 1e308", 2, "Must be <= 1000000"),
        ("map none.nc -o x.nc --plot x.foo", 2, "must end in .png or .pdf or .svg"),
        ("convert {d} -o nowhere/x.csv", 2, "The folder nowhere does not exist"),
        ("convert {d} -o .", 2, "Expected a file, got a folder"),
        ("simulate demo --trajectory-from {d} b.nc -o x.nc", 2, "b.nc: unexpected argument"),
        ("simulate demo --trajectory-from {d} b c d -o x.nc", 2, "b and 2 more: unexpected"),
        ("convert {d} -o /proc/self/x.csv", 2, "The folder /proc/self cannot be written to"),
        ("diagnose {d} --calibration {d} -o {d}", 2, "Expected a folder, got a file"),
        ("demo --out {d}", 2, "Expected a folder, got a file"),
        ("replay {d} --log /proc/self/new", 2, "The folder /proc/self cannot be written to"),
        ("demo --out /proc/self/new/demo", 2, "The folder /proc/self cannot be written to"),
        ("simulate demo -o x.nc --seed -1", 2, "--seed"),
        ("simulate demo -o x.nc --seed 1.5", 2, "--seed: expected a whole number, got 1.5"),
        ("demo --out /dev/null/demo", 2, "/dev/null is a file"),
        ("diagnose {d} --calibration {d} -o {d}/found", 2, "deployment.csv is a file"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(
    deployment: Path, here: Path, command: Command, arguments: str, code: int, words: str
) -> None:
    line = command.refuses(*arguments.format(d=deployment).split(), code=code)
    assert words in line
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("room", [0, 20_000])
@pytest.mark.parametrize("suffix", [".csv", ".nc", ".parquet", ".tlog"])
def test_a_full_disk_gets_one_line_and_leaves_nothing(
    suffix: str, room: int, deployment: Path, here: Path, command: Command
) -> None:
    with full_disk(room):
        line = command.refuses("convert", deployment, "-o", f"x{suffix}")
    assert line == f"x{suffix}: cannot be written: File too large"
    assert list(here.iterdir()) == []


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("time", 1.78e12, "row 12, column 'time': expected seconds since 1970"),
        ("latitude", 4952.3, "row 12, column 'latitude': expected deg, at most 90"),
        ("mag_time_z", 12.0, "row 12, column 'mag_time_z': expected a time within 60 s"),
        ("reference_field", 5.2e-5, "row 12, column 'reference_field': expected 1000 to 1e+06 nT"),
    ],
)
def test_what_would_be_another_place_or_moment(
    deployment: Path, command: Command, column: str, value: float, words: str
) -> None:
    lines = deployment.read_text().splitlines()
    cells = lines[11].split(",")
    cells[lines[0].split(",").index(column)] = repr(value)
    Path("bad.csv").write_text("\n".join([*lines[:11], ",".join(cells), *lines[12:]]))
    assert words in command.refuses("convert", "bad.csv", "-o", "x.nc", "--strict")
    assert not Path("x.nc").exists()
    count, named = command("convert", "bad.csv", "-o", "x.nc").err.splitlines()
    assert count.startswith("magbridge: in the logs: 1 ")
    assert words in named
    both = [read(path).to_array().isnull().sum() for path in ("x.nc", deployment)]
    assert both[0] == both[1] + (column != "time")


def test_one_position_that_is_none(deployment: Path, command: Command) -> None:
    rows = read(deployment)
    rows["battpos"][7] = -9999.0
    write(rows, "bad.nc")
    masses = "--parameter", "battpos", "--parameter", "ballast"
    line = command.refuses("calibrate", "bad.nc", *masses, "-o", "c.json")
    assert "'battpos' is -9999 in 1 of 3600 samples" in line


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    command = sys.executable, "-m", "magbridge", *arguments
    return subprocess.run(command, env={**os.environ, **environment}, capture_output=True, check=False)


def test_a_name_that_is_not_of_the_locale(deployment: Path, here: Path) -> None:
    """Latin-1 names on a UTF-8 system: netCDF cannot open them, and JSON cannot hold them."""
    name = os.fsdecode(b"m\xe4.nc")
    write(read(deployment).isel(time=slice(0, 60)), "log.nc")
    Path("log.nc").rename(name)
    done = run("convert", name, "-o", "x.csv", PYTHONUTF8="1")
    output = rb"magbridge: m\udce4.nc: expected a name in utf-8; rename the file" + b"\n"
    assert (done.returncode, done.stderr) == (1, output)
    assert len(list(here.iterdir())) == 1


@pytest.mark.parametrize("encoding", [{"PYTHONIOENCODING": "ascii:strict"}, {}])
def test_what_cannot_be_printed_is_no_error(encoding: dict[str, str], deployment: Path, here: Path) -> None:
    plain = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    done = run("convert", str(deployment), "-o", "\xb5.csv", **plain, **encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.endswith(b".csv: 3600 rows\n")
    Path("log.csv").write_text("time,x [\xb5V]\n1600000000,1\n1600000001,2\n", encoding="utf-8")
    done = run("info", "log.csv", **plain, **encoding)
    assert done.returncode == 0
    assert rb"\xb5V" in done.stdout


LOGS: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
    "empty.csv": lambda rows: rows.assign({name: np.nan * rows[name] for name in rows}),
    "dumb.csv": lambda rows: rows.assign({name: np.nan * rows[name] for name in CHANNELS}),
    "short.csv": lambda rows: rows.drop_vars("mag_z"),
    "other.nc": lambda rows: rows.assign_attrs(sensor="hmr2300"),
}
"""Changes of a minute of the simulated log; ``short.csv`` lacks a channel of the magnetometer."""


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ("survey dumb.csv -o x.nc", 1, "dumb.csv: only 0 of 60 samples have every value"),
        ("plan --mission empty.csv --survey 1", 1, "empty.csv: "),
        ("navigate empty.csv --map grid.nc --bound -o x.nc", 1,
         "empty.csv: expected a plan of at least two rows"),
        ("correct parts.csv --calibration cal.json -o x.csv", 1,
         "parts.csv: expected rows with all of mag_x mag_y mag_z, got none"),
        ("correct other.nc --calibration cal.json -o x.nc", 1,
         ": expected a log of sensor 'digitizer', the calibration's, got 'hmr2300'"),
        ("calibrate short.csv -o x.nc", 2, "Its name must end in .json"),
        ("survey short.csv --save x.csv -o x.nc", 2, "Its name must end in .json"),
        ("correct short.csv -o x.nc", 2, "expected --calibration cal.json, or --learn with"),
        ("correct short.csv --config bridge.toml -o x.nc", 2, "--learn"),
        ("convert short.csv -o x.csv --column mag_x", 2, '--column mag_x: expected NAME="THEIRS [unit]"'),
        ("correct short.csv --calibration cal.json -o x.nc", 1, "column 'mag_z': expected this column"),
        ("init --driver none", 2, "expected one of ascii, digitizer, hmr2300, rm3100, twinleaf"),
        ("init --option x", 2, "expected NAME=VALUE"),
        ("init --calibration none.json", 1, "none.json: expected a file, there is none"),
        ("init --driver hmr2300 --link wrong -o x.toml", 2, "x.toml: link.url: expected udpin, udpout"),
        ("init --driver ascii --option unit=nT --option unid=3 -o x.toml", 2, "did you mean unit?"),
    ],
)  # fmt: skip
def test_a_log_without_what_the_command_needs_is_named(
    arguments: str, code: int, words: str, deployment: Path, here: Path, command: Command
) -> None:
    rows = read(deployment).isel(time=slice(0, 60))
    for name, change in LOGS.items():
        if name in arguments:
            write(change(rows), name)
    Path("parts.csv").write_text("time,mag_x,mag_y,mag_z\n1386201601,,2,3\n1386201602,1,,\n")
    save_calibration(replace(identity(), sensor=CalibratedSensor("digitizer")), "cal.json")
    if "grid.nc" in arguments:
        command("simulate", "demo", "-o", "twin.nc", "--map", "grid.nc", "--seed", "5")
    line = command.refuses(*arguments.split(), code=code)
    assert words in line
    assert line.startswith(words) or not words.partition(":")[0].endswith(".csv")
    assert not list(here.glob("x.*"))


# ---- A fault of a file is exit code 1 in every command -----------------------------------------------------


COMMANDS = {
    "convert": "convert {f}.csv -o x.nc",
    "convert --metadata": "convert log.csv -o x.nc --metadata {f}.toml",
    "info": "info {f}.csv",
    "calibrate": "calibrate {f}.csv -o x.json",
    "calibrate --grid": "calibrate log.csv --grid {f}.nc -o x.json",
    "calibrate --vehicle": "calibrate log.csv --vehicle {f}.toml -o x.json",
    "correct": "correct {f}.csv --calibration cal.json -o x.nc",
    "correct --calibration": "correct log.csv --calibration {f}.json -o x.nc",
    "correct --columns": "correct log.csv --calibration cal.json --columns {f}.toml -o x.nc",
    "diagnose": "diagnose {f}.csv --calibration cal.json -o x",
    "diagnose --calibration": "diagnose log.csv --calibration {f}.json -o x",
    "survey": "survey {f}.csv -o x.nc",
    "survey --calibration": "survey log.csv --calibration {f}.json -o x.nc",
    "navigate": "navigate {f}.csv --calibration cal.json -o x.nc",
    "navigate --map": "navigate log.csv --calibration cal.json --map {f}.nc -o x.nc",
    "navigate --config": "navigate log.csv --calibration cal.json --config {f}.toml -o x.nc",
    "map": "map {f}.nc -o x.nc",
    "map --mask": "map {f}.nc --mask {f}.csv -o x.nc",
    "plan": "plan --mission {f}.csv --calibration cal.json",
    "plan --calibration": "plan --mission log.csv --calibration {f}.json",
    "export": "export {f}.json --c x",
    "run": "run --config {f}.toml",
    "replay": "replay {f}.csv",
    "replay --config": "replay log.csv --config {f}.toml",
    "simulate": "simulate {f}.toml -o x.nc",
    "simulate --trajectory-from": "simulate demo --trajectory-from {f}.csv -o x.nc",
    "monitor --map": "monitor --map {f}.nc",
    "monitor --signing-key": "monitor --signing-key {f}.key",
    "fleet add": "fleet add {f}.csv --vehicle v --parameter battpos --deployment d",
    "fleet add fleet.toml": "fleet add {f}.toml",
    "fleet status": "fleet status --catalogue {f}",
    "fleet process": "fleet process --catalogue {f}",
    "fleet show": "fleet show --catalogue {f}",
    "fleet export": "fleet export v --catalogue {f} -o x.json",
}


def binary(path: Path) -> None:
    """Write a file that contains every byte value."""
    path.write_bytes(bytes(range(256)) * 40)


FAULTS: dict[str, Callable[[Path], object] | None] = {
    "missing": None,
    "directory": Path.mkdir,
    "empty": Path.touch,
    "wrong format": binary,
}
NO_FAULT = ("fleet add", "wrong format")
"""Pairs of command and fault without an error: the file is only registered; `fleet process` reads it."""


@pytest.fixture
def files(deployment: Path, here: Path) -> Path:
    write(read(deployment).isel(time=slice(0, 60)), "log.csv")
    save_calibration(identity(), "cal.json")
    return here


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_fault_of_a_file_is_exit_code_1_in_every_command_but_run(
    name: str, fault: str, files: Path, command: Command
) -> None:
    if (name, fault) == NO_FAULT:
        pytest.skip("fleet add does not read the content")
    arguments = COMMANDS[name].format(f="given").split()
    for argument in {one for one in arguments if one.startswith("given")}:
        if make := FAULTS[fault]:
            make(Path(argument))
    before = sorted(files.iterdir())
    as_json = ["--json"] * (not name.startswith("monitor") and name != "run")
    output = command(*arguments, *as_json, code=2 if name == "run" else 1)
    line = output.err.removeprefix("magbridge: ").removesuffix("\n")
    assert "\n" not in line
    assert "given" in line
    assert not as_json or json.loads(output.out) == {"error": line, "exit_code": 1}
    assert sorted(files.iterdir()) == before


def test_a_misspelt_name_is_answered_with_the_nearest(files: Path, command: Command) -> None:
    for arguments, code, near in (
        ("calibrat log.csv", 2, '"calibrate"'),
        ("calibrate log.csv --paramter battpos -o x.json", 2, "--parameter"),
        ("calibrate log.csv --parameter batpos -o x.json", 1, "battpos"),
        ("calibrate log.csv --method nomnal -o x.json", 2, '"nominal"'),
        ("simulate surve -o x.nc", 2, "survey"),
        ("drivers digitzer", 2, "digitizer"),
        ("fleet proces", 2, '"process"'),
    ):
        line = command.refuses(*arguments.split(), code=code)
        assert f"did you mean {near}?" in line.replace("Did", "did"), line


def test_without_a_file_handle_a_command_ends_in_one_line(files: Path) -> None:
    """At 3 nothing can be loaded; the limit at which a library cannot be depends on the system."""
    for limit in (4, 12):
        done = subprocess.run(
            [sys.executable, "-S", "-m", "magbridge", "info", "none.csv"],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))},
            preexec_fn=partial(resource.setrlimit, resource.RLIMIT_NOFILE, (limit, limit)),
        )
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1, done.stderr
