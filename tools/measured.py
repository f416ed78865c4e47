"""Measure calibration, diagnosis and maps on logs of real vehicles, for which the true field is unknown.

    python tools/measured.py seaglider --data DIR       each dive corrected by a fit of the other dives
    python tools/measured.py halves --data DIR          the second half by a fit of the first half; see --log
    python tools/measured.py diagnose --data DIR        the second half diagnosed, and the Tolles-Lawson check
    python tools/measured.py survey --data DIR          tie lines of an airborne survey by its other lines

``halves`` fits by ``nominal``, ``auto`` and ``auto --parameter auto``. It tests the samples whose field
direction in the body is within 8 deg of a direction in the first half. The table also has the scales, because
a fit with a scale far from 1 has collapsed even if its RMS is small. ``diagnose`` has an independent check:
Tolles & Lawson's terms (1950), fitted by least squares to the calibration's residuals, with each eighth of
the log held out in turn.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from studies import DATA, Column, Row, Study, command_line, show

from magbridge import MagbridgeError, diagnose, fit, observations, read
from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import Fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.parameter_choice import best_parameters
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.logs import Options
from magbridge.logs.compasses import compasses_in
from magbridge.logs.info import movers
from magbridge.survey.read import read_table
from magbridge.survey.run import survey

MIN_RUN_SAMPLES, MIN_HALF_SAMPLES = 30, 60
"""Minimum number of samples of a held-out run, and of each half of a log."""
MAX_DIRECTION_DEG = 8.0
"""Maximum angle between a tested field direction and the nearest direction in the fitted half, deg."""
SEAGLIDER_CHOICES: tuple[tuple[str, tuple[str, ...], int], ...] = (
    ("nominal", (), 1),
    ("auto", ("pitchCtl", "vbdCC"), 1),
    ("auto", ("pitchCtl", "vbdCC"), 3),
    ("cubic", ("pitchCtl", "vbdCC"), 3),
)
"""Method, masses and polynomial order of each calibration."""
FLIGHT_MIDNIGHT_S = 1592611200.0
"""Start of the day of the flight (2020-06-20), s since 1970 UTC."""
FLIGHT_ROWS = 5
"""Step between the rows of the flight (10 Hz) that are used; an aircraft turns slowly."""
HELD_OUT_PARTS = 8
MAX_LINE_DISTANCE_M = 60.0
"""Maximum distance of a tie's sample from the nearest line, m: about half the sample spacing of a line."""


class Vehicle(NamedTuple):
    """Logs of a vehicle for calibration and for the test, and the parameters of the calibration."""

    known: list[xr.Dataset]
    asked: list[xr.Dataset]
    parameters: tuple[str, ...] = ()


def aircraft_line(folder: Path, step: int) -> FloatArray:
    """Return every `step`-th complete row of an aircraft's line: time, field, pitch, roll, heading, IGRF."""
    rows = np.genfromtxt(folder / "magnav_flt1002" / "Flt1002_1002.02.txt", invalid_raise=False)[::step]
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def flight(folder: Path) -> Vehicle:
    """Return the halves of an aircraft's calibration flight, without parameters."""
    numbers = aircraft_line(folder, FLIGHT_ROWS)
    names = ("mag_x", "mag_y", "mag_z", "pitch", "roll", "heading")
    columns = {name: ("time", numbers[:, k]) for k, name in enumerate(names, 1)}
    columns["reference_field"] = ("time", np.linalg.norm(numbers[:, 7:10], axis=1))
    ds = xr.Dataset(columns, {"time": FLIGHT_MIDNIGHT_S + numbers[:, 0]}, {"source": "flight"})
    for name, column in ds.data_vars.items():
        column.attrs["units"] = "deg" if name in ("pitch", "roll", "heading") else "nT"
    return _halves(ds)


def seaglider(folder: Path) -> Vehicle:
    """Return the first three dives of a Seaglider for calibration, and the other dives for the test."""
    dives = [read(path) for path in sorted((folder / "seaglider_sg167").glob("p*.nc"))]
    return Vehicle(dives[:3], dives[3:], ("pitchCtl", "vbdCC"))


def ardusub(folder: Path) -> Vehicle:
    """Return the halves of an underwater robot's log."""
    return _halves(read(folder / "ardusub" / "small.tlog"))


VEHICLES = {"magnav_flt1002": flight, "seaglider_sg167": seaglider, "ardusub": ardusub}


def _halves(log: xr.Dataset) -> Vehicle:
    half = log.sizes["time"] // 2
    return Vehicle([log.isel(time=slice(half))], [log.isel(time=slice(half, None))])


def joined(logs: list[xr.Dataset]) -> xr.Dataset:
    """Return logs joined in order of time, with the columns that all of them have."""
    return logs[0] if len(logs) == 1 else xr.concat(logs, "time", join="inner").sortby("time")


# ---- a Seaglider's dives, each held out --------------------------------------------------------------------


