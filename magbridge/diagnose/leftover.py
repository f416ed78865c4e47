"""The part of a residual that no known cause explains, modelled by free descriptions.

Notes
-----
The coefficients of a free description have one common free size (:mod:`.joint`). Descriptions are scored
under two noise models. One is of the given fit, whose noise may have absorbed an effect. The other is of a
fit with slow curves. The best descriptions are compared by the full likelihood, with the noise refitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.effects import TimeEffect, powers
from magbridge.diagnose.columns import AXIS_NAMES, Candidate, Columns, places, size_of, slices
from magbridge.diagnose.descriptions import Description, descriptions
from magbridge.diagnose.evidence import FALSE_ALARM_RATE, REMNANT, Hypothesis, information
from magbridge.diagnose.joint import Joint, JointDesign, Ridge, Statistic, in_threads, precomputed
from magbridge.diagnose.noise import ResidualNoise, fit_noise
from magbridge.diagnose.observed import Memory, memory
from magbridge.diagnose.problem import Problem, row_blocks
from magbridge.diagnose.search import Outliers
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.estimation.residual import rms, robust_scale

MAX_TESTED_COEFFICIENTS = 6
"""Most coefficients of a cause that is tested for a varying amplitude; with more, it fits almost any
shape."""
COMPARED_DESCRIPTIONS = 3
"""Number of descriptions, the best under each noise, that are compared by the full likelihood."""
AMPLITUDE_WAVES = 64
"""Number of half waves over the log by which the amplitude of a cause may vary."""
AMPLITUDE_CORNERS = 1.0, 8.0, 1e3
"""Numbers of half waves from which on the spectrum of a variation falls."""
AMPLITUDE_BANDS = (1, 2, 3, 5, 9, 17, 33, 65)
"""First half wave of each band of a variation; the last number ends the last band."""
TURNS = 6
"""Number of alternations between the fit of a curve and the fit of its direction."""
CALM = 2
"""Number of alternations between the fit of slow curves and the fit of noise."""
LOUD = 2.0
"""Ratio of a residual to the calibration's stated sigma above which a structureless residual is reported."""
SLOW, SMOOTH, NEGLIGIBLE = 0.4, 5.0, 1e-5
"""Limits above which a residual is far from white: fraction of its power in means over up to 64 samples;
ratio of its RMS to that of white noise with equal steps. Third: least RMS, as a fraction of the field."""


def varying(
    problem: Problem, candidate: Candidate, look_elsewhere: Mapping[str, float]
) -> Description | None:
    """Return a description of a named cause whose amplitude varies with other telemetry, attitude or time.

    A true cause has a constant amplitude in a log. A wrong one may leave its regressor times a function of
    another series. Return None for a cause with so many coefficients that it can have almost any shape.
    """
    if candidate.spectra is not None or candidate.size > MAX_TESTED_COEFFICIENTS:
        return None
    # Regressor times (1, v_1, v_2, ...), every v from -1 to 1
    values = _followed(problem, candidate.channel)
    low = np.array([[value.min()] for value in values])
    half = np.array([[max(0.5 * float(np.ptp(value)), 1e-12)] for value in values])
    regressor, n = candidate.columns, len(problem)
    # an RMS of one: its coefficients are in nT, as those of other descriptions are
    power = sum(float(np.sum(regressor(rows) ** 2)) for rows in row_blocks(n)) / (n * candidate.size)

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


def _fitted_effect(problem: Problem, candidate: Candidate, b: FloatArray) -> Columns:
    """Return the fitted effect (m, 1) of a candidate, for coefficients b (k,).

    A tone has a second column: the effect a quarter of a period later. A step and a drift have a constant
    offset in their direction of the body.
    """
    shapes = {effect.shape for effect in candidate.effects if isinstance(effect, TimeEffect)}
    if "tone" in shapes:
        cos, sin = np.split(b, 2)
        quadrature = np.column_stack([b, np.append(-sin, cos)])
        return lambda rows: np.asarray(candidate.columns(rows) @ quadrature)
    if shapes and b.size == len(AXIS_NAMES):
        return lambda rows: np.asarray(-problem.jacobian[rows, 6:] @ b[:, None])
    return lambda rows: np.asarray(candidate.columns(rows) @ b[:, None])


