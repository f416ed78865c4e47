"""The simulated worlds of the studies: random gliders with runs and a survey, and the paper's trials.

The noise floor of a survey is the error of a calibration that knows the vehicle (:func:`bound.oracle`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from bound import oracle

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNEL_TIMES, CHANNELS
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import igrf
from magbridge.field.reference import reference_field
from sitl import Twin, load, segments, simulate
from sitl.dataset import at_rest, corrected
from sitl.mission import CrissCross, Spirals
from sitl.platform import Vehicle
from sitl.scenario import Scenario

MASSES = ("battpos", "ballast")
NOISES = {"1 nT white": (1.0, 0.0), "5 nT AR(1)": (5.0, 10.0)}
"""Standard deviation of a channel (nT), and samples over which its correlation falls by e."""
PLANE_WAVES = 1500
"""Plane waves that make a Gaussian crustal field."""


# ---- random gliders that fly the paper's runs --------------------------------------------------------------


class Glider(NamedTuple):
    """A simulated vehicle with its calibration runs and its survey, without samples of masses in motion."""

    vehicle: Vehicle
    runs: xr.Dataset
    survey: xr.Dataset

    @property
    def floor(self) -> float:
        """Noise floor of the survey, nT RMS."""
        return rms(oracle(self.vehicle, self.survey) - true_field(self.survey))

    def score(self, calibration: Calibration) -> dict[str, float]:
        """Return the survey's error over the noise floor, and the deviation of its normalised error."""
        after = corrected(self.survey, calibration)
        error = after.total - true_field(self.survey)
        return {"ratio": rms(error) / self.floor, "sigma": float(np.std(error / after.sigma))}


def glider(scenario: Scenario, seed: int, masses: Sequence[str] = MASSES) -> Glider:
    """Simulate a random glider."""
    vehicle = Twin.draw(scenario, seed).vehicle
    assert isinstance(vehicle, Vehicle)
    parts = {name: at_rest(part, tuple(masses)) for name, part in segments(simulate(scenario, seed)).items()}
    return Glider(vehicle, parts["calibration"], parts["survey"])


def true_field(part: xr.Dataset) -> FloatArray:
    """Return the true total field (n,), nT."""
    return np.asarray(part["truth_total_field"].to_numpy())


# ---- surveys over a Gaussian crustal field -----------------------------------------------------------------


class GaussianRock:
    """A crustal field that is a Gaussian random field in the plane, along the main field, at every depth."""

    def __init__(self, size: float, length: float, direction: FloatArray, rng: np.random.Generator) -> None:
        self.k = rng.normal(0, 1 / length, (PLANE_WAVES, 2))
        self.phase = rng.uniform(0, 2 * np.pi, PLANE_WAVES)
        self.size, self.direction = size * np.sqrt(2 / PLANE_WAVES), direction

    def anomaly(self, place: FloatArray) -> FloatArray:
        """Return nT (n,) at places (n, 2), m north and east of the world's origin."""
        out = np.empty(len(place))
        for start in range(0, len(place), 4096):
            part = slice(start, start + 4096)
            out[part] = self.size * np.cos(place[part] @ self.k.T + self.phase).sum(axis=1)
        return out

    def field(self, ned: FloatArray) -> FloatArray:
        """Return nT (n, 3), north-east-down, as the simulated world's crust does."""
        return self.anomaly(ned[:, :2])[:, None] * self.direction


def fly_survey(
    hours: float, size: float, length: float, noise: str, seed: int
) -> tuple[Twin, dict[str, xr.Dataset]]:
    """Return a glider in its world, its calibration runs, and its surveys on two days."""
    sigma, memory = NOISES[noise]
    same = {"hours": hours, "pitch": (25.0, 2.5), "roll": (1.0, 2.0), "battery_spread": 0.1}
    parts = [Spirals(), CrissCross(**same), CrissCross(**same, segment="another day")]  # type: ignore[arg-type]
    scenario = load("random_glider").replace(
        mission=tuple(parts), instrument={"noise_sigma": sigma, "noise_memory": memory}
    )
    twin = Twin.draw(scenario, seed)
    latitude, longitude = twin.world.origin
    when = np.array([scenario.start.timestamp()])
    main = igrf(np.array([longitude]), np.array([latitude]), np.zeros(1), when)[0]
    drawn = GaussianRock(size, length, main / np.linalg.norm(main), np.random.default_rng([seed, 7]))
    twin = replace(twin, world=replace(twin.world, rock=drawn))  # type: ignore[arg-type]
    flown = twin.fly()
    log = twin.measure(flown, np.arange(0.0, flown.elapsed[-1] - 1.0, 1 / scenario.instrument.rate))
    return twin, {name: at_rest(part, MASSES) for name, part in segments(log).items()}


