"""The search for the causes that the data support, by forward selection and backward elimination.

Notes
-----
1. Score all candidates (:mod:`.evidence`) under two noise models: of the fit so far, and of a fit with the
best candidate of every cause. The noise of the fit so far may have absorbed an effect. 2. Fit the best
candidate of each cause jointly with noise and calibration. Add the best one that passes the test, and repeat.
If a cause is found again, its regressors become one candidate. 3. Exchange causes for competing hypotheses,
and drop causes that later findings have made redundant.

A second start searches under noise of a short correlation, because other noise may have absorbed the joint
effect of several causes. The search ends if the signal switches (:func:`switches`). If the causes found are
asserted, a search with slow noise (:mod:`.problem`) follows, and the likelier result is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve_toeplitz
from scipy.special import gammaln
from scipy.stats import chi2, rankdata

from magbridge.arrays import FloatArray, IndexArray
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.evidence import (
    CONFOUNDED,
    FALSE_ALARM_RATE,
    MOST_REMAINING,
    ODDS,
    REMNANT,
    SMOOTH,
    Hypothesis,
    Information,
    evidence_of,
    likeness,
    most_visible,
    regressor_error,
    shaped_ratio,
)
from magbridge.diagnose.joint import Joint, fit_joint, held_out
from magbridge.diagnose.noise import BRIEFEST, TAILS, autoregressive_order
from magbridge.diagnose.problem import Problem, with_slow_noise
from magbridge.diagnose.state import (
    CompetingHypothesis,
    SearchState,
    competing_hypotheses,
    exchanged,
    refined,
    sharpen,
)
from magbridge.estimation.residual import robust_scale

Rival = Callable[[Problem, Sequence[Candidate], Joint, Candidate], float | None]
"""Function of problem, model, fit, further cause: held-out score of a free description instead, or None."""
LOST, PLACES = 2, 6
"""Least number of regressors in the model, and number of level shifts to exceed, for a switching signal."""
AFTERWARDS = 16
"""Samples beyond the noise's order over which a shift of the level is tested."""
MAX_REGRESSORS = 6
"""Largest number of regressors that forward selection adds."""


class Outliers(NamedTuple):
    """Outliers, with their significance and the evidence that they are isolated."""

    rows: IndexArray
    """(k,) indices of the outliers."""
    ratio: float
    """Twice the gain in log likelihood of the mixture over heavy tails."""
    p_value: float
    neighbours: float
    """p-value of the neighbouring samples under the hypothesis that they are good."""
    lasting: bool
    """True if the level stays shifted after the outliers: something switched."""

    @property
    def isolated(self) -> bool:
        """Return True if the neighbouring samples are good, which excludes transients and ringing."""
        return self.neighbours >= FALSE_ALARM_RATE and not self.lasting


def outliers(fit: Joint, causes: int) -> Outliers | None:
    """Return the outliers if ``(1 - eps) t_nu + eps N(0, S^2)`` beats the best ``t_nu``, else None."""
    v = fit.noise.innovations
    n = len(v)
    if np.abs(v).max() < 5.0:
        return None
    # Likelihood ratio of the mixture against heavy tails alone
    alone = max(_mixture(v, nu, 0.0)[0] for nu in TAILS)
    value, member = max((_mixture(v, nu, 3.0 / n) for nu in TAILS[1:]), key=lambda found: found[0])
    ratio = 2.0 * (value - alone)
    p_value = min(1.0, causes * float(chi2.sf(ratio, 2)))
    rows = np.flatnonzero(member > 0.5)
    if p_value >= FALSE_ALARM_RATE or not rows.size or rows.size > 0.05 * n:
        return None
    # through the noise's autoregression a wrong sample also spoils the innovations after it
    first = rows[np.insert(np.diff(rows) > 1, 0, True)]
    return Outliers(first, ratio, p_value, _neighbours(fit, first), _lasting(fit, first))


def switches(fit: Joint, model: Sequence[Candidate], causes: int) -> bool:
    """Return True if a fit with several regressors leaves many shifts of the level unexplained."""
    if sum(len(candidate.pieces) for candidate in model) < LOST:
        return False
    off = outliers(fit, causes)
    return off is not None and off.lasting and off.rows.size > PLACES


