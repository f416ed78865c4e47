"""Rows of tools/survey.py for surveys that others flew: what is known of each, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from bonne_bay_trials import MASSES, measure
from scipy.spatial import cKDTree

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.validate import in_sensor_units
from magbridge.calibration.residual import rms
from magbridge.logs import read
from magbridge.survey.read import read_table
from magbridge.survey.run import survey
from sitl.scenario import load
from sitl.twin import Twin

__all__ = ["REAL"]

AT_A_LINE = 60.0
"""m, half a step between a line's samples, about."""
SEED = 29
"""Of the Bonne Bay twin, as in tools/bonne_bay.py."""


def rio(folder: Path) -> Iterator[str]:
    """Predict the tie lines of a survey of 1978 from its other lines; then join both."""
    samples = read_table(folder / "rio_magnetic" / "rio-magnetic.csv.xz")
    done = survey(samples.part(~samples.tie))
    ties = samples.part(samples.tie)
    anomaly, sigma = done.gridded.at(ties.place, ties.depth)
    error = anomaly - ties.value
    near_by = done.gridded.kriged
    z = error / np.hypot(sigma, done.gridded.sigma if near_by is None else near_by.of_a_line(ties.place))
    yield f"ties from lines: median error {np.median(np.abs(error)):.1f} nT, RMS {rms(error):.0f}"
    yield f"standardised error {rms(z):.2f} RMS, {1.4826 * np.median(np.abs(z)):.2f} in the middle"
    near = cKDTree(samples.part(~samples.tie).place).query(ties.place)[0] < AT_A_LINE
    yield (
        f"at most {AT_A_LINE:.0f} m from a line's sample, where nothing is left to predict: "
        f"{np.median(np.abs(error[near])):.1f} nT, RMS {rms(error[near]):.0f}"
    )
    joint = survey(samples)
    before, after = rms(joint.before), rms(joint.after)
    yield f"mis-ties at {len(joint.before)} crossings: {before:.1f} nT RMS, {after:.1f} levelled"


def flight(folder: Path) -> Iterator[str]:
    """Calibrate from one half of an aircraft's calibration flight, test on the other."""
    table = pd.read_csv(
        folder / "magnav_flt1002" / "Flt1002_1002.02.txt", sep=r"\s+", header=None, comment="#"
    )
    numbers = table.apply(pd.to_numeric, errors="coerce").dropna(axis=1, how="all").dropna().to_numpy()
    time, field, attitude, ned = (
        numbers[:, 0],
        numbers[:, 1:4],
        np.radians(numbers[:, [5, 4, 6]]),
        numbers[:, 7:10],
    )
    thin = slice(None, None, 10)
    data = Observations(
        field=field[thin], reference=np.linalg.norm(ned[thin], axis=1),
        parameters=np.empty((len(time[thin]), 0)), time=time[thin], attitude=attitude[thin],
        reference_ned=ned[thin],
    )  # fmt: skip
    half = np.arange(len(data)) < len(data) // 2
    for name, part, rest in (("first half", half, ~half), ("second half", ~half, half)):
        yield f"{name}: {_left_out(fit(data.part(part)), data.part(rest))} (no positions in it: no rock)"


def seaglider(folder: Path) -> Iterator[str]:
    """Calibrate from all dives but one, test on that one."""
    files = sorted((folder / "seaglider_sg167").glob("p*.nc"))
    logs = [read(file) for file in files]
    for k in (0, len(logs) - 1):
        others = xr.concat([log for i, log in enumerate(logs) if i != k], "time", join="inner").sortby("time")
        found = fit(observations(others, ()))
        yield f"without {files[k].name}: {_left_out(found, observations(logs[k], ()))}"


def bonne_bay(_: Path) -> Iterator[str]:
    """Calibrate from the twin's survey alone, where the paper used its calibration runs and a map."""
    parts = measure(Twin.draw(load("bonne_bay"), SEED))
    survey_log = parts["survey"]
    found = fit(observations(survey_log.drop_vars("reference_field"), MASSES))
    seen = observations(survey_log, MASSES)
    got = correct(found.calibration, seen.field, seen.parameters, seen.time)
    error = got.total - survey_log["truth_total_field"].to_numpy()
    level = found.calibration.reference.level_sigma
    yield (
        f"survey alone: {np.std(error):.1f} nT RMS about its mean against the truth, level off by "
        f"{error.mean():.0f} (sigma {level:.0f}); the paper with runs and a map: 124 and 69 nT"
    )


def _left_out(found: Fit, rest: Observations) -> str:
    error, standardised = in_sensor_units(found.calibration, rest)
    low, high = found.scales
    about = error - error.mean()
    return (
        f"{found.calibration.method}: {rms(about):.1f} nT RMS about its mean left out, standardised "
        f"{rms(standardised):.2f}, scales {low:.3f} to {high:.3f}"
    )


REAL: dict[str, Callable[[Path], Iterator[str]]] = {
    "rio_magnetic": rio,
    "magnav_flt1002": flight,
    "seaglider_sg167": seaglider,
    "Bonne Bay's twin": bonne_bay,
}
"""By name; each yields lines of text."""
