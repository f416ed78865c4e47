r"""The comparison as a linear problem: residuals of a calibration, and what every coefficient would have left in them.

Notes
-----
With the scalar residual e of :mod:`magbridge.calibration.residual` and its derivative g by the nine
coefficients at every sample, a term or an effect that adds ``sum_rs phi_r C_krs`` to slot s moves it by

.. math:: \partial e_t / \partial c_k = \sum_{rs} \phi_r(t)\, C_{krs}\, g_s(t)

and a coefficient that is really there, but not in the calibration, leaves minus that in the residual. So every cause
passes through the forward model by the one rule. The calibration stays free, with its posterior
as prior: ``c = c_0 + L z``, ``z ~ N(m, 1)``, where L holds only the directions that these data can see.

Derivatives are taken where the reading would have had no residual, ``H_r - e w / |w|^2``: at the reading itself they hold
its noise, and scales could grow against offsets until the noise is gone (errors in variables).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.correct import regressors
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import Samples, residuals, whiten
from magbridge.calibration.terms import Effect, Polynomial
from magbridge.diagnose.survey import Survey

__all__ = [
    "Columns",
    "Problem",
    "add_effects",
    "derivatives",
    "effect_columns",
    "floor",
    "history",
    "pose",
    "samples_of",
]

FloatArray = NDArray[np.float64]
Columns = Callable[[slice], FloatArray]
"""Rows -> (m, k): what one unit of each of k coefficients leaves in the residual."""

CHUNK = 8192
SEEN = 0.01
"""Share of a prior's information that data must add for its direction to be kept."""
BROADEST = 1e-3
"""Precision, of the posterior's, below which a direction that only the given logs determined is not let."""
SOFT, HARD = 0.02, 2000.0
"""Soft iron, of the field, and hard iron, nT: 1-sigma of what vehicles have."""
STABLE = 2e-5
"""Of the field: no fluxgate's scale, axes and offset hold better than twenty parts per million between days."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What a search works on.

    Attributes
    ----------
    survey : Survey
    calibration : Calibration
    reading : (n, 3) array
        nT, ``H_r - e w / |w|^2``: what bends with the reading must not hold its noise.
    residual : (n,) array
        e, nT of the sensor.
    slopes : (n, 9) array
        g.
    gain : (n,) array
        1/s: what one nT of error in the reference does to e.
    free : (n, q) array
        ``-de/dz``.
    directions : (K, q) array
        L.
    centre : (q,) array
        m, prior mean of z.
    unseen : (K, K) array
        nT², covariance in the directions that these data cannot see.
    """

    survey: Survey
    calibration: Calibration
    reading: FloatArray
    residual: FloatArray
    slopes: FloatArray
    gain: FloatArray
    free: FloatArray
    directions: FloatArray
    centre: FloatArray
    unseen: FloatArray

    def __len__(self) -> int:
        return len(self.residual)


def add_effects(calibration: Calibration, effects: tuple[Effect, ...]) -> Calibration:
    """Return the calibration with `effects` at zero, perfectly known."""
    extra = sum(effect.size for effect in effects)
    size = calibration.coefficients.size
    covariance = np.zeros((size + extra, size + extra))
    covariance[:size, :size] = calibration.covariance
    return replace(
        calibration,
        effects=(*calibration.effects, *effects),
        coefficients=np.append(calibration.coefficients, np.zeros(extra)),
        covariance=covariance,
    )


def history(survey: Survey, calibration: Calibration, effect: Effect) -> FloatArray:
    """(r, n) regressors of one effect along the survey, stepped as the bridge would."""
    probe = add_effects(
        replace(
            calibration,
            effects=(),
            coefficients=calibration.coefficients[: _terms(calibration)],
            covariance=calibration.covariance[: _terms(calibration), : _terms(calibration)],
        ),
        (effect,),
    )
    step = effect.begin(probe)
    channels = survey.values(probe.channels)
    times = np.rint(survey.time * 1e6).astype(np.int64).tolist()
    rows = zip(times, *survey.field.T.tolist(), channels.tolist(), strict=True)
    return np.array([step(*row) for row in rows]).T


