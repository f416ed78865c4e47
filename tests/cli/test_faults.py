"""Test that a fault of a file gives the same exit code and one line in every command."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from commands import Command

from magbridge.calibration.file import save as save_calibration
from magbridge.calibration.model import identity
from magbridge.logs import read, write

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
    "run --check": "run --check --config {f}.toml",
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
def test_a_fault_of_a_file_is_exit_code_1_in_every_command(
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
    output = command(*arguments, *as_json, code=1)
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
