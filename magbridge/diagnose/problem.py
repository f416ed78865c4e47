r"""The comparison of the measured field with a calibration, as a linear problem.

Notes
-----
*Slow noise.*
The autoregression of :mod:`~magbridge.diagnose.noise` sees few samples and ends long before: it
leaves the lowest frequencies of 5,000 such samples five to nine times too much power, which passes for a slow
cause. So the noise of axis i may also have a slow part (Keshner 1982, Proc. IEEE 70:212),

.. math:: o_i(t) = \sum_k c_{ki} \cos(\pi k t / T), \qquad \operatorname{var} c_{ki} = g / k

of one common size g (:mod:`~magbridge.diagnose.joint`). It is that of many frequencies, of
which no slow cause has all. A random walk has 1/k^2 (:mod:`~magbridge.diagnose.run`).

*The prior of the coefficients.* It is the calibration's posterior without the information of samples that are
compared here again, and with a drift between days, which every instrument has.

*The residuals of a calibration, and what each coefficient leaves in them.*
With the scalar residual e of :mod:`magbridge.estimation.residual` and its derivative g by the nine
coefficients at every sample, a term or an effect that adds ``sum_rs phi_r C_krs`` to slot s moves it by

.. math:: \partial e_t / \partial c_k = \sum_{rs} \phi_r(t)\, C_{krs}\, g_s(t)

and a coefficient that the vehicle has but the calibration lacks adds minus that to the residual. Every cause
passes through the forward model by this one rule. The calibration's coefficients stay free, with its
posterior as prior: ``c = c_0 + L z``, ``z ~ N(m, 1)``, where L spans only the directions that
these data can determine.

Three delays are free, too: the sensor's axes may have been sampled late, and then interpolated to their rows
(:func:`interpolation_error`). That is a fault of the log, not of the vehicle, so the delays change no
coefficient; without them, a pair of large causes that cancel each other could mimic them. They have one
common size (:mod:`~magbridge.diagnose.joint`), because many logs have no such delays, and three independent
numbers absorb up to a tenth of a skew's power.

Slow noise is free if the data need it (:func:`with_slow_noise`).

Derivatives are taken at ``H_r - e w / |w|^2``, the reading moved until its residual vanishes: at the reading
itself they would correlate with its noise, and scales could grow against offsets until they fit the noise
(errors in variables).
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
    r"""Return the first or second derivative (k, n) of H (k, n), of a cubic spline through each leg.

    A leg is a run of samples in which no gap is longer than :data:`MAX_MISSING_SAMPLES` samples.

    Notes
    -----
    Of an oscillation of angular frequency w, sampled every h, a central difference returns only
    ``sin(wh)/wh = 1 - (wh)^2/6 + ...`` of the rate, so a coefficient fitted to it would be too large by as
    much. The spline returns ``3 sin(wh)/(wh (2 + cos(wh))) = 1 - (wh)^4/180 + ...``.

    The rates ``D e`` of noise e, of covariance Sigma, correlate with the noise:
    :math:`E[(D e)^T \Sigma^{-1} e] = \mathrm{tr} D`, whatever Sigma is. A one-sided difference has a trace,
    which would pass for an effect; the spline treats both directions of time equally and has none.
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
    r"""Return (3, n) error of axes H (3, n) sampled late and interpolated to their row, nT per s of delay.

    Linear interpolation is in error when the vehicle sways from sample to sample. `H` must be free of the
    readings' noise: the difference is one-sided and would correlate with it.

    Notes
    -----
    An axis sampled tau after its row, and interpolated linearly from there and from the sample before it
    (H_-, an interval h earlier), reads at its row (H_0)

    .. math:: H(t + \tau) - \frac{\tau}{h} \left(H(t + \tau) - H(t - h + \tau)\right)
              \approx H + \tau \left(\dot H - \frac{H_0 - H_-}{h}\right)
    """
    # tau (dH/dt - (H_0 - H_-) / h), per unit of tau
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
    """Return (K, K) covariance, nT², of how much the nine constants may have changed since the calibration.

    The posterior counts only the noise of its samples, and a few thousand samples average that down to a
    hundredth. The filters' lag in the turns of the calibration runs, and the drift between days, are larger.
    """
    # 20 ppm of the field on each of the nine constants
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

    The information of the calibration's samples that are in the survey again (`survey.fitted`) is subtracted
    from its posterior: it would count twice. In the posterior's own units the precision left is
    ``P_0 = 1 - H`` with H the information of those samples, and since the gradient of the whole fit vanished
    at c_0, ``P_0 m = L^T J^T W e``, the sum over those samples.
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
    held = (
        values > MIN_PRECISION
    )  # other directions were learned from the repeated samples alone, which count anyway
    pull = vectors @ np.where(held, vectors.T @ (A.T @ y), 0.0)
    # Those directions keep the physical bound as their prior
    bound = L / _physical(calibration)[:, None]
    values, vectors = np.linalg.eigh((vectors * np.where(held, values, 0.0)) @ vectors.T + bound.T @ bound)
    root = np.sqrt(np.maximum(values, BROADEST))
    return L @ (vectors / root), (vectors.T @ pull) / root


