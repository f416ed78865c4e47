"""Run reduced studies with fixed seeds, and report the figures that changed significantly since the baseline.

    python tools/baseline.py --save                    measure, and write tools/baseline.json
    python tools/baseline.py --compare                 measure, and compare with tools/baseline.json
    python tools/baseline.py --compare --part live     one part only

Every case has a fixed seed, so old and new figures are compared case by case. A change is significant if its
mean exceeds both twice its standard error over the cases and one per cent of the figure (two per cent
if there is one case). A run takes twenty minutes on two cores. Measured logs come from
``$MAGBRIDGE_REAL_DATA``; without them, the run omits their part.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import accuracy
import blind
import bonne_bay
import live
import measured
import navigation
import numpy as np
import survey
from studies import DATA, Row, command_line, in_order, run_case
from study import table
from study_worlds import NOISES
from voyages import Map

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.estimation.residual import rms
from magbridge.logs import Options, read
from sitl import load, simulate

FILE = Path(__file__).with_name("baseline.json")
MIN_STANDARD_ERRORS, MIN_RELATIVE_CHANGE, MIN_RELATIVE_CHANGE_SINGLE = 2.0, 0.01, 0.02
LOW, HIGH, ONE = "low", "high", "one"
"""Direction in which a figure improves: to a lower value, to a higher value, or towards 1."""


class Part(NamedTuple):
    """Part of the baseline: a study, its cases, and the rows' columns by the name of their figure.

    The columns `by` of a row precede the names of its figures. Without `columns`, a row is its figures.
    """

    name: str
    run: Callable[..., Iterable[Row]]
    cases: Sequence[tuple[Any, ...]]
    by: tuple[str, ...] = ()
    columns: Mapping[str, str] = {}

    def figures(self, case: tuple[Any, ...]) -> dict[str, float]:
        """Return the figures of a case; a case that fails is the figure "failed cases"."""
        warnings.simplefilter("ignore")
        try:
            rows = run_case(self.run, case) if self.columns else [*self.run(*case)]
        except Exception as error:  # noqa: BLE001 - a case that fails is a figure of its own, the others go on
            print(f"{self.name}: {case}: {error!r}", file=sys.stderr, flush=True)
            return {f"{self.name}: failed cases": 1.0}
        return {
            ": ".join([self.name, *(row[column] for column in self.by), label]): float(
                row.get(column, np.nan)
            )
            for row in rows
            for label, column in (self.columns or dict(zip(row, row, strict=True))).items()
        }


# ---- studies whose rows are not the figures yet ------------------------------------------------------------


def diagnosis(entry: dict[str, Any]) -> list[Row]:
    """Hide effects in a deployment and diagnose it; return the figures.

    A name counts as alone if all its alternatives are the same cause, on another series or of the same trace.
    """
    row = blind.case(entry)
    if not entry["names"]:
        return [{"false alarms": row["false_alarm"]}]
    if entry["part"] in table.NAMELESS:
        return [{"foreign: found": row["found"], "foreign: a name": bool(row["named"])}]
    figures = {"listed: found": row["found"], "listed: false second name": row["second"]}
    if row["found"]:
        figures["listed: truth among the names"] = row["in_set"]
    if row["theory"] and table.is_nameable(row):
        figures["listed: named alone, where an ideal detector can"] = row["alone"]
    return [figures]


def navigated(kind: Map, seed: int) -> list[Row]:
    """Navigate a glider over a random map; return the row, with the error over its bound."""
    rows = navigation.run_accuracy(kind, "wide", seed)
    return [row | {"ratio": row["drms"] / row["bound"]} for row in rows]


def real_logs() -> list[Row]:
    """Return the figures of the logs of real vehicles: a Seaglider, an aircraft and an underwater robot."""
    dives = read(sorted((DATA / "seaglider_sg167").glob("p*.nc")))
    masses, normalised = measured.hold_runs_out(observations(dives, ("pitchCtl", "vbdCC")), "auto", 3)
    nominal, _ = measured.hold_runs_out(observations(dives, ()), "nominal")
    fitted, found = measured.calibrate_and_diagnose(measured.flight(DATA))
    halves = measured.compare_halves(read(DATA / "ardusub" / "small.tlog", options=Options(compass="0")))
    figures = {
        "Seaglider, dives held out: auto, nT": np.sqrt(np.nanmean(masses**2)),
        "Seaglider, dives held out: nominal, nT": np.sqrt(np.nanmean(nominal**2)),
        "Seaglider, dives held out: normalised error": np.nanstd(normalised),
        "aircraft: second half, nT": found.total.before,
        "aircraft: second half, extended model, nT": found.total.after,
        "aircraft: smallest scale": fitted.scales[0],
    }
    return [figures | {f"ArduSub, second half: {row['method']}, nT": row["rms"] for row in halves}]


def whole_log(seed: int) -> list[Row]:
    """Calibrate with a whole simulated log, including rows beside a motion of a mass; return the errors."""
    data = observations(simulate(load("survey"), seed), ("battpos", "ballast"))
    corrected = correct(fit(data).calibration, data.field, data.parameters, data.time)
    error = corrected.total - data.reference
    return [
        {
            "error at rest, nT": rms(error[data.at_rest]),
            "error beside a motion, nT": rms(error[~data.at_rest]),
            "normalised error at rest": rms((error / corrected.sigma)[data.at_rest]),
        }
    ]


def replay() -> list[Row]:
    """Run ``magbridge demo``, a simulated survey through the unmodified bridge; return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "magbridge", "demo", "--json", "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    return [{f"demo: {name}": value for name, value in result.items() if isinstance(value, int | float)}]


ERROR = {"error / noise": "ratio"}


