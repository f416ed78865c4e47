"""Is the extended calibration fit for use? What this log says for it and against it, as data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.assessment.notes import DOUBTS, Note, contested, notes
from magbridge.diagnose.assessment.numbers import (
    Budget,
    Delays,
    Level,
    budget,
    cancelling,
    delays,
    level,
    slow_share,
    stays,
)
from magbridge.diagnose.compare.returns import Returns, returns
from magbridge.diagnose.seen import Memory, Seen, memory, seen
from magbridge.diagnose.words import label, number

if TYPE_CHECKING:
    from magbridge.diagnose.causes import Cause
    from magbridge.diagnose.diagnosis import Diagnosis, Finding

__all__ = ["OWN_LOG_TEXT", "Assessment", "Fitness", "Reason", "assess", "useful"]

Fitness = Literal["yes", "conditional", "no"]
Reason = Literal[
    "held_out_and_other_day", "one_condition", "nothing_added", "not_needed", "reference_only", "refused",
    "no_improvement", "refit_as_good",
]  # fmt: skip
"""Code of the reason for the answer."""
OWN_LOG_TEXT = (
    "The calibration was fitted to this very log and has absorbed part of its errors: the improvement is "
    "not a test."
)
REPEATS = "All parts left out of the fit belong to this log: a log of another day may differ."
SLOWLY = 0.9
"""Fraction of its power that a trend and a curvature over the log explain, for a cause to be called slow."""
SUMMARIES: dict[Reason, str] = {
    "held_out_and_other_day": "The corrected field improves on parts and on days left out of the fit.",
    "not_needed": "There is no need for it: the calibration's own coefficients, refitted, do as well.",
    "reference_only": "It has no new term: the error found belongs to the reference, not to the vehicle. Its "
    "coefficients are refitted without that error.",
    "no_improvement": "The corrected field does not improve on held-out parts.",
    "refit_as_good": "A refit of the calibration alone corrects as well: calibrate again instead.",
}
REFUSALS = {
    "not_linear": "On parts left out of the fit the linear model predicts an error of {0} nT RMS, and the "
    "corrector leaves {1} nT",
    "outside_prior": "It would move the corrected field by {1} nT where this log does not determine it and "
    "the calibration allows {0} nT",
    "worse": "On parts left out of the fit the calibration as given leaves {0} nT RMS, and the extended one "
    "up to {1} nT (95 %)",
    "written_file": "The written file, read back, corrects this log with an error of {1} nT RMS, and the "
    "calibration as given with one of {0} nT",
}
"""Why an extension is refused, with its two values."""
CONDITIONS = {
    "own_log": "compare a log that the calibration was not fitted to.",
    "unsupported": "calibrate again from runs that support the calibration ({0}).",
    "contested": "find out first which of the possible causes it is: {0}.",
    "random_walk": "log the sensor at rest for as long as this log, to exclude a drifting offset.",
    "implausible_amplitude": "compare the corrected field with another reference, because the effect is "
    "implausibly large.",
    "reference_shift": "compare the corrected field with another reference, because all of it is shifted.",
    "cancelling": "compare the corrected field with another reference, because two causes largely cancel.",
    "unexplained": "find the cause of the unexplained residual.",
    "spatial_temporal": "cross the track again at another time, to distinguish a map's error from a change "
    "with time.",
    "no_improvement": "compare another log, because one of the causes shows no improvement of its own.",
    "same_log": "the improvement must show in a log of another day as well.",
}
"""The condition that removes each objection, the weightiest first."""


@dataclass(frozen=True)
class Assessment:
    """Verdict, reasons and quantities that the report shows in addition to the findings."""

    fit_for_use: Fitness
    """Usability of the written calibration in place of the given one."""
    reason: Reason
    """Code of the reason for that."""
    condition: str
    """Condition of a conditional verdict; empty otherwise."""
    summary: str
    """The answer as a sentence."""
    reasons_for: tuple[Note, ...]
    reasons_against: tuple[Note, ...]
    manoeuvres: tuple[str, ...]
    """Manoeuvres that would resolve the open questions."""
    notes: tuple[tuple[Note, ...], ...]
    """What to know before believing each finding."""
    reference_shift: Level | None
    """Shift of the whole corrected field that may be the reference's."""
    delays: Delays | None
    """Delays of the sensor's axes, if they look interpolated."""
    budget: Budget
    """RMS predicted, before, after, fitted."""
    residual: Memory
    """Autocorrelation of the residual: how far from white it is."""
    follows: Seen
    """Series that the residual follows."""
    returns: Returns | None
    """How well the track separates place from time; None without positions."""