def effect_columns(
    problem: Problem, effect: Effect, phi: FloatArray | Callable[[slice], FloatArray]
) -> Columns:
    """Return what an effect's coefficients leave, from its regressors (r, n) or a function of the rows."""
    tensor = effect.columns(problem.calibration.reference.field)
    slots = np.flatnonzero(np.abs(tensor).sum(axis=(0, 1)))
    tensor = tensor[:, :, slots]

    def columns(rows: slice) -> FloatArray:
        part = phi(rows) if callable(phi) else phi[:, rows]
        slopes = problem.slopes[rows][:, slots]
        return np.asarray(-sum((phi_r[:, None] * slopes) @ tensor[:, r].T for r, phi_r in enumerate(part)))

    return columns


def samples_of(survey: Survey, calibration: Calibration) -> tuple[Samples, FloatArray]:
    """Return the residual's samples, with effects among the regressors, and its coefficients (9 m,)."""
    phi = regressors(calibration, survey.field, survey.values(calibration.channels), survey.time)
    unit = calibration.reference.field
    W = calibration.kernel.weights.copy()
    W[0, :3] -= 1.0
    W[:, :6] *= unit
    noise = calibration.noise
    kappa = noise.reference / noise.sensor if noise.sensor > 0.0 else 0.0
    return Samples(survey.field, survey.reference, phi.T, survey.follows, unit, kappa), W.ravel()


def pose(survey: Survey, calibration: Calibration) -> Problem:
    """Linearise the comparison about `calibration`."""
    samples, coefficients = samples_of(survey, calibration)
    n = len(survey)
    e, g, gain, reading = np.empty(n), np.empty((n, 9)), np.empty(n), np.empty((n, 3))
    for start in range(0, n, CHUNK):
        rows = slice(start, start + CHUNK)
        part = samples.part(rows)
        e[rows], slope = residuals(part, coefficients)
        away = slope[:, 6:]
        reading[rows] = part.field + (e[rows] / (away * away).sum(axis=1))[:, None] * away
        _, g[rows] = residuals(replace(part, field=reading[rows]), coefficients)
        above, _ = residuals(replace(part, reference=part.reference + 1.0), coefficients)
        gain[rows] = e[rows] - above
    L, centre = _loosened(calibration, *_prior(survey, calibration, samples, e, g))
    seen = np.zeros((L.shape[1],) * 2)
    for start in range(0, n, CHUNK):
        rows = slice(start, start + CHUNK)
        J = derivatives(calibration, samples.part(rows), g[rows], L)
        seen += J.T @ J
    values, vectors = np.linalg.eigh(seen / _level(calibration, e) ** 2)
    keep = values > SEEN
    V, rest = vectors[:, keep], L @ vectors[:, ~keep]
    free = -derivatives(calibration, samples, g, L @ V)
    return Problem(survey, calibration, reading, e, g, gain, free, L @ V, V.T @ centre, rest @ rest.T)


def _level(calibration: Calibration, e: FloatArray) -> float:
    return calibration.noise.sensor or 1.4826 * float(np.median(np.abs(e))) or 1.0


def _terms(calibration: Calibration) -> int:
    return sum(term.size for term in calibration.terms)


def derivatives(calibration: Calibration, samples: Samples, g: FloatArray, L: FloatArray) -> FloatArray:
    """(n, q): derivatives of the residual by all the calibration's coefficients, times L (K, q), in bounded memory."""
    tensor = _tensor(calibration)
    M = np.tensordot(L.T, tensor, 1).reshape(L.shape[1], -1).T
    out = np.empty((len(g), L.shape[1]))
    for start in range(0, len(g), CHUNK):
        rows = slice(start, start + CHUNK)
        outer = samples.phi[rows, :, None] * g[rows, None, :]
        out[rows] = outer.reshape(len(outer), -1) @ M
    return out


