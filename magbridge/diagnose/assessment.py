"""The assessment of a diagnosis: quantities, notes, and the usability of the extended calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import chi2

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.model import Calibration
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.diagnosis import Diagnosis, Finding, label, measured, names_of, series_of
from magbridge.diagnose.evidence import FALSE_ALARM_RATE
from magbridge.diagnose.improvement import corrected
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
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnostics import CONDITION_CODES, Diagnostic, number, write_text
from magbridge.estimation.residual import residuals, residuals_of, rms

CANCEL = 0.7
"""Ratio of the RMS of two causes' sum to that of the larger cause, below which they cancel each other."""
IMPLAUSIBLE_MULTIPLE = 5.0
"""Multiple of its plausible size above which a cause is implausible."""
MIN_REMOVED_SIGMA = 1.5
"""Least RMS error that the extension of an unsupported calibration removes, in sigmas of its corrected field.
Measured logs: 0.9 to 1.25 where the later part became worse, 1.36 to 4.9 where it improved."""
SLOWLY = 0.9
"""Least fraction of a slow cause's power that a parabola over the log explains."""
DOUBTS = ("contested", "random_walk", "implausible_amplitude", "no_improvement")
"""Codes of notes on findings that are reasons against the use of the extended calibration."""
Fitness = Literal["yes", "conditional", "no"]
Reason = Literal[
    "held_out_and_other_day", "one_condition", "nothing_added", "not_needed", "refused", "no_improvement",
    "within_sigma", "refit_as_good",
]  # fmt: skip
"""Code of the reason for a verdict of :data:`Fitness`."""


class Level(NamedTuple):
    """Shift of the whole corrected field, nT, and its 1-sigma if the named causes are right, nT."""

    shift: float
    sigma: float


class Delays(NamedTuple):
    """Delays (2,) of the axes y and z after x, s, their 1-sigma, s, and the RMS that they cause, nT."""

    later: FloatArray
    sigma: FloatArray
    rms: float


class TelemetryDelay(NamedTuple):
    """Delay of the telemetry, s, its 1-sigma, s, and the RMS errors, nT, without and with its correction."""

    delay_s: float
    sigma_s: float
    before_nt: float
    after_nt: float


class Budget(NamedTuple):
    """RMS of the residual, nT: predicted, as given, held out by a refit and by the extension, and fitted."""

    predicted: float
    before: float
    refitted: float | None
    after: float | None
    fitted: float


def level(problem: Problem, possible: Sequence[Candidate], extended: Calibration) -> Level | None:
    """Return the shift of the whole corrected field if an error of the reference is a possible cause.

    Return None otherwise, and if shift and sigma are below the noise.
    """
    if not any(candidate.about != "vehicle" for candidate in possible):
        return None
    survey = problem.survey
    # Mean change of the residual, and its sigma by the mean derivative
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
    """Return the axes' delays, which no calibration can undo; None if they are insignificant."""
    # Delays relative to x: a common delay is invisible in the total field
    places, to_x = np.arange(len(fit.z))[DELAYS], np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    later = AXIS_DELAY_SIGMA_S * to_x @ fit.z[places]
    covariance = AXIS_DELAY_SIGMA_S**2 * to_x @ fit.covariance[np.ix_(places, places)] @ to_x.T
    if chi2.sf(later @ np.linalg.solve(covariance, later), later.size) >= FALSE_ALARM_RATE:
        return None
    taken = float(np.std(problem.delay_jacobian @ fit.z[DELAYS]))
    return Delays(later, np.sqrt(np.diag(covariance)), taken)


def motion(problem: Problem, finding: Finding) -> dict[str, float] | None:
    """Return fractions of a cause's power (`share`) and of samples (`usual`) next to moving masses.

    `interval` is the sampling interval, s. Return None if the cause acts at other samples as well.
    """
    survey = problem.survey
    p = survey.values([parameter.name for parameter in problem.calibration.parameters])
    # Samples next to a motion, and the cause's share of power there
    steps = np.any(np.diff(p, axis=0) != 0.0, axis=1)
    moving = np.append(steps, False) | np.append(False, steps)
    power = (finding.candidate.columns(slice(0, len(survey))) @ finding.coefficients) ** 2
    share, usual = float(power[moving].sum() / power.sum()), float(moving.mean())
    found = {"share": share, "usual": usual, "interval": float(np.median(np.diff(survey.time)))}
    return None if usual > 0.5 or share < 0.8 else found