def _physical(calibration: Calibration) -> FloatArray:
    """Return the plausible 1-sigma (K,), nT, of each coefficient on any vehicle; infinite if unknown.

    Soft iron is percents of the field, hard iron thousands of nanotesla, and both fall with the order. The
    bound is needed because, at a glider's few attitudes, scale and offset can cancel each other: without it
    they grow without end and fit the noise.
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
    """(n, 3) nT, ``H_r - e w / |w|^2``: for effects that depend on the reading, which must not contain its
    noise."""
    residual: FloatArray
    """(n,) e, in the sensor's nanotesla."""
    jacobian: FloatArray
    """(n, 9) g."""
    reference_jacobian: FloatArray
    """(n,) 1/s of :mod:`magbridge.estimation.residual`: e per nT by which the true field exceeds the
    reference."""
    delay_jacobian: FloatArray
    """(n, 3) ``-de/dz`` of the delays, in units of :data:`AXIS_DELAY_SIGMA_S`."""
    directions: FloatArray
    """(K, q) L; zero for slow noise and the delays."""
    centre: FloatArray
    """(q,) m, prior mean of z."""
    unseen: FloatArray
    """(K, K) nT², covariance in the directions that these data cannot see."""
    waves: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(k,) of each coefficient of slow noise, what its variance falls with: the number of half waves per log,
    or a power of it. There are none where the noise has no such part."""

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
        """(n, k) ``-de/dz`` of the calibration's own coefficients, :attr:`known` of z.

        Single precision: an entry is rarely above 1e4 nT, so its rounding is below 1e-3 nT, and a month's
        array takes 50 MB in place of 100.
        """
        samples, _ = samples_of(self.survey, self.calibration)
        L = -self.directions[:, self.known]
        return derivatives(self.calibration, samples, self.jacobian, L, np.float32)

    def calibration_rows(self, rows: slice) -> FloatArray:
        """Return rows (m, q) of ``-de/dz``: coefficients, slow noise (nT), delays of the axes.

        Slow noise is computed where it is needed: for a month its columns would fill 500 MB.
        """
        blocks = [self.coefficient_jacobian[rows]]
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
    """Compute the residual and its derivatives at readings that are moved until the residual vanishes.

    Returned are the residual (n,), in the sensor's nT, its derivatives by the nine coefficients (n, 9) and by
    the true field (n,), and the moved readings (n, 3), nT. The `coefficients` (9 m,) are those of all m
    regressors.
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
    """Return the problem with slow noise, its power 1/f or that to a higher `power`.

    Its coefficients are places of z that move no calibration.
    """
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
