"""Test the predicted error of a mission, and the proposal of the next runs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from gliders import Gliders
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from magbridge import logs
from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.figure_of_merit import box_flight, figure_of_merit
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.scalar_fit import fit_scalar
from magbridge.calibration.fitting.uncertainty import Mission, expected_error
from magbridge.calibration.model import identity
from magbridge.calibration.planning.plan import (
    Limits,
    PlannedRun,
    evaluate_runs,
    expected_calibration,
    plan,
    settled,
    trim_of,
)
from magbridge.calibration.planning.survey_patterns import propose
from magbridge.calibration.scalar import ScalarSeries, correct_scalar
from magbridge.errors import CalibrationError
from sitl.mission import TABLE_1


def test_expected_error_is_what_comes(glider: Gliders) -> None:
    one = glider(1, 2)
    calibration = fit(one.runs).calibration
    expected = expected_error(calibration, Mission.from_observations(one.survey))
    total = correct(calibration, one.quiet, one.survey.parameters, one.survey.time).total
    assert np.sqrt(np.mean((total - one.survey.reference) ** 2)) < 3.0 * np.sqrt(np.mean(expected**2))


def test_planned_runs_beat_table_1(glider: Gliders) -> None:
    """Six planned runs, with the glider's trim and the paper's bank at most, against the ten of Table 1."""
    one = glider(2, 2)
    parameters = one.runs.ranges()
    before = expected_calibration(parameters, 52_000.0)
    mission = Mission.from_observations(one.survey)
    ned = one.runs.reference_ned[0]
    paper = evaluate_runs(
        before, mission, ned,
        [PlannedRun(pitch, 6.0, (battery, float(np.copysign(200.0, pitch))))
         for _, pitch, battery, _ in TABLE_1],
    )  # fmt: skip
    limits = Limits(roll=(-6.0, 6.0), pitch_at=trim_of(one.runs), flown=settled(one.runs, parameters))
    ours = plan(before, mission, ned, limits, runs=6)
    assert len(ours.runs) == 6
    assert ours.worst[-1] < 0.5 * paper.worst[-1]
    assert ours.rms[-1] < 0.5 * paper.rms[-1]
    assert all(run.pitch * run.parameters[1] > 0.0 for run in ours.runs), (
        "dives with the ballast in, climbs out"
    )
    assert all(-6.0 <= run.roll <= 6.0 and 14.0 <= abs(run.pitch) <= 30.0 for run in ours.runs)
    with pytest.raises(CalibrationError, match="within the vehicle's limits"):
        plan(before, mission, ned, replace(limits, pitch=(80.0, 85.0)), runs=1)


def test_an_extended_or_noiseless_calibration_is_not_planned_with() -> None:
    warm = ChannelEffect(cause="temperature_offset", channel="sensor_temperature")
    extended = replace(identity(), effects=(warm,), coefficients=np.zeros(12), covariance=np.eye(12))
    met = np.tile((20_000.0, 0.0, 45_000.0), (10, 1))
    with pytest.raises(CalibrationError, match="not one that diagnose extended"):
        plan(extended, Mission(met, np.empty((10, 0))), met[0], Limits(), runs=1)
    with pytest.raises(CalibrationError, match="needs the noise of a sample"):
        plan(identity(), Mission(met, np.empty((10, 0))), met[0], Limits(), runs=1)


def test_a_survey_is_proposed_that_comes_back_to_its_places_on_other_courses(glider: Gliders) -> None:
    """Criss-cross is better than lines, lines than a straight track, which reports the undetermined terms."""
    flown = glider(1, 2).survey
    ahead = 0.35 * (flown.time - flown.time[0])
    survey = replace(flown, place=np.stack([ahead, 0.0 * ahead, 0.0 * ahead], axis=1))
    before = expected_calibration(survey.ranges(), 52_000.0)
    found = {one.name: one for one in propose(before, survey, hours=6.0)}
    names = list(found)
    assert names[0].startswith("criss-cross")
    assert names[-1] == "straight ahead"
    assert found[names[0]].worst < 0.1 * found["straight ahead"].worst
    assert found["lines and ties"].rms < found["parallel lines"].rms
    assert "never crossed your own track" in found["straight ahead"].open[0]
    assert not found["criss-cross on all courses"].open
    assert propose(before, survey, hours=12.0)[0].rms < found[names[0]].rms


# ---- figure of merit and improvement ratio -----------------------------------------------------------------


RATE, LEG_S = 5.0, 90.0
AMPLITUDES = (10.0, 5.0, 5.0)


def box(first_heading: float = 20.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (n,), angles (n, 3) (roll, pitch, heading), and the swinging axis (n,), -1 for none."""
    n = int(4 * LEG_S * RATE)
    time = np.arange(n) / RATE
    within = time % LEG_S
    axis = np.where(within < 20.0, -1, np.minimum((within - 20.0) // 20.0, 3)).astype(int)
    axis[(within - 20.0) % 20.0 > 15.0] = -1
    axis[axis == 3] = -1
    angles = np.zeros((n, 3))
    for k, amplitude in enumerate(AMPLITUDES):
        angles[:, k] = np.where(axis == k, amplitude * np.sin(2 * np.pi * within / 5.0), 0.0)
    angles[:, 2] += first_heading + 90.0 * (time // LEG_S)
    return time, angles, axis


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_the_twelve_manoeuvres_and_their_sum(scale: float) -> None:
    """At the second scale, rounding leaves negative running means of a square."""
    time, angles, axis = box()
    angles[:, :2] *= scale
    found = box_flight(time, *angles.T)
    assert found is not None
    assert len(found.manoeuvres) == 12
    assert [one.axis for one in found.manoeuvres] == ["roll", "pitch", "yaw"] * 4
    swing = np.where(axis >= 0, np.sin(2 * np.pi * (time % LEG_S) / 5.0), 0.0)
    merit = figure_of_merit(found, 50_000.0 + 3.0 * swing, 50_000.0 + 0.1 * swing)
    assert merit["before_nT"] == pytest.approx(12 * 6.0, rel=0.15)
    assert merit["after_nT"] == pytest.approx(12 * 0.2, rel=0.15)
    assert merit["improvement_ratio"] == pytest.approx(30.0, rel=0.01)


def test_a_flight_without_manoeuvres_and_a_slow_log_do_not_count_as_a_box() -> None:
    time, angles, _ = box()
    assert box_flight(time, 0.1 * angles[:, 0], 0.1 * angles[:, 1], np.full(len(time), 20.0)) is None
    assert box_flight(time[::10], *angles[::10].T) is None


@pytest.mark.parametrize("seed", range(3))
def test_gusts_on_lines_of_four_headings_are_not_a_box(seed: int) -> None:
    """3 deg RMS of random attitude on every axis, with correlation times of the manoeuvres' periods."""
    time = np.arange(int(4 * 240.0 * RATE)) / RATE
    noise = np.random.default_rng(seed).normal(size=(len(time), 3))
    gust = gaussian_filter1d(noise, 0.8 * RATE, axis=0)
    gust *= 3.0 / gust.std(axis=0)
    gust[:, 2] += 90.0 * (time // 240.0)
    assert box_flight(time, *gust.T) is None
    flown, angles, _ = box()
    found = box_flight(flown, *(angles + 0.3 * gust[: len(angles)] * [1.0, 1.0, 0.0]).T)
    assert found is not None
    assert len(found.manoeuvres) >= 10


def flown_box(seed: int, noise: float, wander: float = 0.0) -> ScalarSeries:
    """Return a box flight with a permanent field of 374 nT, and `noise` (nT) of the scalar sensor."""
    random, earth = np.random.default_rng(seed), np.array([17_000.0, -3_500.0, 51_000.0])
    time, angles, _ = box()
    angles = angles + wander * np.sin(time[:, None] / np.array([13.0, 17.0, 31.0]))
    u = Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True).inv().apply(earth)
    scalar = np.linalg.norm(u + np.array([300.0, -200.0, 100.0]), axis=1) + random.normal(0, noise, len(u))
    known, nothing = np.full(len(u), np.linalg.norm(earth)), np.empty((len(u), 0))
    vector = u + random.normal(0, 1.0, u.shape)
    return ScalarSeries(time + 1.6e9, scalar, vector, known, nothing, np.full(len(u), np.nan))


def test_a_box_that_was_not_fitted_is_within_0_05_nt_of_a_fit_to_it() -> None:
    time, angles, _ = box()
    manoeuvres = box_flight(time, *angles.T)
    assert manoeuvres is not None
    one, two = (flown_box(seed, 0.02, wander=0.3) for seed in (1, 2))

    def merit(fitted: ScalarSeries, tested: ScalarSeries) -> float:
        after = correct_scalar(fit_scalar(fitted, (), map_known=True).sensor, tested).field
        before, after = tested.scalar - tested.reference, after - tested.reference
        return float(figure_of_merit(manoeuvres, before, after)["after_nT"])

    assert merit(one, two) - merit(two, two) < 0.05


def test_calibrate_prints_the_figure_of_merit(tmp_path: Path, command: Command) -> None:
    series, angles = flown_box(1, 0.05), box()[1]
    columns = {f"mag_{axis}": (series.vector[:, k], "nT") for k, axis in enumerate("xyz")}
    columns |= {name: (angles[:, k], "deg") for k, name in enumerate(("roll", "pitch", "heading"))}
    columns |= {"tail": (series.scalar, "nT"), "reference_field": (series.reference, "nT")}
    ds = xr.Dataset(
        {name: ("time", values, {"units": units}) for name, (values, units) in columns.items()},
        coords={"time": series.time},
    )
    log, cal = tmp_path / "box.nc", tmp_path / "cal.json"
    logs.write(ds, log)
    said = command("calibrate", log, "--scalar", "tail", "-o", cal, "--force").out
    assert "figure of merit" in said
    assert "over 12 manoeuvres" in said
    merit = json.loads(command("calibrate", log, "--scalar", "tail", "-o", cal, "--force", "--json").out)
    merit = merit["scalar"]["figure_of_merit"]
    assert merit["fitted"] is True
    assert len(merit["peak_to_peak"]) == 12
    assert merit["after_nT"] < 3.0 < 30.0 < merit["before_nT"]
    assert merit["improvement_ratio"] > 10.0