def drifted(log: xr.Dataset, by: float) -> xr.Dataset:
    """Return a log whose positions are slowly off by `by` m north and east, as dead-reckoned ones."""
    t = (log["time"] - log["time"][0]) / float(log["time"][-1] - log["time"][0])
    per_latitude, per_longitude = metres_per_degree(float(log["latitude"].mean()))
    north, east = by * np.sin(2.2 * np.pi * t + 0.3), by * (np.cos(1.7 * np.pi * t) - 1.0)
    return log.assign(
        latitude=log["latitude"] + north / per_latitude, longitude=log["longitude"] + east / per_longitude
    )


# ---- the paper's trials ------------------------------------------------------------------------------------

METHODS: dict[str, dict[str, Any]] = {
    "nominal": {"axes_fixed": True, "equal_xz": True},
    "cubic": {},
    "auto": {},
}
"""The paper's two methods, with its constraints, and the default."""
TRIALS = ("trial 1", "trial 2")
PAPER = {
    ("trial 1", "nominal"): (153, 207),
    ("trial 2", "nominal"): (145, 136),
    ("trial 1", "cubic"): (29, 124),
    ("trial 2", "cubic"): (17, 69),
}
"""nT RMS on the calibration runs and on the survey (section 4 and Table 2)."""


@dataclass(frozen=True)
class Trials:
    """A simulated deployment of the paper, and each method's result on it.

    Attributes
    ----------
    parts : dict of Dataset
        Trial 1, survey, trial 2.
    corrected : dict of array (n,)
        By (part, trial of the coefficients, method), nT.
    failed : dict of str
        Reason of the failure, by (trial, method).
    scales : dict of (float, float)
        By (trial, method), the smallest and the largest scale of A on its runs: a fit can lower its
        residual by shrinking them.
    anomaly : AnomalyGrid
        The map used as reference of the fit.
    """

    parts: dict[str, xr.Dataset]
    corrected: dict[tuple[str, str, str], FloatArray]
    failed: dict[tuple[str, str], str]
    scales: dict[tuple[str, str], tuple[float, float]]
    anomaly: AnomalyGrid

    def error(self, part: str, trial: str, method: str, against: str = "reference_field") -> FloatArray:
        """Return the error of `method` with the coefficients of `trial`, (n,) nT; NaN where it failed."""
        known = self.parts[part][against].to_numpy()
        found: FloatArray = self.corrected.get((part, trial, method), np.full(known.shape, np.nan))
        return np.asarray(found - known)

    def rms(self, part: str, trial: str, method: str) -> float:
        """Return the RMS of :meth:`error` against the reference, nT."""
        return rms(self.error(part, trial, method))


def measure_trials(twin: Twin, *, at_depth: bool = False) -> dict[str, xr.Dataset]:
    """Fly trial 1, survey and trial 2; return each on one time base, without the samples of masses in motion.

    With `at_depth` the reference is the map continued down to the glider, as ``--grid`` does it; else the
    scenario's: the map at the altitude of its survey, as in the paper.
    """
    track = twin.fly()
    instrument = twin.scenario.instrument
    when = np.arange(0.0, track.elapsed[-1] - max(instrument.channel_delay), 1 / instrument.rate)
    parts = segments(at_rest(_on_row_times(twin.measure(track, when)), MASSES))
    if not at_depth:
        return parts
    grid = twin.anomaly_map()
    for name, part in parts.items():
        known = reference_field(part.drop_vars("reference_field"), grid)
        parts[name] = part.assign(reference_field=("time", known))
    return parts


def fly_trials(seed: int, methods: Sequence[str] = tuple(METHODS), *, at_depth: bool = False) -> Trials:
    """Simulate the paper's deployment; calibrate it on both trials with each method."""
    twin = Twin.draw(load("bonne_bay"), seed)
    parts = measure_trials(twin, at_depth=at_depth)
    total, failed, scales = {}, {}, {}
    for trial, method in product(TRIALS, methods):
        used = () if method == "nominal" else MASSES
        try:
            fitted = fit(observations(parts[trial], used), method, **METHODS[method])
        except CalibrationError as error:
            failed[trial, method] = str(error)
            continue
        scales[trial, method] = fitted.scales
        for part in (trial, "survey"):
            total[part, trial, method] = corrected(parts[part], fitted.calibration).total
    return Trials(parts, total, failed, scales, twin.anomaly_map())


def _on_row_times(deployment: xr.Dataset) -> xr.Dataset:
    """Interpolate the channels linearly to the time of their row, as the paper does."""
    time = deployment["time"].to_numpy()
    moved = {n: ("time", np.interp(time, deployment[f"mag_time_{n[-1]}"], deployment[n])) for n in CHANNELS}
    return deployment.assign(moved).drop_vars(CHANNEL_TIMES)
