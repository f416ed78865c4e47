"""From a finding to a calibration: the found effects as terms, with the calibration's own numbers refitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
from numpy.typing import NDArray

import magbridge
from magbridge.calibration.instrument import RateEffect
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import residuals
from magbridge.diagnose.candidates import Candidate
from magbridge.diagnose.joint import Joint, fit_joint
from magbridge.diagnose.problem import Columns, Problem, derivatives, samples_of
from magbridge.diagnose.weigh import IDEAL

__all__ = ["extend", "settle", "widened"]

STEPS = 4
"""Linearisations at most; a second one is rarely needed."""

FloatArray = NDArray[np.float64]


def extend(problem: Problem, model: Sequence[Candidate], fit: Joint) -> Calibration:
    """Return the calibration with the effects of `model` as terms, at `fit`.

    An error of the reference is no property of the vehicle: of those only a constant bias is kept, as the
    reference's. All covariances are those of the joint posterior.
    """
    calibration, q = problem.calibration, len(problem.centre)
    widths = np.concatenate([np.empty(0), *(candidate.width for candidate in model)])
    kept = np.concatenate([np.empty(0, bool), *(np.full(c.size, bool(c.effects)) for c in model)])
    b = fit.coefficients * widths
    K, k = calibration.coefficients.size, int(kept.sum())
    M = np.zeros((K + k, q + len(b)))
    M[:K, :q] = problem.directions
    M[K:, q:] = np.diag(widths)[kept]
    covariance = M @ fit.covariance @ M.T
    covariance[:K, :K] += problem.unseen
    reference, at = calibration.reference, 0
    for candidate in model:
        if candidate.cause == "reference_bias":
            sigma = float(np.sqrt(fit.covariance[q + at, q + at]) * widths[at])
            reference = msgspec.structs.replace(
                reference, bias=reference.bias + float(b[at]), bias_sigma=sigma
            )
        at += candidate.size
    noise = msgspec.structs.replace(
        calibration.noise, sensor=min(calibration.noise.sensor, level(fit)) or level(fit)
    )
    return replace(
        calibration,
        effects=(*calibration.effects, *(effect for c in model for effect in c.effects)),
        coefficients=np.append(calibration.coefficients + problem.directions @ fit.z, b[kept]),
        covariance=0.5 * (covariance + covariance.T),
        reference=reference,
        noise=noise,
        software=f"magbridge {magbridge.__version__}",
    )


def level(fit: Joint) -> float:
    """Return the 1-sigma of what is left, nT: that of the bulk, not of outliers."""
    return 1.4826 * float(np.median(np.abs(fit.left - np.median(fit.left))))


def settle(
    problem: Problem, model: Sequence[Candidate], fit: Joint, order: int
) -> tuple[Problem, list[Columns], Joint]:
    """Linearise anew about the extended calibration, where a large effect has bent the magnitude, and fit again.

    Rates of change keep the columns of the search: a live effect's backward differences hold the sample's own noise.
    """
    columns = [candidate.columns for candidate in model]
    if not model or any(isinstance(effect, RateEffect) for c in model for effect in c.effects):
        return problem, columns, fit
    settled = problem
    for _ in range(STEPS):
        before = fit
        settled, columns, fit = _again(settled, model, fit, order)
        if abs(fit.log_likelihood - before.log_likelihood) < 0.5:
            break
    return settled, columns, fit


def widened(model: Sequence[Candidate], fit: Joint) -> Joint:
    """Return the fit with what the regressors' idealisation adds to the covariance.

    One that is off by :data:`~.weigh.IDEAL` of its norm has a size that is off by ``1 - sqrt(1 - IDEAL^2)`` of it.
    """
    share, at = 1.0 - float(np.sqrt(1.0 - IDEAL**2)), len(fit.z)
    covariance = fit.covariance.copy()
    for candidate in model:
        own = slice(at, at + candidate.size)
        b = share * fit.coefficients[at - len(fit.z) :][: candidate.size]
        covariance[own, own] += np.outer(b, b)
        at += candidate.size
    return replace(fit, covariance=covariance)


def _again(
    problem: Problem, model: Sequence[Candidate], fit: Joint, order: int
) -> tuple[Problem, list[Columns], Joint]:
    """One step of Gauss and Newton on the whole model."""
    extended = extend(problem, model, fit)
    samples, coefficients = samples_of(problem.survey, extended)
    e, g = residuals(samples, coefficients)
    K = problem.calibration.coefficients.size
    selector = np.eye(extended.coefficients.size)
    L = np.vstack([problem.directions, np.zeros((len(selector) - K, len(problem.centre)))])
    own = -derivatives(extended, samples, g, np.hstack([L, selector[:, K:]]))
    free, effects, at = own[:, : len(problem.centre)], own[:, len(problem.centre) :], 0
    # what the residual would be at the first point, were it linear about this one; the reference was not mended in it
    residual = e + free @ fit.z
    blocks, place = [], 0
    for candidate in model:
        if not candidate.effects:
            blocks.append(candidate.columns(slice(0, len(problem))))
        else:
            blocks.append(effects[:, at : at + candidate.size] * candidate.width)
            residual += blocks[-1] @ fit.coefficients[place : place + candidate.size]
            at += candidate.size
        place += candidate.size
    c = np.append(fit.z, fit.coefficients)
    again = replace(problem, residual=residual, free=free, slopes=g)
    columns: list[Columns] = [partial(_rows, block) for block in blocks]
    return again, columns, fit_joint(again, columns, order, c, ridge=fit.prior[len(fit.z) :])


def _rows(block: FloatArray, rows: slice) -> FloatArray:
    return block[rows]