def assess(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> Assessment:
    """Weigh a diagnosis; `causes` is the table that was asked about."""
    problem, residual = diagnosis.problem, diagnosis.residual / diagnosis.problem.reference_jacobian
    shift = level(problem, diagnosis.possible, diagnosis.calibration)
    track = returns(problem.survey)
    noted = tuple(tuple(notes(diagnosis, one, causes[one.candidate.cause])) for one in diagnosis.findings)
    against = _against(diagnosis, noted, shift, track) if diagnosis.named else []
    use = useful(diagnosis)
    if use:
        against = [*against, *_domain(diagnosis)]
    fitness, reason = _fitness(diagnosis, use, against)
    manoeuvres = tuple(dict.fromkeys(_manoeuvres(diagnosis, causes)))
    condition = _condition(diagnosis, against, manoeuvres) if fitness == "conditional" else ""
    good = [Note("use", use)] if use else []
    return Assessment(
        fit_for_use=fitness,
        reason=reason,
        condition=condition,
        summary=f"Fit for use on one condition: {condition}" if condition else _summary(diagnosis, reason),
        reasons_for=tuple(good),
        reasons_against=(
            *against,
            *([Note("same_log", REPEATS)] if use and diagnosis.other_day is None else []),
        ),
        manoeuvres=manoeuvres,
        notes=noted,
        reference_shift=shift,
        delays=delays(problem, diagnosis.fit),
        budget=budget(diagnosis),
        residual=memory(problem, residual),
        follows=seen(problem, residual),
        returns=track,
    )


def _fitness(diagnosis: Diagnosis, use: str, against: Sequence[Note]) -> tuple[Fitness, Reason]:
    """Return whether the written calibration is fit for use, and the code of the reason."""
    objections: dict[Reason, bool] = {
        "nothing_added": not diagnosis.named,
        "refused": bool(diagnosis.refused),
        "not_needed": diagnosis.negligible,
        "reference_only": not use,
        "no_improvement": not diagnosis.improvement.shown,
        "refit_as_good": not diagnosis.over_refit.shown,
    }
    reason = next((code for code, applies in objections.items() if applies), None)
    if reason is not None:
        return "no", reason
    other_day = diagnosis.other_day is not None and diagnosis.other_day.shown
    if other_day and not any(note.code in CONDITIONS for note in against):
        return "yes", "held_out_and_other_day"
    return "conditional", "one_condition"


def _condition(diagnosis: Diagnosis, against: Sequence[Note], manoeuvres: Sequence[str]) -> str:
    """Return the condition that removes the weightiest objection, else that of a log of another day."""
    codes = [note.code for note in against if note.code in CONDITIONS]
    code = min(codes, key=list(CONDITIONS).index, default="same_log")
    if code == "unsupported":
        return CONDITIONS[code].format("; ".join(diagnosis.problem.calibration.warnings))
    return CONDITIONS[code].format("; ".join(manoeuvres))


def _summary(diagnosis: Diagnosis, reason: Reason) -> str:
    """Return the answer as a sentence."""
    if reason == "refused":
        values = [number(value) for value in diagnosis.refusal_values]
        why = REFUSALS[diagnosis.refused].format(*values)
        return f"The extension is refused. {why}. calibration.json is the calibration as it was given."
    return SUMMARIES.get(reason) or _as_given(diagnosis)


def _domain(diagnosis: Diagnosis) -> list[Note]:
    """List the ranges of attitude, depth and telemetry in which the improvement was measured."""
    survey, known = diagnosis.problem.survey, diagnosis.problem.calibration
    fresh = ~survey.learned
    ranges: dict[str, tuple[float, float, str]] = {}
    if survey.attitude is not None:
        for k, name in enumerate(("roll", "pitch")):
            ranges[name] = (*_extremes(survey.attitude[fresh, k]), "deg")
    names = [parameter.name for parameter in known.parameters]
    names += [name for name in diagnosis.calibration.channels if name not in names]
    for name in names:
        ranges[name] = (*_extremes(survey.channels[name].values[fresh]), survey.channels[name].unit)
    if not ranges:
        return []
    texts = [f"{n} {number(a)} to {number(b)} {unit}".rstrip() for n, (a, b, unit) in ranges.items()]
    values = {f"{n}_{end}": x for n, (a, b, _) in ranges.items() for end, x in (("min", a), ("max", b))}
    return [
        Note(
            "domain", f"The improvement was measured at {', '.join(texts)}; nothing is known outside.", values
        )
    ]


def _extremes(values: FloatArray) -> tuple[float, float]:
    """Return the smallest and the largest of values (n,)."""
    return float(np.min(values)), float(np.max(values))


def _as_given(diagnosis: Diagnosis) -> str:
    """Return the verdict on the given calibration if nothing is added to it."""
    given = "calibration.json is the calibration as it was given."
    if diagnosis.unexplained is None:
        return f"{given} As far as this log can show (last section), it holds."
    return (
        f"{given} It does not describe all that this vehicle's sensor sees: expect errors like the "
        f"{number(diagnosis.total.before)} nT RMS found here."
    )


def useful(diagnosis: Diagnosis) -> str:
    """Return what the extended calibration corrects for and what not; empty if nothing was added to it."""
    added = diagnosis.calibration.effects
    if diagnosis.refused:
        return ""
    if all(c.about != "vehicle" or (c.effects and set(added).isdisjoint(c.effects)) for c in diagnosis.named):
        return ""
    others = ", ".join(label(*candidate.group) for candidate in stays(diagnosis))
    but = f" It leaves {others} in the field, which the RMS above has removed." if others else ""
    verdict = (
        "corrects for what belongs to the vehicle and its sensor"
        if diagnosis.improvement.shown
        else "shows no improvement on data that it was not fitted to: do not use it before another log does"
    )
    return f"The extended calibration, calibration.json next to this page, {verdict}.{but}"


def _against(
    diagnosis: Diagnosis, noted: Sequence[Sequence[Note]], shift: Level | None, track: Returns | None
) -> list[Note]:
    """List the reasons against use, which a reviewer must resolve; `noted` has the notes of each finding."""
    survey, rest = diagnosis.problem.survey, diagnosis.unexplained
    found = [Note("own_log", OWN_LOG_TEXT)] if (survey.fitted & ~survey.learned).any() else []
    if warnings := "; ".join(diagnosis.problem.calibration.warnings):
        found.append(Note("unsupported", f"The calibration's own data do not support it: {warnings}."))
    if shift is not None:
        text = (
            f"The extended calibration shifts the whole corrected field by {shift.shift:+.1f} nT, to within "
            f"{shift.sigma:.1f} nT (1 sigma, if the names are right). A log cannot tell for sure whether a "
            "constant belongs to the vehicle or to the reference: check the extended field against another "
            "reference before using it."
        )
        found.append(Note("reference_shift", text, shift._asdict()))
    found += [
        Note(note.code, f"{_name(one)}: {note.text}", note.numbers)
        for one, some in zip(diagnosis.findings, noted, strict=True)
        for note in some
        if note.code in DOUBTS
    ]
    found += _spatial_temporal(diagnosis, track)
    for one, other, a, b, both in cancelling(diagnosis):
        text = (
            f"{_name(one)} and {_name(other)} largely cancel each other ({number(a)} and {number(b)} nT RMS, "
            f"together {number(both)}): outside of the range of this log, their sum may be far off."
        )
        found.append(Note("cancelling", text, {"one_nT": a, "other_nT": b, "together_nT": both}))
    if rest:
        text = f"Something of S/N {rest.signal_to_noise:.1f} is left that has no name."
        found.append(Note("unexplained", text, {"signal_to_noise": rest.signal_to_noise}))
    return found


def _spatial_temporal(diagnosis: Diagnosis, track: Returns | None) -> list[Note]:
    """Return a note if an error of the reference is slow and the track does not separate place from time."""
    if track is None or track.distinguishable:
        return []
    about = [one for one in diagnosis.findings if one.candidate.about in ("place", "time")]
    slow = [_name(one) for one in about if slow_share(diagnosis.problem, one) >= SLOWLY]
    text = f"{track.text} Only their usual shapes support: {', '.join(slow)}."
    return [Note("spatial_temporal", text, track._asdict())] if slow else []


def _manoeuvres(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """List the manoeuvres that would distinguish the possible causes."""
    found = [causes[one.candidate.cause].disambiguation for one in diagnosis.findings if contested(one)]
    rest = diagnosis.unexplained
    if rest is not None and rest.within:
        found.append(causes[rest.within[0].candidate.cause].disambiguation)
    return found


def _name(finding: Finding) -> str:
    return label(*finding.candidate.group)
