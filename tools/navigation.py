"""Measure the accuracy of the navigator's position on simulated maps, next to its bound.

    python tools/navigation.py [--runs 100] [--part accuracy] ... [--out FILE.parquet]

accuracy      narrow and wide first positions, with the errors that an `auto` calibration leaves
watch         duration for which a wrong position counts as valid
misinformed   validity of the position if the field has an offset, or half of the map's variance is missing
unmapped      surveys of 6 and 12 h without a map
smoothed      flights on a rough map, and on that map without its short wavelengths
dived         gliders that dive under a map from 90 m, without and with its continuation
calibrations  gliders, each calibrated by nominal, cubic and auto, that fly the same survey
speed         processor time of an update, of 100,000 samples, and of the start

Errors are those of the second half of each run, in m. *ratio* is the median of error / bound of the same run,
*all* the RMS of all errors over the RMS of all bounds, *lost* the fraction of the runs in which the truth was
outside the 99.99 % ellipse for half an hour, and *NEES/2* is 1 if the claimed covariance is consistent.
"""

from __future__ import annotations

import argparse
import time as clock
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace as with_options
from studies import Column, Row, Study, command_line, percentile, show
from voyages import (
    GLIDER,
    PLACE,
    START,
    VEHICLES,
    Map,
    calibrated,
    carried,
    dived,
    drawn_track,
    located,
    misled,
    sail,
    synthetic,
    track_over,
)

from magbridge.estimation.residual import rms
from magbridge.field.continuation import smoothed
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import Bank
from magbridge.navigate.batch import navigate
from magbridge.navigate.model import Block, prior, transition

MAPS = (Map(60, 2000), Map(60, 800), Map(20, 1000), Map(20, 1000, rough=True), Map(5, 1000), Map(1, 2000))
STARTS = {"narrow": 0.2, "wide": 1.0}
"""1-sigma of the initial position, in correlation lengths of the map."""
LEVEL_NT = 60.0
"""Offset of the field in a misinformed run, nT."""
ROUGH = Map(40, 1000, rough=True)
WAVELENGTHS_M = 1_000.0, 2_000.0
"""Wavelengths at which the smoothed maps keep half of the amplitude, m."""


def run_accuracy(kind: Map, start: str, seed: int) -> list[Row]:
    """Navigate with the errors of an `auto` calibration; return the row."""
    return [sail(*drawn_track(kind, seed, STARTS[start])).score()]


def run_watch(situation: str, kind: Map, seed: int) -> list[Row]:
    """Measure the time for which a wrong position counts as valid; return the row."""
    silent, lost = {"carried": carried, "misled": misled}[situation](kind, seed)
    row: Row = {"lost": float(lost > 0.0)}
    if lost > 0.0:
        row |= {"flagged": float(silent <= 0.5), "silent": 60.0 * silent, "recovered": float(lost <= 2.0)}
    return [row]


def run_misinformed(situation: str, kind: Map, seed: int) -> list[Row]:
    """Measure the fractions of the time in which a right and a wrong position count as valid.

    In the case "level", the field is always 60 nT too large, with a claimed sigma of 0.5 nT. In the case
    "half", the map has half of the variance of the field.
    """
    field = None
    if situation == "half":
        grid, other = synthetic(kind, seed % 10), synthetic(kind, 10 + seed % 10)
        field = AnomalyGrid(grid.longitude, grid.latitude, (grid.anomaly + other.anomaly) / 2**0.5)
    ds, grid, options = drawn_track(kind, seed, 0.2, first=9000, over=field)
    if situation == "level":
        ds = ds.assign(total_field=ds["total_field"] + LEVEL_NT)
    right, wrong = sail(ds, grid, options).standing()
    return [{"right": right, "wrong": wrong}]


def run_smoothed(seed: int) -> list[Row]:
    """Navigate one flight on a rough map and on smoothed maps; return the rows."""
    ds, raw, options = drawn_track(ROUGH, seed, 0.2)
    rows: list[Row] = [{"map": str(ROUGH)} | sail(ds, raw, options).score()]
    for length in WAVELENGTHS_M:
        name = f"without wavelengths below {length:.0f} m"
        rows.append({"map": name} | sail(ds, smoothed(raw, length), options).score())
    return rows


# ---- the parts: columns and cases of each ------------------------------------------------------------------


def ratios(statistic: Any) -> Column:
    """Return the column of a statistic of error over bound of the runs."""
    return Column(("drms", "bound"), lambda values: float(statistic(values[:, 0] / values[:, 1])))


def rms_ratio(values: np.ndarray) -> float:
    """Return the RMS of the first column over the RMS of the second, of values (n, 2)."""
    return rms(values[:, 0]) / rms(values[:, 1])


