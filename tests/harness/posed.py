"""Make problems of a diagnosis, and candidates for them, without a simulation."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from small import polynomial

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import (
    ChannelEffect,
    ClockEffect,
    LegendreEffect,
    PlayEffect,
    PowersEffect,
    RateEffect,
    ResponseEffect,
    SourcesEffect,
    TimeEffect,
)
from magbridge.calibration.model import Calibration, Parameter
from magbridge.calibration.terms import Effect, LogSeries
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.survey import MAX_LAG, Survey, TelemetryChannel

FIELD, T0 = 5e4, 1.7e9
"""Reference field, nT, and start of a survey, s since 1970 UTC."""
EFFECTS: list[Effect] = [
    ChannelEffect(cause="temperature_offset", channel="heat", origin=3.0, lag=200.0, stages=2),
    ChannelEffect(cause="temperature_scale", channel="heat", origin=3.0, lag=50.0, on="scale"),
    PowersEffect(cause="unmodelled_actuator", channel="heat", centre=3.0, scale=2.0, order=3),
    SourcesEffect(cause="actuator_order", channel="p", centre=-1.1, scale=0.2, apart=1.25, count=12),
    LegendreEffect(cause="actuator_order", exponents=(4,)),
    PlayEffect(cause="hysteresis", channel="p", width=0.3, centre=0.1, scale=0.5),
    PlayEffect(cause="hysteresis", channel="p", width=0.3, centre=0.1, scale=0.5, order=3),
    ClockEffect(),
    ClockEffect(cause="filter_lag", sign=-1.0),
    TimeEffect(cause="offset_step", shape="step", start=T0 + 200.0),
    TimeEffect(cause="offset_drift", shape="drift", start=T0, period=500.0, order=2),
    TimeEffect(cause="interference_tone", shape="tone", start=T0, period=17.3),
    RateEffect(cause="channel_skew", on="skew"),
    RateEffect(cause="eddy_current", on="eddy"),
    ResponseEffect(cause="nonlinearity", unit=FIELD, power=3),
    ResponseEffect(cause="saturation", unit=FIELD, axis=2, knee=35_000.0),
]
"""Effects of every kind, of a mass p and a channel heat, for a log that begins at T0."""


def surveyed(directions: FloatArray, p: FloatArray, **more: Any) -> Survey:
    """Return a gapless 4 s survey with the field along `directions` (n, 3) and a mass at `p` (n,).

    `more` replaces attributes by name; a dive has fifty samples.
    """
    n = len(p)
    plain = {
        "time": T0 + 4.0 * np.arange(float(n)), "reference": np.full(n, FIELD), "still": (),
        "field": FIELD * directions / np.linalg.norm(directions, axis=1)[:, None],
        "steps": np.where(np.arange(n) > 0, 1, MAX_LAG), "dive": np.arange(n) // 50, "place": None,
        "attitude": None, "fitted": np.zeros(n, bool), "learned": np.zeros(n, bool), "cycles": np.empty(0),
        "source": "made",
        "channels": {"p": TelemetryChannel(p, "in", ("position",))},
    }  # fmt: skip
    return Survey(**plain | more)


def walk(n: int, rng: np.random.Generator) -> FloatArray:
    """Return (n, 3) directions of a field that rotates as a random walk in vehicle axes."""
    return np.asarray(rng.normal(size=(n, 3)).cumsum(axis=0) * 0.1 + [0.3, 0.1, 0.9])


def calibrated(coefficients: FloatArray, variance: float = 4.0, **parameter: float) -> Calibration:
    """Return a polynomial calibration in p: nine coefficients for each power, each of `variance` nT²."""
    limits = {"low": -1.0, "high": 1.0, "centre": 0.0, "scale": 1.0} | parameter
    return polynomial(coefficients, Parameter("p", "in", **limits), variance=variance, method="made")


def regressors_of(survey: Survey, calibration: Calibration, effect: Effect) -> FloatArray:
    """Return the (r, n) regressors of an effect along the survey, computed for one sample at a time."""
    channels = dict.fromkeys((*calibration.units, *effect.channels()))
    values = {name: survey.channels[name].values for name in channels}
    return Effect.batch(effect, LogSeries(survey.time, survey.field, values, calibration.kernel))


def right(rows: int) -> Problem:
    """Return the problem of an exact calibration at random attitudes."""
    directions = np.random.default_rng(4).normal(size=(rows, 3))
    return pose(surveyed(directions, np.linspace(-1.0, 1.0, rows)), calibrated(np.zeros(9), 1e-6))


def thinned(survey: Survey, here: NDArray[np.bool_]) -> Survey:
    """Return the survey with only the rows of the mask `here` (n,), as if the other samples had been lost."""
    each = ("time", "field", "reference", "dive", "fitted", "learned")
    rows = {name: getattr(survey, name)[here] for name in each}
    channels = {name: c._replace(values=c.values[here]) for name, c in survey.channels.items()}
    steps = np.append(MAX_LAG, np.minimum(np.diff(np.flatnonzero(here)), MAX_LAG))
    return replace(survey, **rows, channels=channels, steps=steps)


def candidate(cause: str, columns: FloatArray, **more: Any) -> Candidate:
    """Return a candidate with the regressors `columns`, (n,) or (n, k), and a prior width of 1 by default."""
    X = columns.reshape(len(columns), -1)
    k = X.shape[1]
    plain = {
        "channel": None, "columns": lambda rows: X[rows], "width": np.ones(k), "names": ("b",) * k,
        "units": ("nT",) * k,
    }  # fmt: skip
    return Candidate(cause, **plain | more)


def missed(y: FloatArray, X: FloatArray) -> float:
    """Return the fraction of the power of y (n,) that a least-squares fit of the columns X (n, k) leaves."""
    return float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=None)[0]) ** 2) / (y @ y))
