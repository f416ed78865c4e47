"""Decide whether names are asserted: against descriptions of the same signal without one, or noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate, Group
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import Problem, with_slow_noise
from magbridge.diagnose.inference.competing import CompetingHypothesis
from magbridge.diagnose.inference.evidence import ODDS, REMNANT, bayes_factor_threshold, log_odds
from magbridge.diagnose.inference.fit_noise import autoregressive_order
from magbridge.diagnose.inference.hypothesis import Hypothesis, shaped_ratio
from magbridge.diagnose.inference.joint import Joint, fit_joint
from magbridge.diagnose.inference.left_out import held_out
from magbridge.diagnose.inference.search import Outcome, beside_slow_noise, search
from magbridge.diagnose.unexplained.leftover import Leftover, leftover
from magbridge.diagnose.unexplained.varying import varying

__all__ = ["accept", "odds_over_random_walk", "settle"]

AGAINST = 2.0
"""Log odds of the held-out dives against the names from which on names are rejected. These odds are noisy: of
14 right names of S/N 8 one had 1.9, of ten wrong ones of unlisted effects four had more."""


def accept(problem: Problem, outcome: Outcome, tone: Candidate | None) -> tuple[bool, Leftover | None]:
    """Decide whether the names are asserted, and describe the remaining signal, or else the whole signal.

    Names and free descriptions both pay for the number of alternatives they were chosen from. The evidence of
    a description of the remaining signal is added to the names' evidence; unless it is a remnant of one of
    the named causes, the names pay for it as for a further cause. A cause that the table lacks competes like
    any other: names are asserted if they are likelier than every description of the whole signal, and predict
    every eighth dive as well. They remain possible unless one beats them 20:1, allowing for the error of
    their regressors.
    """
    model = [h.candidate for h in outcome.chosen]
    uneven = [
        one for candidate in model if (one := varying(problem, candidate, outcome.look_elsewhere)) is not None
    ]
    rest = residual = leftover(problem, model, outcome.fit, tone, also=uneven)
    if not model:
        return False, rest
    ratio = 2.0 * (outcome.fit.log_likelihood - outcome.null.log_likelihood)
    shaped = shaped_ratio(ratio, model, outcome.fit)
    names = log_odds(ratio, model, outcome.look_elsewhere, shaped) - float(
        np.log(len(outcome.look_elsewhere))
    )
    if rest is not None:
        names += rest.among
        if rest.signal_to_noise < REMNANT * max(h.signal_to_noise for h in outcome.chosen):
            rest = None
    # a description that contains the names' own regressors and nothing else is not an alternative
    alone = rest is None or _same(outcome.chosen, rest)
    but = model if alone else ()
    free = leftover(problem, [], outcome.null, tone, but=but, also=uneven)
    if not alone:
        names -= ODDS
    if free is None:
        return True, rest
    ours = _foretold(problem, [candidate.columns for candidate in model], outcome.fit, residual)
    behind = max(free.among - names, _foretold(problem, [], outcome.null, free) - ours - AGAINST)
    if behind <= 0.0:
        return True, rest
    return False, free._replace(within=_within(outcome, behind))


def settle(
    problem: Problem, candidates: Sequence[Candidate], causes: int, tone: Candidate | None
) -> tuple[Outcome, bool, Leftover | None]:
    """Search, and return the selected outcome with the result of :func:`accept`.

    Slow noise absorbs part of the signal that descriptions represent, and so makes names look better. So if
    the names found without slow noise are not asserted, or something switches, no search with it is made.
    """
    plain = search(problem, candidates, causes)
    asserted, rest = accept(problem, plain, tone)
    if not asserted or plain.switches:
        return plain, asserted, rest
    outcome = beside_slow_noise(plain, candidates, causes)
    return outcome, *((True, rest) if outcome is plain else accept(outcome.problem, outcome, tone))


def _foretold(problem: Problem, model: Sequence[Columns], fit: Joint, best: Leftover | None) -> float:
    """Return the log odds by which a model with the best description, if any, predicts every eighth dive.

    Descriptions that were picked from many places or periods pay for that, as in the fit.
    """
    scores = [held_out(problem, model, fit, interleaved=True).score]
    for one in best.fitted if best else ():
        score = held_out(problem, [*model, one.columns], one.fit, interleaved=True).score
        scores.append(score - float(np.log(one.look_elsewhere)))
    return max(scores)


def _same(chosen: Sequence[Hypothesis], rest: Leftover) -> bool:
    """Return True if the rest is a remnant of the idealised regressor of a stronger named cause."""
    description = rest.description
    if description is None or description.wider:
        return False
    return any(description.covers([h.candidate]) and h.signal_to_noise > rest.signal_to_noise for h in chosen)


def _within(outcome: Outcome, behind: float) -> tuple[CompetingHypothesis, ...]:
    """Return the names, and their competing hypotheses, the likeliest first.

    A description beats the names by `behind`; those that it does not beat by their threshold stay. Its
    shape follows the data, whereas the regressors of all causes are idealised.
    """
    found: dict[Group, CompetingHypothesis] = {}
    for hypothesis, competing in zip(outcome.chosen, outcome.competing, strict=True):
        limit = bayes_factor_threshold(hypothesis.ratio)
        for one in (CompetingHypothesis(hypothesis.candidate, 0.0), *competing):
            known = found.get(one.candidate.group)
            if one.behind + behind < limit and (known is None or one.behind + behind < known.behind):
                found[one.candidate.group] = replace(one, behind=one.behind + behind)
    return tuple(sorted(found.values(), key=lambda one: one.behind))


def odds_over_random_walk(outcome: Outcome, own: Hypothesis) -> float:
    """Return the log odds of one cause that was chosen over offsets that wander in its place.

    Notes
    -----
    A random walk has a power of 1/f^2: half waves of variance ``g / k^2`` in place of the ``g / k`` of
    :mod:`~magbridge.diagnose.compare.slow_noise`. Most of that is of the lowest frequencies, of which a step
    or a drift of a low signal-to-noise is, too, so a log may not distinguish them. Both are compared by their
    evidence, each autoregression at Akaike's price: with a walk it is shorter.
    """
    slots, noise = outcome.problem.survey.slots, outcome.null.noise
    others = [one.candidate for one in outcome.chosen if one is not own]
    columns, spectra = [one.columns for one in others], [one.spectra for one in others]
    walking = with_slow_noise(outcome.problem, 2)
    rough = fit_joint(walking, columns, 1, spectra=spectra, rounds=2)
    order = autoregressive_order(rough.residual, slots)
    walk = fit_joint(walking, columns, order, spectra=spectra, blocks=noise.uneven)
    without = fit_joint(outcome.problem, columns, noise.past.order, spectra=spectra, blocks=noise.uneven)
    # coefficients that the remainder does not need have each gained half a log-likelihood unit by chance
    price = 0.5 * (noise.past.order + autoregressive_order(outcome.fit.residual, slots))
    price += float(np.log(outcome.look_elsewhere[own.candidate.cause]))
    return own.evidence - price + without.log_likelihood - (walk.log_likelihood - order)
