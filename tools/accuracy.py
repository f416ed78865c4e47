"""Measure each calibration out of sample, over random simulated gliders, and compare it with its bound.

Each glider has random dipoles. It is calibrated by the runs of the paper's Table 1, and surveys on another
day with other roll and pitch. The table has for each method the survey's RMS error over its noise floor (the
error of a calibration that knows the vehicle): median, 95th percentile and maximum of the gliders. Next to
it is the standard deviation of the normalised error. The oracle knows that masses are dipoles, the lines of
their travel, and the distribution of moments, volumes and iron. "Bound" is the average error of its fits
(Cramér-Rao, with this prior). "Planned runs" replace the table's ten spirals by as many of the same length.

    python tools/accuracy.py --seeds 40 --out accuracy.parquet
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import xarray as xr
from msgspec.structs import replace
from scipy.optimize import least_squares
from studies import Column, Row, Study, consistent
from study_worlds import METHODS, NOISES, SCORES, Glider, best_fit, glider, true_field

from magbridge import fit, observations
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import Mission
from magbridge.calibration.planning.plan import (
    Limits,
    PlannedRun,
    expected_calibration,
    plan,
    settled,
    trim_of,
)
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.field.reference import main_field
from sitl import load, segments, simulate
from sitl.dataset import at_rest, channels
from sitl.mission import TABLE_1, Run, Spirals

MASSES = {1: ("battpos",), 2: ("battpos", "ballast"), 3: ("battpos", "ballast", "rollpos")}
TAPE_SIGMA_M = 0.05
"""Standard deviation of the masses' positions measured with a tape, m on an axis."""
TAPE = "auto, positions to 5 cm"
PLANNED_NOISE_NT = 1.0
"""Noise of a channel for which runs are planned, nT."""
BANK_DEG = 6.0
"""Maximum bank of planned runs to either side, deg; the paper's spirals have this bank to one side."""


def run(
    masses: int, noise: str, seed: int, methods: tuple[str, ...] = (*METHODS, TAPE), oracles: bool = True
) -> Iterator[Row]:
    """Simulate a glider with some moving masses, calibrate by every method, and score on the survey."""
    sigma, memory = NOISES[noise]
    names = MASSES[masses]
    instrument = {"noise_sigma": sigma, "noise_memory": memory}
    flown = glider(load("random_glider").replace(masses=names, instrument=instrument), seed, names)
    scores: dict[str, dict[str, Any]] = {method: calibrate(method, flown, names, seed) for method in methods}
    for at_sigma, name in ((0.5, "oracle"), (TAPE_SIGMA_M, "oracle, positions to 5 cm")) if oracles else ():
        best = best_fit(flown.vehicle, flown.runs, flown.survey, sigma, memory, at_sigma)
        scores[f"{name}: bound"] = {"ratio": rms(best.bound) / rms(best.floor)}
    if oracles:
        A, T = ellipsoid(flown.runs)
        scores["scipy ellipsoid"] = {"ratio": rms(remainder(A, T, flown.survey)) / flown.floor}
        if masses == 2 and sigma == PLANNED_NOISE_NT:
            scores["auto, planned runs"] = planned(seed)
    yield from ({"method": method} | score for method, score in scores.items())


def calibrate(method: str, flown: Glider, names: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return the score of a method on a glider's survey, or the reason of its failure under ``failed``."""
    used = () if method == "nominal" else names
    options = {"vehicle": tape(flown, seed)} if method == TAPE else METHODS.get(method, {})
    try:
        fitted = fit(observations(flown.runs, used), method.partition(",")[0], **options)
    except CalibrationError as error:
        return {"failed": str(error)}
    return flown.score(fitted.calibration)


def tape(flown: Glider, seed: int) -> dict[str, dict[str, object]]:
    """Return the tables of a ``vehicle.toml`` with the masses' positions, m, and errors of a measurement."""
    rng = np.random.default_rng([seed, 99])
    return {
        name: {
            "at": (np.array(mass.at) + rng.normal(0, TAPE_SIGMA_M, 3)).tolist(),
            "at_sigma": TAPE_SIGMA_M,
            "travel": list(mass.travel),
        }
        for name, mass in flown.vehicle.mass.items()
    }


def planned(seed: int) -> dict[str, float]:
    """Return the score of `auto` on a glider that performs the planned runs."""
    chosen = [(one, dict(zip(MASSES[2], one.parameters, strict=True))) for one in planned_runs()]
    runs = tuple(Run(pitch=one.pitch, roll=one.roll, parameters=masses) for one, masses in chosen)
    scenario = load("random_glider").replace(instrument={"noise_sigma": PLANNED_NOISE_NT})
    mission = (replace(one, runs=runs) if isinstance(one, Spirals) else one for one in scenario.mission)
    flown = glider(scenario.replace(mission=tuple(mission)), seed)
    return flown.score(fit(observations(flown.runs, MASSES[2])).calibration)


@cache
def planned_runs() -> tuple[PlannedRun, ...]:
    """Return as many runs as in Table 1, with its bank and trim, chosen before any data exist."""
    parts = segments(simulate(load("random_glider"), 0))
    runs, survey = (observed(parts[name]) for name in ("calibration", "survey"))
    field = float(runs.reference.mean())
    before = expected_calibration(runs.ranges(), field, noise=PLANNED_NOISE_NT)
    mission, ned = Mission.from_observations(survey), main_field(parts["calibration"])[0]
    limits = Limits(roll=(-BANK_DEG, BANK_DEG), pitch_at=trim_of(runs), flown=settled(runs, runs.ranges()))
    return tuple(plan(before, mission, ned, limits, runs=len(TABLE_1)).runs)


def observed(part: xr.Dataset) -> Observations:
    """Return the samples of a part of a deployment at rest, with the true field vector as reference."""
    found = observations(at_rest(part, MASSES[2]), MASSES[2])
    return dataclasses.replace(found, reference_ned=np.tile(main_field(part)[0], (len(found), 1)))


def ellipsoid(runs: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Fit an ellipsoid with nine parameters by scipy, from a unit matrix; return A (3, 3) and T (3,), nT."""
    upper = np.triu_indices(3)
    size = float(np.mean(true_field(runs)))

    def unpack(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.zeros((3, 3))
        A[upper] = x[:6]
        return A + np.triu(A, 1).T, size * x[6:]

    start = np.concatenate([np.eye(3)[upper], np.zeros(3)])
    options = {"method": "lm", "xtol": 1e-12, "ftol": 1e-12}
    found = least_squares(lambda x: remainder(*unpack(x), runs) / size, start, **options)
    return unpack(found.x)


def remainder(A: np.ndarray, T: np.ndarray, part: xr.Dataset) -> np.ndarray:
    """Return the error (n,) of the total field ``|A (raw - T)|``, nT."""
    return np.asarray(np.linalg.norm((channels(part) - T) @ A.T, axis=1) - true_field(part))


COLUMNS = SCORES | {"0.8 to 1.25": Column("sigma", consistent, ".0%")}
STUDY = Study(run, ("noise", "masses", "method"), COLUMNS)


if __name__ == "__main__":
    STUDY.main(__doc__, seeds=40, masses=[2, 1, 3], noise=list(NOISES))
