"""The twin of the Bonne Bay trials beside the paper: its Tables 1 and 2, and the equivalents of its Figures 2 to 6.

The twin's glider flies the paper's runs among rock of its own, from a boat at -10 degC into water at 2 degC. Each
trial's spirals calibrate (against the IGRF and the aeromagnetic map, which is all that anyone has), and the survey
between them is corrected with either. Nothing here was fitted to the paper but the sizes in
``sitl/scenarios/bonne_bay.toml``; of the worlds that could be drawn, the default seed is one that comes near it.

    python tools/bonne_bay.py --out bonne_bay/
    python tools/bonne_bay.py --seeds 20           # the same tables as medians over 20 worlds
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

from magbridge.columns import CHANNELS
from magbridge.field.igrf import total_field
from sitl.bonne_bay import METHODS, PAPER, TRIALS, Trials, fly
from sitl.mission import TABLE_1

SEED = 29
INK = {"nominal": "#c9a227", "cubic": "#1f77a4", "auto": "#b3315c", "local": "#1b1b1b", "igrf": "#8a8a8a"}
NAMES = {"nominal": "nominal", "cubic": "cubic", "auto": "auto"}


def tables(flights: list[Trials], console: Console) -> None:
    """Print the paper's tables beside the twin's."""
    one = Table(title="Table 1: calibration runs, paper and twin", title_justify="left")
    for heading in (
        "run",
        "",
        "ballast cm³",
        "pitch deg: paper",
        "twin",
        "battery in: trial 1",
        "twin",
        "trial 2",
        "twin",
    ):
        one.add_column(heading, justify="right")
    for number, pitch, *battery in TABLE_1:
        legs = [_leg(flights[0].parts[trial], number) for trial in TRIALS]
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
    console.print(one)
    many = f", median of {len(flights)} worlds" if len(flights) > 1 else ""
    two = Table(title=f"Table 2: RMS nT against the IGRF and the map{many}", title_justify="left")
    for heading in ("", "runs: paper", "twin", "survey: paper", "twin", "to the truth", "without its mean"):
        two.add_column(heading, justify="left" if not heading else "right")
    for trial in TRIALS:
        for method in METHODS:
            good = [flight for flight in flights if (trial, method) not in flight.failed]
            name = f"{trial}, {NAMES[method]}" + (
                f" ({len(good)} of {len(flights)})" if len(good) < len(flights) else ""
            )
            if not good:
                two.add_row(name, flights[0].failed[trial, method])
                continue
            runs, survey = (f"{value}" for value in PAPER.get((trial, method), ("", "")))
            errors = [flight.error("survey", trial, method, "truth_total_field") for flight in good]
            two.add_row(
                name,
                runs,
                f"{np.median([flight.rms(trial, trial, method) for flight in good]):.1f}",
                survey,
                f"{np.median([flight.rms('survey', trial, method) for flight in good]):.1f}",
                f"{np.median([np.sqrt(np.mean(error**2)) for error in errors]):.1f}",
                f"{np.median([np.std(error) for error in errors]):.1f}",
            )
        two.add_section()
    console.print(two)
    surveys = [flight.parts["survey"] for flight in flights]
    off = np.median([np.sqrt(np.mean((s["truth_total_field"] - s["reference_field"]) ** 2)) for s in surveys])
    console.print(
        f"The map itself is {off:.0f} nT RMS off on the survey: it was made from 90 m up. What it is off where the\n"
        "spirals were flown, a calibration takes for the field: the mean of its error."
    )


def by_world(flights: list[Trials], seeds: Iterable[int], console: Console) -> None:
    """Print every world's RMS on runs and survey, and whether it bears the paper's signature."""
    table = Table(title="World by world: RMS nT on the runs / on the survey", title_justify="left")
    for heading in (
        "seed",
        *(f"{trial[-1]}, {method}" for trial in TRIALS for method in METHODS),
        "signature",
    ):
        table.add_column(heading, justify="right")
    borne = 0
    for seed, flight in zip(seeds, flights, strict=True):
        lacking = signature(flight)
        borne += not lacking
        table.add_row(
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
    console.print(table)
    console.print(
        f"the paper's signature (nominal far off; a parameterised fit at least twice as good on its runs as on the "
        f"survey; trial 1's survey worse than trial 2's): {borne} of {len(flights)} worlds"
    )


def signature(flight: Trials) -> str:
    """Return which part of the paper's signature a world lacks, nothing if it has all; by cubic, or auto if refused."""
    method = "auto" if any((trial, "cubic") in flight.failed for trial in TRIALS) else "cubic"
    runs, survey = ([flight.rms(part or trial, trial, method) for trial in TRIALS] for part in ("", "survey"))
    if min(flight.rms(trial, trial, "nominal") for trial in TRIALS) < 3.0 * max(runs):
        return "nominal is near"
    if any(after < 2.0 * before for before, after in zip(runs, survey, strict=True)):
        return "survey is good"
    return "" if survey[0] > survey[1] else "trial 2 is worse"


