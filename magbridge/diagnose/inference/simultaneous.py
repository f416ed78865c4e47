"""A second start of the search: all causes chosen from one matrix, that of the first round.

Its noise has not absorbed an effect: it is what is left when the best candidate of every cause is fitted.
Where several causes act, the search one by one may go astray.
"""

from __future__ import annotations

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.evidence import LEVEL, REMNANT, regressor_error, score
from magbridge.diagnose.inference.rounds import Hypothesis, State

__all__ = ["MOST", "chosen_at_once", "enough"]

MOST = 6
"""Regressors chosen in one log, at most."""


def chosen_at_once(state: State) -> list[Candidate]:
    """Choose causes one after the other, each scored with the calibration and the earlier ones free."""
    info = state.cleared
    picked: list[int] = []
    loudest, ratio = 0.0, 0.0
    while len(picked) < MOST:
        scores = state.scores(info)
        ranked = sorted(
            ((scores[k].evidence + price, k) for k, price in state.best(scores).values()), reverse=True
        )
        significant = []
        for evidence, k in ranked:
            s, candidate = scores[k], state.candidates[k]
            size = float(np.sqrt(max(s.ratio - s.freedom, 0.0)))
            passed = state.p_value(candidate, s.ratio, s.freedom) < LEVEL and size >= REMNANT * loudest
            if passed and candidate.cause not in {state.candidates[j].cause for j in picked}:
                significant.append((evidence, k))
        if not significant:
            break
        as_likely = [
            k for evidence, k in significant if evidence >= significant[0][0] - regressor_error(ratio)
        ]
        k = min(as_likely, key=lambda k: state.candidates[k].size)
        picked.append(k)
        ratio += scores[k].ratio
        loudest = max(loudest, float(np.sqrt(max(scores[k].ratio - scores[k].freedom, 0.0))))
        info = info.without(np.arange(state.at[k].start, state.at[k].stop), scores[k].prior)
    return [state.candidates[k] for k in picked]


def enough(state: State, first: list[Hypothesis]) -> Hypothesis | None:
    """Return the best single cause beside which nothing else would be found, if there is one."""
    members = {(id(c.columns)): k for k, c in enumerate(state.candidates)}
    for h in first:
        k = members[id(h.candidate.columns)]
        s = score(state.cleared, state.at[k], h.candidate)
        if h.p_value >= LEVEL or not s.freedom:
            continue
        left = state.cleared.without(np.arange(state.at[k].start, state.at[k].stop), s.prior)
        others = [
            (candidate, other)
            for candidate, other in zip(state.candidates, state.scores(left), strict=True)
            if candidate.cause != h.candidate.cause
        ]
        quiet = REMNANT**2 * s.ratio
        if all(
            other.ratio - other.freedom < quiet
            or state.p_value(candidate, other.ratio, other.freedom) >= LEVEL
            for candidate, other in others
        ):
            return h
    return None
