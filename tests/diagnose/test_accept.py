"""Names against descriptions of the whole: asserted if they are likelier, possible until they lose 20:1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.accept import _within, accept
from magbridge.diagnose.inference.evidence import ODDS
from magbridge.diagnose.inference.search import search

ROWS = 300


def test_names_within_20_to_1_of_a_description_stay(right: Callable[[int], Problem]) -> None:
    """The name that loses least stays longest, and at 20:1 none is left."""
    t, rng = np.arange(ROWS), np.random.default_rng(8)
    acts = np.sign(np.sin(t / 9.0))
    said = {"a": acts, "like a": acts + 0.1 * rng.normal(size=ROWS), "b": rng.normal(size=ROWS)}
    candidates = [
        Candidate(cause, None, lambda rows, x=x: x[rows, None], np.ones(1), ("b",), ("nT",))
        for cause, x in said.items()
    ]
    outcome = search(replace(right(ROWS), residual=0.5 * acts + rng.normal(size=ROWS)), candidates, 3)
    steps = np.linspace(0.0, ODDS, 30)
    sets = [{rival.cause: rival.behind for rival in _within(outcome, behind)} for behind in steps]
    assert sets[0].keys() == {"a", "like a"}
    assert not sets[-1]
    for behind, within, less in zip(steps, sets, [*sets[1:], {}], strict=True):
        assert less.keys() <= within.keys()
        assert all(
            value < ODDS and np.isclose(value - behind, sets[0][cause]) for cause, value in within.items()
        )


def test_a_name_is_asserted_possible_or_ruled_out(right: Callable[[int], Problem]) -> None:
    """A name is worth less the more it was chosen from, but possible until a description beats it 20:1."""
    problem = right(ROWS)
    bent = 8.0 * (problem.survey.field / 5e4).prod(axis=1)
    problem = replace(problem, residual=bent + np.random.default_rng(9).normal(size=ROWS))
    name = Candidate("a", None, lambda rows: bent[rows, None], np.ones(1), ("b",), ("nT",))
    outcome = search(problem, [name], 1)
    said = []
    for price in np.arange(7.0, 15.0) * ODDS:
        stands, rest = accept(problem, replace(outcome, trials={"a": float(np.exp(price))}), None)
        said.append("asserted" if stands else "possible" if rest is not None and rest.within else "ruled out")
    assert said == sorted(said)
    assert said.count("possible") == 1
    assert {"asserted", "ruled out"} < set(said)
