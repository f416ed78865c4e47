"""Competing hypotheses of a cause: what the data do not rule out, alone or in a pair; and their exchange."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import combinations

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate, Group, slices
from magbridge.diagnose.inference.evidence import FALSE_ALARM_RATE, bayes_factor_threshold, score
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.pairs import AT_ONCE, pairs_of
from magbridge.diagnose.inference.profile_likelihood import refined
from magbridge.diagnose.inference.state import State

__all__ = ["CompetingHypothesis", "competing_hypotheses", "exchanged", "sets_of"]

MAX_EXCHANGES = 6
"""Exchanges at most."""
TRIED = 3
"""Alternatives tried for each place."""


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
            and state.p_value(candidate, s.ratio, s.freedom) < FALSE_ALARM_RATE
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


def exchanged(state: State, model: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Replace one regressor or two by others, or drop one, while the evidence of the whole model grows."""
    pieces = [piece for candidate in model for piece in candidate.pieces]
    for _ in range(MAX_EXCHANGES):
        best, better = state.value(pieces, base), (pieces, base)
        for new, at in _changes(state, pieces, base):
            changed = [*new, *(piece for n, piece in enumerate(pieces) if n not in at)]
            entry = refined(state, changed, state.fit(changed, like=base), len(new))
            if state.value(*entry) > best:  # a month's fit is large: only one is kept
                best, better = state.value(*entry), entry
        if better[0] is pieces:
            break
        pieces, base = better
    return _gathered(state, pieces, base)


def _changes(state: State, pieces: list[Candidate], base: Joint) -> list[tuple[list[Candidate], list[int]]]:
    """List replacements and the places they would take: first none in each place, then the likeliest."""
    info = state.conditional_on(pieces, base)
    found = []
    if len(pieces) == 1:
        found = [(r.behind, [r.candidate], [0]) for r in competing_hypotheses(state, info, pieces, base, 0)]
    everywhere = range(len(pieces))
    twos = combinations(everywhere, 2) if len(pieces) <= AT_ONCE else ()
    for places in [*combinations(everywhere, 1), *twos]:
        for pair in pairs_of(state, info, pieces, base, *places):
            kept = [n for n in places if pieces[n] is pair.first or pieces[n] is pair.second]
            new = [c for c in (pair.first, pair.second) if not any(c is pieces[n] for n in kept)]
            found.append((pair.behind, new, [n for n in places if n not in kept]))
    found = [entry for entry in found if _separate(entry[1], pieces, entry[2])]
    found = sorted(found, key=lambda entry: entry[0])[:TRIED]
    needless = range(len(pieces) if len(pieces) > 1 else 0)
    return [*(([], [n]) for n in needless), *(entry[1:] for entry in found)]


def _separate(new: list[Candidate], pieces: list[Candidate], at: list[int]) -> bool:
    """Return True if each candidate of one common size would be the only one of its cause."""
    changed = [*new, *(piece for n, piece in enumerate(pieces) if n not in at)]
    causes = [candidate.cause for candidate in changed]
    return all(candidate.spectra is None or causes.count(candidate.cause) == 1 for candidate in changed)


def _gathered(state: State, pieces: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Join the pieces of each cause into one candidate."""
    causes = list(dict.fromkeys(piece.cause for piece in pieces))
    if len(causes) == len(pieces):
        return pieces, base
    at = slices(pieces)
    order = sorted(range(len(pieces)), key=lambda n: causes.index(pieces[n].cause))
    c = base.coefficients[np.r_[*(at[n] for n in order)]]
    model = [reduce(Candidate.with_, [p for p in pieces if p.cause == cause]) for cause in causes]
    return model, state.fit(model, np.append(base.z, c), plain=False, like=base, rounds=1)
