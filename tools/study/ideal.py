r"""Compute the performance of an ideal detector that knows the noise and the shape of the hidden effect.

Notes
-----
Let d be the hidden signature and X the columns of all hypotheses, whitened, with the calibration projected
out. The scores of all columns then have the distribution ``N(X^T d, X^T X)``. The ideal detector's results
are drawn from this distribution, without a simulated deployment. It compares the truth (a single column d,
with as many degrees of freedom k as the cause has in the table) with every other cause of the table, by the
evidence that the real detector uses. Its set of names holds all causes within 20:1 of the best.

An effect is *found* if a test of the table or the test of the truth is significant: ``chi2_k`` exceeds its
quantile at 1 %, divided among all causes and their independent hypotheses. The signal-to-noise ratios of
50 % and 95 % detection follow from the draws with d scaled to other sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import chdtrc
from study.deployment import Background, Injected, compare, project, whiten
from study.names import EQUIVALENT

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.columns import slices
from magbridge.diagnose.evidence import FALSE_ALARM_RATE, ODDS, log_bayes, one_sided
from magbridge.diagnose.joint import Statistic
from magbridge.diagnose.problem import pose
from magbridge.diagnose.survey import load_survey

DRAWS = 400
SIZES = np.linspace(1.0, 12.0, 45)
"""Signal-to-noise ratios at which the probability of detection is computed."""


@dataclass(frozen=True, eq=False)
class Span:
    """Hypothesis of a cause: a span of columns of the table.

    Attributes
    ----------
    cause : str
    channel : str or None
    own : slice
        Indices of the hypothesis' columns.
    price : float
        Natural log of the number of hypotheses that this one represents.
    positive : bool
        True if the coefficients cannot be negative.
    spectra : (l, k) array or None
        If the coefficients have one common size (:mod:`magbridge.diagnose.joint`): l
        alternatives for their prior variances.
    more : float
        For the true shape: number of further coefficients of its cause, which fit only noise.
    """

    cause: str
    channel: str | None
    own: slice
    price: float = 0.0
    positive: bool = False
    spectra: FloatArray | None = None
    more: float = 0.0

    @property
    def tail(self) -> float:
        """Fraction of a chi-square's tail that counts in a test: half if a size cannot be negative."""
        return 0.5 if self.positive or self.spectra is not None else 1.0


class Draws(NamedTuple):
    """Fisher information S (m, m) of all columns, the truth's last, and noise of their scores (m, DRAWS)."""

    S: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, S: FloatArray) -> Draws:
        """Return random draws of the noise of scores with the covariance S."""
        values, vectors = np.linalg.eigh(0.5 * (S + S.T))
        drawn = np.random.default_rng(20131212).standard_normal((len(S), DRAWS))
        return cls(S, vectors @ (drawn * np.sqrt(np.maximum(values, 0.0))[:, None]))

    @property
    def wanted(self) -> float:
        """Signal-to-noise ratio of the truth."""
        return float(np.sqrt(self.S[-1, -1]))

    def ratio(self, span: Span, scale: float | FloatArray = 1.0) -> tuple[FloatArray, float]:
        """Return likelihood ratios of a hypothesis for the truth times `scale`, and degrees of freedom."""
        statistic = Statistic(self.S[span.own, span.own], span.spectra)
        given, scale = self.S[span.own, -1], np.asarray(scale)[..., None]
        scores = np.moveaxis(self.noise[span.own] + scale[..., None] * given[:, None], -2, 0)
        value = statistic.ratio(scores.reshape(len(given), -1)).reshape(scores.shape[1:])
        if span.more:
            value = value + 2.0 * np.random.default_rng(20131213).standard_gamma(0.5 * span.more, DRAWS)
        if span.positive:
            value = np.where(scores[0] > 0.0, value, 0.0)
        return value, float(statistic.freedom + span.more)

    def conditional_on(self, span: Span) -> Draws:
        """Return the draws with the columns of one hypothesis projected out."""
        taken = self.S[:, span.own] @ root_of(self.S, span)
        own = root_of(self.S, span).T @ self.noise[span.own]
        return Draws(self.S - taken @ taken.T, self.noise - taken @ own)


