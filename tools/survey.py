"""How well a survey calibrates itself, and how good its map is, over random simulated gliders.

Each glider has dipoles of its own and flies a criss-cross over rock that is a random Gaussian field of a
given size and length, the same at every depth; no calibration runs, no map, the reference is the IGRF alone.
The calibration found is tested on another day's survey of the same kind; the map along the track and between
tracks, up to one length away. Printed are the corrected field's error about its mean over the noise floor
(the error of a calibration that knows the vehicle), the standardised error with the level and apart from it,
and the map's error over that of an oracle's (true calibration and rock's size and length known).

    python tools/survey.py --gliders 10 --hours 6 12
    python tools/survey.py --real ../shared/data      # rows for real surveys, where there are any
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from bound import oracle
from engine import add_engine, in_order
from rich.console import Console
from survey_real import REAL
from terminal import command_line, table

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.field_nodes import nodes_for
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.level import level_of
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import rms
from magbridge.errors import CalibrationError
from magbridge.field.igrf import igrf
from magbridge.field.place.blocks import Factor
from magbridge.field.place.matern import Matern
from magbridge.survey.read import from_vector
from magbridge.survey.run import survey
from sitl import Twin, load, segments
from sitl.dataset import at_rest
from sitl.mission import CrissCross
from sitl.platform import Vehicle

MASSES = ("battpos", "ballast")
NOISES = {"1 nT white": (1.0, 0.0), "5 nT AR(1)": (5.0, 10.0)}
"""nT of a channel, and samples over which its correlation falls by e."""
WAVES = 1500
"""Plane waves of a field."""


class GaussianRock:
    """Rock whose field is a Gaussian random field in the plane, along the main field, at every depth."""

    def __init__(self, size: float, length: float, direction: FloatArray, rng: np.random.Generator) -> None:
        self.k, self.phase = rng.normal(0, 1 / length, (WAVES, 2)), rng.uniform(0, 2 * np.pi, WAVES)
        self.size, self.direction = size * np.sqrt(2 / WAVES), direction

    def anomaly(self, place: FloatArray) -> FloatArray:
        """Return nT (n,) at places (n, 2), m north and east of the world's origin."""
        out = np.empty(len(place))
        for start in range(0, len(place), 4096):
            part = slice(start, start + 4096)
            out[part] = self.size * np.cos(place[part] @ self.k.T + self.phase).sum(axis=1)
        return out

    def field(self, ned: FloatArray) -> FloatArray:
        """Return nT (n, 3), north-east-down, as the simulated world's rock does."""
        return self.anomaly(ned[:, :2])[:, None] * self.direction


class Row(NamedTuple):
    """What one glider reached."""

    hours: float
    rock: float
    length: float
    noise: str
    seed: int
    ratio: float = np.nan
    apart: float = np.nan
    together: float = np.nan
    level: float = np.nan
    level_sigma: float = np.nan
    map_ratio: float = np.nan
    map_sigma: float = np.nan
    seconds: float = np.nan
    failed: str = ""


def fly(
    hours: float, rock: float, length: float, noise: str, seed: int
) -> tuple[Twin, dict[str, xr.Dataset]]:
    """Return a glider in its world, and its two surveys on two days."""
    sigma, memory = NOISES[noise]
    same = {"hours": hours, "pitch": (25.0, 2.5), "roll": (1.0, 2.0), "battery_spread": 0.1}
    parts = [CrissCross(**same), CrissCross(**same, segment="another day")]  # type: ignore[arg-type]
    scenario = load("random_glider").replace(
        mission=tuple(parts), instrument={"noise_sigma": sigma, "noise_memory": memory}
    )
    twin = Twin.draw(scenario, seed)
    latitude, longitude = twin.world.origin
    when = np.array([scenario.start.timestamp()])
    main = igrf(np.array([longitude]), np.array([latitude]), np.zeros(1), when)[0]
    drawn = GaussianRock(rock, length, main / np.linalg.norm(main), np.random.default_rng([seed, 7]))
    twin = replace(twin, world=replace(twin.world, rock=drawn))  # type: ignore[arg-type]
    flown = twin.fly()
    log = twin.measure(flown, np.arange(0.0, flown.elapsed[-1] - 1.0, 1 / scenario.instrument.rate))
    return twin, {name: at_rest(part, MASSES) for name, part in segments(log).items()}


def run(hours: float, rock: float, length: float, noise: str, seed: int) -> Row:
    """Fly, calibrate from the survey alone, and score."""
    twin, parts = fly(hours, rock, length, noise, seed)
    row = Row(hours, rock, length, noise, seed)
    data = observations(parts["survey"].drop_vars("reference_field"), MASSES)
    began = time.process_time()
    try:
        found = fit(data)
    except CalibrationError as refused:
        return row._replace(failed=str(refused))
    seconds = time.process_time() - began
    assert isinstance(twin.vehicle, Vehicle)
    other = parts["another day"]
    truth = other["truth_total_field"].to_numpy()
    error, sigma, level = errors(found.calibration, other)
    about = error - error.mean()
    floor = oracle(twin.vehicle, other) - truth
    map_ratio, map_sigma = score_map(twin, parts["survey"], data, found.calibration, length, rock)
    return row._replace(
        ratio=rms(about) / np.std(floor),
        apart=rms(about / np.sqrt(np.maximum(sigma**2 - level**2, 1e-6))),
        together=rms(error / sigma),
        level=float(error.mean()),
        level_sigma=float(level.mean()),
        map_ratio=map_ratio,
        map_sigma=map_sigma,
        seconds=seconds,
    )


