"""Rivals of a cause: the other names that the data do not rule out, alone or in a pair with another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate, Group, slices
from magbridge.diagnose.inference.evidence import LEVEL, margin, score
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.pairs import pairs_of
from magbridge.diagnose.inference.state import State

__all__ = ["Rival", "rivals_of", "sets_of"]


@dataclass(frozen=True)
class Rival:
    """A rival of a cause, by the best candidate of its grid.

    Attributes
    ----------
    candidate : Candidate
    behind : float
        Log evidence by which it loses, averaged over the grid of its nonlinear parameters.
    """

    candidate: Candidate
    behind: float


def rivals_of(
    state: State, info: Information, model: list[Candidate], base: Joint, k: int
) -> tuple[Rival, ...]:
    """Return the rivals of the k-th cause of `model`, whose columns are the last of `info`."""
    own = slices(model, state.at[-1].stop)[k]
    alone = info.instead(base, own)
    standing = score(alone, own, model[k])
    rivals, best = [], state.best(alone)
    paid = best[model[k].group].price if model[k].group in best else 0.0
    for group, (member, price, s, _) in best.items():
        candidate = state.candidates[member]
        if group == model[k].group or group[0] in {other.cause for other in model if other is not model[k]}:
            continue
        cheaper = price - paid - float(np.log(candidate.trials / model[k].trials))
        behind = standing.evidence - s.evidence - cheaper
        if behind < margin(standing.ratio) and state.p_value(candidate, s.ratio, s.freedom) < LEVEL:
            rivals.append(Rival(candidate, behind))
    return tuple(sorted(rivals, key=lambda rival: rival.behind))


def sets_of(
    state: State, info: Information, model: list[Candidate], base: Joint
) -> tuple[tuple[Rival, ...], ...]:
    """Return the rivals of each cause of `model`, also those that need another cause replaced as well."""
    pieces = [(piece, place) for place, candidate in enumerate(model) for piece in candidate.pieces]
    own = [{piece.group for piece in candidate.pieces} for candidate in model]
    found: list[dict[Group, Rival]] = [{} for _ in model]

    def rivals() -> Iterator[tuple[int, Rival]]:
        for place in range(len(model)):
            for rival in rivals_of(state, info, model, base, place):
                yield place, rival
        for places in combinations(range(len(pieces)), min(2, len(pieces))):
            for pair in pairs_of(state, info, [piece for piece, _ in pieces], base, *places):
                for candidate, n in ((pair.first, places[0]), (pair.second, places[-1])):
                    yield pieces[n][1], Rival(candidate, pair.behind)

    for place, rival in rivals():
        group = rival.candidate.group
        if group not in own[place] and (
            group not in found[place] or rival.behind < found[place][group].behind
        ):
            found[place][group] = rival
    return tuple(tuple(sorted(some.values(), key=lambda rival: rival.behind)) for some in found)
