"""The error expected on a mission, and the runs to fly next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gliders import Gliders

from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.fitting.fit import fit
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
from magbridge.errors import CalibrationError
from sitl.mission import TABLE_1


def test_expected_error_is_what_comes(glider: Gliders) -> None:
    one = glider(1, 2)
    calibration = fit(one.runs).calibration
    expected = expected_error(calibration, Mission.from_observations(one.survey))
    total = correct(calibration, one.quiet, one.survey.parameters, one.survey.time).total
    assert np.sqrt(np.mean((total - one.survey.reference) ** 2)) < 3.0 * np.sqrt(np.mean(expected**2))


def test_planned_runs_beat_table_1(glider: Gliders) -> None:
    """Six against ten, trimmed as the glider trims itself, banked no more than the paper's spirals."""
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
