r"""The search: which causes the data speak for, one after the other, with look-elsewhere accounted for.

Notes
-----
*Score.* For a candidate with projected information S and score b (:mod:`.joint`), ``R = b^T S^-1 b`` is what its
likelihood ratio would be. Nobody knows beforehand how large an effect is, so its k coefficients have Zellner's prior
``N(0, g S^-1)`` with the g that the data like best: log evidence ``(R - k)/2 - (k/2) log(R/k)``, 0 below ``R = k``
(Liang et al. 2008, JASA 103:410, sec. 2.4). It asks the same price of every cause, whatever its unit.
The noise under which both are taken may have swallowed the effect, so candidates are scored twice: under the
noise of the model so far, and under the noise that is left when every cause may take what it can.

*Test.* The best of each cause are fitted jointly with noise and calibration. A cause's p-value is that of its likelihood
ratio, times the number of independent hypotheses N behind it: under no effect scores are ``N(0, S)``, so the smallest
p-value over its grid is simulated from S, and ``N = 1 / E[p_min] - 1``. Times the number of causes, below 1 %: found.

*Name.* By evidence, averaged over the grid; all within 20:1 of the best are named together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from magbridge.diagnose.candidates import Candidate
from magbridge.diagnose.joint import Information, Joint, fit_joint, information
from magbridge.diagnose.noise import memory_order
from magbridge.diagnose.problem import Problem

__all__ = ["LEVEL", "ODDS", "Hypothesis", "Outcome", "score", "search", "slices", "trials", "weigh"]

FloatArray = NDArray[np.float64]

LEVEL = 0.01
"""Family-wise false-alarm rate."""
ODDS = np.log(20.0)
"""Log evidence by which a cause must win to be named alone."""
SIMULATIONS = 400
SHORT_LIST = 9
"""Causes that are fitted jointly in a round."""
IDEAL = 0.2
"""How far from the truth an idealised regressor may be: what is left of a large effect is not another cause.

The price: a second cause of less than a fifth of the strongest one's signal-to-noise is not named beside it.
"""
SHARPEN = 4
"""Halvings of a nonlinear parameter's bracket."""
STARTS = 3
"""Causes that a chain of several may begin with."""
MOST = 5
"""Causes in one log."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One cause beside the model so far.

    Attributes
    ----------
    candidate : Candidate
    ratio : float
        Twice the gain in log likelihood.
    evidence : float
        Log Bayes factor against the model so far.
    p_value : float
        Look-elsewhere and number of causes included.
    fit : Joint
    price : float
        Log evidence, below 0, that its nonlinear parameters cost: 0 would be had they been known.
    """

    candidate: Candidate
    ratio: float
    evidence: float
    p_value: float
    fit: Joint
    price: float = 0.0

    @property
    def signal_to_noise(self) -> float:
        """Whitened norm of what is the effect's own under the noise that is left, less what noise alone gives."""
        k = self.candidate.size
        b, own = self.fit.coefficients[-k:], self.fit.covariance[-k:, -k:]
        power = float(b @ np.linalg.solve(own, b)) - k
        return float(np.sqrt(power)) if power > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a search ends with.

    Attributes
    ----------
    chosen : tuple of Hypothesis
        In the order found; each against the model without it.
    rivals : tuple of tuple of Hypothesis
        For each chosen one, all others within 20:1 in its place, the best first.
    null, fit : Joint
        Without any cause, and with the chosen ones.
    order : int
        Memory of the noise.
    tested : dict
        Cause -> (smallest p-value, ratio) of the first round.
    """

    chosen: tuple[Hypothesis, ...]
    rivals: tuple[tuple[Hypothesis, ...], ...]
    null: Joint
    fit: Joint
    order: int
    tested: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Score:
    """Of one candidate under one noise: likelihood ratio, its degrees of freedom, log evidence, estimate."""

    ratio: float
    freedom: int
    evidence: float
    estimate: FloatArray
    root: FloatArray


def score(info: Information, at: slice) -> Score:
    """Score the candidate whose columns stand at `at`."""
    S, b = info.matrix[at, at], info.score[at]
    values, vectors = np.linalg.eigh(S)
    seen = values > 1e-3  # of the prior's own information: less is invisible
    if not seen.any():
        return Score(0.0, 0, 0.0, np.zeros(len(b)), np.zeros((len(b), 0)))
    root = vectors[:, seen] / np.sqrt(values[seen])
    ratio = float(np.sum((root.T @ b) ** 2))
    estimate = vectors[:, seen] @ ((vectors[:, seen].T @ b) / (values[seen] + 1.0))
    return Score(ratio, int(seen.sum()), weigh(ratio, int(seen.sum())), estimate, root)


def weigh(ratio: float, freedom: int) -> float:
    """Log evidence of a likelihood ratio that took so many free numbers."""
    if ratio <= freedom or not freedom:
        return 0.0
    return 0.5 * (ratio - freedom) - 0.5 * freedom * float(np.log(ratio / freedom))


def slices(candidates: Sequence[Candidate]) -> list[slice]:
    """Where each candidate's columns stand."""
    ends = np.cumsum([candidate.size for candidate in candidates])
    return [
        slice(int(end) - candidate.size, int(end)) for end, candidate in zip(ends, candidates, strict=True)
    ]


