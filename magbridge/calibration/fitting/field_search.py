r"""Search of the crustal field's amplitude, correlation length and smoothness, by maximum evidence.

The evidence also determines the noise's autocorrelation. A few anomalies hardly determine amplitude and
length, so a solution at their likeliest values alone would be overconfident away from the track. The solution
is therefore a mixture over points about the maximum of the evidence,

.. math:: p(f) \approx \sum_k w_k\, p(f \mid \theta_k), \quad \theta_k = \hat\theta + V S g_k,

The points :math:`g_k` are those of a Gauss-Hermite rule (3 x 3). V are the axes of the evidence's curvature,
S the standard deviations along them, and each weight :math:`w_k` includes the evidence of its point (Rue,
Martino & Chopin 2009, section 6.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import minimize

from magbridge.arrays import BoolArray, FloatArray
from magbridge.estimation.elimination import FieldEliminated, SampleSums, eliminate_field
from magbridge.estimation.gaussian_field import BURIED_FACTORS, SMOOTHNESS_POWERS, GaussianField
from magbridge.estimation.hyperparameters import log_evidence
from magbridge.estimation.nodes import Nodes, nodes_near
from magbridge.estimation.priors import PriorFamily

# ---- Lengths and nodes ----

RUNGS = 7
"""Number of correlation lengths that the search tries first."""
NODES_PER_LENGTH = {2: 8.0, 3: 8.0, 4: 5.0}
SMOOTH, ENOUGH = 6, 3.0
"""Number of nodes per correlation length for each power alpha; from the power SMOOTH on it is ENOUGH. With
these numbers the error of a field of ENOUGH_RATIO times the noise is below the noise."""
ENOUGH_RATIO = 40.0
PAD_LENGTHS = 1.0
"""Width of the margin around the track that has nodes, in correlation lengths."""
MAX_FIELD_NODES = 4_000
"""Default of the largest number of nodes."""
SIDE = 1_500
"""Largest number of nodes along a side of the area's box, if the box is a square."""
MIN_LENGTH_M = 60.0
"""Shortest correlation length, m; a twentieth of an area smaller than that."""


def fine_enough(nodes: Nodes, length: float, alpha: int) -> bool:
    """Return True if the spacing of `nodes` suits a field of correlation `length`, m, and power `alpha`."""
    too_fine = length / nodes.spacing > 1.5 * _nodes_per_length(alpha, 1.0)
    return not too_fine and not too_coarse(nodes, length, alpha)


def too_coarse(nodes: Nodes, length: float, alpha: int, finer: float = 1.0) -> bool:
    """Return True if `nodes` are too sparse for a field of correlation `length`, m, and power `alpha`."""
    return length / nodes.spacing < 0.7 * _nodes_per_length(alpha, finer)


def _nodes_per_length(alpha: int, finer: float) -> float:
    return max(NODES_PER_LENGTH.get(alpha, ENOUGH), finer * ENOUGH)


def nodes_for(
    place: FloatArray, length: float, alpha: int, most: int = MAX_FIELD_NODES, finer: float = 1.0
) -> Nodes:
    """Return nodes around places (n, 2), m, for a field of correlation `length`, m, and power `alpha`.

    `most`: approximate largest number of nodes; the spacing grows until it is reached. `finer`: factor of the
    number of nodes per length of a smooth field; the splines' error decreases with its fourth power.
    """
    # begin with the spacing that the length needs, and increase it until there are few enough nodes
    box = np.ptp(place, axis=0) + 4.0 * PAD_LENGTHS * length
    spacing = max(length / _nodes_per_length(alpha, finer), float(np.sqrt(box.prod())) / SIDE)
    while (nodes := nodes_near(place, spacing, PAD_LENGTHS * length)).size > 1.05 * most:
        spacing *= (nodes.size / most) ** 0.5
    return nodes


def about_the_middle(place: FloatArray, number: int, wide: float = 0.0) -> BoolArray:
    """Return a mask (n,) of the `number` places nearest to the middle, and of all within `wide` m of it.

    `place` (n, 2): m. Distances are the larger of north and east, so the places lie in a square, which
    contains whole stretches of survey lines.
    """
    if len(place) <= number:
        return np.ones(len(place), bool)
    from_middle = np.abs(place - np.nanmedian(place, axis=0)).max(axis=1)
    return np.asarray(from_middle <= max(np.partition(from_middle, number)[number], wide))


def ladder(place: FloatArray) -> FloatArray:
    """Return the correlation lengths to try, m, for samples at `place` (n, 2), m."""
    # shortest: four steps between samples; longest: a fraction of the area
    known = place[np.isfinite(place).all(axis=1)]
    extent = float(np.hypot(*np.ptp(known, axis=0)))
    step = np.linalg.norm(np.diff(known, axis=0), axis=1)
    shortest = max(4.0 * float(np.median(step)), extent / 60.0, min(MIN_LENGTH_M, extent / 20.0))
    return np.asarray(np.geomspace(shortest, max(extent / 2.5, 1.5 * shortest), RUNGS))


