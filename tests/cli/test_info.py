"""Test ``magbridge info``, and declarations about a log on the command line."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command
from cyclopts import App
from small import bridge_text

from magbridge.cli.common import app
from magbridge.columns import CHANNELS
from magbridge.logs import read, write
from magbridge.logs.deployment import deployment as made
from magbridge.logs.info import USES, info, movers

START = 1.6e9


def test_info_of_the_demo(deployment: Path, command: Command) -> None:
    output = command("info", deployment)
    assert "battpos" in output.out
    assert "calibrate" in output.out
    assert "may move the field, for --parameter: battpos ballast" in " ".join(output.err.split())
    facts = command.json("info", deployment)[str(deployment)]
    assert facts["rows"] == 3600
    assert all(not lacks for lacks in facts["uses"].values())
    battpos = next(one for one in facts["columns"] if one["name"] == "battpos")
    assert battpos["unit"] == "in"
    assert battpos["lowest"] < battpos["highest"]


def test_an_error_in_one_log_does_not_hide_the_others(deployment: Path, command: Command) -> None:
    Path("bad.csv").write_text("not a log")
    alone = command("info", "bad.csv", code=1).err
    output = command("info", "bad.csv", "none.csv", deployment, "--json", code=1)
    assert output.err.splitlines()[0] == alone.strip()
    assert "none.csv: expected a file, there is none" in output.err
    assert output.err.splitlines()[-1] == "magbridge: 2 of 3 logs cannot be read; see the lines above"
    found = json.loads(output.out)
    assert set(found) == {"bad.csv", "none.csv", str(deployment)}
    assert found["bad.csv"]["error"] in alone
    assert found[str(deployment)]["rows"]


def test_info_says_what_is_missing() -> None:
    log = made("log", START + np.arange(9.0), {"mag_x": np.ones(9), "depth": np.full(9, np.nan)})
    facts = info(log)
    assert facts["uses"].keys() == USES.keys()
    assert facts["uses"]["calibrate"] == ["mag_y mag_z", "reference_field, or latitude longitude"]
    assert facts["uses"]["correct"] == ["mag_y mag_z"]
    places = {name: np.arange(9.0) for name in ("total_field", "latitude", "longitude")}
    assert info(made("log", START + np.arange(9.0), places))["uses"]["navigate"] == []
    assert "never known: depth" in facts["hints"]


def test_seconds_too_few_to_be_since_1970_count_from_a_start() -> None:
    """The rule also holds for magbridge's column names, because a log of 1970 is not plausible."""
    facts = info(made("log", [0.0, 0.5], {"mag_x": [1.0, 2.0]}))
    assert facts["references"]["time_reference"] == "boot"
    assert any("--date says when it was" in hint for hint in facts["hints"])


@pytest.mark.parametrize(
    ("columns", "about", "hint"),
    [
        (dict(zip(CHANNELS, (30.0, 5.0, 45.0), strict=True)), "length", "54.31 nT (median); in uT it would"),
        (dict.fromkeys(CHANNELS, 68_000.0), "length", "the vector's length is 1.178e+05 nT (median)"),
        (dict.fromkeys(CHANNELS, np.nan), "length", ""),
        ({"depth": -12.0}, "depth", "depth is -12 m (median): if it counts upwards, scale = -1 in"),
    ],
    ids=["another unit", "no unit", "never known", "upwards"],
)
def test_implausible_values_are_questioned(columns: dict[str, float], about: str, hint: str) -> None:
    log = made("log", [START, START + 1], {name: np.full(2, value) for name, value in columns.items()})
    found = [line for line in info(log)["hints"] if about in line and "never known" not in line]
    assert len(found) == bool(hint)
    assert all(hint in line for line in found)


def test_what_moves_the_field_is_not_a_state_of_the_vehicle() -> None:
    """Neither a counter nor a validity flag counts as a state of the vehicle."""
    names = {"pump": "A", "water": "degC", "supply": "V", "mast": "1", "speed": "m/s", "still": "A"}
    names |= {"MagValid": "1", "Counter": "1"}
    columns = {name: np.arange(9.0) ** 2 * (name != "still") for name in names}
    columns["Counter"] = np.arange(9.0)
    assert movers(made("log", START + np.arange(9.0), columns, names)) == ["pump", "mast"]


