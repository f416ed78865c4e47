"""The evidence for each candidate, its significance test, and which causes a log can show or distinguish.

Notes
-----
*Information.* The inner products of the whitened columns of all candidates form one matrix, which the whole
search uses.

*Score.* A candidate with score b and information S, the calibration projected out, has the likelihood ratio
``R = b^T S^-1 b`` to second order. Its k coefficients have Zellner's prior ``N(0, g S^-1)`` with the
likeliest g. The log evidence is ``(R - k)/2 - (k/2) log(R/k)``, 0 below ``R = k`` (Liang et al. 2008, JASA
103:410, sec. 2.4).

*Test.* A cause's p-value is the p-value of its likelihood ratio, times the number N of independent hypotheses
of the cause, times the number of causes. The cause is found if the product is below 1 %. Without an effect
the scores are ``N(0, S)``. N is ``P(any of the n hypotheses passes) / a`` with a the level at which each is
tested. Importance sampling makes each hypothesis in turn pass and counts the m that pass then: ``N = n E[1 /
m]`` (Owen, Maximov & Chertkov 2019, Electron. J. Statist. 13:231).

Two kinds of coefficients have another prior. For coefficients of one common size (:mod:`.joint`) the ratio
contains the prior, and the log evidence is R / 2, less the log of the number of spectra that were tried. A
coefficient that cannot be negative has half a Gaussian, of twice the density, which adds
``log 2 Phi(sqrt(R))``.

*Isolability.* An effect of signal-to-noise a is found with the probability that a noncentral chi-square of k
degrees of freedom and noncentrality ``a^2`` exceeds the threshold. If the signatures of two causes have the
correlation rho, the wrong cause wins with the probability ``Phi(-a sqrt(1 - rho^2) / 2)``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.special import chdtri, chndtrinc, log_ndtr
from scipy.stats import chi2

from magbridge.arrays import FloatArray, IndexArray
from magbridge.diagnose.columns import Candidate, Columns, Group, join_columns, parts, places, slices
from magbridge.diagnose.joint import ALL_PRODUCTS, Joint, Statistic, normal, volume_of
from magbridge.diagnose.noise import ResidualNoise
from magbridge.diagnose.problem import Problem, side_by_side

FALSE_ALARM_RATE = 0.01
"""Probability of any false finding in a log without faults (family-wise)."""
ODDS = float(np.log(20.0))
"""Log odds of 20:1, by which a cause with an exact regressor excludes a competing one."""
IDEAL = 0.2
"""Assumed error of an idealised regressor, as a fraction of its norm."""
REMNANT = 0.3
"""Fraction of the strongest cause's signal-to-noise, below which another signal may be its remnant."""
SMOOTH, MOST_REMAINING = 0.1, 8.0
"""Replacement of :data:`REMNANT` for a Gaussian process, and largest signal-to-noise of its remnant."""
SIMULATIONS = 400
CONFOUNDED = 0.85
"""Correlation above which two causes are listed as a pair; at S/N 6 it leaves 5 % of cases confused."""
MAX_PLAUSIBLE_MULTIPLE = 50.0
"""Multiple of its plausible size from which on an effect is impossible."""
FREE = 1e-3
"""Prior precision of free coefficients in :func:`likeness`, in units of their widths."""


@dataclass(frozen=True, eq=False)
class Information:
    """Score and Fisher information of m coefficients, with calibration (and any model) projected out."""

    matrix: FloatArray
    """(m, m) Fisher information, in units of the prior widths."""
    score: FloatArray
    """(m,) score of the coefficients."""
    shift: FloatArray
    """(q + k, m) decrease of the coefficients of calibration and model per unit of each coefficient."""

    def moved(self, base: Joint, places: slice | IndexArray, taken: FloatArray) -> FloatArray:
        """Return the likeliest coefficients (q + k,) of calibration and model, given `taken` at `places`."""
        return np.append(base.z, base.coefficients) - self.shift[:, places] @ taken

    def fitted(self, base: Joint) -> Information:
        """Return the information with the model of `base`, whose columns are the last, also projected out."""
        m = len(self.score) - base.coefficients.size
        prior = base.prior[len(base.z) :]
        K = np.asarray(np.linalg.solve(self.matrix[m:, m:] + np.diag(prior), self.matrix[m:, :m]), float)
        return Information(
            self.matrix[:m, :m] - self.matrix[:m, m:] @ K,
            self.score[:m] - K.T @ (self.score[m:] - prior * base.coefficients),
            np.vstack([self.shift[:, :m] - self.shift[:, m:] @ K, K]),
        )

    def released(self, base: Joint, *places: slice) -> Information:
        """Return the information without these coefficients of `base`, the others projected out."""
        first, own = len(self.score) - base.coefficients.size, np.r_[*places]
        others = np.setdiff1d(np.arange(first, len(self.score)), own)
        S = self.matrix[np.ix_(others, others)] + np.diag(base.prior[len(base.z) + others - first])
        K = np.linalg.solve(S, self.matrix[others])
        matrix, b = self.matrix - self.matrix[:, others] @ K, self.score - K.T @ self.score[others]
        return Information(matrix, b + matrix[:, own] @ base.coefficients[own - first], self.shift)