def trials(info: Information, candidates: Sequence[Candidate], at: Sequence[slice]) -> dict[str, float]:
    """Return the number of independent hypotheses behind each cause."""
    rng = np.random.default_rng(20131211)  # the same answer every time
    found = {}
    for cause in dict.fromkeys(candidate.cause for candidate in candidates):
        own = [k for k, candidate in enumerate(candidates) if candidate.cause == cause]
        index = np.concatenate([np.arange(at[k].start, at[k].stop) for k in own])
        values, vectors = np.linalg.eigh(info.matrix[np.ix_(index, index)])
        draws = (vectors * np.sqrt(np.maximum(values, 0.0))) @ rng.standard_normal((len(index), SIMULATIONS))
        smallest = np.ones(SIMULATIONS)
        place = 0
        for k in own:
            s = score(info, at[k])
            block = draws[place : place + candidates[k].size]
            place += candidates[k].size
            if s.freedom:
                smallest = np.minimum(smallest, chi2.sf(np.sum((s.root.T @ block) ** 2, axis=0), s.freedom))
        found[cause] = max(1.0, 1.0 / float(smallest.mean()) - 1.0) * max(candidates[k].trials for k in own)
    return found


class _Search:
    """The state of one search: the problem, its candidates, the model so far."""

    def __init__(self, problem: Problem, candidates: Sequence[Candidate], order: int, causes: int) -> None:
        self.problem, self.candidates, self.order, self.causes = problem, list(candidates), order, causes
        self.at = slices(self.candidates)
        self.trials: dict[str, float] = {}

    def fit(self, model: Sequence[Candidate], start: FloatArray | None = None, rounds: int = 4) -> Joint:
        return fit_joint(self.problem, [c.columns for c in model], self.order, start, rounds=rounds)

    def round(self, model: list[Candidate], base: Joint) -> list[Hypothesis]:
        """Every cause beside `model`, the likeliest first."""
        columns = [candidate.columns for candidate in model]
        best: dict[tuple[str, str | None], list[tuple[float, float, int, Score]]] = {}
        infos = [information(self.problem, base.noise, base, columns, [c.columns for c in self.candidates])]
        if not self.trials:
            self.trials = trials(infos[0], self.candidates, self.at)
        infos.append(self._bare(model, base, infos[0]))
        for info in infos:
            scores = [score(info, at) for at in self.at]
            groups: dict[tuple[str, str | None], list[int]] = {}
            for k, candidate in enumerate(self.candidates):
                groups.setdefault((candidate.cause, candidate.channel), []).append(k)
            for group, members in groups.items():
                evidences = np.array([scores[k].evidence for k in members])
                top = int(np.argmax(evidences))
                # the grid's average, as against its best: what the nonlinear parameters cost
                average = float(np.log(np.mean(np.exp(evidences - evidences[top]))))
                best.setdefault(group, []).append(
                    (evidences[top], average, members[top], scores[members[top]])
                )
        listed = sorted(best.items(), key=lambda item: -max(entry[0] for entry in item[1]))
        found = [self._joint(model, base, entries) for _, entries in listed[:SHORT_LIST]]
        return sorted(found, key=lambda h: -h.evidence)

    def _bare(self, model: list[Candidate], base: Joint, info: Information) -> Information:
        """Score again under the noise that is left when the best of every cause takes what it can."""
        top: dict[str, tuple[float, int]] = {}
        for k, at in enumerate(self.at):
            s = score(info, at)
            cause = self.candidates[k].cause
            if s.evidence > top.get(cause, (-np.inf, 0))[0]:
                top[cause] = (s.evidence, k)
        pool = [k for _, k in top.values()]
        index = np.concatenate([np.arange(self.at[k].start, self.at[k].stop) for k in pool])
        S = info.matrix[np.ix_(index, index)]
        taken = np.linalg.solve(S + np.eye(len(index)), info.score[index])
        everything = fit_joint(
            self.problem,
            [c.columns for c in (*model, *(self.candidates[k] for k in pool))],
            self.order,
            np.concatenate([base.z, base.coefficients, taken]),
            ridge=1.0,
            rounds=2,
        )
        columns = [c.columns for c in model]
        return information(
            self.problem, everything.noise, base, columns, [c.columns for c in self.candidates]
        )

    def _joint(
        self, model: list[Candidate], base: Joint, entries: list[tuple[float, float, int, Score]]
    ) -> Hypothesis:
        """Fit one cause jointly, at the grid's points that won under either noise."""
        found = []
        for _, average, k, s in {entry[2]: entry for entry in entries}.values():
            candidate = self.candidates[k]
            start = np.concatenate([base.z, base.coefficients, s.estimate])
            fit = self.fit([*model, candidate], start)
            ratio = max(0.0, 2.0 * (fit.log_likelihood - base.log_likelihood))
            tests = self.trials.get(candidate.cause, 1.0) * self.causes
            p_value = min(1.0, tests * float(chi2.sf(ratio, max(s.freedom, 1))))
            evidence = weigh(ratio, s.freedom) + average
            if candidate.trials > 1.0:
                evidence -= float(np.log(candidate.trials))
            found.append(Hypothesis(candidate, ratio, evidence, p_value, fit, average))
        return max(found, key=lambda h: h.evidence)

    def place_of(self, model: list[Candidate], k: int) -> list[Hypothesis]:
        """Return what could stand where the k-th of `model` stands."""
        others = model[:k] + model[k + 1 :]
        return self.round(others, self.fit(others))

    def sharpen(self, model: list[Candidate], hypothesis: Hypothesis, base: Joint) -> Hypothesis:
        """Profile the nonlinear parameters between the grid's points, one after the other, by golden section."""
        best = hypothesis
        again = best.candidate.again
        if again is None:
            return best
        for position, name in enumerate(best.candidate.shape):
            grid = sorted(
                {c.shape[name][0] for c in self.candidates if (c.cause, c.channel) == _key(best.candidate)}
            )
            here = best.candidate.shape[name][0]
            low = max((v for v in grid if v < here), default=here - 0.5 * (grid[-1] - grid[0]))
            high = min((v for v in grid if v > here), default=here + 0.5 * (grid[-1] - grid[0]))
            if name == "period":  # a resolved line is a thousandth wide, the grid is one of peaks
                low, high = here / (1.0 + 0.6 * here / self.span), here * (1.0 + 0.6 * here / self.span)
            for _ in range(SHARPEN):
                tried = []
                for share in (0.25, 0.5, 0.75):
                    values = [v for v, _ in best.candidate.shape.values()]
                    values[position] = low + share * (high - low)
                    candidate = again(*values)
                    start = np.concatenate(
                        [base.z, base.coefficients, best.fit.coefficients[-candidate.size :]]
                    )
                    fit = self.fit([*model, candidate], start, rounds=2)
                    gain = 2.0 * (fit.log_likelihood - base.log_likelihood) - best.ratio
                    tried.append((gain, values[position], candidate, fit))
                gain, value, candidate, fit = max(tried, key=lambda entry: entry[0])
                if gain > 0.0:
                    best = replace(
                        best,
                        candidate=candidate,
                        fit=fit,
                        ratio=best.ratio + gain,
                        evidence=best.evidence + 0.5 * gain,
                    )
                quarter = 0.25 * (high - low)
                low, high = max(low, value - quarter), min(high, value + quarter)
        return best

    @property
    def span(self) -> float:
        """S."""
        return float(np.ptp(self.problem.survey.time))