def _leg(part: xr.Dataset, number: int) -> xr.Dataset:
    return part.isel(time=part["run"] == part["run"].min() + number - 1)


def draw(flight: Trials, folder: Path) -> Iterator[Path]:
    """Draw the figures, yielding each file."""
    mpl.rcParams |= {
        "font.size": 9, "axes.titlesize": 10, "axes.titleweight": "bold", "axes.titlelocation": "left",
        "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6, "lines.linewidth": 0.8,
        "legend.frameon": False, "savefig.dpi": 160, "figure.constrained_layout.use": True,
    }  # fmt: skip
    drawings = {
        "figure_2_map": _figure_2,
        "figure_3_nominal": _figure_3,
        "figure_4_parameterised": _figure_4,
        "figure_5_survey": _figure_5,
        "figure_6_anomaly": _figure_6,
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, drawing in drawings.items():
        figure = drawing(flight)
        figure.savefig(folder / f"{name}.png")
        plt.close(figure)
        yield folder / f"{name}.png"


def _figure_2(flight: Trials) -> Figure:
    figure, axes = plt.subplots(figsize=(6.6, 5.6))
    grid, survey = flight.anomaly, flight.parts["survey"]
    scale = float(np.quantile(np.abs(grid.anomaly), 0.98))
    shade = axes.pcolormesh(
        grid.longitude, grid.latitude, grid.anomaly, cmap="RdBu_r", vmin=-scale, vmax=scale, shading="gouraud"
    )
    axes.plot(survey["longitude"], survey["latitude"], color="black", label="survey")
    for trial, marker, size in zip(TRIALS, "x+", (6, 10), strict=True):  # both stand at one place
        part = flight.parts[trial].isel(time=slice(0, None, 90))
        axes.plot(
            part["longitude"],
            part["latitude"],
            marker,
            color="black",
            markersize=size,
            markeredgewidth=0.6,
            label=trial,
        )
    _frame(axes, survey)
    axes.legend(loc="upper right", facecolor="white", frameon=True, edgecolor="none")
    figure.colorbar(shade, label="anomaly, nT, 90 m above the water", shrink=0.8)
    axes.set_title("Calibration spirals and survey on the aeromagnetic map")
    return figure


def _figure_3(flight: Trials) -> Figure:
    figure, panels = plt.subplots(2, 2, figsize=(9, 5), sharex="col", sharey="row", height_ratios=(1, 1))
    for (raw_panel, panel), trial in zip(panels.T, TRIALS, strict=True):
        part = flight.parts[trial]
        hours = _hours(part)
        raw_panel.plot(
            hours, np.sqrt(sum(part[n] ** 2 for n in CHANNELS)) / 1e3, ".", markersize=1.2, color="#777777"
        )
        raw_panel.set_title(f"Trial {trial[-1]}: raw")
        panel.set_title("corrected")
        panel.plot(
            hours,
            flight.corrected[trial, trial, "nominal"],
            ".",
            markersize=1.2,
            color=INK["nominal"],
            label="nominal",
        )
        _references(panel, part)
        _runs(panel, part)
        panel.set_xlabel("hours since the first dive")
    panels[0, 0].set_ylabel("total field, µT")
    panels[1, 0].set_ylabel("total field, nT")
    _legend(panels[1, 1])
    return figure


def _figure_4(flight: Trials) -> Figure:
    figure, panels = plt.subplots(2, 1, figsize=(9, 6.2), sharex=True, sharey=True)
    for panel, trial in zip(panels, TRIALS, strict=True):
        part = flight.parts[trial]
        for method in METHODS:
            if (trial, trial, method) in flight.corrected:
                label = f"{NAMES[method]}: {flight.rms(trial, trial, method):.0f} nT"
                panel.plot(
                    _hours(part),
                    flight.corrected[trial, trial, method],
                    ".",
                    markersize=1.2,
                    color=INK[method],
                    label=label,
                )
        _references(panel, part)
        _runs(panel, part)
        panel.set_title(f"Trial {trial[-1]}")
        panel.set_ylabel("total field, nT")
        _legend(panel)
    panels[1].set_xlabel("hours since the first dive")
    return figure


def _figure_5(flight: Trials) -> Figure:
    figure, panels = plt.subplots(3, 1, figsize=(9, 7.4), sharex=True, height_ratios=(3, 3, 1))
    survey = flight.parts["survey"]
    hours = _hours(survey)
    for panel, trial in zip(panels, TRIALS, strict=False):
        for method in METHODS:
            if ("survey", trial, method) in flight.corrected:
                label = f"{NAMES[method]}: {flight.rms('survey', trial, method):.0f} nT"
                panel.plot(
                    hours,
                    flight.corrected["survey", trial, method],
                    color=INK[method],
                    label=label,
                    linewidth=0.5,
                )
        _references(panel, survey)
        panel.set_title(f"Survey, trial {trial[-1]}'s coefficients")
        panel.set_ylabel("total field, nT")
        _legend(panel)
    panels[0].sharey(panels[1])
    panels[2].plot(hours, survey["sensor_temperature"], color=INK["local"])
    panels[2].axhline(2.0, color=INK["igrf"], linestyle=":")
    panels[2].set_ylabel("fluxgate, °C")
    panels[2].set_xlabel("hours since the first sample of the survey")
    return figure


def _figure_6(flight: Trials) -> Figure:
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.6), sharex=True, sharey=True)
    survey = flight.parts["survey"]
    main = _main_field(survey)
    method = "cubic" if ("survey", "trial 2", "cubic") in flight.corrected else "auto"
    measured = flight.corrected["survey", "trial 2", method] - main
    mapped = survey["reference_field"] - main
    limit = float(np.quantile(np.abs(mapped), 0.995)) * 1.2
    for panel, anomaly, title in zip(
        panels,
        (measured, mapped),
        (f"Measured ({NAMES[method]}, trial 2)", "Map under the track"),
        strict=True,
    ):
        shade = panel.scatter(
            survey["longitude"],
            survey["latitude"],
            c=anomaly,
            s=5,
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
            linewidths=0,
        )
        panel.set_title(title)
        _frame(panel, survey)
    panels[1].set_ylabel("")
    figure.colorbar(shade, ax=panels, label="anomaly, nT", shrink=0.85)
    return figure


