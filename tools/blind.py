"""The blind study: effects that the detector cannot know are hidden in simulated deployments, and it must find them.

Run it as ``python tools/blind.py --cases 400 --out study``; a study that was interrupted goes on where it stopped.
``--scheduler ADDRESS`` uses a dask cluster that is there; otherwise a local one is made.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # processes share the cores, not threads

import msgspec
import numpy as np
import xarray as xr
from distributed import Client, LocalCluster, as_completed
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magbridge.calibration.correct import regressors
from magbridge.calibration.data import observations
from magbridge.calibration.fit import fit
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import Samples, residuals
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.findings import findings
from magbridge.diagnose.isolability import confusion
from magbridge.diagnose.run import diagnose
from sitl import Twin, load, simulate
from sitl.inject import EFFECTS, FOREIGN, Hidden, disturb
from sitl.mission import CrissCross, Spirals
from sitl.trajectory import Track
from sitl.world import Water

Array = NDArray[np.float64]
HOURS = 6.0
VEHICLES = 6
NOISES = ("white", "ar", "heavy", "uneven", "half")


@lru_cache(maxsize=VEHICLES)
def vehicle(seed: int) -> tuple[Twin, Track, Array, Calibration]:
    """A vehicle with its calibration, and the track of its survey."""
    replace = msgspec.structs.replace
    base = load("demo")
    instrument = replace(base.instrument, corner=0.0, channel_delay=(0.0, 0.0, 0.0), noise_sigma=1.0)
    base = replace(base, instrument=instrument)
    spirals = simulate(replace(base, mission=(Spirals(),)), seed)
    calibration = fit(observations(spirals, ["battpos", "ballast"]), "auto").calibration
    water = Water(surface=6.0, deep=2.5, thermocline=50.0, thickness=30.0)
    quiet = replace(
        base,
        instrument=replace(instrument, noise_sigma=0.0),
        world=replace(base.world, water=water),
        mission=(
            CrissCross(hours=HOURS, roll=(0.0, 4.0), pitch=(24.0, 3.0), battery_spread=0.12, duration=700.0),
        ),
    )
    twin = Twin.draw(quiet, seed)
    track = twin.fly()
    when = np.arange(0.0, track.elapsed[-1] - 30.0, 1 / instrument.rate)
    return twin, track, when, calibration


def add_noise(ds: xr.Dataset, kind: str, sigma: float, seed: int) -> xr.Dataset:
    """Noise of each channel: white; with a memory; heavy-tailed; louder at times; half as loud again as calibrated."""
    rng = np.random.default_rng([seed, 99])
    n = ds.sizes["time"]
    noise = rng.standard_normal((n, 3))
    if kind == "heavy":
        noise = rng.standard_t(4.0, (n, 3)) / np.sqrt(2.0)
    if kind == "ar":
        noise[1:] *= np.sqrt(1 - 0.8**2)
        for i in range(1, n):
            noise[i] += 0.8 * noise[i - 1]
    if kind == "uneven":
        noise *= np.repeat(np.exp(rng.normal(0, 0.5, n // 300 + 1)), 300)[:n, None]
    if kind == "half":
        noise *= 1.5
    out = ds.copy()
    for k, axis in enumerate("xyz"):
        out[f"mag_{axis}"] = out[f"mag_{axis}"] + sigma * noise[:, k]
    return out


def compare(ds: xr.Dataset, calibration: Calibration) -> tuple[Array, Array]:
    """Residual (n,) and its derivative by the calibration's coefficients (n, K)."""
    H = np.column_stack([ds[f"mag_{axis}"] for axis in "xyz"])
    p = np.column_stack([ds[name] for name in calibration.channels])
    phi = regressors(calibration, H, p, ds["time"].to_numpy()).T
    W = calibration.kernel.weights.copy()
    W[0, :3] -= 1.0
    W[:, :6] *= calibration.reference.field
    samples = Samples(
        H, ds["reference_field"].to_numpy(), phi, np.ones(len(H), bool), calibration.reference.field
    )
    e, g = residuals(samples, W.ravel())
    return e, (phi[:, :, None] * g[:, None, :]).reshape(len(e), -1)


def size_of(ds: xr.Dataset, clean: xr.Dataset, calibration: Calibration, rho: float, sigma: float) -> float:
    """Signal-to-noise of what was hidden: whitened by the true noise, free calibration projected out."""
    e0, J = compare(clean, calibration)
    d = compare(ds, calibration)[0] - e0
    white = lambda x: (x[1:] - rho * x[:-1]) / (sigma * np.sqrt(1 - rho**2))  # noqa: E731
    d, A = white(d), white(J)
    C = calibration.covariance
    S = A.T @ A
    # Woodbury's identity needs no inverse of the prior
    projected = d @ d - d @ A @ C @ np.linalg.solve(np.eye(len(C)) + S @ C, A.T @ d)
    return float(np.sqrt(max(projected, 0.0)))


