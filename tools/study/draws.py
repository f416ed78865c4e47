"""Draws of the likelihood ratios of all hypotheses of a table, given a hidden effect.

They follow from the information matrix: no deployment needs to be simulated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.evidence import log_bayes, one_sided
from magbridge.diagnose.joint import Statistic

DRAWS = 400
SHOWN = "as shown"
"""Instead of a channel's name: the span is a cause's true signature, not columns of the table."""


@dataclass(frozen=True, eq=False)
class Span:
    """One of a cause's hypotheses.

    Attributes
    ----------
    cause : str
    channel : str or None
    own : slice
        Places of its columns.
    price : float
        Log of the number of hypotheses that it stands for.
    positive : bool
        Its coefficients cannot be negative.
    spectra : (l, k) array or None
        Where its coefficients have one common size (:mod:`magbridge.diagnose.joint`): l
        alternatives for their prior variances.
    more : float
        Of a true shape: how many further coefficients its cause has, which fit nothing but noise.
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
        """Share of a chi-square's tail that counts in a test: half where a size cannot be negative."""
        return 0.5 if self.positive or self.spectra is not None else 1.0


class Draws(NamedTuple):
    """Fisher information S of all columns, the truth's last, and draws of their scores' noise (m, DRAWS)."""

    S: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, S: FloatArray) -> Draws:
        """Draw the noise of scores whose covariance is S."""
        values, vectors = np.linalg.eigh(0.5 * (S + S.T))
        drawn = np.random.default_rng(20131212).standard_normal((len(S), DRAWS))
        return cls(S, vectors @ (drawn * np.sqrt(np.maximum(values, 0.0))[:, None]))

    @property
    def wanted(self) -> float:
        """Signal-to-noise of the truth."""
        return float(np.sqrt(self.S[-1, -1]))

    def ratio(self, span: Span, scale: float | FloatArray = 1.0) -> tuple[FloatArray, float]:
        """Likelihood ratios of a hypothesis, with the truth scaled by `scale`, and its degrees of freedom."""
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
        """Return the draws with one hypothesis projected out."""
        taken = self.S[:, span.own] @ root_of(self.S, span)
        own = root_of(self.S, span).T @ self.noise[span.own]
        return Draws(self.S - taken @ taken.T, self.noise - taken @ own)


def explained(S: FloatArray, span: Span) -> float:
    """Power of the truth's signature that a hypothesis explains; one of the wrong sign explains nothing."""
    if span.positive and S[span.own, -1].min() < 0.0:
        return 0.0
    return float(np.sum((root_of(S, span).T @ S[span.own, -1]) ** 2))


def evidence(span: Span, ratio: FloatArray, freedom: float) -> FloatArray:
    """Log evidence of likelihood ratios; coefficients of one common size are already integrated out."""
    if span.spectra is not None:
        return np.asarray(0.5 * ratio - np.log(len(span.spectra)))
    # of a known sign: the share of the posterior that has it, over half of the prior
    return log_bayes(ratio, freedom) + (one_sided(ratio) if span.positive else 0.0)


def with_another(draws: Draws, first: Span, spans: Sequence[Span]) -> dict[str, tuple[float, Span]]:
    """For each cause, the truth's signal-to-noise left by `first` and its best hypothesis, and the latter."""
    S = draws.conditional_on(first).S
    left: dict[str, tuple[float, Span]] = {}
    for span in spans:
        value = float(np.sqrt(max(S[-1, -1] - explained(S, span), 0.0)))
        left[span.cause] = min(
            (value, span), left.get(span.cause, (np.inf, span)), key=lambda entry: entry[0]
        )
    return left


def root_of(S: FloatArray, span: Span) -> FloatArray:
    """Return R (k, f): ``R R^T`` is the covariance of a hypothesis' coefficients, where the data see them."""
    own = S[span.own, span.own]
    if span.spectra is not None:  # with their prior, at the likeliest size given the truth
        own = own + np.diag(1.0 / Statistic(own, span.spectra).best(S[span.own, -1]).variance)
    statistic = Statistic(own)
    return np.asarray(statistic.vectors / np.sqrt(statistic.values))


def numbers(S: FloatArray, span: Span) -> float:
    """Number of coefficients that the data determine: of one common size, those not held by the prior."""
    root = root_of(S, span)
    return float(np.trace(root.T @ S[span.own, span.own] @ root))


def by_cause(
    evidences: Mapping[Span, FloatArray], name: str = "", truth: FloatArray | None = None
) -> dict[str, FloatArray]:
    """Each cause's log evidence, averaged over its grid, for its best channel; the truth pays as much."""
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
