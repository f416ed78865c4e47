"""Measure and plot the accuracy of a bridge that starts without a calibration, as a function of time.

    python tools/live_nothing.py --seeds 4 --hours 24 -o docs/figures/learning.png

Random gliders survey a crustal field of 60 nT in a criss-cross, with the IGRF as the only reference and no
calibration run. *Error* is the published field's error without bias over the noise floor, in each stretch
of the survey; *mean* is its mean error, which is not observable; *normalised* includes both.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import live
import numpy as np
import pandas as pd
from studies import Column, Row, Study
from study_worlds import MASSES

from magbridge.calibration.model import Parameter
from magbridge.estimation.residual import rms
from magbridge.learning import Learner
from magbridge.learning.estimator import class_prior

STRETCH_ENDS_H = (0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.5, 2.25, 3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0)
SENSOR_NOISE_NT = 1.0


def run(seed: int, hours: float) -> list[Row]:
    """Return a row for each stretch of one glider's survey."""
    log = live.sampled(live.fly("nothing", seed, hours)[1])
    parameters = []
    for name in MASSES:
        low, high = float(log[name].min()), float(log[name].max())
        parameters.append(Parameter(name, "", low, high, 0.5 * (low + high), 0.5 * (high - low)))
    prior = class_prior(tuple(parameters))
    seen = live.learn(Learner(prior), prior, log)
    time, error = live.hours_of(log), seen.total - log["truth_total_field"].to_numpy()
    rest = live.at_rest(seen.quality)
    rows: list[Row] = []
    for low, high in pairwise(STRETCH_ENDS_H):
        here = rest & (time >= low) & (time < high)
        if here.sum() > 10:
            rows.append(
                {
                    "stretch": f"{low:g} to {high:g} h", "middle": float(np.sqrt(low * high)),
                    "error": float(np.std(error[here])) / SENSOR_NOISE_NT,
                    "mean": abs(float(np.mean(error[here]))), "sigma": float(np.median(seen.sigma[here])),
                    "normalised": rms((error / seen.sigma)[here]),
                }
            )  # fmt: skip
    return rows


STUDY = Study(
    run,
    ("stretch",),
    {
        "error / noise": Column("error"),
        "maximum": Column("error", np.max),
        "mean, nT": Column("mean", form=".0f"),
        "sigma, nT": Column("sigma", form=".0f"),
        "normalised": Column("normalised", rms),
        "its maximum": Column("normalised", np.max),
    },
)


def draw(rows: pd.DataFrame, file: Path) -> None:
    """Plot error and sigma against the time since the start, and write the plot to `file`."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - only here

    figure, axes = plt.subplots(figsize=(7.0, 4.0), constrained_layout=True)
    for _, one in rows.groupby("seed"):
        axes.plot(one["middle"], one["error"], color="tab:blue", alpha=0.35, lw=1)
        axes.plot(one["middle"], one["mean"], color="tab:orange", alpha=0.35, lw=1)
    middle = rows.groupby("middle")[["error", "mean", "sigma"]].median()
    axes.plot(middle.index, middle["error"], "o-", color="tab:blue", label="error about the mean")
    axes.plot(middle.index, middle["mean"], "s-", color="tab:orange", label="mean error")
    axes.plot(middle.index, middle["sigma"], "k--", label="claimed sigma, of both")
    axes.axhline(SENSOR_NOISE_NT, color="0.5", lw=1, label="noise of the sensor")
    axes.set(xscale="log", yscale="log", xlabel="hours since the start", ylabel="nT")
    axes.set_xticks([0.1, 0.3, 1, 3, 6, 12, 24], ["0.1", "0.3", "1", "3", "6", "12", "24"])
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(file)


if __name__ == "__main__":
    # the plot's file is the argument after -o
    rows = STUDY.main(__doc__, seeds=4, first=0, hours=24.0, o=Path)
    if "-o" in sys.argv:
        draw(rows, Path(sys.argv[sys.argv.index("-o") + 1]))
