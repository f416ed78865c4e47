"""Test options of a fit: known iron, a free mean, a range of support."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import Command
from gliders import Gliders
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.file import load
from magbridge.calibration.fitting.fit import METHODS, fit
from magbridge.calibration.fitting.observations import Observations, monomials
from magbridge.calibration.fitting.pose import Known, rescaling
from magbridge.calibration.model import Calibration, Parameter
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.errors import CalibrationError, FormatError, NoSolutionError
from magbridge.estimation.residual import rms
from magbridge.field.reference import about_mean, other_units
from magbridge.logs import read, write
from magbridge.logs.deployment import deployment


def test_rescaled_coefficients_are_the_same_field() -> None:
    rng = np.random.default_rng(0)
    exponents = full_order(2, 3)
    old = Parameter("a", "in", -1.0, 1.0, 0.1, 0.9), Parameter("b", "cm3", -200.0, 200.0, 5.0, 210.0)
    new = Parameter("a", "in", -2.0, 1.0, -0.5, 1.5), Parameter("b", "cm3", -50.0, 200.0, 75.0, 125.0)
    c = rng.normal(size=9 * len(exponents))
    changed = rescaling(exponents, old, new, 48_000.0, 51_000.0) @ c
    positions = np.column_stack([rng.uniform(-1, 1, 20), rng.uniform(-200, 200, 20)])
    before = monomials(positions, old, exponents) @ c.reshape(-1, 9)
    after = monomials(positions, new, exponents) @ changed.reshape(-1, 9)
    np.testing.assert_allclose(after[:, 6:], before[:, 6:], atol=1e-9)
    np.testing.assert_allclose(after[:, :6] / 51_000.0, before[:, :6] / 48_000.0, atol=1e-12)


def test_two_runs_are_enough_for_a_vehicle_that_is_known(glider: Gliders) -> None:
    one = glider(0)
    whole = fit(one.runs).calibration
    term = whole.terms[0]
    assert isinstance(term, Polynomial)
    covariance = whole.covariance + 1e-2 * np.eye(len(whole.coefficients))
    known = Known(whole.parameters, term.exponents, whole.reference.field, whole.coefficients, covariance)
    two = one.runs.part(np.isin(one.runs.runs, np.unique(one.runs.runs)[:2]))
    truth = one.survey.reference

    def error(calibrated: Calibration) -> float:
        found = correct(calibrated, one.survey.field, one.survey.parameters, one.survey.time)
        return rms(found.total - truth)

    least = error(whole)
    assert error(fit(two, known=known).calibration) < 1.1 * least
    assert error(fit(two).calibration) > 5.0 * least


def test_coefficients_of_other_masses_are_refused(glider: Gliders) -> None:
    runs = glider(0).runs
    part = runs.part(np.arange(len(runs)) % 4 == 0)
    parameters = (Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0),)
    known = Known(parameters, full_order(1, 1), 5e4, np.zeros(18), np.eye(18))
    with pytest.raises(CalibrationError, match=r"for battpos \[in\], and the log has battpos \[in\], ballas"):
        fit(part, known=known)
    with pytest.raises(CalibrationError, match="no use where the coefficients are known"):
        fit(part, known=known, vehicle={"battpos": {"at": (1, 0, 0), "travel": (0.1, 0, 0)}})


# ---- A log without date and position is fitted about the mean of its own readings, and this is reported ----


EARTH = np.array([20_000.0, 2_000.0, 44_000.0])
IRON = np.array([900.0, -2_000.0, 400.0])


def turned(spread: float = 1.0) -> xr.Dataset:
    rng = np.random.default_rng(6)
    body = Rotation.from_rotvec(spread * rng.normal(size=(400, 3))).apply(EARTH) + IRON
    body += rng.normal(0.0, 20.0, body.shape)
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", body.T, strict=True)}
    return deployment("turns.csv", 10.0 + 0.1 * np.arange(400), columns, attrs={"time_reference": "boot"})


def test_one_attitude_has_no_mean() -> None:
    with pytest.raises(FormatError, match=r"turns\.csv: expected a field of the Earth's size, not a sphere "):
        about_mean(turned(spread=1e-4))


def test_calibrate_about_a_mean(here: Path, command: Command) -> None:
    asked = "calibrate", "turns.csv", "-o", "cal.json"
    write(turned(), "turns.csv")
    assert "--reference mean" in command.refuses(*asked)
    output = command(*asked, "--reference", "mean")
    assert "turns.csv: the Earth's field is unknown; the reference is the mean reading" in output.err
    found = load(here / "cal.json")
    assert found.coefficients[6:9] == pytest.approx(IRON, abs=10.0)
    command("correct", "turns.csv", "--calibration", "cal.json", "-o", "corrected.csv")
    level = read("corrected.csv")["level_sigma"]
    assert float(level.median()) == pytest.approx(0.02 * np.linalg.norm(EARTH), rel=0.1)
    known = turned().assign(reference_field=("time", np.full(400, 5e4), {"units": "nT"}))
    write(known, "known.csv")
    assert "has positions or reference_field; leave" in command.refuses(
        "calibrate", "known.csv", *asked[2:], "--reference", "mean", code=2
    )


# ---- Fits that the data do not support are not written, and a method without a solution is replaced ------


EARTH_NED = np.array([21_000.0, 1_500.0, 43_000.0])
FIELD = float(np.linalg.norm(EARTH_NED))


def readings(tilt: float, noise: float, n: int = 400) -> FloatArray:
    """Return an ideal compass (n, 3), nT, on all headings with a standard deviation of `tilt` deg."""
    rng = np.random.default_rng(4)
    angles = np.column_stack([rng.uniform(0.0, 360.0, n), rng.normal(0.0, tilt, (n, 2))])
    turned = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(EARTH_NED)
    return np.asarray(turned + rng.normal(0.0, noise, (n, 3)))


def log(field: FloatArray) -> xr.Dataset:
    """Return a log of readings (n, 3), nT, whose true field is known."""
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", field.T, strict=True)}
    columns["reference_field"] = np.full(len(field), FIELD)
    return deployment("turns.csv", 1.6e9 + np.arange(float(len(field))), columns)


def test_a_fit_without_support_is_written_by_force_only(here: Path, command: Command) -> None:
    write(log(readings(3.0, 1500.0)), "turns.csv")
    asked = "calibrate", "turns.csv", "-o", "cal.json"
    assert "cal.json: not written, because the data do not support this fit" in command.refuses(*asked)
    assert not (here / "cal.json").exists()
    command(*asked, "--force")
    assert (here / "cal.json").exists()


@pytest.mark.parametrize("gain", [0.6, 0.8, 1.0, 1.25])
def test_a_gain_is_found_where_the_attitudes_show_it_and_else_refused(gain: float) -> None:
    """Else the prior of a usual gain decides, and the fit takes the rest of the field for an offset."""
    fields = (gain * readings(tilt, 100.0) + IRON for tilt in (40.0, 3.5))
    seen = (Observations(field, np.full(400, FIELD), np.empty((400, 0))) for field in fields)
    wide, narrow = (fit(data, "nominal") for data in seen)
    assert np.allclose(wide.scales, 1.0 / gain, rtol=0.01)
    assert wide.supported
    assert narrow.supported == (gain == 1.0)
    doubtful = "separate it from the offset" in " ".join(narrow.calibration.warnings)
    assert doubtful == (gain != 1.0)


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
