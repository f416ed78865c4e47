r"""The improvement by an extended calibration, measured on the corrected field of held-out samples.

Notes
-----
The log is divided into folds of whole dives, runs or eighths. Each fold is corrected by
:func:`magbridge.calibration.correct.correct` with a calibration that is fitted to the other folds. For
comparison, the calibration as given is refitted in the same way without any cause.

An extension is refused for one of four reasons. It corrects no named cause, so only the refit would change
the calibration. The linear model's held-out prediction and the corrected field differ by more than the noise.
The corrected field moves further than the given covariance allows, where the log does not determine it. Or
the held-out field becomes worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.correct import CorrectedArrays, correct
from magbridge.calibration.effects import TimeEffect
from magbridge.calibration.file import decode_calibration
from magbridge.calibration.model import Calibration
from magbridge.correction import Correction
from magbridge.diagnose.columns import Candidate, Columns, slices
from magbridge.diagnose.extend import (
    extend,
    flyable,
    loosened,
    refitted,
    relinearised,
    with_misfit,
    without_effects_at,
)
from magbridge.diagnose.joint import HeldOut, Joint, held_out, normal, paired
from magbridge.diagnose.problem import DELAYS, Problem, derivatives, floor, isotropic, samples_of
from magbridge.diagnose.survey import Survey, days_of
from magbridge.estimation.residual import ResidualSamples, residuals, rms
from magbridge.field.grid import AnomalyGrid
from magbridge.field.reference import reference_field
from magbridge.rows import correct_rows

if TYPE_CHECKING:
    import xarray as xr

TIGHTENING = (1.0, 0.3, 0.1)
"""Factors on the prior sigma of the calibration's coefficients that are tried until an extension passes."""
MAX_DEPARTURE_SIGMA = 4.0
"""Largest move of a corrected sample that the log does not determine, in sigmas of the given calibration."""
DETERMINED = 0.25
"""Fraction of a sample's prior variance below which the log determines that sample's corrected field."""
DOMAIN_TURN_DEG = 10.0
"""Angle by which the attitudes of the log are turned to probe the calibration's domain, degrees."""
MAX_DOMAIN_SAMPLES = 1500
"""Largest number of samples, with turned ones, at which the domain is probed."""
MAX_FRACTION_OUTSIDE = 0.01
"""Fraction of the probes that may exceed the limit."""
MAX_CHECKED_ROWS = 20_000
"""Largest number of rows of a log that are corrected with the written file."""
MAX_RATIO = 1.02
"""Largest upper end of the interval of the RMS ratio; above it the corrected field may have become worse."""
MAX_PROMISE_RATIO = 1.1
"""Largest ratio of the corrected field's held-out RMS to the linear prediction."""


@dataclass(frozen=True, eq=False)
class Extension:
    """An extended calibration with its fit, its held-out errors, and the result of the checks."""

    calibration: Calibration
    """Extended calibration, or the given one if every extension is refused."""
    problem: Problem
    """Problem linearised at the extended calibration."""
    columns: tuple[Columns, ...]
    """Columns of the causes' pieces in `problem`."""
    fit: Joint
    """Joint fit at the extended calibration."""
    error: FloatArray
    """Held-out error (n,), nT: corrected field less reference."""
    reference_error: FloatArray
    """Held-out error (n,) of the reference by its named causes, nT."""
    score: float
    """Log predictive density, summed over the folds."""
    day_error: FloatArray | None = None
    """Held-out error (n,), nT, with whole days left out; None for a log of one day."""
    refused: str = ""
    """Code of the reason for a refusal; empty if the extension is accepted."""
    details: tuple[float, float] = (0.0, 0.0)
    """Allowed and actual value of the check that refused the extension, nT."""


def corrected(survey: Survey, calibration: Calibration) -> CorrectedArrays:
    """Return the corrected samples of a survey, as ``magbridge correct`` computes them."""
    return correct(calibration, survey.field, survey.values(calibration.channels), survey.time)


