"""What the best could make of a change, for :mod:`live`: filters that know the cause, its onset and the rest.

But they know the crustal field no better than the bridge does.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from live_changes import MASSES

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.model import Calibration
from magbridge.config import Align
from magbridge.field.geodesy import separation
from magbridge.learning.doubt import LEARNING_ALARM_LOG_RATIO
from magbridge.learning.nuisance import STATES, Nuisance
from sitl.dataset import channels, side_by_side

__all__ = ["best_delay", "best_field"]

UNKNOWN = 200.0
"""nT, 1-sigma an axis, of how large a change may be."""


def transitions(nuisance: Nuisance, log: xr.Dataset) -> list[tuple[FloatArray, FloatArray]]:
    """Return the nuisance's transition and its noise before each of the n samples."""
    latitude, longitude = (log[name].to_numpy() for name in ("latitude", "longitude"))
    north, east = separation(latitude[:-1], longitude[:-1], latitude[1:], longitude[1:])
    metres, seconds = np.hypot(north, east), np.diff(log["time"].to_numpy())
    return [nuisance.transition(0.0, 0.0), *map(nuisance.transition, metres.tolist(), seconds.tolist())]


def best_delay(
    effect: FloatArray, log: xr.Dataset, rest: BoolArray, calibration: Calibration, since: int
) -> int:
    """Return how many samples `rest` until a known `effect` (n,) on the total field, nT, is significant.

    It begins with the sample `since`; the crustal field there follows from those before.

    That is where the log-likelihood ratio of a signal known in noise and crustal field is expected to reach
    the bridge's own threshold: half the energy of the signal, whitened as the bridge whitens.
    """
    nuisance = Nuisance(calibration.noise, Align().reference_sigma)
    P, m, h = nuisance.initial.copy(), np.zeros(STATES), -nuisance.row(1.0)
    energy, count = 0.0, 0
    for k, (F, Q) in enumerate(transitions(nuisance, log)):
        P, m = F @ P @ F.T + Q, F @ m
        if rest[k]:
            S = float(h @ P @ h) + nuisance.white_variance
            v, gain = float(effect[k] - h @ m), P @ h / S
            energy += 0.5 * v * v / S
            m, P, count = m + gain * v, P - np.outer(gain, h @ P), count + (k >= since)
            if energy > LEARNING_ALARM_LOG_RATIO:
                break
    return count


def best_field(
    added: FloatArray, log: xr.Dataset, rest: BoolArray, calibration: Calibration, reference: FloatArray
) -> FloatArray:
    """Return the total field (n,), nT, by a Kalman filter that knows when and how a change comes.

    Of `added` (n, 3), nT, it knows the course, but neither size nor direction; its field of each sample is
    that before it has seen it. `reference` (n,), nT, is the main field's.
    """
    seen, values, time = channels(log), side_by_side(log, MASSES), log["time"].to_numpy()
    total = correct(calibration, seen, values, time).total
    amount = np.linalg.norm(added, axis=1) / np.linalg.norm(added, axis=1).max()
    by_axis = [correct(calibration, seen + one, values, time).total - total for one in np.eye(3)]
    by_change = np.stack(by_axis, axis=1) * amount[:, None]
    nuisance = Nuisance(calibration.noise, Align().reference_sigma)
    x, P = np.zeros(3 + STATES), np.diag(np.r_[np.full(3, UNKNOWN**2), np.diag(nuisance.initial)])
    A, h, best = np.eye(3 + STATES), np.r_[np.zeros(3), -nuisance.row(1.0)], total.copy()
    for k, (F, Q) in enumerate(transitions(nuisance, log)):
        A[3:, 3:], h[:3] = F, by_change[k]
        x, P = A @ x, A @ P @ A.T
        P[3:, 3:] += Q
        best[k] -= by_change[k] @ x[:3]
        if rest[k]:
            S = float(h @ P @ h) + nuisance.white_variance
            gain = P @ h / S
            x, P = x + gain * (total[k] - reference[k] - h @ x), P - np.outer(gain, h @ P)
    return best
