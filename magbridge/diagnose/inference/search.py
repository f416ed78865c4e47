r"""The search: which causes the data speak for, one after the other.

Notes
-----
Candidates are scored (:mod:`.weigh`) under two noises, since the noise of the model so far may have swallowed an effect:
that one, and the noise that is left when every cause may take what it can. The best of each cause are then fitted
jointly with noise and calibration. The best that passes the test is added; so on while one does; then what later
findings have made needless is dropped. A cause that is found again is not another cause but needs more than one of
its regressors: they become one candidate.

What a cause's place could be taken by is read off one matrix at the end: the information of all candidates under the
noise that is left, the other causes projected out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.fit_noise import memory_order
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint, fit_joint
from magbridge.diagnose.inference.rivals import Rival, rivals_of
from magbridge.diagnose.inference.rounds import Hypothesis, State, key
from magbridge.diagnose.inference.weigh import LEVEL, ODDS, REMNANT, evidence_of, lead, score, slack, weigh

__all__ = ["Hypothesis", "Outcome", "search", "worth"]

FloatArray = NDArray[np.float64]

MOST = 6
"""Regressors in one log."""
EXCHANGES = 3
"""Rivals that are tried in a cause's place."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a search ends with.

    Attributes
    ----------
    chosen : tuple of Hypothesis
        In the order found; each against the model without it.
    rivals : tuple of tuple of Rival
        For each chosen one, all others that it does not beat by :func:`~.weigh.lead`, the best first.
    null, fit : Joint
        Without any cause, and with the chosen ones.
    order : int
        Memory of the noise.
    tested : dict
        Cause -> (smallest p-value, ratio) of the first round.
    info : Information
        Of all candidates under the noise that is left, only the calibration projected out.
    trials : dict
        Independent hypotheses behind each cause.
    """

    chosen: tuple[Hypothesis, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    null: Joint
    fit: Joint
    order: int
    tested: dict[str, tuple[float, float]]
    info: Information
    trials: dict[str, float]


def search(problem: Problem, candidates: Sequence[Candidate], causes: int) -> Outcome:
    """Find the causes that the data speak for.

    Parameters
    ----------
    problem : Problem
    candidates : sequence of Candidate
        Of all causes.
    causes : int
        How many causes were asked about.
    """
    rough = fit_joint(problem, [], 1, rounds=2)
    order = memory_order(rough.left, problem.survey.follows)
    state = State(problem, candidates, order, causes)
    null = state.fit([])
    state.blocks = bool(np.ptp(null.noise.scale))  # likelihoods that are compared have one kind of noise
    first = state.round([], null) if candidates else []
    tested: dict[str, tuple[float, float]] = {}
    for h in first:
        if h.p_value <= tested.get(h.candidate.cause, (np.inf, 0.0))[0]:
            tested[h.candidate.cause] = (h.p_value, h.ratio)
    model, base = _chain(state, null, first)
    together = _together(state) if first else []

    def value(model: Sequence[Candidate], fit: Joint) -> float:
        # what an idealised regressor leaves is not yet another cause
        ratio, causes = 2.0 * (fit.log_likelihood - null.log_likelihood), {c.cause for c in model}
        narrow = sum(candidate.narrow for candidate in model)
        return worth(ratio, model, state.trials) - narrow - len(causes) * slack(ratio)

    found = [_exchanged(state, model, base, null)] if model else [(model, base)]
    if together and (model or len(together) > 1) and {key(c) for c in together} != {key(c) for c in model}:
        # one after the other may have gone astray where several causes act; a single one has had its test
        found.append(_exchanged(state, *_refined(state, together, state.fit(together, rounds=6)), null))
    model, base = max(found, key=lambda entry: value(*entry))
    if len({candidate.cause for candidate in model}) > 1:
        alone = _enough(state, first)
        if alone is not None and value([alone.candidate], alone.fit) > value(model, base):
            alone = state.sharpen([], alone, null)
            model, base = [alone.candidate], alone.fit
    chosen, base = _remove(state, model, base, null)
    model = [h.candidate for h in chosen]
    info = state.beside(model, base) if chosen or not first else state.own
    rivals = tuple(rivals_of(state, info, model, base, k) for k in range(len(chosen)))
    return Outcome(tuple(chosen), rivals, null, base, order, tested, info, state.trials)


def worth(ratio: float, model: Sequence[Candidate], trials: Mapping[str, float]) -> float:
    """Log evidence of a whole model of this likelihood ratio.

    Every regressor pays for the hypotheses behind it that it was chosen from, and those after the first for the odds that
    so much goes wrong in one log, and for their choice among the causes. How narrowly the data then hold the nonlinear
    parameters counts between names alone: a free description is profiled, too, and pays nothing for it.
    """
    further = max(sum(candidate.parts for candidate in model) - 1, 0) * (ODDS + float(np.log(len(trials))))
    grids = sum(candidate.parts * float(np.log(trials[candidate.cause])) for candidate in model)
    return _evidence(ratio, model) - further - grids


def _evidence(ratio: float, model: Sequence[Candidate]) -> float:
    """Log evidence of a whole model, its nonlinear parameters given."""
    free = sum(candidate.size for candidate in model if candidate.spectra is None)
    sided = float(np.log(2.0)) * sum(candidate.positive for candidate in model)
    spectra = sum(
        float(np.log(len(candidate.spectra))) for candidate in model if candidate.spectra is not None
    )
    return (weigh(ratio, free) if free else 0.5 * ratio) + sided - spectra


def _chain(state: State, null: Joint, first: list[Hypothesis]) -> tuple[list[Candidate], Joint]:
    """Add cause after cause while one passes the test, beginning with the best of `first`."""
    model: list[Candidate] = []
    base, found = null, first
    heard: dict[str, float] = {}
    for _ in range(MOST):
        # numbers of one common size are a whole: it neither grows nor is a part
        whole = {c.cause for c in model if c.spectra is not None}
        grown = [
            h for h in found if h.candidate.cause not in (whole if h.candidate.spectra is None else heard)
        ]
        best = _next(grown, heard, 2.0 * (base.log_likelihood - null.log_likelihood))
        if best is None:
            break
        best = state.sharpen(model, best, base)
        cause = best.candidate.cause
        heard[cause] = max(heard.get(cause, 0.0), best.signal_to_noise)
        model, base = _with(state, model, best)
        found = state.round(model, base)
    return model, base


def _together(state: State) -> list[Candidate]:
    """Choose causes under the noise that is left when every cause takes what it can, one beside the other.

    All in the matrix of the first round: there the noise has swallowed nothing, and each is measured with the calibration
    and those before it free.
    """
    info = state.bare
    picked: list[int] = []
    loudest, ratio = 0.0, 0.0
    while len(picked) < MOST:
        scores = state.scores(info)
        ranked = sorted(
            ((scores[k].evidence + price, k) for k, price in state.best(scores).values()), reverse=True
        )
        sure = []
        for evidence, k in ranked:
            s, candidate = scores[k], state.candidates[k]
            size = float(np.sqrt(max(s.ratio - s.freedom, 0.0)))
            heard = state.p_value(candidate, s.ratio, s.freedom) < LEVEL and size >= REMNANT * loudest
            if heard and candidate.cause not in {state.candidates[j].cause for j in picked}:
                sure.append((evidence, k))
        if not sure:
            break
        alike = [k for evidence, k in sure if evidence >= sure[0][0] - slack(ratio)]
        k = min(alike, key=lambda k: state.candidates[k].size)
        picked.append(k)
        ratio += scores[k].ratio
        loudest = max(loudest, float(np.sqrt(max(scores[k].ratio - scores[k].freedom, 0.0))))
        info = info.without(np.arange(state.at[k].start, state.at[k].stop), scores[k].prior)
    return [state.candidates[k] for k in picked]


def _enough(state: State, first: list[Hypothesis]) -> Hypothesis | None:
    """Return the best single cause, if there is one, beside which nothing else would be found."""
    members = {(id(c.columns)): k for k, c in enumerate(state.candidates)}
    for h in first:
        k = members[id(h.candidate.columns)]
        s = score(state.bare, state.at[k], h.candidate)
        if h.p_value >= LEVEL or not s.freedom:
            continue
        left = state.bare.without(np.arange(state.at[k].start, state.at[k].stop), s.prior)
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


def _refined(state: State, model: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Profile the nonlinear parameters of each member of a model beside the others."""
    for _ in range(len(model)):
        own, others = model[0], model[1:]
        rest = state.fit(others, plain=False)
        c = np.append(base.coefficients[own.size :], base.coefficients[: own.size])
        there = state.fit([*others, own], np.append(base.z, c), plain=False, like=base, rounds=1)
        ratio = 2.0 * (there.log_likelihood - rest.log_likelihood)
        best = state.sharpen(others, Hypothesis(own, ratio, 0.0, 0.0, there), rest)
        model, base = [*others, best.candidate], best.fit
    return model, base