def telemetry_delay(diagnosis: Diagnosis, finding: Finding) -> TelemetryDelay | None:
    """Return the telemetry delay and its effect on the corrected field; None if the cause is not a delay."""
    candidate = finding.candidate
    row = diagnosis.causes.get(candidate.cause)
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
    """Return the fraction of the variance of a cause's effect that a parabola over the log explains."""
    field = finding.field(problem)
    smooth = np.polynomial.Polynomial.fit(problem.survey.time, field, 2)(problem.survey.time)
    return 1.0 - float(np.var(field - smooth)) / max(float(np.var(field)), 1e-300)


def times_usual(candidate: Candidate, b: FloatArray) -> float:
    """Return the largest coefficient of b (k,) in plausible sizes; 0 for coefficients of one common size."""
    return float(np.abs(b).max()) if candidate.spectra is None else 0.0


def cancelling(diagnosis: Diagnosis) -> list[tuple[Finding, Finding, float, float, float]]:
    """Return pairs of findings that largely cancel, each with the RMS of both and of their sum, nT."""
    fields = [(one, one.field(diagnosis.problem)) for one in diagnosis.findings]
    return [
        (one, other, rms(a), rms(b), rms(a + b))
        for (one, a), (other, b) in combinations(fields, 2)
        if rms(a + b) < CANCEL * max(rms(a), rms(b))
    ]


def budget(diagnosis: Diagnosis) -> Budget:
    """Return the RMS of the residual that the calibration predicts and of the residuals found."""
    counts, total = diagnosis.counts, diagnosis.total
    predicted = float(np.sqrt(np.mean(diagnosis.problem.stated[counts])))
    refitted, after = (diagnosis.over_refit.before, total.after) if diagnosis.findings else (None, None)
    return Budget(predicted, total.before, refitted, after, rms(diagnosis.residual[counts]))


def notes(diagnosis: Diagnosis, finding: Finding) -> list[Diagnostic]:
    """Return the notes on one finding: on its numbers, its competing hypotheses, and its use."""
    cause = diagnosis.causes[finding.candidate.cause]
    return [
        *_of_numbers(finding),
        not_separated(finding.candidate, cause, finding.competing),
        *_of_use(diagnosis, finding),
    ]


def _of_numbers(finding: Finding) -> Iterator[Diagnostic]:
    """Yield notes on the numbers of a finding, on an implausible amplitude, and on possible noise."""
    candidate = finding.candidate
    if any(name.endswith(")") for name in candidate.names):
        yield Diagnostic("several_terms")
    variance = dict(zip(candidate.names, finding.coefficients, strict=True)).get("variance", 0.0)
    if variance > 0.0:
        yield Diagnostic("attenuation", {"corner_Hz": 0.5 / np.pi / float(np.sqrt(variance))})
    times = times_usual(candidate, finding.coefficients)
    if times >= IMPLAUSIBLE_MULTIPLE:
        yield Diagnostic("implausible_amplitude", {"times_usual": times})
    if finding.may_be_noise:
        yield Diagnostic("random_walk", {"log_odds": finding.over_random_walk})


def _of_use(diagnosis: Diagnosis, finding: Finding) -> Iterator[Diagnostic]:
    """Yield notes on when a cause acts, whether the calibration corrects it, and the improvement."""
    candidate, rest = finding.candidate, diagnosis.unexplained
    found = motion(diagnosis.problem, finding)
    if found is not None:
        yield Diagnostic("beside_moving_masses", found)
    late = telemetry_delay(diagnosis, finding)
    if late is not None and late.after_nt < late.before_nt:
        values = {"delay_s": late.delay_s, "before_nT": late.before_nt, "after_nT": late.after_nt}
        tables = " and ".join(f"[telemetry.{p.name}]" for p in diagnosis.problem.calibration.parameters)
        delay = measured(late.delay_s, late.sigma_s)
        yield Diagnostic("telemetry_delay", {**values, "tables": tables, "delay": delay})
    if any(piece.since for piece in candidate.pieces):
        yield Diagnostic("recent")
    if not set(candidate.effects) <= set(diagnosis.calibration.effects):
        yield Diagnostic("not_live")
    if not finding.improvement.shown:
        yield Diagnostic("no_improvement")
    if rest is not None and rest.signal_to_noise >= finding.signal_to_noise:
        yield Diagnostic("rest_is_stronger")


def not_separated(candidate: Candidate, cause: Cause, competing: Sequence[CompetingHypothesis]) -> Diagnostic:
    """Return a note on the causes that could take a candidate's place, and on how to distinguish them."""
    others = [hypothesis.candidate for hypothesis in competing]
    if not others:
        return Diagnostic("alone")
    if all(other.cause == candidate.cause for other in others):
        series = ", ".join(str(series_of(other)) for other in others)
        return Diagnostic("series_uncertain", {"series": series})
    return Diagnostic("contested", {"others": names_of(others, " or "), "manoeuvre": cause.disambiguation})


