"""Time the fit against scipy's least squares, the correction against a matrix product, and the diagnosis."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from benchmarks.row import Row, in_own_process, processor_time
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from magbridge import fit, observations, save, write
from magbridge.calibration.correct import CORRECTED_AT_ONCE, correct
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.terms import full_order
from magbridge.estimation.residual import residuals_of
from sitl import load, segments, simulate
from sitl.mission import CrissCross

NAMES = ("battpos", "ballast")
MANY = (100_000, 1_000_000)
NIGHT, MONTH = 12.0, 720.0
"""Durations of the diagnosed logs, h."""
NIGHTLY, MONTHLY = 10.0, 1.0
"""Amplitude of the hidden effect in a night and in a month, nT/degC: signal-to-noise ratio of 30 to 45."""
FITTED = """
import json, resource, sys, time
from benchmarks.offline import many
from magbridge import fit
data = many(int(sys.argv[1]))
begun = time.process_time()
fit(data)
used = time.process_time() - begun
print(json.dumps([used, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3]))
"""
# another process simulates the log, because a month's simulation needs more memory than its diagnosis
SIMULATED = """
import sys
from pathlib import Path
from benchmarks.offline import long_survey
long_survey(Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]))
"""
DIAGNOSED = """
import json, resource, sys, time
from pathlib import Path
from magbridge import diagnose, load, read
folder = Path(sys.argv[1])
survey, calibration = read(folder / "survey.nc"), load(folder / "calibration.json")
begun = time.monotonic()
found = diagnose([survey], calibration).diagnosis
print(json.dumps([time.monotonic() - begun, len(found.problem),
                  resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1.024e-3]))
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
    (few, _), (most, memory) = (in_own_process(FITTED, count) for count in MANY)
    tenfold = f"{MANY[1] // MANY[0]} times {MANY[0]:,}"
    return [
        Row(f"auto, {len(data)} samples, 2 masses, one core", median(ours), "s", most=1.0),
        Row("scipy.optimize.least_squares on them", median(theirs), "s", median(ours), "auto", ratio,
            least=20.0),
        Row(f"auto, {MANY[1]:,} samples", most, "s", few * MANY[1] / MANY[0], tenfold),
        Row("memory of that", memory, "MB", most=1000.0),
    ]  # fmt: skip


def correcting(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001
    """Time `correct` on a log whose masses move at every sample, and the matrix product in it."""
    data = table_1()
    calibration = fit(data).calibration
    rng, n = np.random.default_rng(1), 200_000
    field = data.field[rng.integers(0, len(data), n)]
    moving = rng.uniform(data.parameters.min(axis=0), data.parameters.max(axis=0), (n, 2))
    when = 4.0 * np.arange(float(n))
    kernel = calibration.kernel
    phi, table = (np.ascontiguousarray(part.T) for part in (kernel.monomials_of(moving), kernel.table))

    def product() -> None:
        for start in range(0, n, CORRECTED_AT_ONCE):
            part = phi[start : start + CORRECTED_AT_ONCE]
            (part[:, kernel.first] * part[:, kernel.second]) @ table

    ours, bare = [], []
    with threadpool_limits(1):
        for _ in range(repetitions):
            ours.append(1e6 * processor_time(lambda: correct(calibration, field, moving, when)) / n)
            bare.append(1e6 * processor_time(product) / n)
    ratio = median(b / a for a, b in zip(ours, bare, strict=True))
    label = "the bare matrix product"
    return [Row("correct on arrays, all sigmas", median(ours), "us", median(bare), label, ratio, least=0.5)]


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


def diagnosing(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001  (others repeat)
    """Time `diagnose` without its figures on 12 h and 30 days, each without and with a hidden effect."""
    (night, few, _), (found, _, _), (month, many, _), (loud, _, memory) = (
        _diagnosed(folder, hours, size)
        for hours, size in ((NIGHT, 0.0), (NIGHT, NIGHTLY), (MONTH, 0.0), (MONTH, MONTHLY))
    )
    share, times = many / few, f"{many / few:.0f} times 12 h"
    hidden = "the same with an effect hidden in it"
    return [
        Row(f"diagnose, 12 h at 0.25 Hz ({few:,} samples), every cause, plain", night, "s", most=20.0),
        Row(hidden, found, "s", most=20.0),
        Row(f"diagnose, 30 days ({many:,} samples), every cause, plain", month, "s", night * share, times,
            most=240.0),
        Row(hidden, loud, "s", found * share, times, most=240.0),
        Row("memory of that", memory, "MB", most=2000.0),
    ]  # fmt: skip


def _diagnosed(folder: Path, hours: float, size: float) -> Any:
    in_own_process(SIMULATED, folder, hours, size)
    return in_own_process(DIAGNOSED, folder)


def long_survey(folder: Path, hours: float, size: float) -> None:
    """Write a glider's survey of `hours` and its calibration.

    `size` (nT/degC) is the slope of an added offset proportional to the logged temperature.
    """
    scenario = load("random_glider")
    survey = CrissCross(hours=hours, roll=(1.0, 2.0), pitch=(25.0, 2.5), battery_spread=0.1)
    scenario = scenario.replace(mission=(scenario.mission[0], survey))
    flown, rng = segments(simulate(scenario, 3)), np.random.default_rng(4)
    calibration = fit(observations(flown["calibration"], ["battpos", "ballast"]), "auto").calibration
    log = flown["survey"].drop_vars([name for name in flown["survey"] if str(name).startswith("truth_")])
    warm = log["sensor_temperature"].to_numpy()
    log["amps"] = ("time", (rng.uniform(size=len(warm)) > 0.7).astype(float), {"units": "A"})
    for axis, share in zip("xyz", (0.5, -0.3, 0.8), strict=True):
        log[f"mag_{axis}"] = log[f"mag_{axis}"] + size * share * (warm - warm.mean())
    write(log, folder / "survey.nc")
    save(calibration, folder / "calibration.json")
