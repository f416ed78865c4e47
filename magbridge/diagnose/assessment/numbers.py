"""Quantities of a diagnosis in addition to its findings: shifts, fractions, delays, budget of its RMS."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.stats import chi2

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.model import Calibration
from magbridge.diagnose.causes import known
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.derivatives import DERIVATIVE_ROWS, derivatives
from magbridge.diagnose.compare.problem import AXIS_DELAY_SIGMA_S, DELAYS, Problem, samples_of
from magbridge.diagnose.inference.evidence import FALSE_ALARM_RATE
from magbridge.diagnose.inference.joint import Joint
from magbridge.estimation.residual import residuals, residuals_of, rms

if TYPE_CHECKING:
    from magbridge.diagnose.diagnosis import Diagnosis, Finding

__all__ = [
    "Budget", "Delays", "Level", "Motion", "TelemetryDelay", "budget", "cancelling", "delays", "level",
    "motion", "slow_share", "stays", "telemetry_delay", "times_usual",
]  # fmt: skip

CANCEL = 0.7
"""Two causes cancel each other where their sum is less than this share of the larger one."""


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
