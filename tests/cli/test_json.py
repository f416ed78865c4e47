"""``--json``: one valid object on standard output, of a result or of an error."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import Command
from cyclopts import App
from small import bridge_text

from magbridge.cli.common import app
from magbridge.logs import read, write

HAVE_NO_RESULT = {"monitor"}
"""Commands that run until they are interrupted."""
BRIDGE = bridge_text("hmr2300", "", port="loop://", masses={}, calibration=False, log=False)


def names(group: App = app, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for name in group:
        if not name.startswith("-"):
            below = list(names(group[name], (*before, name)))
            yield from below or [(*before, name)]


ALL = sorted(set(names()) - {(name,) for name in HAVE_NO_RESULT})


def only_object(text: str) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    assert text.count("\n") == 1
    found = json.loads(text, parse_constant=refuse)
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="session")
def short(deployment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The made log, a sixth of it: enough for one ellipsoid."""
    path = tmp_path_factory.mktemp("short") / "short.nc"
    write(read(deployment).isel(time=slice(0, None, 6)), path)
    return path


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        ("calibrate {d} --method nominal -o x.json", "file method samples rms_nT supported paper left_out"),
        ("calibrate {d} --method nominal --compass all -o x.json", "compasses"),
        ("convert {d} -o x.csv", "file rows columns"),
        ("correct {d} --calibration {c} -o x.nc", "file rows flagged flags left_out"),
        ("correct {d} --calibration {c} --learn -o x.nc", "file learned_samples calibration_id unexplained"),
        ("dialect -o x", "files"),
        ("drivers", "hmr2300 ascii"),
        ("drivers hmr2300", "hmr2300"),
        ("export {c} --ardupilot x.param", "files"),
        ("info {d}", "{d}"),
        ("init -o x.toml --driver hmr2300", "file findings"),
        ("map grid.nc -o x.nc", "file steps rms_nT"),
        ("navigate {d} --calibration {c} --map grid.nc -o x.nc", "file rows valid sigma_m error_m findings"),
        ("navigate {d} --map grid.nc --bound -o x.nc", "file findings sample_sigma_nT"),
        ("plan --calibration {c} --mission {d} --runs 1", "runs"),
        ("plan --survey 1 --mission {d}", "surveys"),
        ("ports loop://", "ports"),
        ("run --config bridge.toml --check", "file would_start findings"),
        ("simulate demo -o x.nc", "file rows seed"),
        ("survey {d} --calibration {c} -o x.nc", "file samples crossovers residual_nT warnings"),
    ],
    ids=lambda text: text.partition(" -")[0] if " " in text else "",
)
def test_a_result_is_one_object(
    arguments: str, keys: str, short: Path, calibration: Path, command: Command
) -> None:
    Path("bridge.toml").write_text(BRIDGE)
    if "grid.nc" in arguments:
        command("simulate", "demo", "-o", "twin.nc", "--map", "grid.nc", "--seed", "5")
    values = {"d": short, "c": calibration}
    found = only_object(command(*arguments.format(**values).split(), "--json").out)
    assert set(keys.format(**values).split()) <= set(found)


@pytest.mark.parametrize("name", ALL, ids=" ".join)
def test_a_wrong_option_is_one_object(name: tuple[str, ...], command: Command) -> None:
    """Also where the command line cannot be parsed."""
    output = command(*name, "--no-such-option", "--json", code=2)
    assert only_object(output.out) == {"error": output.err.removeprefix("magbridge: ")[:-1], "exit_code": 2}


@pytest.mark.parametrize(
    "arguments",
    [
        *("convert no -o x.nc", "correct no --calibration no -o x.nc", "calibrate no -o x.json", "info no"),
        *("survey no -o x.nc", "replay no", "plan --calibration no --mission no", "export no --c x"),
        *("run --check --config no", "map no -o x.nc", "navigate no --calibration no -o x.nc"),
        *("diagnose no --calibration no -o x", "fleet status --catalogue no", "simulate no.toml -o x.nc"),
    ],
)
def test_a_missing_file_is_one_object(arguments: str, here: Path, command: Command) -> None:
    output = command(*arguments.split(), "--json", code=1)
    assert only_object(output.out) == {"error": output.err.removeprefix("magbridge: ")[:-1], "exit_code": 1}
    assert list(here.iterdir()) == []


def test_a_bridge_that_would_not_start_is_described_once(command: Command) -> None:
    Path("bridge.toml").write_text(BRIDGE.replace("hmr2300", "hmr23000"))
    found = only_object(command("run", "--config", "bridge.toml", "--check", "--json", code=2).out)
    assert found["would_start"] is False
    assert "did you mean hmr2300?" in found["findings"][0]["text"]
    assert found["findings"][0]["severity"] == "error"
