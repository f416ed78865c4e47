"""Hide effects in simulated deployments, and count how often ``diagnose`` finds and names them unaided.

    python tools/blind.py --cases 800 --out study
    python tools/blind.py --cases 250 --part null,named --seed 1409

An interrupted study continues where it stopped, and a longer one contains the shorter one. The table is
written to the folder ``--out``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from effects import EFFECTS, FOREIGN
from studies import Row, Study, command_line
from study.deployment import (
    CHARTS,
    DAY,
    FLICKER,
    GLIDER,
    LOSSES,
    NOISES,
    SEEDS,
    Background,
    add_noise,
    deployment_of,
    rebuilt,
)
from study.ideal import ideal
from study.names import judge
from study.table import KNOWN, lines

from magbridge import Calibration, diagnose
from magbridge.arrays import BoolArray
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.findings import findings
from sitl.dataset import corrected
from sitl.inject import HiddenEffect

NAMES = tuple(EFFECTS)
LOUD = (25.0, 100.0, 15.0, 50.0)
LASTING = (
    "temperature_offset", "temperature_scale", "current_field", "unmodelled_actuator", "actuator_order",
    "hysteresis", "eddy_current", "channel_skew", "filter_lag", "clock_offset", "nonlinearity",
    "pressure_offset", "reference_bias",
)  # fmt: skip
"""Causes that persist in another deployment; the others depend on a moment, a place or the range of one
log."""
PREDICTED = ("named", "ladder")
"""Parts of the study for which the ideal detector is computed."""
STRANGE = ("jettison", "duet", "winch", "mooring")
"""Foreign effects that were added after the last change of the detector."""
SEEN = (
    "pan", "loose", "corrosion", "pulsation", "needle", "thermostat", "perming", "staircase",
)  # fmt: skip
"""Foreign effects that existed before the last improvement of the detector."""
GOLDEN = 0.6180339887498949


class Part(NamedTuple):
    """Part of the study: its fraction of the cases, and cycles of effects, sizes (S/N) and noises."""

    share: float
    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    noises: tuple[str, ...] = ("white", "ar")


PARTS: dict[str, Part] = {
    "null": Part(0.18, (), (0.0,), NOISES),
    "named": Part(0.22, NAMES, (8.0,)),
    "ladder": Part(0.12, NAMES, (4.0, 3.0, 5.0, 2.0, 6.0)),
    "loud": Part(0.08, NAMES, LOUD),
    "unknown": Part(
        0.1, (*KNOWN, *(name for name in FOREIGN if name not in STRANGE + SEEN)), (10.0,), ("white",)
    ),
    "pair": Part(0.08, KNOWN, (10.0,)),
    "gain": Part(0.07, LASTING, (20.0,), ("white",)),
    "seen": Part(0.03, SEEN, (10.0,)),
    "foreign": Part(0.04, STRANGE, (10.0,)),
    "charted": Part(0.04, LASTING, LOUD, (GLIDER,)),
    "flicker": Part(0.04, LASTING, (25.0,), (FLICKER,)),
}
"""Parts of the study. In `unknown`, the table lacks the effect's cause. In `charted`, the reference is a map.
The signal-to-noise ratio in `flicker` refers to white noise of the same RMS. A third of the cases in these
two parts hides nothing."""


def entry_of(name: str, k: int) -> Row:
    """Return the k-th case of a part: each size and each noise with every effect, before the next ones."""
    part, lost = PARTS[name], losses(k)
    cycle, place = divmod(k, max(len(part.effects), 1))
    names = part.effects[place : place + 1]
    size, noise = (series[cycle % len(series)] for series in (part.sizes, part.noises))
    more = {}
    if name == "pair":
        a, b = np.random.default_rng([20131212, k]).choice(len(KNOWN), 2, replace=False)
        names, noise = (KNOWN[int(a)], KNOWN[int(b)]), part.noises[k % 2]
    if name in ("charted", "flicker") and k % 3 == 0:
        names = ()
    if name == "charted":
        cycle, place = divmod(k, len(LOUD))
        size, lost, more = LOUD[place], "surfacing", {"reference": CHARTS[cycle % len(CHARTS)]}
    return {"losses": lost, "names": names, "wanted": size * bool(names), "noise": noise, **more}


def losses(k: int) -> str:
    """Return the kind of lost samples in the k-th case of a part: one of four in every third case, else "".

    Multiples of the golden section avoid a coincidence with the cycles of causes, noises and sizes.
    """
    place = int(3 * len(LOSSES) * (GOLDEN * k % 1.0))
    return LOSSES[place] if place < len(LOSSES) else ""


def plan(cases: int, parts: tuple[str, ...] = tuple(PARTS), seed: int = 0) -> list[Row]:
    """Return the entries of the study, with evenly mixed parts; a longer study contains the shorter study.

    Another `seed` hides the same causes at the same signal-to-noise ratios in other vehicles, with other
    random numbers.
    """
    made = []
    # the last two parts share a range of 100,000 numbers, because a seed has only ten ranges
    for place, (name, part) in zip((*range(10), 9.5), PARTS.items(), strict=True):
        number = SEEDS * seed + int(100_000 * place)
        for k in range(round(cases * part.share) if name in parts else 0):
            entry = entry_of(name, k) | {"part": name, "number": number + k}
            made.append(((k + 0.5) / part.share, entry))
    return [entry for _, entry in sorted(made, key=lambda item: item[0])]


def case(entry: Row) -> Row:
    """Hide the effects of an entry, diagnose the log, and return the row with the ideal results."""
    number, noise, names = entry["number"], entry["noise"], entry["names"]
    deployment = deployment_of(number, noise, entry.get("reference", "true"))
    background = Background.of(deployment, number, noise, entry["losses"])
    hidden = [background.hide(name, entry["wanted"], number + 7919 * k) for k, name in enumerate(names)]
    effects = tuple(one.hidden for one in hidden)
    whole = hidden[0].ds if len(hidden) == 1 else deployment.measure(effects, number)
    ds = background.log(whole)
    removed = names if entry["part"] == "unknown" else ()
    table = {name: cause for name, cause in CAUSES.items() if name not in removed}
    judged = diagnose([ds], deployment.calibration, training_logs=deployment.learned, causes=table)
    result, found = judged.diagnosis, findings(judged)
    # if the reference is a map, the offset has changed by `TURN_ON` since the calibration
    world = ["offset_step"] * (entry["part"] == "charted")
    row = entry | judge(result, names, world) | {"theory": [], "scores": _scores(found, names, whole)}
    row |= {"unexplained": found["unexplained"], "p_value": result.outcome.p_value}
    if entry["part"] in PREDICTED and names != ("outliers",):
        row["theory"] = [ideal(hidden[0], background, ds, result.outcome.look_elsewhere)]
    if entry["part"] == "charted":
        row["gain"] = harm(effects, background, ds, result)
    return row


def _scores(found: Row, names: tuple[str, ...], whole: xr.Dataset) -> list[float]:
    """Return (value - truth) / sigma of each parameter of the named cause; positive for too large values."""
    truth = json.loads(whole.attrs["truth"])
    own = [f["parameters"] for f in found["findings"] if names == (f["cause"],)]
    if len(own) != 1:
        return []
    return [
        float(np.sign(truth[name]) * (p["value"] - truth[name]) / p["sigma"])
        for name, p in own[0].items()
        if name in truth and p["sigma"]
    ]


def harm(
    hidden: tuple[HiddenEffect, ...], background: Background, ds: xr.Dataset, result: Diagnosis
) -> dict[str, float]:
    """Return mean square errors (nT²) of the calibration ("before") and the extended calibration ("after").

    The errors refer to the true field, on this log and on a log of another day (keys with " elsewhere").
    """
    calibration, number = background.deployment.calibration, background.number + 1
    other = rebuilt(background.deployment, DAY).measure(hidden, number)
    errors: dict[str, float] = {}
    for log, where in ((ds, ""), (add_noise(other, background.noise, number), " elsewhere")):
        truth = log["truth_total_field"].to_numpy()
        inside = _inside(log, ds, calibration)
        for name, one in (("before", calibration), ("after", result.calibration)):
            error = (corrected(log, one).total - truth)[inside]
            errors[name + where] = float(np.nanmean(error**2))
    return errors


def _inside(other: xr.Dataset, ds: xr.Dataset, calibration: Calibration) -> BoolArray:
    """Return the samples (n,) of a log whose masses are within the ranges of the log `ds`."""
    inside = np.ones(other.sizes["time"], bool)
    for parameter in calibration.parameters:
        known = ds[parameter.name]
        inside &= ((other[parameter.name] >= known.min()) & (other[parameter.name] <= known.max())).to_numpy()
    return inside


def run(entry: Row) -> list[Row]:
    """Run a case; return its part and its result as JSON, because the result is nested."""
    return [{"part": entry["part"], "row": json.dumps(case(entry))}]


def main() -> None:
    """Run the cases, and write the table."""
    options = command_line(__doc__, cases=800, part=",".join(PARTS), seed=0, out=Path("study"), workers=2)
    folder = options.out
    folder.mkdir(parents=True, exist_ok=True)
    options.out = folder / "cases.parquet"
    cases = [(entry,) for entry in plan(options.cases, tuple(options.part.split(",")), options.seed)]
    kept = Study(run, ("part",), {}).rows(cases, options)
    rows = sorted((json.loads(row) for row in kept["row"]), key=lambda row: row["number"])
    text = "\n".join(lines(rows))
    (folder / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
