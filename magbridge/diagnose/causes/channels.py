"""Telemetry as the causes ask for it: by what it may be, never by its name."""

from __future__ import annotations

from magbridge.diagnose.compare.problem import Problem

__all__ = ["channels_of", "extent"]


def channels_of(problem: Problem, kind: str) -> list[str]:
    """Name the channels that may be of this kind; not the calibration's own parameters."""
    own = {parameter.name for parameter in problem.calibration.parameters}
    return [name for name, c in problem.survey.channels.items() if kind in c.kinds and name not in own]


def extent(problem: Problem, name: str) -> tuple[float, float]:
    """Return the smallest and the largest value of a channel."""
    values = problem.survey.channels[name].values
    return float(values.min()), float(values.max())
