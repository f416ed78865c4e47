"""Run reduced studies with fixed seeds, and report the figures that changed significantly since the baseline.

    python tools/baseline.py --save                    measure, and write tools/baseline.json
    python tools/baseline.py --compare                 measure, and compare with tools/baseline.json
    python tools/baseline.py --compare --part live     one part only

Every case has a fixed seed, so old and new figures are compared case by case. A change is significant if its
mean exceeds both twice its standard error over the cases and one per cent of the figure (two per cent
if there is one case). A run takes twenty minutes on two cores. Measured logs come from
``$MAGBRIDGE_REAL_DATA`` or ``--data``; without them, the run omits their part.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

FILE = Path(__file__).with_name("baseline.json")
REAL = Path(os.environ.get("MAGBRIDGE_REAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
MIN_STANDARD_ERRORS, MIN_RELATIVE_CHANGE, MIN_RELATIVE_CHANGE_SINGLE = 2.0, 0.01, 0.02
LOW, HIGH, ONE = "low", "high", "one"
"""Direction in which a figure improves: to a lower value, to a higher value, or towards 1."""
Figures = dict[str, float]
Case = Callable[[], Figures]


def goal_of(name: str) -> str:
    """Return the direction in which the figure `name` improves."""
    if "normalised" in name:
        return ONE
    return HIGH if any(word in name for word in ("found", "alone", "valid", "among")) else LOW


def calibration(noise: str, seed: int) -> Figures:
    """Calibrate a random glider by the paper's runs; return its figures on a survey."""
    import accuracy  # noqa: PLC0415

    rows = {row["method"]: row for row in accuracy.run(seed, noise, 2, ("cubic", "auto"), oracles=False)}
    return {
        f"{noise}: error / noise": rows["auto"]["ratio"],
        f"{noise}: normalised error": rows["auto"]["sigma"],
        f"{noise}: cubic, error / noise": rows["cubic"]["ratio"],
    }


def survey(seed: int) -> Figures:
    """Calibrate a random glider from its survey only; return the figures of field and map."""
    import survey as study  # noqa: PLC0415

    row = study.run(6.0, 30.0, 1000.0, "1 nT white", 0.0, seed)[0]
    return {
        "error / noise": row["ratio"],
        "normalised error without bias": row["without_bias"],
        "normalised error": row["with_bias"],
        "map error along the track / oracle": row["map_along"],
        "map error between the tracks / oracle": row["map_between"],
        "map, normalised error between the tracks": row["map_between_sigma"],
    }


def live(change: str, seed: int) -> Figures:
    """Change a vehicle after its calibration while the bridge calibrates in flight; return the figures."""
    import live as study  # noqa: PLC0415

    row = study.run(change, seed, 6.0, 20.0)[0]
    return {
        f"{change}: published error / noise": row["published"],
        f"{change}: normalised error": row["sigma"],
        f"{change}: alarm delay / optimal": row.get("delay", np.nan),
        f"{change}: cause among the candidates": row.get("among", np.nan),
        f"{change}: false alarms": row["false"],
    }


def diagnosis(entry: dict[str, Any]) -> Figures:
    """Hide effects in a deployment and diagnose it; return the figures.

    A name counts as alone if all its alternatives are the same cause, on another series or of the same trace.
    The step of the offset since the calibration, in worlds with a map, does not count as a false alarm.
    """
    from study import table  # noqa: PLC0415
    from study.cases import NAMELESS, case  # noqa: PLC0415

    row = case(entry)
    found = float(table.found(row))
    if not entry["names"]:
        return {"false alarms": float(table.is_false_alarm(row))}
    if entry["part"] in NAMELESS:
        return {"foreign: found": found, "foreign: a name": float(bool(row["found"]))}
    figures = {
        "listed: found": found,
        "listed: false second name": float(table.has_second(row)),
    }
    if found:
        figures["listed: truth among the names"] = float(table.holds(row))
    if row["theory"] and table.is_nameable(row):
        figures["listed: named alone, where an ideal detector can"] = float(table.is_right_alone(row))
    return figures