def separation(track: Returns) -> Diagnostic:
    """Return a note on whether the track separates spatial from slow temporal changes of the field."""
    code = "separable" if track.distinguishable else "alike" if track.share else "never"
    values = {"share": track.share, "hours": track.longest / 3600.0, "like": 1.0 - track.separable}
    return Diagnostic(f"track.{code}", values)


@dataclass(frozen=True)
class Assessment:
    """Verdict on the extended calibration, with reasons and quantities for the report."""

    fit_for_use: Fitness
    """Usability of the written calibration in place of the given one."""
    reason: Reason
    condition: str
    """Condition of a conditional verdict; empty otherwise."""
    summary: str
    """Verdict and reason in words."""
    reasons_for: tuple[Diagnostic, ...]
    reasons_against: tuple[Diagnostic, ...]
    manoeuvres: tuple[str, ...]
    """Manoeuvres that would distinguish the possible causes."""
    notes: tuple[tuple[Diagnostic, ...], ...]
    """Notes on each finding, in the order of the findings."""
    reference_shift: Level | None
    """Shift of the whole corrected field that may be an error of the reference."""
    delays: Delays | None
    """Delays of the sensor's axes; None if insignificant."""
    budget: Budget
    residual: Memory
    follows: Seen
    """Series that the residual of the fit follows."""
    returns: Returns | None
    """Returns of the track, which separate spatial from temporal changes; None without positions."""


class DiagnosisResult(NamedTuple):
    """The result of a diagnosis: the findings, and their assessment."""

    diagnosis: Diagnosis
    assessment: Assessment


def assess(diagnosis: Diagnosis) -> DiagnosisResult:
    """Return a diagnosis with its assessment."""
    problem, residual = diagnosis.problem, diagnosis.residual / diagnosis.problem.reference_jacobian
    shift = level(problem, diagnosis.possible, diagnosis.calibration)
    track = returns(problem.survey)
    noted = tuple(tuple(notes(diagnosis, finding)) for finding in diagnosis.findings)
    against = list(_against(diagnosis, noted, shift, track)) if diagnosis.named else []
    use = useful(diagnosis)
    if use:
        against += _domain(diagnosis)
    fitness, reason = _fitness(diagnosis, against)
    # Manoeuvres that would distinguish the possible causes
    uncertain = [
        f.candidate
        for f in diagnosis.findings
        if any(h.candidate.cause != f.candidate.cause for h in f.competing)
    ]
    if diagnosis.unexplained is not None:
        uncertain += [h.candidate for h in diagnosis.unexplained.within[:1]]
    manoeuvres = tuple(dict.fromkeys(diagnosis.causes[c.cause].disambiguation for c in uncertain))
    condition = _condition(diagnosis, against, manoeuvres) if fitness == "conditional" else ""
    if use and diagnosis.other_day is None:
        against.append(Diagnostic("same_log"))
    return DiagnosisResult(
        diagnosis,
        Assessment(
            fit_for_use=fitness, reason=reason, condition=condition,
            summary=_summary(diagnosis, reason, condition),
            reasons_for=(use,) if use else (), reasons_against=tuple(against),
            manoeuvres=manoeuvres, notes=noted, reference_shift=shift,
            delays=delays(problem, diagnosis.fit), budget=budget(diagnosis),
            residual=memory(problem, residual), follows=seen(problem, residual), returns=track,
        ),
    )  # fmt: skip


def _fitness(diagnosis: Diagnosis, against: Sequence[Diagnostic]) -> tuple[Fitness, Reason]:
    """Return the usability of the written calibration, and the code of the reason."""
    # The first objection decides; without any, another day is needed for an unconditional yes
    objections: dict[Reason, bool] = {
        "nothing_added": not diagnosis.named,
        "refused": bool(diagnosis.refused),
        "not_needed": diagnosis.negligible,
        "no_improvement": not diagnosis.improvement.shown,
        "within_sigma": bool(diagnosis.problem.calibration.warnings) and _within_sigma(diagnosis),
        "refit_as_good": not diagnosis.over_refit.shown,
    }
    reason = next((code for code, applies in objections.items() if applies), None)
    if reason is not None:
        return "no", reason
    other_day = diagnosis.other_day is not None and diagnosis.other_day.shown
    if other_day and not any(note.code in CONDITION_CODES for note in against):
        return "yes", "held_out_and_other_day"
    return "conditional", "one_condition"


