"""Compare in-flight calibration with the fixed calibration, in a simulation that does not use ``sitl``.

    python3 tools/never_worse.py                         every change, vehicles 1 to 4
    python3 tools/never_worse.py --changes none --vehicles 11 12

Each vehicle has two dipole masses and 1 nT of white noise. It is calibrated with ten
runs whose true field is known. It then surveys a crustal field of 7 nT (standard deviation) for 12 hours at
0.25 Hz with one hidden change. The reference is the IGRF alone. Errors are RMS, nT: from one hour after a
step on, else from the start.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from independent import Crust, Dipoles, Log, along, logged
from live import learn
from studies import Column, Row, Study

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.learning import Learner


def seconds(log: Log) -> FloatArray:
    """Return the time since the middle of the survey (n,), s."""
    return np.asarray(log.time - log.time[len(log.time) // 2])


CHANGES: dict[str, Callable[[Log], np.ndarray]] = {
    "none": lambda log: np.zeros(len(log.time)),
    "offset step of 60 nT": lambda log: 60.0 * (seconds(log) >= 0.0),
    "offset drift": lambda log: 60.0 * np.linspace(0.0, 1.0, len(log.time)),
    "temperature": lambda log: log.columns["sensor_temperature"] - 10.0,
    "current without telemetry": lambda log: 20.0 * (log.time % 600.0 < 120.0),
}
"""Functions that return a hidden field (n,), nT, along a random direction: a step in the middle of the
survey, a drift over all of it, 1 nT/degC, and a pump that is on in two of every ten minutes."""


def run(change: str, vehicle: int, hours: float) -> list[Row]:
    """Return the row of one vehicle: RMS errors of the fixed and of the in-flight calibration."""
    glider, rng = Dipoles(vehicle), np.random.default_rng([vehicle, 21])
    calibration = glider.calibrated(vehicle, lambda n: rng.normal(0.0, 1.0, (n, 3)))
    survey = logged(vehicle, hours, spirals=False, crust=Crust(vehicle, 7.0, 900.0))
    hidden = along(CHANGES[change](survey), rng)
    log = survey.dataset(glider.reads(survey) + hidden + rng.normal(0.0, 1.0, hidden.shape))
    fixed, learned = (learn(one, calibration, log, age_s=0.0) for one in (None, Learner(calibration)))
    late = fixed.quality & 0b101 == 0  # no mass moves
    if change.startswith("offset step"):
        late &= seconds(survey) > 3600.0
    truth = np.linalg.norm(survey.body, axis=1)
    errors = [(one.total - truth)[late] for one in (fixed, learned)]
    row: Row = {"fixed": rms(errors[0]), "learned": rms(errors[1])}
    row |= {"ratio": row["learned"] / row["fixed"], "about": float(errors[1].std())}
    return [row | {"standardised": rms(errors[1] / learned.sigma[late]), "alarms": len(learned.alarms)}]


STUDY = Study(
    run,
    ("change", "vehicle"),
    {
        "fixed, nT": Column("fixed"),
        "learned, nT": Column("learned"),
        "about the mean": Column("about"),
        "learned / fixed": Column("ratio", form=".3f"),
        "standardised": Column("standardised"),
        "alarms": Column("alarms", form=".0f"),
    },
)


if __name__ == "__main__":
    STUDY.main(__doc__, changes=list(CHANGES), vehicles=[1, 2, 3, 4], hours=12.0)
