r"""Extension of a calibration by the effects of findings, with all coefficients refitted.

Notes
-----
The nonlinear parameters s of a cause have the derivatives ``J_s = d(X b)/ds``. M is their information with
calibration and effects projected out, and K the change of all other coefficients per unit of each parameter.
The prior of each parameter is N(0, 1) in units of a cell of its grid. The covariance of the other
coefficients is then

.. math:: C + K (M + 1)^{-1} K^T
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.effects import ClockEffect, RateEffect
from magbridge.calibration.model import Calibration
from magbridge.diagnose.columns import Candidate, Columns, places, slices
from magbridge.diagnose.evidence import IDEAL, information
from magbridge.diagnose.joint import Joint, JointDesign, fit_joint
from magbridge.diagnose.problem import Problem, derivatives, linearised, row_blocks, samples_of
from magbridge.diagnose.survey import Survey
from magbridge.estimation.residual import residuals_of, robust_scale
from magbridge.version import __version__

STEP_CELL_FRACTION = 0.05
"""Fraction of a grid cell by which a parameter is moved for its derivative."""
MAX_STEPS = 12
"""Largest number of Gauss-Newton steps; a second one is rarely needed."""
MAX_HALVINGS = 6
"""Largest number of halvings of one step."""
MAX_MISMATCH = 0.1
"""Convergence: RMS difference of linear prediction and nonlinear residual, as a fraction of the noise."""
MODES = 64
"""Number of directions over which the misfit of an idealised regressor is spread, from the blind study."""


def loosened(problem: Problem, model: Sequence[Candidate], columns: Sequence[Columns], fit: Joint) -> Joint:
    """Return the fit with its covariance widened for nonlinear parameters; `columns` are of `model`."""
    pieces = [piece for candidate in model for piece in candidate.pieces]
    if not any(piece.point.rebuild and piece.point.cells for piece in pieces):
        return fit
    jacobian: list[Columns] = []
    for piece, place in zip(pieces, slices(pieces), strict=True):
        jacobian += _jacobian(piece, fit.coefficients[place])
    # C + K (M + 1)^-1 K^T, of the information M with calibration and effects projected out
    info = information(problem, fit.noise, fit, [*jacobian, *columns]).fitted(fit)
    K = info.shift
    more = K @ np.linalg.solve(info.matrix + np.eye(len(jacobian)), K.T)
    return replace(fit, covariance=fit.covariance + 0.5 * (more + more.T))


def _jacobian(piece: Candidate, b: FloatArray) -> Iterator[Columns]:
    """Yield the derivative of ``X b`` (b: coefficients) by each nonlinear parameter, per grid cell."""
    if piece.point.rebuild is None:
        return
    values = [value for value, _ in piece.point.shape.values()]
    for k, cell in enumerate(piece.point.cells):
        near = [value + STEP_CELL_FRACTION * cell * (n == k) for n, value in enumerate(values)]
        moved = piece.point.rebuild(*near)

        def columns(rows: slice, moved: Candidate = moved) -> FloatArray:
            return np.asarray((moved.columns(rows) - piece.columns(rows)) @ b / STEP_CELL_FRACTION)[:, None]

        yield columns


def refitted(
    problem: Problem, columns: Sequence[Columns], fit: Joint, kept: slice | IndexArray = slice(None)
) -> Joint:
    """Fit `columns` with noise order, level and prior of `fit`, starting at its coefficients `kept`."""
    start, noise = np.append(fit.z, fit.coefficients[kept]), fit.noise
    ridge = fit.prior[len(fit.z) :][kept]
    return fit_joint(problem, columns, noise.past.order, start, blocks=noise.uneven, ridge=ridge)


def extend(problem: Problem, model: Sequence[Candidate], fit: Joint) -> Calibration:
    """Return the calibration with the effects of `model` added, with values and covariance of `fit`.

    A constant error of the reference becomes the bias of the calibration's reference. Its other errors are
    not part of the calibration.
    """
    calibration, q = problem.calibration, len(problem.centre)
    widths = np.concatenate([np.empty(0), *(candidate.width for candidate in model)])
    pieces = [piece for candidate in model for piece in candidate.pieces]
    kept = np.concatenate([np.empty(0, bool), *(np.full(c.size, bool(c.effects)) for c in pieces)])
    b = fit.coefficients * widths
    # Posterior of (z, b) to coefficients: c = c_0 + L z, and b in its own units
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
    # The noise may have become smaller than the calibration states, not larger by one log
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


def flyable(survey: Survey, calibration: Calibration) -> tuple[Calibration, list[int]]:
    """Return the calibration without rates and delays that worsen the live correction, and their indices.

    The live correction computes a rate as a backward difference, which is mostly noise if the vehicle sways
    from sample to sample.
    """
    dropped: list[int] = []
    # Greedy: each rate is dropped if the residual with live differences is smaller without it
    for place, effect in enumerate(calibration.effects):
        if not isinstance(effect, (RateEffect, ClockEffect)):
            continue
        kept, without = (without_effects_at(calibration, some) for some in (dropped, [*dropped, place]))
        if _power(survey, without) < _power(survey, kept):
            dropped.append(place)
    return without_effects_at(calibration, dropped), dropped


def _power(survey: Survey, calibration: Calibration) -> float:
    """Return the mean square residual of the new samples, nT², with the live correction."""
    return float(np.mean(residuals_of(*samples_of(survey, calibration))[~survey.learned] ** 2))


def without_effects_at(calibration: Calibration, dropped: Sequence[int]) -> Calibration:
    """Return the calibration without the effects at the indices `dropped`."""
    if not dropped:
        return calibration
    # Coefficients stand in the order of terms, then effects
    at = places((one.size for one in calibration.effects), sum(term.size for term in calibration.terms))
    own = np.r_[*(at[k] for k in dropped)]
    kept = [effect for k, effect in enumerate(calibration.effects) if k not in dropped]
    return replace(
        calibration,
        effects=tuple(kept),
        coefficients=np.delete(calibration.coefficients, own),
        covariance=np.delete(np.delete(calibration.covariance, own, 0), own, 1),
    )


def relinearised(
    problem: Problem, model: Sequence[Candidate], fit: Joint
) -> tuple[Problem, list[Columns], Joint]:
    """Refit about the extended calibration until the linear model predicts the nonlinear residual.

    Return the problem linearised at the last point, the columns of the model's pieces there, and the fit.
    Rates of change are computed as in the search, not as in the live correction.
    """
    # The calibration as given is the point that a step which overshoots is halved towards
    origin = replace(fit, z=np.zeros_like(fit.z), coefficients=np.zeros_like(fit.coefficients))
    last, last_cost = origin, _cost(problem.residual, origin, problem)
    # Halve a step until the nonlinear posterior does not fall
    for _ in range(MAX_STEPS):
        for _ in range(MAX_HALVINGS):
            settled, columns = _linearised_at(problem, model, fit)
            actual = settled.residual - JointDesign(settled, columns).times(
                np.append(fit.z, fit.coefficients)
            )
            cost = _cost(actual, fit, problem)
            if cost <= last_cost:
                break
            fit = replace(
                fit, z=0.5 * (fit.z + last.z), coefficients=0.5 * (fit.coefficients + last.coefficients)
            )
            settled.let_go()
        # Converged: the linear model predicts the nonlinear residual to a tenth of the noise
        missed = float(np.sqrt(np.mean((actual - fit.residual) ** 2)))
        if missed < MAX_MISMATCH * float(np.median(fit.noise.scale)) and cost <= last_cost:
            break
        last, last_cost = fit, cost
        fit = refitted(settled, columns, fit)
        settled.let_go()
    return settled, columns, fit


def _cost(residual: FloatArray, fit: Joint, problem: Problem) -> float:
    """Return the negative log posterior of a nonlinear residual (n,), nT, with noise and prior of `fit`."""
    noise, c = fit.noise, np.append(fit.z, fit.coefficients)
    centre = np.append(problem.centre, np.zeros(len(c) - len(problem.centre)))
    x2 = noise.whiten(residual) ** 2 / noise.kappa
    likelihood = 0.5 * (noise.nu + 1.0) * float(np.log1p(x2 / noise.nu).sum())
    return likelihood + 0.5 * float(fit.prior @ (c - centre) ** 2)


def with_misfit(model: Sequence[Candidate], fit: Joint) -> Joint:
    r"""Return the fit with errors of idealised regressors added to the covariance.

    Notes
    -----
    A cause of Wald's statistic ``W = b^T C_bb^-1 b`` has a signal of the whitened norm ``sqrt(W)``. If its
    regressor is wrong by the fraction :data:`~.evidence.IDEAL`, a misfit of unknown shape remains. Its power
    is ``IDEAL^2 W / MODES`` in every direction, where the whitened noise has 1:

    .. math:: C \leftarrow C + \frac{IDEAL^2 W}{MODES}\, C_{:b} C_{bb}^{-1} C_{b:}
    """
    C, q = fit.covariance.copy(), len(fit.z)
    for place in slices(model):
        own = slice(q + place.start, q + place.stop)
        given = np.linalg.solve(fit.covariance[own, own], fit.covariance[own])
        C += IDEAL**2 * fit.wald(place) / MODES * fit.covariance[:, own] @ given
    return replace(fit, covariance=0.5 * (C + C.T))


def _linearised_at(problem: Problem, model: Sequence[Candidate], fit: Joint) -> tuple[Problem, list[Columns]]:
    """Return the problem, and the columns of each piece of the model, linearised at `fit`."""
    # Residual and derivatives of the extended calibration's own equations
    extended = extend(problem, model, fit)
    samples, coefficients = samples_of(problem.survey, extended)
    pieces = [piece for candidate in model for piece in candidate.pieces]
    # Regressors of the added effects are the last; each piece's own rates and onset apply to its effects
    listed = [(effect, piece) for piece in pieces for effect in piece.effects]
    counts = [effect.columns(extended.reference.field).shape[1] for effect, _ in listed]
    first = samples.phi.shape[1] - sum(counts)
    for (_, piece), place in zip(listed, places(counts, first), strict=True):
        if piece.regressors is not None:
            # Central differences of the search replace the live, noisy ones
            samples.phi[:, place] = piece.regressors(slice(0, len(problem))).T
        # Causes that appeared later have no regressors in the logs that were learned from
        if piece.since:
            samples.phi[problem.survey.learned, place] = 0.0
    e, g, reference_jacobian, _ = linearised(samples, coefficients)
    selector = np.eye(extended.coefficients.size)[:, problem.calibration.coefficients.size :]
    effects, at, columns = derivatives(extended, samples, g, -selector), 0, []
    rebuilt = replace(problem, residual=e, jacobian=g, reference_jacobian=reference_jacobian)
    # The residual at the calibration as given, extrapolated linearly from this point. Errors of the
    # reference, slow noise and the axes' delays are in both, because `extended` corrects none of them
    for rows in row_blocks(len(rebuilt)):
        rebuilt.residual[rows] += rebuilt.coefficient_jacobian[rows] @ fit.z[problem.known]
    for piece, place in zip(pieces, slices(pieces), strict=True):
        if not piece.effects:
            columns.append(piece.columns)
            continue
        block = effects[:, at : at + piece.size] * piece.width
        rebuilt.residual[:] += block @ fit.coefficients[place]
        columns.append(block.__getitem__)
        at += piece.size
    return rebuilt, columns