def _main_field(part: xr.Dataset) -> np.ndarray:
    return total_field(
        *(part[name].to_numpy() for name in ("longitude", "latitude", "depth")), part["time"].to_numpy()
    )


def _references(panel: Axes, part: xr.Dataset) -> None:
    panel.plot(
        _hours(part), _main_field(part), color=INK["igrf"], linewidth=1.0, linestyle="--", label="IGRF"
    )
    panel.plot(_hours(part), part["reference_field"], color=INK["local"], linewidth=1.0, label="IGRF + map")
    panel.grid(axis="y", linewidth=0.3, alpha=0.6)


def _runs(panel: Axes, part: xr.Dataset) -> None:
    """Shade every other run."""
    edges = _hours(part)[np.flatnonzero(np.diff(part["run"], prepend=0))]
    edges = np.append(edges, _hours(part)[-1])
    for left, right in zip(edges[::2], edges[1::2], strict=False):
        panel.axvspan(left, right, color="#f3f1ec", zorder=0, linewidth=0)


def _legend(panel: Axes) -> None:
    legend = panel.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, fontsize=8, borderpad=0.1, columnspacing=1.2
    )
    for handle in legend.legend_handles:
        if handle is not None and hasattr(handle, "set_markersize"):
            handle.set_markersize(6)


def _frame(axes: Axes, survey: xr.Dataset) -> None:
    latitude, longitude = survey["latitude"].to_numpy(), survey["longitude"].to_numpy()
    middle = float(latitude.mean())
    half = 0.62 * max(float(np.ptp(latitude)), float(np.ptp(longitude)) * np.cos(np.radians(middle)))
    centre = [(float(a.min()) + float(a.max())) / 2 for a in (longitude, latitude)]
    axes.set(
        aspect=1 / np.cos(np.radians(middle)),
        xlim=centre[0] + np.array([-1, 1]) * half / np.cos(np.radians(middle)),
        ylim=centre[1] + np.array([-1, 1]) * half,
        xlabel="longitude, deg",
        ylabel="latitude, deg",
    )
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(4))
    axes.ticklabel_format(useOffset=False)


def _hours(part: xr.Dataset) -> np.ndarray:
    time = part["time"].to_numpy()
    return (time - time[0]) / 3600


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, help="the world that is drawn, and the first of --seeds"
    )
    parser.add_argument("--seeds", type=int, default=1, help="worlds")
    parser.add_argument("--out", type=Path, help="folder for figures and tables.txt")
    chosen = parser.parse_args()
    console = Console(width=120, record=True)
    seeds = range(chosen.seed, chosen.seed + chosen.seeds)
    flights = [fly(seed) for seed in track(seeds, "worlds", console=Console(stderr=True))]
    tables(flights, console)
    if chosen.seeds > 1:
        by_world(flights, seeds, console)
    if chosen.out:
        for file in draw(flights[0], chosen.out):
            console.print(f"wrote {file}")
        (chosen.out / "tables.txt").write_text(console.export_text())


if __name__ == "__main__":
    main()
