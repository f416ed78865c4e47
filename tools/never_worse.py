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
from independent import Log, along, calibrated, rotated
from live import learn
from studies import Column, Row, Study

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.field.igrf import igrf
from magbridge.learning import Learner

START_S = 1_780_000_000.0
"""Time of the first sample, s since 1970 UTC."""
STEP_S = 4.0
"""Time between two samples, s."""
METRES_PER_DEGREE = 111_200.0
MU0_OVER_4PI_NT = 100.0
"""mu_0 / 4 pi in nT m^3 / (A m^2)."""
MASSES = ("battpos", "ballast")


class Crust:
    """Random crustal anomaly with a given standard deviation (nT) and shortest wavelength (m)."""

    def __init__(self, seed: int, sigma_nt: float, wavelength_m: float, waves: int = 60) -> None:
        rng = np.random.default_rng([seed, 11])
        length = wavelength_m * np.exp(rng.uniform(0.0, 2.0, waves))
        angle = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._k = 2.0 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._amplitude = sigma_nt * np.sqrt(2.0 / waves)

    def at_position(self, metres: FloatArray) -> FloatArray:
        """Return the anomaly (n,), nT, at positions (n, 2), m north and east."""
        return np.asarray(self._amplitude * np.cos(metres @ self._k.T + self._phase).sum(axis=1))


class Vehicle:
    """Magnetic model of a vehicle: hard iron, soft iron and dipole masses, drawn from `seed`."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        self._hard = rng.normal(0.0, 800.0, 3)
        self._soft = np.eye(3) + rng.normal(0.0, 0.012, (3, 3))
        self._moment = {name: rng.normal(0.0, 1.6, 3) for name in MASSES}
        self._induced = {name: abs(rng.normal(0.0, 1.0e-5)) for name in MASSES}  # A m^2 per nT
        self._home = {}
        for name in MASSES:
            away = rng.normal(size=3)
            self._home[name] = away / np.linalg.norm(away) * rng.uniform(0.55, 0.75)

    def reads(self, log: Log) -> FloatArray:
        """Return the noiseless readings (n, 3), nT."""
        out = log.body @ self._soft.T + self._hard
        for name in MASSES:
            r = self._home[name] + log.columns[name][:, None] * np.array([0.0254, 0.0, 0.0])
            distance = np.linalg.norm(r, axis=1)[:, None]
            n = r / distance
            moment = self._moment[name] + self._induced[name] * log.body
            radial = np.sum(n * moment, axis=1)[:, None]
            out = out + MU0_OVER_4PI_NT * (3.0 * n * radial - moment) / distance**3
        return np.asarray(out)


def smooth(values: FloatArray, samples: float) -> FloatArray:
    """Return the moving mean of values (n,) over a number of samples, which turns steps into ramps."""
    width = max(round(samples), 1)
    padded = np.concatenate([np.full(width, values[0]), values, np.full(width, values[-1])])
    kernel = np.ones(width) / width
    return np.asarray(np.convolve(padded, kernel, "same")[width:-width])


def wander(rng: np.random.Generator, n: int, step: float, tau: float, sigma: float) -> FloatArray:
    """Return a smoothed Ornstein-Uhlenbeck process (n,) with time constant `tau` (s) and 1-sigma `sigma`."""
    keep = np.exp(-step / tau)
    out = np.empty(n)
    state = rng.normal()
    for k, shock in enumerate(rng.normal(size=n) * np.sqrt(1.0 - keep**2)):
        state = keep * state + shock
        out[k] = state
    return smooth(sigma * out, 3.0 / step)


def logged(seed: int, hours: float, *, spirals: bool, crust: Crust | None = None) -> Log:
    """Simulate a glider's dives over a criss-cross, or ten banked spirals for a calibration."""
    rng = np.random.default_rng([seed, 5, int(spirals)])
    n = int(3600.0 * hours / STEP_S)
    seconds = STEP_S * np.arange(n)
    leg = np.floor(seconds / (180.0 if spirals else 840.0)).astype(int)
    climbing = leg % 2 == 1
    jitter = rng.normal(size=leg[-1] + 1)[leg]
    steep = np.radians(24.0) + np.radians(3.0) * jitter
    pitch = smooth(np.where(climbing, steep, -steep), 25.0 / STEP_S)
    battpos = smooth(np.where(climbing, -0.8, 0.8) + 0.12 * jitter, 20.0 / STEP_S)
    trims = rng.normal(0.0, 0.05, int(seconds[-1] / 240.0) + 1)[(seconds / 240.0).astype(int)]
    battpos = battpos + smooth(trims, 4.0 / STEP_S)
    ballast = smooth(np.where(climbing, 1.0, -1.0), 30.0 / STEP_S)
    if spirals:
        run = np.minimum((seconds / (3600.0 * hours / 10.0)).astype(int), 9)
        bank = np.radians(rng.uniform(-35.0, 35.0, 10))
        heading = np.cumsum(np.full(n, np.radians(2.2) * STEP_S))
        roll = smooth(bank[run], 10.0 / STEP_S)
        battpos = battpos * (0.4 + 0.12 * run)
        ballast = ballast * (1.0 - 0.09 * (run % 5))
    else:
        course = np.radians(rng.choice([20.0, 110.0, 200.0, 290.0], int(seconds[-1] / 2400.0) + 2))
        course += rng.normal(0.0, 0.15, len(course))
        heading = smooth(np.unwrap(course)[(seconds / 2400.0).astype(int)], 40.0 / STEP_S)
        roll = np.radians(rng.uniform(-3.0, 3.0)) + np.zeros(n)
    for angle, sigma in ((pitch, 0.6), (roll, 0.8), (heading, 2.0)):
        angle[:] = angle + np.radians(wander(rng, n, STEP_S, 20.0, sigma))
    vertical = 0.16 * np.sin(pitch) / np.sin(np.radians(24.0))
    depth = np.maximum(1.0 - np.cumsum(vertical) * STEP_S, 0.0)
    north, east = (np.cumsum(0.35 * turn(heading)) * STEP_S for turn in (np.cos, np.sin))
    columns = {
        "time": START_S + 3.0 * 86_400.0 * (not spirals) + seconds,
        "roll": np.degrees(roll), "pitch": np.degrees(pitch), "heading": np.degrees(heading),
        "latitude": 47.5 + north / METRES_PER_DEGREE,
        "longitude": -59.0 + east / (METRES_PER_DEGREE * np.cos(np.radians(47.5))),
        "depth": depth, "battpos": battpos, "ballast": ballast,
        "sensor_temperature": 4.0 + 9.0 / (1.0 + np.exp((depth - 40.0) / 6.0)),
    }  # fmt: skip
    ned = igrf(columns["longitude"], columns["latitude"], depth, columns["time"])
    if crust is not None:  # its field is along the main field
        metres = np.stack([north - north[0], east - east[0]], axis=1)
        ned *= 1.0 + (crust.at_position(metres) / np.linalg.norm(ned, axis=1))[:, None]
    return Log(columns, rotated(columns, ned))


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
    glider, rng = Vehicle(vehicle), np.random.default_rng([vehicle, 21])
    runs = logged(vehicle, 5.0, spirals=True)
    known = runs.dataset(glider.reads(runs) + rng.normal(0.0, 1.0, runs.body.shape))
    known = known[["mag_x", "mag_y", "mag_z", *MASSES]]
    n = len(runs.time)
    known["reference_field"] = "time", np.linalg.norm(runs.body, axis=1), {"units": "nT"}
    known["segment"] = "time", np.floor(10.0 * np.arange(n) / n).astype(int).astype(str)
    calibration = calibrated(known, MASSES)
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