def information(
    problem: Problem,
    noise: ResidualNoise,
    base: Joint,
    columns: Sequence[Columns],
    unshared: int = 0,
    stride: int = 1,
) -> Information:
    """Return the information of columns at the fit `base` under `noise`, with the calibration projected out.

    Products of the first `unshared` columns with each other are not computed. With a `stride` k, only every
    k-th piece of the log counts.
    """
    # Sums are taken over the distinct parts X_i; the candidates are their mixtures X_i M_i
    q, shared = len(problem.centre), join_columns(columns).parts
    alone = places((sum(len(M) for _, M in parts(one)) for one in columns[:unshared]), q)
    others = slice(alone[-1].stop if alone else q, None)
    asked = [(slice(q), slice(None)), *zip(alone, alone, strict=True), (others, slice(q, None))]
    G, b = normal(
        lambda rows: side_by_side([problem.calibration_rows(rows), *(X(rows) for X, _ in shared)]),
        noise.response(base.residual),
        noise,
        asked if unshared else ALL_PRODUCTS,
        stride,
    )
    # Project the calibration out, with its prior: S = G_bb - G_bq (G_qq + prior)^-1 G_qb
    pull = base.prior[:q] * (problem.centre - base.z)
    K = np.linalg.solve(G[:q, :q] + np.diag(base.prior[:q]), G[:q, q:])
    M = csr_array(np.concatenate([M for _, M in shared]))
    return Information(
        M.T @ (G[q:, q:] - G[q:, :q] @ K) @ M, M.T @ (b[q:] - K.T @ (b[:q] + pull)), np.asarray(K @ M)
    )


class Score(NamedTuple):
    """Likelihood ratio, degrees of freedom, log evidence and estimate (k,) of a candidate under a noise."""

    ratio: float
    freedom: int
    evidence: float
    estimate: FloatArray


def score(info: Information, place: slice, candidate: Candidate) -> Score:
    """Return the score of the candidate whose columns are at `place`; zero if its sign is impossible."""
    # A size that cannot be negative has no evidence where its score is negative
    b, statistic = info.score[place], Statistic(info.matrix[place, place], candidate.spectra)
    freedom = statistic.freedom
    if not freedom or (candidate.positive and b.min() < 0.0):
        return Score(0.0, freedom, 0.0, np.zeros(len(b)))
    if candidate.spectra is not None:
        best = statistic.best(b)
        return Score(best.ratio, freedom, evidence_of(candidate, best.ratio, freedom), best.estimate)
    ratio, values, V = float(statistic.ratio(b[:, None])[0]), statistic.values, statistic.vectors
    estimate = V @ ((V.T @ b) / (values + 1.0))
    return Score(ratio, freedom, evidence_of(candidate, ratio, freedom), estimate)


def evidence_of(candidate: Candidate, ratio: float, freedom: int) -> float:
    """Return the log evidence of a candidate's likelihood ratio, under the prior of its coefficients."""
    if candidate.spectra is not None:
        return 0.5 * ratio - float(np.log(len(candidate.spectra)))
    sided = float(one_sided(ratio)) if candidate.positive else 0.0
    return float(log_bayes(ratio, freedom)) + sided + candidate.point.likelier


def log_bayes(ratio: float | FloatArray, freedom: float | FloatArray) -> FloatArray:
    """Return the log Bayes factor (...,) against no effect for likelihood ratios (...,) and freedoms."""
    # (R - k)/2 - (k/2) log(R/k), and 0 below R = k: Zellner's prior with the likeliest g
    over = np.maximum(ratio / np.maximum(freedom, 1e-12), 1.0)
    return np.asarray(0.5 * freedom * (over - 1.0 - np.log(over)))


def one_sided(ratio: float | FloatArray) -> FloatArray:
    """Return the log evidence (...,) that the constraint to a nonnegative coefficient adds."""
    return np.asarray(np.log(2.0) + log_ndtr(np.sqrt(ratio)))


def bayes_factor_threshold(ratio: float) -> float:
    """Return the margin in log evidence by which a cause of this likelihood ratio excludes another one."""
    return ODDS + regressor_error(ratio)


