"""Fit the compensation of a scalar magnetometer.

Notes
-----
The model of :mod:`magbridge.calibration.scalar` is linear, its coefficients Gaussian with widths w_b for each
block of columns (permanent, induced, eddy, lag, each channel), and the noise is white plus a sum of
Ornstein-Uhlenbeck processes, plus, where the reference lacks the crustal field, a Matern process of
smoothness 5/2 in time. The marginal likelihood times the hyperparameters' prior is maximised (Rasmussen &
Williams 2006, section 5.4):

1. For given noise, the steady-state Kalman filter of the slow processes whitens reading and columns. For a
   stationary process it is a linear filter with the zeros ``eig(A)`` and the poles ``eig(A - K C)``, applied
   as second-order sections, so that the cost is linear in the samples. The filter begins with the steady
   state's covariance P, the processes with their stationary covariance: the remainder of the initial state is
   a random vector whose effect on the stretch is whitened as well.
2. With the normal equations of the whitened columns, the evidence and its gradient by the log widths are
   algebra of the columns' number alone.

No channel is selected: the evidence of one log does not distinguish channels that help in another log from
those that harm, but a physical width does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise, starmap
from typing import Any

import msgspec
import numpy as np
from scipy.linalg import block_diag, solve_discrete_are
from scipy.optimize import minimize
from scipy.signal import sosfilt
from scipy.special import chdtrc
from threadpoolctl import threadpool_limits

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.scalar import (
    CYCLE_LEVEL_SIGMA_NT,
    IMPOSSIBLE_FRACTION,
    PLATFORM_TERMS,
    ScalarChannel,
    ScalarNoise,
    ScalarSensor,
    ScalarSeries,
    moved_earlier,
    scalar_design,
    term_columns,
)
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError
from magbridge.estimation.blocks import NO_COEFFICIENTS, ParameterBlock, with_blocks
from magbridge.estimation.hyperparameters import log_evidence
from magbridge.estimation.information import GaussianInformation, covariance_of
from magbridge.estimation.priors import PriorFamily
from magbridge.estimation.residual import robust_scale

__all__ = ["ScalarFit", "adapt_to_log", "fit_scalar", "is_significant"]

WIDTH_CENTRES_NT = {"permanent": 1000.0, "induced": 100.0, "eddy": 10.0}
"""Centres of the priors of the widths, nT (eddy: nT s)."""
LOG_WIDTH_SIGMA = 0.5
"""1-sigma of the log of a width. If wider, permanent and induced field cancel over few attitudes."""
CHANNEL_WIDTH_NT, LOG_CHANNEL_WIDTH_SIGMA = 10.0, 1.5
"""nT a swing and its log's 1-sigma: centre of a channel's width."""
LAG = PLATFORM_TERMS - 1
"""Column of the lag."""
LAG_GRID_S = np.linspace(-1.5, 1.5, 61)
"""Lags that are tried first, s."""
LAG_SIGMA_S = 0.5
"""1-sigma of the lag between scalar and vector, s."""
TIME_CONSTANTS_S = (1.5, 5.0, 15.0, 50.0, 150.0, 500.0, 1500.0, 5000.0)
"""Correlation times of the Ornstein-Uhlenbeck processes, s."""
FIT_INTERVAL_S = 0.5
"""Shortest interval of the samples that are fitted, s; faster logs are averaged to it."""
FILTER_GAP_INTERVALS = 3.0
"""Intervals without a sample after which the whitening filter begins again."""
MIN_SCALAR_SAMPLES = 100
NOISE_STARTS_NT = 0.1, 1.0, 10.0
"""Amplitudes of the slow processes from which the search starts: the evidence has several maxima."""
WIDTH_GRID_SIGMA = np.linspace(-3.0, 3.0, 13)
"""Grid of the log of a width about its prior's centre, in prior sigmas."""
NOISE_STEP = 1e-3
"""Step of the logs of the noise with which the gradient is computed."""
START_ITERATIONS, EVIDENCE_ITERATIONS = 5, 25
"""Iterations of the search from each start, and of the search from the best of them."""
LOG_PROCESS_CENTRE, LOG_PROCESS_SPREAD, LOG_PROCESS_STEP = float(np.log(0.1)), 2.0, 0.7
"""Log of nT: centre and 1-sigma of white noise and fastest process, 1-sigma of the change to the next."""
LOG_CRUST_CENTRES, LOG_CRUST_SPREAD = np.log(np.array([30.0, 15.0, 30.0])), 1.5
"""Log of the amplitudes of the two parts of the crustal field (nT) and of the time scale of the first (s)."""
CRUST_SCALE_RATIO = 8.0
"""Time scale of the crustal field's second part in units of that of the first: one scale is too few."""
LOG_LONGEST_CRUST, REFUSED_COST = float(np.log(500.0)), 1e9
"""Log of s, longest time scale of the first part; cost of noise whose whitening filter is unstable."""
WITNESS_SIGMA, WITNESS_PASSES = 8.0, 12
"""Distance from the vector sensor, in robust standard deviations, beyond which a sample is not fitted."""
LOG_WIDTH_LIMITS = -15.0, 15.0
"""Limits of the log of a width, nT: a trial step of the optimiser stays finite."""
ROUNDING = 1e-10
"""Fraction of the crustal variance that is added to each step, whose own variance is lost in rounding."""
OUTLIER_INNOVATION_SIGMA, OUTLIER_PAD = 8.0, 4
"""Whitened residual beyond which a sample is left out of the fit, and samples left out on either side."""
LEAST_GAIN = 0.99
"""RMS after compensation in units of that before it, from which on nothing is improved."""
FALSE_NAME_LEVEL = 1e-3
"""Probability of a finding by chance, over all terms that are tested."""


