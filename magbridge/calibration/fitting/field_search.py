"""Amplitude, length and smoothness of a field, and the noise's autocorrelation, by the evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.field_nodes import MAX_FIELD_NODES, SMOOTH, fine_enough, ladder, nodes_for
from magbridge.estimation.elimination import FieldEliminated, SampleSums, eliminate_field
from magbridge.estimation.gaussian_field import BURIED_FACTORS, SMOOTHNESS_POWERS, GaussianField
from magbridge.estimation.hyperparameters import log_evidence
from magbridge.estimation.priors import PriorFamily

__all__ = [
    "BENDS", "DECISIVE_LOG_RATIO", "Choice", "Weighed", "choose", "climb", "first_guess", "refined",
    "same_noise",
]  # fmt: skip

RESOLVED = 2.0
"""Nodes a length at least: a shorter one is not tried on so large an area."""
FEWER = 1_500
"""Nodes at most of the smoothest fields, whose precisions are nearly full."""
DECISIVE_LOG_RATIO = 30.0
"""Nats by which one kind of field is likelier than the other at any smoothness, or an offer needed."""
BENDS = 0.25
"""Fields are similar if the length times this power of alpha - 1 is equal."""
WHITE_AUTOCORRELATION = 0.03
"""Autocorrelation below which noise counts as white."""
MAX_FIT_AUTOCORRELATION = 0.995
"""Largest autocorrelation of a sample with the next one."""
SIZE, SIZE_SPREAD = 50.0, np.log(4.0)
"""Crustal field, nT, and the 1-sigma of its logarithm: sea floor and land, as airborne surveys find them."""
LENGTH_SPREAD = np.log(6.0)
"""1-sigma of the logarithm of the length, about the middle of those that are tried."""


@dataclass(frozen=True, eq=False)
class Choice:
    """A field for a standard deviation of 1, its size over the noise's, and that noise's autocorrelation."""

    field: GaussianField
    ratio: float
    rho: float
    score: float = -np.inf


@dataclass(frozen=True, eq=False)
class Weighed:
    """Settings of an evidence: the dense unknowns' prior at widths eta (h,), and the noise, nT."""

    family: PriorFamily
    eta: FloatArray
    sigma: float
    middle: float
    """m, the length that is expected."""

    def score(self, reduced: FieldEliminated, field: GaussianField, ratio: float) -> float:
        """Return the log evidence, the noise's size being the likeliest one."""
        # profile sigma out, then add the Gaussian priors of log size and log length
        log_sigma, value = float(np.log(self.sigma)), -np.inf
        for _ in range(4):  # Newton's: in log sigma it is nearly a parabola of curvature -2n
            value, slope, _ = log_evidence(reduced.quadratic, self.family, self.eta, log_sigma)
            step = float(np.clip(slope[-1] / (2.0 * reduced.quadratic.n), -1.0, 1.0))
            log_sigma += step
            if abs(step) < 1e-3:
                break
        size = (log_sigma + np.log(ratio / SIZE)) / SIZE_SPREAD
        length = np.log(field.length / self.middle) / LENGTH_SPREAD
        return value + reduced.log_evidence - 0.5 * float(size * size + length * length)


def choose(
    sums_of: Callable[[GaussianField], SampleSums],
    place: FloatArray,
    weighed: Weighed,
    start: float,
    *,
    harmonic: bool,
    rho: float | None = None,
    effort: float = 1.0,
    most: int = MAX_FIELD_NODES,
) -> Choice:
    """Choose the field without a start: lengths from a ladder, then smoothness and the rest.

    Parameters
    ----------
    sums_of : callable
        The samples' sums with a field.
    place : (n, 2) array
        m, where they are.
    weighed : Weighed
        What each is weighed with.
    start : float
        The field's size over the noise's, to begin with.
    harmonic : bool
        Whether the depth varies, so that a field which falls off upwards differs from one that does not.
    rho : float, optional
        Autocorrelation of the noise, where it is known.
    effort : float
        Share of the usual steps.
    most : int
        Nodes at most.
    """
    # 1. length by a ladder at the usual smoothness; 2. falling off upwards or not; 3. smoothness; 4.
    # sources at a depth. Each step starts from the best so far and maximises the evidence over size, memory
    # and length.
    move_rho, memory = rho is None, 0.3 if rho is None else rho

    def search_lengths(alpha: int) -> tuple[Choice, bool]:
        """Return the best of the lengths, from the longest on, and whether shorter ones are worse."""
        best: Choice | None = None
        worse, ratio, rho = 0, start, memory
        for length in ladder(place)[::-1]:
            nodes = nodes_for(place, length, alpha, most)
            # too few nodes are allowed for this length: the grid cannot show it
            if length < RESOLVED * nodes.spacing:
                continue
            field = GaussianField(nodes, float(length), alpha, harmonic)
            found = climb(
                sums_of(field), Choice(field, ratio, rho), weighed,
                move_length=False, move_rho=move_rho, steps=int(24 * effort), tolerance=1.0,
            )  # fmt: skip
            ratio, rho = found.ratio, found.rho
            if best is None or found.score > best.score:
                best, worse = found, 0
            elif (worse := worse + 1) == 2:
                break  # shorter ones take more nodes, and would be worse still
        assert best is not None
        return best, worse > 0

    best, enclosed = search_lengths(SMOOTH)
    if not enclosed:  # the crustal field is rougher than every candidate
        rough, _ = search_lengths(SMOOTHNESS_POWERS[0])
        best = rough if rough.score > best.score else best

    def tried(choice: Choice, alpha: int, harmonic: bool, buried: bool = False) -> Choice:
        # keep the correlation similar when the power changes, so that the climb starts near its maximum
        length = choice.field.length * ((choice.field.alpha - 1) / (alpha - 1)) ** BENDS
        nodes = nodes_for(place, length, alpha, most if alpha <= SMOOTH else FEWER)
        field = GaussianField(nodes, length, alpha, harmonic, buried)
        begin = replace(choice, field=field)
        return climb(sums_of(field), begin, weighed, move_rho=move_rho, steps=int(36 * effort))

    # try both kinds if the depth varies; where neither is decisively better, try again after the smoothness
    kinds = [tried(best, best.field.alpha, kind) for kind in ((True, False) if harmonic else (False,))]
    kinds.sort(key=lambda one: one.score)
    best = _smoothness(kinds[-1], tried)
    if harmonic and kinds[1].score - kinds[0].score < DECISIVE_LOG_RATIO:
        other = tried(best, best.field.alpha, not best.field.harmonic)
        best = _smoothness(other, tried) if other.score > best.score else best
    if best.field.alpha < SMOOTH:  # the spectrum of sources at a depth falls off slowly, too
        other = tried(best, BURIED_FACTORS, best.field.harmonic, buried=True)
        best = other if other.score > best.score else best
    return best


