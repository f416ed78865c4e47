"""From a finding to a calibration: found effects become terms, and its own numbers are fitted anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from magbridge.arrays import IndexArray
from magbridge.calibration.instrument_effects import RateEffect
from magbridge.calibration.memory_effects import ClockEffect
from magbridge.calibration.model import Calibration
from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.compare.derivatives import derivatives
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.prior import isotropic
from magbridge.diagnose.compare.problem import Problem, samples_of
from magbridge.diagnose.compare.survey import Survey
from magbridge.diagnose.inference.design import normal
from magbridge.diagnose.inference.evidence import IDEAL
from magbridge.diagnose.inference.joint import Joint, fit_joint
from magbridge.estimation.residual import residuals, residuals_of, robust_scale
from magbridge.version import __version__

__all__ = ["extend", "flyable", "relinearised", "with_map_error", "with_misfit"]

STEPS = 4
"""Linearisations at most; a second one is rarely needed."""
MODES = 64
"""Directions among which the misfit of an idealised regressor is spread; measured in the blind study."""


def extend(problem: Problem, model: Sequence[Candidate], fit: Joint) -> Calibration:
    """Return the calibration with the effects of `model` added, at the values of `fit`.

    An error of the reference is no property of the vehicle: of such causes only a constant bias is kept, as
    the reference's. Of a filter's attenuation nothing is kept; the other coefficients are free of it. All
    covariances are those of the joint posterior.
    """
    calibration, q = problem.calibration, len(problem.centre)
    widths = np.concatenate([np.empty(0), *(candidate.width for candidate in model)])
    pieces = [piece for candidate in model for piece in candidate.pieces]
    kept = np.concatenate([np.empty(0, bool), *(np.full(c.size, bool(c.effects)) for c in pieces)])
    b = fit.coefficients * widths
    K, k = calibration.coefficients.size, int(kept.sum())
    M = np.zeros((K + k, q + len(b)))
    M[:K, :q] = problem.directions
    M[K:, q:] = np.diag(widths)[kept]
    covariance = M @ fit.covariance @ M.T
    covariance[:K, :K] += problem.unseen
    reference = calibration.reference
    for candidate, own in zip(model, slices(model), strict=True):
        if candidate.about == "constant":
            at = own.start
            sigma = float(np.sqrt(fit.effects_covariance[at, at]) * widths[at])
            reference = msgspec.structs.replace(
                reference, bias=reference.bias + float(b[at]), bias_sigma=sigma
            )
    residual = robust_scale(fit.residual - np.median(fit.residual))  # of the bulk, not of outliers
    noise = msgspec.structs.replace(
        calibration.noise, sensor=min(calibration.noise.sensor, residual) or residual
    )
    return replace(
        calibration,
        effects=(*calibration.effects, *(effect for c in model for effect in c.effects)),
        coefficients=np.append(calibration.coefficients + problem.directions @ fit.z, b[kept]),
        covariance=0.5 * (covariance + covariance.T),
        reference=reference,
        noise=noise,
        software=f"magbridge {__version__}",
    )


def flyable(survey: Survey, calibration: Calibration) -> Calibration:
    """Return the calibration without those rates of change that make the live correction worse.

    On the vehicle the next sample is not known yet, so a rate is a backward difference, which is mostly noise
    if the vehicle sways from sample to sample.
    """
    place = 0
    for effect in calibration.effects:
        without = _without(calibration, place)
        if isinstance(effect, RateEffect) and _power(survey, without) < _power(survey, calibration):
            calibration = without
        else:
            place += 1
    return calibration


def _power(survey: Survey, calibration: Calibration) -> float:
    """nT², mean square of the residual over the new samples, corrected as the bridge would."""
    return float(np.mean(residuals_of(*samples_of(survey, calibration))[~survey.learned] ** 2))


def _without(calibration: Calibration, place: int) -> Calibration:
    """Return the calibration without the effect at a place; other places may hold an equal one."""
    before, (effect, *after) = calibration.effects[:place], calibration.effects[place:]
    at = sum(term.size for term in (*calibration.terms, *before))
    own = np.arange(at, at + effect.size)
    return replace(
        calibration,
        effects=(*before, *after),
        coefficients=np.delete(calibration.coefficients, own),
        covariance=np.delete(np.delete(calibration.covariance, own, 0), own, 1),
    )


def with_map_error(
    problem: Problem, model: Sequence[Candidate], fit: Joint, extended: Calibration
) -> Calibration:
    r"""Return the extended calibration with a map's error in its covariance.

    Notes
    -----
    The logs that the calibration was fitted to have the same map as their reference, so the mean of its error
    may have gone into the calibration's scale. How large it is rests on the map's altitude, which may be half
    the usual or twice, and half of the error is taken to be uncertain. With s the coefficients that raise the
    corrected field by 1 nT everywhere, and m the error of the map that was found,

    .. math:: C \leftarrow C + \overline{(m / 2)^2}\, s s^T
    """
    if not problem.survey.learned.any():
        return extended
    power = 0.0
    for candidate, own in zip(model, slices(model), strict=True):
        if candidate.about == "place":
            b = fit.coefficients[own]
            power += 0.25 * float(b @ normal(candidate.columns, problem.residual)[0] @ b) / len(problem)
    s = isotropic(extended)
    return replace(extended, covariance=extended.covariance + power * np.outer(s, s))


def relinearised(
    problem: Problem, model: Sequence[Candidate], fit: Joint
) -> tuple[Problem, list[Columns], Joint]:
    """Linearise anew about the extended calibration, and fit again.

    The magnitude is not linear in a large effect. A model with a delay or a rate of change is left as the
    search had it: the live effects' backward differences contain the sample's own noise.
    """
    columns = [candidate.columns for candidate in model]
    if not model or any(isinstance(effect, (RateEffect, ClockEffect)) for c in model for effect in c.effects):
        return problem, columns, fit
    settled = problem
    for _ in range(STEPS):
        before, noise, c = fit.log_likelihood, fit.noise, np.append(fit.z, fit.coefficients)
        ridge, columns = fit.prior[len(fit.z) :], []
        settled.let_go()  # one problem's columns at a time
        settled, columns = _about(problem, model, fit)
        fit = fit_joint(settled, columns, noise.past.order, c, blocks=noise.uneven, ridge=ridge)
        if abs(fit.log_likelihood - before) < 0.5:
            break
    return settled, columns, fit


def with_misfit(model: Sequence[Candidate], fit: Joint) -> Joint:
    r"""Return the fit with the error of idealised regressors added to the covariance.

    Notes
    -----
    A cause of Wald's statistic ``W = b^T C_bb^-1 b`` has a signal of the whitened norm ``sqrt(W)``. A
    regressor that is off by a share :data:`~.inference.evidence.IDEAL` of it leaves a misfit of unknown
    shape. This is taken for further noise, of the power ``IDEAL^2 W / MODES`` in every direction, where the
    data's whitened noise has 1. It adds to the variance of the cause's coefficients, and of all others by
    their correlation with them:

    .. math:: C \leftarrow C + \frac{IDEAL^2 W}{MODES}\, C_{:b} C_{bb}^{-1} C_{b:}
    """
    C, q = fit.covariance.copy(), len(fit.z)
    for place in slices(model):
        own = slice(q + place.start, q + place.stop)
        given = np.linalg.solve(fit.covariance[own, own], fit.covariance[own])
        C += IDEAL**2 * fit.wald(place) / MODES * fit.covariance[:, own] @ given
    return replace(fit, covariance=0.5 * (C + C.T))


def _about(problem: Problem, model: Sequence[Candidate], fit: Joint) -> tuple[Problem, list[Columns]]:
    """Return problem and columns of the model, linearised about the calibration that `fit` extends."""
    extended = extend(problem, model, fit)
    samples, coefficients = samples_of(problem.survey, extended)
    samples.phi[np.ix_(problem.survey.learned, _since(extended, model))] = 0.0
    e, g = residuals(samples, coefficients)
    selector = np.eye(extended.coefficients.size)[:, problem.calibration.coefficients.size :]
    effects, at, columns = derivatives(extended, samples, g, -selector), 0, []
    rebuilt = replace(problem, residual=e, jacobian=g)
    # the residual at the first point, extrapolated linearly from this one; errors of the reference, slow
    # noise and the axes' delays are in both, as `extended` corrects none
    rebuilt.residual[:] += rebuilt.calibration_jacobian[:, problem.known] @ fit.z[problem.known]
    for candidate, place in zip(model, slices(model), strict=True):
        if not candidate.effects:
            columns.append(candidate.columns)
        else:
            block = effects[:, at : at + candidate.size] * candidate.width
            rebuilt.residual[:] += block @ fit.coefficients[place]
            columns.append(block.__getitem__)
            at += candidate.size
    return rebuilt, columns


def _since(extended: Calibration, model: Sequence[Candidate]) -> IndexArray:
    """Return the places of the regressors of causes that have appeared since the calibration."""
    late = {id(e) for c in model for piece in c.pieces if piece.since for e in piece.effects}
    counts = [effect.columns(extended.reference.field).shape[1] for effect in extended.effects]
    marks = np.repeat([id(effect) in late for effect in extended.effects], counts)
    return len(extended.kernel.weights) - len(marks) + np.flatnonzero(marks)