@dataclass(frozen=True, eq=False)
class ScalarFit:
    """A fitted compensation and its effect on the samples."""

    sensor: ScalarSensor
    rms_before: float
    """RMS of reading minus reference about its mean, nT."""
    rms_after: float
    """RMS of compensated minus reference about its mean, on the fitted samples, nT."""
    contribution: dict[str, float]
    """Standard deviation of what each block adds to the fitted samples, nT."""
    left_out: int
    """Samples that were left out as outliers."""
    removed: float
    """Median of reading minus reference, nT."""
    findings: tuple[Diagnostic, ...] = ()
    """Statistically significant lag, and channels that disturb the scalar (:data:`FALSE_NAME_LEVEL`)."""
    merit: dict[str, Any] | None = None
    """Figure of merit of the fitted log, :func:`.figure_of_merit`; None if the log holds no box flight."""

    @property
    def lag_sigma(self) -> float:
        """1-sigma of the lag, s; 0 for a given lag."""
        variance = self.sensor.total_covariance[LAG, LAG]
        return 0.0 if _has_fixed_lag(self.sensor) else float(np.sqrt(variance))

    @property
    def doubt(self) -> str:
        """Return why the data do not support this compensation; empty if they do."""
        if abs(self.removed) > IMPOSSIBLE_FRACTION * self.sensor.reference_field:
            return (
                f"{self.sensor.column} reads {self.sensor.reference_field + self.removed:.0f} nT and the "
                f"reference is {self.sensor.reference_field:.0f} nT: is the sign of the latitude right?"
            )
        if self.rms_after > max(LEAST_GAIN * self.rms_before, MAIN_FIELD_SIGMA_NT):
            return (
                f"the compensation of {self.sensor.column} improves nothing: {self.rms_before:.0f} -> "
                f"{self.rms_after:.0f} nT about the mean; its reading or the reference is wrong"
            )
        return ""


