r"""Competing hypotheses of a cause, alone or in pairs, and the exchange of causes for them.

Notes
-----
A wrong cause may persist only because another is wrong, too: replacing either alone is not an improvement. So
replacements are compared in pairs, with the rest of the model projected out (:mod:`.evidence`):

.. math:: E_{ab} = E_a + E_{b \mid a}, \qquad
          E_{AB} = \ln \frac{1}{|A| |B|} \sum_{a \in A, b \in B} e^{E_{ab}}

with A, B the grids of two causes' nonlinear parameters. A candidate whose coefficients have one common size
is always the first of its pair, at the size that it would have alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from magbridge.arrays import FloatArray
from magbridge.diagnose.columns import Candidate, Group, slices
from magbridge.diagnose.evidence import (
    FALSE_ALARM_RATE,
    REMNANT,
    Information,
    bayes_factor_threshold,
    log_bayes,
    one_sided,
    score,
)
from magbridge.diagnose.joint import Joint, Statistic
from magbridge.diagnose.state import SearchState, refined

AT_ONCE = 4
"""Regressors of a model, beyond which no two are replaced at once: each two take a table of all pairs."""
PAIR_COLUMNS = 128
"""Columns of candidates that are scored at once: enough to outweigh a call, few enough for a core's cache."""
MAX_EXCHANGES = 6
"""Exchanges at most."""
TRIED = 3
"""Alternatives tried for each place."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two candidates in the places of one or two of a model; the log evidence that their grids lack."""

    first: Candidate
    second: Candidate
    behind: float


