"""Time fitting and correcting, compared with scipy and with the bare matrix product."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from benchmarks.measure import in_own_process, processor_time
from benchmarks.row import Row
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from magbridge.calibration.correct import CORRECTED_AT_ONCE, correct
from magbridge.calibration.corrector import Corrector
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.kernel import Kernel
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import full_order
from magbridge.estimation.residual import residuals_of
from sitl import load, segments, simulate

__all__ = ["correcting", "fitting"]

NAMES = ("battpos", "ballast")
LARGE = (100_000, 1_000_000)

IN_ANOTHER = """
import json, resource, sys, time
from benchmarks.calibration import many
from magbridge.calibration.fitting.fit import fit
data = many(int(sys.argv[1]))
begun = time.process_time()
fit(data)
used = time.process_time() - begun
print(json.dumps([used, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3]))
"""


def fitting(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001  (the others write there)
    """Time `auto` on a glider's calibration runs, and on very many samples."""
    data = table_1()
    samples = polynomial_samples(data, full_order(2, 3))
    ours, theirs = [], []
    fit(data)
    with threadpool_limits(1):
        for _ in range(repetitions):
            ours.append(processor_time(lambda: fit(data)))
            theirs.append(
                processor_time(
                    lambda: least_squares(lambda c: residuals_of(samples, c), np.zeros(90), method="lm")
                )
            )
    (few, _), (all_, memory) = (in_own_process(IN_ANOTHER, count) for count in LARGE)
    return [
        Row(f"auto, {len(data)} samples, 2 masses, one core", median(ours), "s", most=1.0),
        Row("the same by scipy, finite differences, no hyperparameters", median(theirs), "s", median(ours),
            "auto", ratio=median(b / a for a, b in zip(ours, theirs, strict=True)), least=20.0),
        Row(f"auto, {LARGE[1]:,} samples", all_, "s", few * LARGE[1] / LARGE[0],
            f"{LARGE[1] // LARGE[0]} times {LARGE[0]:,}"),
        Row("memory of that", memory, "MB", most=1000.0),
    ]  # fmt: skip


class Floors:
    """The matrix products within `correct` alone.

    Parameters
    ----------
    kernel : Kernel
    positions : (n, k) array
        Of the masses.
    """

    def __init__(self, kernel: Kernel, positions: np.ndarray) -> None:
        self.kernel = kernel
        self.phi = np.ascontiguousarray(kernel.monomials_of(positions).T)
        self.table = np.ascontiguousarray(kernel.table.T)

    def product(self, piece: int) -> None:
        """One product of monomials and table, in pieces of so many samples."""
        kernel = self.kernel
        for start in range(0, len(self.phi), piece):
            part = self.phi[start : start + piece]
            (part[:, kernel.first] * part[:, kernel.second]) @ self.table


def correcting(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001
    """Time `correct` with positions that change at every sample, with positions at rest, and one by one."""
    data = table_1()
    calibration = fit(data).calibration
    jobs, (rows, columns) = _jobs(calibration, data)
    found: dict[str, list[float]] = {name: [] for name in jobs}
    with threadpool_limits(1):
        for _ in range(repetitions):
            for name, (job, samples) in jobs.items():
                found[name].append(1e6 * processor_time(job) / samples)

    def compared(what: str, floor: str, label: str, **target: Any) -> Row:
        ratio = median(b / a for a, b in zip(found["moving"], found[floor], strict=True))
        return Row(what, median(found["moving"]), "us", median(found[floor]), label, ratio=ratio, **target)

    bare = f"{rows} products of monomials @ {rows} x {columns} table, on whole arrays"
    return [
        compared("correct, sigmas and all, positions new with every sample", "bare", bare, least=0.5),
        compared("the same, the product in pieces that stay in the cache", "pieces", "as above, in pieces"),
        Row("correct, positions held", median(found["still"]), "us"),
        Row("one sample live, positions held", median(found["live held"]), "us"),
        Row("one sample live, positions new", median(found["live"]), "us"),
    ]


def _jobs(
    calibration: Calibration, data: Observations
) -> tuple[dict[str, tuple[Callable[[], object], int]], tuple[int, int]]:
    """Return the timed jobs, each with its number of samples; and the shape of the calibration's table."""
    rng = np.random.default_rng(1)
    n, few = 200_000, 2000
    field = data.field[rng.integers(0, len(data), n)]
    moving = rng.uniform(data.parameters.min(axis=0), data.parameters.max(axis=0), (n, 2))
    still = np.repeat(moving[::200], 200, axis=0)
    when = 4.0 * np.arange(float(n))
    floors = Floors(calibration.kernel, moving)
    values = moving[:few].tolist()
    readings = [(x, y, z) for x, y, z in field[:few].tolist()]

    def live(positions: list[list[float]]) -> None:
        corrector = Corrector(calibration)
        for reading, value in zip(readings, positions, strict=True):
            corrector.step(0, reading, value)

    jobs: dict[str, tuple[Callable[[], object], int]] = {
        "bare": (lambda: floors.product(n), n),
        "pieces": (lambda: floors.product(CORRECTED_AT_ONCE), n),
        "moving": (lambda: correct(calibration, field, moving, when), n),
        "still": (lambda: correct(calibration, field, still, when), n),
        "live": (lambda: live(values), few),
        "live held": (lambda: live([values[0]] * few), few),
    }
    return jobs, floors.table.shape


def table_1(noise: float = 1.0) -> Observations:
    """Return a random glider's runs of the paper's Table 1; `noise` in nT."""
    scenario = load("random_glider").replace(instrument={"noise_sigma": noise})
    return observations(segments(simulate(scenario, 1))["calibration"], NAMES)


def many(count: int) -> Observations:
    """Return `count` samples: the same runs repeated, each time with new noise."""
    runs = table_1(0.0)
    rng = np.random.default_rng(2)
    pick = np.arange(count) % len(runs)
    return Observations(
        field=runs.field[pick] + rng.normal(0.0, 1.0, (count, 3)),
        reference=runs.reference[pick],
        parameters=runs.parameters[pick],
        names=runs.names,
        units=runs.units,
        runs=runs.runs[pick].astype(int) + 10 * (np.arange(count) // len(runs)),
        time=4.0 * np.arange(float(count)),
    )