def amplitude_evidence(problem: Problem, fit: Joint, chosen: Sequence[Hypothesis]) -> float:
    """Return the log evidence that the amplitude of the strongest cause varies in time; 0 if it does not.

    A true cause has a constant amplitude in a log. The fitted effect of a wrong one is multiplied by half
    waves over the log. The evidence is the mean over their spectra and bands. A variation that may be a
    remnant of the cause's idealised regressor counts as none.
    """
    model = [one.candidate for one in chosen]
    k = max(range(len(chosen)), key=lambda n: chosen[n].signal_to_noise)
    candidate, least = model[k], REMNANT * chosen[k].signal_to_noise
    if candidate.spectra is not None or candidate.size > MAX_TESTED_COEFFICIENTS:
        return 0.0
    effect = _fitted_effect(problem, candidate, fit.coefficients[slices(model)[k]])
    columns = [one.columns for one in model]
    scored = list(_scored(problem, fit.noise, fit, columns, [_modulated(problem, effect)]))
    odds = [np.exp(one.evidence) if one.best.signal_to_noise >= least else 1.0 for one in scored]
    return max(float(np.log(np.mean(odds))), 0.0)


def soft_iron_evidence(problem: Problem, fit: Joint, chosen: Sequence[Hypothesis]) -> float:
    """Return the log evidence of a change of soft iron over the strongest cause, in its place.

    No telemetry confirms a cause that is a function of time alone. Such an offset is known only by its
    dependence on attitude. The same course in soft iron has the offset's columns, times the direction of the
    field in the body. Both have coefficients of one common size, so that neither pays for its number. Return
    minus infinity for a cause of another kind.
    """
    model = [one.candidate for one in chosen]
    k = max(range(len(chosen)), key=lambda n: chosen[n].signal_to_noise)
    candidate = model[k]
    if not candidate.effects or not all(isinstance(effect, TimeEffect) for effect in candidate.effects):
        return -np.inf

    def changed(rows: slice) -> FloatArray:
        """Return the columns of a change of soft iron, (m, 3 k)."""
        direction = problem.jacobian.T[6:, rows] / problem.reference_jacobian[rows]
        return np.asarray((candidate.columns(rows).T[:, None] * direction).reshape(3 * candidate.size, -1).T)

    # The evidence of each in the place of the cause, which is released; all other causes are projected out
    columns = [changed, *(one.columns for one in model)]
    own = slices(model, 3 * candidate.size)[k]
    alone = information(problem, fit.noise, fit, columns).released(fit, own)
    iron, offset = (
        Statistic(alone.matrix[at, at], np.ones((1, at.stop - at.start))).best(alone.score[at]).ratio
        for at in (slice(0, 3 * candidate.size), own)
    )
    return 0.5 * (iron - offset)


def _modulated(problem: Problem, effect: Columns) -> Description:
    """Return the description of an effect (m, k), multiplied by half waves over the log."""
    n, several = len(problem), size_of(effect)
    # An RMS of one, so that the prior widths are in nT
    scale = np.sqrt(max(sum(float(np.sum(effect(rows) ** 2)) for rows in row_blocks(n)) / n, 1e-300))
    time = problem.survey.time
    turn = np.exp(1j * np.pi * (time - time[0]) / max(float(time[-1] - time[0]), 1.0))

    def columns(rows: slice) -> FloatArray:
        waves = np.stack(powers(turn[rows], AMPLITUDE_WAVES)).real
        return np.asarray((waves[:, None] * (effect(rows).T / scale)).reshape(-1, waves.shape[1]).T)

    k = np.arange(1.0, AMPLITUDE_WAVES + 1.0)
    widths = [1.0 / np.sqrt(1.0 + (k / corner) ** 2) for corner in AMPLITUDE_CORNERS]
    widths += [np.where((k >= low) & (k < high), 1.0, 1e-3) for low, high in pairwise(AMPLITUDE_BANDS)]
    return Description(columns, tuple(("broadband", np.repeat(width, several)) for width in widths))


def _followed(problem: Problem, channel: str | None) -> list[FloatArray]:
    """Return the series (n,) that an amplitude may follow: time, telemetry except `channel`, and attitude."""
    survey = problem.survey
    channels = [c.values for name, c in survey.channels.items() if name not in (channel, *survey.still)]
    if survey.attitude is None:
        return [survey.time, *channels]
    roll, pitch, heading = survey.attitude.T
    heading = np.radians(heading)
    return [survey.time, *channels, roll, pitch, np.cos(heading), np.sin(heading)]


