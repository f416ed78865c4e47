"""Measure the error of the heading out of sample, and whether its stated standard deviation is right.

Each row of the table is a calibration, tested on another log. No calibration uses the headings of its log,
except in the row that states it. A free ellipsoid has no boresight, so it gets magbridge's. The
aircraft's log is third-party data (``$MAGBRIDGE_REAL_DATA``, or ``../shared/data``); its inertial heading
is the truth.

    python tools/heading.py --seeds 6 --out heading.parquet
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import xarray as xr
from accuracy import ellipsoid
from measured import FLIGHT_MIDNIGHT_S, aircraft_line
from scipy.spatial.transform import Rotation
from studies import DATA, Column, Row, Study
from study_worlds import MASSES, glider, measure_trials

import magbridge as mb
from magbridge.calibration.correct import correct, vector_covariance
from magbridge.calibration.fitting.boresight import choose_boresight
from magbridge.calibration.fitting.observations import Observations, unfiltered
from magbridge.calibration.model import Calibration
from magbridge.columns import HEADINGS
from magbridge.estimation.residual import rms
from magbridge.field.reference import earth_field
from sitl import Twin, load
from sitl.dataset import channels, side_by_side

TILT_SIGMA_DEG = 0.1
"""1-sigma of the white noise of simulated roll and pitch, deg."""
RUN_OFFSET_DEG = 0.2
"""1-sigma of the offsets of roll and pitch in a run, deg."""
PAIRS = (1, 5)
"""Numbers of pairs of spirals from which the boresight is estimated."""
CUTOFF_HZ = 0.33
"""Cut-off of the simulated anti-alias filter, Hz; a spiral turns at 1.6 deg/s."""
ANGLES = ("roll", "pitch")
AIRCRAFT_STEP = 10
"""Step between the samples of the aircraft's line (10 Hz) that are used."""
SIMULATED = ("gliders", "gliders, tilt offsets", "gliders, filter", "Bonne Bay twin")


def run(name: str, seed: int) -> Iterator[Row]:
    """Yield the rows of one vehicle: a heading's RMS error and its normalised error, by method."""
    if name != "aircraft":
        yield from simulated(name, seed)
    elif seed == 0:
        yield from aircraft()


def score(method: str, heading: np.ndarray, sigma: np.ndarray | float, truth: np.ndarray) -> Row:
    """Return the row of a method: its heading and sigma (n,) against the true heading (n,), deg."""
    error = (heading - truth + 180.0) % 360.0 - 180.0
    good = np.isfinite(error)
    error, stated = error[good], np.broadcast_to(sigma, truth.shape)[good]
    return {"method": method, "rms": rms(error), "stated": rms(stated), "normalised": rms(error / stated)}


def published(method: str, calibration: Calibration, log: xr.Dataset) -> Row:
    """Score the heading columns of ``correct`` on unflagged rows; the log's own heading is the truth."""
    rows = mb.correct_rows(mb.Correction(calibration), log.drop_vars("heading"))
    good = rows["quality"].to_numpy() == 0
    magnetic, _, sigma, declination, its_sigma = (rows[column].to_numpy()[good] for column in HEADINGS)
    # the simulated world's main field is the IGRF: the declination has no error
    stated = np.sqrt(sigma**2 - its_sigma**2)
    return score(method, magnetic + declination, stated, log["heading"].to_numpy()[good])


def with_tilt_errors(log: xr.Dataset, rng: np.random.Generator, offset_deg: float) -> xr.Dataset:
    """Return a log whose roll and pitch have white noise and an offset (1-sigma `offset_deg`) in each run."""
    _, runs = np.unique(log["run"], return_inverse=True)
    for angle in ANGLES:
        noise = rng.normal(0.0, TILT_SIGMA_DEG, len(runs)) + rng.normal(0.0, offset_deg, runs.max() + 1)[runs]
        log = log.assign({angle: log[angle] + noise})
    return log