def navigation(rms: float, length: float, seed: int) -> Figures:
    """Navigate a glider over a random map; return the figures."""
    from voyages import Map, drawn_track, sail  # noqa: PLC0415

    kind = Map(rms, length)
    score = sail(*drawn_track(kind, seed, 1.0)).score()
    return {
        f"{kind}: error / bound": score["drms"] / score["bound"],
        f"{kind}: normalised squared error": score["nees"],
        f"{kind}: lost": score["lost"],
        f"{kind}: valid fraction": score["valid"],
    }


def twin(seed: int) -> Figures:
    """Simulate the paper's trials; return the error of each method on runs and survey."""
    from study_worlds import METHODS, TRIALS, fly_trials  # noqa: PLC0415

    trials = fly_trials(seed)
    return {
        f"{trial}, {method}: error on the {place}, nT": trials.rms(part, trial, method)
        for trial in TRIALS
        for method in METHODS
        for place, part in (("runs", trial), ("survey", "survey"))
    }


def seaglider(data: Path) -> Figures:
    """Cross-validate the calibration of a real Seaglider over its dives; return the figures."""
    from measured import hold_runs_out  # noqa: PLC0415

    from magbridge.calibration.fitting.observe import observations  # noqa: PLC0415
    from magbridge.logs import read  # noqa: PLC0415

    log = read(sorted((data / "seaglider_sg167").glob("p*.nc")))
    masses, normalised = hold_runs_out(observations(log, ("pitchCtl", "vbdCC")), "auto", 3)
    nominal, _ = hold_runs_out(observations(log, ()), "nominal", 0)
    return {
        "Seaglider, dives held out: auto, nT": float(np.sqrt(np.nanmean(masses**2))),
        "Seaglider, dives held out: nominal, nT": float(np.sqrt(np.nanmean(nominal**2))),
        "Seaglider, dives held out: normalised error": float(np.nanstd(normalised)),
    }


def flight(data: Path) -> Figures:
    """Calibrate an aircraft on the first half of its flight and diagnose the second."""
    import measured  # noqa: PLC0415

    fitted, found = measured.calibrate_and_diagnose(measured.flight(data))
    return {
        "aircraft: second half, nT": found.total.before,
        "aircraft: second half, extended model, nT": found.total.after,
        "aircraft: smallest scale": fitted.scales[0],
    }


def ardusub(data: Path) -> Figures:
    """Fit an underwater robot's compass on the first half of a log and test the second."""
    from measured import compare_halves  # noqa: PLC0415

    from magbridge.logs import Options, read  # noqa: PLC0415

    log = read(data / "ardusub" / "small.tlog", options=Options(compass="0"))
    return {f"ArduSub, second half: {row.method}, nT": row.rms for row in compare_halves(log)}


