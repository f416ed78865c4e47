"""How well the navigator holds a position: simulated gliders and maps, with the bound and with peers.

    python tools/navigation.py [--runs 100] [--part accuracy] ... [--keep DIR] [--peers PYTHON] [--data DIR]

accuracy      error over the posterior Cramér-Rao bound, lost runs, consistency, for narrow and wide starts,
              with the remaining errors of an auto calibration
nominal       the same, with the remaining errors of a nominal calibration
watch         how long a wrong position counts as valid
misinformed   whether a position counts as valid when the level is wrong, or half of the map is
unmapped      surveys without a map: a glider's of 6 and 12 h, an aircraft's of 100 minutes, with the bound
smoothed      the same flights on a rough map and on that map without its short waves
dived         gliders that dive under a map flown 90 m above the sea, without and with its continuation
calibrations  simulated gliders, each calibrated by nominal, cubic and auto, that fly the same survey
speed         one update, 100,000 samples, the start
peers         Stone Soup (stone_soup.py there) on the same measurements; MagNav.jl's published flight

A run takes about a second; accuracy with 100 runs a row takes a quarter of an hour on a free core. With
``--keep`` finished rows are kept in a folder and used again.

The columns of the accuracy tables, from the errors of the second half of each run:

DRMS m        median over the runs of the error's root mean square
ratio         median over the runs of that, over the bound **of the same run** (its track, map and noise)
90 %          the same ratio's 90th percentile
RMS ratio     root mean square error of all runs together over that of all bounds: 1 for an efficient
              estimator. The median is below it, because the errors within a run are correlated, so that its
              RMS scatters widely about its bound
alone m       median of the error of dead reckoning alone
lost %        the truth was outside the 99.99 % ellipse for half an hour on end
NEES/2        mean of the squared error over its covariance, 1 when consistent; then how many of 4 instants
              have the mean of the runs within its 99 % chi-square limits
false alarm % the filter reported to be lost, and was not
valid %       of the time
after h       median over the runs of when its position was first valid
"""

from __future__ import annotations

import argparse
import os
import time as clock
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from pickle import dumps, loads
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace as with_options
from navigation_studies.calibrated import Flown, flown
from navigation_studies.dived import dived
from navigation_studies.lost import LEVEL, carried, half, level, misled
from navigation_studies.others import magnav, stone_soup
from navigation_studies.simulated import (
    AT_HOURS,
    GLIDER,
    LEFT,
    PLACE,
    SPEEDS,
    START,
    Map,
    Score,
    sail,
    synthetic,
    track_over,
)
from navigation_studies.smoothed import ROUGH, WAVELENGTHS, on_smoothed
from navigation_studies.unmapped import AIRCRAFT, Located, located
from navigation_studies.unmapped import GLIDER as UNMAPPED
from scipy.stats import chi2
from studies import command_line
from study_worlds import METHODS

from magbridge.navigate.batch import navigate
from magbridge.navigate.model import Block, prior, transition
from magbridge.navigate.tracker import Tracker

Table = list[Sequence[str]]
MAPS = (Map(60, 2000), Map(60, 800), Map(20, 1000), Map(20, 1000, rough=True), Map(5, 1000), Map(1, 2000))
STARTS = {"narrow": 0.2, "wide": 1.0}
"""1-sigma of the first position, in correlation lengths of the map."""


class Runs(NamedTuple):
    """How runs are made: number of processors, runs in a row, and the folder that keeps them, if any."""

    pool: ProcessPoolExecutor
    number: int
    keep: Path | None

    def __call__(self, run: partial[Any], first: int = 0) -> list[Any]:
        """Return `run` of `first` and the numbers after it; from the folder if they were made before."""
        row = f"{run.func.__name__} {run.args} {self.number} {first}"
        kept = self.keep / sha256(row.encode()).hexdigest()[:16] if self.keep else None
        if kept and kept.exists():
            made: list[Any] = loads(kept.read_bytes())
            return made
        made = list(self.pool.map(run, range(first, first + self.number)))
        if kept:
            kept.write_bytes(dumps(made))
        return made


# ---- accuracy, and what calibration buys -------------------------------------------------------------------

HEADER = (
    "map, start", "DRMS m", "bound m", "ratio", "90 %", "RMS ratio", "alone m", "lost %", "NEES/2",
    "in limits", "false alarm %", "valid %", "after h", "ms/sample",
)  # fmt: skip