def explained(S: FloatArray, span: Span) -> float:
    """Return the power of the true signature that a hypothesis explains; 0 if its sign is wrong."""
    if span.positive and S[span.own, -1].min() < 0.0:
        return 0.0
    return float(np.sum((root_of(S, span).T @ S[span.own, -1]) ** 2))


def evidence(span: Span, ratio: FloatArray, freedom: float) -> FloatArray:
    """Return the log evidence of likelihood ratios; ratios of a common size are already integrated."""
    if span.spectra is not None:
        return np.asarray(0.5 * ratio - np.log(len(span.spectra)))
    # for a known sign: the posterior probability of this sign over its prior probability, one half
    return log_bayes(ratio, freedom) + (one_sided(ratio) if span.positive else 0.0)


def root_of(S: FloatArray, span: Span) -> FloatArray:
    """Return R (k, f) with ``R R^T`` the covariance of a hypothesis' coefficients that the data determine."""
    own = S[span.own, span.own]
    if span.spectra is not None:  # add the prior at the likeliest size given the truth
        own = own + np.diag(1.0 / Statistic(own, span.spectra).best(S[span.own, -1]).variance)
    statistic = Statistic(own)
    return np.asarray(statistic.vectors / np.sqrt(statistic.values))


def numbers(S: FloatArray, span: Span) -> float:
    """Return the effective number of coefficients that the data determine, not the prior."""
    root = root_of(S, span)
    return float(np.trace(root.T @ S[span.own, span.own] @ root))


def by_cause(
    evidences: Mapping[Span, FloatArray], name: str = "", truth: FloatArray | None = None
) -> dict[str, FloatArray]:
    """Return each cause's log evidence: mean over its grid, maximum over its channels, with the truth."""
    groups: dict[tuple[str, str | None], list[tuple[FloatArray, float]]] = {}
    for span, evidence in evidences.items():
        groups.setdefault((span.cause, span.channel), []).append((evidence, span.price))
    found: dict[str, FloatArray] = {}
    for (cause, _), members in groups.items():
        table = np.array([evidence for evidence, _ in members])
        top = table.max(axis=0)
        price = np.log(np.mean(np.exp(table - top), axis=0)) - members[0][1]
        own = (truth if cause == name and truth is not None else top) + price
        found[cause] = np.maximum(found.get(cause, own), own)
    return found if name in found or truth is None else found | {name: truth}


def ideal(
    hidden: Injected, background: Background, ds: xr.Dataset, look_elsewhere: Mapping[str, float]
) -> dict[str, Any]:
    """Return the probabilities of the outcomes of an ideal detector.

    Parameters
    ----------
    hidden : Injected
        Hidden effect of the case.
    background : Background
        Background of the log with the effect.
    ds : Dataset
        Deployment that is diagnosed.
    look_elsewhere : mapping
        Cause -> number of its independent hypotheses.

    Returns
    -------
    dict
        Probabilities: ``alone``, only the truth is named; ``inside``, the set of names has the truth.
        ``half``, ``sure``: signal-to-noise ratio of 50 and 95 % detection. ``here``: p-value in this log's
        noise for each of :data:`SIZES`. ``left``: signal-to-noise ratio that each cause's best hypotheses
        leave.
    """
    name = EQUIVALENT.get(hidden.hidden.name, hidden.hidden.name)
    spans, S, noise = information(hidden, background, ds)
    draws, competing = Draws.of(S), [span for span in spans if span.cause != name]
    own = own_span(S, spans, name)
    true = true_span(S, own, name)
    given = {span: draws.ratio(span) for span in (*spans, true)}
    truth = evidence(true, *given[true])
    weighed = by_cause({span: evidence(span, *given[span]) for span in spans}, name, truth)
    names, table = list(weighed), np.array([*weighed.values()])
    inside, first, me = table > table.max(axis=0) - ODDS, np.argmax(table, axis=0), names.index(name)
    tests = [true, *competing]
    return {
        "alone": float(np.mean((first == me) & (inside.sum(axis=0) == 1))) * bool(own),
        "inside": float(np.mean(inside[me])) * bool(own),
        **found_at(p_values(draws, tests, look_elsewhere)),
        "here": np.median(p_values(Draws(S, noise), tests, look_elsewhere), axis=1).tolist(),
        "left": left_by_causes(draws, competing),
    }


