"""Exchange causes for competing hypotheses, or drop them: the first were found without the later."""

from __future__ import annotations

from functools import reduce
from itertools import combinations

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.inference.competing import competing_hypotheses
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.pairs import AT_ONCE, pairs_of
from magbridge.diagnose.inference.profile_likelihood import refined
from magbridge.diagnose.inference.state import State

__all__ = ["exchanged"]

CHANGES = 6
"""Exchanges at most."""
TRIED = 3
"""Alternatives tried for each place."""


def exchanged(state: State, model: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Replace one regressor or two by others, or drop one, while the evidence of the whole model grows."""
    pieces = [piece for candidate in model for piece in candidate.pieces]
    for _ in range(CHANGES):
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
    """Say whether each candidate of one common size would be the only one of its cause."""
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
