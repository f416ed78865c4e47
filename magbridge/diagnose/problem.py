r"""The comparison of the measured field with a calibration, as a linear problem.

Notes
-----
*Forward model.* With the scalar residual e of :mod:`magbridge.estimation.residual` and its
derivative g by the nine coefficients, a term or an effect that adds ``sum_rs phi_r C_krs`` to slot s moves e
by

.. math:: \partial e_t / \partial c_k = \sum_{rs} \phi_r(t)\, C_{krs}\, g_s(t)

A coefficient that the vehicle has and the calibration lacks adds minus that to the residual. Derivatives are
taken at ``H_r - e w / |w|^2``, the reading moved until its residual vanishes. At the reading itself they
would correlate with its noise (errors in variables).

*Unknowns.* The calibration's coefficients are free, ``c = c_0 + L z``, ``z ~ N(m, 1)``, where L spans the
directions that these data determine. The prior is the calibration's posterior, without the information of
samples that are compared again, and with a drift between days. Three delays of the sensor's axes are free as
well (:func:`interpolation_error`): they are a fault of the log, and change no coefficient.

*Slow noise* is free if the data need it (:func:`with_slow_noise`). The autoregression of :mod:`.noise` ends
after few samples, and underestimates the power of 1/f noise at the lowest frequencies by a factor of five to
nine. So the noise of axis i may have a slow part (Keshner 1982, Proc. IEEE 70:212), of one common size g:

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
from magbridge.calibration.terms import Effect, LogSeries, Polynomial
from magbridge.diagnose.survey import Survey
from magbridge.estimation.noise import whiten
from magbridge.estimation.priors import HARD_IRON_SIGMA_NT, SOFT_IRON_SIGMA
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, robust_scale

EACH, LAST = 16, 64
"""Half waves per log along each axis, and further ones along the field alone."""
MAX_MISSING_SAMPLES = 3
"""Largest number of samples missing in a row within a leg: the rate next to such a gap still has 98 % of the
true one's power."""
WHITENED_ROWS = 2048
"""Rows that are whitened at a time, few enough for the processor's cache."""
DERIVATIVE_ROWS = 8192
"""Rows at a time: the memory is bounded, whatever the log."""
BROADEST = 1e-3
"""Least precision, in units of the posterior's, of a direction that only the repeated logs determined."""
FALL = 0.3
"""Share of a coefficient's plausible size that remains from one power of a mass' position to the next."""
MIN_PRECISION = 0.1
"""Least precision, in units of the posterior's, of a direction that other logs determined, too."""
STABLE = 2e-5
"""Stability between days, as a fraction of the field: no fluxgate's scales, axes and offsets do better
than 20 ppm."""
T = TypeVar("T")
AXIS_DELAY_SIGMA_S = 0.3
"""Plausible size of an axis' delay after its row, s."""
DELAYS = slice(-3, None)
"""Places of the axes' delays in z."""
MIN_INFORMATION = 0.01
"""Share of a prior's information that data must add for its direction to be kept."""


def waves() -> FloatArray:
    """Return (k,) k of each coefficient: each axis in turn, then along the field."""
    return np.append(np.repeat(np.arange(1.0, EACH + 1.0), 3), np.arange(EACH + 1.0, LAST + 1.0))


def slow_columns(slopes: FloatArray, rows: slice) -> FloatArray:
    """Return the contribution of 1 nT of each coefficient to rows of a residual, (m, k)."""
    # cos(pi k t / T) at the middle of each sample's interval
    n, part = len(slopes), slopes.T[:, rows]
    phase = np.pi * (np.arange(n)[rows] + 0.5) / n
    wave = np.stack(powers(np.exp(1j * phase), LAST)).real  # cos(k phase), by one product each
    each = (wave[:EACH, None] * part).reshape(3 * EACH, -1)
    return np.concatenate([each, wave[EACH:] * np.linalg.norm(part, axis=0)]).T


