"""Simulated worlds of the studies: random gliders with runs and a survey, and the paper's trials.

The noise floor of a survey is the error of a calibration that knows the vehicle (:func:`oracle`);
:func:`best_fit` and :func:`survey_bound` are Cramér-Rao bounds for the vehicle's true model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import msgspec
import numpy as np
import xarray as xr
from scipy.spatial.distance import cdist
from studies import Column, percentile

from magbridge import Calibration, fit, observations, reference_field
from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import Fit
from magbridge.columns import CHANNEL_TIMES, CHANNELS
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.igrf import igrf
from sitl import Scenario, Twin, load, segments, simulate
from sitl.dataset import at_rest, channels, corrected
from sitl.mission import CrissCross, Spirals
from sitl.platform import HARD_IRON, MOMENT, SOFT_IRON, VOLUME_SPREAD, Vehicle

MASSES = ("battpos", "ballast")
NOISES = {"1 nT white": (1.0, 0.0), "5 nT AR(1)": (5.0, 10.0)}
"""Standard deviation of a channel's noise (nT), and its correlation time (1/e), in samples."""
MAX_COVARIANCE_SAMPLES = 2_700
"""Maximum number of samples in the covariance matrix of a survey bound."""
PLANE_WAVES = 1500
"""Number of plane waves in a Gaussian crustal field."""


# ---- random gliders that fly the paper's runs --------------------------------------------------------------


class Glider(NamedTuple):
    """Simulated vehicle, its calibration runs and its survey, without samples of moving masses."""

    vehicle: Vehicle
    runs: xr.Dataset
    survey: xr.Dataset

    @property
    def floor(self) -> float:
        """Noise floor of the survey, nT RMS."""
        return rms(oracle(self.vehicle, self.survey) - true_field(self.survey))

    def score(self, calibration: Calibration) -> dict[str, float]:
        """Return the survey's RMS error over the noise floor, and the deviation of its normalised error."""
        after = corrected(self.survey, calibration)
        error = after.total - true_field(self.survey)
        return {"ratio": rms(error) / self.floor, "sigma": float(np.std(error / after.sigma))}


SCORES = {
    "error / noise: median": Column("ratio", np.median, ".3f"),
    "95 %": Column("ratio", percentile(95), ".3f"),
    "maximum": Column("ratio", np.max, ".3f"),
    "normalised error: median": Column("sigma"),
}
"""Columns of a study's table for the rows of :meth:`Glider.score`."""


def glider(scenario: Scenario, seed: int, masses: Sequence[str] = MASSES) -> Glider:
    """Return a simulated random glider with its runs and its survey."""
    vehicle = Twin.draw(scenario, seed).vehicle
    assert isinstance(vehicle, Vehicle)
    parts = {name: at_rest(part, tuple(masses)) for name, part in segments(simulate(scenario, seed)).items()}
    return Glider(vehicle, parts["calibration"], parts["survey"])


def true_field(part: xr.Dataset) -> FloatArray:
    """Return the true total field (n,), nT."""
    return np.asarray(part["truth_total_field"].to_numpy())


# ---- surveys over a Gaussian crustal field -----------------------------------------------------------------


class GaussianRock:
    """Gaussian random crustal field in the horizontal plane, along the main field, equal at every depth."""

    def __init__(self, size: float, length: float, direction: FloatArray, rng: np.random.Generator) -> None:
        self.k = rng.normal(0, 1 / length, (PLANE_WAVES, 2))
        self.phase = rng.uniform(0, 2 * np.pi, PLANE_WAVES)
        self.size, self.direction = size * np.sqrt(2 / PLANE_WAVES), direction

    def anomaly(self, place: FloatArray) -> FloatArray:
        """Return the anomaly (n,), nT, at places (n, 2), m north and east of the world's origin."""
        out = np.empty(len(place))
        for start in range(0, len(place), 4096):
            part = slice(start, start + 4096)
            out[part] = self.size * np.cos(place[part] @ self.k.T + self.phase).sum(axis=1)
        return out

    def field(self, ned: FloatArray) -> FloatArray:
        """Return the crustal field (n, 3), nT north-east-down, at places (n, 3), m."""
        return self.anomaly(ned[:, :2])[:, None] * self.direction