def _key(candidate: Candidate) -> tuple[str, str | None]:
    return candidate.cause, candidate.channel


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
    state = _Search(problem, candidates, order, causes)
    null = state.fit([])
    first = state.round([], null) if candidates else []
    tested: dict[str, tuple[float, float]] = {}
    for h in first:
        if h.p_value <= tested.get(h.candidate.cause, (np.inf, 0.0))[0]:
            tested[h.candidate.cause] = (h.p_value, h.ratio)
    chosen, model, base = _chain(state, null, first)
    if (
        len(chosen) > 1
    ):  # the first step may have gone astray where several causes act: begin with others, too
        kinds = {h.candidate.cause: h for h in reversed(first) if h.p_value < LEVEL}
        others = [h for cause, h in kinds.items() if cause != first[0].candidate.cause]
        others = sorted(others, key=lambda h: -h.evidence)[: STARTS - 1]
        chains = [(chosen, model, base), *(_chain(state, null, [h]) for h in others)]
        chosen, model, base = max(
            chains,
            key=lambda chain: weigh(
                2.0 * (chain[2].log_likelihood - null.log_likelihood), sum(c.size for c in chain[1])
            ),
        )
    rivals = []
    for k, own in enumerate(chosen):
        others = [h for h in state.place_of(model, k) if _key(h.candidate) != _key(own.candidate)]
        # a rival has the benefit of the doubt about its nonlinear parameters
        rivals.append(
            tuple(h for h in others if h.evidence - h.price > own.evidence - ODDS and h.p_value < LEVEL)
        )
    return Outcome(tuple(chosen), tuple(rivals), null, base, order, tested)


