"""Measure the accuracy of a bridge that starts without a calibration, as a function of time.

    python tools/live_nothing.py --seeds 4 --hours 24

Random gliders survey a crustal field of 60 nT in a criss-cross, with the IGRF as the only reference and no
calibration run. *Error* is the published field's error without bias over the noise floor, in each stretch
of the survey; *mean* is its mean error, which is not observable; *normalised* includes both.
"""

from __future__ import annotations

from itertools import pairwise

import live
import numpy as np
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
                    "stretch": f"{low:g} to {high:g} h",
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


if __name__ == "__main__":
    STUDY.main(__doc__, seeds=4, first=0, hours=24.0)