def one(kind: Map, slow: float, start: float, seed: int) -> Score:
    grid = synthetic(kind, seed % 10)
    options = with_options(GLIDER, bias_sigma=slow, start_sigma=start * grid.correlation_length)
    return sail(track_over(grid, options, 1000 + seed, speed=SPEEDS[seed % 3]), grid, options).score()


def row(label: str, runs: Sequence[Score]) -> list[str]:
    """Return one line of the accuracy table."""
    drms, bound, nees = np.array([(run.drms, run.bound, run.nees) for run in runs]).T
    at_hours = np.mean([run.at_hours for run in runs], axis=0)
    low, high = chi2.ppf([0.005, 0.995], 2 * len(runs)) / len(runs)
    return [
        label,
        f"{np.median(drms):.0f}",
        f"{np.median(bound):.0f}",
        f"{np.median(drms / bound):.2f}",
        f"{np.percentile(drms / bound, 90):.2f}",
        f"{np.sqrt(np.mean(drms**2) / np.mean(bound**2)):.2f}",
        f"{np.median([run.unaided for run in runs]):.0f}",
        f"{100 * np.mean([run.lost for run in runs]):.0f}",
        f"{nees.mean():.2f}",
        f"{np.sum((at_hours > low) & (at_hours < high))}/{len(AT_HOURS)}",
        f"{100 * np.mean([run.false_alarm for run in runs]):.0f}",
        f"{100 * np.mean([run.valid for run in runs]):.0f}",
        f"{np.median([run.waited for run in runs]):.1f}",
        f"{1e3 * np.mean([run.seconds for run in runs]):.2f}",
    ]


def accuracy(runs: Runs, _asked: argparse.Namespace, left: str = "auto") -> None:
    """Narrow and wide starts on every map, with the remaining errors of a calibration."""
    slow = LEFT[left]
    print(
        f"\n## Accuracy with {left}: {runs.number} runs of 6 h a row, {min(SPEEDS)} to {max(SPEEDS)} m/s;"
        f" 1 nT white, {slow:g} nT slow, map error 1 nT, current 0.05 m/s\n"
    )
    table: Table = [HEADER]
    for kind in MAPS:
        for start, share in STARTS.items():
            label = f"{kind}; {start} {share * synthetic(kind, 0).correlation_length:.0f} m"
            table.append(row(label, runs(partial(one, kind, slow, share))))
            show(table)


def calibrations(runs: Runs, _asked: argparse.Namespace) -> None:
    """Calibrate gliders, and fly the same survey over the same map with each calibration."""
    kinds = (Map(60, 2000), Map(20, 1000))
    print(
        "\n"
        f"## What calibration buys: {runs.number} gliders, their own calibration runs and survey of 6 h; "
        "start within a length\n"
    )
    found: list[dict[tuple[int, str], Flown]] = runs(partial(flown, kinds))
    table: Table = [("calibration", "error nT", "claimed nT", *HEADER)]
    for k, kind in enumerate(kinds):
        for method in METHODS:
            made = [glider[k, method] for glider in found]
            errors = [f"{e:.1f}" for e in np.median([(m.error, m.claimed) for m in made], axis=0)]
            table.append((method, *errors, *row(str(kind), [m.score for m in made])))
            show(table)


# ---- whether a lost filter reports it


def watch(runs: Runs, _asked: argparse.Namespace) -> None:
    """How soon a wrong position no longer counts as valid."""
    print(
        "\n"
        f"## A lost filter reports it: {runs.number} runs of 6 h a row. Lost: the truth is outside the "
        "99.99 % ellipse, and a quarter of\n"
        "a correlation length away or more. Flagged: its position is no longer valid\n"
    )
    table: Table = [("how, map", "lost %", "flagged in 30 min %", "95 % within min", "found in 2 h %")]
    for how in (carried, misled):
        for kind in MAPS[:4]:
            spans = np.array(runs(partial(how, kind)))
            lost = spans[spans[:, 1] > 0.0]
            shares = (
                (np.mean(lost[:, 0] <= 0.5), np.mean(lost[:, 1] <= 2.0)) if len(lost) else (np.nan, np.nan)
            )
            within = 60.0 * np.percentile(lost[:, 0], 95) if len(lost) else np.nan
            table.append(
                (
                    f"{how.__name__}; {kind}",
                    f"{100 * len(lost) / len(spans):.0f}",
                    f"{100 * shares[0]:.0f}",
                    f"{within:.0f}",
                    f"{100 * shares[1]:.0f}",
                )
            )
            show(table)