def hold_runs_out(data: Observations, method: str, order: int = 3) -> tuple[FloatArray, FloatArray]:
    """Fit without each run in turn; return the held-out run's errors (n,), nT, and normalised errors (n,).

    Raises
    ------
    CalibrationError
        The data have fewer than two runs, or a fit fails.
    """
    labels, counts = np.unique(data.runs, return_counts=True)
    labels = labels[counts >= MIN_RUN_SAMPLES]
    if len(labels) < 2:
        raise CalibrationError(f"holding runs out: expected 2 runs of {MIN_RUN_SAMPLES} samples or more")
    error, normalised = np.full(len(data), np.nan), np.full(len(data), np.nan)
    for label in labels:
        out = np.asarray(data.runs == label)
        calibration = fit(data.part(~out), method, order).calibration
        error[out], normalised[out] = in_sensor_units(calibration, data.part(out))
    return error, normalised


def run_seaglider(method: str, masses: tuple[str, ...], order: int, data: Path) -> list[Row]:
    """Correct each dive of a Seaglider by a fit of the other dives, with a choice of masses."""
    log = read(sorted((data / "seaglider_sg167").glob("p*.nc")))
    error, normalised = hold_runs_out(observations(log, masses), method, order)
    return [{"rms": rms(error[np.isfinite(error)]), "normalised": float(np.nanstd(normalised))}]


# ---- halves of a log ---------------------------------------------------------------------------------------


def run_halves(log: Path) -> Iterator[Row]:
    """Compare the methods on each compass of a log."""
    for number in [str(one.number) for one in compasses_in(read(log))] or ["0"]:
        for row in compare_halves(read(log, options=Options(compass=number))):
            yield {"compass": number} | row


def compare_halves(deployment: xr.Dataset) -> Iterator[Row]:
    """Fit every method to the first half of a log; yield its scores on the second half, nT."""
    bare = observations(deployment, ())
    half = float(np.median(bare.time))
    early, late = bare.part(bare.time <= half), bare.part(bare.time > half)
    known = has_known_direction(late, early)
    if min(len(early), int(known.sum())) < MIN_HALF_SAMPLES:
        raise CalibrationError(f"{len(early)} samples to fit and {int(known.sum())} to test: too few")
    first = deployment.sel(time=deployment["time"] <= half)
    for label, method in (("nominal", "nominal"), ("auto", "auto"), ("auto --parameter auto", "auto")):
        try:
            names = best_parameters(first, movers(first))[0] if "--" in label else ()
            found = fit(observations(first, names), method)
        except MagbridgeError as refusal:
            yield {"method": label, "failed": str(refusal)[:60]}
            continue
        data = observations(deployment, names)
        data = data.part(np.isin(data.time, late.time[known]))
        corrected = correct(found.calibration, data.field, data.parameters, data.time)
        low, high = found.scales
        row = {"method": label, "parameters": " ".join(names), "low": low, "high": high}
        yield row | errors(corrected.total - data.reference, rms(corrected.sigma))


def errors(error: FloatArray, sigma: float) -> Row:
    """Return the RMS and median of an error (n,), nT, and the claimed `sigma` over the RMS."""
    return {"rms": rms(error), "median": float(np.median(np.abs(error))), "claimed": sigma / rms(error)}


def has_known_direction(late: Observations, early: Observations) -> BoolArray:
    """Return the late samples (n,) whose field direction in the body is also among the early samples."""
    tree = cKDTree(np.nan_to_num(_directions(early), nan=5.0))
    distance, _ = tree.query(np.nan_to_num(_directions(late), nan=9.0))
    return np.asarray(distance < 2 * np.sin(np.radians(MAX_DIRECTION_DEG) / 2))


def _directions(data: Observations) -> FloatArray:
    """Return the directions (n, 3) of the Earth's field in body axes, from the attitude; NaN if unknown."""
    found = np.full((len(data), 3), np.nan)
    known, attitude, earth = data.directed()
    roll, pitch, heading = attitude.T
    turned = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).inv().apply(earth)
    found[known] = turned / np.linalg.norm(turned, axis=1)[:, None]
    return found


# ---- diagnosis, with an independent check ------------------------------------------------------------------