def replay() -> Figures:
    """Run ``magbridge demo``, a simulated survey through the unmodified bridge; return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "magbridge", "demo", "--json", "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    return {f"demo: {name}": value for name, value in result.items() if isinstance(value, int | float)}


def parts(data: Path) -> dict[str, list[Case]]:
    """Return the cases of each part."""
    from live import CHANGES  # noqa: PLC0415
    from study.cases import plan  # noqa: PLC0415

    measured: list[Case] = (
        [partial(part, data) for part in (seaglider, flight, ardusub)] if data.is_dir() else []
    )
    return {
        "calibration": [
            partial(calibration, noise, seed) for noise in ("1 nT white", "5 nT AR(1)") for seed in range(20)
        ],
        "survey": [partial(survey, seed) for seed in range(1000, 1008)],
        "live": [partial(live, change, seed) for change in CHANGES for seed in range(500, 503)],
        "diagnosis": [partial(diagnosis, entry) for entry in plan(60)],
        "navigation": [
            partial(navigation, *kind, seed)
            for kind in ((60.0, 2000.0), (20.0, 1000.0))
            for seed in range(20)
        ],
        "twin": [partial(twin, 29)],
        "measured": measured,
        "replay": [replay],
    }


def run(part: str, case: Case) -> tuple[Figures, float]:
    """Return the figures of a case and its processor time (s); a failed case returns "failed cases"."""
    sys.path.insert(0, str(Path(__file__).parent))
    warnings.simplefilter("ignore")
    begun = time.process_time()
    try:
        figures = {f"{part}: {name}": float(value) for name, value in case().items()}
    except Exception as error:  # noqa: BLE001 - a case that fails is a figure of its own, the others go on
        print(f"{part}: {case}: {error!r}", file=sys.stderr, flush=True)
        figures = {f"{part}: failed cases": 1.0}
    return figures, time.process_time() - begun


def measure(chosen: Sequence[str], data: Path, workers: int) -> dict[str, list[float]]:
    """Return the values of every figure, case by case."""
    values: dict[str, list[float]] = {}
    with ProcessPoolExecutor(workers) as pool:
        tasks = [
            (part, pool.submit(run, part, case))
            for part, cases in parts(data).items()
            if part in chosen or not chosen
            for case in cases
        ]
        seconds: dict[str, float] = {}
        for part, task in tasks:
            figures, used = task.result()
            seconds[part] = seconds.get(part, 0.0) + used
            for name, value in figures.items():
                values.setdefault(name, []).append(float(f"{value:.5g}"))
    print(", ".join(f"{part} {used:.0f} s" for part, used in seconds.items()), "of processor time")
    return values


def compare(old: dict[str, list[float]], new: dict[str, list[float]]) -> list[str]:
    """Return a line for each figure that changed significantly, the worse figures first."""
    worse: list[str] = []
    better: list[str] = []
    for name, values in new.items():
        before, after = np.array(old.get(name, [])), np.array(values)
        if before.shape != after.shape:
            worse.append(f"CASES   {name}: {before.size} cases before, {after.size} now")
            continue
        known = np.isfinite(before) & np.isfinite(after)
        if np.isfinite(before).sum() != np.isfinite(after).sum():
            worse.append(
                f"MISSING {name}: {np.isfinite(before).sum()} values before, {np.isfinite(after).sum()} now"
            )
        before, after = before[known], after[known]
        if not moved(before, after):
            continue
        distance = [np.abs(v - 1.0) if goal_of(name) == ONE else v for v in (before, after)]
        is_better = (distance[1].mean() < distance[0].mean()) != (goal_of(name) == HIGH)
        text = f"{name}: {describe(before)} -> {describe(after)}"
        (better if is_better else worse).append(f"{'better ' if is_better else 'WORSE  '} {text}")
    missing = [f"GONE    {name}" for name in old if name not in new]
    return [*worse, *missing, *better]


def moved(before: np.ndarray, after: np.ndarray) -> bool:
    """Return True if the mean difference of paired values is significant."""
    difference = after - before
    if before.size == 0:
        return False
    scale = max(abs(float(before.mean())), 1e-9)
    if before.size == 1:
        return abs(float(difference[0])) > MIN_RELATIVE_CHANGE_SINGLE * scale
    error = float(difference.std(ddof=1)) / np.sqrt(difference.size)
    change = abs(float(difference.mean()))
    return change > MIN_STANDARD_ERRORS * error and change > MIN_RELATIVE_CHANGE * scale


def describe(values: np.ndarray) -> str:
    """Return the text of the mean, the standard deviation and the number of values."""
    if values.size < 2:
        return f"{values[0]:.4g}" if values.size else "no value"
    return f"{values.mean():.4g} (spread {values.std(ddof=1):.2g}, {values.size} cases)"


def main() -> int:
    """Measure, then save or compare; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--save", action="store_true", help="write the figures to --file")
    parser.add_argument("--compare", action="store_true", help="compare the figures with --file")
    parser.add_argument("--part", action="append", default=[], help="a part; may be repeated")
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--data", type=Path, default=REAL, help="folder of the measured logs")
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    known = json.loads(chosen.file.read_text()) if chosen.file.exists() else {}
    values = measure(chosen.part, chosen.data, chosen.workers)
    if chosen.save:
        known |= values
        lines = [f"{json.dumps(name)}: {json.dumps(figures)}" for name, figures in sorted(known.items())]
        chosen.file.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    if not chosen.compare:
        for name, figures in values.items():
            print(f"{name}: {describe(np.array(figures)[np.isfinite(figures)])}")
        return 0
    old = {k: v for k, v in known.items() if not chosen.part or k.split(":")[0] in chosen.part}
    lines = compare(old, values)
    print(*lines, f"{len(values)} figures, {len(lines)} moved beyond their noise", sep="\n")
    return int(any(not line.startswith("better") for line in lines))


if __name__ == "__main__":
    sys.exit(main())
