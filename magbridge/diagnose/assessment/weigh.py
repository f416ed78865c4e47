"""Is the extended calibration fit for use? What this log says for it and against it, as data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from magbridge.diagnose.assessment.notes import DOUBTS, Note, contested, notes
from magbridge.diagnose.assessment.numbers import (
    Budget,
    Delays,
    Level,
    alone,
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

__all__ = ["OWN", "Assessment", "Fitness", "assess", "useful"]

Fitness = Literal["yes", "once_settled", "no", "not_needed", "nothing_added", "reference_only"]
OWN = (
    "The calibration was fitted to this very log and has absorbed part of what is wrong: the improvement is "
    "no test."
)
REPEATS = (
    "What was left out of the fit are parts of the same log. Compare one more log, of another day, before "
    "you rely on it."
)
SLOWLY = 0.9
"""Share of its power that a trend and a bend over the log explain, of what is called slow."""
ANSWERS: dict[Fitness, str] = {
    "yes": "Nothing in this log speaks against it.",
    "once_settled": "Only once these doubts are settled.",
    "no": "Not on the evidence of this log.",
    "not_needed": "There is no need for it: the calibration's own numbers fitted anew do as well.",
    "reference_only": "It has no new term: what was found belongs to the reference, not to the vehicle. Its "
    "coefficients are fitted anew with that taken out.",
}


@dataclass(frozen=True)
class Assessment:
    """All that a reader gets beside the findings themselves."""

    fit_for_use: Fitness
    """``yes``, ``once_settled``, ``no``, ``not_needed``, ``nothing_added`` or ``reference_only`` (no new
    term)."""
    answer: str
    """The same as a sentence."""
    reasons_for: tuple[Note, ...]
    reasons_against: tuple[Note, ...]
    manoeuvres: tuple[str, ...]
    """What to fly to settle the doubts."""
    notes: tuple[tuple[Note, ...], ...]
    """What to know before believing each finding."""
    level: Level | None
    """Shift of the whole corrected field that may be the reference's."""
    delays: Delays | None
    """Of the sensor's axes, where they look interpolated."""
    budget: Budget
    """RMS predicted, before, after, fitted."""
    residual: Memory
    """How far from white it is, of what is left."""
    follows: Seen
    """What it follows."""
    returns: Returns | None
    """Whether the track tells place from time; None without positions."""