class _Stack:
    """Candidates with the same number of free coefficients, scored all at once."""

    def __init__(
        self,
        places: Sequence[int],
        slots: Sequence[slice],
        candidates: Sequence[Candidate],
        info: Information,
    ) -> None:
        self.places = np.array(places)
        self.index = np.array([np.r_[slots[k]] for k in places])
        self.positive = np.array([candidates[k].positive for k in places])
        self.likelier = np.array([candidates[k].point.likelier for k in places])
        self.S = info.matrix[self.index[:, :, None], self.index[:, None, :]]
        self.b = info.score[self.index]

    def conditional_on(
        self, rows: FloatArray, K: FloatArray, taken: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Log evidences, likelihood ratios, freedoms (n, m) (:func:`~.evidence.score`) given n others.

        Parameters
        ----------
        rows, K : (n, k, M) array
            Rows of each other one in the information matrix M, and ``A^-1 M`` with A its own block and prior.
        taken : (n, k) array
            ``A^-1 b`` of its own score b.
        """
        U = rows[:, :, self.index]
        S = self.S - np.einsum("namk,naml->nmkl", U, K[:, :, self.index])
        b = self.b - np.einsum("namk,na->nmk", U, taken)
        statistic = Statistic(S)
        ratio = statistic.ratio(b[..., None])[..., 0]
        ratio[self.positive & (b.min(axis=-1) < 0.0)] = 0.0
        evidence = log_bayes(ratio, statistic.freedom) + np.where(self.positive, one_sided(ratio), 0.0)
        return evidence + self.likelier, ratio, statistic.freedom


def pairs_of(
    state: SearchState, info: Information, model: Sequence[Candidate], base: Joint, *places: int
) -> list[Pair]:
    """Return the pairs that could replace the causes of `model` at one or two places, the likeliest first.

    `info` is that of all candidates and of `model`, whose columns are the last
    (:meth:`~.state.SearchState.conditional_on`), and `base` the model's fit.
    """
    table = _Table(state, info, model, base, places)
    groups = list(table.members)
    pairs = (table.pair(A, B) for n, A in enumerate(groups) for B in groups[n:])
    return sorted((pair for pair in pairs if pair is not None), key=lambda pair: pair.behind)


class _Table:
    """Log evidences of all pairs in the place of one or two causes of a model."""

    def __init__(
        self,
        state: SearchState,
        info: Information,
        model: Sequence[Candidate],
        base: Joint,
        places: Sequence[int],
    ) -> None:
        # Free the causes in question; all others of the model stay projected out
        first = state.at[-1].stop
        here = [slices(model, first)[n] for n in places]
        self.info = info.released(base, *here)
        self.signals = [self.info.matrix[:, at] @ base.coefficients[np.r_[at] - first] for at in here]
        self.state, self.base, self.standing = state, base, [model[n] for n in places]
        self.candidates = [*state.candidates, *self.standing]
        self.at = [*state.at, *here]
        self.members = {group: list(members) for group, members in state.groups.items()}
        for n, candidate in enumerate(self.standing):
            self.members[candidate.group].append(len(state.candidates) + n)
        self._fill()
        self.best, self.threshold = self._current()
        self.paid = float(np.sum(np.log([candidate.look_elsewhere for candidate in self.standing])))

    def _fill(self) -> None:
        """Score every candidate alone, and together with each other one."""
        m, info = len(self.candidates), self.info
        free = [n for n, candidate in enumerate(self.candidates) if candidate.spectra is None]
        # E_ab = E_a + E_(b|a) for all pairs: for each a, every b of one size at once
        stacks = [_Stack(places, self.at, self.candidates, info) for places in self._by_size(free)]
        self.scores = [score(info, own, c) for own, c in zip(self.at, self.candidates, strict=True)]
        conditional_on, self.ratio = np.full((m, m), -np.inf), np.zeros((m, m))
        self.freedom = np.ones((m, m), int)
        for places, rows, solved in self._pieces():
            alone = np.array([self.scores[n].evidence for n in places])
            for stack in stacks:
                evidence, ratio, freedom = stack.conditional_on(rows, solved[:, :, :-1], solved[:, :, -1])
                at = np.ix_(np.array(places), stack.places)
                conditional_on[at] = alone[:, None] + evidence
                self.ratio[at], self.freedom[at] = ratio, freedom
        # Either of the two may come first
        self.evidence = np.maximum(conditional_on, conditional_on.T)
        np.fill_diagonal(self.evidence, -np.inf)

    def _by_size(self, places: Iterable[int]) -> list[list[int]]:
        """Sort places by their candidates' number of coefficients."""
        found: dict[int, list[int]] = {}
        for n in places:
            found.setdefault(self.candidates[n].size, []).append(n)
        return list(found.values())

    def _pieces(self) -> Iterator[tuple[list[int], FloatArray, FloatArray]]:
        """Yield all candidates, some of the same size at a time: their places, and arrays for a _Stack.

        These are the (n, k, M) rows of the information matrix, and ``A^-1`` times those and the score, which
        stands last.
        """
        info = self.info
        for places in self._by_size(range(len(self.candidates))):
            step = max(1, PAIR_COLUMNS // self.candidates[places[0]].size)
            for some in (places[n : n + step] for n in range(0, len(places), step)):
                own = np.array([np.r_[self.at[n]] for n in some])
                rows, prior = info.matrix[own], np.array([np.diag(self.scores[n].prior) for n in some])
                A = info.matrix[own[:, :, None], own[:, None, :]] + prior
                every = np.concatenate([rows, info.score[own][..., None]], axis=2)
                yield some, rows, np.asarray(np.linalg.solve(A, every), float)

    def _current(self) -> tuple[float, float]:
        """Log evidence of the standing causes, averaged over their grids, and the margin that they need."""
        m, groups = len(self.state.candidates), [candidate.group for candidate in self.standing]
        # under the noise that is left, which is less, ratios exceed what the model as a whole has gained
        whole = self.state.ratio(self.base)
        # One cause stands: a pair pays for its second cause
        if len(groups) == 1:
            standing, grid = self.scores[m], [self.scores[n].evidence for n in self.state.groups[groups[0]]]
            needed = bayes_factor_threshold(min(standing.ratio, whole))
            # the pair pays for one more cause, which must not be what the single one's regressor leaves
            price = needed + float(np.log(len(self.state.look_elsewhere)))
            return standing.evidence + _average(np.array(grid)) + price, needed
        # Two causes stand: their joint evidence, whichever comes first
        found = []
        for a, b in ((m, m + 1), (m + 1, m)):
            first = self.scores[a]
            second = score(
                self.info.projected_out(np.r_[self.at[a]], first.prior), self.at[b], self.candidates[b]
            )
            found.append((first.evidence + second.evidence, first.ratio + second.ratio))
        best, ratio = max(found)
        return best + self._price(*groups), bayes_factor_threshold(min(ratio, whole))

    def _price(self, A: Group, B: Group) -> float:
        """Log of the evidence's average over two grids, relative to the best there."""
        return _average(self.evidence[np.ix_(self.state.groups[A], self.state.groups[B])])

    def pair(self, A: Group, B: Group) -> Pair | None:
        """Return the best of two grids, unless what stands beats it by the Bayes-factor threshold."""
        # A pair that is the standing one, or contains a single standing cause, is no alternative
        current = [candidate.group for candidate in self.standing]
        block = self.evidence[np.ix_(self.members[A], self.members[B])]
        top = float(block.max())
        if (
            (len(current) > 1 and {A, B} == set(current))
            or (len(current) == 1 and current[0] in (A, B))
            or not np.isfinite(top)
        ):
            return None
        # The price of the two grids, compared with what the standing causes paid
        rows, columns = np.unravel_index(int(np.argmax(block)), block.shape)
        a, b = self.members[A][int(rows)], self.members[B][int(columns)]
        one, two = self.candidates[a], self.candidates[b]
        paid = float(np.log(one.look_elsewhere * two.look_elsewhere)) - self.paid
        if self.best - top + paid > self.threshold:  # before the price, which can only add to it
            return None
        behind = self.best - top - self._price(A, B) + paid
        if behind > self.threshold or not self._significant(a, b):
            return None
        return Pair(two, one, behind) if self._swapped(a, b) else Pair(one, two, behind)

    def _significant(self, a: int, b: int) -> bool:
        """Return True if each passes its test in the presence of the other.

        Where one cause stood, neither may be a remnant of the other.
        """
        # Each cause is tested given the other of the pair
        ratios = []
        for n, other in ((a, b), (b, a)):
            one, alone = self.candidates[n], self.scores[n]
            ratio, freedom = self.ratio[other, n], self.freedom[other, n]
            if one.spectra is not None:
                ratio, freedom = alone.ratio, alone.freedom
            if self.state.p_value(one, float(ratio), int(freedom)) >= FALSE_ALARM_RATE:
                return False
            ratios.append(ratio)
        same = len({candidate.cause for candidate in self.standing}) == 1
        return not same or min(ratios) >= REMNANT**2 * max(ratios)

    def _swapped(self, a: int, b: int) -> bool:
        """Return True if a rather replaces the second, judged by cause, else by the signal it explains."""
        if len(self.standing) == 1:
            return False
        # Places by the cause where that decides, else by the signal that each explains
        names = [candidate.cause for candidate in self.standing]
        one, two = self.candidates[a].cause, self.candidates[b].cause
        straight, crossed = (one == names[0]) + (two == names[1]), (one == names[1]) + (two == names[0])
        if straight != crossed:
            return crossed > straight

        def takes(n: int, signal: FloatArray) -> float:
            own = self.at[n]
            s = signal[own]
            return float(s @ np.linalg.solve(self.info.matrix[own, own] + np.diag(self.scores[n].prior), s))

        k, j = self.signals
        return takes(a, j) + takes(b, k) > takes(a, k) + takes(b, j)


def _average(evidences: FloatArray) -> float:
    """Log of the average of evidences given by their logs, relative to the best."""
    top = float(np.max(evidences))
    return float(logsumexp(evidences - top)) - float(np.log(np.size(evidences))) if np.isfinite(top) else 0.0


@dataclass(frozen=True)
class CompetingHypothesis:
    """A competing hypothesis, by the best candidate of its grid."""

    candidate: Candidate
    behind: float
    """Log evidence by which it loses, averaged over the grid of its nonlinear parameters."""


def competing_hypotheses(
    state: SearchState, info: Information, model: list[Candidate], base: Joint, k: int
) -> tuple[CompetingHypothesis, ...]:
    """Return the competing hypotheses of the k-th cause of `model`, whose columns are the last of `info`."""
    # Score every group in the place of the k-th cause
    own = slices(model, state.at[-1].stop)[k]
    alone = info.released(base, own)
    standing = score(alone, own, model[k])
    competing, best = [], state.best(alone)
    paid = best[model[k].group].price if model[k].group in best else 0.0
    for group, (member, price, s, _) in best.items():
        candidate = state.candidates[member]
        if group == model[k].group or group[0] in {other.cause for other in model if other is not model[k]}:
            continue
        # Log evidence of the grids' averages, with the look-elsewhere of both
        cheaper = price - paid - float(np.log(candidate.look_elsewhere / model[k].look_elsewhere))
        behind = standing.evidence - s.evidence - cheaper
        if (
            behind < bayes_factor_threshold(standing.ratio)
            and state.p_value(candidate, s.ratio, s.freedom) < FALSE_ALARM_RATE
        ):
            competing.append(CompetingHypothesis(candidate, behind))
    return tuple(sorted(competing, key=lambda hypothesis: hypothesis.behind))


def sets_of(
    state: SearchState, info: Information, model: list[Candidate], base: Joint
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


def exchanged(state: SearchState, model: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Replace one regressor or two by others, or drop one, while the evidence of the whole model grows."""
    pieces = [piece for candidate in model for piece in candidate.pieces]
    # Steepest ascent over the neighbours of the model, each fitted with its noise
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


def _changes(
    state: SearchState, pieces: list[Candidate], base: Joint
) -> list[tuple[list[Candidate], list[int]]]:
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


def _separate(new: list[Candidate], pieces: list[Candidate], replaced: list[int]) -> bool:
    """Return True if each candidate of one common size would be the only one of its cause."""
    changed = [*new, *(piece for n, piece in enumerate(pieces) if n not in replaced)]
    causes = [candidate.cause for candidate in changed]
    return all(candidate.spectra is None or causes.count(candidate.cause) == 1 for candidate in changed)


def _gathered(state: SearchState, pieces: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Join the pieces of each cause into one candidate."""
    # Pieces of one cause stand next to each other, so that one candidate can hold them
    causes = list(dict.fromkeys(piece.cause for piece in pieces))
    if len(causes) == len(pieces):
        return pieces, base
    at = slices(pieces)
    order = sorted(range(len(pieces)), key=lambda n: causes.index(pieces[n].cause))
    c = base.coefficients[np.r_[*(at[n] for n in order)]]
    model = [reduce(Candidate.joined_with, [p for p in pieces if p.cause == cause]) for cause in causes]
    return model, state.fit(model, np.append(base.z, c), plain=False, like=base, rounds=1)
