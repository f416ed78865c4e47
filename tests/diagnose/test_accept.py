"""Names against descriptions of the whole: asserted if they are likelier, possible until they lose 20:1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed import candidate, missed, right

from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.columns import GridPoint
from magbridge.diagnose.evidence import bayes_factor_threshold
from magbridge.diagnose.leftover import varying
from magbridge.diagnose.problem import Problem
from magbridge.diagnose.run import accept
from magbridge.diagnose.search import search

ROWS = 300


def test_a_name_is_asserted_possible_or_ruled_out() -> None:
    """A name is worth less the more it was chosen from, but possible until beaten by its margin."""
    problem = right(ROWS)
    bent = 8.0 * (problem.survey.field / 5e4).prod(axis=1)
    problem = replace(problem, residual=bent + np.random.default_rng(9).normal(size=ROWS))
    name = candidate("a", bent)
    outcome = search(problem, [name], 1)
    output = []
    for price in np.arange(4.0, 9.0) * bayes_factor_threshold(outcome.chosen[0].ratio):
        stands, rest = accept(problem, replace(outcome, look_elsewhere={"a": float(np.exp(price))}), None)
        output.append(
            "asserted" if stands else "possible" if rest is not None and rest.within else "ruled out"
        )
    assert output == sorted(output)
    assert output.count("possible") == 1
    assert {"asserted", "ruled out"} < set(output)


def test_dives_left_out_overrule_a_name_that_fits() -> None:
    """For any prior: a name that only resembles the truth predicts less than a description."""
    problem, rng = right(ROWS), np.random.default_rng(10)
    bent = 8.0 * (problem.survey.field / 5e4).prod(axis=1)
    problem = replace(problem, residual=bent + rng.normal(size=ROWS))
    for share, named in ((0.0, True), (0.5, False)):
        alike = candidate(
            "a", bent + share * bent.std() * rng.normal(size=ROWS), point=GridPoint(likelier=300.0)
        )
        assert accept(problem, search(problem, [alike], 1), None)[0] == named


@pytest.mark.parametrize(("follows", "named"), [(0.0, True), (0.2, True), (1.0, False)])
def test_a_name_whose_size_follows_something_else_is_not_asserted(follows: float, named: bool) -> None:
    """A payload's current at S/N 14 or more, with leads that a moving mass separates."""
    problem, rng = right(ROWS), np.random.default_rng(10)
    drawn = np.where(np.sin(np.arange(ROWS) / 3.0) > 0.3, 1.0, 0.0)
    place = problem.survey.channels["p"].values
    away = drawn * (1.0 + follows * place / np.std(place[drawn > 0.0]))
    problem = replace(problem, residual=1.5 * away + rng.normal(size=ROWS))
    name = candidate("a", drawn, channel="amps")
    outcome = search(problem, [name], 1)
    assert [h.candidate for h in outcome.chosen] == [name]
    assert accept(problem, outcome, None)[0] == named


def test_the_size_of_a_cause_may_follow_all_but_its_own_channel(problem: Problem) -> None:
    """An effect of pressure and pitch together is held; the remainder is the square of the pressure."""
    survey, rows = problem.survey, slice(0, len(problem))
    assert survey.attitude is not None
    squeezed = next(c for c in CAUSES["pressure_offset"].candidates(problem) if c.channel == "depth")
    described = varying(problem, squeezed, {"pressure_offset": 2.0})
    assert described is not None
    X = described.columns(rows)
    assert X.shape[1] == described.widths[0][1].size

    own = squeezed.columns(rows)[:, 0]
    assert missed(own * (2.0 - survey.attitude[:, 1]), X) < 1e-9
    assert missed(own * np.cos(np.radians(survey.attitude[:, 2])), X) < 1e-9
    assert missed(own * survey.channels["depth"].values ** 2, X) > 1e-3
    assert described.covers([squeezed])
    slow = replace(squeezed, spectra=np.ones((1, squeezed.size)))
    assert varying(problem, slow, {"pressure_offset": 2.0}) is None
