"""Compare planned calibration runs with the paper's Table 1 at the same flight time, on random gliders.

All gliders get one plan, which is computed from the prior before any data exist. It has ten spirals as long
as the table's, with masses and pitch within the table's ranges, the vehicle's trim and at most the paper's
bank. Each glider is calibrated by `auto` on both sets of runs, and surveys the same track.

    python tools/plan.py --seeds 12
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import xarray as xr
from msgspec.structs import replace
from studies import Column, Row, Study
from study_worlds import MASSES, SCORES, glider

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.uncertainty import Mission
from magbridge.calibration.planning.plan import (
    Limits,
    PlannedRun,
    evaluate_runs,
    expected_calibration,
    plan,
    settled,
    trim_of,
)
from magbridge.field.reference import main_field
from sitl import load, segments, simulate
from sitl.dataset import at_rest
from sitl.mission import TABLE_1, Run, Spirals

BANK_DEG = 6.0
"""Maximum bank to either side, deg; the paper's spirals have this bank to one side."""


@cache
def plans() -> dict[str, tuple[list[PlannedRun], float]]:
    """Return the runs of Table 1 and of the plan by name, each with its predicted RMS error, nT."""
    parts = segments(simulate(load("random_glider"), 0))
    runs, survey = (observed(parts[name]) for name in ("calibration", "survey"))
    before = expected_calibration(runs.ranges(), float(runs.reference.mean()), noise=1.0)
    mission, ned = Mission.from_observations(survey), main_field(parts["calibration"])[0]
    paper = [
        PlannedRun(pitch, BANK_DEG, (battery, float(np.copysign(200.0, pitch))))
        for _, pitch, battery, _ in TABLE_1
    ]
    limits = Limits(roll=(-BANK_DEG, BANK_DEG), pitch_at=trim_of(runs), flown=settled(runs, runs.ranges()))
    found = plan(before, mission, ned, limits, runs=len(paper))
    expected = evaluate_runs(before, mission, ned, paper).rms[-1]
    return {"Table 1": (paper, float(expected)), "planned": (list(found.runs), float(found.rms[-1]))}


def observed(part: xr.Dataset) -> Observations:
    """Return the samples of a part of a deployment at rest, with the true field vector as reference."""
    found = observations(at_rest(part, MASSES), MASSES)
    return dataclasses.replace(found, reference_ned=np.tile(main_field(part)[0], (len(found), 1)))


def run(name: str, seed: int) -> list[Row]:
    """Calibrate a glider on runs and score the calibration on its survey; return the row."""
    scenario, (runs, expected) = load("random_glider"), plans()[name]
    if name == "planned":
        spirals = tuple(
            Run(pitch=one.pitch, roll=one.roll, parameters=dict(zip(MASSES, one.parameters, strict=True)))
            for one in runs
        )
        mission = (
            replace(one, runs=spirals) if isinstance(one, Spirals) else one for one in scenario.mission
        )
        scenario = scenario.replace(mission=tuple(mission))
    flown = glider(scenario, seed)
    found = fit(observations(flown.runs, MASSES)).calibration
    return [{"expected": expected} | flown.score(found)]


STUDY = Study(run, ("name",), {"expected, nT": Column("expected")} | SCORES)


if __name__ == "__main__":
    STUDY.main(__doc__, names=["Table 1", "planned"], seeds=12)
