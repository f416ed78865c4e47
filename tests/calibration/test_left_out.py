"""Parts left out: which they are, what a fit without them predicts, and which fit they prefer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gliders import Gliders
from measured import hold_runs_out
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.logs import read

FIELD = np.array([21_000.0, 2_000.0, 42_000.0])
BOOTS = np.repeat([0, 1, 2], [400, 100, 100])


def copter(seed: int, n: int = 600, size: float = 800.0, memory: float = 0.97) -> Observations:
    """All headings, tilted by 12 deg; disturbed for long, and three times as much in the first third."""
    rng = np.random.default_rng(seed)
    angles = np.column_stack([lfilter([0.2], [1.0, -0.98], rng.normal(size=n)) * 3.0 for _ in range(2)])
    heading = np.cumsum(rng.normal(0.0, 6.0, n)) + np.linspace(0.0, 1500.0, n)
    turned = Rotation.from_euler("ZYX", np.column_stack([heading, 12.0 * np.tanh(angles)]), degrees=True)
    field = turned.inv().apply(FIELD) @ (np.eye(3) + rng.normal(0.0, 0.005, (3, 3)))
    lasting = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], rng.normal(0.0, size, (n, 3)), axis=0)
    lasting[: n // 3] = 3.0 * lasting[: n // 3] + rng.normal(0.0, 3.0 * size, 3)
    return Observations(
        field + rng.normal(0.0, 500.0, 3) + lasting,
        np.full(n, np.linalg.norm(FIELD)),
        np.empty((n, 0)),
        time=np.arange(n, dtype=float) * 0.1,
    )


def test_auto_is_better_than_one_ellipsoid_where_the_first_part_differs() -> None:
    """Fitted to the first half, tested on the second, of six logs."""
    squares = {"nominal": 0.0, "auto": 0.0}
    for seed in range(6):
        data = copter(seed, 1200)
        late = data.part(data.time >= 60.0)
        first = data.part(data.time < 60.0)
        first = Observations(first.field, first.reference, first.parameters, runs=BOOTS, time=first.time)
        for method in squares:
            error, _ = in_sensor_units(fit(first, method).calibration, late)
            squares[method] += float(np.mean(error**2))
    assert squares["auto"] < 0.87**2 * squares["nominal"]


def smoothed(window: int, roll: float = 0.0, pitch: float = 20.0, n: int = 7200) -> Observations:
    """Circles of 150 s, ten minutes up and ten down; a reading is the mean of so many seconds."""
    rng, second = np.random.default_rng(7), np.arange(n)
    dive = lfilter([0.08], [1.0, -0.92], np.where(second // 600 % 2, pitch, -pitch))
    roll_s, pitch_s = (lfilter([0.06], [1.0, -0.94], rng.normal(0.0, size, n)) for size in (8.0, 2.0))
    angles = np.column_stack([2.4 * second, dive + pitch_s, roll + roll_s])
    field = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(FIELD)
    field = field @ (np.eye(3) + 0.01 * np.diag([1.0, -0.5, 0.3])) + np.array([900.0, -400.0, 300.0])
    field = np.column_stack([np.convolve(axis, np.full(window, 1.0 / window), "same") for axis in field.T])
    rows = second[(second > 60) & (second < n - 60)][::4]
    return Observations(
        field[rows] + rng.normal(0.0, 1.0, (len(rows), 3)),
        np.full(len(rows), np.linalg.norm(FIELD)),
        np.empty((len(rows), 0)),
        time=rows.astype(float),
    )


def test_a_smoothed_field_is_as_unsure_as_it_is_wrong_in_attitudes_not_seen() -> None:
    """Groups of similar attitude that are held out show a missing term; runs alone give too small a sigma."""
    found = fit(smoothed(12))
    assert found.details["left_out_ratio"] > 1.5
    for roll, pitch in ((0.0, 20.0), (25.0, 20.0), (0.0, 55.0)):
        other = smoothed(12, roll, pitch, 2400)
        _, standardised = in_sensor_units(found.calibration, other.part(other.time % 600.0 > 90.0))
        assert np.sqrt(np.mean(standardised**2)) < 1.15
    clean = fit(smoothed(1))
    assert clean.details["left_out_ratio"] == 1.0
    for roll, pitch in ((0.0, 20.0), (25.0, 20.0)):
        _, standardised = in_sensor_units(clean.calibration, smoothed(1, roll, pitch, 2400))
        assert 0.6 < np.sqrt(np.mean(standardised**2)) < 1.3


# ---- runs held out of a fit one at a time, simulated and of a Seaglider's own magnetometer -----------------


COUNT_NT = 100.0
"""A step of the Seaglider's magnetometer."""


@pytest.mark.real
def test_seaglider_dives_held_out(real_data: Path) -> None:
    """The nominal fit is at the sensor's quantisation; moving masses take a few per cent of it."""
    dives = sorted((real_data / "seaglider_sg167").glob("*.nc"))[:3]
    deployment = read(dives).isel(time=slice(None, None, 2))
    nominal, _ = hold_runs_out(observations(deployment, []), "nominal")
    moving, normalised = hold_runs_out(observations(deployment, ["vbdCC"]), "auto", 2)
    nominal, moving = (error[np.isfinite(error)] for error in (nominal, moving))
    assert rms(nominal) / COUNT_NT == pytest.approx(1.0, abs=0.03)
    assert 0.85 < rms(moving) / rms(nominal) < 1.02
    # each sigma includes the bias of the IGRF: 145 nT, in addition to 88
    assert 0.4 < np.nanstd(normalised) < 1.0


def test_two_runs_at_least(glider: Gliders) -> None:
    runs = glider(0, 2).runs
    with pytest.raises(CalibrationError, match="expected 2 runs"):
        hold_runs_out(runs.part(np.asarray(runs.runs) == 0), "nominal")


def test_held_out_runs_are_near_the_floor(glider: Gliders) -> None:
    """Holding out inner runs (the outermost would be extrapolation) costs a little; sigma includes it."""
    runs = glider(0, 1).runs
    few = runs.part(np.asarray(runs.runs) < 4)
    error, normalised = hold_runs_out(few, "auto", 1)
    assert np.isfinite(error[np.asarray(few.runs) < 4]).all()
    assert np.nanmedian(np.abs(normalised)) < 1.5