class Scored(NamedTuple):
    """A description with its score under one noise; `shift` is defined in :class:`.Information`."""

    evidence: float
    kind: str
    description: Description
    best: Ridge
    shift: FloatArray


class FittedDescription(NamedTuple):
    """A description fitted jointly with noise: log evidence, columns, fit, and number of hypotheses."""

    evidence: float
    columns: Columns
    fit: Joint
    look_elsewhere: float


class Leftover(NamedTuple):
    """Unexplained structure in a residual: its kind, its strength, and the channel that it follows."""

    kind: str
    """``switching``, ``drift``, ``tone``, ``transient`` or ``broadband``."""
    signal_to_noise: float
    p_value: float
    evidence: float
    """Log Bayes factor of the description against the model without it."""
    period_s: float | None
    """Period of a tone, s."""
    best_channel: str | None
    """Telemetry channel of the description; None if it is not a function of one."""
    description: Description | None = None
    """Best description; None if other tests found the structure."""
    choice: int = 1
    """Number of descriptions from which the best one was chosen."""
    within: tuple[CompetingHypothesis, ...] = ()
    """Causes that remain possible, because the description is better by less than their margin."""
    fitted: tuple[FittedDescription, ...] = ()
    """Best descriptions with their fits."""
    size: float | None = None
    """RMS of the structure in the total field, nT; None if unknown."""
    shifts: tuple[int, ...] = ()
    """Indices of the samples at which the level shifts, for ``switching``."""

    @property
    def evidence_of_choice(self) -> float:
        """Log evidence, less the log of the number of descriptions to choose from."""
        return self.evidence - float(np.log(self.choice))


def along_one_direction(S: FloatArray, b: FloatArray, width: FloatArray, free: Ridge) -> Ridge:
    """Return the estimate of one curve along one direction of the body, ``c = f d^T``.

    `free` is the estimate with a curve for each axis, S and b are information and score of its coefficients.
    The penalty of the direction's two parameters is as in :func:`~.evidence.log_bayes`.
    """
    # Start from the first singular vector of the `free` estimate; then fit f given d, and d given f, in turn
    count = len(width) // 3
    direction = np.linalg.svd(free.estimate.reshape(count, 3), full_matrices=False)[2][0]
    for _ in range(TURNS):
        along = np.kron(np.eye(count), direction[:, None])
        best = Statistic(along.T @ S @ along, width[None, ::3] ** 2).best(along.T @ b)
        axes = np.kron(best.estimate[:, None], np.eye(3))
        direction = np.linalg.lstsq(axes.T @ S @ axes, axes.T @ b, rcond=None)[0]
        direction /= max(float(np.linalg.norm(direction)), 1e-300)
    price = 1.0 + float(np.log(max(0.5 * best.ratio + best.price, 1.0)))
    return replace(
        best, ratio=best.ratio - 2.0 * price, estimate=along @ best.estimate, price=best.price + price
    )


def leftover(
    problem: Problem,
    model: Sequence[Candidate],
    fit: Joint,
    *,
    but: Sequence[Candidate] = (),
    also: Sequence[Description] = (),
) -> Leftover | None:
    """Return the best significant description of the residual of `model`, or None.

    Descriptions that only repeat the regressors of the causes in `but` are not tried; those in `also` are.
    """
    # Descriptions that only repeat an excluded cause's own regressors are not alternatives
    listed = [one for one in (*descriptions(problem, fit), *also) if not one.covers(but)]
    made = precomputed(len(problem), [one.columns for one in listed])
    listed = [one._replace(columns=columns) for one, columns in zip(listed, made, strict=True)]
    columns = [candidate.columns for candidate in model]
    # Screen all descriptions by their score; weigh the best under each noise by the whole likelihood
    found: list[tuple[FittedDescription, Scored]] = []
    for noise in (fit.noise, _calm(problem, columns, fit, listed[:2])):
        scored = _scored(problem, noise, fit, columns, listed)
        tried = sorted(scored, key=lambda one: -one.evidence)[:COMPARED_DESCRIPTIONS]
        weighed = in_threads(len(problem), lambda one: _weighed(problem, columns, fit, one), tried)
        found += zip(weighed, tried, strict=True)
    likeliest, (_, kind, one, best, _) = max(found, key=lambda entry: entry[0].evidence)
    evidence = likeliest.evidence
    # half of a chi-square's tail: a size that cannot be negative is zero as often as not (Self & Liang 1987)
    tail = 0.5 * float(chi2.sf(2.0 * max(evidence, 0.0), 1))
    # Bonferroni over descriptions and widths
    count = sum(len(one.widths) for one in listed)
    p_value = min(1.0, count * tail)
    # stricter where no cause was found: the distribution is only asymptotic
    if p_value >= (FALSE_ALARM_RATE if model else 0.1 * FALSE_ALARM_RATE):
        return None
    # RMS of the fitted description in the total field
    shape = likeliest.columns(slice(0, len(problem))) @ likeliest.fit.coefficients[-len(best.variance) :]
    size = rms(shape / problem.reference_jacobian)
    return Leftover(
        kind, best.signal_to_noise, p_value, evidence, one.period, one.channel, one, count,
        fitted=tuple(entry for entry, _ in found), size=size,
    )  # fmt: skip


