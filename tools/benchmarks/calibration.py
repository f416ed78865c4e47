"""Time the fit against scipy's least squares, and the correction against the bare matrix product."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from benchmarks.row import Row, in_own_process, processor_time
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from magbridge.calibration.correct import CORRECTED_AT_ONCE, Corrector, correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.terms import full_order
from magbridge.estimation.residual import residuals_of
from sitl import load, segments, simulate

NAMES = ("battpos", "ballast")
MANY = (100_000, 1_000_000)
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
    """Time `auto` on a glider's runs, scipy's least squares on these runs, and `auto` on many samples."""
    data = table_1()
    samples = polynomial_samples(data, full_order(2, 3))

    def by_scipy() -> object:
        return least_squares(lambda c: residuals_of(samples, c), np.zeros(90), method="lm")

    ours, theirs = [], []
    fit(data)
    with threadpool_limits(1):
        for _ in range(repetitions):
            ours.append(processor_time(lambda: fit(data)))
            theirs.append(processor_time(by_scipy))
    ratio = median(b / a for a, b in zip(ours, theirs, strict=True))
    (few, _), (most, memory) = (in_own_process(IN_ANOTHER, count) for count in MANY)
    tenfold = f"{MANY[1] // MANY[0]} times {MANY[0]:,}"
    return [
        Row(f"auto, {len(data)} samples, 2 masses, one core", median(ours), "s", most=1.0),
        Row("scipy.optimize.least_squares on them", median(theirs), "s", median(ours), "auto", ratio,
            least=20.0),
        Row(f"auto, {MANY[1]:,} samples", most, "s", few * MANY[1] / MANY[0], tenfold),
        Row("memory of that", memory, "MB", most=1000.0),
    ]  # fmt: skip


def correcting(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001
    """Time `correct` on a log whose masses move at every sample, and the live correction of one sample."""
    data = table_1()
    calibration = fit(data).calibration
    rng = np.random.default_rng(1)
    n, few = 200_000, 2000
    field = data.field[rng.integers(0, len(data), n)]
    moving = rng.uniform(data.parameters.min(axis=0), data.parameters.max(axis=0), (n, 2))
    when = 4.0 * np.arange(float(n))
    kernel = calibration.kernel
    phi, table = (np.ascontiguousarray(part.T) for part in (kernel.monomials_of(moving), kernel.table))

    def live(positions: list[list[float]]) -> None:
        corrector = Corrector(calibration)
        for (x, y, z), value in zip(field[:few].tolist(), positions, strict=True):
            corrector.step(0, (x, y, z), value)

    def product() -> None:
        for start in range(0, n, CORRECTED_AT_ONCE):
            part = phi[start : start + CORRECTED_AT_ONCE]
            (part[:, kernel.first] * part[:, kernel.second]) @ table

    values = moving[:few].tolist()
    jobs: dict[str, tuple[Callable[[], object], int]] = {
        "product": (product, n),
        "moving": (lambda: correct(calibration, field, moving, when), n),
        "live": (lambda: live(values), few),
        "held": (lambda: live([values[0]] * few), few),
    }
    found: dict[str, list[float]] = {name: [] for name in jobs}
    with threadpool_limits(1):
        for _ in range(repetitions):
            for name, (job, samples) in jobs.items():
                found[name].append(1e6 * processor_time(job) / samples)
    ratio = median(b / a for a, b in zip(found["moving"], found["product"], strict=True))
    label = "the bare matrix product"
    return [
        Row("correct on arrays, all sigmas", median(found["moving"]), "us", median(found["product"]), label,
            ratio, least=0.5),
        Row("one sample live, positions held", median(found["held"]), "us"),
        Row("one sample live, positions new", median(found["live"]), "us"),
    ]  # fmt: skip


def table_1(noise: float = 1.0) -> Observations:
    """Return a random glider's runs of the paper's Table 1, with white noise of `noise` nT."""
    scenario = load("random_glider").replace(instrument={"noise_sigma": noise})
    return observations(segments(simulate(scenario, 1))["calibration"], NAMES)


def many(count: int) -> Observations:
    """Return `count` samples: the runs of Table 1 repeated, each time with new noise of 1 nT."""
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
