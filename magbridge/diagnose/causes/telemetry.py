"""Causes that are functions of a telemetry channel: temperature, current, pressure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, reduce
from typing import ClassVar, Literal

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import ChannelEffect, lagged
from magbridge.diagnose.causes.base import Cause
from magbridge.diagnose.columns import AXIS_NAMES, Candidate, GridPoint, of_effect
from magbridge.diagnose.problem import Problem, cached_per_problem

TELEMETRY_LAGS_S = (0.0, 700.0, 1700.0, 4000.0, 10000.0)
"""Lags of a temperature effect that are tried, s; any lag between is imitated to within a fifth (RMS)."""
STAGES = 2
"""Number of equal lags in series, for hull and core: one lag is wrong by 10 to 30 % of a slab's temperature,
two lags by 4 to 9 %."""
MAX_JOINT_CURRENTS = 12
"""Largest number of currents for which a candidate of all currents together is tried."""


@cached_per_problem
def _levels(problem: Problem) -> Callable[[str, float], Callable[[slice], FloatArray]]:
    """Return a function of channel and lag, s, that returns a lagged temperature by rows, (1, m)."""
    survey = problem.survey  # a cache that referred to the problem would keep it alive

    @lru_cache(len(TELEMETRY_LAGS_S) * len(problem.channels_of("temperature")))
    def level(name: str, lag: float) -> Callable[[slice], FloatArray]:
        values = lagged(survey.time, survey.channels[name].values, lag, STAGES).astype(np.float32)
        return lambda rows: values[None, rows].astype(float)

    return level


class _Thermal(Cause):
    """An effect proportional to the sensor's temperature, which follows the logged one with a lag."""

    needs = "a temperature that varies"
    family = "temperature"
    on: ClassVar[Literal["offset", "scale"]]

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a candidate for each temperature channel, each lag, and each temperature of zero effect."""
        longest, made = 2.0 * float(np.ptp(problem.survey.time)), []
        for name in problem.channels_of("temperature"):
            values = problem.survey.channels[name].values
            low, high = problem.survey.channels[name].extent
            # The effect is zero at an unknown temperature: the log's mean, or outside of its range on either
            # side
            origins = [float(np.mean(values)), 2 * low - high, 2 * high - low]
            if problem.survey.fitted.any():  # the values during the calibration are in the data
                origins = origins[:1]
            for origin in origins:
                lags = [lag for lag in TELEMETRY_LAGS_S if lag <= longest]
                made += [self._lagged(problem, name, origin, lag) for lag in lags]
        return made

    def _lagged(self, problem: Problem, name: str, origin: float, lag: float) -> Candidate:
        """Return the candidate of temperature channel `name`, zero at `origin`, degC, with total `lag`, s."""
        lag, field = max(lag, 0.0), problem.calibration.reference.field
        effect = ChannelEffect(
            cause=self.name, channel=name, origin=origin, lag=lag, stages=STAGES, on=self.on
        )
        point = GridPoint(
            {"origin": (origin, "degC"), "lag": (lag, "s")},
            lambda origin, lag: self._lagged(problem, name, origin, lag),
        )
        unit = "nT/degC" if self.on == "offset" else f"nT/degC per {field:.0f} nT"
        return of_effect(
            problem, effect, 5.0, unit, channel=name, point=point, phi=_levels(problem)(name, lag),
            origin=origin,
        )  # fmt: skip


class TemperatureOffset(_Thermal):
    """Core and electronics have an offset that follows temperature: ``T += b (theta_2 - origin)``.

    The core's temperature theta_2 lags behind the logged theta by the heat capacity of the hull, theta_1:
    ``dtheta_1/dt = 2 (theta - theta_1) / lag``, ``dtheta_2/dt = 2 (theta_1 - theta_2) / lag``. Typical sizes
    are 0.1 nT/degC for a good fluxgate and several nT/degC for a low-power one (Primdahl 1979, J. Phys.
    E 12:241). The thermal hysteresis of dive and climb separates the effect from one of depth.
    """

    name = "temperature_offset"
    meaning = "the sensor's zero shifts with temperature"
    disambiguation = (
        "pass one depth at two temperatures of the sensor, diving and climbing; or hold one depth for an "
        "hour after launch"
    )
    on = "offset"


class TemperatureScale(_Thermal):
    """Coil and resistances follow temperature: ``A += diag(b) (theta_2 - origin)``, 10-100 ppm/degC."""

    name = "temperature_scale"
    meaning = "the sensor's sensitivity changes with temperature"
    disambiguation = (
        "roll about the field at two temperatures: a scale follows the axis' reading, an offset does not"
    )
    on = "scale"


class _Proportional(Cause):
    """An offset proportional to a telemetry channel of one kind."""

    kind: ClassVar[str]
    """Kind of the channels, as :func:`.survey.kinds_of` returns it."""
    largest: ClassVar[float]
    """Plausible offset at the channel's extreme, nT."""

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return ``T += b c(t)`` for every channel c of the kind."""
        made = []
        for name in problem.channels_of(self.kind):
            channel = problem.survey.channels[name]
            unit = f"nT/{channel.unit}" if channel.unit else "nT per 1"
            # A coefficient of one width makes the plausible offset at the channel's extreme
            width = self.largest / max(map(abs, channel.extent))
            effect = ChannelEffect(cause=self.name, channel=name)
            made.append(of_effect(problem, effect, width, unit, channel=name))
        return made


class CurrentField(_Proportional):
    """The field of a fixed current loop follows its current: ``T += sum_k b_k I_k(t)`` (Biot and Savart)."""

    name = "current_field"
    meaning = "an electric current makes a field of its own"
    needs = "a current"
    disambiguation = "run the motor with its mass held, and hold the motor with its mass moved"
    kind, largest = "current", 100.0

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return each current by itself, and all currents together with coefficients of one common size."""
        alone = super().candidates(problem)
        if not 2 <= len(alone) <= MAX_JOINT_CURRENTS:
            return alone
        names = tuple(f"{axis} {one.channel}" for one in alone for axis in AXIS_NAMES)
        every = replace(reduce(Candidate.joined_with, alone), channel=None, names=names, parts=())
        return [*alone, replace(every, spectra=np.ones((1, every.size)))]


class PressureOffset(_Proportional):
    """Pressure strains the mount and the hull, whose magnetisation changes (Villari effect): ``T += b p``."""

    name = "pressure_offset"
    meaning = "the sensor's zero shifts with depth or pressure"
    needs = "depth or pressure that varies"
    disambiguation = "hold one depth for an hour: the temperature becomes constant, the pressure effect stays"
    kind, largest = "pressure", 50.0
