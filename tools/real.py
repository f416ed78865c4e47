"""What ``diagnose`` finds in logs that others measured, beside an independent least-squares check.

    python tools/real.py --data DIR [--only NAME]

Each vehicle is calibrated on the first part of its data and diagnosed on the rest. Prints what is found, what
that improves on parts left out of its fit, and how far from white the rest is. The check knows nothing of
``diagnose``: Tolles & Lawson's terms (1950), fitted by least squares to what the calibration leaves in the
rest, eighths of it left out in turn: permanent and induced (3 + 6 terms), and with eddy currents (9 more).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from rich.console import Console
from terminal import command_line, table

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.words import label
from magbridge.logs import read

MIDNIGHT = 1592611200.0
"""s since 1970, of the flight's day (2020-06-20)."""
EVERY = 5
"""Rows of the flight (10 Hz) of which one is taken: an aircraft turns no faster."""

PARTS = 8
"""Parts of a log that are left out of the check's fit, one after the other, as `diagnose` does."""


class Vehicle(NamedTuple):
    """Logs to calibrate from, logs to diagnose, and the calibration's parameters."""

    known: list[xr.Dataset]
    asked: list[xr.Dataset]
    parameters: tuple[str, ...] = ()


def flight(folder: Path) -> Vehicle:
    """Halve an aircraft's calibration flight: permanent, induced and eddy-current fields."""
    numbers = np.genfromtxt(folder / "magnav_flt1002" / "Flt1002_1002.02.txt", invalid_raise=False)[::EVERY]
    numbers = numbers[np.isfinite(numbers).all(axis=1)]
    names = ("mag_x", "mag_y", "mag_z", "pitch", "roll", "heading")
    columns = {name: ("time", numbers[:, k]) for k, name in enumerate(names, 1)}
    columns["reference_field"] = ("time", np.linalg.norm(numbers[:, 7:10], axis=1))
    ds = xr.Dataset(columns, {"time": MIDNIGHT + numbers[:, 0]}, {"source": "flight"})
    for name, column in ds.data_vars.items():
        column.attrs["units"] = "deg" if name in ("pitch", "roll", "heading") else "nT"
    half = ds.sizes["time"] // 2
    return Vehicle([ds.isel(time=slice(half))], [ds.isel(time=slice(half, None))])


def seaglider(folder: Path) -> Vehicle:
    """Take a Seaglider's first three dives, and its next two."""
    dives = [read(path) for path in sorted((folder / "seaglider_sg167").glob("p*.nc"))]
    return Vehicle(dives[:3], dives[3:], ("pitchCtl", "vbdCC"))


def ardusub(folder: Path) -> Vehicle:
    """Halve an ROV's log."""
    ds = read(folder / "ardusub" / "small.tlog")
    half = ds.sizes["time"] // 2
    return Vehicle([ds.isel(time=slice(half))], [ds.isel(time=slice(half, None))])


VEHICLES: dict[str, Callable[[Path], Vehicle]] = {
    "magnav_flt1002": flight,
    "seaglider_sg167": seaglider,
    "ardusub": ardusub,
}


def joined(logs: list[xr.Dataset]) -> xr.Dataset:
    """Put logs one after the other; only what all have."""
    return logs[0] if len(logs) == 1 else xr.concat(logs, "time", join="inner").sortby("time")


def tolles_lawson(u: FloatArray, time: FloatArray, field: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return permanent and induced terms (n, 9), and those of eddy currents (n, 9).

    Parameters
    ----------
    u : (n, 3) array
        Direction cosines of the field in the body.
    time, field : (n,) array
        s, and nT.
    """
    upper = np.triu_indices(3)
    still = np.hstack([u, (u[:, upper[0]] * u[:, upper[1]])])
    rate = np.gradient(u, time, axis=0)
    return still, (u[:, :, None] * rate[:, None, :]).reshape(-1, 9) * (field / field.mean())[:, None]


def left_out(X: FloatArray, y: FloatArray) -> float:
    """Return the RMS of what least squares of X (n, k) leaves of y (n,), eighths left out in turn."""
    X = np.hstack([np.ones((len(X), 1)), X])
    eighth = np.arange(len(y)) * PARTS // len(y)
    missed = np.empty_like(y)
    for part in range(PARTS):
        out = eighth == part
        missed[out] = y[out] - X[out] @ np.linalg.lstsq(X[~out], y[~out], rcond=1e-8)[0]
    return float(np.std(missed))


def checked(found: Diagnosis) -> Iterator[float]:
    """Yield what is left, without permanent and induced terms, and without eddy currents."""
    survey, known = found.problem.survey, found.problem.calibration
    new = ~survey.learned
    got = correct(known, survey.field, survey.values(known.channels), survey.time)
    u = (got.vector / np.linalg.norm(got.vector, axis=1)[:, None])[new]
    e = (got.total - survey.reference)[new]
    still, eddy = tolles_lawson(u, survey.time[new], survey.reference[new])
    yield float(np.std(e))
    yield left_out(still, e)
    yield left_out(np.hstack([still, eddy]), e)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the measured data")
    parser.add_argument("--only", choices=VEHICLES, help="one of them")
    options = parser.parse_args()
    console = Console(width=200)
    made = table(
        "Logs that others measured (nT RMS)", "log", "scales", "verdict", "found", "before",
        "left out",
        "95 %", "rest: RMS", "white", "memory", "about mean", "+ 9 terms", "+ eddy", left=("log", "found"),
    )  # fmt: skip
    for name in [options.only] if options.only else VEHICLES:
        vehicle = VEHICLES[name](options.data)
        fitted = fit(observations(joined(vehicle.known), vehicle.parameters))
        found = diagnose([joined(vehicle.asked)], fitted.calibration)
        names = [label(*one.candidate.group) for one in found.findings]
        names += ["outliers"] if found.wrong is not None else []
        low, high = found.total.interval
        rest = found.assessment.residual
        made.add_row(
            name, "{:.2f}-{:.2f}".format(*fitted.scales), found.verdict, ", ".join(names) or "nothing named",
            f"{found.total.before:.1f}", f"{found.total.after:.1f}", f"{low:.2f}-{high:.2f}",
            f"{rest.rms:.1f}", f"{rest.white:.1f}", f"{rest.correlation_time:.1f} s",
            *(f"{x:.1f}" for x in checked(found)),
        )  # fmt: skip
        console.print(
            f"{name}: {found.assessment.answer}",
            *(
                f"\n  {one.candidate.cause}: {one.follows(found.problem, found.fit)}"
                for one in found.findings
            ),
            f"\n  left: {found.assessment.follows}",
        )
    console.print(made)


if __name__ == "__main__":
    main()