def _tensor(calibration: Calibration) -> FloatArray:
    """(K, m, 9): what each coefficient makes of each regressor, in each slot."""
    kernel = calibration.kernel
    exponents = [(0,) * len(calibration.parameters)]
    for parent, k in kernel.parents:
        e = exponents[parent]
        exponents.append((*e[:k], e[k] + 1, *e[k + 1 :]))
    tensor = np.zeros((calibration.coefficients.size, len(kernel.weights), 9))
    row, k = {exponent: i for i, exponent in enumerate(exponents)}, 0
    for term in calibration.terms:
        expansion = term.expand(calibration)
        tensor[k : k + term.size, [row[e] for e in expansion.exponents]] = expansion.columns
        k += term.size
    r = len(exponents)
    for effect in calibration.effects:
        columns = effect.columns(calibration.reference.field)
        tensor[k : k + effect.size, r : r + columns.shape[1]] = columns
        k, r = k + effect.size, r + columns.shape[1]
    return tensor


def floor(calibration: Calibration) -> FloatArray:
    """(K, K) covariance, nT²: what the nine constants may have changed by since the calibration.

    Its posterior knows only the noise of its samples, and a few thousand of them make that a hundredth of it. What
    the runs' turns did to the filtered channels, and what nobody holds constant, is more.
    """
    spread, k = np.zeros(calibration.coefficients.size), 0
    for term in calibration.terms:
        if isinstance(term, Polynomial) and (0,) * len(calibration.parameters) in term.exponents:
            first = k + 9 * term.exponents.index((0,) * len(calibration.parameters))
            spread[first : first + 9] = STABLE * calibration.reference.field
        k += term.size
    return np.diag(spread**2)


def _loosened(calibration: Calibration, L: FloatArray, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L and m with :func:`floor` added."""
    mean = L @ centre
    broad = _factor(L @ L.T + floor(calibration))
    return broad, np.asarray(np.linalg.lstsq(broad, mean, rcond=None)[0], float)


def _factor(covariance: FloatArray) -> FloatArray:
    """L with ``L L^T`` the covariance, of as many columns as it has rank."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0)) + 1e-12
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-12 * values[-1]
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _prior(
    survey: Survey, calibration: Calibration, samples: Samples, e: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return L and m. What the calibration learned from samples that are here again is taken out of its posterior.

    In the posterior's own units, ``P_0 = 1 - H`` with H the information of those samples, and since the gradient
    vanished at c_0, ``P_0 m = L^T J^T W e``.
    """
    L = _factor(calibration.covariance)
    centre = np.zeros(L.shape[1])
    learned = np.flatnonzero(survey.learned)
    if not learned.size:
        return L, centre
    J = derivatives(calibration, samples.part(learned), g[learned], L)
    noise, follows = calibration.noise, survey.follows[learned]
    white = np.column_stack([J, e[learned]])
    white = whiten(white, follows, noise.memory) / _level(calibration, e)
    A, y = white[:, :-1], white[:, -1]
    values, vectors = np.linalg.eigh(np.eye(len(centre)) - A.T @ A)
    held = values > 0.1  # elsewhere those samples were all there was, and they speak for themselves
    pull = vectors @ np.where(held, vectors.T @ (A.T @ y), 0.0)
    bound = L / _physical(calibration)[:, None]
    values, vectors = np.linalg.eigh((vectors * np.where(held, values, 0.0)) @ vectors.T + bound.T @ bound)
    root = np.sqrt(np.maximum(values, BROADEST))
    return L @ (vectors / root), (vectors.T @ pull) / root


def _physical(calibration: Calibration) -> FloatArray:
    """(K,) nT: how large coefficients are on any vehicle, soft iron of percents and hard iron of thousands of nanotesla.

    Less at every order. On a glider's attitudes scale and offset can grow against each other without end, and take the
    noise with them.
    """
    width, k = np.full(calibration.coefficients.size, np.inf), 0
    for term in calibration.terms:
        if isinstance(term, Polynomial):
            for i, exponents in enumerate(term.exponents):
                fall = 0.3 ** sum(exponents)
                width[k + 9 * i : k + 9 * i + 6] = SOFT * calibration.reference.field * fall
                width[k + 9 * i + 6 : k + 9 * i + 9] = HARD * fall
        k += term.size
    return width