def test_columns_are_declared_on_the_command_line(command: Command) -> None:
    Path("theirs.csv").write_text("Zeit;Fx [uT];Fy [uT];Fz [uT]\n2022-05-04T12:00:00Z;30,0;5,0;45,0\n")
    columns = [f"--column=mag_{axis}=F{axis} [uT]" for axis in "xyz"]
    output = command("convert", "theirs.csv", "-o", "ours.csv", *columns)
    assert "guessed: decimal commas; fields separated by ';'; time is 'Zeit'" in output.err
    assert float(read("ours.csv")["mag_z"][0]) == 45_000.0
    assert "theirs.csv was read with: decimal commas" in read("ours.csv").attrs["history"]
    assert "guessed" not in command("convert", "ours.csv", "-o", "again.nc").err
    Path("columns.toml").write_text('[columns.mag_x]\nfrom = "Fx"\nunit = "mT"\n')
    command("convert", "theirs.csv", "-o", "ours.csv", "--columns", "columns.toml")
    assert float(read("ours.csv")["mag_x"][0]) == 30e6


TAKE_LOGS = "calibrate convert correct diagnose info navigate plan replay simulate survey"


@pytest.mark.parametrize("name", TAKE_LOGS.split())
def test_every_command_that_takes_a_log_has_the_reading_options(name: str, command: Command) -> None:
    output = command(name, "--help").out
    for option in ("--column ", "--columns", "--compass", "--date", "--strict"):
        assert option in output, option


def test_a_replay_of_columns_under_other_names(deployment: Path, here: Path, command: Command) -> None:
    rows = read(deployment).isel(time=slice(0, 60))[["mag_x", "mag_y", "mag_z"]]
    write(rows.rename(mag_x="Bx", mag_y="By", mag_z="Bz"), "log.csv")
    declared = [word for axis in "xyz" for word in ("--column", f"mag_{axis}=B{axis} [nT]")]
    result = json.loads(command("replay", "log.csv", "--json", *declared).out)
    assert (result["rows"], result["samples"], result["simulated_field"]) == (60, 60, False)


def test_a_survey_by_the_other_compass(deployment: Path, here: Path, command: Command) -> None:
    line = command.refuses("survey", deployment, "--compass", "1", "-o", "map.nc")
    assert line == f"{deployment.name}: expected a compass '1'; there are: 0"


def test_compasses_that_are_columns_are_listed(command: Command) -> None:
    axes = {f"{name}_{axis}": np.full(9, 20_000.0) for name in ("mag", "mag3") for axis in "xyz"}
    log = made("log", START + 0.5 * np.arange(9.0), axes | {"mag2_x": np.ones(9)})
    found = [(one["number"], one["samples"], one["rate"]) for one in info(log)["compasses"]]
    assert found == [(0, 9, 2), (2, 9, 2)]
    write(log, "two.csv")
    output = command("info", "two.csv")
    assert "compass 0: 2 Hz, 9 samples, read as mag_x mag_y mag_z" in output.out
    assert "compass 2: 2 Hz, 9 samples\n" in output.out


def test_a_log_without_a_date_is_given_one(here: Path, command: Command) -> None:
    """The date is also accepted if pydantic is installed, which would parse the day as a time."""
    write(made("log", np.arange(9.0), {"mag_x": np.ones(9)}).assign_attrs(time_reference="boot"), "boot.csv")
    assert "times count from a start" in command("info", "boot.csv").err
    facts = json.loads(command("info", "boot.csv", "--json", "--date", "2024-06-01").out)["boot.csv"]
    assert facts["start"] == np.datetime64("2024-06-01", "s").astype(float)
    assert facts["references"]["time_reference"] == "utc"
    for wrong in ("2024-06-01T10:00", "1717200000", "yesterday"):
        assert f"expected YYYY-MM-DD, got {wrong}" in command("info", "boot.csv", "--date", wrong, code=2).err


# ---- ``--json``: one valid object on standard output, of a result or of an error -------------------------


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
    """Return a sixth of the made log, enough for one ellipsoid."""
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
    """The output is one JSON object even if the command line cannot be parsed."""
    output = command(*name, "--no-such-option", "--json", code=2)
    assert only_object(output.out) == {"error": output.err.removeprefix("magbridge: ")[:-1], "exit_code": 2}


def test_a_bridge_that_would_not_start_is_described_once(command: Command) -> None:
    Path("bridge.toml").write_text(BRIDGE.replace("hmr2300", "hmr23000"))
    found = only_object(command("run", "--config", "bridge.toml", "--check", "--json", code=2).out)
    assert found["would_start"] is False
    assert "did you mean hmr2300?" in found["findings"][0]["text"]
    assert found["findings"][0]["severity"] == "error"
