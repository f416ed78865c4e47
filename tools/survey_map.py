"""The map's rows of tools/survey.py: beside an oracle's, and beside harmonica's equivalent sources."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import harmonica as hm
import numpy as np
import xarray as xr
from bound import SurveyBound
from survey_world import GaussianRock

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.field_nodes import nodes_for
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import rms
from magbridge.field.geodesy import separation
from magbridge.field.place.blocks import Factor
from magbridge.field.place.matern import Matern
from magbridge.survey.read import from_vector
from magbridge.survey.run import Result, survey
from sitl import Twin

__all__ = ["MapScore", "score_map"]

PLACES = 600
"""Along the track, and as many up to one length from it."""
NEAR = 0.4
"""Lengths, 1-sigma north and east, by which places lie off the track."""
THINNED, HELD_OUT = 2_500, 50
"""Samples that equivalent sources are given, and samples in a stretch of those held out to choose them."""
DEPTHS, DAMPINGS = (0.5, 1.0, 2.0), (1e-3, 1e-1, 1.0, 10.0)
"""Of the sources, in lengths of the rock; and of their fit."""


class MapScore(NamedTuple):
    """RMS over the oracle's, the least it could be, standardised error; harmonica's RMS over ours."""

    along: float
    off: float
    bound_along: float
    bound_off: float
    sigma_along: float
    sigma_off: float
    peer: float


def score_map(
    twin: Twin, log: xr.Dataset, calibration: Calibration, rock_is: tuple[float, float], best: SurveyBound
) -> MapScore:
    """Draw the map of a survey, and compare it with the rock, of a size (nT) and length (m).

    What `best` says is the least error of one who knows all that an oracle knows but the vehicle. The level,
    which no survey knows, is each map's mean error along the track.
    """
    done, (size, length) = survey(from_vector(log, calibration, 0)), rock_is
    rock, shift = twin.world.rock, np.array(separation(*twin.world.origin, *done.samples.origin))
    assert isinstance(rock, GaussianRock)
    rng, place = np.random.default_rng(0), done.samples.place
    along = place[rng.integers(len(place), size=PLACES)]
    off = along + rng.normal(0, NEAR * length, along.shape)
    at = np.concatenate([along, off])
    true = rock.anomaly(at + shift)
    anomaly, sigma = done.gridded.at(at)
    known = _oracle(twin, done, at, size, length, rock.anomaly(place + shift))
    ours, oracle, peer = (_apart(one - true) for one in (anomaly, known, _equivalent(done, at, length)))
    halves = slice(PLACES), slice(PLACES, None)
    along_ratio, off_ratio = (rms(ours[half]) / rms(oracle[half]) for half in halves)
    along_sigma, off_sigma = (rms((ours / sigma)[half]) for half in halves)
    least = best.of_map(at + shift, PLACES, vehicle_known=False)
    along_bound, off_bound = (rms(least[half]) / rms(oracle[half]) for half in halves)
    return MapScore(
        along_ratio, off_ratio, along_bound, off_bound, along_sigma, off_sigma, rms(peer) / rms(ours)
    )


def _apart(error: FloatArray) -> FloatArray:
    return np.asarray(error - error[:PLACES].mean())


def _oracle(
    twin: Twin, done: Result, at: FloatArray, size: float, length: float, rock: FloatArray
) -> FloatArray:
    """Return the map by who knows the calibration and the rock's size and length, nT."""
    place, noise = done.samples.place, twin.scenario.instrument.noise_sigma
    field = Matern(nodes_for(place, 1.5 * length, 4), 1.5 * length, 4)
    B = field.basis(place)
    read = rock + np.random.default_rng(1).normal(0, noise, len(rock))
    w = Factor(B.T @ B / noise**2 + field.precision / size**2).solve(B.T @ read / noise**2)
    return np.asarray(field.basis(at) @ w)


def _equivalent(done: Result, at: FloatArray, length: float) -> FloatArray:
    """Return harmonica's map, nT: of depths and dampings those that predict stretches held out best."""
    every = slice(None, None, max(len(done.samples.value) // THINNED, 1))
    place, value = done.samples.place[every], done.samples.value[every]
    held = np.arange(len(value)) // HELD_OUT % 5 == 0

    def drawn(rows: FloatArray, to: FloatArray, depth: float, damping: float) -> FloatArray:
        sources = hm.EquivalentSources(damping=damping, depth=depth * length, block_size=length / 4.0)
        where = place[rows, 1], place[rows, 0], np.zeros(int(rows.sum()))
        mean = value[rows].mean()
        found = sources.fit(where, value[rows] - mean)
        return np.asarray(mean + found.predict((to[:, 1], to[:, 0], np.zeros(len(to)))))

    choices = list(product(DEPTHS, DAMPINGS))
    missed = [rms(drawn(~held, place[held], *choice) - value[held]) for choice in choices]
    return drawn(np.ones(len(value), bool), at, *choices[int(np.argmin(missed))])
