r"""The linearised comparison of the measured field with a calibration.

Notes
-----
*Forward model.* With the scalar residual e of :mod:`magbridge.estimation.residual` and its
derivative g by the nine coefficients, a term or effect adds ``c_k sum_r phi_r C_krs`` to the coefficient in
slot s, and changes e by

.. math:: \partial e_t / \partial c_k = \sum_{rs} \phi_r(t)\, C_{krs}\, g_s(t)

An effect that the vehicle has and the calibration lacks changes the residual by minus this amount.
Derivatives are taken at ``H_r - e w / |w|^2``, the reading moved until its residual vanishes. At the reading
itself they would correlate with its noise (errors in variables).

*Unknowns.* The calibration's coefficients are free, ``c = c_0 + L z``, ``z ~ N(m, 1)``, where L spans the
directions that these data determine. The prior is the calibration's posterior with a drift between days, but
without the information of samples that are compared again. Three delays of the sensor's axes are free as well
(:func:`interpolation_error`). They are a fault of the log and change no coefficient.

*Slow noise* is free if the data need it (:func:`with_slow_noise`). The autoregression of :mod:`.noise` ends
after few samples, and underestimates the power of 1/f noise at the lowest frequencies by a factor of five to
nine. Therefore the noise of axis i may have a slow part of a common size g (Keshner 1982, Proc. IEEE 70:212):

.. math:: o_i(t) = \sum_k c_{ki} \cos(\pi k t / T), \qquad \operatorname{var} c_{ki} = g / k
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from scipy.interpolate import CubicSpline

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import regressors
from magbridge.calibration.effects import powers
from magbridge.calibration.model import Calibration, coefficient_tensor
from magbridge.calibration.terms import Effect, LogSeries
from magbridge.diagnose.survey import Survey
from magbridge.estimation.noise import whiten
from magbridge.estimation.priors import HARD_IRON_SIGMA_NT, SOFT_IRON_SIGMA
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, robust_scale

EACH, LAST = 16, 64
"""Highest number of half waves per log in slow noise: along each axis, and along the field."""
MAX_MISSING_SAMPLES = 3
"""Largest number of consecutive missing samples within a leg: a spline's rate next to such a gap keeps 98 %
of the true power."""
WHITENED_ROWS = 2048
"""Rows that are whitened at a time, few enough for the processor's cache."""
DERIVATIVE_ROWS = 8192
"""Rows of derivatives that are computed at a time, which bounds the memory."""
BROADEST = 1e-3
"""Lower bound of the prior precision, in units of the posterior's, in any direction."""
FALL = 0.3
"""Ratio of a coefficient's plausible size to that of the next lower power of a mass' position."""
MIN_PRECISION = 0.1
"""Remaining precision, as a fraction of the posterior's, above which other logs determined a direction."""
STABLE = 2e-5
"""Stability between days, as a fraction of the field: no fluxgate's scales, axes and offsets do better
than 20 ppm."""
T = TypeVar("T")
AXIS_DELAY_SIGMA_S = 0.3
"""Plausible delay (1-sigma) of an axis' sample after the time of its row, s."""
DELAYS = slice(-3, None)
"""Slice of the axes' delays in the unknowns z."""
MIN_INFORMATION = 0.01
"""Information of the data, as a fraction of the prior's, above which a direction is fitted."""


def waves() -> FloatArray:
    """Return the number of half waves (k,) of each slow-noise coefficient: three axes, then the field."""
    return np.append(np.repeat(np.arange(1.0, EACH + 1.0), 3), np.arange(EACH + 1.0, LAST + 1.0))


def slow_columns(slopes: FloatArray, rows: slice) -> FloatArray:
    """Return the change (m, k) of m rows of a residual per nT of each slow-noise coefficient."""
    # cos(pi k t / T) at the middle of each sample's interval
    n, part = len(slopes), slopes.T[:, rows]
    phase = np.pi * (np.arange(n)[rows] + 0.5) / n
    wave = np.stack(powers(np.exp(1j * phase), LAST)).real  # cos(k phase), by one product each
    each = (wave[:EACH, None] * part).reshape(3 * EACH, -1)
    return np.concatenate([each, wave[EACH:] * np.linalg.norm(part, axis=0)]).T


