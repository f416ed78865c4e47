"""A log without date and position is fitted about the mean of its own readings, and this is reported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from scipy.spatial.transform import Rotation

from magbridge.calibration.file import load
from magbridge.errors import FormatError
from magbridge.field.reference import about_mean
from magbridge.logs import read, write
from magbridge.logs.deployment import deployment

EARTH = np.array([20_000.0, 2_000.0, 44_000.0])
IRON = np.array([900.0, -2_000.0, 400.0])


def turned(gain: float = 1.0, spread: float = 1.0) -> xr.Dataset:
    rng = np.random.default_rng(6)
    body = Rotation.from_rotvec(spread * rng.normal(size=(400, 3))).apply(gain * EARTH) + IRON
    body += rng.normal(0.0, 20.0, body.shape)
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", body.T, strict=True)}
    return deployment("turns.csv", 10.0 + 0.1 * np.arange(400), columns, attrs={"time_reference": "boot"})


@pytest.mark.parametrize("gain", [0.8, 1.0])
def test_the_mean_is_without_the_hard_iron_and_in_the_sensors_scale(gain: float) -> None:
    known = about_mean(turned(gain))["reference_field"]
    np.testing.assert_allclose(known, gain * np.linalg.norm(EARTH), rtol=1e-3)


def test_one_attitude_has_no_mean() -> None:
    with pytest.raises(
        FormatError, match=r"turns\.csv: expected a field of the Earth's size, not a sphere of"
    ):
        about_mean(turned(spread=1e-4))


def test_calibrate_about_a_mean(here: Path, command: Command) -> None:
    asked = "calibrate", "turns.csv", "-o", "cal.json"
    write(turned(), "turns.csv")
    assert "--reference mean" in command.refuses(*asked)
    output = command(*asked, "--reference", "mean")
    assert "turns.csv: the Earth's field is not known; the reference is the mean reading" in output.err
    found = load(here / "cal.json")
    assert found.coefficients[6:9] == pytest.approx(IRON, abs=10.0)
    command("correct", "turns.csv", "--calibration", "cal.json", "-o", "corrected.csv")
    level = read("corrected.csv")["level_sigma"]
    assert float(level.median()) == pytest.approx(0.02 * np.linalg.norm(EARTH), rel=0.1)
    known = turned().assign(reference_field=("time", np.full(400, 5e4), {"units": "nT"}))
    write(known, "known.csv")
    assert "has positions or reference_field already" in command.refuses(
        "calibrate", "known.csv", *asked[2:], "--reference", "mean", code=2
    )
