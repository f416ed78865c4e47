"""How well a survey calibrates itself, and how good its map is, over random simulated gliders.

Each glider has dipoles of its own and flies a criss-cross over rock that is a random Gaussian field of a
given size and length, the same at every depth; no calibration runs, no map, the reference is the IGRF alone.
The calibration found is tested on another day's survey of the same kind; the map along the track and between
tracks, up to one length away. Printed are the corrected field's error about its mean over the noise floor
(the error of a calibration that knows the vehicle), the standardised error with the level and apart from it,
and the map's error over that of an oracle's (true calibration and rock's size and length known), beside the
least that one could reach who knows all that the oracle knows but the vehicle.

    python tools/survey.py --gliders 10 --hours 6 12
    python tools/survey.py --real ../shared/data      # rows for real surveys, where there are any
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from bound import SurveyBound, oracle
from engine import add_engine, as_done
from rich.console import Console
from survey_map import score_map
from survey_real import REAL
from survey_world import MASSES, NOISES, drifted, fly
from terminal import command_line, table

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.level import level_of
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import rms
from magbridge.errors import CalibrationError
from magbridge.field.geodesy import separation
from sitl.platform import Vehicle

DRIFTS = 100.0
"""m, by how much a fit is told that positions drift, where they do."""


class Row(NamedTuple):
    """What one glider reached; NaN where it was not asked for."""

    hours: float
    rock: float
    length: float
    noise: str
    drift: float
    seed: int
    ratio: float = np.nan
    bound: float = np.nan
    runs: float = np.nan
    apart: float = np.nan
    together: float = np.nan
    level: float = np.nan
    level_sigma: float = np.nan
    map_along: float = np.nan
    map_off: float = np.nan
    map_along_bound: float = np.nan
    map_off_bound: float = np.nan
    sigma_along: float = np.nan
    sigma_off: float = np.nan
    peer: float = np.nan
    seconds: float = np.nan
    failed: str = ""


def run(hours: float, rock: float, length: float, noise: str, drift: float, seed: int) -> Row:
    """Fly, calibrate from the survey alone and from ten runs with the true field, and score."""
    twin, parts = fly(hours, rock, length, noise, seed)
    row = Row(hours, rock, length, noise, drift, seed)
    log = drifted(parts["survey"], drift) if drift else parts["survey"]
    began = time.process_time()
    try:
        data = observations(log.drop_vars("reference_field"), MASSES)
        options: dict[str, Any] = {"position_sigma": DRIFTS} if drift else {}
        found = fit(data, **options).calibration
    except CalibrationError as refused:
        return row._replace(failed=str(refused))
    seconds = time.process_time() - began
    assert isinstance(twin.vehicle, Vehicle)
    other = parts["another day"]
    error, sigma, level = errors(found, other)
    about = error - error.mean()
    floor = float(np.std(oracle(twin.vehicle, other) - other["truth_total_field"].to_numpy()))
    with_runs, _, _ = errors(fit(observations(parts["calibration"], MASSES)).calibration, other)
    seen = parts["survey"]
    where = seen["latitude"].to_numpy(), seen["longitude"].to_numpy()
    place = np.stack(separation(*twin.world.origin, *where), axis=1)
    best = SurveyBound(twin.vehicle, seen, place, (rock, length), NOISES[noise])
    row = row._replace(
        ratio=rms(about) / floor,
        bound=best.of_field(other),
        runs=float(np.std(with_runs)) / floor,
        apart=rms(about / np.sqrt(np.maximum(sigma**2 - level**2, 1e-6))),
        together=rms(error / sigma),
        level=float(error.mean()),
        level_sigma=float(level.mean()),
        seconds=seconds,
    )
    if drift:  # the map is drawn along the track as it was logged
        return row
    mapped = score_map(twin, log, found, (rock, length), best)
    return row._replace(
        map_along=mapped.along, map_off=mapped.off, map_along_bound=mapped.bound_along,
        map_off_bound=mapped.bound_off, sigma_along=mapped.sigma_along, sigma_off=mapped.sigma_off,
        peer=mapped.peer,
    )  # fmt: skip


def errors(calibration: Calibration, part: xr.Dataset) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the corrected field's error, its sigma, and the level's share of that, (n,) nT each."""
    seen = observations(part, MASSES)
    channels = seen.channels(calibration)
    got = correct(calibration, seen.field, channels, seen.time)
    level = level_of(calibration, seen.field, channels, seen.time)
    return got.total - part["truth_total_field"].to_numpy(), got.sigma, level


