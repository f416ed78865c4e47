"""Competing hypotheses of a cause: what the data do not rule out, alone or in a pair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate, Group, slices
from magbridge.diagnose.inference.evidence import LEVEL, bayes_factor_threshold, score
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.pairs import AT_ONCE, pairs_of
from magbridge.diagnose.inference.state import State

__all__ = ["CompetingHypothesis", "competing_hypotheses", "sets_of"]


@dataclass(frozen=True)
class CompetingHypothesis:
    """A competing hypothesis, by the best candidate of its grid."""

    candidate: Candidate
    behind: float
    """Log evidence by which it loses, averaged over the grid of its nonlinear parameters."""


def competing_hypotheses(
    state: State, info: Information, model: list[Candidate], base: Joint, k: int
) -> tuple[CompetingHypothesis, ...]:
    """Return the competing hypotheses of the k-th cause of `model`, whose columns are the last of `info`."""
    own = slices(model, state.at[-1].stop)[k]
    alone = info.instead(base, own)
    standing = score(alone, own, model[k])
    competing, best = [], state.best(alone)
    paid = best[model[k].group].price if model[k].group in best else 0.0
    for group, (member, price, s, _) in best.items():
        candidate = state.candidates[member]
        if group == model[k].group or group[0] in {other.cause for other in model if other is not model[k]}:
            continue
        cheaper = price - paid - float(np.log(candidate.look_elsewhere / model[k].look_elsewhere))
        behind = standing.evidence - s.evidence - cheaper
        if (
            behind < bayes_factor_threshold(standing.ratio)
            and state.p_value(candidate, s.ratio, s.freedom) < LEVEL
        ):
            competing.append(CompetingHypothesis(candidate, behind))
    return tuple(sorted(competing, key=lambda hypothesis: hypothesis.behind))


def sets_of(
    state: State, info: Information, model: list[Candidate], base: Joint
) -> tuple[tuple[CompetingHypothesis, ...], ...]:
    """Return the competing hypotheses of each of `model`, also those that need another cause replaced."""
    pieces = [(piece, place) for place, candidate in enumerate(model) for piece in candidate.pieces]
    own = [{piece.group for piece in candidate.pieces} for candidate in model]
    found: list[dict[Group, CompetingHypothesis]] = [{} for _ in model]

    def competing() -> Iterator[tuple[int, CompetingHypothesis]]:
        for place in range(len(model)):
            for hypothesis in competing_hypotheses(state, info, model, base, place):
                yield place, hypothesis
        for places in combinations(range(len(pieces)), 2 if 1 < len(pieces) <= AT_ONCE else 1):
            for pair in pairs_of(state, info, [piece for piece, _ in pieces], base, *places):
                for candidate, n in ((pair.first, places[0]), (pair.second, places[-1])):
                    yield pieces[n][1], CompetingHypothesis(candidate, pair.behind)

    for place, hypothesis in competing():
        group = hypothesis.candidate.group
        if group not in own[place] and (
            group not in found[place] or hypothesis.behind < found[place][group].behind
        ):
            found[place][group] = hypothesis
    return tuple(tuple(sorted(some.values(), key=lambda hypothesis: hypothesis.behind)) for some in found)