def errors(calibration: Calibration, part: xr.Dataset) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the corrected field's error, its sigma, and the level's share of that, (n,) nT each."""
    seen = observations(part, MASSES)
    channels = seen.channels(calibration)
    got = correct(calibration, seen.field, channels, seen.time)
    level = level_of(calibration, seen.field, channels, seen.time)
    return got.total - part["truth_total_field"].to_numpy(), got.sigma, level


def score_map(
    twin: Twin, log: xr.Dataset, data: Observations, calibration: Calibration, length: float, size: float
) -> tuple[float, float]:
    """Return the map's RMS over the oracle's, and its standardised error, up to one length off the track.

    The level, which no survey knows, is the map's mean error along the track.
    """
    done = survey(from_vector(log, calibration, 0))
    assert data.place is not None
    rng = np.random.default_rng(0)
    picked = data.place[rng.integers(len(data.place), size=600), :2]
    at = picked + rng.normal(0, 0.4 * length, picked.shape)
    origin_shift = np.subtract(_world(twin, data.origin), 0.0)
    true = twin.world.rock.anomaly(at + origin_shift)  # type: ignore[attr-defined]
    shift = np.subtract(_world(twin, done.samples.origin), origin_shift)
    anomaly, sigma = done.gridded.at(at - shift)
    along = done.gridded.at(picked - shift)[0] - twin.world.rock.anomaly(picked + origin_shift)  # type: ignore[attr-defined]
    error = anomaly - true - along.mean()
    best = best_map(twin, data, at, true, length, size, origin_shift)
    return rms(error) / max(rms(best), 1e-9), rms(error / sigma)


def _world(twin: Twin, origin: tuple[float, float]) -> FloatArray:
    from magbridge.field.geodesy import separation  # noqa: PLC0415

    return np.array(separation(*twin.world.origin, *origin))


def best_map(
    twin: Twin,
    data: Observations,
    at: FloatArray,
    true: FloatArray,
    length: float,
    size: float,
    shift: FloatArray,
) -> FloatArray:
    """Return the error of the map by who knows the calibration and the rock's size and length, nT."""
    assert data.place is not None
    place = data.place[:, :2]
    rock = twin.world.rock.anomaly(place + shift)  # type: ignore[attr-defined]
    noise = twin.scenario.instrument.noise_sigma
    field = Matern(nodes_for(place, 1.5 * length, 4), 1.5 * length, 4)
    B = field.basis(place)
    read = rock + np.random.default_rng(1).normal(0, noise, len(rock))
    w = Factor(B.T @ B / noise**2 + field.precision / size**2).solve(B.T @ read / noise**2)
    return np.asarray(field.basis(at) @ w - true)


def show(rows: list[Row], console: Console) -> None:
    """Print a line for each kind of survey."""
    shown = table(
        f"surveys that calibrate themselves, {len({row.seed for row in rows})} gliders a row",
        "hours", "rock nT", "length m", "noise", "over the floor: median", "95 %", "apart: median",
        "0.8 to 1.25", "level, off over sigma: RMS", "map over oracle", "map's sigma", "s", "refused",
    )  # fmt: skip
    for key in dict.fromkeys(row[:4] for row in rows):
        mine = [row for row in rows if row[:4] == key]
        good = [row for row in mine if np.isfinite(row.ratio)]
        if not good:
            shown.add_row(*map(str, key), *[""] * 8, str(len(mine)))
            continue

        def column(name: str, of: list[Row] = good) -> FloatArray:
            return np.array([getattr(row, name) for row in of])

        apart = column("apart")
        shown.add_row(
            *(f"{value:g}" for value in key[:3]),
            key[3],
            f"{np.median(column('ratio')):.3f}",
            f"{np.quantile(column('ratio'), 0.95):.2f}",
            f"{np.median(apart):.2f}",
            f"{np.mean((apart > 0.8) & (apart < 1.25)):.0%}",
            f"{rms(column('level') / column('level_sigma')):.2f}",
            f"{np.median(column('map_ratio')):.2f}",
            f"{np.median(column('map_sigma')):.2f}",
            f"{np.median(column('seconds')):.0f}",
            str(len(mine) - len(good)),
        )
    console.print(shown)


def cases(chosen: argparse.Namespace) -> Iterator[tuple[float, float, float, str, int]]:
    """Yield every kind of survey with every glider."""
    yield from product(chosen.hours, chosen.rock, chosen.length, chosen.noise, range(chosen.gliders))


def arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = command_line(__doc__)
    parser.add_argument("--gliders", type=int, default=10, help="a row")
    parser.add_argument("--hours", type=float, nargs="+", default=[6.0, 12.0])
    parser.add_argument("--rock", type=float, nargs="+", default=[8.0, 30.0, 60.0], help="nT RMS")
    parser.add_argument("--length", type=float, nargs="+", default=[500.0, 1000.0, 1500.0], help="m")
    parser.add_argument("--noise", nargs="+", default=list(NOISES), choices=list(NOISES))
    parser.add_argument("--real", type=Path, help="folder of real surveys, instead of gliders")
    parser.add_argument("--out", type=Path, help="CSV of all gliders")
    add_engine(parser)
    return parser.parse_args()


def main() -> None:
    chosen = arguments()
    console = Console(width=190)
    if chosen.real:
        for name, row in REAL.items():
            console.print(name, *row(chosen.real))
        return
    todo = list(cases(chosen))
    rows = in_order(run, todo, chosen)
    show(rows, console)
    if chosen.out:
        with chosen.out.open("w", newline="") as file:
            csv.writer(file).writerows([Row._fields, *rows])


if __name__ == "__main__":
    main()