def hide(name: str, wanted: float, seed: int, number: int, noise: str) -> tuple[Hidden, xr.Dataset]:
    """Find the size at which the effect has the signal-to-noise that is wanted."""
    twin, track, when, calibration = vehicle(seed)
    rho, sigma = (0.8 if noise == "ar" else 0.0), (1.5 if noise == "half" else 1.0)
    clean = disturb(twin, (), track, when, number)
    size = 1.0
    hidden, ds = Hidden(name, size, number), clean
    for _ in range(4):
        hidden = Hidden(name, size, number)
        ds = disturb(twin, (hidden,), track, when, number)
        found = size_of(ds, clean, calibration, rho, sigma)
        if abs(found / wanted - 1.0) < 0.02:
            break
        size *= wanted / max(found, 1e-9)
    return hidden, ds


def case(number: int, names: tuple[str, ...], wanted: float, noise: str, without: str = "") -> dict[str, Any]:
    """One case: hide, diagnose, and say what came out."""
    began = time.process_time()
    seed = number % VEHICLES
    twin, track, when, calibration = vehicle(seed)
    hidden = tuple(hide(name, wanted, seed, number + 7919 * k, noise)[0] for k, name in enumerate(names))
    ds = add_noise(disturb(twin, hidden, track, when, number), noise, 1.0, number)
    table = {name: cause for name, cause in CAUSES.items() if name != without}
    result = findings(diagnose([ds], calibration, causes=table), table)
    return {
        "number": number, "names": list(names), "wanted": wanted, "noise": noise, "without": without,
        "sizes": [h.size for h in hidden], "verdict": result["verdict"], "ratio": result["gain"]["rms_ratio"],
        "after": result["rms_after_nT"], "before": result["rms_before_nT"],
        "found": [[f["cause"], f["channel"], f["signal_to_noise"], [a["cause"] for a in f["alternatives"]]] for f in result["findings"]],
        "unexplained": result["unexplained"], "seconds": time.process_time() - began,
    }  # fmt: skip


