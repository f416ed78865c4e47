"""Does a planned calibration beat the paper's Table 1 at the same flight time? Random gliders fly both.

One plan for all, made before the first flight from the physical widths alone: ten spirals as long as the
table's, masses and pitch within the table's own ends, trimmed as the vehicle trims itself, banked as the
paper's at most. Each glider is then calibrated by `auto` on either, and flies the same survey. Printed: the
error that was expected over the mission, and the survey's actual RMS over the noise floor.

    python tools/plan.py --seeds 12
"""

from __future__ import annotations

import dataclasses

import numpy as np
import xarray as xr
from accuracy import total
from bound import oracle
from msgspec.structs import replace
from rich.console import Console
from rich.progress import track
from terminal import command_line, table

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.mission import Mission
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.planning.limits import Limits, PlannedRun, settled, trim_of
from magbridge.calibration.planning.plan import Plan, evaluate_runs, expected_calibration, plan
from magbridge.calibration.residual import rms
from magbridge.field.reference import main_field
from sitl import Twin, load, segments, simulate
from sitl.dataset import at_rest, corrected
from sitl.mission import TABLE_1, Run, Spirals
from sitl.platform import Vehicle
from sitl.scenario import Scenario

MASSES = ("battpos", "ballast")
BANK = 6.0
"""deg either way, as the paper's spirals had it on one side."""


def chosen(scenario: Scenario, noise: float) -> tuple[Plan, Plan]:
    """Return Table 1 and as many runs of a plan, with the error expected after either."""
    parts = segments(simulate(scenario, 0))
    runs, survey = (observed(parts[name]) for name in ("calibration", "survey"))
    before = expected_calibration(runs.ranges(), float(runs.reference.mean()), noise=noise)
    mission, ned = Mission.of(survey), main_field(parts["calibration"])[0]
    table_1 = [
        PlannedRun(pitch, BANK, (battery, float(np.copysign(200.0, pitch))))
        for _, pitch, battery, _ in TABLE_1
    ]
    limits = Limits(roll=(-BANK, BANK), pitch_at=trim_of(runs), flown=settled(runs, runs.ranges()))
    return evaluate_runs(before, mission, ned, table_1), plan(before, mission, ned, limits, runs=len(table_1))


def observed(part: xr.Dataset) -> Observations:
    """Return a part of a deployment with its true field's vector."""
    found = observations(at_rest(part, MASSES), MASSES)
    return dataclasses.replace(found, reference_ned=np.tile(main_field(part)[0], (len(found), 1)))


def flown(scenario: Scenario, seed: int) -> float:
    """Calibrate a glider on the scenario's runs; return the survey's RMS error over its noise floor."""
    vehicle = Twin.draw(scenario, seed).vehicle
    assert isinstance(vehicle, Vehicle)
    parts = {name: at_rest(part, MASSES) for name, part in segments(simulate(scenario, seed)).items()}
    found = fit(observations(parts["calibration"], MASSES)).calibration
    survey = parts["survey"]
    return rms(corrected(survey, found).total - total(survey)) / rms(oracle(vehicle, survey) - total(survey))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--seeds", type=int, default=12, help="gliders")
    parser.add_argument("--noise", type=float, default=1.0, help="nT, white")
    given = parser.parse_args()
    console = Console(width=130)
    scenario = load("random_glider").replace(instrument={"noise_sigma": given.noise})
    paper, ours = chosen(scenario, given.noise)
    show_runs(ours, console)
    spirals = tuple(
        Run(pitch=run.pitch, roll=run.roll, parameters=dict(zip(MASSES, run.parameters, strict=True)))
        for run in ours.runs
    )
    mission = (replace(one, runs=spirals) if isinstance(one, Spirals) else one for one in scenario.mission)
    planned = scenario.replace(mission=tuple(mission))
    seeds = range(given.seeds)
    ratios = {
        name: np.array([flown(how, seed) for seed in track(seeds, name, console=Console(stderr=True))])
        for name, how in (("Table 1", scenario), ("planned", planned))
    }
    shown = table(
        f"{given.seeds} gliders, noise {given.noise:g} nT, ten spirals of 15 minutes",
        "", "expected nT: RMS", "worst", "survey over the floor: median", "95 %", "worst", "better on",
    )  # fmt: skip
    for (name, ratio), expected in zip(ratios.items(), (paper, ours), strict=True):
        shown.add_row(
            name,
            f"{expected.rms[-1]:.2f}",
            f"{expected.worst[-1]:.2f}",
            *(f"{value:.3f}" for value in (*np.quantile(ratio, [0.5, 0.95]), ratio.max())),
            f"{(ratio < ratios['Table 1' if name == 'planned' else 'planned']).sum()} of {given.seeds}",
        )
    console.print(shown)


def show_runs(found: Plan, console: Console) -> None:
    """Print the plan."""
    headings = ("run", "pitch deg", "bank deg", "battery in", "ballast cm³", "expected nT: RMS", "worst")
    shown = table("The plan", *headings)
    for number, run in enumerate(found.runs, 1):
        values = (run.pitch, run.roll, *run.parameters, found.rms[number], found.worst[number])
        shown.add_row(str(number), *(f"{value:.2f}" for value in values))
    console.print(shown)


if __name__ == "__main__":
    main()
