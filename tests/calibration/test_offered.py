"""``--parameter auto``: the columns that move the field are found, the others are not taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from demos import demo_log
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.parameter_choice import best_parameters, lines, undeclared
from magbridge.logs import write
from magbridge.logs.deployment import deployment
from magbridge.logs.info import movers

EARTH = np.array([21_000.0, 1_500.0, 43_000.0])
IRON = np.array([800.0, -300.0, 500.0])
PER_AMPERE = np.array([40.0, -25.0, 60.0])
UNITS = {"battery_current": "A", "throttle": "1", "servo1": "us", "baro_temperature": "degC"}


def flight(seed: int = 1, moved: float = 1.0) -> xr.Dataset:
    """Return a drone's turns, whose motors move its field by `moved` times 76 nT a A."""
    rng = np.random.default_rng(seed)
    n = 500
    heading = np.cumsum(rng.normal(3.0, 4.0, n)) % 360.0
    roll, pitch = (30.0 * np.sin(np.arange(n) / period) for period in (17.0, 23.0))
    turned = (
        Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]), degrees=True).inv().apply(EARTH)
    )
    current = 10.0 + 8.0 * np.abs(np.sin(np.arange(n) / 11.0)) + rng.normal(0.0, 0.3, n)
    field = turned + IRON + moved * np.outer(current, PER_AMPERE) + rng.normal(0.0, 40.0, (n, 3))
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", field.T, strict=True)}
    columns |= {"roll": roll, "pitch": pitch, "heading": heading, "battery_current": current}
    columns |= {"throttle": current / 30.0 + rng.normal(0.0, 0.05, n), "servo1": rng.uniform(1100, 1900, n)}
    columns |= {"baro_temperature": np.linspace(20.0, 30.0, n)}
    columns["reference_field"] = np.full(n, np.linalg.norm(EARTH))
    return deployment("flight.csv", 1.6e9 + 0.2 * np.arange(n), columns, UNITS)


def test_the_current_is_taken_and_what_says_the_same_is_not() -> None:
    log = flight()
    taken, offers = best_parameters(log, movers(log))
    assert taken == ("battery_current",)
    first = offers[0]
    assert first.name == "battery_current"
    assert first.left_out < 0.5 * first.without
    assert lines(offers)[0].endswith("with it: taken")
    # the promised error holds on a new flight
    found = fit(observations(log, taken))
    other = observations(flight(2), taken)
    off = correct(found.calibration, other.field, other.parameters, other.time).total - other.reference
    assert float(np.sqrt(np.mean(off**2))) == pytest.approx(first.left_out, rel=0.3)


def test_where_nothing_moves_the_field_nothing_is_taken() -> None:
    log = flight(moved=0.0)
    taken, _ = best_parameters(log, movers(log))
    assert taken == ()


def test_on_the_command_line(tmp_path: Path, command: Command) -> None:
    write(flight(), tmp_path / "flight.csv")
    output = command("calibrate", tmp_path / "flight.csv", "--parameter", "auto", "-o", tmp_path / "cal.json")
    assert "--parameter battery_current: " in output.err
    assert "is not declared" not in output.err
    command(
        "correct", tmp_path / "flight.csv", "--calibration", tmp_path / "cal.json", "-o", tmp_path / "c.csv"
    )
    assert (tmp_path / "c.csv").exists()


@pytest.mark.parametrize("more", [("--parameter", "throttle"), ("--method", "nominal")])
def test_auto_goes_with_nothing_else(more: tuple[str, ...], tmp_path: Path, command: Command) -> None:
    write(flight(), tmp_path / "flight.csv")
    given = ("calibrate", tmp_path / "flight.csv", "--parameter", "auto", *more, "-o", tmp_path / "cal.json")
    assert "--parameter auto" in command.refuses(*given, code=2)


def test_error_on_later_parts_is_known_with_and_without_a_parameter() -> None:
    """The choice compares the two; a column that does not move the field does not lower it."""
    log = flight()
    without, useful, useless = (
        fit(observations(log, names)).details["forward_nT"]
        for names in ((), ("battery_current",), ("servo1",))
    )
    assert useful < 0.8 * without
    assert useless > 0.95 * without


# ---- a column that moves the field and was not declared is named; one that does not is not -----------------


@pytest.mark.parametrize("seed", [2, 5])
@pytest.mark.parametrize("declared", [("battpos",), ("battpos", "ballast")])
def test_a_mass_that_was_left_out_is_named(declared: tuple[str, ...], seed: int) -> None:
    """Also one that nearly always moves with the declared one, as a glider's ballast with its battery."""
    log = demo_log(seed)
    data = observations(log, declared)
    data = data.part(np.arange(len(data)) % 3 == 0)  # as much to see in a third of the time
    rows = np.searchsorted(log["time"].to_numpy(), data.time)
    noise = np.random.default_rng(2).normal(size=len(data))
    others = {name: log[name].to_numpy()[rows] for name in ("ballast", "sensor_temperature")}
    columns = {"noise": noise, "walk": np.cumsum(noise), "clock": data.time, **others}
    others = {name: column for name, column in columns.items() if name not in declared}
    output = undeclared(fit(data, "auto").calibration, data, others)
    if "ballast" in declared:
        assert not output
    else:
        (line,) = output
        assert line.startswith("column 'ballast' is not declared and moves the field, by about ")
        assert line.endswith("--parameter ballast")
