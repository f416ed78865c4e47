r"""The evidence for a candidate, its test, and the margin by which it must win.

Notes
-----
*Score.* For a candidate with score b and information S, the calibration projected out (:mod:`.information`),
``R = b^T S^-1 b`` is its likelihood ratio to second order. The size of an effect is not known beforehand, so
its k coefficients have Zellner's prior ``N(0, g S^-1)`` with the likeliest g: log evidence
``(R - k)/2 - (k/2) log(R/k)``, 0 below ``R = k`` (Liang et al. 2008, JASA 103:410, sec. 2.4). Every cause
pays the same price for a coefficient, whatever its unit.

*Test.* A cause's p-value is that of its likelihood ratio, times the number N of independent hypotheses behind
the cause, times the number of causes; it is found if that is below 1 %. Under no effect scores are
``N(0, S)``, and N is ``P(any of its n hypotheses passes) / a`` at the level a at which each is tested: even
hypotheses that correlate strongly are nearly independent far out in the tail. Plain simulation does not reach
that far, so each hypothesis in turn is made to pass, and with m that pass then ``N = n E[1 / m]`` (Owen,
Maximov & Chertkov 2019, Electron. J. Statist. 13:231). A size that cannot be negative has one tail
(:attr:`~magbridge.diagnose.causes.candidates.Candidate.tail`).

Two kinds of coefficients have a prior of their own. For those of one common size (:mod:`.statistic`) the
ratio contains the prior: the evidence is R / 2, less the log of the number of spectra that were tried. One
that cannot be negative has half a Gaussian, of twice the density: ``log 2 Phi(sqrt(R))`` is added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr
from scipy.stats import chi2

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import FLAT_PRECISION
from magbridge.diagnose.inference.noise import Noise
from magbridge.diagnose.inference.statistic import Statistic

__all__ = [
    "FALSE_ALARM_RATE",
    "IDEAL",
    "MOST_REMAINING",
    "ODDS",
    "REMNANT",
    "SMOOTH",
    "Score",
    "bayes_factor_threshold",
    "certainty",
    "evidence_of",
    "log_bayes",
    "log_odds",
    "look_elsewhere_factors",
    "one_sided",
    "regressor_error",
    "score",
]  # fmt: skip

FALSE_ALARM_RATE = 0.01
"""Family-wise false-alarm rate."""
ODDS = float(np.log(20.0))
"""Log evidence by which a cause with an exact regressor must win to be named alone."""
IDEAL = 0.2
"""Error of an idealised regressor, as a share of its norm: a cause that explains less by no more than that
competes with it."""
REMNANT = 0.3
"""Fraction of the strongest cause's signal-to-noise; anything weaker is a remnant of its idealised regressor,
not another cause.

The price: a second cause of so low a signal-to-noise is not named.
"""
SMOOTH, MOST_REMAINING = 0.1, 8.0
"""Fraction (as REMNANT) for a Gaussian process, and the largest signal-to-noise of its remnant: a process has
a flexible shape, but not any shape equally, and the remnant of a map's error is slow in time, too."""
SIMULATIONS = 400
PIECE, PIECES = 600, 64
"""Pieces of a column from which its power spectrum is estimated: their length in samples, and most pieces."""


@dataclass(frozen=True, eq=False)
class Score:
    """Score of a candidate under a noise: likelihood ratio, freedoms, log evidence, estimate, prior."""

    ratio: float
    freedom: int
    evidence: float
    estimate: FloatArray
    prior: FloatArray


def score(info: Information, at: slice, candidate: Candidate) -> Score:
    """Score the candidate whose columns stand at `at`; one of the wrong sign scores zero."""
    b, statistic = info.score[at], Statistic(info.matrix[at, at], candidate.spectra)
    freedom = int(statistic.freedom)
    if not freedom or (candidate.positive and b.min() < 0.0):
        return Score(0.0, freedom, 0.0, np.zeros(len(b)), np.ones(len(b)))
    if candidate.spectra is not None:
        best = statistic.best(b)
        evidence = evidence_of(candidate, best.ratio, freedom)
        return Score(best.ratio, freedom, evidence, best.estimate, 1.0 / best.variance)
    ratio, values, V = float(statistic.ratio(b[:, None])[0]), statistic.values, statistic.vectors
    evidence = evidence_of(candidate, ratio, freedom)
    return Score(ratio, freedom, evidence, V @ ((V.T @ b) / (values + 1.0)), np.full(len(b), FLAT_PRECISION))


def evidence_of(candidate: Candidate, ratio: float, freedom: int) -> float:
    """Log evidence of one candidate's likelihood ratio, by the prior that its numbers have."""
    if candidate.spectra is not None:
        return 0.5 * ratio - float(np.log(len(candidate.spectra)))
    sided = float(one_sided(ratio)) if candidate.positive else 0.0
    return float(log_bayes(ratio, freedom)) + sided + candidate.point.likelier


def log_bayes(ratio: float | FloatArray, freedom: float | FloatArray) -> FloatArray:
    """Log evidence (Bayes factor against no effect) of likelihood ratios (...,) of `freedom` coefficients."""
    over = np.maximum(ratio / np.maximum(freedom, 1e-12), 1.0)
    return np.asarray(0.5 * freedom * (over - 1.0 - np.log(over)))


def one_sided(ratio: float | FloatArray) -> FloatArray:
    """Log evidence (...,) that half a prior of twice the density adds where the estimate has its sign."""
    return np.asarray(np.log(2.0) + log_ndtr(np.sqrt(ratio)))


def bayes_factor_threshold(ratio: float) -> float:
    """Log evidence by which a cause of this likelihood ratio must win to be named alone.

    The error of its regressor is allowed for.
    """
    return ODDS + regressor_error(ratio)


