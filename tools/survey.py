"""Measure the accuracy of a calibration from a survey only, and of its map, over random simulated gliders.

Each glider has random dipoles and surveys a Gaussian random crustal field of a given amplitude and length,
equal at every depth, on crossing tracks. It has no calibration runs and no map; the reference is the IGRF.
The calibration is tested on another day's survey, and the map along the track and up to one length from
it. The table has the corrected field's error without bias over the noise floor, the normalised error with and
without the reference bias, and the map's error over an oracle's, which knows the true calibration and the
field's amplitude and length. The bound is for an estimator that knows all except the vehicle.

    python tools/survey.py --gliders 10 --hours 6 12 --out survey.parquet
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from studies import Column, Row, Study, percentile
from study_worlds import MASSES, NOISES, GaussianRock, drifted, fly_survey, oracle, survey_bound, true_field

from magbridge import Calibration, fit, observations
from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.field_search import nodes_for
from magbridge.calibration.fitting.uncertainty import level_of
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.residual import rms
from magbridge.estimation.sparse import SparseFactor
from magbridge.field.geodesy import separation
from magbridge.survey.read import from_vector
from magbridge.survey.run import Result, survey
from sitl import Twin
from sitl.platform import Vehicle

POSITION_SIGMA_M = 100.0
"""1-sigma of the position drift that the fit gets as an option if positions drift, m."""
PLACES = 600
"""Number of test places of the map along the track, and between the tracks."""
TRACK_DISTANCE_LENGTHS = 0.4
"""Standard deviation of a place's distance from the track, north and east, in lengths of the field."""


def run(hours: float, crust: float, length: float, noise: str, drift: float, glider: int) -> Iterator[Row]:
    """Simulate a glider, calibrate it from its survey, and from ten runs with the true field; yield the row.

    `crust` is the amplitude of the crustal field, nT; `length` and `drift` are in m.
    """
    twin, parts = fly_survey(hours, crust, length, noise, glider)
    log = drifted(parts["survey"], drift) if drift else parts["survey"]
    began = time.process_time()
    data = observations(log.drop_vars("reference_field"), MASSES)
    options: dict[str, Any] = {"position_sigma": POSITION_SIGMA_M} if drift else {}
    found = fit(data, **options).calibration
    row: Row = {"seconds": time.process_time() - began}
    assert isinstance(twin.vehicle, Vehicle)
    other, seen = parts["another day"], parts["survey"]
    error, sigma, bias = errors(found, other)
    about = error - error.mean()
    floor = float(np.std(oracle(twin.vehicle, other) - true_field(other)))
    with_runs, _, _ = errors(fit(observations(parts["calibration"], MASSES)).calibration, other)
    where = seen["latitude"].to_numpy(), seen["longitude"].to_numpy()
    place = np.stack(separation(*twin.world.origin, *where), axis=1)
    bound = survey_bound(twin.vehicle, seen, place, (crust, length), NOISES[noise], other)
    row |= {
        "ratio": rms(about) / floor,
        "bound": bound,
        "runs": float(np.std(with_runs)) / floor,
        "without_bias": rms(about / np.sqrt(np.maximum(sigma**2 - bias**2, 1e-6))),
        "with_bias": rms(error / sigma),
        "bias": float(error.mean()) / float(bias.mean()),
    }
    if not drift:  # the map's places follow the logged track
        row |= score_map(twin, survey(from_vector(log, found)), crust, length)
    yield row


def errors(calibration: Calibration, part: xr.Dataset) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the corrected field's error, its sigma, and the sigma of the reference bias in it, (n,) nT."""
    seen = observations(part, MASSES)
    channels = seen.channels(calibration)
    got = correct(calibration, seen.field, channels, seen.time)
    bias = level_of(calibration, seen.field, channels, seen.time)
    return got.total - true_field(part), got.sigma, bias


def score_map(twin: Twin, done: Result, size: float, length: float) -> Row:
    """Return the errors of a survey's map, next to an oracle's map.

    The score excludes each map's mean error along the track: the reference bias, which no survey determines.
    """
    crust, shift = twin.world.rock, np.array(separation(*twin.world.origin, *done.samples.origin))
    assert isinstance(crust, GaussianRock)
    rng, place = np.random.default_rng(0), done.samples.place
    along = place[rng.integers(len(place), size=PLACES)]
    places = np.concatenate([along, along + rng.normal(0, TRACK_DISTANCE_LENGTHS * length, along.shape)])
    true = crust.anomaly(places + shift)
    anomaly, sigma = done.gridded.evaluate(places)
    known = _oracle_map(twin, done, places, size, length, crust.anomaly(place + shift))
    ours, ideal = (error - error[:PLACES].mean() for error in (anomaly - true, known - true))
    row: Row = {}
    for name, half in (("along", slice(PLACES)), ("between", slice(PLACES, None))):
        row[f"map_{name}"] = rms(ours[half]) / rms(ideal[half])
        row[f"map_{name}_sigma"] = rms((ours / sigma)[half])
    return row


def _oracle_map(
    twin: Twin, done: Result, places: FloatArray, size: float, length: float, crust: FloatArray
) -> FloatArray:
    """Return an oracle's map at places, nT; it knows the calibration and the field's amplitude and length."""
    place, noise = done.samples.place, twin.scenario.instrument.noise_sigma
    field = GaussianField(nodes_for(place, 1.5 * length, 4), 1.5 * length, 4)
    B = field.basis(place)
    read = crust + np.random.default_rng(1).normal(0, noise, len(crust))
    w = SparseFactor(B.T @ B / noise**2 + field.precision / size**2).solve(B.T @ read / noise**2)
    return np.asarray(field.basis(places) @ w)


STUDY = Study(
    run,
    ("hours", "crust", "length", "noise", "drift"),
    {
        "error / noise: median": Column("ratio"),
        "95 %": Column("ratio", percentile(95)),
        "bound": Column("bound"),
        "ten runs": Column("runs"),
        "normalised, without bias": Column("without_bias"),
        "bias / its sigma": Column("bias", rms),
        "map / oracle: along": Column("map_along"),
        "between": Column("map_between"),
        "map / sigma: along": Column("map_along_sigma"),
        "between tracks": Column("map_between_sigma"),
        "s": Column("seconds", np.median, ".1f"),
    },
)


if __name__ == "__main__":
    STUDY.main(
        __doc__, gliders=10, first=0, hours=[6.0, 12.0], crust=[8.0, 30.0, 60.0],
        length=[500.0, 1000.0, 1500.0], noise=list(NOISES), drift=[0.0],
    )  # fmt: skip