def misinformed(runs: Runs, _asked: argparse.Namespace) -> None:
    """Whether a position counts as valid when the map or the calibration is worse than it claims."""
    print(
        "\n"
        f"## Told wrong: {runs.number} runs of 6 h a row, on a field {LEVEL:g} nT off, or of which the map "
        "knows half the variance.\n"
        "Share of the time in which a right position counts as valid, and a wrong one\n"
    )
    table: Table = [("how, map", "rightly %", "wrongly %", "95 % of runs, wrongly %")]
    for how in (level, half):
        for kind in MAPS[:4]:
            right, wrong = 100 * np.array(runs(partial(how, kind))).T
            cells = (right.mean(), wrong.mean(), np.percentile(wrong, 95))
            table.append((f"{how.__name__}; {kind}", *(f"{cell:.1f}" for cell in cells)))
            show(table)


def dives(runs: Runs, _asked: argparse.Namespace) -> None:
    """Measure the cost of using a map at its own altitude for the field below it."""
    print(
        "\n"
        f"## Under a map from 90 m up: {runs.number} worlds, 4 h, dives of 140 m, a crustal field "
        "of 54 nT from 350 m down\n"
    )
    found = np.array(runs(partial(dived)))
    table: Table = [("map", "error m: median", "90 %", "worst", "NEES/2", "valid %")]
    for name, column in zip(
        ("as it was flown", "at the glider's depth"), found.transpose(1, 2, 0), strict=True
    ):
        error, nees, valid = column
        cells = (np.median(error), np.percentile(error, 90), error.max())
        ends = f"{np.median(nees):.2f}", f"{100 * valid.mean():.0f}"
        table.append((name, *(f"{cell:.0f}" for cell in cells), *ends))
        show(table)


def on_smoothed_maps(runs: Runs, asked: argparse.Namespace) -> None:
    """What smoothing a map costs, and whether the position's sigma knows."""
    print(f"\n## On a smoothed map: {runs.number} runs of 6 h, {ROUGH}; start within 0.2 lengths\n")
    found: list[tuple[Score, ...]] = runs(partial(on_smoothed), asked.first)
    table: Table = [HEADER]
    for name, made in zip(WAVELENGTHS, zip(*found, strict=True), strict=True):
        table.append(row(f"without waves below {name:.0f} m" if name else "as it is", made))
        show(table)


