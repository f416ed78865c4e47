"""The twin of the Bonne Bay trials beside the paper: its Tables 1 and 2, and the like of Figures 2 to 6.

The twin's glider flies the paper's runs among rock of its own, from a boat at -10 degC into water at
2 degC. It is calibrated on each trial's spirals (against the IGRF and the aeromagnetic map, as in the paper),
and the survey between them is corrected with either calibration. Only the sizes in
``sitl/scenarios/bonne_bay.toml`` were fitted to the paper; the default seed draws a world that comes near it.

    python tools/bonne_bay.py --out bonne_bay/
    python tools/bonne_bay.py --seeds 20           # the same tables as medians over 20 worlds
    python tools/bonne_bay.py --at-depth           # against the map continued down to the glider
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr
from bonne_bay_figures import draw
from bonne_bay_trials import METHODS, PAPER, TRIALS, Trials, fly
from rich.console import Console
from rich.progress import track
from rich.table import Table
from terminal import command_line, table

from magbridge.calibration.residual import rms
from sitl.mission import TABLE_1

SEED = 29


def table_1(flight: Trials) -> Table:
    """Return the paper's calibration runs beside the twin's."""
    one = table(
        "Table 1: calibration runs, paper and twin",
        "run", "", "ballast cm³", "pitch deg: paper", "twin", "battery in: trial 1", "twin", "trial 2",
        "twin",
    )  # fmt: skip
    for number, pitch, *battery in TABLE_1:
        legs = [_leg(flight.parts[trial], number) for trial in TRIALS]
        one.add_row(
            str(number),
            "dive" if pitch < 0 else "climb",
            f"{legs[0]['ballast'].mean():.0f}",
            f"{pitch:.0f}",
            f"{legs[0]['pitch'].mean():.1f}",
            *(
                text
                for p, leg in zip(battery, legs, strict=True)
                for text in (f"{p:.3f}", f"{leg['battpos'].mean():.3f}")
            ),
        )
    return one


def table_2(flights: list[Trials]) -> Table:
    """Return each method's RMS on runs and survey, in the paper and in the twin."""
    many = f", median of {len(flights)} worlds" if len(flights) > 1 else ""
    two = table(
        f"Table 2: RMS nT against the IGRF and the map{many}",
        "", "runs: paper", "twin", "survey: paper", "twin", "to the truth", "without its mean", "scales",
    )  # fmt: skip
    for trial in TRIALS:
        for method in METHODS:
            good = [flight for flight in flights if (trial, method) not in flight.failed]
            name = f"{trial}, {method}" + (
                f" ({len(good)} of {len(flights)})" if len(good) < len(flights) else ""
            )
            if not good:
                two.add_row(name, flights[0].failed[trial, method])
                continue
            runs, survey = (f"{value}" for value in PAPER.get((trial, method), ("", "")))
            on_runs, on_survey, error, spread, scales = _medians(good, trial, method)
            two.add_row(name, runs, on_runs, survey, on_survey, error, spread, scales)
        two.add_section()
    return two


def _medians(good: list[Trials], trial: str, method: str) -> tuple[str, ...]:
    """Return RMS on runs and survey, the error's RMS and standard deviation, and the range of the scales."""
    errors = [flight.error("survey", trial, method, "truth_total_field") for flight in good]
    figures = (
        [flight.rms(trial, trial, method) for flight in good],
        [flight.rms("survey", trial, method) for flight in good],
        [rms(error) for error in errors],
        [np.std(error) for error in errors],
    )
    ends = [np.median([flight.scales[trial, method][end] for flight in good]) for end in (0, 1)]
    return *(f"{np.median(values):.1f}" for values in figures), " to ".join(f"{end:.2f}" for end in ends)


def tables(flights: list[Trials], console: Console) -> None:
    """Print the paper's tables beside the twin's."""
    console.print(table_1(flights[0]))
    console.print(table_2(flights))
    surveys = [flight.parts["survey"] for flight in flights]
    off = np.median([np.sqrt(np.mean((s["truth_total_field"] - s["reference_field"]) ** 2)) for s in surveys])
    console.print(
        f"The reference itself is {off:.0f} nT RMS off on the survey, because the map was made from 90 m "
        "up. A calibration\n"
        "takes the map's mean error over the spirals for field. Scales are those of A on the runs: a fit "
        "that shrinks\n"
        "the field shrinks its errors, and every anomaly with them."
    )


def by_world(flights: list[Trials], seeds: Iterable[int], console: Console) -> None:
    """Print every world's RMS on runs and survey, and whether it bears the paper's signature."""
    columns = (f"{trial[-1]}, {method}" for trial in TRIALS for method in METHODS)
    shown = table("World by world: RMS nT on the runs / on the survey", "seed", *columns, "signature")
    borne = 0
    for seed, flight in zip(seeds, flights, strict=True):
        lacking = signature(flight)
        borne += not lacking
        shown.add_row(
            str(seed),
            *(
                "refused"
                if (trial, method) in flight.failed
                else f"{flight.rms(trial, trial, method):.0f} / {flight.rms('survey', trial, method):.0f}"
                for trial in TRIALS
                for method in METHODS
            ),
            lacking or "yes",
        )
    console.print(shown)
    console.print(
        "the paper's signature (nominal far off; a parameterised fit at least twice as good on its runs as "
        f"on the survey; trial 1's survey worse than trial 2's): {borne} of {len(flights)} worlds"
    )


def signature(flight: Trials) -> str:
    """Return which part of the paper's signature a world lacks, if any; cubic's, or auto's if that failed."""
    method = "auto" if any((trial, "cubic") in flight.failed for trial in TRIALS) else "cubic"
    runs, survey = ([flight.rms(part or trial, trial, method) for trial in TRIALS] for part in ("", "survey"))
    if min(flight.rms(trial, trial, "nominal") for trial in TRIALS) < 3.0 * max(runs):
        return "nominal is near"
    if any(after < 2.0 * before for before, after in zip(runs, survey, strict=True)):
        return "survey is good"
    return "" if survey[0] > survey[1] else "trial 2 is worse"


def _leg(part: xr.Dataset, number: int) -> xr.Dataset:
    return part.isel(time=part["run"] == part["run"].min() + number - 1)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument(
        "--seed", type=int, default=SEED, help="the world that is drawn, and the first of --seeds"
    )
    parser.add_argument("--seeds", type=int, default=1, help="worlds")
    parser.add_argument("--at-depth", action="store_true", help="continue the map down to the glider")
    parser.add_argument("--out", type=Path, help="folder for figures and tables.txt")
    chosen = parser.parse_args()
    console = Console(width=134, record=True)
    seeds = range(chosen.seed, chosen.seed + chosen.seeds)
    flights = [
        fly(seed, at_depth=chosen.at_depth) for seed in track(seeds, "worlds", console=Console(stderr=True))
    ]
    tables(flights, console)
    if chosen.seeds > 1:
        by_world(flights, seeds, console)
    if chosen.out:
        for file in draw(flights[0], chosen.out):
            console.print(f"wrote {file}")
        (chosen.out / "tables.txt").write_text(console.export_text())


if __name__ == "__main__":
    main()