def extension_of(problem: Problem, model: Sequence[Candidate], fit: Joint, counts: BoolArray) -> Extension:
    """Extend the calibration by the causes of a model; without a model, refit its own coefficients.

    `counts` (n,) are the samples by which the improvement is measured. Attempts with ever tighter priors are
    made. Return the first one that passes all checks, else the first attempt with its refusal and the given
    calibration.
    """
    first = None
    for factor in TIGHTENING:
        tried = attempt(problem, model, fit, counts, factor)
        if not tried.refused:
            return tried
        first = first or tried
        if tried.refused == "reference_only":  # no tighter prior adds a term
            break
        tried.problem.let_go()
    assert first is not None
    return replace(first, calibration=problem.calibration)


def attempt(
    problem: Problem, model: Sequence[Candidate], fit: Joint, counts: BoolArray, factor: float = 1.0
) -> Extension:
    """Return the extension with the calibration's prior sigma multiplied by `factor`, and its checks."""
    if factor < 1.0:
        problem = tightened(problem, factor)
        fit = refitted(problem, [one.columns for one in model], replace(fit, z=factor * fit.z))
    # Converge, hold every fold out, then widen the covariance for nonlinear parameters and misfit
    settled, blocks, fit = relinearised(problem, model, fit)
    out = held_out(settled, blocks, fit)
    fit = with_misfit(model, loosened(settled, model, blocks, fit))
    whole = extend(problem, model, fit)
    calibration, dropped = flyable(problem.survey, whole)
    error, reference_error = _held_out_error(problem, model, fit, out, dropped)
    day_error, day = None, days_of(problem.survey.time, problem.survey.learned)
    if day is not None and model:
        day_error, _ = _held_out_error(
            problem, model, fit, held_out(settled, blocks, fit, groups=day), dropped
        )
    # Sigma covers the level, and the held-out error of the whole log and of its last fold
    variance = map_error_variance(settled, model, fit) + level_change_variance(problem, calibration)
    calibration = with_level_variance(calibration, variance)
    last = [counts, counts & (out.fold == out.fold.max())]
    calibration = with_level_variance(calibration, _excess_variance(problem, calibration, error, last))
    if model and not any(isinstance(effect, TimeEffect) for c in model for effect in c.effects):
        # Forward chaining: sigma also covers what a fit of the first half leaves in the second
        late = np.cumsum(counts) > 0.5 * counts.sum()
        halves = held_out(settled, blocks, fit, groups=late.astype(np.int64))
        forward, _ = _held_out_error(problem, model, fit, halves, dropped)
        variance = _excess_variance(problem, calibration, forward, [counts & late])
        calibration = with_level_variance(calibration, variance)
    extension = Extension(
        calibration, settled, tuple(blocks), fit, error, reference_error, out.score, day_error
    )
    if not model:
        return extension
    # An error of the reference is not the vehicle's: without a new term, the given calibration stays
    added = set(calibration.effects)
    if all(c.about != "vehicle" or (c.effects and added.isdisjoint(c.effects)) for c in model):
        return replace(extension, refused="reference_only")
    reason, details = _refusal(problem, extension, out, counts, bool(dropped))
    return replace(extension, refused=reason, details=details)