def rates(survey: Survey, H: FloatArray, order: int = 1) -> FloatArray:
    """Return the first or second derivative (k, n) of H (k, n), of a cubic spline through each leg.

    A leg is a run of samples without a gap of more than :data:`MAX_MISSING_SAMPLES`. The derivative matrix of
    a spline has no trace, so the rates of noise do not correlate with the noise itself; those of a one-sided
    difference do. A central difference would underestimate the rate of an oscillation.
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
    """Return (3, n) error of axes H (3, n) sampled late and interpolated to their row, nT per s of delay.

    `H` must be free of the readings' noise: the difference is one-sided and would correlate with it.
    """
    # Linear interpolation between t - h + tau and t + tau: H + tau (dH/dt - (H_0 - H_-) / h), per unit of tau
    rate, follows = rates(survey, H), survey.follows()
    at = np.flatnonzero(follows & rate.any(axis=0))
    out = np.zeros_like(H)
    out[:, at] = rate[:, at] - (H[:, at] - H[:, at - 1]) / (survey.time[at] - survey.time[at - 1])
    return out


def row_blocks(n: int) -> list[slice]:
    """Return the pieces in which n rows are processed."""
    return [slice(start, min(start + WHITENED_ROWS, n)) for start in range(0, n, WHITENED_ROWS)]


def side_by_side(blocks: Sequence[FloatArray]) -> FloatArray:
    """Return (m, k) blocks of columns side by side, stored column by column."""
    out = np.empty((sum(block.shape[1] for block in blocks), len(blocks[0])))
    return np.concatenate([block.T for block in blocks], out=out).T


def derivatives(
    calibration: Calibration, samples: ResidualSamples, g: FloatArray, L: FloatArray, dtype: type = float
) -> FloatArray:
    """Return (n, q) derivatives of the residual by all coefficients, times L (K, q), in bounded memory."""
    # Sum over r, s of phi_r C_krs g_s, by one product of matrices for each block of rows
    tensor, _ = coefficient_tensor(calibration)  # C_krs of :mod:`.problem`
    M = np.tensordot(L.T, tensor, 1).reshape(L.shape[1], tensor[0].size).T
    out: FloatArray = np.empty((L.shape[1], len(g)), dtype)
    for start in range(0, len(g), DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        out[:, rows] = (jacobian(samples.phi[rows], g[rows]) @ M).T
    return out.T


def noise_sigma(calibration: Calibration, e: FloatArray) -> float:
    """Return the noise's 1-sigma, nT: the calibration's, or that of the residual e (n,)."""
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
    """Return the places of the nine constants (of exponents zero) of each polynomial that has them."""
    found, k, none = [], 0, (0,) * len(calibration.parameters)
    for term in calibration.terms:
        if isinstance(term, Polynomial) and none in term.exponents:
            first = k + 9 * term.exponents.index(none)
            found.append(slice(first, first + 9))
        k += term.size
    return found


def _factor(covariance: FloatArray) -> FloatArray:
    """Return L with ``L L^T`` the covariance, of as many columns as it has rank."""
    # Of the correlations: coefficients have units that differ by orders of magnitude
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
    """Return L and m of the posterior without the information of samples that are compared here again.

    It would count twice. In the posterior's own units the remaining precision is ``P_0 = 1 - H`` with H the
    information of those samples (`survey.fitted`), and ``P_0 m = L^T J^T W e``, the sum over them.
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
    """Return the plausible 1-sigma (K,), nT, of each coefficient on any vehicle; infinite if unknown.

    Without this bound, scale and offset can cancel each other at a glider's few attitudes and fit the noise.
    """
    width, k = np.full(calibration.coefficients.size, np.inf), 0
    for term in calibration.terms:
        if isinstance(term, Polynomial):
            for i, exponents in enumerate(term.exponents):
                fall = FALL ** sum(exponents)
                width[k + 9 * i : k + 9 * i + 6] = SOFT_IRON_SIGMA * calibration.reference.field * fall
                width[k + 9 * i + 6 : k + 9 * i + 9] = HARD_IRON_SIGMA_NT * fall
        k += term.size
    return width


