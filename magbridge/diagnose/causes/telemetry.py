"""Causes that follow a telemetry channel: temperatures, currents, pressures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, reduce
from typing import Literal

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import ChannelEffect, lagged
from magbridge.diagnose.columns import AXES, Candidate, GridPoint, of_effect
from magbridge.diagnose.problem import Problem, once

__all__ = ["current_field", "pressure_offset", "temperature_offset", "temperature_scale"]

TELEMETRY_LAGS_S = (0.0, 700.0, 1700.0, 4000.0, 10000.0)
"""s, spaced so closely that any lag between two of them is matched to within a fifth (RMS)."""
STAGES = 2
"""Equal lags in series, because conducted heat passes the hull before it reaches the core. One lag misses 10
to 30 % of the temperature in the centre of a slab, two in series miss 4 to 9 %."""

MAX_JOINT_CURRENTS = 12
"""Most currents that are also tried together."""


def _origins(problem: Problem, name: str) -> list[float]:
    """Return values that the channel may have had when the vehicle was calibrated."""
    low, high = problem.survey.channels[name].extent
    middle = float(np.mean(problem.survey.channels[name].values))
    if problem.survey.fitted.any():  # the values during the calibration are in the data
        return [middle]
    return [middle, 2 * low - high, 2 * high - low]


@once
def _levels(problem: Problem) -> Callable[[str, float], Callable[[slice], FloatArray]]:
    """Return the lagged temperatures, cached: origins and causes share them, each of 5 MB for a month."""
    survey = problem.survey  # a cache that referred to the problem would keep it alive

    @lru_cache(len(TELEMETRY_LAGS_S) * len(problem.channels_of("temperature")))
    def level(name: str, lag: float) -> Callable[[slice], FloatArray]:
        values = lagged(survey.time, survey.channels[name].values, lag, STAGES)
        return lambda rows: values[None, rows]

    return level


def _thermal(problem: Problem, on: Literal["offset", "scale"]) -> list[Candidate]:
    longest = 2.0 * float(np.ptp(problem.survey.time))
    lags = [lag for lag in TELEMETRY_LAGS_S if lag <= longest]
    return [c for name in problem.channels_of("temperature") for c in _warmed(problem, on, name, lags)]


def _warmed(
    problem: Problem, on: Literal["offset", "scale"], name: str, lags: Sequence[float]
) -> list[Candidate]:
    """Return the candidates for one temperature."""
    field = problem.calibration.reference.field
    unit = "nT/degC" if on == "offset" else f"nT/degC per {field:.0f} nT"

    def rebuild(origin: float, lag: float) -> Candidate:
        lag = max(lag, 0.0)
        effect = ChannelEffect(
            cause=f"temperature_{on}", channel=name, origin=origin, lag=lag, stages=STAGES, on=on
        )
        point = GridPoint({"origin": (origin, "degC"), "lag": (lag, "s")}, rebuild)
        levels = _levels(problem)(name, lag)
        return of_effect(problem, effect, 5.0, unit, channel=name, point=point, phi=levels, origin=origin)

    return [rebuild(origin, lag) for origin in _origins(problem, name) for lag in lags]


def temperature_offset(problem: Problem) -> list[Candidate]:
    """Core and electronics have an offset that follows temperature: ``T += b (theta_2 - origin)``.

    The core's temperature theta_2 follows through the heat capacity of the hull:
    ``dtheta_1/dt = 2 (theta - theta_1) / lag``, ``dtheta_2/dt = 2 (theta_1 - theta_2) / lag``. Typically
    0.1 nT/degC for a good fluxgate, several for a low-power one (Primdahl 1979, J. Phys. E 12:241). Separated
    from depth by the thermal hysteresis of dive and climb.
    """
    return _thermal(problem, "offset")


def temperature_scale(problem: Problem) -> list[Candidate]:
    """Coil and resistances follow temperature: ``A += diag(b) (theta_2 - origin)``, 10-100 ppm/degC."""
    return _thermal(problem, "scale")


def current_field(problem: Problem) -> list[Candidate]:
    """A current loop is a fixed source: ``T += sum_k b_k I_k(t)`` (Biot and Savart), zero when they are.

    Each current by itself, and all together: motors that are driven as one (throttle, speed controllers,
    battery) leave the field of currents at several places, which have one common size.
    """
    alone = _proportional(problem, "current_field", "current", 100.0)
    if not 2 <= len(alone) <= MAX_JOINT_CURRENTS:
        return alone
    names = tuple(f"{axis} {one.channel}" for one in alone for axis in AXES)
    every = replace(reduce(Candidate.with_, alone), channel=None, names=names, parts=())
    return [*alone, replace(every, spectra=np.ones((1, every.size)))]


def pressure_offset(problem: Problem) -> list[Candidate]:
    """Pressure strains the hull and its magnetisation (Villari effect), and the mount: ``T += b p``."""
    return _proportional(problem, "pressure_offset", "pressure", 50.0)


def _proportional(problem: Problem, cause: str, kind: str, largest: float) -> list[Candidate]:
    """``T += b c(t)`` for every channel c of a kind; plausible are `largest` nT at the channel's extreme."""
    made = []
    for name in problem.channels_of(kind):
        low, high = problem.survey.channels[name].extent
        effect = ChannelEffect(cause=cause, channel=name)
        of = problem.survey.channels[name].unit
        unit = f"nT/{of}" if of else "nT per 1"
        width = largest / max(abs(low), abs(high))
        made.append(of_effect(problem, effect, width, unit, channel=name))
    return made
