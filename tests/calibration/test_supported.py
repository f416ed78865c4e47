"""Fits that the data do not support are not written, and a method without a solution is replaced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import Command
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import METHODS, fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.solve import check_scales
from magbridge.errors import CalibrationError, NoSolutionError
from magbridge.estimation.residual import ResidualSamples
from magbridge.field.reference import other_units
from magbridge.logs import write
from magbridge.logs.deployment import deployment

EARTH = np.array([21_000.0, 1_500.0, 43_000.0])
FIELD = float(np.linalg.norm(EARTH))


def readings(tilt: float, noise: float, n: int = 400) -> FloatArray:
    """Return an ideal compass (n, 3), nT, on all headings with a standard deviation of `tilt` deg."""
    rng = np.random.default_rng(4)
    angles = np.column_stack([rng.uniform(0.0, 360.0, n), rng.normal(0.0, tilt, (n, 2))])
    turned = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(EARTH)
    return np.asarray(turned + rng.normal(0.0, noise, (n, 3)))


def log(field: FloatArray) -> xr.Dataset:
    """Return a log of readings (n, 3), nT, whose true field is known."""
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", field.T, strict=True)}
    columns["reference_field"] = np.full(len(field), FIELD)
    return deployment("turns.csv", 1.6e9 + np.arange(float(len(field))), columns)


def test_noise_that_passes_for_attitudes_is_not_supported() -> None:
    coarse = fit(Observations(readings(3.0, 1500.0), np.full(400, FIELD), np.empty((400, 0))))
    assert not coarse.supported
    assert "noise passes for attitudes" in coarse.warnings[0].text
    fine = fit(Observations(readings(20.0, 50.0), np.full(400, FIELD), np.empty((400, 0))))
    assert fine.supported


def test_a_fit_without_support_is_written_by_force_only(here: Path, command: Command) -> None:
    write(log(readings(3.0, 1500.0)), "turns.csv")
    asked = "calibrate", "turns.csv", "-o", "cal.json"
    assert "cal.json: not written, because the data do not support this fit" in command.refuses(*asked)
    assert not (here / "cal.json").exists()
    command(*asked, "--force")
    assert (here / "cal.json").exists()


@pytest.mark.parametrize(("asked", "other"), [("auto", "nominal"), ("nominal", "auto")])
def test_a_method_without_a_solution_is_replaced(
    asked: str, other: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, asked, f"{__name__}:no_solution")
    data = Observations(readings(20.0, 50.0), np.full(400, FIELD), np.arange(400.0)[:, None])
    found = fit(data, asked)
    assert found.calibration.method == other
    assert not found.calibration.parameters
    assert any(f"method {asked} has no solution" in warning.text for warning in found.warnings)
    monkeypatch.setitem(METHODS, other, f"{__name__}:no_solution")
    with pytest.raises(NoSolutionError, match="the fit collapsed"):
        fit(data, asked)


def no_solution(*_: Any, **__: Any) -> None:
    raise NoSolutionError("the fit collapsed")


def test_a_hard_iron_of_many_times_the_field_is_not_another_unit() -> None:
    field = readings(60.0, 50.0)
    far = np.array([11.0, -2.0, 3.0]) * FIELD
    assert not other_units(field + far, FIELD)
    assert "expected nT" in other_units(1000.0 * (field + far), FIELD)
    found = fit(Observations(field + far, np.full(400, FIELD), np.empty((400, 0))))
    np.testing.assert_allclose(found.calibration.coefficients[6:9], far, atol=30.0)


# ---- hard iron beyond twice the field ----------------------------------------------------------------------


def samples(directions: np.ndarray, offset: float) -> ResidualSamples:
    field = 5e4 * directions + np.array([0.0, 0.0, offset])
    reference = np.full(len(field), 5e4)
    return ResidualSamples(field, reference, np.ones((len(field), 1)), np.ones(len(field)), 5e4)


def test_it_is_the_attitudes_that_decide() -> None:
    rng = np.random.default_rng(0)
    around = rng.normal(size=(800, 3))
    around /= np.linalg.norm(around, axis=1)[:, None]
    turn = rng.uniform(0.0, 2.0 * np.pi, 800)
    level = np.column_stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), np.full(800, np.sqrt(0.75))])
    fit = np.zeros(9)
    fit[8] = 1.1e5
    check_scales(samples(around, 1.1e5), fit)
    with pytest.raises(CalibrationError, match="too few attitudes"):
        check_scales(samples(level, 1.1e5), fit)
