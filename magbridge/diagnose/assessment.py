"""The assessment of a diagnosis: quantities, notes, and whether the extended calibration is fit for use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.stats import chi2

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.model import Calibration
from magbridge.diagnose.alternatives import CompetingHypothesis
from magbridge.diagnose.causes import Cause, known
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.evidence import FALSE_ALARM_RATE
from magbridge.diagnose.joint import Joint
from magbridge.diagnose.observed import Memory, Returns, Seen, memory, returns, seen
from magbridge.diagnose.problem import (
    AXIS_DELAY_SIGMA_S,
    DELAYS,
    DERIVATIVE_ROWS,
    Problem,
    derivatives,
    samples_of,
)
from magbridge.diagnose.words import label, measured, names_of, number, series_of
from magbridge.estimation.residual import residuals, residuals_of, rms

if TYPE_CHECKING:
    from magbridge.diagnose.diagnosis import Diagnosis, Finding

__all__ = [
    "IMPLAUSIBLE_MULTIPLE", "OWN_LOG_TEXT", "Assessment", "Delays", "Fitness", "Note", "assess", "delays",
    "level", "not_separated", "telemetry_delay", "times_usual", "useful",
]  # fmt: skip

CANCEL = 0.7
"""Two causes cancel each other where their sum is less than this share of the larger one."""
IMPLAUSIBLE_MULTIPLE = 5.0
"""Multiple of its plausible size above which a cause is implausible."""
DOUBTS = ("contested", "random_walk", "implausible_amplitude", "no_improvement")
"""Codes of notes that are reasons against the use of an extended calibration."""
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


class Level(NamedTuple):
    """By how much the whole corrected field is shifted, and its 1-sigma if the names are right, nT."""

    shift: float
    sigma: float


class Delays(NamedTuple):
    """By how much y and z were sampled later than x, s, with 1-sigma, and the RMS that this causes, nT."""

    later: FloatArray
    sigma: FloatArray
    rms: float


class TelemetryDelay(NamedTuple):
    """Delay of the telemetry behind the sensor, and the delays that the model corrects itself."""

    delay_s: float
    """Time by which the telemetry is late, s."""
    sigma_s: float
    """Standard deviation of the delay, s."""
    before_nt: float
    """RMS error of the corrected field as given, nT."""
    after_nt: float
    """RMS error with the telemetry moved by the delay and the calibration as given, nT."""


class Motion(NamedTuple):
    """Fraction of a cause's power next to moving masses, fraction of such samples, and the interval, s."""

    share: float
    usual: float
    interval: float


class Budget(NamedTuple):
    """RMS of measured less simulated, nT: predicted, before, by a refit and after (held out), fitted."""

    predicted: float
    before: float
    refitted: float | None
    after: float | None
    fitted: float


