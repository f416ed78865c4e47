"""A glider dives under a map flown above the sea: with the map as it is, and continued to its depth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.estimation.residual import rms
from magbridge.navigate.batch import navigate
from magbridge.navigate.depth import at_depth
from magbridge.navigate.options import Options
from sitl import Twin, load, simulate

__all__ = ["Dived", "dived"]


class Dived(NamedTuple):
    """RMS error (m), mean squared error over covariance of two axes, share of the time it is valid."""

    error: float
    nees: float
    valid: float


def dived(seed: int) -> tuple[Dived, Dived]:
    """Fly the demo's spirals and survey over its own world, in the true field; without and with depth."""
    scenario = load("demo")
    grid, log = Twin.draw(scenario, seed).anomaly_map(), simulate(scenario, seed)
    log = log.assign(total_field=log["truth_total_field"])
    found = [
        navigate(log, *how) for how in ((grid, Options()), at_depth(grid, Options(), log["depth"].to_numpy()))
    ]
    return _score(found[0]), _score(found[1])


def _score(track: xr.Dataset) -> Dived:
    error = np.stack([track["error_north"], track["error_east"]], axis=-1)
    nn, ne, ee = (track[f"covariance_{axes}"].to_numpy() for axes in ("nn", "ne", "ee"))
    P = np.stack([nn, ne, ne, ee], axis=-1).reshape(-1, 2, 2)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)
    return Dived(rms(np.hypot(*error.T)), float(squared.mean()) / 2, float(track["valid"].mean()))
