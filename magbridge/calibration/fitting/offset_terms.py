r"""Dependence of a sensor's offset on temperature, with or without lag, and on time during a survey.

.. math:: T(t) = T + c\,(\Theta_\tau(t) - \bar\Theta) + \sum_k d_k \cos(\pi k t / t_s)

c along each axis, nT/degC, with the temperature through a lag tau; the rest a random walk along each axis. An
offset of the body is another field on each heading: without these terms the crustal field would absorb it.
All terms are in the fit during the field search; then those stay that make the log likelier.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import ChannelEffect, held, lagged
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Calibration
from magbridge.columns import TEMPERATURE
from magbridge.diagnostics import Diagnostic
from magbridge.estimation.blocks import OffsetBlock, ParameterBlock, slow_functions

__all__ = ["Creep", "offered", "offset_diagnostics", "with_creep", "with_temperature"]

TEMPERATURE_LAGS_S = (0.0, 600.0, 2400.0)
"""Time constants with which the offset may follow the temperature, s: a bare sensor, in its housing, in a
hull."""
SHORTEST_DRIFT_HALF_PERIOD_S = 1200.0
"""Half the period of the fastest creep, s: it follows a random walk of 20 nT in 6 h to 1 nT, and a step."""
VARIES = 0.5
"""Standard deviation of a temperature, from which on it can tell anything, degC."""
PER_DEGREE, CREEPS, SPREAD = 1.0, 3.0, np.log(5.0)
"""nT/degC and nT along an axis (fluxgates' data sheets: 0.1 to 3 nT/degC), 1-sigma of their logarithms."""


@dataclass(frozen=True, eq=False)
class Creep:
    """Drift of the offset during a survey."""

    time: FloatArray
    """(n,), s since 1970 UTC."""
    offset: FloatArray
    """(n, 3), nT, sensor axes, about the mean."""
    calibration: Calibration
    """Calibration without the walk; beyond the survey the offset may have any value of it."""

    def offset_at(self, time: FloatArray) -> FloatArray:
        """Return the offset (m, 3), nT, at times (m,), s since 1970 UTC."""
        return np.stack([np.interp(time, self.time, one) for one in self.offset.T], axis=1)


def offered(data: Observations) -> tuple[OffsetBlock, ...]:
    """Return the terms that a log allows: the temperature at each lag, and drift."""
    groups = []
    if data.temperature is not None and TEMPERATURE not in data.names:
        for lag in TEMPERATURE_LAGS_S:
            # a constant temperature is not distinguished from the offset
            warm = _temperature(data, lag)
            if np.std(warm) > VARIES:
                column = (warm - warm.mean())[:, None]
                name = f"offset by temperature, lag {lag:.0f} s"
                groups.append(
                    OffsetBlock(name, column, np.ones(3), PER_DEGREE, SPREAD, offered=True, lag=lag)
                )
    # a random walk of the offset, by slow functions of time on each axis
    waves, shape = slow_functions(data.time, SHORTEST_DRIFT_HALF_PERIOD_S)
    if len(shape):
        groups.append(
            OffsetBlock("creep of the offset", waves, np.tile(shape, 3), CREEPS, SPREAD, offered=True)
        )
    return tuple(groups)


def _temperature(data: Observations, lag: float) -> FloatArray:
    """Return the temperature (n,), degC, through a lag; its mean before any is known."""
    assert data.temperature is not None
    known = data.temperature[np.isfinite(data.temperature)]
    return lagged(data.time, held(data.temperature, float(known.mean()) if len(known) else 0.0), lag)


def with_temperature(
    calibration: Calibration,
    data: Observations,
    groups: tuple[ParameterBlock, ...],
    found: tuple[FloatArray, FloatArray, FloatArray],
) -> Calibration:
    """Return the calibration with the effect of the temperature that was found, if any.

    `calibration`: its position terms. `data`: of the fit. `groups`: that are in the fit, in order. `found`
    (q,): the unknowns, their covariance, and what they do to the coefficients.
    """
    # The offset by temperature becomes a channel effect with three more coefficients: the rows of z that
    # are its own are copied into them, with their covariance with all others.
    z, covariance, E = found
    row = E.shape[1] - sum(len(one.shape) for one in groups)
    for one in groups:
        if isinstance(one, OffsetBlock) and one.lag is not None:
            origin = float(_temperature(data, one.lag).mean())
            both = np.vstack([E, np.eye(3, len(z), row)])
            return replace(
                calibration,
                effects=(ChannelEffect(channel=TEMPERATURE, origin=origin, lag=one.lag),),
                coefficients=np.append(calibration.coefficients, z[row : row + 3]),
                covariance=both @ covariance @ both.T,
            )
        row += len(one.shape)
    return calibration


def with_creep(calibration: Calibration, creep: FloatArray) -> Calibration:
    """Return the calibration with the spread of the offsets (n, 3), nT, of the survey."""
    covariance = calibration.covariance.copy()
    # beyond the survey the offset may have any value that it had: add its variance to that of T
    covariance[6:9, 6:9] += creep.T @ creep / len(creep)
    return replace(calibration, covariance=covariance)


def offset_diagnostics(calibration: Calibration, creep: Creep | None) -> Iterator[Diagnostic]:
    """Yield the quantities that the offset depends on."""
    for effect in calibration.effects:
        if isinstance(effect, ChannelEffect):
            slope = float(np.linalg.norm(calibration.coefficients[-effect.size :]))
            late = f", {effect.lag / 60:.0f} minutes late" if effect.lag else ""
            values = {"slope": slope, "late": late, "channel": effect.channel}
            yield Diagnostic("temperature_removed", values)
    if creep is not None:
        size = float(np.sqrt(np.mean((creep.offset**2).sum(axis=1))))
        yield Diagnostic("offset_crept", {"rms_nT": size})