def _chain(
    state: _Search, null: Joint, first: list[Hypothesis]
) -> tuple[list[Hypothesis], list[Candidate], Joint]:
    """Add cause after cause while one passes the test, beginning with the best of `first`; drop what became needless."""
    chosen: list[Hypothesis] = []
    model: list[Candidate] = []
    base, found = null, first
    while len(chosen) < MOST:
        sure = [h for h in found if h.p_value < LEVEL]
        loudest = max((h.signal_to_noise for h in chosen), default=0.0)
        if not sure or sure[0].signal_to_noise < IDEAL * loudest:
            break
        best = state.sharpen(model, sure[0], base)
        chosen.append(best)
        model.append(best.candidate)
        base = best.fit
        found = state.round(model, base) if len(chosen) < MOST else []
    return _remove(state, chosen, model, base)


def _remove(
    state: _Search, chosen: list[Hypothesis], model: list[Candidate], base: Joint
) -> tuple[list[Hypothesis], list[Candidate], Joint]:
    """Drop what later findings have made needless; measure what stays against the model without it."""
    k = 0
    while k < len(chosen) and len(chosen) > 1:
        others = model[:k] + model[k + 1 :]
        without = state.fit(others)
        ratio = max(0.0, 2.0 * (base.log_likelihood - without.log_likelihood))
        own = chosen[k].candidate
        p_value = min(1.0, state.trials.get(own.cause, 1.0) * state.causes * float(chi2.sf(ratio, own.size)))
        if p_value < LEVEL:
            change = 0.5 * (ratio - chosen[k].ratio)
            evidence = chosen[k].evidence + change
            chosen[k] = replace(
                chosen[k], ratio=ratio, p_value=p_value, evidence=evidence, fit=state.fit([*others, own])
            )
            k += 1
            continue
        chosen, model, base, k = chosen[:k] + chosen[k + 1 :], others, without, 0
    return chosen, model, base
