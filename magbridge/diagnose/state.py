"""The steps of a search: score all causes given a model, fit the likeliest, profile and exchange causes.

A model is a list of candidates, not part of the state: each step has one as argument and returns another.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np
from scipy.special import chdtrc

from magbridge.arrays import FloatArray
from magbridge.diagnose.columns import Candidate, Columns, Group, Mixture, join_columns, parts, slices
from magbridge.diagnose.evidence import (
    FALSE_ALARM_RATE,
    Best,
    Hypothesis,
    Information,
    bayes_factor_threshold,
    evidence_of,
    information,
    log_odds,
    look_elsewhere_factors,
    regressor_error,
    score,
    shaped_ratio,
    wald_ratio,
)
from magbridge.diagnose.joint import RIDGE, Joint, fit_joint, in_threads, precomputed
from magbridge.diagnose.noise import ResidualNoise
from magbridge.diagnose.problem import Problem

MAX_SCREENED_SAMPLES = 65_536
"""Number of samples of a long log, in pieces spread evenly, on which a round screens the candidates."""
JOINTLY_FITTED_CAUSES, WORTH_FITTING = 9, 0.3
"""Largest number of causes fitted jointly in a round; their least log evidence as a fraction of the best."""
MAX_EXCHANGES, TRIED = 6, 3
"""Largest number of exchanges, and of replacements tried in each."""
COLUMNS, STAGES = 144, 2
"""Total columns of the values tried in a nonlinear parameter's bracket; number of narrowing stages."""


