"""How well each calibration does out of sample, over random simulated gliders, beside what is possible.

Each glider has dipoles of its own, flies the paper's Table 1, is calibrated, and flies a survey on another
day with other roll and pitch. Printed for each method: the survey's RMS error over its noise floor (the
error of a calibration that knows the vehicle), as median, 95th percentile and worst of the gliders, the RMS
in nT on calibration and survey, and whether the predicted sigma is right. The oracle knows that masses are
dipoles, along which lines they travel, and the distribution of moments, volumes and iron on such gliders:
its bound is the average error of its fits (Cramér-Rao, with that prior); their error on these very data is
listed below it. Samples taken while a mass was moving are left out.

    python tools/accuracy.py --seeds 40 --out accuracy/
    python tools/accuracy.py --peers .venv-peers/bin/python        # see tools/peers.py
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from bonne_bay_trials import METHODS
from bound import BestFit, oracle
from engine import add_engine, in_order
from rich.console import Console
from scipy.optimize import least_squares
from terminal import command_line, table

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.residual import rms
from magbridge.errors import CalibrationError
from magbridge.field.reference import main_field
from sitl import Twin, load, segments, simulate
from sitl.dataset import at_rest, channels, corrected, side_by_side
from sitl.instrument import rotation
from sitl.platform import Vehicle

NOISES = {"1 nT white": (1.0, 0.0), "5 nT AR(1)": (5.0, 10.0)}
"""nT of a channel, and samples over which its correlation falls by e."""
MASSES = {1: ("battpos",), 2: ("battpos", "ballast"), 3: ("battpos", "ballast", "rollpos")}
TAPE = 0.05
"""m, 1-sigma of the masses' positions as measured with a tape."""


class Case(NamedTuple):
    """One glider under one noise."""

    seed: int
    noise: str
    masses: int
    methods: tuple[str, ...]
    peers: str


class Row(NamedTuple):
    """What one method did on one glider; RMS in nT, `sigma` the standardised survey error's deviation."""

    noise: str
    masses: int
    method: str
    seed: int
    calibration: float
    survey: float
    floor: float
    sigma: float
    failed: str = ""


def run(case: Case) -> list[Row]:
    """Simulate, calibrate by every method, and score on the survey."""
    noise, memory = NOISES[case.noise]
    names = MASSES[case.masses]
    instrument = {"noise_sigma": noise, "noise_memory": memory}
    scenario = load("random_glider").replace(masses=names, instrument=instrument)
    vehicle = Twin.draw(scenario, case.seed).vehicle
    assert isinstance(vehicle, Vehicle)
    parts = {name: at_rest(part, names) for name, part in segments(simulate(scenario, case.seed)).items()}
    runs, survey = parts["calibration"], parts["survey"]
    floor = rms(oracle(vehicle, survey) - total(survey))
    rows = []

    def add(method: str, before: float, after: float, sigma: float = np.nan, failed: str = "") -> None:
        rows.append(Row(case.noise, case.masses, method, case.seed, before, after, floor, sigma, failed))

    for method in case.methods:
        try:
            error, sigma, residual = calibrate(method, vehicle, runs, survey, names, case.seed)
        except CalibrationError as refused:
            add(method, np.nan, np.nan, failed=str(refused))
            continue
        add(method, residual, rms(error), float(np.std(error / sigma)))
    for at_sigma, name in ((0.5, "oracle"), (TAPE, "oracle, positions to 5 cm")):
        best = BestFit(vehicle, runs, survey, noise, memory, at_sigma)
        add(f"{name}: bound", rms(best.floor), rms(best.bound) / rms(best.floor) * floor)
        add(f"{name}: reached", np.nan, rms(best.error(np.random.default_rng([case.seed, 98]))))
    for name, (A, T, failed) in other_methods(runs, case.peers):
        add(name, rms(left(A, T, runs)), rms(left(A, T, survey)), failed=failed)
    return rows