def _lasting(fit: Joint, rows: IndexArray) -> bool:
    """Return True if shifts of the level at `rows` (k,) are likelier than impulses there."""
    # Whitened impulse h = (1, -a) and shift, its running sum; of either, x, at each row i the statistic
    # (sum_l x_l v_(i+l))^2 / sum_l x_l^2 (Chen & Liu 1993, J. Am. Stat. Assoc. 88:284)
    impulse = np.concatenate([[1.0], -fit.noise.ar, np.zeros(AFTERWARDS)])
    both = np.stack([impulse, np.cumsum(impulse)])
    v = np.append(fit.noise.innovations, np.zeros(impulse.size))[rows[:, None] + np.arange(impulse.size)]
    impulses, shifts = ((v @ both.T) ** 2 / np.sum(both**2, axis=1)).sum(axis=0)
    return bool(0.5 * (shifts - impulses) > ODDS)


def _neighbours(fit: Joint, rows: IndexArray) -> float:
    r"""Return the p-value of the samples next to `rows` (k,) if they are good; 1 if none is testable.

    Notes
    -----
    A wrong sample i is an additive or an innovation outlier (Fox 1972, JRSS B 34:350). For an additive one,
    three impulses c are fitted at i - 1, i and i + 1, with the whitening filter ``h = (1, -a)`` and
    innovations v in units of the noise's scale:

    .. math:: G c = b, \qquad G_{jk} = \sum_l h_l h_{l+|j-k|}, \qquad b_j = \sum_l h_l v_{j+l}

    If the neighbours are good, the outer c, or the innovations next to i, are noise. Their p-values are ranks
    among all samples, combined by Fisher's method for the better of the two kinds of outlier.
    """
    # Whitening filter h, and b: the filter's transpose applied to the innovations
    noise, p = fit.noise, len(fit.noise.ar)
    h = np.concatenate([[1.0], -noise.ar, np.zeros(2)])
    b, v = (
        sliding_window_view(x, 3).T
        for x in (noise.filter_back(noise.whiten(fit.residual)) * noise.scale, noise.innovations)
    )
    # Amplitudes of three impulses at every sample: Toeplitz, since the filter is the same everywhere
    c = solve_toeplitz([float(h[: len(h) - k] @ h[k:]) for k in range(3)], b)
    before = np.arange(b.shape[1])
    after = np.minimum(before + 2 + p, b.shape[1] + 1)  # the last sample that one of the impulses reaches
    whole = noise.past.whole[before] & noise.past.whole[after]
    asked = np.isin(before + 1, rows)[whole]
    if not asked.any():
        return 1.0
    # (kind, side, sample)
    ranked = -np.abs(np.stack([c[::2, whole], v[::2, whole]]))
    p_values = rankdata(ranked, "max", axis=2)[:, :, asked] / asked.size
    return float(chi2.sf(-2.0 * np.log(p_values).sum(axis=1).max(axis=0).sum(), 4 * asked.sum()))


def _mixture(v: FloatArray, nu: float, eps: float) -> tuple[float, FloatArray]:
    """Return the largest log likelihood of the mixture, and each sample's probability of being an outlier."""
    s, wide = robust_scale(v), float(np.abs(v).max())
    at_zero = gammaln(0.5 * (nu + 1.0)) - gammaln(0.5 * nu) - 0.5 * np.log(np.pi * nu)
    member = np.zeros(len(v))
    value = -np.inf
    # Expectation maximisation over scale, share and width of the wide component
    for _ in range(25):
        x = v / s
        # Membership of the wide component, then scale, share and width by weighted moments
        log_t = at_zero - np.log(s) - 0.5 * (nu + 1.0) * np.log1p(x * x / nu)
        inside = np.exp(log_t) * (1.0 - eps)
        outside = eps * np.exp(-0.5 * (v / wide) ** 2) / (wide * np.sqrt(2 * np.pi))
        value = float(np.log(inside + outside + 1e-300).sum())
        if eps > 0.0:
            member = outside / (inside + outside + 1e-300)
            eps = max(float(member.mean()), 0.1 / len(v))
            wide = max(float(np.sqrt((member @ (v * v)) / (member.sum() + 1e-12))), 4.0 * s)
        weight = (1.0 - member) * (nu + 1.0) / (nu + x * x)
        s = float(np.sqrt((weight @ (v * v)) / (1.0 - member).sum()))
    return value, member


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """The result of a search."""

    problem: Problem
    """Problem of the search, with slow noise if that is likelier."""
    chosen: tuple[Hypothesis, ...]
    """Causes found, each tested against the model without it; empty if no names are asserted."""
    competing: tuple[tuple[CompetingHypothesis, ...], ...]
    """Competing hypotheses of each chosen cause, the likeliest first."""
    null: Joint
    """Fit without any cause."""
    fit: Joint
    """Fit with the chosen causes."""
    p_value: float
    """Smallest p-value of the first round."""
    info: Information
    """Information of all candidates, then the model, under the noise of `fit`."""
    look_elsewhere: dict[str, float]
    """Number of independent hypotheses of each cause, by its name."""
    evidence: float
    """Log evidence of causes and noise, relative to the null without slow noise."""
    switches: bool
    """True if the search ended because of a switching signal that no cause describes."""

    @property
    def model(self) -> list[Candidate]:
        """The candidates of the chosen causes."""
        return [hypothesis.candidate for hypothesis in self.chosen]

    def with_chosen(self, places: Sequence[int], fit: Joint) -> SearchOutcome:
        """Return the outcome with only the causes at these indices, whose joint fit is `fit`."""
        competing = tuple(self.competing[k] for k in places)
        return replace(self, chosen=tuple(self.chosen[k] for k in places), competing=competing, fit=fit)