def fly_survey(
    hours: float, size: float, length: float, noise: str, seed: int
) -> tuple[Twin, dict[str, xr.Dataset]]:
    """Return a simulated glider in its world, its calibration runs, and its surveys on two days."""
    sigma, memory = NOISES[noise]
    same = {"hours": hours, "pitch": (25.0, 2.5), "roll": (1.0, 2.0), "battery_spread": 0.1}
    parts = [Spirals(), CrissCross(**same), CrissCross(**same, segment="another day")]  # type: ignore[arg-type]
    instrument = {"noise_sigma": sigma, "noise_memory": memory}
    scenario = load("random_glider").replace(mission=tuple(parts), instrument=instrument)
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
    """Return a log whose positions drift by up to about `by` m, as dead-reckoned positions do."""
    t = (log["time"] - log["time"][0]) / float(log["time"][-1] - log["time"][0])
    per_latitude, per_longitude = metres_per_degree(float(log["latitude"].mean()))
    north, east = by * np.sin(2.2 * np.pi * t + 0.3), by * (np.cos(1.7 * np.pi * t) - 1.0)
    latitude = log["latitude"] + north / per_latitude
    return log.assign(latitude=latitude, longitude=log["longitude"] + east / per_longitude)


# ---- the paper's trials ------------------------------------------------------------------------------------

METHODS: dict[str, dict[str, Any]] = {"nominal": {"constrained": True}, "cubic": {}, "auto": {}}
"""Options of the fit by method: the paper's two methods with its constraints, and the default."""
TRIALS = ("trial 1", "trial 2")
PAPER = {
    ("trial 1", "nominal"): (153, 207),
    ("trial 2", "nominal"): (145, 136),
    ("trial 1", "cubic"): (29, 124),
    ("trial 2", "cubic"): (17, 69),
}
"""The paper's errors on the calibration runs and on the survey, nT RMS (section 4 and Table 2)."""


class Trials(NamedTuple):
    """Simulated deployment of the paper: trial 1, survey and trial 2, and the fits by trial and method.

    A refused fit is the text of its reason. A fit with small scales of A has a small residual.
    """

    parts: dict[str, xr.Dataset]
    fits: dict[tuple[str, str], Fit | str]

    def error(self, part: str, trial: str, method: str, against: str = "reference_field") -> FloatArray:
        """Return the error (n,), nT, of `method` with the coefficients of `trial`; NaN if the fit failed."""
        known, fitted = self.parts[part][against].to_numpy(), self.fits[trial, method]
        if isinstance(fitted, str):
            return np.full(known.shape, np.nan)
        return np.asarray(corrected(self.parts[part], fitted.calibration).total - known)

    def rms(self, part: str, trial: str, method: str) -> float:
        """Return the RMS of :meth:`error` against the reference, nT."""
        return rms(self.error(part, trial, method))


