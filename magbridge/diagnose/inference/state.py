"""State of a search in a log, and one round of it: score every cause given a model, fit the likeliest.

The model is not part of the state: every step of a search takes one and returns another. A round adds data of
the log, not of the model, which are the same whenever they are computed: the look-elsewhere factors and the
certainty of the noise's level, in the first; and the last information, which several steps ask for.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial

import numpy as np
from scipy.special import fdtrc

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate, Group, slices
from magbridge.diagnose.compare.design_columns import Columns, Mixture, parts, together
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import in_threads, precomputed
from magbridge.diagnose.inference.evidence import (
    certainty,
    evidence_of,
    log_odds,
    look_elsewhere_factors,
    regressor_error,
    score,
)
from magbridge.diagnose.inference.hypothesis import Best, Hypothesis, shaped_ratio, wald_ratio
from magbridge.diagnose.inference.information import Information, information
from magbridge.diagnose.inference.joint import RIDGE, Joint, fit_joint
from magbridge.diagnose.inference.noise import Noise

__all__ = ["State"]

JOINTLY_FITTED_CAUSES = 9
"""Causes that are fitted jointly in a round."""


class State:
    """The problem of one search, its candidates, and quantities of the log.

    Attributes
    ----------
    null : Joint
        The fit without any cause.
    look_elsewhere : dict
        Cause -> number of independent hypotheses behind it.
    certain : dict
        Group -> degrees of freedom of the noise's level.
    groups : dict
        Cause and channel -> places of its candidates.
    brief : bool
        Whether noise may be correlated for a short time only: :meth:`with_brief_noise`.
    """

    def __init__(self, problem: Problem, candidates: Sequence[Candidate], order: int, causes: int) -> None:
        self.problem, self.candidates, self.order, self.causes = problem, list(candidates), order, causes
        self.brief = False
        self.at = slices(self.candidates)
        self.columns = _made_once(len(problem), [candidate.columns for candidate in self.candidates])
        self.look_elsewhere: dict[str, float] = {}
        self.certain: dict[Group, float] = {}
        self.last: tuple[Joint | None, Information | None] = None, None
        self.groups: dict[Group, list[int]] = {}
        for k, candidate in enumerate(self.candidates):
            self.groups.setdefault(candidate.group, []).append(k)
        self.blocks: bool | None = None
        self.null = self.fit([])
        self.blocks = self.null.noise.uneven

    def with_brief_noise(self) -> State:
        """Return the same search, with noise whose correlation is too short to pass for a slow cause."""
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
        """Fit a model jointly with calibration and noise; arguments as of :func:`~.joint.fit_joint`."""
        columns = [candidate.columns for candidate in model]
        return fit_joint(
            self.problem, columns, self.order, *starts, plain=plain, spectra=[c.spectra for c in model],
            like=like, blocks=self.blocks, brief=self.brief, ridge=_ridge(model), rounds=rounds,
        )  # fmt: skip

    def ratio(self, fit: Joint, null: Joint | None = None) -> float:
        """Twice the gain in log likelihood over the fit without any cause, or over another `null`."""
        return 2.0 * (fit.log_likelihood - (null or self.null).log_likelihood)

    def value(self, model: Sequence[Candidate], fit: Joint, null: Joint | None = None) -> float:
        """Log evidence of a model; each cause must also outweigh what idealised regressors may leave.

        It is relative to this search's null, or to one without slow noise.
        """
        ratio = self.ratio(fit, null)
        if not model:
            return 0.5 * ratio
        causes, narrow = {candidate.cause for candidate in model}, sum(c.point.narrow for c in model)
        shaped = shaped_ratio(ratio, model, fit, slow=null is not None)
        return (
            log_odds(ratio, model, self.look_elsewhere, shaped)
            - narrow
            - len(causes) * regressor_error(shaped)
        )

    def best(self, info: Information) -> dict[Group, Best]:
        """Best member of each group."""
        found = {}
        for group, members in self.groups.items():
            scores = [score(info, self.at[k], self.candidates[k]) for k in members]
            evidences = np.array([s.evidence for s in scores])
            top = int(np.argmax(evidences))
            price = float(np.log(np.mean(np.exp(evidences - evidences[top]))))
            found[group] = Best(members[top], price, scores[top], info)
        return found

    def round(self, model: list[Candidate], base: Joint) -> list[Hypothesis]:
        """Fit the best causes given `model`, each on its own, and list them, the likeliest first."""
        as_fitted = self.conditional_on(model, base).fitted(base)
        if not self.look_elsewhere:
            self.look_elsewhere = look_elsewhere_factors(as_fitted, self.candidates, self.at)
        under: dict[Group, list[Best]] = {}
        for info in (as_fitted, self._cleared(model, base, as_fitted)):
            for group, best in self.best(info).items():
                under.setdefault(group, []).append(best)
        listed = sorted(under.values(), key=lambda won: -max(best.score.evidence for best in won))
        # the largest, which take longest, first: then the threads end together
        tried = sorted(listed[:JOINTLY_FITTED_CAUSES], key=lambda won: -self.candidates[won[0].place].size)
        found = in_threads(len(self.problem), partial(self._joint, model, base), tried)
        return sorted(found, key=lambda h: -h.evidence)

    def conditional_on(self, model: Sequence[Candidate], base: Joint) -> Information:
        """Information of all candidates, then of `model`, under its noise, the calibration projected out."""
        known, info = self.last
        if known is not base:
            info = self._under(base.noise, model, base)
            self.last = base, info
        assert info is not None
        return info

    def _cleared(self, model: list[Candidate], base: Joint, info: Information) -> Information:
        """Information under the noise that remains when the best candidate of every cause is fitted."""
        top: dict[str, Best] = {}
        for (cause, _), best in self.best(info).items():
            top[cause] = max(top.get(cause, best), best, key=lambda one: one.score.evidence)
        pool = [best.place for best in top.values()]
        index = np.r_[*(self.at[k] for k in pool)]
        taken = np.linalg.solve(info.matrix[np.ix_(index, index)] + np.eye(len(index)), info.score[index])
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
        )
        if not model:
            middle = [self.columns[members[len(members) // 2]] for members in self.groups.values()]
            certain = certainty(everything.residual, everything.noise, middle)
            self.certain = dict(zip(self.groups, certain, strict=True))
        return self._under(everything.noise, model, base).fitted(base)

    def _under(self, noise: Noise, model: Sequence[Candidate], base: Joint) -> Information:
        """Information of all candidates and of `model` under a noise."""
        return information(self.problem, noise, base, [*self.columns, *(c.columns for c in model)])

    def _joint(self, model: list[Candidate], base: Joint, won: list[Best]) -> Hypothesis:
        """Fit one cause jointly at the grid points that won under either noise."""
        found = []
        for k in {best.place for best in won}:
            candidate, here = self.candidates[k], [best for best in won if best.place == k]
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
        """P-value of a likelihood ratio, times the hypotheses behind its cause, times the causes.

        The noise's level is estimated, too, so the distribution is Fisher's F.
        """
        hypotheses = self.look_elsewhere.get(candidate.cause, 1.0) * float(np.exp(-candidate.point.likelier))
        tests = candidate.tail * hypotheses * self.causes
        freedom, certain = max(freedom, 1), self.certain.get(candidate.group, np.inf)
        return min(1.0, tests * float(fdtrc(freedom, certain, ratio / freedom)))


def _made_once(n: int, columns: Sequence[Columns]) -> list[Columns]:
    """Return `columns` with their shared parts precomputed."""
    shared = [X for X, _ in together(columns).parts]
    known = dict(zip(shared, precomputed(n, shared), strict=True))
    return [Mixture(tuple((known[X], M) for X, M in parts(column))) for column in columns]


def _ridge(model: Sequence[Candidate]) -> FloatArray:
    """(k,) prior precision that a fit begins from: nature's sizes are known, a fault's hardly."""
    natural = [not c.effects or c.spectra is not None for c in model]
    return np.repeat(np.where(natural, 1.0, RIDGE), [c.size for c in model])
