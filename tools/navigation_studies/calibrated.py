"""Simulated gliders, calibrated as tools/accuracy.py calibrates them, whose survey is flown over a map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as with_options
from study_worlds import MASSES, METHODS, true_field

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.correction import Correction
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import separation
from magbridge.navigate.options import informed
from magbridge.rows import correct_rows
from navigation_studies.simulated import GLIDER, PLACE, Map, Score, adrift, sail, synthetic
from sitl import load, segments, simulate
from sitl.dataset import at_rest


class Flown(NamedTuple):
    """RMS error (nT) of the corrected field on the survey, the median claimed sigma, the navigation."""

    error: float
    claimed: float
    score: Score


def flown(kinds: tuple[Map, ...], seed: int) -> dict[tuple[int, str], Flown]:
    """Return how a glider navigates on each map (by number) with each calibration, all else the same."""
    parts = segments(simulate(load("random_glider"), seed))
    runs, survey = at_rest(parts["calibration"], MASSES), parts["survey"]
    places = separation(*PLACE, *(survey[f"truth_{name}"].to_numpy() for name in ("latitude", "longitude")))
    every = float(survey["time"][1] - survey["time"][0])
    velocity = np.gradient(np.column_stack(places), every, axis=0)
    found = {}
    for method, options in METHODS.items():
        fitted = fit(observations(runs, () if method == "nominal" else MASSES), method, **options).calibration
        corrected = correct_rows(Correction(fitted), survey)
        error = corrected["total_field"].to_numpy() - true_field(survey)
        sigma = corrected["total_field_sigma"].to_numpy()
        claimed = float(np.median(sigma))
        for k, kind in enumerate(kinds):
            grid = synthetic(kind, seed % 10)
            known = with_options(GLIDER, start_sigma=grid.correlation_length)
            known = informed(known, fitted, claimed)
            ds = adrift(grid, known, np.random.default_rng(seed), velocity, error, sigma, every=every)
            found[k, method] = Flown(rms(error), claimed, sail(ds, grid, known).score())
    return found
