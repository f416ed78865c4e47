"""Time the diagnosis of a 12 h and a 30-day deployment with every cause, each in its own process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from benchmarks.row import Row, in_own_process

from magbridge.calibration.file import save
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.logs import write
from sitl import load, segments, simulate
from sitl.mission import CrissCross

NIGHT, MONTH = 12.0, 720.0
"""Durations of the logs, h."""
NIGHTLY, MONTHLY = 10.0, 1.0
"""Amplitude of the hidden effect in a night and in a month, nT/degC: signal-to-noise ratio of 30 to 45."""

# another process simulates the log, because a month's simulation needs more memory than its diagnosis
SIMULATED = """
import sys
from pathlib import Path
from benchmarks.diagnose import survey_in
survey_in(Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]))
"""
DIAGNOSED = """
import json, resource, sys, time
from pathlib import Path
from magbridge import load, read
from magbridge.diagnose.run import diagnose
folder = Path(sys.argv[1])
survey, calibration = read(folder / "survey.nc"), load(folder / "calibration.json")
begun, used = time.monotonic(), time.process_time()
found = diagnose([survey], calibration).diagnosis
causes = [h.candidate.cause for h in found.findings]
print(json.dumps([time.monotonic() - begun, time.process_time() - used, len(found.problem), found.verdict,
                  causes, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1.024e-3]))
"""


def diagnosing(folder: Path, repetitions: int) -> list[Row]:  # noqa: ARG001  (others repeat)
    """Time `diagnose` without its figures on 12 h and 30 days, each without and with a hidden effect."""
    night, found, month, loud = (
        _diagnosed(folder, hours, size)
        for hours, size in ((NIGHT, 0.0), (NIGHT, NIGHTLY), (MONTH, 0.0), (MONTH, MONTHLY))
    )
    slope = float(np.log(month[1] / night[1]) / np.log(month[2] / night[2]))
    share = f"{month[2] / night[2]:.0f} times 12 h"
    return [
        Row(f"diagnose, 12 h at 0.25 Hz ({night[2]:,} samples), every cause, plain", night[0], "s",
            most=20.0),
        Row("the same with an effect hidden in it", found[0], "s", most=20.0),
        Row(f"diagnose, 30 days ({month[2]:,} samples), every cause, plain", month[0], "s",
            night[0] * month[2] / night[2], share, most=240.0),
        Row("the same with an effect hidden in it", loud[0], "s", found[0] * loud[2] / found[2], share,
            most=240.0),
        Row("memory of that", loud[5], "MB", most=2000.0),
        Row("processor time grows as samples to the power of", slope, ""),
    ]  # fmt: skip


def _diagnosed(folder: Path, hours: float, size: float) -> Any:
    in_own_process(SIMULATED, folder, hours, size)
    return in_own_process(DIAGNOSED, folder)


def survey_in(folder: Path, hours: float, size: float) -> None:
    """Write a survey's log and its calibration, made by :func:`long_survey`."""
    survey, calibration = long_survey(hours, size)
    write(survey, folder / "survey.nc")
    save(calibration, folder / "calibration.json")


def long_survey(hours: float, size: float = 0.0) -> tuple[xr.Dataset, Calibration]:
    """Return a glider's survey of `hours` with its calibration.

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
    return log, calibration