class SearchState:
    """Problem and candidates of one search, with quantities that its steps share.

    `null` is the fit without any cause, and `look_elsewhere` the number of hypotheses of each cause. Every
    `stride`-th piece of a log serves to screen candidates. If `brief`, noise has a short correlation time.
    """

    def __init__(self, problem: Problem, candidates: Sequence[Candidate], order: int, causes: int) -> None:
        self.problem, self.candidates, self.order, self.causes = problem, list(candidates), order, causes
        self.brief, self.stride = False, max(len(problem) // MAX_SCREENED_SAMPLES, 1)
        self.at = slices(self.candidates)
        self.columns = _made_once(len(problem), [candidate.columns for candidate in self.candidates])
        self.look_elsewhere: dict[str, float] = {}
        self.last: tuple[Joint | None, Information | None] = None, None
        self.groups: dict[Group, list[int]] = {}
        for k, candidate in enumerate(self.candidates):
            self.groups.setdefault(candidate.group, []).append(k)
        self.blocks: bool | None = None
        self.null = self.fit([])
        self.blocks = self.null.noise.uneven

    def with_brief_noise(self) -> SearchState:
        """Return a copy of the state whose noise has a correlation too short to imitate a slow cause."""
        brief = copy(self)
        brief.brief, brief.last = True, (None, None)
        brief.null = brief.fit([])
        return brief

    def fit(
        self,
        model: Sequence[Candidate],
        *starts: FloatArray,
        plain: bool = True,
        like: Joint | None = None,
        rounds: int = 4,
    ) -> Joint:
        """Return the joint fit of a model, with arguments as for :func:`~.joint.fit_joint`."""
        columns = [candidate.columns for candidate in model]
        # Prior precision 1 for errors of the reference and common sizes
        natural = [not c.effects or c.spectra is not None for c in model]
        ridge = np.repeat(np.where(natural, 1.0, RIDGE), [c.size for c in model])
        return fit_joint(
            self.problem, columns, self.order, *starts, plain=plain, spectra=[c.spectra for c in model],
            like=like, blocks=self.blocks, brief=self.brief, ridge=ridge, rounds=rounds,
        )  # fmt: skip

    def ratio(self, fit: Joint, null: Joint | None = None) -> float:
        """Return twice the gain in log likelihood over the fit without any cause, or over another `null`."""
        return 2.0 * (fit.log_likelihood - (null or self.null).log_likelihood)

    def value(self, model: Sequence[Candidate], fit: Joint, null: Joint | None = None) -> float:
        """Return the log evidence of a model relative to `null`, less the allowance for regressor errors."""
        ratio = self.ratio(fit, null)
        if not model:
            return 0.5 * ratio
        # Odds of the model, less the parameters' narrowness and the errors of idealised regressors
        causes, narrow = {candidate.cause for candidate in model}, sum(c.point.narrow for c in model)
        shaped = shaped_ratio(ratio, model, fit, slow=null is not None)
        return (
            log_odds(ratio, model, self.look_elsewhere, shaped)
            - narrow
            - len(causes) * regressor_error(shaped)
        )

    def best(self, info: Information) -> dict[Group, Best]:
        """Return the best candidate of each group (cause and channel) by log evidence."""
        found = {}
        for group, members in self.groups.items():
            scores = [score(info, self.at[k], self.candidates[k]) for k in members]
            evidences = np.array([s.evidence for s in scores])
            top = int(np.argmax(evidences))
            price = float(np.log(np.mean(np.exp(evidences - evidences[top]))))
            found[group] = Best(members[top], price, scores[top], info)
        return found

    def round(self, model: list[Candidate], base: Joint) -> list[Hypothesis]:
        """Return fits of the best causes, each added alone to `model`, the likeliest first."""
        # Score all candidates: under the noise of the model, then under that without the best of every cause
        screened = self._information_under(base.noise, model, base, self.stride) if self.stride > 1 else None
        as_fitted = (screened or self.conditional_on(model, base)).fitted(base)
        if not self.look_elsewhere:
            self.look_elsewhere = look_elsewhere_factors(as_fitted, self.candidates, self.at)
        under: dict[Group, list[Best]] = {}
        for info in (as_fitted, self._cleared(model, base, as_fitted)):
            for group, best in self.best(info).items():
                under.setdefault(group, []).append(best)
        # The likeliest of each group are fitted jointly with calibration and noise
        listed = sorted(under.values(), key=lambda won: -max(best.score.evidence for best in won))
        top = max(best.score.evidence for best in listed[0])
        least = min(top, WORTH_FITTING * top)
        listed = [
            won for won in listed[:JOINTLY_FITTED_CAUSES] if max(best.score.evidence for best in won) >= least
        ]
        # the largest, which take longest, first: then the threads end together
        tried = sorted(listed, key=lambda won: -self.candidates[won[0].place].size)
        found = in_threads(len(self.problem), partial(self._joint, model, base), tried)
        return sorted(found, key=lambda h: -h.evidence)

    def conditional_on(self, model: Sequence[Candidate], base: Joint) -> Information:
        """Return the information of all candidates, then `model`, with the calibration projected out."""
        known, info = self.last
        if known is not base:
            info = self._information_under(base.noise, model, base)
            self.last = base, info
        assert info is not None
        return info

    def _cleared(self, model: list[Candidate], base: Joint, info: Information) -> Information:
        """Return the information under the noise of a fit with the best candidate of every cause."""
        # The best candidate of each cause, all in one model with the prior of plausible sizes
        top: dict[str, Best] = {}
        for (cause, _), best in self.best(info).items():
            top[cause] = max(top.get(cause, best), best, key=lambda one: one.score.evidence)
        pool = [best.place for best in top.values()]
        index = np.r_[*(self.at[k] for k in pool)]
        taken = np.linalg.solve(info.matrix[np.ix_(index, index)] + np.eye(len(index)), info.score[index])
        # Start from the solution of that system under the present noise
        every = [*model, *(self.candidates[k] for k in pool)]
        everything = fit_joint(
            self.problem,
            [candidate.columns for candidate in every],
            self.order,
            np.append(info.moved(base, index, taken), taken),
            spectra=[candidate.spectra for candidate in every],
            ridge=1.0,
            rounds=1,
            brief=self.brief,
            stride=self.stride,
        )
        return self._information_under(everything.noise, model, base, self.stride).fitted(base)

    def _information_under(
        self, noise: ResidualNoise, model: Sequence[Candidate], base: Joint, stride: int = 1
    ) -> Information:
        """Return the information of all candidates, then `model`, under the given noise."""
        columns = [*self.columns, *(candidate.columns for candidate in model)]
        return information(self.problem, noise, base, columns, stride=stride)

    def _joint(self, model: list[Candidate], base: Joint, won: list[Best]) -> Hypothesis:
        """Return the best joint fit of one cause at the grid points `won`, the best under either noise."""
        found = []
        for k in {best.place for best in won}:
            candidate, here = self.candidates[k], [best for best in won if best.place == k]
            # Start from the estimate under each noise in which this point won
            starts = [
                np.append(info.moved(base, self.at[k], s.estimate), s.estimate) for _, _, s, info in here
            ]
            fit = self.fit([*model, candidate], *starts, like=base, rounds=2)
            ratio = max(0.0, 2.0 * (fit.log_likelihood - base.log_likelihood))
            if candidate.positive and fit.coefficients[-1] < 0.0:
                ratio = 0.0
            # no more than the effect itself can gain: the rest is of a noise that found another optimum
            ratio = min(ratio, wald_ratio(fit, candidate))
            freedom = here[0].score.freedom
            p_value = self.p_value(candidate, ratio, freedom)
            evidence = (
                evidence_of(candidate, ratio, freedom)
                + here[0].price
                - float(np.log(candidate.look_elsewhere))
            )
            found.append(Hypothesis(candidate, ratio, evidence, p_value, fit))
        return max(found, key=lambda h: h.evidence)

    def p_value(self, candidate: Candidate, ratio: float, freedom: int) -> float:
        """Return the p-value of a likelihood ratio, times hypotheses of the cause, times number of causes."""
        hypotheses = self.look_elsewhere.get(candidate.cause, 1.0) * float(np.exp(-candidate.point.likelier))
        tests = candidate.tail * hypotheses * self.causes
        return min(1.0, tests * float(chdtrc(max(freedom, 1), ratio)))


def _made_once(n: int, columns: Sequence[Columns]) -> list[Columns]:
    """Return `columns` with their shared parts precomputed."""
    shared = [X for X, _ in join_columns(columns).parts]
    known = dict(zip(shared, precomputed(n, shared), strict=True))
    return [Mixture(tuple((known[X], M) for X, M in parts(column))) for column in columns]


def sharpen(state: SearchState, model: list[Candidate], hypothesis: Hypothesis, base: Joint) -> Hypothesis:
    """Return the hypothesis with its nonlinear parameters profiled, one after the other.

    The other causes are `model`, and `base` is their fit. Many values are scored at once, because the
    likelihood of an onset has several peaks.
    """
    best, narrow = hypothesis, 0.0
    if best.candidate.point.rebuild is None:
        return best
    # Coordinate-wise: one parameter after the other, each kept only where the likelihood grows
    for position, name in enumerate(best.candidate.point.shape):
        candidate, start, narrower = _profiled(state, model, best, base, position, name)
        narrow += narrower
        fit = state.fit([*model, candidate], start, plain=False, like=best.fit, rounds=2)
        improvement = 2.0 * (fit.log_likelihood - base.log_likelihood) - best.ratio
        if improvement > 0.0:
            ratio, evidence = best.ratio + improvement, best.evidence + 0.5 * improvement
            best = replace(best, candidate=candidate, fit=fit, ratio=ratio, evidence=evidence)
    # Cells of the grid, in which the uncertainty of these parameters is expressed later
    brackets = [_bracket(state, best.candidate, name) for name in best.candidate.point.shape]
    cells = tuple(0.5 * (high - low) for low, high in brackets)
    point = replace(best.candidate.point, narrow=narrow, cells=cells)
    return replace(best, candidate=replace(best.candidate, point=point))


def _profiled(
    state: SearchState, model: list[Candidate], best: Hypothesis, base: Joint, position: int, name: str
) -> tuple[Candidate, FloatArray, float]:
    """Return the best value's candidate, start coefficients, and log ratio of cell to likelihood width."""
    rebuild = best.candidate.point.rebuild
    assert rebuild is not None
    columns = [candidate.columns for candidate in model]
    # Two stages: all values of the bracket at once, then again between the neighbours of the best
    low, high = _bracket(state, best.candidate, name)
    narrower = 0.0
    for stage in range(STAGES):
        values = np.linspace(low, high, max(COLUMNS // best.candidate.size, 4) + 2)
        made = []
        for value in values[1:-1]:
            shape = [v for v, _ in best.candidate.point.shape.values()]
            shape[position] = float(value)
            made.append(rebuild(*shape))
        every = [*(c.columns for c in made), *columns]
        info = information(state.problem, best.fit.noise, base, every, stride=state.stride).fitted(base)
        at = slices(made)
        scores = [score(info, own, made[0]) for own in at]
        ratios = state.stride * np.array([s.ratio for s in scores])
        k = int(np.argmax(ratios))
        if not stage:
            # as a share of one cell: the bracket spans two
            share = 2.0 * float(np.mean(np.exp(0.5 * (ratios - ratios[k]))))
            narrower = max(-float(np.log(share)), 0.0)
        low, high = values[k], values[k + 2]
    there = scores[k].estimate
    return made[k], np.append(info.moved(base, at[k], there), there), narrower


def _bracket(state: SearchState, candidate: Candidate, name: str) -> tuple[float, float]:
    """Return the grid values of a nonlinear parameter next below and above a candidate's value."""
    here = candidate.point.shape[name][0]
    if name == "period":  # a resolved line is a thousandth wide, the grid is one of peaks
        share = 0.6 * here / float(np.ptp(state.problem.survey.time))
        return here / (1.0 + share), here * (1.0 + share)
    grid = sorted({state.candidates[k].point.shape[name][0] for k in state.groups[candidate.group]})
    width = 0.5 * (grid[-1] - grid[0])
    # a positive parameter stays positive
    low = max(
        (v for v in grid if v < here), default=max(here - width, 0.5 * here if grid[0] > 0.0 else -np.inf)
    )
    return low, min((v for v in grid if v > here), default=here + width)


def refined(
    state: SearchState, model: list[Candidate], base: Joint, members: int | None = None
) -> tuple[list[Candidate], Joint]:
    """Return model and fit after its first `members` were profiled in turn and moved to the end."""
    for _ in range(len(model) if members is None else members):
        own, others = model[0], model[1:]
        c = np.append(base.coefficients[own.size :], base.coefficients[: own.size])
        base = state.fit([*others, own], np.append(base.z, c), plain=False, like=base, rounds=1)
        model = [*others, own]
        if own.point.rebuild is not None:
            rest = state.fit(others, plain=False)
            ratio = 2.0 * (base.log_likelihood - rest.log_likelihood)
            best = sharpen(state, others, Hypothesis(own, ratio, 0.0, 0.0, base), rest)
            model, base = [*others, best.candidate], best.fit
    return model, base


@dataclass(frozen=True)
class CompetingHypothesis:
    """A cause that the data do not exclude in place of another, by the best candidate of its grid."""

    candidate: Candidate
    behind: float
    """Log evidence by which the other cause is better, averaged over the grids of nonlinear parameters."""


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
    taken = {other.cause for other in model if other is not model[k]}
    pieces = {piece.group for piece in model[k].pieces} | {model[k].group}
    for group, (member, price, s, _) in best.items():
        candidate = state.candidates[member]
        if group in pieces or group[0] in taken:
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


def exchanged(state: SearchState, model: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Return the model, and its fit, after exchanges and drops of regressors that raise its evidence."""
    pieces = [piece for candidate in model for piece in candidate.pieces]
    # Steepest ascent over the neighbours of the model, each fitted with its noise
    for _ in range(MAX_EXCHANGES):
        best, better = state.value(pieces, base), (pieces, base)
        for new, place in _changes(state, pieces, base):
            changed = [*new, *pieces[:place], *pieces[place + 1 :]]
            entry = refined(state, changed, state.fit(changed, like=base), len(new))
            if state.value(*entry) > best:  # a month's fit is large: only one is kept
                best, better = state.value(*entry), entry
        if better[0] is pieces:
            break
        pieces, base = better
    return _gathered(state, pieces, base)


def _changes(state: SearchState, pieces: list[Candidate], base: Joint) -> list[tuple[list[Candidate], int]]:
    """Return the exchanges to try: new candidates (none for a drop), and the index of the replaced piece."""
    info = state.conditional_on(pieces, base)
    found = [
        (one.behind, [one.candidate], place)
        for place in range(len(pieces))
        for one in competing_hypotheses(state, info, pieces, base, place)
    ]
    found.sort(key=lambda entry: entry[0])
    needless = range(len(pieces) if len(pieces) > 1 else 0)
    return [*(([], place) for place in needless), *(entry[1:] for entry in found[:TRIED])]


def _gathered(state: SearchState, pieces: list[Candidate], base: Joint) -> tuple[list[Candidate], Joint]:
    """Return the model, and its fit, with the pieces of each cause joined into one candidate."""
    # Pieces of one cause stand next to each other, so that one candidate can hold them
    causes = list(dict.fromkeys(piece.cause for piece in pieces))
    if len(causes) == len(pieces):
        return pieces, base
    at = slices(pieces)
    order = sorted(range(len(pieces)), key=lambda n: causes.index(pieces[n].cause))
    c = base.coefficients[np.r_[*(at[n] for n in order)]]
    model = [reduce(Candidate.joined_with, [p for p in pieces if p.cause == cause]) for cause in causes]
    return model, state.fit(model, np.append(base.z, c), plain=False, like=base, rounds=1)
