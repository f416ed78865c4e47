r"""The search for the causes that the data support, one after the other.

Notes
-----
Candidates are scored (:mod:`.evidence`) under two noises: that of the model so far, and that which is left
when the best candidate of every cause is fitted, because the former may have absorbed an effect. The best of
each cause are then fitted jointly with noise and calibration. The best that passes the test is added, and so
on while one does. A cause that is found again needs more than one regressor: these become one candidate. Then
causes are exchanged for competing hypotheses (:mod:`.competing`). Last, causes that later findings have made
needless are dropped.

Slow noise may have absorbed the joint effect of several causes: then none is significant on its own.
So a second start finds causes under noise of a short correlation, and compares them under noise of any. A
switching signal uses regressor after regressor, and none describes it: if the level still shifts at many
places that the first few do not explain (:func:`~.outliers.switches`), the search ends.

Asserted causes are then searched for again under noise that grows towards low frequencies, if that gains
anything (:mod:`~.compare.slow_noise`), and the likelier result is kept: a cause that only represents such
noise is not found. The competing hypotheses are read off one matrix at the end: the information of all
candidates under the noise that is left, the other causes projected out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.problem import Problem, with_slow_noise
from magbridge.diagnose.inference.competing import CompetingHypothesis, exchanged, sets_of
from magbridge.diagnose.inference.evidence import (
    FALSE_ALARM_RATE,
    MOST_REMAINING,
    REMNANT,
    SMOOTH,
    evidence_of,
    regressor_error,
)
from magbridge.diagnose.inference.fit_noise import BRIEFEST, autoregressive_order
from magbridge.diagnose.inference.hypothesis import Hypothesis, shaped_ratio
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.isolability import CONFOUNDED, likeness, most_visible
from magbridge.diagnose.inference.joint import Joint, fit_joint
from magbridge.diagnose.inference.left_out import held_out
from magbridge.diagnose.inference.outliers import switches
from magbridge.diagnose.inference.profile_likelihood import refined, sharpen
from magbridge.diagnose.inference.state import State

__all__ = ["Outcome", "beside_slow_noise", "search"]

MAX_REGRESSORS = 6
"""Regressors found one by one in a log, at most."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a search."""

    problem: Problem
    """With slow noise, if that is the likelier."""
    chosen: tuple[Hypothesis, ...]
    """In the order found; each against the model without it."""
    competing: tuple[tuple[CompetingHypothesis, ...], ...]
    """For each chosen one, all others that it does not beat by
    :func:`~.evidence.bayes_factor_threshold`, the best first."""
    null: Joint
    fit: Joint
    """`null`, `fit`: fits without any cause, and with the chosen ones."""
    p_value: float
    """The smallest of the first round."""
    info: Information
    """Of all candidates under the noise that is left, only the calibration projected out."""
    look_elsewhere: dict[str, float]
    """Cause -> number of independent hypotheses behind it."""
    evidence: float
    """Log evidence of the causes found and of their noise, against the null without slow noise."""
    switches: bool
    """True if the search ended because of a switching signal that no cause describes."""


def search(
    problem: Problem, candidates: Sequence[Candidate], causes: int, plain: Joint | None = None
) -> Outcome:
    """Find the causes that the data support, among the candidates of so many `causes`, under one noise.

    `plain` is the null without slow noise, where the problem has such.
    """
    rough = fit_joint(problem, [], 1, rounds=2)
    order = autoregressive_order(rough.residual, problem.survey.slots)
    state = State(problem, candidates, order, causes)
    first = state.round([], state.null) if candidates else []
    p_value = min((h.p_value for h in first), default=1.0)
    model, base = _likeliest(state, first) if first else ([], state.null)
    ended = switches(base, model, state.causes)
    chosen, base = _backward_elimination(state, model, base)
    model = [h.candidate for h in chosen]
    info = state.conditional_on(model, base)
    competing = sets_of(state, info, model, base) if model else ()
    # Akaike's price of the autoregression, which slow noise makes shorter. Coefficients that the residual
    # no longer needs, for example after a step, have each gained only half a unit of log-likelihood by chance
    needed = autoregressive_order(base.residual, problem.survey.slots)
    evidence = state.value(model, base, plain) - 0.5 * (order + needed)
    return Outcome(
        problem, tuple(chosen), competing, state.null, base, p_value, info, state.look_elsewhere, evidence,
        ended,
    )  # fmt: skip


def beside_slow_noise(found: Outcome, candidates: Sequence[Candidate], causes: int) -> Outcome:
    """Repeat the search of the causes found, with slow noise; return the likelier outcome."""
    noisy, null = with_slow_noise(found.problem), found.null
    slow = fit_joint(noisy, [], null.noise.past.order, blocks=null.noise.uneven, like=null)
    if slow.log_likelihood <= null.log_likelihood:
        return found
    return max(found, search(noisy, candidates, causes, null), key=lambda outcome: outcome.evidence)


def _likeliest(state: State, first: list[Hypothesis]) -> tuple[list[Candidate], Joint]:
    """Return the likeliest of the models found with any noise, and with a short-lived one if need be."""
    model, base = _forward_selection(state, first)
    if switches(base, model, state.causes):
        return model, base
    if model:
        model, base = exchanged(state, model, base)
    if base.noise.slowest > BRIEFEST:  # it may have absorbed causes
        brief = state.with_brief_noise()
        slow, there = _forward_selection(brief, brief.round([], brief.null))
        if slow and not switches(there, slow, brief.causes):
            start = refined(state, slow, state.fit(slow, rounds=6))
            model, base = max((model, base), exchanged(state, *start), key=lambda entry: state.value(*entry))
    return model, base


