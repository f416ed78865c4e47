"""The sets: for each cause found, all others that are not ruled out, alone or in a pair."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.pairs import pairs_of
from magbridge.diagnose.inference.rivals import Rival, rivals_of
from magbridge.diagnose.inference.rounds import State, key

__all__ = ["sets_of"]


def sets_of(
    state: State, info: Information, model: list[Candidate], base: Joint
) -> tuple[tuple[Rival, ...], ...]:
    """Return the rivals of each cause of `model`, also those that need another cause replaced as well."""
    pieces = [(piece, place) for place, candidate in enumerate(model) for piece in candidate.pieces]
    own = [{key(piece) for piece in candidate.pieces} for candidate in model]
    found: list[dict[tuple[str, str | None], Rival]] = [{} for _ in model]

    def rivals() -> Iterator[tuple[int, Rival]]:
        for place in range(len(model)):
            for rival in rivals_of(state, info, model, base, place):
                yield place, rival
        for places in combinations(range(len(pieces)), min(2, len(pieces))):
            for pair in pairs_of(state, info, [piece for piece, _ in pieces], base, *places):
                for candidate, n in ((pair.first, places[0]), (pair.second, places[-1])):
                    yield pieces[n][1], Rival(candidate, pair.behind)

    for place, rival in rivals():
        group = key(rival.candidate)
        if group not in own[place] and (
            group not in found[place] or rival.behind < found[place][group].behind
        ):
            found[place][group] = rival
    return tuple(tuple(sorted(some.values(), key=lambda rival: rival.behind)) for some in found)
