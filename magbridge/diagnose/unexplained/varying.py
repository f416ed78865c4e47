"""A named cause whose size is not the same throughout: what its name leaves where it is wrong."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import pieces
from magbridge.diagnose.unexplained.descriptions import Description

__all__ = ["varying"]

MAX_TESTED_COEFFICIENTS = 6
"""Coefficients of a cause of which this is asked: with more, it takes almost any shape."""


def varying(
    problem: Problem, candidate: Candidate, look_elsewhere: Mapping[str, float]
) -> Description | None:
    """Describe a named cause whose size follows other telemetry, the attitude, or time.

    A cause of the table has one size in a log: its true name leaves nothing of this kind. A name that stands
    for something else (a current's, where its leads move, or where a joint closes under pressure) leaves its
    own regressor times a function of that.

    Parameters
    ----------
    problem : Problem
        The survey.
    candidate : Candidate
        The cause; None is returned for one that takes almost any shape.
    look_elsewhere : mapping
        Cause -> number of independent hypotheses behind it.
    """
    if candidate.spectra is not None or candidate.size > MAX_TESTED_COEFFICIENTS:
        return None
    values = _followed(problem, candidate.channel)
    low = np.array([[value.min()] for value in values])
    half = np.array([[max(0.5 * float(np.ptp(value)), 1e-12)] for value in values])
    regressor, n = candidate.columns, len(problem)
    # an RMS of one: its coefficients are in nT, as those of other descriptions are
    power = sum(float(np.sum(regressor(rows) ** 2)) for rows in pieces(n)) / (n * candidate.size)

    def columns(rows: slice) -> FloatArray:
        part = regressor(rows).T / np.sqrt(max(power, 1e-300))
        between = (np.stack([value[rows] for value in values]) - low) / half - 1.0
        size = np.concatenate([np.ones((1, part.shape[1])), between])
        return np.asarray((size[:, None] * part).reshape(-1, part.shape[1]).T)

    width = np.full((1 + len(values)) * candidate.size, 30.0)
    return Description(
        columns, (("broadband", width),), candidate.channel, look_elsewhere[candidate.cause],
        holds=lambda other: other.cause == candidate.cause, turned=candidate.size == 3, wider=True,
    )  # fmt: skip


def _followed(problem: Problem, own: str | None) -> list[FloatArray]:
    """List what a size might follow, (n,) each: time, telemetry except the cause's `own`, attitude."""
    survey = problem.survey
    channels = [c.values for name, c in survey.channels.items() if name not in (own, *survey.still)]
    if survey.attitude is None:
        return [survey.time, *channels]
    roll, pitch, heading = survey.attitude.T
    heading = np.radians(heading)
    return [survey.time, *channels, roll, pitch, np.cos(heading), np.sin(heading)]
