"""What to know before believing a finding: a note each, none where there is nothing to say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from magbridge.diagnose.assessment.numbers import motion, telemetry_delay, times_usual
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.competing import CompetingHypothesis
from magbridge.diagnose.words import measured, names_of, number, series_of

if TYPE_CHECKING:
    from magbridge.diagnose.diagnosis import Diagnosis, Finding

__all__ = ["DOUBTS", "IMPLAUSIBLE_MULTIPLE", "Note", "contested", "not_separated", "notes"]

IMPLAUSIBLE_MULTIPLE = 5.0
"""Multiple of its plausible size above which a cause is implausible."""
DOUBTS = ("contested", "random_walk", "implausible_amplitude", "no_improvement")
"""Codes of notes that are reasons against the use of an extended calibration."""


class Note(NamedTuple):
    """A statement: a code for programs, plain text for people, and the numbers in it."""

    code: str
    text: str
    numbers: Mapping[str, float] = {}


def notes(diagnosis: Diagnosis, finding: Finding, cause: Cause) -> list[Note]:
    """List what to know of one finding; `cause` is its row in the table of causes."""
    return [
        *_of_numbers(finding),
        *not_separated(finding.candidate, cause, finding.competing),
        *_of_use(diagnosis, finding),
    ]


def _of_numbers(finding: Finding) -> Iterator[Note]:
    """Yield notes on its numbers, on an implausible amplitude, and on whether it may be noise."""
    candidate = finding.candidate
    if any(name.endswith(")") for name in candidate.names):
        yield Note(
            "several_terms",
            "A number in brackets: several such terms were needed to describe the cause; they act together.",
        )
    variance = dict(zip(candidate.names, finding.coefficients, strict=True)).get("variance", 0.0)
    if variance > 0.0:
        corner = 0.5 / np.pi / float(np.sqrt(variance))
        yield Note(
            "attenuation",
            f"It shortens a field that turns, as an RC filter of {number(corner, 2)} Hz does. The extended "
            "calibration is fitted without that, as with calibrate --filter-cutoff. In turns the corrected "
            "field stays too short.",
            {"corner_Hz": corner},
        )
    times = times_usual(candidate, finding.coefficients)
    if times >= IMPLAUSIBLE_MULTIPLE:
        yield Note(
            "implausible_amplitude",
            f"This is {number(times, 2)} times the usual size of such a cause. Two causes that cancel each "
            "other can grow this large: check the extended calibration against another reference before it "
            "is used.",
            {"times_usual": times},
        )
    if finding.may_be_noise:
        yield Note(
            "random_walk",
            "It may as well be noise: a sensor whose offsets wander (a random walk, of power 1/f^2) would "
            "look the same in this log, within odds of 20:1. To tell: log the sensor at rest for as long.",
            {"log_odds": finding.over_random_walk},
        )


def _of_use(diagnosis: Diagnosis, finding: Finding) -> Iterator[Note]:
    """Yield notes on when and where it acts, whether it is corrected, and how much that improves."""
    candidate, rest = finding.candidate, diagnosis.unexplained
    found = motion(diagnosis.problem, finding)
    if found is not None:
        yield Note(
            "beside_moving_masses",
            f"{100 * found.share:.0f} % of its power lies in the {100 * found.usual:.0f} % of samples next "
            f"to which a mass moved. With {found.interval:.3g} s between rows, a mass that was not where its "
            "row says would look the same.",
            found._asdict(),
        )
    late = telemetry_delay(diagnosis, finding)
    if late is not None and late.after_nt < late.before_nt:
        tables = " and ".join(f"[telemetry.{p.name}]" for p in diagnosis.problem.calibration.parameters)
        yield Note(
            "telemetry_delay",
            f"With delay = {measured(late.delay_s, late.sigma_s)} in {tables} of bridge.toml the calibration "
            f"as given leaves {number(late.after_nt)} nT RMS of {number(late.before_nt)} on this log. Use "
            "either the delay or the extended calibration, not both.",
            {"delay_s": late.delay_s, "before_nT": late.before_nt, "after_nT": late.after_nt},
        )
    if any(piece.since for piece in candidate.pieces):
        yield Note(
            "recent",
            "It is best described as absent from the logs that the calibration was fitted to: it may have "
            "appeared since.",
        )
    if not set(candidate.effects) <= set(diagnosis.calibration.effects):
        yield Note(
            "not_live",
            "It is not in the extended calibration: live, a rate of change is a backward difference, whose "
            "noise would exceed what the correction improves.",
        )
    if not finding.improvement.shown:
        yield Note(
            "no_improvement",
            "It shows no improvement on held-out parts: it may be a remnant of another effect.",
        )
    if rest is not None and rest.signal_to_noise >= finding.signal_to_noise:
        yield Note(
            "rest_is_stronger",
            "The unexplained rest is stronger than this cause, and may have caused part of it.",
        )


def contested(finding: Finding) -> bool:
    """Return True if another cause, not only another series, remains possible."""
    return any(hypothesis.candidate.cause != finding.candidate.cause for hypothesis in finding.competing)


def not_separated(
    candidate: Candidate, cause: Cause, competing: Sequence[CompetingHypothesis]
) -> Iterator[Note]:
    """Yield notes on the causes that could take its place, and on how to distinguish them."""
    alone = "No other known cause explains the data nearly as well (none comes within odds of 20:1)."
    if not competing:
        yield Note("alone", alone)
    elif all(hypothesis.candidate.cause == candidate.cause for hypothesis in competing):
        series = ", ".join(str(series_of(hypothesis.candidate)) for hypothesis in competing)
        yield Note(
            "series_uncertain",
            f"{alone} Which series it follows is less sure: {series} would do nearly as well (odds below "
            "20:1). A log in which these differ more would tell.",
        )
    else:
        yield Note(
            "contested",
            f"The data cannot distinguish it from {names_of(competing, ' or ')} (odds below 20:1). A "
            "correction under a wrong name may fit this log and fail on the next. To distinguish them: "
            f"{cause.disambiguation}.",
        )