def gliders(method: str) -> list[tuple[Any, ...]]:
    """Return the cases of a method's calibrations, without bounds and other programs."""
    return [(2, noise, seed, (method,), False) for noise in NOISES for seed in range(20)]


BOTH = "noise", "method"
PARTS = (
    Part("calibration", accuracy.run, gliders("auto"), BOTH, ERROR | {"normalised error": "sigma"}),
    Part("calibration", accuracy.run, gliders("cubic"), BOTH, ERROR),
    Part(
        "survey", survey.run, [(6.0, 30.0, 1000.0, "1 nT white", 0.0, 1000 + k) for k in range(8)], (),
        ERROR | {
            "normalised error without bias": "without_bias", "normalised error": "with_bias",
            "map error along the track / oracle": "map_along",
            "map error between the tracks / oracle": "map_between",
            "map, normalised error between the tracks": "map_between_sigma",
        },
    ),
    Part(
        "live", live.run,
        [(change, seed, 6.0, 20.0) for change in live.CHANGES for seed in range(500, 503)], ("change",),
        {
            "published error / noise": "published", "normalised error": "sigma",
            "alarm delay / optimal": "delay", "cause among the candidates": "among", "false alarms": "false",
        },
    ),
    Part("diagnosis", diagnosis, [(entry,) for entry in blind.plan(60)]),
    Part(
        "navigation", navigated, [(navigation.MAPS[k], seed) for k in (0, 2) for seed in range(20)],
        ("kind",),
        {
            "error / bound": "ratio", "normalised squared error": "nees", "lost": "lost",
            "valid fraction": "valid",
        },
    ),
    Part(
        "twin", bonne_bay.run, [(29, False)], ("trial", "method"),
        {"error on the runs, nT": "runs", "error on the survey, nT": "survey"},
    ),
    Part("measured", real_logs, [()] if DATA.is_dir() else []),
    Part("whole log", whole_log, [(seed,) for seed in range(1, 6)]),
    Part("replay", replay, [()]),
)  # fmt: skip


# ---- the comparison ----------------------------------------------------------------------------------------


def goal_of(name: str) -> str:
    """Return the direction in which the figure `name` improves."""
    if "normalised" in name or "scale" in name:
        return ONE
    return HIGH if any(word in name for word in ("found", "alone", "valid", "among")) else LOW


def compare(old: dict[str, list[float]], new: dict[str, list[float]]) -> list[str]:
    """Return a line for each figure that changed significantly, the worse figures first."""
    found: dict[str, list[str]] = {kind: [] for kind in ("CASES", "MISSING", "WORSE", "GONE", "better")}
    for name, values in new.items():
        before, after = np.array(old.get(name, [])), np.array(values)
        if before.shape != after.shape:
            found["CASES"].append(f"{name}: {before.size} cases before, {after.size} now")
            continue
        counts = [int(np.isfinite(one).sum()) for one in (before, after)]
        if counts[0] != counts[1]:
            found["MISSING"].append(f"{name}: {counts[0]} values before, {counts[1]} now")
        known = np.isfinite(before) & np.isfinite(after)
        before, after = before[known], after[known]
        if moved(before, after):
            distance = [np.abs(v - 1.0) if goal_of(name) == ONE else v for v in (before, after)]
            is_better = (distance[1].mean() < distance[0].mean()) != (goal_of(name) == HIGH)
            line = f"{name}: {describe(before)} -> {describe(after)}"
            found["better" if is_better else "WORSE"].append(line)
    found["GONE"] = [name for name in old if name not in new]
    return [f"{kind:7} {line}" for kind, lines in found.items() for line in lines]


def moved(before: np.ndarray, after: np.ndarray) -> bool:
    """Return True if the mean difference of paired values (n,) is significant."""
    n = before.size
    if n == 0:
        return False
    change, scale = abs(float((after - before).mean())), max(abs(float(before.mean())), 1e-9)
    error = float((after - before).std(ddof=1)) / np.sqrt(n) if n > 1 else 0.0
    least = MIN_RELATIVE_CHANGE if n > 1 else MIN_RELATIVE_CHANGE_SINGLE
    return change > max(MIN_STANDARD_ERRORS * error, least * scale)


def describe(values: np.ndarray) -> str:
    """Return the text of the mean, the standard deviation and the number of values."""
    if values.size < 2:
        return f"{values[0]:.4g}" if values.size else "no value"
    return f"{values.mean():.4g} (spread {values.std(ddof=1):.2g}, {values.size} cases)"


def main() -> int:
    """Measure, then save or compare; return the exit code."""
    names = list(dict.fromkeys(part.name for part in PARTS))
    chosen = command_line(__doc__, save=False, compare=False, part=names, file=FILE, workers=2)
    tasks = [(part, case) for part in PARTS if part.name in chosen.part for case in part.cases]
    values: dict[str, list[float]] = {}
    for figures in in_order(Part.figures, tasks, chosen):
        for name, value in figures.items():
            values.setdefault(name, []).append(float(f"{value:.5g}"))
    known = json.loads(chosen.file.read_text()) if chosen.file.exists() else {}
    if chosen.save:
        saved = sorted((known | values).items())
        lines = [f"{json.dumps(name)}: {json.dumps(figures)}" for name, figures in saved]
        chosen.file.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    if not chosen.compare:
        for name, measured_values in values.items():
            print(f"{name}: {describe(np.array(measured_values)[np.isfinite(measured_values)])}")
        return 0
    old = {name: figures for name, figures in known.items() if name.partition(":")[0] in chosen.part}
    lines = compare(old, values)
    print(*lines, f"{len(values)} figures, {len(lines)} moved beyond their noise", sep="\n")
    return int(any(not line.startswith("better") for line in lines))


if __name__ == "__main__":
    sys.exit(main())