def _forward_selection(state: State, first: list[Hypothesis]) -> tuple[list[Candidate], Joint]:
    """Add cause after cause while one passes the test, beginning with the best of `first`."""
    model: list[Candidate] = []
    base, found = state.null, first
    strengths: dict[str, float] = {}
    for _ in range(MAX_REGRESSORS):
        # a candidate of one common size is a whole: neither extended nor added to its cause's others
        whole = {c.cause for c in model if c.spectra is not None}
        grown = [
            h for h in found if h.candidate.cause not in (whole if h.candidate.spectra is None else strengths)
        ]
        best = _next(grown, strengths, shaped_ratio(state.ratio(base), model, base))
        if best is None:
            break
        best = sharpen(state, model, best, base)
        cause = best.candidate.cause
        strengths[cause] = max(strengths.get(cause, 0.0), _remnant(best))
        model, base = _added(state, model, best)
        if switches(base, model, state.causes):
            break
        found = state.round(model, base)
    return model, base


def _remnant(found: Hypothesis) -> float:
    """Return the signal-to-noise of what a cause's idealised regressor may leave of it."""
    size = found.signal_to_noise
    return min(SMOOTH * size, MOST_REMAINING) if found.candidate.nonparametric else REMNANT * size


def _next(found: list[Hypothesis], strengths: Mapping[str, float], ratio: float) -> Hypothesis | None:
    """Pick the best that passes, unless it is so weak that other causes' idealised regressors may leave it.

    `strengths` holds what the causes that are in the model may leave, `ratio` is the likelihood ratio of
    those that have a shape. Among candidates whose evidence differs by less than the regressors' errors
    may account for, the one with the fewest coefficients is preferred.
    """

    def remnant(cause: str) -> float:
        return max((size for other, size in strengths.items() if other != cause), default=0.0)

    significant = [
        h for h in found if h.p_value < FALSE_ALARM_RATE and h.signal_to_noise >= remnant(h.candidate.cause)
    ]
    as_likely = [h for h in significant if h.evidence >= significant[0].evidence - regressor_error(ratio)]
    return min(as_likely, key=lambda h: h.candidate.size, default=None)


def _added(state: State, model: list[Candidate], best: Hypothesis) -> tuple[list[Candidate], Joint]:
    """Add a candidate to the model, or to its cause's own if that is in it already."""
    new = best.candidate
    for k, own in enumerate(model):
        if own.cause == new.cause:
            grown = [*model[:k], own.with_(new), *model[k + 1 :]]
            at = sum(candidate.size for candidate in model[: k + 1])
            c = best.fit.coefficients
            c = np.concatenate([c[:at], c[-new.size :], c[at : -new.size]])
            return grown, state.fit(grown, np.append(best.fit.z, c), like=best.fit)
    return [*model, new], best.fit


def _backward_elimination(
    state: State, model: list[Candidate], base: Joint
) -> tuple[list[Hypothesis], Joint]:
    """Drop causes without which the model is likelier, or which fail their test given the others.

    Then drop the remnants of a Gaussian process, and causes that the held-out dives contradict.
    """
    chosen: list[Hypothesis] = []
    k = 0
    while k < len(model):
        own, others = model[k], model[:k] + model[k + 1 :]
        without = state.fit(others) if others else state.null
        ratio = max(0.0, 2.0 * (base.log_likelihood - without.log_likelihood))
        p_value = state.p_value(own, ratio, own.freedom)
        if p_value >= FALSE_ALARM_RATE or (
            others and state.value(others, without) > state.value(model, base)
        ):
            model, base, chosen, k = others, without, [], 0
            continue
        c, at = base.coefficients, sum(candidate.size for candidate in model[:k])
        last = np.concatenate([c[:at], c[at + own.size :], c[at : at + own.size]])
        fit = state.fit([*others, own], np.append(base.z, last), plain=False, like=base, rounds=1)
        chosen.append(Hypothesis(own, ratio, evidence_of(own, ratio, own.freedom), p_value, fit))
        k += 1
        if k == len(model) > 1 and (surplus := _surplus(state, chosen, base)) is not None:
            model = model[:surplus] + model[surplus + 1 :]
            base, chosen, k = state.fit(model), [], 0
    return chosen, base


def _surplus(state: State, chosen: Sequence[Hypothesis], base: Joint) -> int | None:
    """Return the place of the weakest cause if it is redundant given a Gaussian process or a similar cause.

    A process represents part of every slow shape, and its remnant of a map's error passes for a second one.
    Two correlated causes share a signal; if the second gains nothing on held-out dives, it is redundant.
    """
    smooth = max((_remnant(h) for h in chosen if h.candidate.nonparametric), default=0.0)
    k = min(range(len(chosen)), key=lambda n: chosen[n].signal_to_noise)
    model = [h.candidate for h in chosen]
    if model[k].nonparametric or not (smooth or _like_another(state, model, base, k)):
        return None
    others = model[:k] + model[k + 1 :]
    if chosen[k].signal_to_noise < smooth:
        return k
    counts = slice(None) if smooth else ~state.problem.survey.learned
    power = [
        np.sum(held_out(state.problem, [candidate.columns for candidate in some], fit).residual[counts] ** 2)
        for some, fit in ((others, state.fit(others)), (model, base))
    ]
    return k if power[0] < power[1] else None


def _like_another(state: State, model: Sequence[Candidate], base: Joint, k: int) -> bool:
    """Return True if in this log the k-th cause is strongly correlated with another of the model."""
    info = state.conditional_on(model, base)
    every = {state.candidates[n].group: n for n in most_visible(state.candidates, info, state.at)}
    own, *others = (every[candidate.group] for candidate in (model[k], *model[:k], *model[k + 1 :]))
    one, at = state.candidates[own], state.at[own]
    return any(likeness(info, one, at, state.candidates[n], state.at[n]) > CONFOUNDED for n in others)