def measure_trials(twin: Twin, *, at_depth: bool = False) -> dict[str, xr.Dataset]:
    """Simulate trial 1, survey and trial 2; return each on one time base, without samples of moving masses.

    With `at_depth` the reference is the map continued down to the glider, as with ``--grid``; otherwise it is
    the map at its survey altitude, as in the scenario and in the paper.
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
    flown = Trials(measure_trials(Twin.draw(load("bonne_bay"), seed), at_depth=at_depth), {})
    for trial, method in product(TRIALS, methods):
        data = observations(flown.parts[trial], () if method == "nominal" else MASSES)
        try:
            flown.fits[trial, method] = fit(data, method, **METHODS[method])
        except CalibrationError as error:
            flown.fits[trial, method] = str(error)
    return flown


def _on_row_times(deployment: xr.Dataset) -> xr.Dataset:
    """Return the log with its channels interpolated linearly to the time of the row, as in the paper."""
    time = deployment["time"].to_numpy()
    moved = {n: ("time", np.interp(time, deployment[f"mag_time_{n[-1]}"], deployment[n])) for n in CHANNELS}
    return deployment.assign(moved).drop_vars(CHANNEL_TIMES)


# ---- noise floor and bounds ------------------------------------------------------------------------------


def oracle(vehicle: Vehicle, deployment: xr.Dataset) -> FloatArray:
    """Return the total field (n,), nT, corrected by a calibration that knows the vehicle exactly.

    The error of this field is the noise floor: the channels' noise in the magnitude. The instrument must have
    no errors except noise.
    """
    D, T = _response(vehicle, deployment)
    raw = channels(deployment)
    return np.asarray(np.linalg.norm(np.linalg.solve(D, (raw - T)[..., None])[..., 0], axis=1))


class Bound(NamedTuple):
    """Standard deviation of the corrected total field, and of its noise alone (the floor), (n,) nT."""

    bound: FloatArray
    floor: FloatArray


def best_fit(
    vehicle: Vehicle,
    calibration: xr.Dataset,
    survey: xr.Dataset,
    sigma: float,
    memory: float = 0.0,
    at_sigma: float = 0.05,
    widths: FloatArray | None = None,
) -> Bound:
    r"""Return the Cramér-Rao bound, the least error that the calibration data allow, on a survey.

    `vehicle` is the truth: dipoles with a permanent moment, a three-axis induced moment and a position each.
    The prior is the distribution that such vehicles are drawn from, or `widths` (k,): 1-sigma of soft iron
    (9), hard iron (3, nT), and of each mass moment (3, A m²), volume (3, m³) and place (3, m). The masses'
    positions are known to `at_sigma`, m. `sigma` is the noise of a channel, nT, and `memory` the samples over
    which its correlation falls by e.

    Notes
    -----
    The reading is :math:`\mathbf y = D(p) \mathbf B + \mathbf T(p) + \mathbf n`, and only
    :math:`|\mathbf B|` is known. With :math:`\mathbf w = D^{-T} \mathbf B / |B|`, a change of the parameters
    θ and the noise change the corrected magnitude by :math:`-\mathbf w^T (\partial \mathbf y / \partial θ)
    dθ + \mathbf w^T \mathbf n`. So with g the first factor over :math:`σ |\mathbf w|`, whitened by the
    noise's memory, the information is :math:`\sum \mathbf g \mathbf g^T` plus the prior's (Kay 1993,
    *Estimation Theory*, ch. 3 and 15).
    """
    # θ in units of its prior's 1-sigma, so that the information is well scaled
    scale = _widths(vehicle, at_sigma) if widths is None else widths
    g, learned_floor = _sensitivity(vehicle, calibration, sigma)
    # whiten the noise of consecutive samples; runs are independent
    g = g / learned_floor[:, None] * scale
    phi = np.exp(-1 / memory) if memory else 0.0
    follows = (np.diff(calibration["run"].to_numpy(), prepend=np.nan) == 0)[:, None]
    g = np.where(follows, (g - phi * np.roll(g, 1, axis=0)) / np.sqrt(1 - phi**2), g)
    covariance = np.linalg.inv(g.T @ g + np.eye(len(scale)))
    h, floor = _sensitivity(vehicle, survey, sigma)
    h = h * scale
    return Bound(np.sqrt(np.einsum("ni,ij,nj->n", h, covariance, h) + floor**2), floor)


def survey_bound(
    vehicle: Vehicle,
    survey: xr.Dataset,
    place: FloatArray,
    crust: tuple[float, float],
    noise: tuple[float, float],
    other: xr.Dataset,
) -> float:
    """Return the least RMS error without bias on an `other` survey, over its noise floor.

    Vehicle and crustal field are estimated from a `survey` of n samples at `place` (n, 2), m. `crust` are
    amplitude (nT) and length (m) of a Gaussian field with a Gaussian covariance, which are known; `noise` is
    that of a channel (nT), with its memory in samples.

    Notes
    -----
    As :func:`best_fit`, with crustal field and bias in the covariance K of the magnitudes:
    :math:`P = (I + G^T K^{-1} G)^{-1}`. Neighbouring samples are averaged: :data:`MAX_COVARIANCE_SAMPLES`
    remain.
    """
    (sigma, memory), (size, length), scale = noise, crust, _widths(vehicle, 0.05)
    g, floor = _sensitivity(vehicle, survey, sigma)
    step = -(-len(g) // MAX_COVARIANCE_SAMPLES)
    n = len(g) // step
    parts = g, place, floor[:, None]
    g, place, floor = (part[: n * step].reshape(n, step, -1).mean(axis=1) for part in parts)

    def correlation(samples: int, distance: int) -> FloatArray:
        lag = distance * np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
        return np.asarray(np.exp(-lag / memory) if memory else 1.0 * (lag == 0))

    R = correlation(n, step)
    np.fill_diagonal(R, correlation(step, 1).mean())
    field = size**2 * np.exp(-0.5 * cdist(place, place, "sqeuclidean") / length**2)
    G, K = g * scale, floor * floor.T * R + field + MAIN_FIELD_SIGMA_NT**2
    h, its_floor = _sensitivity(vehicle, other, sigma)
    H = (h - h.mean(axis=0)) * scale
    P = np.linalg.inv(G.T @ np.linalg.solve(K, G) + np.eye(len(scale)))
    return float(np.sqrt(1.0 + np.einsum("ni,ij,nj->", H, P, H) / (its_floor**2).sum()))


def _widths(vehicle: Vehicle, at_sigma: float) -> FloatArray:
    """Return the prior 1-sigma of each parameter, (k,), in the order of :func:`_neighbours`."""
    widths = [*[SOFT_IRON] * 9, *[HARD_IRON] * 3]
    for mass in vehicle.mass.values():
        widths += [*[MOMENT] * 3, *(VOLUME_SPREAD * volume for volume in mass.volume), *[at_sigma] * 3]
    return np.array(widths)


def _sensitivity(vehicle: Vehicle, deployment: xr.Dataset, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (n, k) of the corrected magnitude by each parameter, and its noise (n,), nT."""
    ambient = np.column_stack([deployment[f"truth_field_{axis}"] for axis in "xyz"])
    positions = {name: deployment[name].to_numpy() for name in vehicle.channels}
    D, _ = _response(vehicle, deployment)
    u = ambient / np.linalg.norm(ambient, axis=1, keepdims=True)
    w = np.linalg.solve(np.swapaxes(D, 1, 2), u[..., None])[..., 0]
    columns = []
    for up, down, step in _neighbours(vehicle):
        change = (up.field(ambient, positions) - down.field(ambient, positions)) / (2 * step)
        columns.append(-np.sum(w * change, axis=1))
    return np.column_stack(columns), sigma * np.linalg.norm(w, axis=1)