def rates(survey: Survey, H: FloatArray, order: int = 1) -> FloatArray:
    """Return the first or second time derivative (k, n) of H (k, n), by a cubic spline through each leg.

    A leg is a run of samples without a gap of more than :data:`MAX_MISSING_SAMPLES`. A spline's rate of noise
    does not correlate with the noise itself, unlike a one-sided difference. A central difference would
    underestimate the rate of an oscillation.
    """
    t, out = survey.time, np.zeros_like(H)
    # One spline for each leg, so that none reaches across a gap
    starts = np.flatnonzero(~survey.follows(MAX_MISSING_SAMPLES))
    for start, end in zip(starts, np.append(starts[1:], len(t)), strict=True):
        if end - start > 2:
            spline = CubicSpline(t[start:end], H[:, start:end], axis=1).c
            out[:, start + 1 : end - 1] = order * spline[3 - order, 1:].T
    return out


def interpolation_error(survey: Survey, H: FloatArray) -> FloatArray:
    """Return the error (3, n), nT per s of delay, of axes sampled late and interpolated to their row.

    `H` (3, n), nT, must be free of the readings' noise, with which a one-sided difference would correlate.
    """
    # Linear interpolation between t - h + tau and t + tau: H + tau (dH/dt - (H_0 - H_-) / h), per unit of tau
    rate, follows = rates(survey, H), survey.follows()
    at = np.flatnonzero(follows & rate.any(axis=0))
    out = np.zeros_like(H)
    out[:, at] = rate[:, at] - (H[:, at] - H[:, at - 1]) / (survey.time[at] - survey.time[at - 1])
    return out


def row_blocks(n: int) -> list[slice]:
    """Return the slices of at most :data:`WHITENED_ROWS` rows in which n rows are processed."""
    return [slice(start, min(start + WHITENED_ROWS, n)) for start in range(0, n, WHITENED_ROWS)]


def side_by_side(blocks: Sequence[FloatArray]) -> FloatArray:
    """Return blocks of columns, (m, k_i) each, side by side as (m, sum of k_i), stored column by column."""
    out = np.empty((sum(block.shape[1] for block in blocks), len(blocks[0])))
    return np.concatenate([block.T for block in blocks], out=out).T