def regressor_error(ratio: float) -> float:
    """Return the log evidence that another cause may gain from the regressor errors of a model."""
    return 0.5 * IDEAL**2 * ratio


def look_elsewhere_factors(
    info: Information, candidates: Sequence[Candidate], places: Sequence[slice]
) -> dict[str, float]:
    """Return the number of independent hypotheses of each cause (module notes), by its name."""
    causes = dict.fromkeys(candidate.cause for candidate in candidates)
    found = {}
    for cause in causes:
        members = [k for k, candidate in enumerate(candidates) if candidate.cause == cause]
        index, own = np.r_[*(places[k] for k in members)], slices([candidates[k] for k in members])
        free = [place for k, place in zip(members, own, strict=True) if candidates[k].spectra is None]
        count = _independent(info.matrix[np.ix_(index, index)], free, FALSE_ALARM_RATE / len(causes))
        # candidates of one common size count as independent: an upper bound
        count += len(members) - len(free)
        found[cause] = max(1.0, count) * max(candidates[k].look_elsewhere for k in members)
    return found


def _independent(S: FloatArray, places: Sequence[slice], level: float) -> float:
    """Return the number of independent hypotheses that pass as often as any hypothesis at `places`.

    S is the information of all their coefficients, and `level` the level of their joint test.
    """
    # Draws of the scores N(0, S) under no effect
    rng = np.random.default_rng(20131212)  # the same answer every time
    values, vectors = np.linalg.eigh(S)
    draws = (vectors * np.sqrt(np.maximum(values, 0.0))) @ rng.standard_normal((len(S), SIMULATIONS))
    every = [(place, Statistic(S[place, place])) for place in places]
    seen = [(place, statistic) for place, statistic in every if statistic.freedom]
    if not seen:
        return 0.0
    # Importance sampling: each hypothesis in turn is moved beyond its limit, then those that pass are counted
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
    # N = n E[1 / m] (Owen, Maximov & Chertkov 2019)
    return len(seen) * float(np.mean(1.0 / np.sum(passed, axis=0)))


def log_odds(
    ratio: float, model: Sequence[Candidate], look_elsewhere: Mapping[str, float], shaped: float
) -> float:
    """Return the log posterior odds of a model of this likelihood ratio against no effect.

    `shaped` is the part of the ratio that causes of flexible shape do not explain (:func:`.shaped_ratio`).
    The number of hypotheses of each regressor's cause is a penalty. Each regressor after the first adds the
    prior odds of a further fault, and of its choice among the causes.
    """
    regressors, free = sum(len(c.pieces) for c in model), sum(c.size for c in model if c.spectra is None)
    # Price of each further regressor, of the grids, and of the spectra that were tried
    further = max(regressors - 1, 0) * (ODDS + float(np.log(len(look_elsewhere))))
    prices = sum(len(c.pieces) * float(np.log(look_elsewhere[c.cause])) for c in model)
    prices += sum(float(np.log(len(c.spectra))) for c in model if c.spectra is not None)
    known = sum(c.point.likelier + float(np.log(2.0)) * c.positive for c in model)
    # A Gaussian process has paid for its size already; the others pay by the part that it leaves
    worth = float(log_bayes(shaped, free)) if free else 0.5 * shaped
    return 0.5 * (ratio - shaped) + worth + known - further - prices


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A cause, fitted jointly with the other causes of a model, and its test."""

    candidate: Candidate
    ratio: float
    """Twice the gain in log likelihood by this cause."""
    evidence: float
    """Log Bayes factor against the model without it."""
    p_value: float
    """p-value, times the hypotheses of the cause (look-elsewhere) and the number of causes."""
    fit: Joint
    """Fit of the whole model; this cause's coefficients are the last."""

    @property
    def signal_to_noise(self) -> float:
        """Whitened norm of the effect beyond calibration and model, less the expected norm of noise."""
        own = slice(-self.candidate.size, None)
        known = self.fit.prior[own] * np.diag(self.fit.covariance)[own]
        power = self.fit.wald(own) - float(np.sum(1.0 - known))
        return float(np.sqrt(power)) if power > 0.0 else 0.0


class Best(NamedTuple):
    """The best candidate of a grid under one noise."""

    place: int
    """Index among all candidates."""
    price: float
    """Log of the average evidence of the grid, relative to the best candidate."""
    score: Score
    info: Information


def shaped_ratio(ratio: float, model: Sequence[Candidate], fit: Joint, *, slow: bool = False) -> float:
    """Return the part of a model's likelihood `ratio` that its causes of flexible shape do not explain."""
    free = np.repeat([one.nonparametric for one in model], [one.size for one in model])
    return min(ratio, fit.wald(np.flatnonzero(~free))) if slow or free.any() else ratio