def search(
    problem: Problem,
    candidates: Sequence[Candidate],
    causes: int,
    rival: Rival | None = None,
    plain: Joint | None = None,
) -> SearchOutcome:
    """Return the causes that the data support under one noise model; `causes` is the number of causes tested.

    Each further cause must predict held-out dives better than a free description (`rival`). For a problem
    with slow noise, `plain` is the fit without causes and without slow noise.
    """
    # Order of the noise, forward selection with exchanges, backward elimination, competing hypotheses
    rough = fit_joint(problem, [], 1, rounds=2)
    order = autoregressive_order(rough.residual, problem.survey.slots)
    state = SearchState(problem, candidates, order, causes)
    first = state.round([], state.null) if candidates else []
    p_value = min((h.p_value for h in first), default=1.0)
    model, base = _likeliest(state, first) if first else ([], state.null)
    ended = switches(base, model, state.causes)
    chosen, base = _backward_elimination(state, model, base, rival)
    model = [h.candidate for h in chosen]
    info = state.conditional_on(model, base)
    competing = tuple(competing_hypotheses(state, info, model, base, k) for k in range(len(model)))
    # Akaike's price of the autoregression, which slow noise makes shorter. Coefficients that the residual
    # no longer needs, for example after a step, have each gained only half a unit of log-likelihood by chance
    needed = autoregressive_order(base.residual, problem.survey.slots)
    evidence = state.value(model, base, plain) - 0.5 * (order + needed)
    return SearchOutcome(
        problem, tuple(chosen), competing, state.null, base, p_value, info, state.look_elsewhere, evidence,
        ended,
    )  # fmt: skip


def beside_slow_noise(
    found: SearchOutcome, candidates: Sequence[Candidate], causes: int, rival: Rival | None = None
) -> SearchOutcome:
    """Return the likelier of the outcome `found` and of a search with slow noise."""
    noisy, null = with_slow_noise(found.problem), found.null
    slow = fit_joint(noisy, [], null.noise.past.order, blocks=null.noise.uneven, like=null)
    gain = slow.log_likelihood - null.log_likelihood
    if gain <= 0.0:
        return found
    if len(found.chosen) == 1 and len(found.chosen[0].candidate.pieces) == 1 and gain < found.evidence:
        # Slow noise in place of the one cause is less likely: is it likelier in addition to that cause?
        fit, columns = found.fit, [candidate.columns for candidate in found.model]
        start = np.append(np.insert(fit.z, noisy.slow.start, np.zeros(noisy.waves.size)), fit.coefficients)
        both = fit_joint(
            noisy, columns, fit.noise.past.order, start, plain=False, like=fit, blocks=fit.noise.uneven,
            spectra=[candidate.spectra for candidate in found.model],
            ridge=fit.prior[len(fit.z) :], rounds=2,
        )  # fmt: skip
        if both.log_likelihood <= fit.log_likelihood:
            return found
    return max(found, search(noisy, candidates, causes, rival, null), key=lambda outcome: outcome.evidence)


def _likeliest(state: SearchState, first: list[Hypothesis]) -> tuple[list[Candidate], Joint]:
    """Return the likelier model, and its fit, of searches under any noise and under short-lived noise."""
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


def _forward_selection(state: SearchState, first: list[Hypothesis]) -> tuple[list[Candidate], Joint]:
    """Return the model, and its fit, of causes added one after the other, from the hypotheses `first` on."""
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
    """Return the largest signal-to-noise that errors of a cause's idealised regressor may leave."""
    size = found.signal_to_noise
    return min(SMOOTH * size, MOST_REMAINING) if found.candidate.nonparametric else REMNANT * size