SCORES = {
    "DRMS, m": Column("drms", form=".0f"),
    "bound": Column("bound", form=".0f"),
    "ratio": ratios(np.median),
    "90 %": ratios(percentile(90)),
    "all": Column(("drms", "bound"), rms_ratio),
    "dead reckoning": Column("unaided", form=".0f"),
    "lost": Column("lost", np.mean, ".0%"),
    "NEES/2": Column("nees", np.mean),
    "valid": Column("valid", np.mean, ".0%"),
    "after, h": Column("waited", form=".1f"),
}
STUDIES = {
    "accuracy": Study(run_accuracy, ("kind", "start"), SCORES),
    "calibrations": Study(
        calibrated,
        ("map", "calibration"),
        {"error, nT": Column("error", form=".1f"), "claimed, nT": Column("claimed", form=".1f")} | SCORES,
    ),
    "watch": Study(
        run_watch,
        ("situation", "kind"),
        {
            "lost": Column("lost", np.mean, ".0%"),
            "flagged in 30 min": Column("flagged", np.mean, ".0%"),
            "95 % within, min": Column("silent", percentile(95), ".0f"),
            "recovered in 2 h": Column("recovered", np.mean, ".0%"),
        },
    ),
    "misinformed": Study(
        run_misinformed,
        ("situation", "kind"),
        {
            "right and valid": Column("right", np.mean, ".1%"),
            "wrong and valid": Column("wrong", np.mean, ".1%"),
        },
    ),
    "dived": Study(
        dived,
        ("map",),
        {
            "error, m: median": Column("error", form=".0f"),
            "maximum": Column("error", np.max, ".0f"),
            "NEES/2": Column("nees"),
            "valid": Column("valid", np.mean, ".0%"),
        },
    ),
    "smoothed": Study(run_smoothed, ("map",), SCORES),
    "unmapped": Study(
        located,
        ("vehicle", "kind"),
        {
            "bound, m": Column("bound", rms, ".0f"),
            "error": Column("error", rms, ".0f"),
            "dead reckoning": Column("reckoned", rms, ".0f"),
            "sigma": Column("sigma", rms, ".0f"),
            "NEES/2": Column("nees", np.mean),
            "worse": Column("worse", np.sum, ".0f"),
            "beyond 2 sigma": Column("beyond", np.sum, ".0f"),
            "valid": Column("valid", np.mean, ".0%"),
            "s": Column("seconds", np.mean, ".0f"),
        },
    ),
}  # fmt: skip


def cases_of(part: str, options: argparse.Namespace) -> list[tuple[Any, ...]]:
    """Return the cases of a part."""
    surveys = [("6 h", kind) for kind in (Map(30, 500), Map(30, 1000), Map(60, 500), Map(60, 1000))]
    surveys += [("6 h", Map(30, 1000, rough=True)), ("12 h", Map(30, 500))]
    kinds: dict[str, Any] = {
        "accuracy": product(MAPS, STARTS),
        "calibrations": [((MAPS[0], MAPS[2]),)],
        "watch": product(("carried", "misled"), MAPS[:4]),
        "misinformed": product(("level", "half"), MAPS[:4]),
        "unmapped": [one for one in surveys if one[0] in options.vehicle],
    }
    seeds = range(options.first, options.first + options.runs)
    return [(*kind, seed) for kind in kinds.get(part, [()]) for seed in seeds]


def show_speed() -> None:
    """Print the processor time of an update, of 100,000 samples, and of a sample after a wide start."""
    grid = synthetic(Map(30, 1500), 3, 40_000.0)
    options = with_options(GLIDER, start_sigma=50.0)
    tracker = Bank(grid, *prior(options), np.inf, options.gate)
    block = Block(int(START * 1e6), *PLACE, grid.look_up(PLACE[1], PLACE[0]).anomaly, 1.0, 0.0, 0.0)
    moved = transition(options, 4.0, 1.4)
    begun = clock.process_time()
    for _ in range(5000):
        tracker.predict(*moved)
        tracker.update(block)
    show(f"one update with its look-up: {1e6 * (clock.process_time() - begun) / 5000:.0f} us")
    ds = track_over(grid, options, 5, hours=100_000 / 3600, every=1.0)
    for interval in (options.interval, 0.0):
        begun = clock.process_time()
        navigate(ds, grid, with_options(options, interval=interval), start=PLACE)
        show(f"100,000 samples, interval {interval:.0f} s: {clock.process_time() - begun:.1f} s")
    show(f"wide start: {1e3 * sail(*drawn_track(MAPS[0], 7, 1.0, bias_sigma=1.0)).seconds:.2f} ms a sample")


def main() -> None:
    """Run the parts, and print their tables."""
    options = command_line(
        __doc__, part=[*STUDIES, "speed"], runs=100, first=0, vehicle=list(VEHICLES), out=Path,
        workers=2,
    )  # fmt: skip
    out = options.out
    for part in options.part:
        if part == "speed":
            show_speed()
        elif cases := cases_of(part, options):
            options.out = out and out.with_stem(f"{out.stem}-{part}")
            study = STUDIES[part]
            show(study.table(f"{part}, {options.runs} runs", study.rows(cases, options)))


if __name__ == "__main__":
    main()
