"""Decide whether names are asserted, against descriptions of the same signal without a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate, Group
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.evidence import ODDS, REMNANT, log_odds, margin
from magbridge.diagnose.inference.rivals import Rival
from magbridge.diagnose.inference.search import Outcome
from magbridge.diagnose.inference.state import Hypothesis, shaped_ratio
from magbridge.diagnose.unexplained.leftover import Leftover, leftover
from magbridge.diagnose.unexplained.varying import varying

__all__ = ["accept"]


def accept(problem: Problem, outcome: Outcome, tone: Candidate | None) -> tuple[bool, Leftover | None]:
    """Say whether the names are asserted, and describe what is left beside them, or else the whole signal.

    Names and free descriptions both pay for the number of alternatives they were chosen from. The evidence of
    a description of what the names leave is added to theirs; unless it is a remnant of one of the named
    causes, they pay for it as for a further cause. A cause that the table lacks is a rival like any other:
    names are asserted if they are likelier than every description of the whole signal, and remain possible
    unless one beats them 20:1, the error of their regressors allowed for.
    """
    model = [h.candidate for h in outcome.chosen]
    uneven = [one for candidate in model if (one := varying(problem, candidate, outcome.trials)) is not None]
    rest = leftover(problem, model, outcome.fit, tone, also=uneven)
    if not model:
        return False, rest
    ratio = 2.0 * (outcome.fit.log_likelihood - outcome.null.log_likelihood)
    shaped = shaped_ratio(ratio, model, outcome.fit)
    names = log_odds(ratio, model, outcome.trials, shaped) - float(np.log(len(outcome.trials)))
    if rest is not None:
        names += rest.among
        if rest.signal_to_noise < REMNANT * max(h.signal_to_noise for h in outcome.chosen):
            rest = None
    # a description that contains the names' own regressors, with nothing else beside them, is no alternative
    alone = rest is None or _same(outcome.chosen, rest)
    but = model if alone else ()
    free = leftover(problem, [], outcome.null, tone, but=but, also=uneven)
    if not alone:
        names -= ODDS
    if free is None or names >= free.among:
        return True, rest
    return False, free._replace(within=_within(outcome, free.among - names))


def _same(chosen: Sequence[Hypothesis], rest: Leftover) -> bool:
    """Say whether the rest is what the idealised regressor of a stronger named cause has left."""
    description = rest.description
    if description is None or description.wider:
        return False
    return any(description.covers([h.candidate]) and h.signal_to_noise > rest.signal_to_noise for h in chosen)


def _within(outcome: Outcome, behind: float) -> tuple[Rival, ...]:
    """Return the names, and their rivals, the likeliest first.

    A description beats the names by `behind`; rivals are those that it does not beat by their margin. Its
    shape follows the data, whereas a regressor is idealised, a named cause's as well as its rivals'.
    """
    found: dict[Group, Rival] = {}
    for hypothesis, rivals in zip(outcome.chosen, outcome.rivals, strict=True):
        limit = margin(hypothesis.ratio)
        for one in (Rival(hypothesis.candidate, 0.0), *rivals):
            known = found.get(one.candidate.group)
            if one.behind + behind < limit and (known is None or one.behind + behind < known.behind):
                found[one.candidate.group] = replace(one, behind=one.behind + behind)
    return tuple(sorted(found.values(), key=lambda one: one.behind))
