"""Diagnosing: a night's deployment with every cause, and a month's, in a process of its own each."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import xarray as xr
from benchmarks.measure import in_own_process
from benchmarks.row import Row

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from sitl import load, segments, simulate
from sitl.mission import CrissCross

__all__ = ["diagnosing", "long_survey"]

MONTH = 648_000
"""Samples of 30 days at 0.25 Hz."""
NIGHTLY, MONTHLY = 10.0, 1.0
"""nT/degC, in a night and in a month: either makes a signal-to-noise ratio of 30 to 40."""

IN_ANOTHER = """
import json, resource, sys, time
from benchmarks.diagnose import long_survey
from magbridge.diagnose.run import diagnose
survey, calibration = long_survey(float(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
begun, used = time.monotonic(), time.process_time()
found = diagnose([survey], calibration)
causes = [h.candidate.cause for h in found.findings]
print(json.dumps([time.monotonic() - begun, time.process_time() - used, len(found.problem), found.verdict,
                  causes, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3]))
"""


def diagnosing(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001  (others write there and repeat)
    """Time `diagnose` without its figures: 12 h and 30 days, plain and with an effect."""
    night, found, month, loud = (
        in_own_process(IN_ANOTHER, 12, count, size)
        for size, count in ((0.0, 0), (NIGHTLY, 0), (0.0, MONTH), (MONTHLY, MONTH))
    )
    fields = ("seconds", "processor seconds", "samples", "verdict", "causes", "MB")
    detail = {name: [run[k] for run in (night, found, month, loud)] for k, name in enumerate(fields)}
    slope = float(np.log(month[1] / night[1]) / np.log(month[2] / night[2]))
    share = f"{month[2] / night[2]:.0f} times 12 h"
    return [
        Row(f"diagnose, 12 h at 0.25 Hz ({night[2]:,} samples), every cause, plain", night[0], "s",
            most=20.0),
        Row("the same with an effect hidden in it", found[0], "s", most=20.0, detail=detail),
        Row(f"diagnose, 30 days ({month[2]:,} samples), every cause, plain", month[0], "s",
            night[0] * month[2] / night[2], share, most=240.0),
        Row("the same with an effect hidden in it", loud[0], "s", found[0] * loud[2] / found[2], share,
            most=240.0),
        Row("memory of that", loud[5], "MB", most=2000.0),
        Row("processor time grows as samples to the power of", slope, ""),
    ]  # fmt: skip


def long_survey(hours: float, count: int = 0, size: float = 0.0) -> tuple[xr.Dataset, Calibration]:
    """Return a glider's survey with its calibration.

    Parameters
    ----------
    hours : float
        How long it lasts.
    count : int
        Number of samples: the survey is repeated, each time with new noise; 0: flown once.
    size : float
        nT/degC of an offset proportional to the logged temperature.
    """
    scenario = load("random_glider")
    replace = msgspec.structs.replace
    parts = (
        scenario.mission[0],
        CrissCross(hours=hours, roll=(1.0, 2.0), pitch=(25.0, 2.5), battery_spread=0.1),
    )
    whole = segments(simulate(replace(scenario, mission=parts), 3))
    calibration = fit(observations(whole["calibration"], ["battpos", "ballast"]), "auto").calibration
    # a survey that is repeated must not repeat its noise: that would be a tone
    quiet = replace(
        scenario,
        instrument=replace(scenario.instrument, noise_sigma=0.0, channel_delay=(0.0, 0.0, 0.0)),
        mission=parts,
    )
    survey, rng = segments(simulate(quiet, 3))["survey"], np.random.default_rng(4)
    n = survey.sizes["time"]
    if count:
        time = survey["time"].to_numpy()
        times = -(-count // n)
        late = np.repeat(np.arange(times) * (time[-1] - time[0] + 4.0), n)[:count]
        survey = survey.isel(time=np.tile(np.arange(n), times)[:count])
        survey = survey.assign_coords(time=survey["time"].to_numpy() + late)
    warm = survey["sensor_temperature"].to_numpy()
    survey["amps"] = ("time", (rng.uniform(size=len(warm)) > 0.7).astype(float), {"units": "A"})
    for axis, share in zip("xyz", (0.5, -0.3, 0.8), strict=True):
        again = rng.normal(0.0, scenario.instrument.noise_sigma, len(warm)) + size * share * (
            warm - warm.mean()
        )
        survey[f"mag_{axis}"] = survey[f"mag_{axis}"] + again
    return survey, calibration
