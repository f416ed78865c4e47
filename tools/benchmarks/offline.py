"""Time the fit against scipy's least squares, the correction against a matrix product, and the diagnosis."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median

import numpy as np
from benchmarks.row import Row, alternating, in_own_process, median_ratio, peak_memory, processor_time
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from magbridge import diagnose, fit, load, observations, read, save, write
from magbridge.calibration.correct import CORRECTED_AT_ONCE, correct
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.terms import full_order
from magbridge.estimation.residual import residuals_of
from sitl import load as load_scenario
from sitl import segments, simulate
from sitl.mission import CrissCross

NAMES = ("battpos", "ballast")
MANY = (100_000, 1_000_000)
NIGHT, MONTH = 12.0, 720.0
"""Durations of the diagnosed logs, h."""
NIGHTLY, MONTHLY = 10.0, 1.0
"""Amplitude of the hidden effect in a night and in a month, nT/degC: signal-to-noise ratio of 30 to 45."""


def fitting(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001  (the others write there)
    """Time `auto` on a glider's runs, scipy's least squares on these runs, and `auto` on many samples."""
    data = table_1()
    samples = polynomial_samples(data, full_order(2, 3))

    def by_scipy() -> object:
        return least_squares(lambda c: residuals_of(samples, c), np.zeros(90), method="lm")

    with threadpool_limits(1):
        ours, theirs = alternating(
            repetitions, lambda: processor_time(lambda: fit(data)), lambda: processor_time(by_scipy)
        )
    (few, _), (most, memory) = (in_own_process(fit_many, count) for count in MANY)
    tenfold = f"{MANY[1] // MANY[0]} times {MANY[0]:,}"
    return [
        Row(f"auto, {len(data)} samples, 2 masses, one core", median(ours), "s", most=1.0),
        Row("scipy.optimize.least_squares on them", median(theirs), "s", median(ours), "auto",
            median_ratio(theirs, ours), least=20.0),
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

    with threadpool_limits(1):
        ours, bare = alternating(
            repetitions,
            lambda: 1e6 * processor_time(lambda: correct(calibration, field, moving, when)) / n,
            lambda: 1e6 * processor_time(product) / n,
        )
    label, ratio = "the bare matrix product", median_ratio(bare, ours)
    return [Row("correct on arrays, all sigmas", median(ours), "us", median(bare), label, ratio, least=0.5)]


def table_1(noise: float = 1.0) -> Observations:
    """Return a random glider's runs of the paper's Table 1, with white noise of `noise` nT."""
    scenario = load_scenario("random_glider").replace(instrument={"noise_sigma": noise})
    return observations(segments(simulate(scenario, 1))["calibration"], NAMES)


def fit_many(count: int) -> tuple[float, float]:
    """Return processor time (s) and memory (MB) of a fit of `count` samples: Table 1 with noise of 1 nT."""
    runs = table_1(0.0)
    rng = np.random.default_rng(2)
    pick = np.arange(count) % len(runs)
    data = Observations(
        field=runs.field[pick] + rng.normal(0.0, 1.0, (count, 3)),
        reference=runs.reference[pick],
        parameters=runs.parameters[pick],
        names=runs.names,
        units=runs.units,
        runs=runs.runs[pick].astype(int) + 10 * (np.arange(count) // len(runs)),
        time=4.0 * np.arange(float(count)),
    )
    return processor_time(lambda: fit(data)), peak_memory()


def diagnosing(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001  (others repeat)
    """Time `diagnose` without its figures on 12 h and 30 days, each without and with a hidden effect."""
    found = []
    for hours, size in ((NIGHT, 0.0), (NIGHT, NIGHTLY), (MONTH, 0.0), (MONTH, MONTHLY)):
        # another process simulates the log, because a month's simulation needs more memory than its diagnosis
        in_own_process(write_survey, folder, hours, size)
        found.append(in_own_process(diagnose_survey, folder))
    (night, few, _), (effect, _, _), (month, many, _), (loud, _, memory) = found
    share, times = many / few, f"{many / few:.0f} times 12 h"
    hidden = "the same with an effect hidden in it"
    return [
        Row(f"diagnose, 12 h at 0.25 Hz ({few:,} samples), every cause, plain", night, "s", most=20.0),
        Row(hidden, effect, "s", most=20.0),
        Row(f"diagnose, 30 days ({many:,} samples), every cause, plain", month, "s", night * share, times,
            most=240.0),
        Row(hidden, loud, "s", effect * share, times, most=240.0),
        Row("memory of that", memory, "MB", most=2000.0),
    ]  # fmt: skip


def diagnose_survey(folder: Path) -> tuple[float, int, float]:
    """Diagnose the survey in a folder; return the time (s), the number of samples, and the memory (MB)."""
    log, calibration = read(folder / "survey.nc"), load(folder / "calibration.json")
    begun = time.monotonic()
    found = diagnose([log], calibration).diagnosis
    return time.monotonic() - begun, len(found.problem), peak_memory()


def write_survey(folder: Path, hours: float, size: float) -> None:
    """Write a glider's survey of `hours` and its calibration, with an offset of `size`, nT/degC."""
    scenario = load_scenario("random_glider")
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
