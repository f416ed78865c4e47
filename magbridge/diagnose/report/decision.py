"""May the extended calibration fly? What this log says for it and against it, on the page's first screen."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from itertools import combinations
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.residual import residuals_of, rms
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.compare.problem import samples_of
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.report.doubts import IMPLAUSIBLE, stays, times_usual, unsettled, useful
from magbridge.diagnose.report.words import label, number

__all__ = ["Decision", "decide", "decision"]

OWN = (
    "The calibration was fitted to this very log, so nothing was left out of its fit: the gain is not a test."
)
CANCEL = 0.7
"""Two causes cancel each other where their sum is less than this share of the larger one."""
REPEATS = (
    "What was left out of the fit are parts of the same log. Compare one more log, of another day, before "
    "you rely on it."
)


class Decision(NamedTuple):
    """An answer in one sentence, how it is marked (``good``, ``doubt``, ``bad``, ``none``), and why."""

    answer: str
    mark: str
    reasons: tuple[str, ...]


def decide(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> Decision:
    """Weigh the extended calibration; reasons are HTML."""
    if not diagnosis.named:
        return Decision(_as_given(diagnosis), "none", ())
    use, against = useful(diagnosis), tuple(_against(diagnosis, causes))
    if not use:
        return Decision(
            "It has no new term: what was found belongs to the reference, not to the vehicle. Its "
            "coefficients are fitted anew with that taken out.",
            "doubt" if against else "none",
            against,
        )
    reasons = (use, _alone(diagnosis), *against, REPEATS)
    if not diagnosis.total.shown:
        answer, mark = "Not on the evidence of this log.", "bad"
    elif against:
        answer, mark = "Only once these doubts are settled.", "doubt"
    else:
        answer, mark = "Nothing in this log speaks against it.", "good"
    return Decision(answer, mark, tuple(reason for reason in reasons if reason))


def decision(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> str:
    """Return the answer with its reasons as a box."""
    found = decide(diagnosis, causes)
    reasons = "".join(f"<li>{reason}</li>" for reason in found.reasons)
    return (
        f'<div class="box {found.mark}"><p><b>May the extended calibration fly?</b> {found.answer}</p>'
        f"{f'<ul>{reasons}</ul>' if reasons else ''}</div>"
    )


def _as_given(diagnosis: Diagnosis) -> str:
    """Say what to think of the calibration where nothing is added to it."""
    given = "Nothing was added: <code>calibration.json</code> is the calibration as it was given."
    if diagnosis.unexplained is None:
        return f"{given} As far as this log can show (last section), it holds."
    return (
        f"{given} It does not describe all that this vehicle's sensor sees: expect errors like the "
        f"{number(diagnosis.total.before)} nT RMS found here."
    )


def _alone(diagnosis: Diagnosis) -> str:
    """Say what the extended calibration does by itself, where some of what was found stays in the field."""
    if not stays(diagnosis):
        return ""
    survey = diagnosis.problem.survey
    before, after = (
        residuals_of(*samples_of(survey, calibration))[~survey.learned]
        for calibration in (diagnosis.problem.calibration, diagnosis.calibration)
    )
    whole, spread = (
        " to ".join(f"{number(size(e))}" for e in (before, after)) for size in (rms, _about_its_mean)
    )
    return (
        f"By itself it takes the difference from the reference from {whole} nT RMS, and about its mean from "
        f"{spread} nT, on this log, to which it was fitted."
    )


def _about_its_mean(e: FloatArray) -> float:
    return float(np.std(e))


def _against(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Return what a reviewer must see settled, a sentence or two each."""
    survey, rest = diagnosis.problem.survey, diagnosis.unexplained
    doubt = unsettled(diagnosis.problem, diagnosis.possible, diagnosis.calibration)
    large = {
        one: times
        for one in diagnosis.findings
        if (times := times_usual(one.candidate, one.coefficients)) >= IMPLAUSIBLE
    }
    idle = [one for one in diagnosis.findings if not one.gain.shown]
    return [
        *([OWN] if (survey.fitted & ~survey.learned).any() else []),
        *([f"{doubt[0].upper()}{doubt[1:]}."] if doubt else []),
        *_contested(diagnosis, causes),
        *_cancelling(diagnosis),
        *(f"{_name(one)} is {number(times, 2)} times the usual size." for one, times in large.items()),
        *([f"No gain of its own on what was left out: {', '.join(map(_name, idle))}."] if idle else []),
        *([f"Something of S/N {rest.signal_to_noise:.1f} is left that has no name."] if rest else []),
    ]


def _contested(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Name the causes that the data do not tell from others, and what would."""
    contested = [
        one for one in diagnosis.findings if any(r.candidate.cause != one.candidate.cause for r in one.rivals)
    ]
    if not contested:
        return []
    tests = dict.fromkeys(escape(causes[one.candidate.cause].separated_by) for one in contested)
    said = (
        f"Not told from other causes: {', '.join(map(_name, contested))} (the table below names them). A "
        f"correction under a wrong name may fit this log and fail on the next. To tell: {'; '.join(tests)}."
    )
    return [said]


def _cancelling(diagnosis: Diagnosis) -> list[str]:
    """Name pairs of causes that largely cancel each other: neither size is to be relied on by itself."""
    fields = [(one, one.field(diagnosis.problem)) for one in diagnosis.findings]
    return [
        f"{_name(one)} and {_name(other)} largely cancel each other ({number(rms(a))} and {number(rms(b))} "
        f"nT RMS, together {number(rms(a + b))}): outside of what was flown, their sum may be far off."
        for (one, a), (other, b) in combinations(fields, 2)
        if rms(a + b) < CANCEL * max(rms(a), rms(b))
    ]


def _name(finding: Finding) -> str:
    return f"<b>{escape(label(*finding.candidate.group))}</b>"