def _held_out_error(
    problem: Problem, model: Sequence[Candidate], fit: Joint, held: HeldOut, dropped: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Return the held-out errors (n,), nT, of the corrected field and of the reference by its causes."""
    q, survey = len(fit.z), problem.survey
    # Each fold is corrected by a calibration that was fitted to the others
    error, reference_error = np.zeros(len(problem)), np.zeros(len(problem))
    wrong = [(c, place) for c, place in zip(model, slices(model), strict=True) if c.about != "vehicle"]
    for k, c in enumerate(held.coefficients):
        fold = held.fold == k
        part = replace(fit, z=c[:q], coefficients=c[q:])
        calibration = without_effects_at(extend(problem, model, part), dropped)
        error[fold] = (corrected(survey, calibration).total - survey.reference)[fold]
        for candidate, place in wrong:
            added = np.asarray(candidate.columns(slice(0, len(problem)))[fold] @ part.coefficients[place])
            reference_error[fold] += added / problem.reference_jacobian[fold]
    return error, reference_error


def _refusal(
    problem: Problem, extension: Extension, held: HeldOut, counts: BoolArray, dropped: bool
) -> tuple[str, tuple[float, float]]:
    """Return the code of the reason for a refusal, or empty, and the allowed and actual value, nT."""
    noise = float(np.median(extension.fit.noise.scale))
    # The corrector cannot undo the axes' delays, which the linear model takes out
    linear = held.residual + extension.problem.delay_jacobian @ extension.fit.z[DELAYS]
    promised = rms((linear / problem.reference_jacobian)[counts])
    found = rms((extension.error - extension.reference_error)[counts])
    # A rate of change that was dropped is in the linear prediction alone
    if not dropped and found > max(MAX_PROMISE_RATIO * promised, float(np.hypot(promised, noise))):
        return "not_linear", (promised, found)
    # Trust region: the corrected field may not move where the log determines nothing
    allowed, moved = _departure(problem, extension)
    if moved > allowed:
        return "outside_prior", (allowed, moved)
    # Compare with the calibration as given, dive by dive; an error of the reference is not in the output
    before = corrected(problem.survey, problem.calibration).total - problem.survey.reference
    change = paired(before, extension.error, problem.survey.dive, counts)
    if not extension.reference_error.any() and change.interval[1] > MAX_RATIO:
        return "worse", (change.before, change.before * change.interval[1])
    return "", (0.0, 0.0)


def _departure(problem: Problem, extension: Extension) -> tuple[float, float]:
    """Return the limit and the value of the largest undetermined move of the corrected field, nT.

    The move is evaluated at the log's attitudes, and at these turned by :data:`DOMAIN_TURN_DEG` about each
    axis. Only the calibration's own coefficients count: the effects of the causes are not limited.
    """
    calibration = problem.calibration
    own, K = _own_part(calibration, extension.calibration), calibration.coefficients.size
    step = max(1, len(problem) // (MAX_DOMAIN_SAMPLES // 7))
    samples, coefficients = samples_of(problem.survey, calibration)
    _, moved_coefficients = samples_of(problem.survey, own)
    few = samples.part(slice(None, None, step))
    probes = _turned(few)
    # Move of the field at the probes, and the sigma that the calibration as given allows
    e, g = residuals(probes, coefficients)
    shift = np.abs(residuals(probes, moved_coefficients)[0] - e)
    J = derivatives(calibration, probes, g, np.eye(K))
    # with training logs the fit begins before them: the calibration's covariance contains them already
    D, prior = problem.directions[:K, problem.known], calibration.covariance
    if problem.survey.learned.any():
        prior = D @ D.T + problem.unseen
    before = np.einsum("ij,jk,ik->i", J, prior + floor(calibration), J)
    after = np.einsum("ij,jk,ik->i", J, own.covariance, J)
    limit = MAX_DEPARTURE_SIGMA * np.sqrt(before + problem.calibration.noise.sensor**2)
    # Moves that the log determines are not limited; of the others 1 % may exceed the limit
    excess = np.where(after < DETERMINED * before, 0.0, shift / limit)
    worst = int(np.argsort(excess)[int((1.0 - MAX_FRACTION_OUTSIDE) * (len(excess) - 1))])
    return float(limit[worst]), float(excess[worst] * limit[worst])


def _turned(samples: ResidualSamples) -> ResidualSamples:
    """Return the samples seven times: as they are, and with readings turned both ways about each axis."""
    turns = Rotation.from_rotvec(
        DOMAIN_TURN_DEG * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]), degrees=True
    )
    count = len(turns)
    return replace(
        samples,
        field=np.concatenate([turn.apply(samples.field) for turn in turns]),
        reference=np.tile(samples.reference, count),
        phi=np.tile(samples.phi, (count, 1)),
        steps=np.tile(samples.steps, count),
    )


def check_written(
    content: bytes, given: Calibration, datasets: Sequence[xr.Dataset], grid: AnomalyGrid | None
) -> tuple[float, float] | None:
    """Decode a written calibration and correct the logs with it, as ``magbridge correct`` does.

    Return the RMS errors, nT, with the calibration as `given` and with the written one if the latter is
    larger by more than the noise; else None. At most :data:`MAX_CHECKED_ROWS` rows of a log are corrected.
    """
    written = decode_calibration(content, "calibration.json")
    errors: dict[bool, list[FloatArray]] = {False: [], True: []}
    for ds in datasets:
        part = ds.isel(time=slice(MAX_CHECKED_ROWS))
        reference = reference_field(part, grid, given.reference.bias)
        for extended, calibration in ((False, given), (True, written)):
            total = correct_rows(Correction(calibration), part)["total_field"].to_numpy()
            errors[extended].append(total - reference)
    before, after = (np.concatenate(errors[key]) for key in (False, True))
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return None
    found = rms(before[both]), rms(after[both])
    return found if found[1] > np.hypot(found[0], given.noise.sensor) else None


def tightened(problem: Problem, factor: float) -> Problem:
    """Return the problem with the prior sigma of the calibration's coefficients multiplied by `factor`."""
    known = problem.known
    directions, centre = problem.directions.copy(), problem.centre.copy()
    # L -> factor L; what the prior loses, (1 - factor^2) L L^T, is kept as unseen variance
    D = directions[:, known]
    unseen = problem.unseen + (1.0 - factor**2) * D @ D.T
    directions[:, known] *= factor
    centre[known] /= factor
    return replace(problem, directions=directions, centre=centre, unseen=unseen)


def with_level_variance(calibration: Calibration, variance: float) -> Calibration:
    """Return the calibration with a constant bias of `variance` v, nT², in its covariance: ``C + v s s^T``.

    s is the change of coefficients that raises the corrected field by 1 nT at any attitude.
    """
    s = isotropic(calibration)
    return replace(calibration, covariance=calibration.covariance + variance * np.outer(s, s))


def _excess_variance(
    problem: Problem, calibration: Calibration, error: FloatArray, parts: Sequence[BoolArray]
) -> float:
    """Return the largest excess, nT², of the mean square held-out error over the stated variance.

    `parts` are sets of samples, the largest of whose excesses counts. A covariance lacks the model's error.
    """
    sigma = corrected(problem.survey, calibration).sigma
    return max(0.0, *(float(np.mean(error[rows] ** 2 - sigma[rows] ** 2)) for rows in parts if rows.any()))


def map_error_variance(problem: Problem, model: Sequence[Candidate], fit: Joint) -> float:
    """Return the mean square of half of a map's error, nT², if the calibration's own logs are compared too.

    The calibration may have absorbed the mean of the map's error, of which half is assumed to be uncertain.
    """
    power = 0.0
    for candidate, place in zip(model, slices(model), strict=True):
        if candidate.about == "place" and problem.survey.learned.any():
            b = fit.coefficients[place]
            power += 0.25 * float(b @ normal(candidate.columns, problem.residual)[0] @ b) / len(problem)
    return power


def _own_part(given: Calibration, extended: Calibration) -> Calibration:
    """Return the given calibration with the refitted coefficients of the extension, without new effects."""
    K = given.coefficients.size
    return replace(given, coefficients=extended.coefficients[:K], covariance=extended.covariance[:K, :K])


def level_change_variance(problem: Problem, extended: Calibration) -> float:
    """Return the variance, nT², of the difference in the reference's bias between this log and a later one.

    A reference without the crustal field has another bias in each log. If the refitted coefficients move the
    mean of the corrected field by m, more than the given sigma, the bias of a log has the variance
    ``m^2 - sigma^2``. The difference of two logs has twice this variance.
    """
    fresh = ~problem.survey.learned
    given = corrected(problem.survey, problem.calibration)
    moved = corrected(problem.survey, _own_part(problem.calibration, extended))
    change = float(np.mean((moved.total - given.total)[fresh]))
    return 2.0 * max(0.0, change**2 - float(np.mean(given.sigma[fresh] ** 2)))


def fit_without(
    problem: Problem, model: Sequence[Candidate], left_out: Sequence[int], fit: Joint
) -> tuple[list[Candidate], Joint]:
    """Return a model without the causes at indices `left_out`, and its fit about the given calibration."""
    others = [candidate for k, candidate in enumerate(model) if k not in left_out]
    own = slices(model)
    kept = np.delete(np.arange(fit.coefficients.size), np.r_[*(own[k] for k in left_out)])
    return others, refitted(problem, [candidate.columns for candidate in others], fit, kept)