def unmapped(runs: Runs, asked: argparse.Namespace) -> None:
    """Localise surveys in their own field, with the bound of localisation and mapping at once."""
    print(
        "\n"
        f"## Without a map: {runs.number} surveys a row (aircraft: a quarter), RMS in m over track and runs;"
        "\nworse: those farther off than dead reckoning alone, and those of them beyond twice their sigma\n"
    )
    header = "bound", "error", "alone", "sigma", "NEES/2", "worse", "beyond", "valid %", "s of CPU"
    table: Table = [("map, vehicle", *header)]
    long = replace(UNMAPPED, hours=12.0)
    for name, vehicle, kinds in (
        ("6 h", UNMAPPED, (Map(30, 500), Map(30, 1000), Map(60, 500), Map(60, 1000))),
        ("6 h", UNMAPPED, (Map(30, 1000, rough=True),)),
        ("12 h", long, (Map(30, 500),)),
        ("aircraft", AIRCRAFT, (Map(60, 1500),)),
    ):
        if asked.vehicle and name not in asked.vehicle:
            continue
        number = max(runs.number // 4, 1) if vehicle is AIRCRAFT else runs.number
        for kind in kinds:
            made = runs._replace(number=number)(partial(located, vehicle, kind), asked.first)
            table.append(unmapped_row(f"{kind}; {name}", made))
            show(table)


def unmapped_row(label: str, made: Sequence[Located]) -> list[str]:
    """Return one line of the table of surveys without a map."""
    found = np.array(made)
    bound, error, alone, sigma = (np.sqrt(np.mean(found[:, k] ** 2)) for k in (3, 0, 1, 2))
    worse = found[:, 0] > found[:, 1]
    return [
        label,
        *(f"{value:.0f}" for value in (bound, error, alone, sigma)),
        f"{found[:, 4].mean():.2f}",
        f"{worse.sum()}",
        f"{(worse & (found[:, 0] > 2.0 * found[:, 2])).sum()}",
        f"{100 * found[:, 5].mean():.0f}",
        f"{found[:, 6].mean():.0f}",
    ]


# ---- speed, peers ------------------------------------------------------------------------------------------


def timings() -> tuple[float, float, float, float]:
    """Return processor seconds: an update; 100,000 samples, as blocks and singly; a sample of the start."""
    kind = Map(30, 1500)
    grid = synthetic(kind, 3, 40_000.0)
    options = with_options(GLIDER, start_sigma=50.0)
    tracker = Tracker(grid, *prior(options), options.gate)
    block = Block(int(START * 1e6), *PLACE, grid.look_up(PLACE[1], PLACE[0]).anomaly, 1.0, 0.0, 0.0)
    moved = transition(options, 4.0, 1.4)
    begun = clock.process_time()
    for _ in range(5000):
        tracker.predict(*moved)
        tracker.update(block)
    each = (clock.process_time() - begun) / 5000
    ds = track_over(grid, options, 5, hours=100_000 / 3600, every=1.0)
    whole = []
    for interval in (options.interval, 0.0):
        begun = clock.process_time()
        navigate(ds, grid, with_options(options, interval=interval), start=PLACE)
        whole.append(clock.process_time() - begun)
    blocks, singly = whole
    return each, blocks, singly, one(Map(60, 2000), 1.0, 1.0, 7).seconds


def speed(runs: Runs, _asked: argparse.Namespace) -> None:
    """Time the pieces on one core."""
    each, blocks, singly, start = runs.pool.submit(timings).result()
    print(f"\n## Speed\n\none update with its look-up   {1e6 * each:.0f} us (asked: 150)")
    print(
        f"navigate, 100,000 samples     {blocks:.1f} s; each an update of its own {singly:.1f} s (asked: 20)"
    )
    print(f"wide start, mean over 6 h     {1e3 * start:.2f} ms a sample (asked: 5)")


def peers(runs: Runs, asked: argparse.Namespace) -> None:
    """Stone Soup's filters on the same measurements, and the flight that MagNav.jl publishes."""
    if asked.peers:
        some = runs._replace(number=min(runs.number, 20))
        print(
            "\n"
            "## Stone Soup on the same measurements: DRMS (m) of the second half, NEES/2; medians of "
            f"{some.number} runs\n"
        )
        header = ("bound", "ours", "NEES/2", "EKF", "NEES/2", "20,000 particles", "NEES/2", "ms/update")
        table: Table = [("map, start", *header)]
        for kind in (Map(20, 1000), Map(60, 2000)):
            for name, share in STARTS.items():
                found = np.median(some(partial(stone_soup, asked.peers, kind, GLIDER, share)), axis=0)
                cells = (f"{cell:.0f}" if cell > 20 else f"{cell:.2f}" for cell in found)
                table.append((f"{kind}; {name}", *cells))
                show(table)
    if asked.data:
        magnav(asked.data / "magnav_example")


def show(table: Sequence[Sequence[str]]) -> None:
    """Print the head once, then each new row, in columns of one width."""
    widths = [max(34 if "map" in header else 8, len(header)) for header in table[0]]
    lines: Iterable[Sequence[str]] = table if len(table) == 2 else table[-1:]
    for line in lines:
        cells = (
            str(cell).ljust(w) if w == 34 else str(cell).rjust(w)
            for cell, w in zip(line, widths, strict=True)
        )
        print("  ".join(cells), flush=True)


PARTS: dict[str, Callable[[Runs, argparse.Namespace], None]] = {
    "accuracy": accuracy,
    "watch": watch,
    "misinformed": misinformed,
    "unmapped": unmapped,
    "smoothed": on_smoothed_maps,
    "dived": dives,
    "calibrations": calibrations,
    "nominal": partial(accuracy, left="nominal"),
    "speed": speed,
    "peers": peers,
}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first run (unmapped, smoothed)")
    parser.add_argument("--vehicle", choices=("6 h", "12 h", "aircraft"), action="append", help="of unmapped")
    parser.add_argument("--part", choices=sorted(PARTS), action="append")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder in which rows that are done are kept")
    parser.add_argument("--peers", help="a Python interpreter that has Stone Soup")
    parser.add_argument("--data", type=Path, help="folder of measured data, with magnav_example in it")
    asked = parser.parse_args()
    if asked.keep:
        asked.keep.mkdir(parents=True, exist_ok=True)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the workers: their matrices are small
    with ProcessPoolExecutor(asked.workers, get_context("spawn")) as pool:
        for name in asked.part or PARTS:
            PARTS[name](Runs(pool, asked.runs, asked.keep), asked)


if __name__ == "__main__":
    main()