def wald_ratio(fit: Joint, candidate: Candidate) -> float:
    """Return the likelihood ratio of a fit's last candidate, under the noise of that fit."""
    own = slice(-candidate.size, None)
    spread = 0.0 if candidate.spectra is None else volume_of(fit.covariance[own, own], fit.prior[own])
    return fit.wald(own) - 2.0 * spread


class Visible(NamedTuple):
    """Smallest sizes at which one cause is found."""

    cause: str
    channel: str | None
    sizes: dict[str, tuple[float, str]]
    """Size found with 95 % probability, and its unit, by coefficient; infinite if a log cannot show it."""


@dataclass(frozen=True)
class Isolability:
    """The causes that a log can show and distinguish, by its design matrix alone."""

    visible: tuple[Visible, ...]
    pairs: tuple[tuple[Visible, Visible, float], ...]
    """Pairs of causes with correlated effects, and their correlation."""
    untestable: dict[str, str]
    """Content that a test needs and this log lacks, by cause."""


def isolability(
    candidates: Sequence[Candidate],
    info: Information,
    look_elsewhere: Mapping[str, float],
    causes: int,
    untestable: Mapping[str, str],
) -> Isolability:
    """Return what the log can show by `info`, with the most visible candidate of each cause and channel."""
    at, visible, alike = slices(candidates), {}, []
    # One candidate for each cause and channel, with the price of all hypotheses behind it
    for k in most_visible(candidates, info, at):
        count = candidates[k].tail * causes * look_elsewhere.get(candidates[k].cause, 1.0)
        visible[k] = _visible(candidates[k], info, at[k], count)
    for (a, one), (b, other) in combinations(visible.items(), 2):
        rho = likeness(info, candidates[a], at[a], candidates[b], at[b])
        if one.cause != other.cause and rho > CONFOUNDED:
            alike.append((one, other, rho))
    alike.sort(key=lambda pair: -pair[2])
    return Isolability(tuple(visible.values()), tuple(alike), dict(untestable))


def most_visible(candidates: Sequence[Candidate], info: Information, places: Sequence[slice]) -> list[int]:
    """Return the index of the most visible candidate of each cause and channel."""
    best: dict[Group, tuple[float, int]] = {}
    for k, candidate in enumerate(candidates):
        total = float(np.trace(info.matrix[places[k], places[k]])) / candidate.size
        if total > best.get(candidate.group, (-1.0, 0))[0]:
            best[candidate.group] = (total, k)
    return [k for _, k in best.values()]


def _visible(candidate: Candidate, info: Information, place: slice, hypotheses: float) -> Visible:
    """Return the sizes at which a candidate is found that is chosen from a number of `hypotheses`."""
    # Noncentrality at which a noncentral chi-square passes the threshold in 95 %
    freedom = max(score(info, place, candidate).freedom, 1)
    sure = float(np.sqrt(chndtrinc(chdtri(freedom, FALSE_ALARM_RATE / hypotheses), freedom, 0.05)))
    power = np.diag(info.matrix[place, place])
    names, widths, units = candidate.names, candidate.width, candidate.units
    if candidate.spectra is not None:  # what counts is what all of them do together
        power, names, widths, units = (
            power.sum(keepdims=True),
            ("size",),
            np.ones(1),
            ("times the usual one",),
        )
    # Infinite where nothing plausible would show
    size = sure / np.sqrt(np.maximum(power, 1e-300))
    size = np.where(size < MAX_PLAUSIBLE_MULTIPLE, size * widths, np.inf).tolist()
    return Visible(
        candidate.cause, candidate.channel, dict(zip(names, zip(size, units, strict=True), strict=True))
    )


def likeness(info: Information, first: Candidate, a: slice, second: Candidate, b: slice) -> float:
    """Return the correlation of two signatures: root of the larger power fraction that one imitates."""
    # Share of A's power that B imitates, C B^-1 C^T, and the reverse
    A, B, C = info.matrix[a, a], info.matrix[b, b], info.matrix[a, b]
    p, q = (FREE if candidate.spectra is None else 1.0 for candidate in (first, second))
    M = C @ np.linalg.solve(B + q * np.eye(len(B)), C.T)
    N = C.T @ np.linalg.solve(A + p * np.eye(len(A)), C)
    share = max(np.trace(M) / (np.trace(A) + 1e-12), np.trace(N) / (np.trace(B) + 1e-12))
    return float(np.sqrt(np.clip(share, 0.0, 1.0)))