def tolles_lawson(u: FloatArray, time: FloatArray, field: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the permanent and induced terms (n, 9), and the eddy-current terms (n, 9).

    `u` (n, 3) are the direction cosines of the field in the body; `time` in s, `field` in nT, (n,).
    """
    upper = np.triu_indices(3)
    static = np.hstack([u, (u[:, upper[0]] * u[:, upper[1]])])
    rate = np.gradient(u, time, axis=0)
    return static, (u[:, :, None] * rate[:, None, :]).reshape(-1, 9) * (field / field.mean())[:, None]


def held_out_error(X: FloatArray, y: FloatArray) -> float:
    """Return the RMS prediction error of y (n,) by least squares on X (n, k), parts held out in turn."""
    X = np.hstack([np.ones((len(X), 1)), X])
    part_of = np.arange(len(y)) * HELD_OUT_PARTS // len(y)
    missed = np.empty_like(y)
    for part in range(HELD_OUT_PARTS):
        out = part_of == part
        missed[out] = y[out] - X[out] @ np.linalg.lstsq(X[~out], y[~out], rcond=1e-8)[0]
    return float(np.std(missed))


def check_by_tolles_lawson(found: Diagnosis) -> Row:
    """Return the residual without bias, with 9 Tolles-Lawson terms, and with 18 terms, nT RMS."""
    log, known = found.problem.survey, found.problem.calibration
    new = ~log.learned
    got = correct(known, log.field, log.values(known.channels), log.time)
    u = (got.vector / np.linalg.norm(got.vector, axis=1)[:, None])[new]
    error = (got.total - log.reference)[new]
    static, eddy = tolles_lawson(u, log.time[new], log.reference[new])
    return {
        "about_mean": float(np.std(error)), "static": held_out_error(static, error),
        "eddy": held_out_error(np.hstack([static, eddy]), error),
    }  # fmt: skip


def calibrate_and_diagnose(vehicle: Vehicle) -> tuple[Fit, Diagnosis]:
    """Return the fit of a vehicle's first logs, and the diagnosis of its test logs."""
    fitted = fit(observations(joined(vehicle.known), vehicle.parameters))
    return fitted, diagnose([joined(vehicle.asked)], fitted.calibration).diagnosis


def run_diagnose(log: str, data: Path) -> list[Row]:
    """Diagnose a vehicle's log, and check it by Tolles and Lawson's terms; return the row, nT RMS."""
    fitted, found = calibrate_and_diagnose(VEHICLES[log](data))
    causes = ", ".join(one.candidate.cause for one in found.findings) or "none"
    low, high = found.improvement.interval
    row = {"found": causes, "scales": "{:.2f}-{:.2f}".format(*fitted.scales), "least": low, "most": high}
    row |= {"before": found.improvement.before, "held_out": found.improvement.after}
    return [row | check_by_tolles_lawson(found)]


# ---- an airborne survey ------------------------------------------------------------------------------------


def run_survey(data: Path) -> Iterator[Row]:
    """Predict the tie lines of an airborne survey from its other lines; level all lines; yield errors, nT."""
    samples = read_table(data / "rio_magnetic" / "rio-magnetic.csv.xz")
    lines, ties = samples.part(~samples.tie), samples.part(samples.tie)
    done = survey(lines)
    anomaly, sigma = done.gridded.evaluate(ties.place, ties.depth)
    error, kriged = anomaly - ties.value, done.gridded.kriged
    claimed = np.hypot(sigma, done.gridded.sigma if kriged is None else kriged.of_a_line(ties.place))
    near = cKDTree(lines.place).query(ties.place)[0] < MAX_LINE_DISTANCE_M
    joint = survey(samples)
    none = np.full(1, np.nan)
    for name, values, sigmas in (
        ("all ties", error, claimed),
        (f"within {MAX_LINE_DISTANCE_M:.0f} m of a line", error[near], claimed[near]),
        (f"{len(joint.before)} mis-ties", joint.before, none),
        ("mis-ties, levelled", joint.after, none),
    ):
        row = {"values": name, "median": float(np.median(np.abs(values))), "rms": rms(values)}
        yield row | {"normalised": rms(values / sigmas)}


def columns(form: str, **sources: str) -> dict[str, Column]:
    """Return columns of one form: their headings, and the rows' columns; ``_`` is a space in a heading."""
    return {heading.replace("_", " "): Column(source, form=form) for heading, source in sources.items()}


SCALES = columns(".2f", smallest_scale="low", largest="high")
STUDIES = {
    "seaglider": Study(
        run_seaglider, ("method", "masses", "order"), columns(".2f", RMS="rms", normalised="normalised")
    ),
    "halves": Study(
        run_halves,
        ("log", "compass", "method"),
        columns(".0f", RMS="rms", median="median") | columns(".2f", claimed="claimed") | SCALES,
    ),
    "diagnose": Study(
        run_diagnose,
        ("log", "scales", "found"),
        columns(".1f", before="before", held_out="held_out")
        | columns(".2f", least="least", most="most")
        | columns(".1f", about_mean="about_mean", with_9_terms="static", with_eddy_currents="eddy"),
    ),
    "survey": Study(
        run_survey,
        ("values",),
        columns(".1f", median="median", RMS="rms") | columns(".2f", normalised="normalised"),
    ),
}


def main() -> None:
    """Print the tables of the parts."""
    logs = [DATA / "ardusub" / "small.tlog"]
    chosen = command_line(__doc__, STUDIES, data=DATA, log=logs, out=Path, workers=2)
    warnings.simplefilter("ignore")
    cases: dict[str, list[tuple[Any, ...]]] = {
        "seaglider": [(*choice, chosen.data) for choice in SEAGLIDER_CHOICES],
        "halves": [(log,) for log in chosen.log],
        "diagnose": [(name, chosen.data) for name in VEHICLES],
        "survey": [(chosen.data,)],
    }
    for name in chosen.names:
        study = STUDIES[name]
        show(study.table(f"Measured logs: {name}, nT", study.rows(cases[name], chosen)))


if __name__ == "__main__":
    main()
