"""Profile nonlinear parameters between the points of their grid, with the other causes of a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.inference.evidence import score
from magbridge.diagnose.inference.hypothesis import Hypothesis
from magbridge.diagnose.inference.information import information
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.state import State

__all__ = ["refined", "sharpen"]

COLUMNS, STAGES = 144, 2
"""Number of columns that all values tried within a nonlinear parameter's bracket may have, and number of
stages: after each the bracket is narrowed to the neighbours of the best value."""


def sharpen(state: State, model: list[Candidate], hypothesis: Hypothesis, base: Joint) -> Hypothesis:
    """Profile the nonlinear parameters of a cause given `model`, whose fit is `base`, one after the other.

    Many values are scored at once under the present noise, because the likelihood of an onset has several
    peaks. The evidence pays for the choice: the average over the bracket counts, not the peak.
    """
    best, narrow = hypothesis, 0.0
    if best.candidate.point.rebuild is None:
        return best
    for position, name in enumerate(best.candidate.point.shape):
        candidate, start, narrower = _profiled(state, model, best, base, position, name)
        narrow += narrower
        fit = state.fit([*model, candidate], start, plain=False, like=best.fit, rounds=2)
        improvement = 2.0 * (fit.log_likelihood - base.log_likelihood) - best.ratio
        if improvement > 0.0:
            ratio, evidence = best.ratio + improvement, best.evidence + 0.5 * improvement
            best = replace(best, candidate=candidate, fit=fit, ratio=ratio, evidence=evidence)
    brackets = [_bracket(state, best.candidate, name) for name in best.candidate.point.shape]
    cells = tuple(0.5 * (high - low) for low, high in brackets)
    point = replace(best.candidate.point, narrow=narrow, cells=cells)
    return replace(best, candidate=replace(best.candidate, point=point))


def _profiled(
    state: State, model: list[Candidate], best: Hypothesis, base: Joint, position: int, name: str
) -> tuple[Candidate, FloatArray, float]:
    """Return the best value's candidate, coefficients to begin from, and its share of the bracket."""
    rebuild = best.candidate.point.rebuild
    assert rebuild is not None
    columns = [candidate.columns for candidate in model]
    low, high = _bracket(state, best.candidate, name)
    narrower = 0.0
    for stage in range(STAGES):
        values = np.linspace(low, high, max(COLUMNS // best.candidate.size, 4) + 2)
        made = []
        for value in values[1:-1]:
            shape = [v for v, _ in best.candidate.point.shape.values()]
            shape[position] = float(value)
            made.append(rebuild(*shape))
        info = information(
            state.problem, best.fit.noise, base, [*(c.columns for c in made), *columns]
        ).fitted(base)
        at = slices(made)
        scores = [score(info, own, made[0]) for own in at]
        ratios = np.array([s.ratio for s in scores])
        k = int(np.argmax(ratios))
        if not stage:
            # as a share of one cell: the bracket spans two
            share = 2.0 * float(np.mean(np.exp(0.5 * (ratios - ratios[k]))))
            narrower = max(-float(np.log(share)), 0.0)
        low, high = values[k], values[k + 2]
    there = scores[k].estimate
    return made[k], np.append(info.moved(base, at[k], there), there), narrower


def _bracket(state: State, candidate: Candidate, name: str) -> tuple[float, float]:
    """Return the values of one nonlinear parameter's grid between which a candidate stands."""
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
    state: State, model: list[Candidate], base: Joint, members: int | None = None
) -> tuple[list[Candidate], Joint]:
    """Profile the nonlinear parameters of the first `members`, each given the others; they end up last."""
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