def _exchanged(
    state: State, model: list[Candidate], base: Joint, null: Joint
) -> tuple[list[Candidate], Joint]:
    """Put a rival in a cause's place, profiled there, as long as the evidence of the whole grows.

    What was found first was chosen without what was found later.
    """

    def evidence(model: Sequence[Candidate], fit: Joint) -> float:
        ratio = 2.0 * (fit.log_likelihood - null.log_likelihood)
        return _evidence(ratio, model) - sum(candidate.narrow for candidate in model)

    for _ in range(MOST):
        info, own = state.beside(model, base), evidence(model, base)
        tried = []
        for k in range(len(model)):
            best: dict[str, Rival] = {}
            for rival in rivals_of(state, info, model, base, k):
                best.setdefault(rival.cause, rival)
            best.pop(model[k].cause, None)
            others = model[:k] + model[k + 1 :]
            rest = state.fit(others) if best else base
            for rival in list(best.values())[:EXCHANGES]:
                fit = state.fit([*others, rival.candidate], like=base)
                ratio = 2.0 * (fit.log_likelihood - rest.log_likelihood)
                there = state.sharpen(others, Hypothesis(rival.candidate, ratio, 0.0, 0.0, fit), rest)
                changed = [*others, there.candidate]
                tried.append((evidence(changed, there.fit) + rival.cheaper - own, changed, there.fit))
        gain, *_ = better = max(tried, key=lambda entry: entry[0], default=(0.0, model, base))
        if gain <= 0.0:
            break
        _, model, base = better
    return model, base


