"""What every hypothesis of a table would make of a hidden effect: draws of its likelihood ratio without a deployment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DRAWS = 400
COMMON = np.logspace(-7, 2, 37)
"""Common sizes, squared, of what has no name."""


@dataclass(frozen=True, eq=False)
class Span:
    """One of a cause's hypotheses: its columns, the log of how many others it stands for, and whether it has a sign."""

    cause: str
    channel: str | None
    own: slice
    price: float = 0.0
    positive: bool = False


class Draws(NamedTuple):
    """Fisher's information S of all columns, the truth's as the last one, and draws of their scores' noise (m, DRAWS)."""

    S: Array
    noise: Array

    @classmethod
    def of(cls, S: Array) -> Draws:
        """Draw scores' noise of information S."""
        values, vectors = np.linalg.eigh(0.5 * (S + S.T))
        drawn = np.random.default_rng(20131212).standard_normal((len(S), DRAWS))
        return cls(S, vectors @ (drawn * np.sqrt(np.maximum(values, 0.0))[:, None]))

    @property
    def wanted(self) -> float:
        """Signal-to-noise of the truth."""
        return float(np.sqrt(self.S[-1, -1]))

    def ratio(self, *spans: Span, scale: float | Array = 1.0) -> tuple[Array, int]:
        """Likelihood ratios of hypotheses taken together, with the truth times `scale`, and their free numbers."""
        at = np.concatenate([np.arange(span.own.start, span.own.stop) for span in spans])
        root = root_of(self.S[np.ix_(at, at)])
        given, drawn = root.T @ self.S[at, -1], root.T @ self.noise[at]
        scale = np.asarray(scale)[..., None]
        value = np.sum(drawn**2, axis=0) + 2.0 * scale * (given @ drawn) + scale**2 * (given @ given)
        if spans[0].positive:
            value = value * (drawn[0] + scale * given[0] > 0.0)
        return value, root.shape[1]

    def component(self, own: slice, width: Array) -> Array:
        """Log evidence of columns whose numbers have one common size, which is the likeliest, in units of `width`."""
        values, vectors = np.linalg.eigh(self.S[own, own] * np.outer(width, width))
        values = np.maximum(values, 0.0)[:, None]
        y2 = (vectors.T @ (width[:, None] * (self.S[own, -1:] + self.noise[own]))) ** 2
        tried = [np.sum(g * y2 / (1.0 + g * values) - np.log1p(g * values), axis=0) for g in COMMON]
        return np.asarray(0.5 * np.max(tried, axis=0))

    def truth(self, k: int, scale: float | Array = 1.0) -> Array:
        """Likelihood ratios of the truth itself; its k - 1 other numbers fit nothing but noise."""
        more = 2.0 * np.random.default_rng(20131213).standard_gamma(0.5 * (k - 1), DRAWS) if k > 1 else 0.0
        return np.asarray(
            (self.noise[-1] / self.wanted + np.asarray(scale)[..., None] * self.wanted) ** 2 + more
        )


def explained(S: Array, span: Span) -> float:
    """What a hypothesis explains of the truth's power; one of the wrong sign explains nothing."""
    if span.positive and S[span.own, -1].min() < 0.0:
        return 0.0
    return float(np.sum((root_of(S[span.own, span.own]).T @ S[span.own, -1]) ** 2))


def weigh(ratio: Array, freedom: int) -> Array:
    """Log evidence of likelihood ratios that took so many free numbers (Liang et al. 2008, sec. 2.4)."""
    if not freedom:
        return np.zeros_like(ratio)
    more = np.maximum(ratio, freedom)
    return np.asarray(0.5 * (more - freedom) - 0.5 * freedom * np.log(more / freedom))


def with_another(S: Array, first: Span, spans: Sequence[Span]) -> dict[str, tuple[float, Span]]:
    """Signal-to-noise of the truth (the last of S) that `first` leaves with the best other of each cause, and that one."""
    taken = S[:, first.own] @ root_of(S[first.own, first.own])
    S = S - taken @ taken.T
    left: dict[str, tuple[float, Span]] = {}
    for span in spans:
        value = float(np.sqrt(max(S[-1, -1] - explained(S, span), 0.0)))
        left[span.cause] = min(
            (value, span), left.get(span.cause, (np.inf, span)), key=lambda entry: entry[0]
        )
    return left


def root_of(S: Array) -> Array:
    """Return R (k, f) with ``R R^T`` the inverse of S in the directions that the data see."""
    values, vectors = np.linalg.eigh(S)
    seen = values > 1e-3
    return np.asarray(vectors[:, seen] / np.sqrt(values[seen]))


def by_cause(evidences: Mapping[Span, Array], name: str = "", truth: Array | None = None) -> dict[str, Array]:
    """Each cause's evidence, averaged over its grid, of its best channel; the truth pays for its grid as the others do."""
    groups: dict[tuple[str, str | None], list[tuple[Array, float]]] = {}
    for span, evidence in evidences.items():
        groups.setdefault((span.cause, span.channel), []).append((evidence, span.price))
    found: dict[str, Array] = {}
    for (cause, _), members in groups.items():
        table = np.array([evidence for evidence, _ in members])
        top = table.max(axis=0)
        price = np.log(np.mean(np.exp(table - top), axis=0)) - members[0][1]
        own = (truth if cause == name and truth is not None else top) + price
        found[cause] = np.maximum(found.get(cause, own), own)
    return found if name in found or truth is None else found | {name: truth}