def regressor_error(ratio: float) -> float:
    """Log evidence that another cause may gain from the errors of the regressors in a model of this ratio."""
    return 0.5 * IDEAL**2 * ratio


def look_elsewhere_factors(
    info: Information, candidates: Sequence[Candidate], at: Sequence[slice]
) -> dict[str, float]:
    """Return the number of independent hypotheses behind each cause."""
    causes = dict.fromkeys(candidate.cause for candidate in candidates)
    found = {}
    for cause in causes:
        members = [k for k, candidate in enumerate(candidates) if candidate.cause == cause]
        index, own = np.r_[*(at[k] for k in members)], slices([candidates[k] for k in members])
        free = [place for k, place in zip(members, own, strict=True) if candidates[k].spectra is None]
        count = _independent(info.matrix[np.ix_(index, index)], free, FALSE_ALARM_RATE / len(causes))
        # candidates of one common size count as independent: an upper bound
        count += len(members) - len(free)
        found[cause] = max(1.0, count) * max(candidates[k].look_elsewhere for k in members)
    return found


def _independent(S: FloatArray, places: Sequence[slice], level: float) -> float:
    """Return how many independent hypotheses would pass as often as any of those at `places` does.

    All together they are tested at `level`.
    """
    rng = np.random.default_rng(20131212)  # the same answer every time
    values, vectors = np.linalg.eigh(S)
    draws = (vectors * np.sqrt(np.maximum(values, 0.0))) @ rng.standard_normal((len(S), SIMULATIONS))
    every = [(place, Statistic(S[place, place])) for place in places]
    seen = [(place, statistic) for place, statistic in every if statistic.freedom]
    if not seen:
        return 0.0
    limits = [float(chi2.isf(level / len(seen), statistic.freedom)) for _, statistic in seen]
    for k, (place, statistic) in enumerate(seen):
        some, away = draws[:, k :: len(seen)], statistic.vectors / np.sqrt(statistic.values)
        y = away.T @ some[place]
        tail = level / len(seen) * rng.random(y.shape[1])
        longer = np.sqrt(chi2.isf(tail, statistic.freedom) / np.sum(y * y, axis=0))
        some += S[:, place] @ away @ (y * (longer - 1.0))
    passed = [
        statistic.ratio(draws[place]) >= (1.0 - 1e-9) * limit
        for (place, statistic), limit in zip(seen, limits, strict=True)
    ]
    return len(seen) * float(np.mean(1.0 / np.sum(passed, axis=0)))


def log_odds(
    ratio: float, model: Sequence[Candidate], look_elsewhere: Mapping[str, float], shaped: float
) -> float:
    """Log posterior odds of a whole model of this likelihood ratio against no effect.

    `shaped` is the part of it that causes of flexible shape do not explain (:func:`~.state.shaped_ratio`).
    The size of the remaining causes is judged by that part.

    Every regressor pays for the number of hypotheses of its cause. Each after the first also pays for the
    prior odds of a further fault in one log, and for its choice among the causes. How narrowly the data
    determine nonlinear parameters is not counted here, but only between names: free descriptions are
    profiled, too, and do not pay for it.
    """
    regressors, free = sum(len(c.pieces) for c in model), sum(c.size for c in model if c.spectra is None)
    further = max(regressors - 1, 0) * (ODDS + float(np.log(len(look_elsewhere))))
    prices = sum(len(c.pieces) * float(np.log(look_elsewhere[c.cause])) for c in model)
    prices += sum(float(np.log(len(c.spectra))) for c in model if c.spectra is not None)
    known = sum(c.point.likelier + float(np.log(2.0)) * c.positive for c in model)
    worth = float(log_bayes(shaped, free)) if free else 0.5 * shaped
    return 0.5 * (ratio - shaped) + worth + known - further - prices


def certainty(residual: FloatArray, noise: Noise, columns: Sequence[Columns]) -> list[float]:
    r"""Degrees of freedom of the noise's level at the frequencies where each of `columns` has its power.

    `residual` (n,) is what the noise was fitted to, nT.

    Notes
    -----
    The fitted coefficients a have the covariance ``C = (L^T L)^-1`` of its regression, with L the p preceding
    residuals in units of s. A column x has the information ``|w|^2``,
    ``w_t = x_t - sum_k a_k x_(t-k)``:

    .. math:: D_k = \frac{\partial \ln |w|^2}{\partial a_k} = -\frac{2 \sum_t w_t x_{t-k}}{|w|^2}, \qquad
              \operatorname{var} \ln |w|^2 = \frac{2}{n} + D^T C D

    The log of a variance estimated with f degrees of freedom has the variance 2 / f. At low frequencies the
    level is known worst.
    """
    n, p = len(residual), len(noise.ar)
    rows = np.flatnonzero(noise.past.whole)
    if len(rows) <= 2 * p:
        return [float(n)] * len(columns)
    before = np.array([residual[rows - k] for k in range(1, p + 1)]) / noise.scale[rows]
    C = np.linalg.pinv(before @ before.T)
    pieces = range(0, max(n - PIECE, 0) + 1, max(PIECE, n // PIECES))
    found = []
    for column in columns:
        power, slope = 1e-300, np.zeros(p)
        for start in pieces:
            x = column(slice(start, start + PIECE))
            lags = np.array([x[p - k : len(x) - k] for k in range(1, p + 1)])
            w = x[p:] - np.tensordot(noise.ar, lags, 1)
            power += float(np.sum(w * w))
            slope += np.tensordot(lags, w, 2)
        D = -2.0 * slope / power
        found.append(2.0 / float(2.0 / n + D @ C @ D))
    return found
