r"""Two causes at once: every pair of candidates in place of two regressors of a model.

Notes
-----
A wrong cause may persist only because another is wrong, too: replacing either alone is not an improvement. So
replacements are compared in pairs, with the rest of the model projected out (:mod:`.information`):

.. math:: E_{ab} = E_a + E_{b \mid a}, \qquad
          E_{AB} = \ln \frac{1}{|A| |B|} \sum_{a \in A, b \in B} e^{E_{ab}}

with A, B the grids of two causes' nonlinear parameters. A candidate whose coefficients have one common size
is always the first of its pair, at the size that it would have alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate, Group, slices
from magbridge.diagnose.inference.evidence import (
    FALSE_ALARM_RATE,
    REMNANT,
    bayes_factor_threshold,
    log_bayes,
    one_sided,
    score,
)
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.state import State
from magbridge.diagnose.inference.statistic import Statistic

__all__ = ["AT_ONCE", "Pair", "pairs_of"]

AT_ONCE = 4
"""Regressors of a model, beyond which no two are replaced at once: each two take a table of all pairs."""
PAIR_COLUMNS = 128
"""Columns of candidates that are scored at once: enough to outweigh a call, few enough for a core's cache."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two candidates in the places of one or two of a model; the log evidence that their grids lack."""

    first: Candidate
    second: Candidate
    behind: float


class _Stack:
    """Candidates with the same number of free coefficients, scored all at once."""

    def __init__(
        self, places: Sequence[int], at: Sequence[slice], candidates: Sequence[Candidate], info: Information
    ) -> None:
        self.places = np.array(places)
        self.index = np.array([np.r_[at[k]] for k in places])
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
    state: State, info: Information, model: Sequence[Candidate], base: Joint, *places: int
) -> list[Pair]:
    """Return the pairs that could replace the causes of `model` at one or two places, the likeliest first.

    `info` is that of all candidates and of `model`, whose columns are the last
    (:meth:`~.state.State.conditional_on`), and `base` the model's fit.
    """
    table = _Table(state, info, model, base, places)
    groups = list(table.members)
    pairs = (table.pair(A, B) for n, A in enumerate(groups) for B in groups[n:])
    return sorted((pair for pair in pairs if pair is not None), key=lambda pair: pair.behind)


class _Table:
    """Log evidences of all pairs in the place of one or two causes of a model."""

    def __init__(
        self, state: State, info: Information, model: Sequence[Candidate], base: Joint, places: Sequence[int]
    ) -> None:
        first = state.at[-1].stop
        here = [slices(model, first)[n] for n in places]
        self.info = info.instead(base, *here)
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
        if len(groups) == 1:
            standing, grid = self.scores[m], [self.scores[n].evidence for n in self.state.groups[groups[0]]]
            needed = bayes_factor_threshold(min(standing.ratio, whole))
            # the pair pays for one more cause, which must not be what the single one's regressor leaves
            price = needed + float(np.log(len(self.state.look_elsewhere)))
            return standing.evidence + _average(np.array(grid)) + price, needed
        found = []
        for a, b in ((m, m + 1), (m + 1, m)):
            first = self.scores[a]
            second = score(self.info.without(np.r_[self.at[a]], first.prior), self.at[b], self.candidates[b])
            found.append((first.evidence + second.evidence, first.ratio + second.ratio))
        best, ratio = max(found)
        return best + self._price(*groups), bayes_factor_threshold(min(ratio, whole))

    def _price(self, A: Group, B: Group) -> float:
        """Log of the evidence's average over two grids, relative to the best there."""
        return _average(self.evidence[np.ix_(self.state.groups[A], self.state.groups[B])])

    def pair(self, A: Group, B: Group) -> Pair | None:
        """Return the best of two grids, unless what stands beats it by the Bayes-factor threshold."""
        current = [candidate.group for candidate in self.standing]
        block = self.evidence[np.ix_(self.members[A], self.members[B])]
        top = float(block.max())
        if (
            (len(current) > 1 and {A, B} == set(current))
            or (len(current) == 1 and current[0] in (A, B))
            or not np.isfinite(top)
        ):
            return None
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