def _response(vehicle: Vehicle, deployment: xr.Dataset) -> tuple[FloatArray, FloatArray]:
    """Return D (n, 3, 3) and T (n, 3), nT: the reading is ``D B + T`` for the ambient field B."""
    positions = {name: deployment[name].to_numpy() for name in vehicle.channels}
    n, unit = deployment.sizes["time"], 1e4
    T = vehicle.field(np.zeros((n, 3)), positions)
    shifted = [vehicle.field(np.tile(unit * e, (n, 1)), positions) for e in np.eye(3)]
    D = np.stack([(field - T) / unit for field in shifted], axis=-1)
    return D, T


def _neighbours(vehicle: Vehicle) -> Iterator[tuple[Vehicle, Vehicle, float]]:
    """Yield the vehicle with one parameter a step up and a step down, and the step, in the prior's order."""

    def vary(struct: Any, name: str, step: float) -> Iterator[tuple[Any, Any, float]]:
        value = np.asarray(getattr(struct, name), dtype=np.float64)
        for k in range(value.size):
            moved = []
            for sign in (1, -1):
                other = value.copy()
                other.flat[k] += sign * step
                moved.append(msgspec.structs.replace(struct, **{name: other.tolist()}))
            yield moved[0], moved[1], step

    yield from vary(vehicle, "soft_iron", 1e-4)
    yield from vary(vehicle, "hard_iron", 1.0)
    for name, mass in vehicle.mass.items():
        for field, step in (("moment", 1e-3), ("volume", 1e-5), ("at", 1e-5)):
            for up, down, width in vary(mass, field, step):
                yield (
                    msgspec.structs.replace(vehicle, mass=vehicle.mass | {name: up}),
                    msgspec.structs.replace(vehicle, mass=vehicle.mass | {name: down}),
                    width,
                )