def simulated(name: str, seed: int) -> Iterator[Row]:
    """Yield the rows of a simulated vehicle, calibrated by spirals and tested on a survey's true headings."""
    exact = {"roll_pitch_sigma": 0.0, "heading_sigma": 0.0}
    rng = np.random.default_rng([seed, 5])
    if name == "Bonne Bay twin":
        parts = measure_trials(Twin.draw(load("bonne_bay").replace(telemetry=exact), seed), at_depth=True)
        learned, survey = parts["trial 1"], parts["survey"]
    else:
        corner = CUTOFF_HZ if name == "gliders, filter" else 0.0
        scenario = load("random_glider").replace(telemetry=exact, instrument={"corner": corner})
        _, learned, survey = glider(scenario, seed)
    offset_deg = RUN_OFFSET_DEG if name == "gliders, tilt offsets" else 0.0
    level = survey  # without errors of roll and pitch
    learned, survey = (with_tilt_errors(log, rng, offset_deg) for log in (learned, survey))
    blind = learned.drop_vars("heading")
    data = mb.observations(blind, MASSES)
    if name == "gliders, filter":
        yield published("auto, lag ignored", mb.fit(data).calibration, survey)
        yield published("auto, lag undone", mb.fit(unfiltered(data, CUTOFF_HZ)).calibration, survey)
        return
    known = mb.fit(data).calibration
    yield published("auto", known, survey)
    yield published("nominal", mb.fit(mb.observations(blind, ()), "nominal").calibration, survey)
    if name == "gliders, tilt offsets":
        yield from after_pairs(known, learned, {"": survey, ", exact tilt in the survey": level}, blind)
    yield score("raw compass", *levelled(channels(survey), survey), survey["heading"].to_numpy())
    assert known.boresight is not None
    turn = Rotation.from_rotvec(known.boresight.rotation)
    A, T = ellipsoid(learned)
    vector = turn.apply((channels(survey) - T) @ A.T)
    yield score("scipy ellipsoid", *levelled(vector, survey), survey["heading"].to_numpy())


def levelled(vector: np.ndarray, log: xr.Dataset) -> tuple[np.ndarray, float]:
    """Return the true heading (n,), deg, of field vectors (n, 3) in body axes, and NaN as its sigma."""
    _, ned, _ = earth_field(log)
    assert ned is not None
    declination = np.degrees(np.arctan2(ned[:, 1], ned[:, 0]))
    roll, pitch = np.radians(side_by_side(log, ANGLES)).T
    return mb.heading(vector, roll, pitch, declination).true, np.nan


def after_pairs(
    known: Calibration, learned: xr.Dataset, surveys: dict[str, xr.Dataset], blind: xr.Dataset
) -> Iterator[Row]:
    """Yield the rows of boresights from the first pairs of spirals alone, in each survey."""
    runs = np.unique(learned["run"])
    for pairs in PAIRS:
        first = blind.isel(time=np.isin(learned["run"], runs[: 2 * pairs]))
        boresight = choose_boresight(known, mb.observations(first, MASSES))
        if boresight is None:
            yield {"method": f"auto, boresight of {pairs} pairs", "failed": "no boresight"}
            continue
        used = replace(known, boresight=boresight)
        for text, survey in surveys.items():
            yield published(f"auto, boresight of {pairs} pairs{text}", used, survey)


def aircraft() -> Iterator[Row]:
    """Yield the rows of the aircraft: each half of its line is fitted and tested on the other half."""
    if not DATA.exists():
        yield {"method": "auto", "failed": "no measured data"}
        return
    rows = aircraft_line(DATA, AIRCRAFT_STEP)
    pitch, roll, heading = rows[:, 4:7].T
    ned = rows[:, 7:10]
    line = Observations(
        rows[:, 1:4], np.linalg.norm(ned, axis=1), np.empty((len(rows), 0)),
        time=FLIGHT_MIDNIGHT_S + rows[:, 0], attitude=np.radians(np.column_stack([roll, pitch, heading])),
        reference_ned=ned,
    )  # fmt: skip
    first = np.arange(len(line)) < len(line) // 2
    declination = np.degrees(np.arctan2(ned[:, 1], ned[:, 0]))
    for half, part in (("first half", first), ("second half", ~first)):
        for method, inertial in (("roll and pitch", False), ("inertial headings", True)):
            used = mb.fit(replace(line.part(part), independent_headings=inertial)).calibration
            boresight = used.boresight
            assert boresight is not None
            other = line.part(~part)
            after = correct(used, other.field, other.parameters, other.time)
            found = mb.heading(
                after.vector, np.radians(roll[~part]), np.radians(pitch[~part]), declination[~part],
                covariance=vector_covariance(used, other.field, other.parameters, other.time),
                boresight_covariance=np.array(boresight.covariance), tilt_sigma_deg=boresight.tilt_sigma,
            )  # fmt: skip
            yield score(f"{half} fitted with {method}", found.true, found.sigma, heading[~part])


STUDY = Study(
    run,
    ("name", "method"),
    {
        "error, deg RMS: median": Column("rms"),
        "maximum": Column("rms", np.max),
        "stated, deg": Column("stated"),
        "normalised: median": Column("normalised"),
    },
)


if __name__ == "__main__":
    STUDY.main(__doc__, names=[*SIMULATED, "aircraft"], seeds=6)
