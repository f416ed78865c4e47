"""Two causes at once: the whole table of pairs against one by one; two that take each other's place."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from posed import candidate, right

from magbridge.diagnose.alternatives import _separate, exchanged, pairs_of, sets_of
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.evidence import FALSE_ALARM_RATE, score
from magbridge.diagnose.search import _backward_elimination
from magbridge.diagnose.state import SearchState

ROWS = 600


@pytest.fixture(scope="module")
def state() -> SearchState:
    """Two causes that act, one that looks like both, one like the first, and a stranger."""
    rng, t = np.random.default_rng(5), np.arange(ROWS)
    a, b = np.sin(t / 7.0), np.sign(np.sin(t / 40.0))
    problem = replace(right(ROWS), residual=a + b + rng.normal(size=ROWS))
    both, alike, other = (
        a + b + 0.3 * np.cos(t / 90.0),
        a + 0.2 * np.cos(t / 11.0),
        rng.normal(size=(2, ROWS)),
    )
    candidates = [
        candidate("a", a), candidate("b", b, positive=True), candidate("both", both),
        candidate("alike", alike), candidate("other", other.T),
        candidate("series", rng.normal(size=(4, ROWS)).T, spectra=np.ones((1, 4))),
    ]  # fmt: skip
    found = SearchState(problem, candidates, 1, 6)
    found.round([], found.null)
    return found


def test_all_pairs_at_once_are_one_after_the_other(state: SearchState) -> None:
    """A single name loses to each pair by the evidence of both, the second given the first."""
    model = [state.candidates[2], state.candidates[4]]
    base = state.fit(model)
    info = state.conditional_on(model, base)
    pairs = {(pair.first.cause, pair.second.cause): pair for pair in pairs_of(state, info, model, base, 0, 1)}
    ends = np.cumsum([state.at[-1].stop, *(c.size for c in model)])
    own = np.arange(ends[0], ends[-1])
    alone = replace(info, score=info.score + info.matrix[:, own] @ base.coefficients)

    def together(a: slice, one: Candidate, b: slice, two: Candidate) -> float:
        first = score(alone, a, one)
        return first.evidence + score(alone.projected_out(np.r_[a], first.prior), b, two).evidence

    places = [slice(int(x), int(y)) for x, y in pairwise(ends)]
    standing = max(together(places[n], model[n], places[1 - n], model[1 - n]) for n in (0, 1))
    single = {c.cause: (at, c) for at, c in zip(state.at, state.candidates, strict=True)}
    pairs = {names: pair for names, pair in pairs.items() if set(names) <= single.keys() - {"both", "other"}}
    assert pairs
    for names, pair in pairs.items():
        there = max(together(*single[x], *single[y]) for x, y in (names, names[::-1]))
        assert pair.behind == pytest.approx(standing - there, abs=1e-6)


def test_two_take_the_place_of_one_that_had_swallowed_both(state: SearchState) -> None:
    alone = [state.candidates[2]]
    model, base = exchanged(state, alone, state.fit(alone))
    assert {one.cause for one in model} == {"a", "b"}
    assert state.value(model, base) > state.value(alone, state.fit(alone))


def test_a_cause_that_is_not_worth_a_further_one_is_dropped(state: SearchState) -> None:
    """It passes its test, but two others of S/N 17 and 24 may leave as much."""
    a, b, other = (state.candidates[k] for k in (0, 1, 4))
    weak = copy(state)
    residual = 0.2 * other.columns(slice(None))[:, 0]
    weak.problem = replace(state.problem, residual=state.problem.residual + residual)
    weak.null = weak.fit([])
    base = weak.fit([a, b, other])
    ratio = weak.ratio(base) - weak.ratio(weak.fit([a, b]))
    assert weak.p_value(other, ratio, other.size) < FALSE_ALARM_RATE
    chosen, _ = _backward_elimination(weak, [a, b, other], base)
    assert [h.candidate for h in chosen] == [a, b]


def test_the_sets_hold_whatever_a_whole_within_20_to_1_is_made_of(state: SearchState) -> None:
    model = [state.candidates[3], state.candidates[1]]
    base = state.fit(model)
    sets = sets_of(state, state.conditional_on(model, base), model, base)
    assert "a" in {competitor.candidate.cause for competitor in sets[0]}
    assert "other" not in {competitor.candidate.cause for some in sets for competitor in some}


def test_numbers_of_one_common_size_stay_a_whole(state: SearchState) -> None:
    """No exchange makes a series and a part of it one cause's regressors."""
    series, other = state.candidates[5], replace(state.candidates[4], cause="series")
    assert not _separate([other], [series, state.candidates[0]], [1])
    assert _separate([other], [series, state.candidates[0]], [0])