def plan(cases: int) -> list[dict[str, Any]]:
    """The study: nulls of every noise; each cause over sizes; without its function; pairs; foreign effects."""
    rng = np.random.default_rng(20131212)
    names = list(EFFECTS)
    made: list[dict[str, Any]] = [
        {"names": (), "wanted": 0.0, "noise": NOISES[k % len(NOISES)]} for k in range(cases // 4)
    ]
    for k in range(cases // 2):
        sizes = (8.0, 8.0, 4.0, 8.0, 25.0, 8.0, 3.0, 100.0, 8.0, 5.5)
        made.append(
            {
                "names": (names[k % len(names)],),
                "wanted": sizes[k // len(names) % len(sizes)],
                "noise": NOISES[int(rng.integers(2))],
            }
        )
    for k in range(cases // 8):
        name = names[k % (len(names) - 1)]
        if k % 3 == 2:
            made.append({"names": (list(FOREIGN)[k // 3 % len(FOREIGN)],), "wanted": 10.0, "noise": "white"})
        else:
            made.append({"names": (name,), "wanted": 10.0, "noise": "white", "without": name})
    for k in range(cases - len(made)):
        a, b = rng.choice(len(names) - 1, 2, replace=False)
        made.append({"names": (names[int(a)], names[int(b)]), "wanted": 10.0, "noise": NOISES[k % 2]})
    return [entry | {"number": number} for number, entry in enumerate(made)]


def share(rows: list[dict[str, Any]], good: Callable[[dict[str, Any]], bool]) -> tuple[float, int]:
    """Fraction of the rows that are good, and how many rows there are."""
    return (sum(map(good, rows)) / len(rows) if rows else float("nan")), len(rows)


def causes_of(row: dict[str, Any]) -> set[str]:
    return {found[0] for found in row["found"]}


def sets_of(row: dict[str, Any]) -> set[str]:
    return causes_of(row).union(*(found[3] for found in row["found"]))


def right_alone(row: dict[str, Any]) -> bool:
    """One finding, the truth, and no other cause beside it."""
    return causes_of(row) == set(row["names"]) and sets_of(row) == set(row["names"])


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """The study's figures against their targets."""
    out = ["| figure | target | measured | cases |", "|---|---|---|---|"]

    def add(figure: str, target: str, measured: tuple[float, int]) -> None:
        out.append(f"| {figure} | {target} | {100 * measured[0]:.1f} % | {measured[1]} |")

    nulls = [r for r in rows if not r["names"]]
    add("false alarm on nulls", "at most 1 %", share(nulls, lambda r: r["verdict"] != "nothing_found"))
    for noise in NOISES:
        add(
            f"... {noise}",
            "",
            share([r for r in nulls if r["noise"] == noise], lambda r: r["verdict"] != "nothing_found"),
        )
    single = [r for r in rows if len(r["names"]) == 1 and not r["without"] and r["names"][0] in EFFECTS]
    for size in sorted({r["wanted"] for r in single}):
        add(
            f"detection at S/N {size:g}",
            "95 % at 8",
            share([r for r in single if r["wanted"] == size], lambda r: r["verdict"] != "nothing_found"),
        )
    loud = [r for r in single if r["wanted"] == 8.0]
    add("S/N 8: named alone and right", "90 % where theory allows", share(loud, right_alone))
    add("S/N 8: the set holds the truth", "97 %", share(loud, lambda r: r["names"][0] in sets_of(r)))
    named = [len(sets_of(r)) for r in loud if r["found"]]
    out.append(
        f"| S/N 8: mean size of the set | 1.5 where separable | {np.mean(named) if named else 0:.2f} | {len(named)} |"
    )
    unknown = [r for r in rows if r["without"] or (r["names"] and r["names"][0] in FOREIGN)]
    add(
        "unknown at S/N 10: 'unexplained'",
        "90 %",
        share(unknown, lambda r: r["verdict"] in ("unexplained", "partly_explained")),
    )
    add("unknown at S/N 10: a wrong name", "at most 5 %", share(unknown, lambda r: bool(r["found"])))
    pairs = [r for r in rows if len(r["names"]) == 2]
    add("two at S/N 10: both in the sets", "80 %", share(pairs, lambda r: set(r["names"]) <= sets_of(r)))
    out += [
        "",
        "| hidden (S/N 8) | cases | found | named alone, right | in the set | else |",
        "|---|---|---|---|---|---|",
    ]
    for name in EFFECTS:
        own = [r for r in loud if r["names"] == [name]]
        other = sorted(
            {c for r in own for c in causes_of(r) - {name}}
            | {r["unexplained"]["kind"] for r in own if r["unexplained"]}
        )
        found, alone, inside = (
            share(own, good)[0]
            for good in (
                lambda r: r["verdict"] != "nothing_found",
                right_alone,
                lambda r, name=name: name in sets_of(r),
            )
        )
        out.append(
            f"| {name} | {len(own)} | {found:.0%} | {alone:.0%} | {inside:.0%} | {', '.join(other)} |"
            if own
            else f"| {name} | 0 | | | | |"
        )
    return out


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """The measured confusion matrix beside the one that theory predicts for the first vehicle's log."""
    names = [name for name in EFFECTS if name != "outliers"]
    measured = np.zeros((len(names), len(names)))
    for r in rows:
        if (
            len(r["names"]) == 1
            and r["wanted"] == 8.0
            and r["names"][0] in names
            and r["found"]
            and r["found"][0][0] in names
        ):
            measured[names.index(r["names"][0]), names.index(r["found"][0][0])] += 1.0
    measured /= np.maximum(measured.sum(axis=1, keepdims=True), 1.0)
    twin, track, when, calibration = vehicle(0)
    report = diagnose([add_noise(disturb(twin, (), track, when), "white", 1.0, 0)], calibration).isolability
    listed = [v.cause for v in report.visible]
    first = [listed.index(name) for name in names if name in listed]
    predicted = confusion(report.correlation[np.ix_(first, first)], 8.0)
    labels = [listed[k] for k in first]
    figure = Figure(figsize=(15, 7.5), layout="constrained")
    for axis, matrix, ticks, title in zip(
        figure.subplots(1, 2), (predicted, measured), (labels, names), ("predicted", "measured"), strict=True
    ):
        axis.imshow(matrix, cmap="Blues", vmin=0.0, vmax=1.0)
        axis.set_xticks(range(len(ticks)), ticks, rotation=90)
        axis.set_yticks(range(len(ticks)), ticks)
        axis.set_title(f"{title}: hidden (row), named first (column), S/N 8")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("study"))
    parser.add_argument(
        "--scheduler", default="", help="address of a dask scheduler; a local cluster if not given"
    )
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "cases.jsonl"
    done = (
        {row["number"]: row for row in map(json.loads, log.read_text().splitlines())} if log.exists() else {}
    )
    todo = [entry for entry in plan(options.cases) if entry["number"] not in done]
    print(f"{len(done)} cases done, {len(todo)} to do")
    if todo:
        cluster = (
            None
            if options.scheduler
            else LocalCluster(n_workers=options.workers, threads_per_worker=1, dashboard_address=None)
        )
        with Client(options.scheduler or cluster) as client, log.open("a") as file:
            client.run(sys.path.insert, 0, str(Path(__file__).parent))
            futures = client.map(run_case, todo, pure=False)
            for k, future in enumerate(as_completed(futures), 1):
                row = future.result()
                done[row["number"]] = row
                file.write(json.dumps(row) + "\n")
                file.flush()
                print(f"\r{k} of {len(todo)}", end="", file=sys.stderr)
        if cluster is not None:
            cluster.close()
    rows = [done[number] for number in sorted(done)]
    text = "\n".join(lines(rows))
    (options.out / "table.md").write_text(text + "\n")
    plot(rows, options.out / "confusion.png")
    print(f"\n{text}")


def run_case(entry: dict[str, Any]) -> dict[str, Any]:
    """One entry of :func:`plan`, on a worker."""
    return case(**entry)


if __name__ == "__main__":
    main()
