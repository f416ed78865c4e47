"""Drones' logs: fitted on the first half, tested on the second, beside MAVProxy's magfit.

    python tools/drones.py [--peers .venv-peers/bin/python] LOG...        # the interpreter: tools/peers.py

Every compass of every log is fitted by ``nominal`` (one ellipsoid), ``auto``, ``auto`` with ``--parameter
auto`` and, in its own interpreter, MAVProxy's magfit (elliptical, and with motor compensation). Tested are
the samples of the second half whose field comes from a direction that the first half has seen, within NEAR:
no fit can know another. Printed is the RMS of the total field's error, nT, its median, and the 1-sigma that
the calibration claims over that RMS. A scale far from 1 is a collapse, whatever the RMS: it is printed, too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.offered import best_parameters
from magbridge.errors import MagbridgeError
from magbridge.logs import Options, read
from magbridge.logs.compasses import compasses_in
from magbridge.logs.info import movers

NEAR = 8.0
"""deg."""
LEAST = 60
"""Samples in either half."""


class Row(NamedTuple):
    """What one method reaches on one compass."""

    method: str
    rms: float
    median: float
    claimed: float
    scales: str
    note: str = ""


def main() -> None:
    """Print a table for each compass of each log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--peers", default="", help="interpreter that has MAVProxy")
    parser.add_argument("logs", nargs="+", type=Path)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    console = Console(width=120)
    for path in chosen.logs:
        for number in [str(one.number) for one in compasses_in(read(path))] or ["0"]:
            deployment = read(path, options=Options(compass=number))
            try:
                title, rows = compared(deployment, chosen.peers)
            except MagbridgeError as error:
                console.print(f"{path.name}, compass {number}: {error}")
                continue
            table = Table("method", "RMS, nT", "median, nT", "claimed/error", "scales", "",
                          title=f"{path.name}, compass {number}: {title}")  # fmt: skip
            for row in rows:
                table.add_row(row.method, f"{row.rms:.0f}", f"{row.median:.0f}", f"{row.claimed:.2f}",
                              row.scales, row.note)  # fmt: skip
            console.print(table)


def compared(deployment: xr.Dataset, peers: str) -> tuple[str, list[Row]]:
    """Return what was compared, and a row for each method."""
    bare = observations(deployment, ())
    half = float(np.median(bare.time))
    early, late = bare.part(bare.time <= half), bare.part(bare.time > half)
    seen = near(late, early)
    if min(len(early), int(seen.sum())) < LEAST:
        raise MagbridgeError(f"{len(early)} samples to fit and {int(seen.sum())} to test: too few")
    tested = late.time[seen]
    rows = []
    for method, names in (("nominal", ()), ("auto", ()), ("auto", None)):
        rows.append(ours(deployment, half, tested, method, names))
    if peers:
        rows += list(magfits(deployment, early, late.part(seen), peers))
    return f"{len(early)} samples to fit, {len(tested)} of {len(late)} to test", rows


def near(late: Observations, early: Observations) -> np.ndarray:
    """Return which samples see the Earth's field within NEAR of where the early ones have seen it."""
    away, _ = cKDTree(np.nan_to_num(_directions(early), nan=5.0)).query(
        np.nan_to_num(_directions(late), nan=9.0)
    )
    return np.asarray(away < 2 * np.sin(np.radians(NEAR) / 2))


def _directions(data: Observations) -> FloatArray:
    """Return the directions (n, 3) of the Earth's field in the body, by attitude; NaN where not known."""
    found = np.full((len(data), 3), np.nan)
    known, attitude, earth = data.directed()
    roll, pitch, heading = attitude.T
    turned = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).inv().apply(earth)
    found[known] = turned / np.linalg.norm(turned, axis=1)[:, None]
    return found


def ours(
    deployment: xr.Dataset, half: float, tested: FloatArray, method: str, names: tuple[str, ...] | None
) -> Row:
    """Return what a fit of the first half reaches; `names` None: the parameters are chosen there."""
    label = method if names is not None else "auto --parameter auto"
    first = deployment.sel(time=deployment["time"] <= half)
    try:
        if names is None:
            names, _ = best_parameters(first, movers(first))
        found = fit(observations(first, names), method)
    except MagbridgeError as error:
        return Row(label, np.nan, np.nan, np.nan, "", str(error)[:60])
    data = observations(deployment, names)
    data = data.part(np.isin(data.time, tested))
    corrected = correct(found.calibration, data.field, data.parameters, data.time)
    return row(label, corrected.total - data.reference, found, corrected.sigma, " ".join(names))


def row(label: str, error: FloatArray, found: Fit, sigma: FloatArray, note: str) -> Row:
    """Return the row of a fit by its errors (n,), nT, and the sigmas (n,) that it claims."""
    claimed = float(np.sqrt(np.mean(sigma**2) / np.mean(error**2)))
    low, high = found.scales
    return Row(label, rms(error), float(np.median(np.abs(error))), claimed, f"{low:.2f}-{high:.2f}", note)


def rms(error: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(error**2)))


def magfits(deployment: xr.Dataset, early: Observations, late: Observations, peers: str) -> Iterator[Row]:
    """Yield what MAVProxy's magfit reaches, fitted and tested on the same samples."""
    if early.attitude is None or early.reference_ned is None:
        return
    at = deployment["time"].to_numpy()
    current = np.zeros(len(at))
    if "battery_current" in deployment:
        current = np.nan_to_num(deployment["battery_current"].to_numpy())
    known, attitude, earth = early.directed()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "half.npz"
        np.savez(
            file,
            field=early.field[known],
            reference=early.reference[known],
            attitude=np.degrees(attitude),
            reference_ned=earth.mean(axis=0),
            current=np.interp(early.time[known], at, current),
        )
        command = [peers, str(Path(__file__).with_name("peers.py")), str(file), "magfit"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{peers}: {done.stderr.strip().splitlines()[-1]}")
    for name, answer in json.loads(done.stdout).items():
        if "failed" in answer:
            yield Row(name, np.nan, np.nan, np.nan, "", answer["failed"][:60])
            continue
        A, T, K = (np.array(answer[key]) for key in "ATK")
        total = np.linalg.norm(
            (late.field - T) @ A.T + np.outer(np.interp(late.time, at, current), K), axis=1
        )
        scales = np.linalg.svd(A, compute_uv=False)
        error = total - late.reference
        yield Row(
            name, rms(error), float(np.median(np.abs(error))), np.nan, f"{scales[-1]:.2f}-{scales[0]:.2f}"
        )


if __name__ == "__main__":
    main()