def _next(found: list[Hypothesis], strengths: Mapping[str, float], ratio: float) -> Hypothesis | None:
    """Return the best significant hypothesis that exceeds the remnants of the model's causes, or None.

    `strengths` holds the remnants by cause, and `ratio` is the likelihood ratio of the causes of fixed shape.
    Among candidates within the errors of their regressors, the one with the fewest coefficients is returned.
    """

    def remnant(cause: str) -> float:
        return max((size for other, size in strengths.items() if other != cause), default=0.0)

    # Significant, and stronger than what the regressors of other causes leave
    significant = [
        h for h in found if h.p_value < FALSE_ALARM_RATE and h.signal_to_noise >= remnant(h.candidate.cause)
    ]
    as_likely = [h for h in significant if h.evidence >= significant[0].evidence - regressor_error(ratio)]
    return min(as_likely, key=lambda h: h.candidate.size, default=None)


def _added(state: SearchState, model: list[Candidate], best: Hypothesis) -> tuple[list[Candidate], Joint]:
    """Return the model, and its fit, with a candidate added, or joined to the candidate of the same cause."""
    new = best.candidate
    for k, own in enumerate(model):
        if own.cause == new.cause:
            grown = [*model[:k], own.joined_with(new), *model[k + 1 :]]
            at = sum(candidate.size for candidate in model[: k + 1])
            c = best.fit.coefficients
            c = np.concatenate([c[:at], c[-new.size :], c[at : -new.size]])
            return grown, state.fit(grown, np.append(best.fit.z, c), like=best.fit)
    return [*model, new], best.fit


def _backward_elimination(
    state: SearchState, model: list[Candidate], base: Joint, rival: Rival | None
) -> tuple[list[Hypothesis], Joint]:
    """Return the causes that remain, each with its test, and the fit of their model.

    A cause is dropped if it fails its test given the others, if the model is likelier without it, or if it is
    redundant (:func:`_surplus`).
    """
    # Each cause in turn against the model without it; a drop starts the pass again
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
        if k == len(model) > 1 and (surplus := _surplus(state, chosen, base, rival)) is not None:
            model = model[:surplus] + model[surplus + 1 :]
            base, chosen, k = state.fit(model), [], 0
    return chosen, base


def _surplus(
    state: SearchState, chosen: Sequence[Hypothesis], base: Joint, rival: Rival | None
) -> int | None:
    """Return the index of the weakest cause if it is redundant given the others, else None.

    The cause is redundant if it is the remnant of a Gaussian process, if it correlates with another cause and
    does not improve held-out dives, or if a free description predicts held-out dives better.
    """
    smooth = max((_remnant(h) for h in chosen if h.candidate.nonparametric), default=0.0)
    k = min(range(len(chosen)), key=lambda n: chosen[n].signal_to_noise)
    model = [h.candidate for h in chosen]
    others = model[:k] + model[k + 1 :]
    if not model[k].nonparametric and chosen[k].signal_to_noise < smooth:
        return k
    problem, without = state.problem, state.fit(others)
    # Squared residuals of held-out dives without and with the cause, where a correlated one may replace it
    if not model[k].nonparametric and (smooth or _like_another(state, model, base, k)):
        counts = slice(None) if smooth else ~problem.survey.learned
        power = [
            np.sum(held_out(problem, [c.columns for c in some], fit).residual[counts] ** 2)
            for some, fit in ((others, without), (model, base))
        ]
        if power[0] < power[1]:
            return k
    described = rival and rival(problem, others, without, model[k])
    if described is None:
        return None
    named = held_out(problem, [c.columns for c in model], base, interleaved=True).score
    return k if described > named else None


def _like_another(state: SearchState, model: Sequence[Candidate], base: Joint, k: int) -> bool:
    """Return True if in this log the effect of the k-th cause correlates strongly with that of another."""
    # The most visible candidate of each group stands for its grid
    info = state.conditional_on(model, base)
    every = {state.candidates[n].group: n for n in most_visible(state.candidates, info, state.at)}
    own, *others = (every[candidate.group] for candidate in (model[k], *model[:k], *model[k + 1 :]))
    one, at = state.candidates[own], state.at[own]
    return any(likeness(info, one, at, state.candidates[n], state.at[n]) > CONFOUNDED for n in others)