def calibrate(
    method: str, vehicle: Vehicle, runs: xr.Dataset, survey: xr.Dataset, names: tuple[str, ...], seed: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the survey's error and predicted sigma (n,), and the RMS on the calibration runs, nT."""
    used = () if method == "nominal" else names
    options = (
        {"vehicle": tape(vehicle, seed)} if method == "auto, positions to 5 cm" else METHODS.get(method, {})
    )
    fitted = fit(observations(runs, used), method.partition(",")[0], **options).calibration
    before, after = (corrected(part, fitted) for part in (runs, survey))
    return after.total - total(survey), after.sigma, rms(before.total - total(runs))


def tape(vehicle: Vehicle, seed: int) -> dict[str, dict[str, object]]:
    """Return the masses' positions with the errors of a measurement; the tables of a ``vehicle.toml``."""
    rng = np.random.default_rng([seed, 99])
    return {
        name: {
            "at": (np.array(mass.at) + rng.normal(0, TAPE, 3)).tolist(),
            "at_sigma": TAPE,
            "travel": list(mass.travel),
        }
        for name, mass in vehicle.mass.items()
    }


def other_methods(runs: xr.Dataset, peers: str) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray, str]]]:
    """Yield the public methods' results: the corrected field is ``A (raw - T)``."""
    yield "scipy ellipsoid", (*ellipsoid(runs), "")
    if not peers:
        return
    attitude = rotation(*(runs[name].to_numpy() for name in ("roll", "pitch", "heading")))
    time = runs["time"].to_numpy()
    turned = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(time)[:, None]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "runs.npz"
        np.savez(
            file,
            field=channels(runs),
            reference=total(runs),
            attitude=side_by_side(runs, ("roll", "pitch", "heading")),
            rates=np.vstack([turned, turned[-1:]]),
            reference_ned=main_field(runs)[0],
            time=time,
        )
        command = [peers, str(Path(__file__).with_name("peers.py")), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{peers}: {done.stderr.strip().splitlines()[-1]}")
    for name, answer in json.loads(done.stdout).items():
        failed = answer.get("failed", "")
        nothing = np.full((3, 3), np.nan), np.full(3, np.nan)
        yield name, (*(nothing if failed else (np.array(answer["A"]), np.array(answer["T"]))), failed)


def ellipsoid(runs: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Fit a free ellipsoid, nine numbers, by scipy from the identity."""
    upper = np.triu_indices(3)
    size = float(np.mean(total(runs)))

    def unpack(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.zeros((3, 3))
        A[upper] = x[:6]
        return A + np.triu(A, 1).T, size * x[6:]

    start = np.concatenate([np.eye(3)[upper], np.zeros(3)])
    found = least_squares(lambda x: left(*unpack(x), runs) / size, start, method="lm", xtol=1e-12, ftol=1e-12)
    return unpack(found.x)


def total(part: xr.Dataset) -> np.ndarray:
    return part["truth_total_field"].to_numpy()


def left(A: np.ndarray, T: np.ndarray, part: xr.Dataset) -> np.ndarray:
    return np.asarray(np.linalg.norm((channels(part) - T) @ A.T, axis=1) - total(part))


def show(rows: list[Row], console: Console) -> None:
    """Print a table for each noise and number of masses."""
    for noise, masses in dict.fromkeys((row.noise, row.masses) for row in rows):
        chosen = [row for row in rows if (row.noise, row.masses) == (noise, masses)]
        gliders = len({row.seed for row in chosen})
        shown = table(
            f"{noise}, {masses} moving mass{'es' * (masses > 1)}, {gliders} gliders",
            "", "over the floor: median", "95 %", "worst", "runs nT", "survey nT", "sigma: median",
            "0.8 to 1.25",
        )  # fmt: skip
        for method in dict.fromkeys(row.method for row in chosen):
            mine = [row for row in chosen if row.method == method]
            good = [row for row in mine if np.isfinite(row.survey)]
            if not good:
                shown.add_row(method, f"failed: {mine[0].failed}")
                continue
            ratio = np.array([row.survey / row.floor for row in good])
            sigma = np.array([row.sigma for row in good])
            known = np.isfinite(sigma).any()
            shown.add_row(
                method
                + (f" ({len(mine) - len(good)} of {len(mine)} failed)" if len(good) < len(mine) else ""),
                *(
                    f"{value:.3f}" if value < 10 else f"{value:,.0f}"
                    for value in (*np.quantile(ratio, [0.5, 0.95]), ratio.max())
                ),
                *(
                    f"{np.median([getattr(row, name) for row in good]):,.2f}".replace("nan", "")
                    for name in ("calibration", "survey")
                ),
                f"{np.median(sigma):.2f}" if known else "",
                f"{np.mean((sigma > 0.8) & (sigma < 1.25)):.0%}" if known else "",
            )
        console.print(shown)


def arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = command_line(__doc__)
    parser.add_argument("--seeds", type=int, default=40, help="gliders")
    parser.add_argument("--masses", type=int, nargs="+", default=[2, 1, 3], choices=sorted(MASSES))
    parser.add_argument("--noise", nargs="+", default=list(NOISES), choices=list(NOISES))
    parser.add_argument(
        "--methods", nargs="+", default=["nominal", "cubic", "auto", "auto, positions to 5 cm"]
    )
    parser.add_argument(
        "--peers",
        default=os.environ.get("MAGBRIDGE_PEERS", ""),
        help="interpreter that has magyc and MAVProxy",
    )
    parser.add_argument(
        "--peer-seeds",
        type=int,
        default=40,
        help="gliders that the peers are given (12 s each): two masses, first noise",
    )
    add_engine(parser)
    parser.add_argument("--out", type=Path, help="folder for accuracy.csv and accuracy.txt")
    return parser.parse_args()


def main() -> None:
    chosen = arguments()
    console = Console(width=150, record=True)
    if not chosen.peers:
        console.print(
            "magyc and MAVProxy's magfit are left out: no --peers interpreter (tools/peers.py says how)"
        )
    cases = [
        Case(
            seed,
            noise,
            masses,
            tuple(chosen.methods),
            chosen.peers * (masses == 2 and noise == chosen.noise[0] and seed < chosen.peer_seeds),
        )
        for masses, noise, seed in product(chosen.masses, chosen.noise, range(chosen.seeds))
    ]
    rows = [row for some in in_order(run, [(case,) for case in cases], chosen) for row in some]
    show(rows, console)
    if chosen.out:
        chosen.out.mkdir(parents=True, exist_ok=True)
        (chosen.out / "accuracy.txt").write_text(console.export_text())
        with (chosen.out / "accuracy.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerows([Row._fields, *rows])


if __name__ == "__main__":
    main()