def assess(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> Assessment:
    """Weigh a diagnosis; `causes` is the table that was asked about."""
    problem, residual = diagnosis.problem, diagnosis.residual / diagnosis.problem.reference_jacobian
    shift = level(problem, diagnosis.possible, diagnosis.calibration)
    track = returns(problem.survey)
    noted = tuple(tuple(notes(diagnosis, one, causes[one.candidate.cause])) for one in diagnosis.findings)
    against = _against(diagnosis, noted, shift, track) if diagnosis.named else []
    use = useful(diagnosis)
    fitness = _fitness(diagnosis, use, against)
    good = [Note("use", use), *_alone(diagnosis)] if use else []
    return Assessment(
        fit_for_use=fitness,
        answer=ANSWERS.get(fitness) or _as_given(diagnosis),
        reasons_for=tuple(good),
        reasons_against=(*against, *([Note("same_log", REPEATS)] if use else [])),
        manoeuvres=tuple(dict.fromkeys(_manoeuvres(diagnosis, causes))),
        notes=noted,
        level=shift,
        delays=delays(problem, diagnosis.fit),
        budget=budget(diagnosis),
        residual=memory(problem, residual),
        follows=seen(problem, residual),
        returns=track,
    )


def _fitness(diagnosis: Diagnosis, use: str, against: Sequence[Note]) -> Fitness:
    if not diagnosis.named:
        return "nothing_added"
    if diagnosis.negligible:
        return "not_needed"
    if not use:
        return "reference_only"
    if not diagnosis.total.shown:
        return "no"
    return "once_settled" if against else "yes"


def _as_given(diagnosis: Diagnosis) -> str:
    """Say what to think of the calibration where nothing is added to it."""
    given = "calibration.json is the calibration as it was given."
    if diagnosis.unexplained is None:
        return f"{given} As far as this log can show (last section), it holds."
    return (
        f"{given} It does not describe all that this vehicle's sensor sees: expect errors like the "
        f"{number(diagnosis.total.before)} nT RMS found here."
    )


def useful(diagnosis: Diagnosis) -> str:
    """Say what the extended calibration corrects for and what not; nothing where nothing was added to it."""
    added = diagnosis.calibration.effects
    if all(c.about != "vehicle" or (c.effects and set(added).isdisjoint(c.effects)) for c in diagnosis.named):
        return ""
    others = ", ".join(label(*candidate.group) for candidate in stays(diagnosis))
    but = f" It leaves {others} in the field, which the RMS above has removed." if others else ""
    verdict = (
        "corrects for what belongs to the vehicle and its sensor"
        if diagnosis.total.shown
        else "shows no improvement on what it was not fitted to: do not use it before another log does"
    )
    return f"The extended calibration, calibration.json beside this page, {verdict}.{but}"


def _alone(diagnosis: Diagnosis) -> list[Note]:
    """Say what the extended calibration does by itself, where some of what was found stays in the field."""
    if not stays(diagnosis):
        return []
    found = alone(diagnosis)
    text = (
        f"By itself it takes the difference from the reference from {number(found.before)} to "
        f"{number(found.after)} nT RMS, and about its mean from {number(found.scatter_before)} to "
        f"{number(found.scatter_after)} nT, on this log, to which it was fitted."
    )
    return [Note("by_itself", text, found._asdict())]


def _against(
    diagnosis: Diagnosis, noted: Sequence[Sequence[Note]], shift: Level | None, track: Returns | None
) -> list[Note]:
    """List what a reviewer must see settled; `noted` is what to know of each finding."""
    survey, rest = diagnosis.problem.survey, diagnosis.unexplained
    found = [Note("own_log", OWN)] if (survey.fitted & ~survey.learned).any() else []
    if warnings := "; ".join(diagnosis.problem.calibration.warnings):
        found.append(Note("unsupported", f"The calibration's own data do not support it: {warnings}."))
    if shift is not None:
        text = (
            f"The extended calibration shifts the whole corrected field by {shift.shift:+.1f} nT, to within "
            f"{shift.sigma:.1f} nT (1 sigma, if the names are right). A log cannot tell for sure whether a "
            "constant belongs to the vehicle or to the reference: check the extended field against another "
            "reference before using it."
        )
        found.append(Note("level", text, shift._asdict()))
    found += [
        Note(note.code, f"{_name(one)}: {note.text}", note.numbers)
        for one, some in zip(diagnosis.findings, noted, strict=True)
        for note in some
        if note.code in DOUBTS
    ]
    found += _place_or_time(diagnosis, track)
    for one, other, a, b, both in cancelling(diagnosis):
        text = (
            f"{_name(one)} and {_name(other)} largely cancel each other ({number(a)} and {number(b)} nT RMS, "
            f"together {number(both)}): outside of what was flown, their sum may be far off."
        )
        found.append(Note("cancelling", text, {"one_nT": a, "other_nT": b, "together_nT": both}))
    if rest:
        text = f"Something of S/N {rest.signal_to_noise:.1f} is left that has no name."
        found.append(Note("unexplained", text, {"signal_to_noise": rest.signal_to_noise}))
    return found


def _place_or_time(diagnosis: Diagnosis, track: Returns | None) -> list[Note]:
    """Say so where an error of the reference is slow, and the track does not tell place from time."""
    if track is None or track.apart:
        return []
    about = [one for one in diagnosis.findings if one.candidate.about in ("place", "time")]
    slow = [_name(one) for one in about if slow_share(diagnosis.problem, one) >= SLOWLY]
    text = f"{track.text} Only their usual shapes speak for: {', '.join(slow)}."
    return [Note("place_or_time", text, track._asdict())] if slow else []


def _manoeuvres(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """List what would tell the possible causes apart."""
    found = [causes[one.candidate.cause].separated_by for one in diagnosis.findings if contested(one)]
    rest = diagnosis.unexplained
    if rest is not None and rest.within:
        found.append(causes[rest.within[0].candidate.cause].separated_by)
    return found


def _name(finding: Finding) -> str:
    return label(*finding.candidate.group)