# ---- The search ----

RESOLVED = 2.0
"""Smallest number of nodes per correlation length; the search omits a length that has fewer."""
FEWER = 1_500
"""Largest number of nodes of the smoothest fields, whose precision matrices are nearly full."""
DECISIVE_LOG_RATIO = 30.0
"""Difference of log evidence that decides between two kinds of field, or for an optional term."""
BENDS = 0.25
"""Exponent x with which fields of equal ``length (alpha - 1)^x`` have similar correlations."""
WHITE_AUTOCORRELATION = 0.03
"""Autocorrelation below which noise counts as white."""
MAX_FIT_AUTOCORRELATION = 0.995
"""Largest autocorrelation of a sample with the next one."""
SIZE, SIZE_SPREAD = 50.0, np.log(4.0)
"""Prior median of the crustal field's amplitude, nT, from airborne surveys, and 1-sigma of its logarithm."""
LENGTH_SPREAD = np.log(6.0)
"""Prior 1-sigma of the logarithm of the correlation length; its median is the middle length tried."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Candidate crustal field and noise, with their evidence."""

    field: GaussianField
    ratio: float
    """Standard deviation of the field over that of the noise."""
    rho: float
    """Autocorrelation of the noise of successive samples."""
    score: float = -np.inf
    """Natural logarithm of the evidence."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """Prior and noise with which the search computes the evidence of a field."""

    family: PriorFamily
    eta: FloatArray
    """`family`, `eta`: Prior of the other unknowns, and its log widths (h,)."""
    sigma: float
    """Initial standard deviation of the noise, nT."""
    middle: float
    """Prior median of the correlation length, m."""

    def score(self, reduced: FieldEliminated, field: GaussianField, ratio: float) -> float:
        """Return the log evidence of a field, maximised over the standard deviation of the noise."""
        # maximise over sigma, then add the Gaussian priors of log amplitude and log length
        log_sigma, value = float(np.log(self.sigma)), -np.inf
        for _ in range(4):  # Newton's method: in log sigma the evidence is nearly a parabola of curvature -2n
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
    deeper: FloatArray,
    rho: float | None = None,
    effort: float = 1.0,
    most: int = MAX_FIELD_NODES,
) -> Choice:
    """Return the field and noise of the largest evidence, without an initial field.

    `sums_of`: function that returns the normal equations of the samples for a field. `place` (n, 2): m.
    `start`: initial ratio of field and noise. `deeper` (n,): depth of the samples, m; if it matters, the
    search also tries a field that decreases upwards. `rho`: autocorrelation of the noise, if known. `effort`:
    fraction of the usual number of steps. `most`: largest number of nodes.
    """
    # A field of size s and length l changes with depth by about s / l. Over all samples these changes, in
    # units of the noise, have the norm (s / sigma) |deeper| / l, and change the log likelihood by half its
    # square: below 1 they do not matter.
    harmonic = bool(start * np.linalg.norm(deeper - deeper.mean()) > ladder(place)[0])
    # 1. correlation length at the usual smoothness; 2. decrease upwards; 3. smoothness; 4. sources at a
    # depth. Each step starts from the best field so far, and maximises the evidence over amplitude,
    # autocorrelation of the noise and length.
    move_rho, memory = rho is None, 0.3 if rho is None else rho

    def search_lengths(alpha: int) -> tuple[Choice, bool]:
        """Return the best field over the lengths, longest first, and True if a shorter length was worse."""
        best: Choice | None = None
        worse, ratio, rho = 0, start, memory
        for length in ladder(place)[::-1]:
            nodes = nodes_for(place, length, alpha, most)
            # the allowed number of nodes is too small for this length
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
                break  # shorter lengths need more nodes, and the evidence has a single maximum
        assert best is not None
        return best, worse > 0

    best, enclosed = search_lengths(SMOOTH)
    if not enclosed:  # the shortest length is best: try a rougher field
        rough, _ = search_lengths(SMOOTHNESS_POWERS[0])
        best = rough if rough.score > best.score else best

    def tried(choice: Choice, alpha: int, harmonic: bool, buried: bool = False) -> Choice:
        # keep the correlation similar when the power changes, so that the climb starts near its maximum
        length = choice.field.length * ((choice.field.alpha - 1) / (alpha - 1)) ** BENDS
        nodes = nodes_for(place, length, alpha, most if alpha <= SMOOTH else FEWER)
        field = GaussianField(nodes, length, alpha, harmonic, buried)
        begin = replace(choice, field=field)
        return climb(sums_of(field), begin, weighed, move_rho=move_rho, steps=int(36 * effort))

    # if the depth varies, try both kinds; if neither is decisively better, try the other again after step 3
    kinds = [tried(best, best.field.alpha, kind) for kind in ((True, False) if harmonic else (False,))]
    kinds.sort(key=lambda one: one.score)
    best = _smoothness(kinds[-1], tried)
    if harmonic and kinds[1].score - kinds[0].score < DECISIVE_LOG_RATIO:
        other = tried(best, best.field.alpha, not best.field.harmonic)
        best = _smoothness(other, tried) if other.score > best.score else best
    if best.field.alpha < SMOOTH:  # sources at a depth also have a slowly decreasing spectrum
        other = tried(best, BURIED_FACTORS, best.field.harmonic, buried=True)
        best = other if other.score > best.score else best
    return best


def _smoothness(best: Choice, tried: Callable[[Choice, int, bool], Choice]) -> Choice:
    """Return the best field over the powers alpha, increased from that of `best`, else decreased."""
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


def climb(
    sums: SampleSums,
    start: Choice,
    weighed: Weighed,
    *,
    move_ratio: bool = True,
    move_length: bool = True,
    move_rho: bool = True,
    steps: int = 40,
    tolerance: float = 0.1,
) -> Choice:
    """Maximise the evidence over ratio, length and autocorrelation on the nodes of `start`.

    `move_ratio`, `move_length`, `move_rho`: False to keep the value of `start`. `steps`: largest number of
    evaluations. `tolerance`: difference of log evidence at which the search ends.
    """
    # unknowns without bounds: log ratio, logit of rho over its largest value, log length
    share = np.clip(max(start.rho, 0.01) / MAX_FIT_AUTOCORRELATION, 1e-6, 1.0 - 1e-6)
    moves = [0] * move_ratio + [1] * move_rho + [2] * move_length
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

    # Nelder-Mead, because the evidence has no cheap derivative by the length, and at most three unknowns
    begin = first[moves]
    simplex = begin + np.vstack([np.zeros(len(moves)), np.diag(np.array([0.7, 0.8, 0.3])[moves])])
    found = minimize(
        downhill, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": steps, "xatol": 0.05, "fatol": tolerance},
    )  # fmt: skip
    best = choice_at(found.x)
    rho = best.rho if best.rho > WHITE_AUTOCORRELATION or not move_rho else 0.0
    return replace(best, rho=rho, score=-float(found.fun))


# ---- Uncertainty of amplitude and length ----

MAX_UNCERTAIN_NODES = 2_500
"""Number of nodes above which the uncertainty of amplitude and length is negligible."""
LOG_STEP = 0.3
"""Step in the logarithms of amplitude and length with which the evidence's curvature is computed."""
WIDEST = 0.7
"""Largest standard deviation of these logarithms; beyond it the evidence is not a parabola."""
RULE = ((0.0, 2.0 / 3.0), (3.0**0.5, 1.0 / 6.0), (-(3.0**0.5), 1.0 / 6.0))
"""Points and weights of the Gauss-Hermite rule for a standard normal distribution."""
MIN_WEIGHT = 0.01
"""Fraction of the total weight below which the mixture omits a point."""