def level(problem: Problem, possible: Sequence[Candidate], extended: Calibration) -> Level | None:
    """Return by how much the corrected field is shifted as a whole, if the reference may be wrong.

    That is, if an error of it is among the `possible` causes: a constant may belong to either then. None
    where shift and sigma are below the noise.
    """
    if not any(candidate.about != "vehicle" for candidate in possible):
        return None
    survey = problem.survey
    before = residuals_of(*samples_of(survey, problem.calibration))
    samples, coefficients = samples_of(survey, extended)
    after, g = residuals(samples, coefficients)
    fresh = np.flatnonzero(~survey.learned)
    shift = float((after - before)[fresh].mean())
    some = fresh[:: 1 + fresh.size // DERIVATIVE_ROWS]  # enough for a mean
    every = np.eye(extended.coefficients.size)
    slope = derivatives(extended, samples.part(some), g[some], every).mean(axis=0)
    sigma = float(np.sqrt(slope @ extended.covariance @ slope))
    return None if max(abs(shift), sigma) < extended.noise.sensor else Level(shift, max(sigma, 0.1))


def delays(problem: Problem, fit: Joint) -> Delays | None:
    """Return the axes' delays where they look interpolated: a noise that no calibration can undo."""
    places, to_x = np.arange(len(fit.z))[DELAYS], np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    later = AXIS_DELAY_SIGMA_S * to_x @ fit.z[places]
    covariance = AXIS_DELAY_SIGMA_S**2 * to_x @ fit.covariance[np.ix_(places, places)] @ to_x.T
    if chi2.sf(later @ np.linalg.solve(covariance, later), later.size) >= FALSE_ALARM_RATE:
        return None
    taken = float(np.std(problem.straight(fit.z) - problem.residual))
    return Delays(later, np.sqrt(np.diag(covariance)), taken)


def motion(problem: Problem, finding: Finding) -> Motion | None:
    """Return how far a cause acts only while masses move: one that moved unseen between rows looks so."""
    survey = problem.survey
    p = survey.values([parameter.name for parameter in problem.calibration.parameters])
    steps = np.any(np.diff(p, axis=0) != 0.0, axis=1)
    moving = np.append(steps, False) | np.append(False, steps)
    power = (finding.candidate.columns(slice(0, len(survey))) @ finding.coefficients) ** 2
    share, usual = float(power[moving].sum() / power.sum()), float(moving.mean())
    interval = float(np.median(np.diff(survey.time)))
    return None if usual > 0.5 or share < 0.8 else Motion(share, usual, interval)


def telemetry_delay(diagnosis: Diagnosis, finding: Finding) -> TelemetryDelay | None:
    """Return the delay that a clock offset puts on the telemetry, with the field that it corrects.

    The corrector runs with the calibration as given and with each parameter interpolated to the later time.
    None for other causes.
    """
    candidate = finding.candidate
    row = known().get(candidate.cause)
    if row is None or not row.delays_telemetry:
        return None
    delay = float(np.sum(finding.coefficients * candidate.width))
    sigma = float(np.sqrt(candidate.width @ finding.covariance @ candidate.width))
    survey, calibration = diagnosis.problem.survey, diagnosis.problem.calibration
    channels, time = survey.values(calibration.channels), survey.time
    moved = channels.copy()
    for k in range(len(calibration.parameters)):
        moved[:, k] = np.interp(time + delay, time, channels[:, k])
    errors = [
        rms((correct(calibration, survey.field, values, time).total - survey.reference)[diagnosis.counts])
        for values in (channels, moved)
    ]
    return TelemetryDelay(delay, sigma, *errors)


def slow_share(problem: Problem, finding: Finding) -> float:
    """Return the share of a cause's power, about its mean, that a trend and a bend over the log explain."""
    field, time = finding.field(problem), problem.survey.time
    x = (time - time.mean()) / max(float(np.ptp(time)), 1e-300)
    smooth = np.polynomial.Polynomial.fit(x, field, 2)(x)
    return 1.0 - float(np.var(field - smooth) / max(np.var(field), 1e-300))


def times_usual(candidate: Candidate, b: FloatArray) -> float:
    """Return how many times its plausible size a cause of b (k,) is; 0 where its terms share one size."""
    return float(np.abs(b).max()) if candidate.spectra is None else 0.0


def stays(diagnosis: Diagnosis) -> list[Candidate]:
    """Return the named causes that the extended calibration does not correct for."""
    added = diagnosis.calibration.effects
    return [c for c in diagnosis.named if not c.effects or any(effect not in added for effect in c.effects)]


def cancelling(diagnosis: Diagnosis) -> list[tuple[Finding, Finding, float, float, float]]:
    """Return pairs of causes that largely cancel each other, with their RMS, and that of their sum, nT."""
    fields = [(one, one.field(diagnosis.problem)) for one in diagnosis.findings]
    return [
        (one, other, rms(a), rms(b), rms(a + b))
        for (one, a), (other, b) in combinations(fields, 2)
        if rms(a + b) < CANCEL * max(rms(a), rms(b))
    ]


def budget(diagnosis: Diagnosis) -> Budget:
    """Compare the residual that the calibration predicts with those that were found."""
    counts, total = diagnosis.counts, diagnosis.total
    predicted = float(np.sqrt(np.mean(diagnosis.problem.stated[counts])))
    refitted, after = (diagnosis.over_refit.before, total.after) if diagnosis.findings else (None, None)
    return Budget(predicted, total.before, refitted, after, rms(diagnosis.residual[counts]))


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