def _scored(
    problem: Problem,
    noise: ResidualNoise,
    fit: Joint,
    model: Sequence[Columns],
    listed: Sequence[Description],
) -> Iterator[Scored]:
    """Yield the score of each description with each of its prior widths under `noise`."""
    columns = [*(one.columns for one in listed), *model]
    info = information(problem, noise, fit, columns, unshared=len(listed)).fitted(fit)
    for one, at in zip(listed, places(one.widths[0][1].size for one in listed), strict=True):
        for kind, width in one.widths:
            S, b = info.matrix[at, at], info.score[at]
            best = Statistic(S, width[None] ** 2).best(b)
            if one.turned:
                best = max(best, along_one_direction(S, b, width, best), key=lambda found: found.ratio)
            yield Scored(
                0.5 * best.ratio - float(np.log(one.look_elsewhere)), kind, one, best, info.shift[:, at]
            )


def _calm(
    problem: Problem, model: Sequence[Columns], fit: Joint, slow: Sequence[Description]
) -> ResidualNoise:
    """Return the noise of a fit with the `slow` curves, which starts from white noise."""
    level = np.full(len(problem), robust_scale(np.diff(fit.residual)) / np.sqrt(2.0) + 1e-12)
    ar, innovations = np.zeros_like(fit.noise.ar), fit.residual / level
    noise = replace(fit.noise, ar=ar, scale=level, nu=1e6, innovations=innovations)
    # Curves and noise in turn, from white noise: its level is that of the differences
    width = np.concatenate([one.widths[1][1] for one in slow])
    for _ in range(CALM):
        info = information(problem, noise, fit, [*(one.columns for one in slow), *model]).fitted(fit)
        c = Statistic(info.matrix, width[None] ** 2).best(info.score).estimate
        X = JointDesign(problem, [*model, *(one.columns for one in slow)])
        residual = fit.residual - X.times(np.append(-info.shift @ c, c))
        noise = fit_noise(residual, fit.noise.past, blocks=fit.noise.uneven)
    return noise


def _weighed(problem: Problem, model: Sequence[Columns], fit: Joint, scored: Scored) -> FittedDescription:
    """Return a description fitted with model and noise, and its log evidence by Laplace's approximation."""
    one, best, q = scored.description, scored.best, len(fit.z)
    c, columns = best.estimate, one.columns
    moved = -scored.shift @ c
    residual = fit.residual - JointDesign(problem, [*model, columns]).times(np.append(moved, c))
    # Gain in likelihood with the noise fitted again, less the change of the prior
    noise = fit_noise(residual, fit.noise.past, blocks=fit.noise.uneven, like=fit.noise)
    z = fit.z + moved[:q]
    pull = float(fit.prior[:q] @ ((z - problem.centre) ** 2 - (fit.z - problem.centre) ** 2))
    gained = noise.log_likelihood - fit.noise.log_likelihood - 0.5 * pull
    if len(best.variance) < len(c):  # along one direction
        curves = c.reshape(len(best.variance), -1)
        direction = np.linalg.svd(curves, full_matrices=False)[2][0]
        c, columns = curves @ direction, lambda rows: _along(one.columns(rows), direction)
    coefficients = np.append(fit.coefficients + moved[q:], c)
    prior = np.append(fit.prior, 1.0 / best.variance)
    # no more than the description itself can gain: the rest is of a noise that found another optimum
    evidence = min(scored.evidence, gained - best.price - float(np.log(one.look_elsewhere)))
    made = replace(
        fit, log_likelihood=fit.log_likelihood + gained, z=z, coefficients=coefficients, prior=prior,
        noise=noise, residual=residual,
    )  # fmt: skip
    return FittedDescription(evidence, columns, made, one.look_elsewhere)


