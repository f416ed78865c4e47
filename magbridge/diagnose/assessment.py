"""The assessment of a diagnosis: quantities, notes, and whether the extended calibration is fit for use."""

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
"""Two causes cancel each other where their sum is less than this share of the larger one."""
IMPLAUSIBLE_MULTIPLE = 5.0
"""Multiple of its plausible size above which a cause is implausible."""
SLOWLY = 0.9
"""Fraction of its power that a trend and a curvature over the log explain, for a cause to be called slow."""
DOUBTS = ("contested", "random_walk", "implausible_amplitude", "no_improvement")
"""Codes of notes that are reasons against the use of an extended calibration."""
Fitness = Literal["yes", "conditional", "no"]
Reason = Literal[
    "held_out_and_other_day", "one_condition", "nothing_added", "not_needed", "reference_only", "refused",
    "no_improvement", "refit_as_good",
]  # fmt: skip
"""Code of the reason for the answer."""


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
    """Delay of the telemetry, s, its 1-sigma, and the RMS error as given and with the delay undone, nT."""

    delay_s: float
    sigma_s: float
    before_nt: float
    after_nt: float


class Budget(NamedTuple):
    """RMS of measured less simulated, nT: predicted, before, by a refit and after (held out), fitted."""

    predicted: float
    before: float
    refitted: float | None
    after: float | None
    fitted: float


def level(problem: Problem, possible: Sequence[Candidate], extended: Calibration) -> Level | None:
    """Return the shift of the whole corrected field if an error of the reference is among the causes.

    None where shift and sigma are below the noise.
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
    """Return the axes' delays where they look interpolated: a noise that no calibration can undo."""
    # Delays relative to x: a common delay is invisible in the total field
    places, to_x = np.arange(len(fit.z))[DELAYS], np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    later = AXIS_DELAY_SIGMA_S * to_x @ fit.z[places]
    covariance = AXIS_DELAY_SIGMA_S**2 * to_x @ fit.covariance[np.ix_(places, places)] @ to_x.T
    if chi2.sf(later @ np.linalg.solve(covariance, later), later.size) >= FALSE_ALARM_RATE:
        return None
    taken = float(np.std(problem.delay_jacobian @ fit.z[DELAYS]))
    return Delays(later, np.sqrt(np.diag(covariance)), taken)


def motion(problem: Problem, finding: Finding) -> dict[str, float] | None:
    """Return the fractions of a cause's power and of the samples next to moving masses, and the interval, s.

    None where the cause acts elsewhere as well.
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
    """Return the telemetry delay of a clock offset, with the corrector's errors; None for other causes."""
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
    """Return the share of a cause's power, about its mean, that a parabola over the log explains."""
    field = finding.field(problem)
    smooth = np.polynomial.Polynomial.fit(problem.survey.time, field, 2)(problem.survey.time)
    return 1.0 - float(np.var(field - smooth)) / max(float(np.var(field)), 1e-300)


def times_usual(candidate: Candidate, b: FloatArray) -> float:
    """Return the size of a cause b (k,) over its plausible size; 0 where its terms share one size."""
    return float(np.abs(b).max()) if candidate.spectra is None else 0.0


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


def notes(diagnosis: Diagnosis, finding: Finding) -> list[Diagnostic]:
    """List what to know of one finding."""
    cause = diagnosis.causes[finding.candidate.cause]
    return [
        *_of_numbers(finding),
        not_separated(finding.candidate, cause, finding.competing),
        *_of_use(diagnosis, finding),
    ]


def _of_numbers(finding: Finding) -> Iterator[Diagnostic]:
    """Yield notes on its numbers, on an implausible amplitude, and on whether it may be noise."""
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
    """Yield notes on when and where it acts, whether it is corrected, and how much that improves."""
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
    """Return a note on the causes that could take its place, and on how to distinguish them."""
    others = [hypothesis.candidate for hypothesis in competing]
    if not others:
        return Diagnostic("alone")
    if all(other.cause == candidate.cause for other in others):
        series = ", ".join(str(series_of(other)) for other in others)
        return Diagnostic("series_uncertain", {"series": series})
    return Diagnostic("contested", {"others": names_of(others, " or "), "manoeuvre": cause.disambiguation})