def derivatives(
    calibration: Calibration, samples: ResidualSamples, g: FloatArray, L: FloatArray, dtype: type = float
) -> FloatArray:
    """Return (n, q) derivatives of the residual by all coefficients, times L (K, q); g is (n, 9)."""
    # Sum over r, s of phi_r C_krs g_s, by one product of matrices for each block of rows
    tensor, _ = coefficient_tensor(calibration)  # C_krs of :mod:`.problem`
    M = np.tensordot(L.T, tensor, 1).reshape(L.shape[1], tensor[0].size).T
    out: FloatArray = np.empty((L.shape[1], len(g)), dtype)
    for start in range(0, len(g), DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        out[:, rows] = (jacobian(samples.phi[rows], g[rows]) @ M).T
    return out.T


def noise_sigma(calibration: Calibration, e: FloatArray) -> float:
    """Return the 1-sigma of the noise, nT: as the calibration states, else of the residual e (n,), nT."""
    return calibration.noise.sensor or robust_scale(e) or 1.0


def floor(calibration: Calibration) -> FloatArray:
    """Return (K, K) covariance, nT², of the drift of the nine constants since the calibration."""
    # 20 ppm of the field on each: the posterior counts only noise, which thousands of samples average down
    spread = np.zeros(calibration.coefficients.size)
    for constants in _constants(calibration):
        spread[constants] = STABLE * calibration.reference.field
    return np.diag(spread**2)


def isotropic(calibration: Calibration) -> FloatArray:
    """Return the change of coefficients (K,) that raises the total field by 1 nT at any attitude."""
    scale = np.zeros(calibration.coefficients.size)
    for constants in _constants(calibration)[:1]:
        scale[constants.start : constants.start + 3] = 1.0
    return scale


def _constants(calibration: Calibration) -> list[slice]:
    """Return the slice of the nine constants (exponents zero) of each polynomial that contains them."""
    found, k, none = [], 0, (0,) * len(calibration.parameters)
    for term in calibration.terms:
        if none in term.exponents:
            first = k + 9 * term.exponents.index(none)
            found.append(slice(first, first + 9))
        k += term.size
    return found


def _factor(covariance: FloatArray) -> FloatArray:
    """Return L (K, r) with ``L L^T`` equal to the covariance (K, K) of rank r."""
    # decompose the correlations, because units of coefficients differ by orders of magnitude
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0)) + 1e-12
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-12 * values[-1]
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def prior(
    survey: Survey, calibration: Calibration, samples: ResidualSamples, e: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return L (K, q) and m (q,) of the prior ``c = c_0 + L z``, ``z ~ N(m, 1)``, :func:`floor` included."""
    # Posterior and drift add as covariances; the mean is carried over to the new factor
    L, centre = _without_repeats(survey, calibration, samples, e, g)
    broad = _factor(L @ L.T + floor(calibration))
    return broad, np.asarray(np.linalg.lstsq(broad, L @ centre, rcond=None)[0], float)


def _without_repeats(
    survey: Survey, calibration: Calibration, samples: ResidualSamples, e: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return L and m of the posterior without the information of samples that are compared again.

    That information would count twice. In units of the posterior the remaining precision is ``P_0 = 1 - H``,
    with H the information of the samples `survey.fitted`. The mean is ``P_0 m = L^T J^T W e``, summed over
    them.
    """
    L = _factor(calibration.covariance)
    centre = np.zeros(L.shape[1])
    repeated = np.flatnonzero(survey.fitted)
    if not repeated.size:
        return L, centre
    # Information A^T A of the repeated samples under the calibration's own noise
    J = derivatives(calibration, samples.part(repeated), g[repeated], L)
    noise = calibration.noise
    steps = np.asarray(survey.steps[repeated] * (survey.interval / noise.interval if noise.interval else 1.0))
    white = np.column_stack([J, e[repeated]])
    white = whiten(white, steps, noise.autocorrelation, noise.white) / noise_sigma(calibration, e)
    # P_0 = 1 - H, and P_0 m = A^T y with the directions that only these samples determined left out
    A, y = white[:, :-1], white[:, -1]
    values, vectors = np.linalg.eigh(np.eye(len(centre)) - A.T @ A)
    # other directions were learned from the repeated samples alone, which count anyway
    held = values > MIN_PRECISION
    pull = vectors @ np.where(held, vectors.T @ (A.T @ y), 0.0)
    # Those directions keep the physical bound as their prior
    bound = L / _physical(calibration)[:, None]
    values, vectors = np.linalg.eigh((vectors * np.where(held, values, 0.0)) @ vectors.T + bound.T @ bound)
    root = np.sqrt(np.maximum(values, BROADEST))
    return L @ (vectors / root), (vectors.T @ pull) / root


def _physical(calibration: Calibration) -> FloatArray:
    """Return the plausible size (K,), 1-sigma, nT, of each coefficient on any vehicle; infinite if unknown.

    Without this bound, scale and offset can cancel each other at a glider's few attitudes and fit the noise.
    """
    width, k = np.full(calibration.coefficients.size, np.inf), 0
    for term in calibration.terms:
        for exponents in term.exponents:
            fall = FALL ** sum(exponents)
            width[k : k + 6] = SOFT_IRON_SIGMA * calibration.reference.field * fall
            width[k + 6 : k + 9] = HARD_IRON_SIGMA_NT * fall
            k += 9
    return width


@dataclass(frozen=True, eq=False)
class Problem:
    """A survey compared with a calibration, linearised in all coefficients (module notes)."""

    survey: Survey
    calibration: Calibration
    reading: FloatArray
    """(n, 3) nT, noise-free readings ``H_r - e w / |w|^2``, for effects that depend on the reading."""
    residual: FloatArray
    """(n,) residual e, in the sensor's nT."""
    jacobian: FloatArray
    """(n, 9) g, derivatives of e by the nine coefficients."""
    reference_jacobian: FloatArray
    """(n,) change of e per nT of the true field above the reference."""
    delay_jacobian: FloatArray
    """(n, 3) ``-de/dz`` of the delays, in units of :data:`AXIS_DELAY_SIGMA_S`."""
    directions: FloatArray
    """(K, q) L, change of the coefficients per unit of z; zero for slow noise and delays."""
    centre: FloatArray
    """(q,) m, prior mean of z."""
    unseen: FloatArray
    """(K, K) nT², prior covariance in the directions that these data do not determine."""
    waves: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(k,) factors by which the variances of slow noise are divided; empty without slow noise."""

    def __len__(self) -> int:
        return len(self.residual)

    def channels_of(self, kind: str) -> list[str]:
        """Return the names of channels that may be of this kind, except the calibration's parameters."""
        own = {parameter.name for parameter in self.calibration.parameters}
        return [name for name, c in self.survey.channels.items() if kind in c.kinds and name not in own]

    @property
    def known(self) -> slice:
        """Slice of the calibration's own directions in z."""
        return slice(len(self.centre) - len(self.waves) - 3)

    @property
    def slow(self) -> slice:
        """Slice of the slow-noise coefficients in z."""
        return slice(self.known.stop, len(self.centre) - 3)

    def slow_noise(self, z: FloatArray) -> FloatArray:
        """Return the contribution (n,) of slow noise to the residual for unknowns z (q,)."""
        if not self.waves.size:
            return np.zeros(len(self))
        slopes = self.jacobian[:, 6:]
        return np.concatenate([slow_columns(slopes, rows) @ z[self.slow] for rows in row_blocks(len(self))])

    def series(self, effect: Effect, rows: slice = slice(None)) -> LogSeries:
        """Return rows of the log as the argument of an effect's array form (:meth:`.Effect.batch`)."""
        names = dict.fromkeys([*(p.name for p in self.calibration.parameters), *effect.channels()])
        values = {name: self.survey.channels[name].values[rows] for name in names}
        return LogSeries(self.survey.time[rows], self.reading[rows], values, self.calibration.kernel)

    @cached_property
    def coefficient_jacobian(self) -> FloatArray:
        """(n, k) ``-de/dz`` by the calibration's own directions (:attr:`known`), in single precision."""
        samples, _ = samples_of(self.survey, self.calibration)
        L = -self.directions[:, self.known]
        return derivatives(self.calibration, samples, self.jacobian, L, np.float32)

    def calibration_rows(self, rows: slice) -> FloatArray:
        """Return rows (m, q) of ``-de/dz``: own directions, slow noise (per nT), delays of the axes."""
        blocks = [self.coefficient_jacobian[rows]]
        # Computed for each block: for a month, all columns of slow noise would fill 500 MB
        if self.waves.size:
            blocks.append(slow_columns(self.jacobian[:, 6:], rows))
        return side_by_side([*blocks, self.delay_jacobian[rows]])

    def let_go(self) -> None:
        """Release :attr:`coefficient_jacobian` (100 MB for a month); it is computed again when needed."""
        self.__dict__.pop("coefficient_jacobian", None)

    @property
    def stated(self) -> FloatArray:
        """(n,) nT², variance of the residual that the calibration states: of noise and of coefficients."""
        noise, J = self.calibration.noise, self.coefficient_jacobian
        return np.asarray(noise.sensor**2 + noise.reference**2 + np.einsum("ij,ij->i", J, J, dtype=float))


def cached_per_problem(made: Callable[[Problem], T]) -> Callable[[Problem], T]:
    """Return a function that caches its result for each problem, as long as the problem exists."""
    known: WeakKeyDictionary[Problem, T] = WeakKeyDictionary()

    @wraps(made)
    def cached(problem: Problem) -> T:
        if problem not in known:
            known[problem] = made(problem)
        return known[problem]

    return cached


def samples_of(survey: Survey, calibration: Calibration) -> tuple[ResidualSamples, FloatArray]:
    """Return the samples of the residual with all m regressors, effects included, and coefficients (9 m,)."""
    phi = regressors(calibration, survey.field, survey.values(calibration.channels), survey.time)
    # The residual takes A - 1 in nT of the usual field
    unit = calibration.reference.field
    W = calibration.kernel.weights.copy()
    W[0, :3] -= 1.0
    W[:, :6] *= unit
    noise = calibration.noise
    kappa = noise.reference / noise.sensor if noise.sensor > 0.0 else 0.0
    return ResidualSamples(
        survey.field, survey.reference, phi.T, survey.steps.astype(float), unit, kappa
    ), W.ravel()


def linearised(
    samples: ResidualSamples, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the residual (n,), nT, its derivatives (n, 9) and (n,), and the moved readings (n, 3), nT.

    The derivatives, by the nine coefficients and by the true field, are taken at readings that are moved
    until the residual vanishes. The `coefficients` (9 m,) belong to all m regressors.
    """
    n = len(samples.field)
    e, g, reference_jacobian, reading = np.empty(n), np.empty((9, n)).T, np.empty(n), np.empty((n, 3))
    for start in range(0, n, DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        part = samples.part(rows)
        e[rows], slope = residuals(part, coefficients)
        # Errors in variables: move the reading along its own gradient until the residual vanishes
        away = slope[:, 6:]
        reading[rows] = part.field + (e[rows] / (away * away).sum(axis=1))[:, None] * away
        _, g[rows] = residuals(replace(part, field=reading[rows]), coefficients)
        above, _ = residuals(replace(part, reference=part.reference + 1.0), coefficients)
        reference_jacobian[rows] = e[rows] - above
    return e, g, reference_jacobian, reading


def pose(survey: Survey, calibration: Calibration) -> Problem:
    """Return the problem of a survey, linearised about `calibration`."""
    samples, coefficients = samples_of(survey, calibration)
    n = len(survey)
    # Residual and derivatives at readings without noise, and the prior of the coefficients
    e, g, reference_jacobian, reading = linearised(samples, coefficients)
    L, centre = prior(survey, calibration, samples, e, g)
    # Information of these data in units of the prior: directions below MIN_INFORMATION are not fitted
    seen = np.zeros((L.shape[1],) * 2)
    for start in range(0, n, DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        J = derivatives(calibration, samples.part(rows), g[rows], L)
        seen += J.T @ J
    values, vectors = np.linalg.eigh(seen / noise_sigma(calibration, e) ** 2)
    # Their covariance goes into `unseen`, which the extended calibration keeps
    keep = values > MIN_INFORMATION
    V, rest = vectors[:, keep], L @ vectors[:, ~keep]
    delay_jacobian = -AXIS_DELAY_SIGMA_S * g[:, 6:] * interpolation_error(survey, reading.T).T
    directions, centre = np.hstack([L @ V, np.zeros((len(L), 3))]), np.append(V.T @ centre, np.zeros(3))
    return Problem(
        survey, calibration, reading, e, g, reference_jacobian, delay_jacobian, directions, centre,
        rest @ rest.T,
    )  # fmt: skip


def with_slow_noise(problem: Problem, power: int = 1) -> Problem:
    """Return the problem with free slow noise of the spectral density ``1 / f^power``."""
    if problem.waves.size:
        made = replace(problem, waves=waves() ** power)
    else:
        # Zero columns of L: slow noise moves no coefficient of the calibration
        place, more = problem.known.stop, np.zeros(waves().size)
        made = replace(
            problem,
            directions=np.insert(problem.directions, place, more[:, None], axis=1),
            centre=np.insert(problem.centre, place, more),
            waves=waves() ** power,
        )
    made.__dict__["coefficient_jacobian"] = problem.coefficient_jacobian  # the same array: 200 MB for a month
    return made