def _along(part: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the columns (m, k) along one direction (3,), from columns (m, 3 k) along each axis."""
    return np.asarray(part.reshape(len(part), -1, 3) @ direction)


def switching(
    problem: Problem, fit: Joint, named: Sequence[Hypothesis], wrong: Outliers | None, *, ended: bool
) -> Leftover | None:
    """Return a switching signal if it is stronger than all `named` causes, or has `ended` the search."""
    if wrong is None or not wrong.lasting:
        return None
    slow = slow_remainder(problem, fit, named)
    if not ended and (slow is None or any(one.signal_to_noise >= slow.signal_to_noise for one in named)):
        return None
    within = tuple(CompetingHypothesis(one.candidate, 0.0) for one in named)
    rest = slow or not_isolated(wrong)
    return rest and rest._replace(kind="switching", within=within, shifts=tuple(wrong.rows.tolist()))


def not_isolated(wrong: Outliers | None) -> Leftover | None:
    """Return outliers that are not isolated as a transient or switching signal; None if all are isolated."""
    if wrong is None or wrong.isolated:
        return None
    kind = "switching" if wrong.lasting else "transient"
    shifts = tuple(wrong.rows.tolist()) if wrong.lasting else ()
    return Leftover(
        kind, float(np.sqrt(wrong.ratio)), wrong.p_value, 0.5 * wrong.ratio, None, None, shifts=shifts
    )


def loud(problem: Problem, error: FloatArray, counts: BoolArray) -> Leftover | None:
    """Return a structureless residual above :data:`LOUD` times the calibration's stated sigma, or None.

    `error` (n,), nT, is the residual of held-out parts. Samples with `counts` (n,) true are tested.
    """
    # Chi-square of the error by the variance that the calibration states
    power = float(np.sum(error[counts] ** 2 / np.maximum(problem.stated[counts], 1e-12)))
    n = int(counts.sum())
    if problem.calibration.noise.sensor <= 0.0 or power < LOUD**2 * n:
        return None
    return Leftover("broadband", float(np.sqrt(power - n)), float(chi2.sf(power, n)), 0.0, None, None)


def far_from_white(problem: Problem, found: Memory) -> bool:
    """Return True if a residual of this autocorrelation is more than noise of a sensor."""
    lasts = found.slow >= SLOW or found.rms >= SMOOTH * found.white
    return lasts and found.rms >= NEGLIGIBLE * float(np.median(problem.survey.reference))


def slow_remainder(problem: Problem, fit: Joint, named: Sequence[Hypothesis]) -> Leftover | None:
    """Return the drift in a residual: far from white, or slow noise above the causes' remnants; or None."""
    # Slow noise belongs to the unexplained structure: no sensor makes it
    slow = problem.slow_noise(fit.z)
    residual = (fit.residual + slow) / problem.reference_jacobian
    found = memory(problem, residual)
    if problem.waves.size:
        known = fit.prior[problem.slow] * np.diag(fit.covariance)[problem.slow]
        power, freedom = float(np.sum(fit.noise.whiten(slow) ** 2)), float(np.sum(1.0 - known))
        if power < (REMNANT * max((h.signal_to_noise for h in named), default=0.0)) ** 2:
            return None
        ratio, size = power, rms(slow / problem.reference_jacobian)
    elif far_from_white(problem, found):
        power, freedom = found.means * found.samples * found.slow, found.means
        ratio, size = (
            power * (found.rms / max(found.white, 1e-9)) ** 2,
            found.rms * float(np.sqrt(found.slow)),
        )
    else:
        return None
    p_value = float(chi2.sf(power, freedom))
    return Leftover("drift", float(np.sqrt(ratio)), p_value, 0.0, None, None, size=size)