def plausible(score: Callable[[Choice], float], best: Choice) -> list[tuple[float, Choice]]:
    """Return the points of the mixture in the module's notes, each with its weight; the first is `best`.

    The weights add up to 1. `score`: log evidence of a choice; it may raise LinAlgError.
    """
    if best.field.nodes.size > MAX_UNCERTAIN_NODES:
        return [(1.0, best)]

    def choice_at(x: FloatArray) -> Choice:
        field = replace(best.field, length=best.field.length * float(np.exp(x[1])))
        return replace(best, field=field, ratio=best.ratio * float(np.exp(x[0])))

    def value(x: FloatArray) -> float:
        try:
            return score(choice_at(x))
        except np.linalg.LinAlgError:
            return -np.inf

    top = value(np.zeros(2))
    spreads, axes = _spread(value, top)
    points: list[tuple[float, Choice]] = []
    for (g, p), (h, q) in product(RULE, RULE):
        x = axes @ (spreads * np.array([g, h]))
        # weight: the evidence over that of a parabola, which the rule assumes
        gained = (value(x) if x.any() else top) - top + 0.5 * (g * g + h * h)
        points.append((p * q * float(np.exp(min(gained, 5.0))), choice_at(x)))
    total = sum(weight for weight, _ in points)
    kept = [(weight, one) for weight, one in points if weight > MIN_WEIGHT * total]
    total = sum(weight for weight, _ in kept)
    return [(weight / total, one) for weight, one in kept]


def _spread(value: Callable[[FloatArray], float], top: float) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations (2,) along the axes of the evidence's curvature, and the axes (2, 2).

    `value`: log evidence at steps of log amplitude and log length from the maximum. `top`: its maximum.
    """
    a, b = LOG_STEP * np.eye(2)
    second = np.array([value(x) + value(-x) - 2.0 * top for x in (a, b, a + b)]) / LOG_STEP**2
    if not np.isfinite(second).all():
        return np.full(2, 0.1), np.eye(2)
    # second differences along both axes and their diagonal give the Hessian
    bend = np.diag(second[:2])
    bend[0, 1] = bend[1, 0] = 0.5 * (second[2] - second[:2].sum())
    values, axes = np.linalg.eigh(-bend)
    return np.maximum(values, WIDEST**-2.0) ** -0.5, axes
