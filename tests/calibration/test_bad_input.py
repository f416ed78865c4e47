"""Test that bad calibration data give exit code 1, one clear line and no file."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import Command
from demos import demo_log

from magbridge.cli import main
from magbridge.logs import write
from sitl import segments

PARAMETERS = ("--parameter", "battpos", "--parameter", "ballast")


@pytest.fixture(scope="module")
def runs() -> xr.Dataset:
    return segments(demo_log())["calibration"].isel(time=slice(0, None, 4)).drop_vars("reference_field")


@pytest.fixture(scope="module")
def good(runs: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a good log and its calibration."""
    folder = tmp_path_factory.mktemp("good")
    write(runs, folder / "runs.csv")
    assert main(["calibrate", str(folder / "runs.csv"), *PARAMETERS, "-o", str(folder / "cal.json")]) == 0
    return folder / "runs.csv", folder / "cal.json"


def changed(runs: xr.Dataset, **columns: Any) -> xr.Dataset:
    return runs.assign(
        {name: (("time"), np.broadcast_to(value, runs.sizes["time"])) for name, value in columns.items()}
    )


BAD: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "too few samples": (
        lambda ds: ds.isel(time=slice(0, 6)),
        "only 6 of 6 samples have every value: at least 10",
    ),
    "one attitude": (
        lambda ds: changed(ds, **{f"mag_{axis}": ds[f"mag_{axis}"].to_numpy()[0] for axis in "xyz"}),
        "within 0.0 degrees of one attitude: fly turns",
    ),
    "all NaN": (lambda ds: changed(ds, mag_y=np.nan), "have every value ('mag_y' has 0 numbers)"),
    "a sensor that is not there": (
        lambda ds: changed(ds, **{f"mag_{axis}": 0.0 for axis in "xyz"}),
        "have every value ('mag_x' has 0, 'mag_y' has 0, 'mag_z' has 0 numbers)",
    ),
    "gauss": (
        lambda ds: changed(ds, **{f"mag_{axis}": 1e-5 * ds[f"mag_{axis}"].to_numpy() for axis in "xyz"}),
        "the length of the vector is 0.478 (median)",
    ),
    "a parameter that never moves": (
        lambda ds: changed(ds, battpos=0.3),
        "'battpos' never moves (it is 0.3 throughout)",
    ),
    "after the IGRF": (
        lambda ds: ds.drop_vars([f"mag_time_{axis}" for axis in "xyz"]).assign_coords(time=ds["time"] + 3e9),
        "the IGRF covers",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_data(case: str, runs: xr.Dataset, command: Command) -> None:
    spoil, words = BAD[case]
    write(spoil(runs), "bad.csv")
    output = command.refuses("calibrate", "bad.csv", *PARAMETERS, "-o", "cal.json")
    assert words in output
    assert output.startswith("bad.csv: ")
    assert not Path("cal.json").exists()


def test_a_run_given_twice_counts_once(good: tuple[Path, Path], command: Command) -> None:
    Path("again.csv").write_bytes(good[0].read_bytes())
    output = command("calibrate", good[0], "again.csv", *PARAMETERS, "-o", "cal.json").err
    assert f"again.csv: has the same content as {good[0]}; its samples are used once" in output
    assert "in the logs: 563 duplicate rows" in output
    once, twice = (json.loads(path.read_text()) for path in (good[1], Path("cal.json")))
    assert once["coefficients"] == twice["coefficients"]


def later(runs: xr.Dataset, days: int) -> xr.Dataset:
    shift = 86400.0 * days
    sampled = {name: runs[name].to_numpy() + shift for name in (f"mag_time_{axis}" for axis in "xyz")}
    return changed(runs, **sampled).assign_coords(time=runs["time"].to_numpy() + shift)


def test_a_log_that_adds_nothing_is_reported(
    runs: xr.Dataset, good: tuple[Path, Path], command: Command
) -> None:
    """The command reports a log whose samples do not enter the fit."""
    write(changed(later(runs, 1), mag_x=np.nan), "no_x.csv")
    write(later(runs, 2).drop_vars("battpos"), "no_mass.csv")
    write(runs.assign(mag_x=runs["mag_x"] + 100.0), "same_times.csv")
    logs = good[0], "no_x.csv", "no_mass.csv", "same_times.csv"
    output = command("calibrate", *logs, *PARAMETERS, "-o", "cal.json", "--json")
    idle = [line for line in output.err.splitlines() if "adds no sample" in line]
    assert [line.partition(": adds no sample to the fit: ")[::2] for line in idle] == [
        ("magbridge: no_x.csv", "'mag_x' has no number"),
        ("magbridge: no_mass.csv", "'battpos' has no number"),
        ("magbridge: same_times.csv", "runs.csv has samples at the same times, and the first counts"),
    ]
    assert json.loads(output.out)["left_out"] == 2 * 563
    once, all_logs = (json.loads(path.read_text())["coefficients"] for path in (good[1], Path("cal.json")))
    assert once == all_logs


def test_logs_of_two_vehicles_are_distinguished(
    runs: xr.Dataset, good: tuple[Path, Path], command: Command
) -> None:
    """Logs of two vehicles are distinguished, but not logs of one vehicle on two days."""
    iron = {f"mag_{axis}": runs[f"mag_{axis}"].to_numpy() + 5000.0 for axis in "xy"}
    write(changed(later(runs, 1), **iron), "other.csv")
    write(later(runs, 1), "own.csv")
    for name in ("own.csv", "other.csv"):
        output = command("calibrate", good[0], name, "--method", "nominal", "-o", "cal.json").err
        assert ("one calibration does not fit all logs" in output) == (name == "other.csv"), output
    assert "each on its own runs.csv " in output


def test_where_two_vehicles_leave_no_fit_at_all(runs: xr.Dataset, command: Command) -> None:
    """The message names the two vehicles, not a lack of attitudes."""
    other = segments(demo_log(3))["calibration"].isel(time=slice(0, None, 4))
    write(runs, "one.csv")
    write(later(other.drop_vars("reference_field"), 1), "two.csv")
    fit = "calibrate", "one.csv", "two.csv", *PARAMETERS, "--method", "cubic", "-o", "cal.json"
    output = command.refuses(*fit)
    assert output.startswith(
        "one.csv, two.csv: one calibration does not fit all logs: together the fit collapses, each on its "
    )
    assert not Path("cal.json").exists()