def fit_scalar(
    series: ScalarSeries,
    names: tuple[str, ...],
    *,
    column: str = "scalar",
    units: tuple[str, ...] = (),
    lag: float | None = None,
    map_known: bool = False,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ScalarFit:
    """Fit the compensation of a scalar magnetometer; samples with a missing value are left out.

    `names` and `units` are those of the channels. `lag` (s) is that of the scalar after the vector; it is
    estimated if not given. With `map_known` the reference includes the crustal field; otherwise that is a
    Matern process along the track. The reference includes `lever` (m) already.

    CalibrationError: too few samples, or a constant direction.
    """
    needed = np.column_stack([series.scalar, series.vector, series.reference, series.channels])
    valid = np.asarray(np.isfinite(needed).all(axis=1))
    if valid.sum() < MIN_SCALAR_SAMPLES:
        raise CalibrationError(
            f"{column}: expected at least {MIN_SCALAR_SAMPLES} samples with vector, reference and "
            f"{', '.join(names) or 'no telemetry'}, got {int(valid.sum())}"
        )
    channels = tuple(
        ScalarChannel(
            name, float(np.median(values)), _quantiles(values), float(values.min()), float(values.max()), unit
        )
        for name, values, unit in zip(
            names, series.channels[valid].T, units or [""] * len(names), strict=True
        )
    )
    reference_field = float(np.median(series.reference[valid]))
    valid &= _agreeing(series, valid, channels, reference_field)
    shift, terms = _first_lag(series, valid, channels, reference_field, lag)
    series = series._replace(scalar=moved_earlier(series.scalar, series.time, shift))
    valid &= np.isfinite(series.scalar)
    problem = _ScalarProblem.build(series, valid, channels, reference_field, terms, fixed_lag=lag is not None)
    kept = np.ones(len(problem.target), bool)
    start: FloatArray | None = None
    with threadpool_limits(1, "blas"):  # for matrices this small threads cost more than they gain
        for _ in range(3):  # outliers of one pass are left out in the next
            state = problem.part(kept).optimise(map_known=map_known, start=start)
            outliers = problem.outliers(state, kept)
            if not outliers.any():
                break
            kept &= ~outliers
            start = state.log_noise
    return _result(problem, kept, state, series, column, channels, lever, shift)


def _agreeing(
    series: ScalarSeries, valid: BoolArray, channels: tuple[ScalarChannel, ...], reference_field: float
) -> BoolArray:
    """Return a mask (n,) of samples at which the scalar agrees with the vector sensor.

    Notes
    -----
    The crustal field is in both sensors, so that the difference of scalar and vector length is the platform's
    field and noise. A fit of its columns by least absolute values leaves a source that no channel shows.
    """
    design = scalar_design(series, channels, reference_field)
    design = np.column_stack([design, np.ones(len(design))])
    difference = series.scalar - np.linalg.norm(series.vector, axis=1)
    weight = valid.astype(float)
    for _ in range(WITNESS_PASSES):
        # Weights of 1 / |r| minimise the sum of |r|: some far samples do not move the fit.
        root = np.sqrt(weight)
        found = np.linalg.lstsq(design[valid] * root[valid, None], (difference * root)[valid], rcond=1e-10)[0]
        residual = np.abs(difference - design @ found)
        usual = max(robust_scale(residual[valid]), 1e-3)
        weight = 1.0 / np.maximum(residual, usual)
    return np.asarray(valid & (residual <= WITNESS_SIGMA * usual))


def _interval(time: FloatArray) -> tuple[float, int]:
    """Return the interval of the samples, s, and their number in the fit's interval."""
    gaps = np.diff(time)
    step = float(np.median(gaps[gaps > 0.0])) if (gaps > 0.0).any() else FIT_INTERVAL_S
    return step, max(1, int(FIT_INTERVAL_S / step + 1e-6))


def _first_lag(
    series: ScalarSeries,
    valid: BoolArray,
    channels: tuple[ScalarChannel, ...],
    reference_field: float,
    lag: float | None,
) -> tuple[float, FloatArray]:
    """Return a first estimate of the lag, s (`lag` if given), and of the terms (m,) that belong to it.

    Notes
    -----
    Changes over the fit's interval have little slow noise and crustal field, so that least squares suffices.
    With an orthonormal basis Q of the changes of the columns, the sum of squares that a lag leaves of the
    changes y of the moved reading minus reference is ``y^T y - |Q^T y|^2``. Its log is half the number of
    intervals times the log likelihood. The prior alone decides for 0 where the samples show nothing: with a
    threshold, a lag below it was left to the linear column, which finds half of it.
    """
    design = scalar_design(series, channels, reference_field)
    design[:, LAG] = 0.0
    _, many = _interval(series.time)
    change = series.time[many:] - series.time[:-many]

    def changes(lag: float) -> FloatArray:
        target = moved_earlier(series.scalar, series.time, lag) - series.reference
        return np.asarray(target[many:] - target[:-many])

    lags = LAG_GRID_S if lag is None else np.array([lag])
    tried = np.array([changes(one) for one in lags])
    rows = valid[many:] & valid[:-many] & np.isfinite(tried).all(axis=0) & (change < 2.0 * FIT_INTERVAL_S)
    if rows.sum() <= design.shape[1]:
        return (0.0 if lag is None else lag), np.zeros(design.shape[1])
    columns = (design[many:] - design[:-many])[rows]
    Q = np.linalg.svd(columns[:, np.ptp(columns, axis=0) > 0.0], full_matrices=False)[0]
    left = ((tried[:, rows] - (tried[:, rows] @ Q) @ Q.T) ** 2).sum(axis=1)
    if lag is None:
        cost = rows.sum() / many * np.log(left) + (lags / LAG_SIGMA_S) ** 2
        best, lag = int(cost.argmin()), 0.0
        if 0 < best < len(lags) - 1:
            below, at, above = cost[best - 1 : best + 2]
            lag = float(lags[best] + 0.5 * (lags[1] - lags[0]) * (below - above) / (below - 2.0 * at + above))
    found = np.linalg.lstsq(columns, changes(lag)[rows], rcond=1e-6)[0]
    return lag, np.asarray(found)


def is_significant(values: FloatArray, covariance: FloatArray, tests: int) -> bool:
    """Return True if coefficients (k,), one of several `tests`, are significant at :data:`FALSE_NAME_LEVEL`.

    Notes
    -----
    ``c^T C^-1 c`` of k zero coefficients, with their covariance C (k, k), is a chi-square of k degrees.
    """
    squared = float(values @ np.linalg.solve(covariance, values))
    return bool(chdtrc(len(values), squared) < FALSE_NAME_LEVEL / max(tests, 1))


def _findings(
    sensor: ScalarSensor, contribution: dict[str, float], channels: tuple[ScalarChannel, ...]
) -> tuple[Diagnostic, ...]:
    """Return the lag if it is not zero, then the channels that disturb the scalar, the strongest first."""
    names, column, terms = [channel.name for channel in channels], sensor.column, term_columns(channels)
    mean, covariance = np.array(sensor.coefficients), np.array(sensor.covariance)
    mean[LAG] -= sensor.lag

    def significant(name: str) -> bool:
        term = terms[name]
        return is_significant(mean[term], covariance[term, term], len(names) + 1)

    found = []
    if significant("lag") and not _has_fixed_lag(sensor):
        sigma = float(np.sqrt(covariance[LAG, LAG]))
        found.append(Diagnostic("scalar.lag", {"column": column, "lag_s": sensor.lag, "sigma_s": sigma}))
    for name in filter(significant, sorted(names, key=lambda name: -contribution[name])):
        values = {"column": column, "channel": name, "effect_nT": contribution[name]}
        found.append(Diagnostic("scalar.channel", values))
    return tuple(found)


def _quantiles(values: FloatArray) -> tuple[float, float]:
    low, high = np.quantile(values, [0.02, 0.98]).tolist()
    return low, high


@dataclass(frozen=True, eq=False)
class _Posterior:
    """Hyperparameters where the evidence is largest, and the posterior that they give."""

    log_widths: FloatArray
    prior_sigma: FloatArray
    """(m,), 1-sigma of each coefficient's prior."""
    mean: FloatArray
    covariance: FloatArray
    cost: float
    """Negative log of evidence times prior, up to a constant."""
    log_noise: FloatArray


@dataclass(frozen=True, eq=False)
class _ScalarProblem:
    """Target and columns at the fit's interval."""

    time: FloatArray
    target: FloatArray
    """(n,), nT, reading minus reference."""
    design: FloatArray
    """(n, m), all columns, levels last."""
    family: PriorFamily
    interval: float
    cycles: tuple[int | None, ...]
    averaged: int

    @staticmethod
    def build(
        series: ScalarSeries,
        valid: BoolArray,
        channels: tuple[ScalarChannel, ...],
        reference_field: float,
        terms: FloatArray,
        *,
        fixed_lag: bool,
    ) -> _ScalarProblem:
        """Average to the fit's interval and form the columns, that of the lag by the coefficients `terms`."""
        step, many = _interval(series.time)
        design = scalar_design(series, channels, reference_field, terms)
        target = series.scalar - series.reference
        if fixed_lag:
            design[:, LAG] = 0.0
        cycles, number = np.unique(np.nan_to_num(series.power_cycle[valid], nan=-1.0), return_inverse=True)
        table = np.column_stack([series.time, target, design])[valid]
        table = np.hstack([table, np.eye(len(cycles))[number]])  # a level for each power cycle
        # Average neighbours, never across a gap.
        piece = np.cumsum(np.diff(table[:, 0], prepend=table[0, 0]) > FILTER_GAP_INTERVALS * step)
        first = np.flatnonzero(np.diff(piece, prepend=-1))
        group = piece * len(table) + (np.arange(len(table)) - first[piece]) // many
        _, starts, counts = np.unique(group, return_index=True, return_counts=True)
        table = np.add.reduceat(table, starts, axis=0) / counts[:, None]
        family = _prior_family(channels, len(cycles), fixed_lag=fixed_lag)
        known = tuple(None if label < 0.0 else int(label) for label in cycles.tolist())
        return _ScalarProblem(table[:, 0], table[:, 1], table[:, 2:], family, many * step, known, many)

    def part(self, kept: BoolArray) -> _ScalarProblem:
        """Return the problem of some samples."""
        return replace(self, time=self.time[kept], target=self.target[kept], design=self.design[kept])

    def whiten(self, log_noise: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the whitened target and design, and the log of the noise's determinant.

        Notes
        -----
        With B (n, q) the filtered effect of the initial state's remainder in units of its 1-sigma, what the
        filter leaves of the noise has the covariance ``1 + B B^T``. Its inverse square root is ``1 - B V f(s)
        V^T B^T``, with ``B^T B = V s V^T`` and ``f(s) = (1 - (1 + s)^-1/2) / s``.
        """
        slow = _SlowNoise.build(log_noise, self.interval)
        both = np.column_stack([self.target, self.design])
        log_det = len(both) * float(np.log(slow.variance))
        gaps = np.flatnonzero(np.diff(self.time) > FILTER_GAP_INTERVALS * self.interval) + 1
        for segment in starmap(slice, pairwise([0, *gaps.tolist(), len(both)])):
            initial = slow.initial_effect(self.time[segment] - self.time[segment.start])
            filtered = sosfilt(slow.sections, np.column_stack([both[segment], initial]), axis=0)
            filtered /= np.sqrt(slow.variance)
            rows, B = filtered[:, : both.shape[1]], filtered[:, both.shape[1] :]
            s, V = np.linalg.eigh(B.T @ B)
            s = np.maximum(s, 1e-12)
            BV = B @ V
            both[segment] = rows - BV @ (((1.0 - 1.0 / np.sqrt(1.0 + s)) / s)[:, None] * (BV.T @ rows))
            log_det += float(np.log1p(s).sum())
        return both[:, 0], both[:, 1:], log_det

    def information(self, log_noise: FloatArray) -> tuple[GaussianInformation, float] | None:
        """Return the information of the whitened samples, and the cost of the noise itself.

        None if the noise has no stable whitening filter.
        """
        try:
            y, X, log_det = self.whiten(log_noise)
        except ValueError:  # scipy: the Riccati equation is ill-conditioned
            return None
        if not np.isfinite(X).all():
            return None
        data = GaussianInformation(X.T @ X, X.T @ y, float(y @ y))
        return data, 0.5 * log_det - _log_noise_prior(log_noise)

    def posterior(self, log_noise: FloatArray, log_widths: FloatArray) -> _Posterior | None:
        """Return the posterior given the noise, with the widths that maximise the evidence, or None."""
        given = self.information(log_noise)
        if given is None:
            return None
        found = _choose_widths(given[0], self.family, log_widths)
        return replace(found, log_noise=log_noise, cost=found.cost + given[1])

    def slope(self, state: _Posterior, upper: FloatArray) -> FloatArray:
        """Return the gradient of the cost by the noise, whose values may not exceed `upper`.

        Notes
        -----
        By the envelope theorem the widths at their maximum stay as they are: their own change adds nothing.
        """
        slope = np.zeros(len(state.log_noise))
        for k in range(len(slope)):
            moved = state.log_noise.copy()
            moved[k] += NOISE_STEP if moved[k] + NOISE_STEP <= upper[k] else -NOISE_STEP
            given = self.information(moved)
            if given is not None:
                evidence, _, _ = log_evidence(given[0], self.family, state.log_widths, 0.0)
                slope[k] = (given[1] - evidence - state.cost) / (moved[k] - state.log_noise[k])
        return slope

    def optimise(self, *, map_known: bool, start: FloatArray | None) -> _Posterior:
        """Maximise the evidence over the noise, and for each noise over the widths."""
        warm = self.family.centre
        best: _Posterior | None = None

        # A time scale beyond these limits is white noise or part of the level; its filter would be unstable.
        limits = [(-9.0, 9.0)] * (1 + len(TIME_CONSTANTS_S))
        limits += [(-3.0, 7.0), (-3.0, 7.0), (float(np.log(2.0 * self.interval)), LOG_LONGEST_CRUST)]

        def cost(log_noise: FloatArray) -> tuple[float, FloatArray]:
            nonlocal warm, best
            state = self.posterior(log_noise, warm)
            if state is None:
                return REFUSED_COST, np.zeros(len(log_noise))
            if best is None or state.cost < best.cost:
                best, warm = state, state.log_widths
            return state.cost, self.slope(state, np.array(limits)[:, 1])

        def search(start: FloatArray, iterations: int) -> FloatArray:
            found = minimize(
                cost, start, jac=True, method="L-BFGS-B", bounds=limits[: len(start)],
                options={"maxiter": iterations, "ftol": 1e-6},
            )  # fmt: skip
            return np.asarray(found.x)

        if start is None:
            # logs of the amplitudes, nT, and of the crustal time scale, s
            white = np.log(max(robust_scale(np.diff(self.target) / np.sqrt(2.0)), 1e-3))
            crust = [] if map_known else LOG_CRUST_CENTRES
            for amplitude in NOISE_STARTS_NT:
                slow = np.full(len(TIME_CONSTANTS_S), np.log(amplitude))
                warm = self.family.centre
                search(np.concatenate([[white], slow, crust]), START_ITERATIONS)
            assert best is not None
            start = best.log_noise
        search(start, EVIDENCE_ITERATIONS)
        assert best is not None
        return best

    def outliers(self, state: _Posterior, kept: BoolArray) -> BoolArray:
        """Return samples (n,) whose whitened residual is far too large, with their neighbours."""
        part = self.part(kept)
        y, X, _ = part.whiten(state.log_noise)
        residual = y - X @ state.mean
        large = np.abs(residual) > OUTLIER_INNOVATION_SIGMA * max(robust_scale(residual), 1.0)
        padded = np.convolve(large, np.ones(2 * OUTLIER_PAD + 1), mode="same") > 0.5
        out = np.zeros(len(kept), bool)
        out[np.flatnonzero(kept)[padded]] = True
        return out


def _choose_widths(data: GaussianInformation, family: PriorFamily, log_widths: FloatArray) -> _Posterior:
    """Maximise the evidence over the widths, given the information of the whitened samples."""

    def downhill(logs: FloatArray) -> tuple[float, FloatArray]:
        value, slope, _ = log_evidence(data, family, logs, 0.0)
        return (-value if np.isfinite(value) else REFUSED_COST), -slope[:-1]

    found = minimize(
        downhill, log_widths, jac=True, method="L-BFGS-B", bounds=[LOG_WIDTH_LIMITS] * len(log_widths),
        options={"maxiter": 60},
    )  # fmt: skip
    sigma = family.widths(found.x)
    mean, covariance = _coefficients(data, sigma)
    return _Posterior(found.x, sigma, mean, covariance, float(found.fun), np.empty(0))


def _coefficients(data: GaussianInformation, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the posterior mean (m,) and covariance (m, m) of the coefficients for a prior's 1-sigma (m,)."""
    covariance = covariance_of(data.precision + np.diag(sigma**-2.0))
    return covariance @ data.vector, covariance


def _marginal(sensor: ScalarSensor, data: GaussianInformation) -> ScalarSensor:
    """Return the sensor with the covariance that the uncertainty of its prior's widths adds.

    Notes
    -----
    A channel that hardly moved in the fitted log has a width that only its prior limits, so the covariance at
    the most probable widths is too small. The law of total covariance, ``E[C] + cov[mean] - C(mode)``, is
    summed over one width after another on a grid, the others at their mode (Rasmussen & Williams, sec. 5.2).
    """
    family, log_widths = _sensor_prior(sensor)
    _, at_mode = _coefficients(data, family.widths(log_widths))
    added = np.zeros_like(at_mode)
    for index in np.flatnonzero(family.spread):
        grid = np.tile(log_widths, (len(WIDTH_GRID_SIGMA), 1))
        grid[:, index] = family.centre[index] + family.spread[index] * WIDTH_GRID_SIGMA
        log_probability = np.array([log_evidence(data, family, logs, 0.0)[0] for logs in grid])
        weight = np.exp(log_probability - log_probability.max())
        weight /= weight.sum()
        means, covariances = zip(*(_coefficients(data, family.widths(logs)) for logs in grid), strict=True)
        offset = np.array(means) - weight @ np.array(means)
        added += np.tensordot(weight, np.array(covariances), 1) - at_mode
        added += (weight[:, None] * offset).T @ offset
    # The widths that were chosen are less probable than narrower ones: the sum may be slightly negative.
    size, axes = np.linalg.eigh(added)
    added = (axes * np.maximum(size, 0.0)) @ axes.T
    return msgspec.structs.replace(sensor, width_covariance=tuple(map(tuple, added.tolist())))


def _has_fixed_lag(sensor: ScalarSensor) -> bool:
    return sensor.prior_sigma[LAG] < 1e-6


def _sensor_prior(sensor: ScalarSensor) -> tuple[PriorFamily, FloatArray]:
    """Return the prior of a sensor's coefficients, and the log widths that the fit chose."""
    cycles = len(sensor.power_cycles)
    family = _prior_family(sensor.channels, cycles, fixed_lag=_has_fixed_lag(sensor))
    return family, np.log(np.array(sensor.prior_sigma)[family.design.argmax(axis=0)])


def adapt_to_log(sensor: ScalarSensor, channels: FloatArray) -> ScalarSensor:
    """Return the sensor with the priors of its channels for one swing over the fitted and another log.

    `channels` (n, k) are those of the log to be corrected; NaN where unknown.

    Notes
    -----
    The data's information about the coefficients, ``P - 1 / prior^2`` and ``P mean``, is unchanged; a
    channel's coefficients are per unit of its new swing, and the widths maximise the evidence again. A
    channel that hardly moved in the fitted log and moves far in this one thus has a large sigma.
    """
    factor, wider = np.ones(len(sensor.coefficients)), list(sensor.channels)
    for k, channel in enumerate(sensor.channels):
        values = channels[np.isfinite(channels[:, k]), k]
        if len(values):
            low, high = _quantiles(values)
            quantiles = min(channel.quantiles[0], low), max(channel.quantiles[1], high)
            wider[k] = msgspec.structs.replace(channel, quantiles=quantiles)
            columns = slice(PLATFORM_TERMS + 3 * k, PLATFORM_TERMS + 3 * k + 3)
            factor[columns] = channel.scale / wider[k].scale
    if (factor == 1.0).all():
        return sensor
    mean, covariance, prior = map(np.array, (sensor.coefficients, sensor.covariance, sensor.prior_sigma))
    known = GaussianInformation.from_posterior(mean, covariance, 0.0 * mean, np.diag(prior**2))
    data = GaussianInformation(known.precision * np.outer(factor, factor), known.vector * factor)
    chosen = _choose_widths(data, *_sensor_prior(sensor))
    adapted = msgspec.structs.replace(
        sensor,
        channels=tuple(wider),
        coefficients=tuple(chosen.mean.tolist()),
        covariance=tuple(map(tuple, chosen.covariance.tolist())),
        prior_sigma=tuple(chosen.prior_sigma.tolist()),
    )
    return _marginal(adapted, data)


def _log_noise_prior(log_noise: FloatArray) -> float:
    """Return the log of the hyperparameters' prior: process widths vary smoothly with their scale."""
    white, processes = log_noise[0], log_noise[1 : 1 + len(TIME_CONSTANTS_S)]
    value = ((white - LOG_PROCESS_CENTRE) / LOG_PROCESS_SPREAD) ** 2
    value += ((processes[0] - LOG_PROCESS_CENTRE) / LOG_PROCESS_SPREAD) ** 2
    value += float((np.diff(processes) ** 2).sum()) / LOG_PROCESS_STEP**2
    crust = log_noise[1 + len(TIME_CONSTANTS_S) :]
    if len(crust):
        value += float((((crust - LOG_CRUST_CENTRES) / LOG_CRUST_SPREAD) ** 2).sum())
    return -0.5 * float(value)


def _prior_family(channels: tuple[ScalarChannel, ...], levels: int, *, fixed_lag: bool) -> PriorFamily:
    """Return the prior of the coefficients: free widths, except for the lag and the levels."""
    widths = {name: (centre, LOG_WIDTH_SIGMA) for name, centre in WIDTH_CENTRES_NT.items()}
    widths["lag"] = 1e-9 if fixed_lag else LAG_SIGMA_S, 0.0
    blocks = []
    for name, columns in term_columns(channels).items():
        width, spread = widths.get(name, (CHANNEL_WIDTH_NT, LOG_CHANNEL_WIDTH_SIGMA))
        size = columns.stop - columns.start
        blocks.append(ParameterBlock(name, np.empty((0, size)), np.ones(size), width, spread))
    blocks.append(ParameterBlock("level", np.empty((0, levels)), np.ones(levels), CYCLE_LEVEL_SIGMA_NT))
    return with_blocks(NO_COEFFICIENTS, tuple(blocks))


def _slow_variances(log_noise: FloatArray) -> FloatArray:
    """Return the variance of every slow process, nT^2; the crustal ones last where there are any."""
    many = len(TIME_CONSTANTS_S)
    crust = log_noise[1 + many : -1] if len(log_noise) > 1 + many else log_noise[:0]
    return np.asarray(np.exp(2.0 * np.concatenate([log_noise[1 : 1 + many], crust])))


@dataclass(frozen=True, eq=False)
class _SlowNoise:
    """Whitening filter of white noise and slow processes.

    Notes
    -----
    State space of the slow processes, ``x' = A x + w, y = C x + v``. The discrete algebraic Riccati equation
    gives the steady prediction covariance P, ``S = C P C^T + sigma^2``, ``K = A P C^T / S``. The
    innovations are the output of a filter with the zeros eig(A) and the poles eig(A - K C).
    """

    sections: FloatArray
    """Second-order sections of the filter."""
    variance: float
    """nT^2, of the innovations."""
    remainder: FloatArray
    """(q, q), square root of the initial state's covariance beyond P."""
    crust_lengths: tuple[float, ...]
    """Time scales of the crustal processes, s."""

    @staticmethod
    def build(log_noise: FloatArray, interval: float) -> _SlowNoise:
        """Return the filter for the logs of the noise's amplitudes, nT."""
        variances = _slow_variances(log_noise)
        decay = np.exp(-interval / np.array(TIME_CONSTANTS_S))
        stationary = np.diag(variances[: len(decay)])
        A, Q, zeros, C = np.diag(decay), stationary * (1.0 - decay**2), decay, np.ones(len(decay))
        lengths: list[float] = []
        for variance_m in variances[len(decay) :].tolist():
            lengths.append(float(np.exp(log_noise[-1])) * CRUST_SCALE_RATIO ** len(lengths))
            A_m, Q_m, P_m = _matern_transition(lengths[-1], variance_m, interval)
            A, Q, stationary = block_diag(A, A_m), block_diag(Q, Q_m), block_diag(stationary, P_m)
            # The triple eigenvalue of A_m is known; computed, it would lose two thirds of its digits.
            zeros = np.append(zeros, np.full(3, np.exp(-np.sqrt(5.0) / lengths[-1] * interval)))
            C = np.append(C, [1.0, 0.0, 0.0])
        white = float(np.exp(2.0 * log_noise[0]))
        P = solve_discrete_are(A.T, C[:, None], Q + 1e-12 * np.eye(len(Q)), np.array([[white]]))
        variance = float(C @ P @ C) + white
        K = A @ P @ C / variance
        sections = np.hstack([_quadratics(zeros), _quadratics(np.linalg.eigvals(A - np.outer(K, C)))])
        size, axes = np.linalg.eigh(stationary - P)
        return _SlowNoise(sections, variance, axes * np.sqrt(np.maximum(size, 0.0)), tuple(lengths))

    def initial_effect(self, elapsed: FloatArray) -> FloatArray:
        """Return the effect (n, q) of the initial state's remainder, nT, `elapsed` (n,) s after it: C A^t."""
        effect = np.exp(-elapsed[:, None] / np.array(TIME_CONSTANTS_S))
        for length in self.crust_lengths:
            x = np.sqrt(5.0) / length * elapsed
            row = np.exp(-x)[:, None] * np.stack([1.0 + x + 0.5 * x * x, x + x * x, 0.5 * x * x], axis=1)
            effect = np.hstack([effect, row])
        return np.asarray(effect @ self.remainder)


def _quadratics(roots: FloatArray) -> FloatArray:
    """Return the polynomials (n / 2, 3) whose product has the real roots and conjugate pairs (n,)."""
    # complex roots first, conjugates adjacent; all sections are stable in any pairing
    roots = roots[np.lexsort((roots.real, np.isreal(roots)))]
    a, b = roots[::2], roots[1::2]
    return np.stack([np.ones(len(a)), -(a + b).real, (a * b).real], axis=1)


def _matern_transition(
    length: float, variance: float, interval: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return transition, process noise and stationary covariance of a Matern process of smoothness 5/2.

    Notes
    -----
    ``lambda = sqrt(5) / l``; ``A = exp(F dt)`` with F the companion matrix of ``(s + lambda)^3``; ``Q = P -
    A P A^T`` with the stationary covariance P (Hartikainen & Sarkka 2010, doi:10.1109/MLSP.2010.5589113).
    """
    # Derivatives in units of lambda and lambda^2: all entries are of the order of 1, whatever the scales are.
    x = np.sqrt(5.0) / length * interval
    N = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [-1.0, -3.0, -2.0]])  # F / lambda + 1; N^3 = 0
    A = np.exp(-x) * (np.eye(3) + x * N + 0.5 * x * x * N @ N)
    P = variance * np.array([[1.0, 0.0, -1.0 / 3.0], [0.0, 1.0 / 3.0, 0.0], [-1.0 / 3.0, 0.0, 1.0]])
    Q = P - A @ P @ A.T + ROUNDING * variance * np.eye(3)
    return A, 0.5 * (Q + Q.T), P


def _result(
    problem: _ScalarProblem,
    kept: BoolArray,
    state: _Posterior,
    series: ScalarSeries,
    column: str,
    channels: tuple[ScalarChannel, ...],
    lever: tuple[float, float, float],
    shift: float,
) -> ScalarFit:
    """Return the fit with its sensor, RMS before and after, and contributions."""
    part = problem.part(kept)
    residual = part.target - part.design @ state.mean
    columns = term_columns(channels) | {"level": slice(PLATFORM_TERMS + 3 * len(channels), None)}
    contribution = {
        name: float(np.std(part.design[:, term] @ state.mean[term])) for name, term in columns.items()
    }
    # The lag that remains is small, so that moving the reading by both is the same as its linear term.
    mean, total_lag = state.mean.copy(), shift - float(state.mean[LAG])
    mean[LAG] = 0.0
    contribution["lag"] = abs(total_lag) * float(np.std(part.design[:, LAG]))
    averaged_white = float(np.exp(state.log_noise[0]))
    variances = _slow_variances(state.log_noise)[: len(TIME_CONSTANTS_S)]
    sensor = ScalarSensor(
        kind="scalar",
        column=column,
        directions_from="vector",
        reference_field=float(np.median(series.reference[np.isfinite(series.reference)])),
        channels=channels,
        coefficients=tuple(mean.tolist()),
        lag=total_lag,
        covariance=tuple(map(tuple, state.covariance.tolist())),
        prior_sigma=tuple(state.prior_sigma.tolist()),
        noise=ScalarNoise(
            averaged_white * float(np.sqrt(problem.averaged)), problem.interval / problem.averaged,
            TIME_CONSTANTS_S, tuple(np.sqrt(variances).tolist()),
        ),
        power_cycles=problem.cycles,
        fitted_from=float(part.time[0]),
        fitted_until=float(part.time[-1]),
        lever=lever,
        slow_variance=float(variances.sum()),  # a log of another time has other values of all processes
    )  # fmt: skip
    y, X, _ = part.whiten(state.log_noise)
    sensor = _marginal(sensor, GaussianInformation(X.T @ X, X.T @ y))
    return ScalarFit(
        sensor, float(np.std(part.target)), float(np.std(residual)), contribution,
        int((~kept).sum()) * problem.averaged, float(np.nanmedian(series.scalar - series.reference)),
        _findings(sensor, contribution, channels),
    )  # fmt: skip