def _next(found: list[Hypothesis], heard: Mapping[str, float], ratio: float) -> Hypothesis | None:
    """Pick the best that passes the test; of what idealised regressors may have left, only more of the same cause.

    `heard` holds the signal-to-noise of the causes that are in the model, `ratio` is its likelihood ratio.

    More of a cause that is there already comes before another that explains hardly more; and fewer numbers before more,
    where what the model has left may be what makes the difference.
    """

    def left(cause: str) -> float:
        return REMNANT * max((size for other, size in heard.items() if other != cause), default=0.0)

    sure = [h for h in found if h.p_value < LEVEL and h.signal_to_noise >= left(h.candidate.cause)]
    if not sure:
        return None
    near = sure[0].evidence - lead(sure[0].ratio)
    more = next((h for h in sure if h.candidate.cause in heard and h.evidence > near), None)
    alike = [h for h in sure if h.evidence >= sure[0].evidence - slack(ratio)]
    return more or min(alike, key=lambda h: h.candidate.size)


def _with(state: State, model: list[Candidate], best: Hypothesis) -> tuple[list[Candidate], Joint]:
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


def _remove(state: State, model: list[Candidate], base: Joint, null: Joint) -> tuple[list[Hypothesis], Joint]:
    """Drop what later findings have made needless; measure what stays against the model without it."""
    chosen: list[Hypothesis] = []
    k = 0
    while k < len(model):
        own, others = model[k], model[:k] + model[k + 1 :]
        without = state.fit(others) if others else null
        ratio = max(0.0, 2.0 * (base.log_likelihood - without.log_likelihood))
        p_value = state.p_value(own, ratio, own.freedom)
        if p_value >= LEVEL:
            model, base, chosen, k = others, without, [], 0
            continue
        c, at = base.coefficients, sum(candidate.size for candidate in model[:k])
        last = np.concatenate([c[:at], c[at + own.size :], c[at : at + own.size]])
        fit = state.fit([*others, own], np.append(base.z, last), plain=False, like=base, rounds=1)
        chosen.append(Hypothesis(own, ratio, evidence_of(own, ratio, own.freedom), p_value, fit))
        k += 1
    return chosen, base