@dataclass(frozen=True, eq=False)
class Problem:
    """A survey compared with a calibration and linearised: what a search works on."""

    survey: Survey
    calibration: Calibration
    reading: FloatArray
    """(n, 3) nT, ``H_r - e w / |w|^2``: the reading without noise, for effects that depend on it."""
    residual: FloatArray
    """(n,) e, in the sensor's nanotesla."""
    jacobian: FloatArray
    """(n, 9) g."""
    reference_jacobian: FloatArray
    """(n,) change of e per nT by which the true field exceeds the reference."""
    delay_jacobian: FloatArray
    """(n, 3) ``-de/dz`` of the delays, in units of :data:`AXIS_DELAY_SIGMA_S`."""
    directions: FloatArray
    """(K, q) L; zero for slow noise and the delays."""
    centre: FloatArray
    """(q,) m, prior mean of z."""
    unseen: FloatArray
    """(K, K) nT², covariance in the directions that these data cannot see."""
    waves: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(k,) half waves per log, or a power, by which slow noise's variances fall; empty without such noise."""

    def __len__(self) -> int:
        return len(self.residual)

    def channels_of(self, kind: str) -> list[str]:
        """Name the channels that may be of this kind, except the calibration's own parameters."""
        own = {parameter.name for parameter in self.calibration.parameters}
        return [name for name, c in self.survey.channels.items() if kind in c.kinds and name not in own]

    @property
    def known(self) -> slice:
        """Places in z of the calibration's own coefficients."""
        return slice(len(self.centre) - len(self.waves) - 3)

    @property
    def slow(self) -> slice:
        """Places in z of slow noise."""
        return slice(self.known.stop, len(self.centre) - 3)

    def slow_noise(self, z: FloatArray) -> FloatArray:
        """Return (n,) what slow noise of z (q,) adds to the residual."""
        if not self.waves.size:
            return np.zeros(len(self))
        slopes = self.jacobian[:, 6:]
        return np.concatenate([slow_columns(slopes, rows) @ z[self.slow] for rows in row_blocks(len(self))])

    def series(self, effect: Effect, rows: slice = slice(None)) -> LogSeries:
        """Return rows of the log as the array form of an effect takes them."""
        names = dict.fromkeys([*(p.name for p in self.calibration.parameters), *effect.channels()])
        values = {name: self.survey.channels[name].values[rows] for name in names}
        return LogSeries(self.survey.time[rows], self.reading[rows], values, self.calibration.kernel)

    @cached_property
    def coefficient_jacobian(self) -> FloatArray:
        """(n, k) ``-de/dz`` of the calibration's own coefficients (:attr:`known`), single precision."""
        samples, _ = samples_of(self.survey, self.calibration)
        L = -self.directions[:, self.known]
        return derivatives(self.calibration, samples, self.jacobian, L, np.float32)

    def calibration_rows(self, rows: slice) -> FloatArray:
        """Return rows (m, q) of ``-de/dz``: coefficients, slow noise (nT), delays of the axes."""
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
        """(n,) nT², variance that the calibration states: of the noise, and of its coefficients."""
        noise, J = self.calibration.noise, self.coefficient_jacobian
        return np.asarray(noise.sensor**2 + noise.reference**2 + np.einsum("ij,ij->i", J, J, dtype=float))


def cached_per_problem(made: Callable[[Problem], T]) -> Callable[[Problem], T]:
    """Cache a function's result for each problem: causes share regressors, of 50 MB for a month."""
    known: WeakKeyDictionary[Problem, T] = WeakKeyDictionary()

    @wraps(made)
    def cached(problem: Problem) -> T:
        if problem not in known:
            known[problem] = made(problem)
        return known[problem]

    return cached


def samples_of(survey: Survey, calibration: Calibration) -> tuple[ResidualSamples, FloatArray]:
    """Return the residual's samples, with effects among the regressors, and its coefficients (9 m,)."""
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

    The derivatives are those by the nine coefficients and by the true field, at readings that are moved until
    the residual vanishes. The `coefficients` (9 m,) are those of all m regressors.
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
    """Linearise the comparison about `calibration`."""
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
    """Return the problem with slow noise, its power 1/f or that to a higher `power`."""
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