COLUMNS = {
    "ratio": "over the floor: median", "bound": "bound", "runs": "ten runs", "apart": "apart: median",
    "map_along": "map over oracle: along", "map_along_bound": "bound", "map_off": "between",
    "map_off_bound": "bound", "sigma_along": "over sigma: along",
    "sigma_off": "between", "peer": "harmonica over ours", "seconds": "s",
}  # fmt: skip
"""Of the table: medians over the gliders."""


def show(rows: list[Row], console: Console) -> None:
    """Print a line for each kind of survey."""
    shown = table(
        f"surveys that calibrate themselves, {len({row.seed for row in rows})} gliders",
        "h", "rock nT", "m", "noise", "drift m", "gliders", *COLUMNS.values(), "95 %", "0.8 to 1.25",
        "level, off over sigma: RMS", "refused",
    )  # fmt: skip
    for key in dict.fromkeys(row[:5] for row in rows):
        mine = [row for row in rows if row[:5] == key]
        good = [row for row in mine if not row.failed]

        def column(name: str, of: list[Row] = good) -> FloatArray:
            return np.array([getattr(row, name) for row in of] or [np.nan])

        apart = column("apart")
        shown.add_row(
            *map(str, key),
            str(len(mine)),
            *(f"{np.median(column(name)):.{2 if name != 'seconds' else 1}f}" for name in COLUMNS),
            f"{np.quantile(column('ratio'), 0.95):.2f}",
            f"{np.mean((apart > 0.8) & (apart < 1.25)):.0%}",
            f"{rms(column('level') / column('level_sigma')):.2f}",
            str(len(mine) - len(good)),
        )
    console.print(shown)


def kept(path: Path | None) -> list[Row]:
    """Return the gliders that a CSV has."""
    if path is None or not path.exists():
        return []
    with path.open(newline="") as file:
        of: dict[str, Callable[[str], Any]] = {"seed": int, "noise": str, "failed": str}
        return [Row(**{k: of.get(k, float)(v) for k, v in one.items()}) for one in csv.DictReader(file)]


def keep(row: Row, path: Path) -> None:
    """Add a glider to a CSV."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        csv.writer(file).writerows([Row._fields, row] if new else [row])


def cases(chosen: argparse.Namespace) -> Iterator[tuple[float, float, float, str, float, int]]:
    """Yield every kind of survey with every glider, glider by glider."""
    first = chosen.first
    for seed in range(first, first + chosen.gliders):
        for kind in product(chosen.hours, chosen.rock, chosen.length, chosen.noise, chosen.drift):
            yield (*kind, seed)


def arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = command_line(__doc__)
    parser.add_argument("--gliders", type=int, default=10, help="a row")
    parser.add_argument("--hours", type=float, nargs="+", default=[6.0, 12.0])
    parser.add_argument("--rock", type=float, nargs="+", default=[8.0, 30.0, 60.0], help="nT RMS")
    parser.add_argument("--length", type=float, nargs="+", default=[500.0, 1000.0, 1500.0], help="m")
    parser.add_argument("--noise", nargs="+", default=list(NOISES), choices=list(NOISES))
    parser.add_argument("--drift", type=float, nargs="+", default=[0.0], help="m, by which positions are off")
    parser.add_argument("--first", type=int, default=0, help="number of the first glider")
    parser.add_argument("--real", type=Path, help="folder of real surveys, instead of gliders")
    parser.add_argument("--out", type=Path, help="CSV of all gliders; those it has are not flown again")
    add_engine(parser)
    return parser.parse_args()


def main() -> None:
    chosen = arguments()
    console = Console(width=190)
    if chosen.real:
        for name, row in REAL.items():
            console.print(name, *row(chosen.real))
        return
    rows = kept(chosen.out)
    todo = [case for case in cases(chosen) if case not in {row[:6] for row in rows}]
    for _, flown in as_done(run, todo, chosen):
        rows.append(flown.result())
        if chosen.out:
            keep(rows[-1], chosen.out)
    show(sorted(rows), console)


if __name__ == "__main__":
    main()