def information(
    hidden: Injected, background: Background, ds: xr.Dataset
) -> tuple[list[Span], FloatArray, FloatArray]:
    """Return hypotheses, Fisher information (m, m) of all columns, and scores (m, 1) of the log's noise."""
    noise, rows, calibration = background.noise, background.rows, background.deployment.calibration
    problem = pose(load_survey([ds], calibration), calibration)
    candidates = [c for cause in CAUSES.values() for c in cause.candidates(problem)]
    table = whiten(np.hstack([c.columns(slice(0, len(problem))) for c in candidates]), noise, rows)
    X = np.column_stack([table, hidden.signature])
    spans = []
    for c, own in zip(candidates, slices(candidates, 0), strict=True):
        cause, price = EQUIVALENT.get(c.cause, c.cause), float(np.log(c.look_elsewhere))
        spans.append(Span(cause, c.channel, own, price, c.positive, c.spectra))
    projected = project(X, background.columns, background.deployment.prior)
    measured = whiten(compare(ds, calibration)[0], noise, rows)
    return spans, X.T @ projected, projected.T @ (measured - hidden.signature)[:, None]


def own_span(S: FloatArray, spans: Sequence[Span], name: str) -> Span | None:
    """Return the true cause's hypothesis of largest evidence; None if the log has no such hypothesis."""

    def worth(span: Span) -> float:
        freedom = numbers(S, span)
        return float(log_bayes(explained(S, span) + freedom, freedom))  # at the mean likelihood ratio

    return max((span for span in spans if span.cause == name), key=worth, default=None)


def true_span(S: FloatArray, own: Span | None, name: str) -> Span:
    """Return the true shape (last column) as a hypothesis, with as many coefficients as `own`."""
    shape = slice(len(S) - 1, len(S))
    if own is None:
        return Span(name, None, shape)
    return Span(name, None, shape, positive=own.positive, more=max(numbers(S, own), 1.0) - 1.0)


def left_by_causes(draws: Draws, spans: Sequence[Span]) -> dict[str, float]:
    """Return the truth's signal-to-noise ratio with the best two hypotheses of each cause projected out."""
    causes: dict[str, list[Span]] = {}
    for span in spans:
        causes.setdefault(span.cause, []).append(span)
    left = {}
    for cause, group in causes.items():
        first = max(group, key=lambda span: explained(draws.S, span))
        S = draws.conditional_on(first).S if explained(draws.S, first) else draws.S
        power = min(S[-1, -1] - explained(S, span) for span in group)
        left[cause] = float(np.sqrt(max(power, 0.0)))
    return left


def p_values(draws: Draws, spans: Sequence[Span], look_elsewhere: Mapping[str, float]) -> FloatArray:
    """Return the smallest p-value of all tests for each of :data:`SIZES` and each draw, (sizes, DRAWS)."""
    scale, largest = SIZES / draws.wanted, {(1.0, 1.0): np.zeros((len(SIZES), 1))}  # a p-value of 1
    for span in spans:
        ratio, freedom = draws.ratio(span, scale)
        if freedom:
            tests = span.tail * len(CAUSES) * look_elsewhere.get(span.cause, 1.0)
            largest[tests, freedom] = np.maximum(largest.get((tests, freedom), 0.0), ratio)
    # of tests with the same distribution, that of the largest ratio has the smallest p-value
    every = [tests * chdtrc(freedom, ratio) for (tests, freedom), ratio in largest.items()]
    return np.asarray(reduce(np.minimum, every))


def found_at(p: FloatArray) -> dict[str, float]:
    """Return the signal-to-noise ratios with 50 % and 95 % probability of detection."""
    chance = np.maximum.accumulate(np.mean(p < FALSE_ALARM_RATE, axis=1))
    return {"half": float(np.interp(0.5, chance, SIZES)), "sure": float(np.interp(0.95, chance, SIZES))}