def _within_sigma(diagnosis: Diagnosis) -> bool:
    """Return True if the error that remains may oppose, in later samples, the error that is removed."""
    sigma = corrected(diagnosis.problem.survey, diagnosis.calibration).sigma[diagnosis.counts]
    before, after, _, _ = diagnosis.improvement
    return before**2 - after**2 < (MIN_REMOVED_SIGMA * rms(sigma)) ** 2


def _condition(diagnosis: Diagnosis, against: Sequence[Diagnostic], manoeuvres: Sequence[str]) -> str:
    """Return the condition, in words, that removes the weightiest objection; default: another day's log."""
    codes = [note.code for note in against if note.code in CONDITION_CODES]
    code = min(codes, key=CONDITION_CODES.index, default="same_log")
    warnings = "; ".join(diagnosis.problem.calibration.warnings)
    return write_text(f"condition.{code}", warnings=warnings, manoeuvres="; ".join(manoeuvres))


def _summary(diagnosis: Diagnosis, reason: Reason, condition: str) -> str:
    """Return the verdict for the given `reason` in words."""
    allowed, found = diagnosis.refusal_values
    why = (
        write_text(f"refusal.{diagnosis.refused}", allowed=allowed, found=found) if diagnosis.refused else ""
    )
    code = "holds" if reason == "nothing_added" and diagnosis.unexplained is None else reason
    return write_text(f"summary.{code}", condition=condition, why=why, before_nT=diagnosis.total.before)


def _domain(diagnosis: Diagnosis) -> list[Diagnostic]:
    """Return a note on the ranges of attitude and channels in which the improvement was measured."""
    survey, known = diagnosis.problem.survey, diagnosis.problem.calibration
    fresh = ~survey.learned
    names = dict.fromkeys([*known.units, *diagnosis.calibration.channels])
    series = {name: (survey.channels[name].values, survey.channels[name].unit) for name in names}
    if survey.attitude is not None:
        roll, pitch, _ = survey.attitude.T
        series = {"roll": (roll, "deg"), "pitch": (pitch, "deg")} | series
    texts: list[str] = []
    ends: dict[str, float] = {}
    for name, (values, unit) in series.items():
        low, high = float(values[fresh].min()), float(values[fresh].max())
        texts.append(f"{name} {number(low)} to {number(high)} {unit}".rstrip())
        ends |= {f"{name}_min": low, f"{name}_max": high}
    return [Diagnostic("domain", {**ends, "ranges": ", ".join(texts)})] if texts else []


def useful(diagnosis: Diagnosis) -> Diagnostic | None:
    """Return the note in favour of the extended calibration; None if it corrects no named cause."""
    added = diagnosis.calibration.effects
    if diagnosis.refused or not diagnosis.named:
        return None
    stays = [c for c in diagnosis.named if not c.effects or any(effect not in added for effect in c.effects)]
    others = ", ".join(label(*candidate.group) for candidate in stays)
    verdict = write_text("use.good" if diagnosis.improvement.shown else "use.bad")
    return Diagnostic(
        "use", {"verdict": verdict, "but": write_text("use.but", others=others) if others else ""}
    )


def _against(
    diagnosis: Diagnosis, noted: Sequence[Sequence[Diagnostic]], shift: Level | None, track: Returns | None
) -> Iterator[Diagnostic]:
    """Yield the reasons against the use of the extended calibration; `noted` has each finding's notes."""
    survey, rest = diagnosis.problem.survey, diagnosis.unexplained
    if (survey.fitted & ~survey.learned).any():
        yield Diagnostic("own_log")
    if warnings := "; ".join(diagnosis.problem.calibration.warnings):
        yield Diagnostic("unsupported", {"warnings": warnings})
    if shift is not None:
        yield Diagnostic("reference_shift", shift._asdict())
    for finding, some in zip(diagnosis.findings, noted, strict=True):
        for note in some:
            if note.code in DOUBTS:
                yield note._replace(about=_name(finding))
    if track is not None and not track.distinguishable:
        about = [one for one in diagnosis.findings if one.candidate.about in ("place", "time")]
        slow = [_name(one) for one in about if slow_share(diagnosis.problem, one) >= SLOWLY]
        values = {"track": separation(track).text, "names": ", ".join(slow)}
        if slow:
            yield Diagnostic("spatial_temporal", {**track._asdict(), **values})
    for one, other, a, b, both in cancelling(diagnosis):
        values = {"one": _name(one), "other": _name(other)}
        yield Diagnostic("cancelling", {**values, "one_nT": a, "other_nT": b, "together_nT": both})
    if rest:
        yield Diagnostic("unexplained", {"signal_to_noise": rest.signal_to_noise})


def _name(finding: Finding) -> str:
    return label(*finding.candidate.group)