def _smoothness(best: Choice, tried: Callable[[Choice, int, bool], Choice]) -> Choice:
    """Increase the power alpha from that of `best`, or decrease it if that is not better; return the best."""
    # one direction at a time: evidence is unimodal in the smoothness, so stop at the first power that is
    # worse
    at = SMOOTHNESS_POWERS.index(best.field.alpha)
    for others in (SMOOTHNESS_POWERS[at + 1 :], SMOOTHNESS_POWERS[:at][::-1]):
        before = best
        for alpha in others:
            found = tried(best, alpha, best.field.harmonic)
            if found.score <= best.score:
                break
            best = found
        if best is not before:
            break
    return best


def first_guess(place: FloatArray) -> Choice:
    """Return an initial field at places (n, 2), m: of the middle length, usual amplitude and noise."""
    rungs = ladder(place)
    length = float(rungs[len(rungs) // 2 + 1])
    return Choice(GaussianField(nodes_for(place, length, SMOOTH), length, SMOOTH), SIZE, 0.0)


def climb(
    sums: SampleSums,
    start: Choice,
    weighed: Weighed,
    *,
    move_length: bool = True,
    move_rho: bool = True,
    steps: int = 40,
    tolerance: float = 0.1,
) -> Choice:
    """Maximise the evidence from a choice, its nodes kept, to within so much log evidence of the maximum.

    Its length or its noise's memory change, too, if need be.
    """
    # unknowns without bounds: log ratio, logit of rho over its largest value, log length
    share = np.clip(max(start.rho, 0.01) / MAX_FIT_AUTOCORRELATION, 1e-6, 1.0 - 1e-6)
    moves = [0] + [1] * move_rho + [2] * move_length
    first = np.array([0.0, np.log(share / (1.0 - share)), 0.0])

    def choice_at(moved: FloatArray) -> Choice:
        x = first.copy()
        x[moves] = moved
        rho = MAX_FIT_AUTOCORRELATION / (1.0 + np.exp(-np.clip(x[1], -30.0, 30.0))) if move_rho else start.rho
        field = start.field
        if move_length:
            field = replace(field, length=field.length * float(np.exp(np.clip(x[2], -0.5, 0.9))))
        return Choice(field, start.ratio * float(np.exp(np.clip(x[0], -6.0, 6.0))), float(rho))

    def downhill(x: FloatArray) -> float:
        one = choice_at(x)
        try:
            return -weighed.score(eliminate_field(sums, one.field, one.ratio, one.rho), one.field, one.ratio)
        except np.linalg.LinAlgError:
            return 1e300

    # Nelder-Mead: the score has no cheap derivative by the length, and three unknowns at most
    begin = first[moves]
    simplex = begin + np.vstack([np.zeros(len(moves)), np.diag(np.array([0.7, 0.8, 0.3])[moves])])
    found = minimize(
        downhill, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": steps, "xatol": 0.05, "fatol": tolerance},
    )  # fmt: skip
    best = choice_at(found.x)
    rho = best.rho if best.rho > WHITE_AUTOCORRELATION or not move_rho else 0.0
    return replace(best, rho=rho, score=-float(found.fun))


def refined(
    sums_of: Callable[[GaussianField], SampleSums], place: FloatArray, choice: Choice, weighed: Weighed
) -> Choice:
    """Maximise from a choice; nodes at places (n, 2), m, are rebuilt when they no longer suit the length."""
    field = choice.field
    if not fine_enough(field.nodes, field.length, field.alpha):
        nodes = nodes_for(place, field.length, field.alpha)
        field = replace(field, nodes=nodes)
    return climb(sums_of(field), replace(choice, field=field), weighed, steps=30)


def same_noise(sums: SampleSums, choice: Choice, weighed: Weighed) -> Choice:
    """Choose the noise's autocorrelation alone, with all samples, where the rest was chosen with a few."""

    def downhill(x: float) -> float:
        try:
            rho = MAX_FIT_AUTOCORRELATION / (1.0 + np.exp(-x))
            return -weighed.score(
                eliminate_field(sums, choice.field, choice.ratio, float(rho)), choice.field, choice.ratio
            )
        except np.linalg.LinAlgError:
            return 1e300

    # rho alone, by its logit: everything else keeps its value
    found = minimize_scalar(downhill, bounds=(-5.0, 5.0), method="bounded", options={"maxiter": 12})
    rho = float(MAX_FIT_AUTOCORRELATION / (1.0 + np.exp(-found.x)))
    return replace(choice, rho=rho if rho > WHITE_AUTOCORRELATION else 0.0)