def separation(track: Returns) -> Diagnostic:
    """Return whether a track distinguishes place from time."""
    code = "separable" if track.distinguishable else "alike" if track.share else "never"
    values = {"share": track.share, "hours": track.longest / 3600.0, "like": 1.0 - track.separable}
    return Diagnostic(f"track.{code}", values)


@dataclass(frozen=True)
class Assessment:
    """Verdict, reasons and quantities that the report shows in addition to the findings."""

    fit_for_use: Fitness
    """Usability of the written calibration in place of the given one."""
    reason: Reason
    condition: str
    """Condition of a conditional verdict; empty otherwise."""
    summary: str
    """The answer as a sentence."""
    reasons_for: tuple[Diagnostic, ...]
    reasons_against: tuple[Diagnostic, ...]
    manoeuvres: tuple[str, ...]
    """Manoeuvres that would resolve the open questions."""
    notes: tuple[tuple[Diagnostic, ...], ...]
    """What to know before believing each finding."""
    reference_shift: Level | None
    """Shift of the whole corrected field that may be the reference's."""
    delays: Delays | None
    """Delays of the sensor's axes, if they look interpolated."""
    budget: Budget
    residual: Memory
    follows: Seen
    """Series that the residual follows."""
    returns: Returns | None
    """How well the track separates place from time; None without positions."""


class DiagnosisResult(NamedTuple):
    """The result of a diagnosis: the findings, and their assessment."""

    diagnosis: Diagnosis
    assessment: Assessment


def assess(diagnosis: Diagnosis) -> DiagnosisResult:
    """Weigh a diagnosis; return it with its assessment."""
    problem, residual = diagnosis.problem, diagnosis.residual / diagnosis.problem.reference_jacobian
    shift = level(problem, diagnosis.possible, diagnosis.calibration)
    track = returns(problem.survey)
    noted = tuple(tuple(notes(diagnosis, finding)) for finding in diagnosis.findings)
    against = list(_against(diagnosis, noted, shift, track)) if diagnosis.named else []
    use = useful(diagnosis)
    if use:
        against += _domain(diagnosis)
    fitness, reason = _fitness(diagnosis, bool(use), against)
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


def _fitness(diagnosis: Diagnosis, use: bool, against: Sequence[Diagnostic]) -> tuple[Fitness, Reason]:
    """Return whether the written calibration is fit for use, and the code of the reason."""
    # The first objection decides; without any, another day is needed for an unconditional yes
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
    if other_day and not any(note.code in CONDITION_CODES for note in against):
        return "yes", "held_out_and_other_day"
    return "conditional", "one_condition"


def _condition(diagnosis: Diagnosis, against: Sequence[Diagnostic], manoeuvres: Sequence[str]) -> str:
    """Return the condition that removes the weightiest objection, else that of a log of another day."""
    codes = [note.code for note in against if note.code in CONDITION_CODES]
    code = min(codes, key=CONDITION_CODES.index, default="same_log")
    warnings = "; ".join(diagnosis.problem.calibration.warnings)
    return write_text(f"condition.{code}", warnings=warnings, manoeuvres="; ".join(manoeuvres))


def _summary(diagnosis: Diagnosis, reason: Reason, condition: str) -> str:
    """Return the answer as a sentence."""
    allowed, found = diagnosis.refusal_values
    why = (
        write_text(f"refusal.{diagnosis.refused}", allowed=allowed, found=found) if diagnosis.refused else ""
    )
    code = "holds" if reason == "nothing_added" and diagnosis.unexplained is None else reason
    return write_text(f"summary.{code}", condition=condition, why=why, before_nT=diagnosis.total.before)


def _domain(diagnosis: Diagnosis) -> list[Diagnostic]:
    """List the ranges of attitude, depth and telemetry in which the improvement was measured."""
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
    """Return which causes the extended calibration corrects; None if nothing was added to it."""
    added = diagnosis.calibration.effects
    if diagnosis.refused:
        return None
    if all(c.about != "vehicle" or (c.effects and set(added).isdisjoint(c.effects)) for c in diagnosis.named):
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
    """Yield the reasons against use, which a reviewer must resolve; `noted` has the notes of each finding."""
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
