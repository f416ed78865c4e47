r"""The map from corrected samples: a spatial Gaussian field, and a level for each line.

.. math:: y_i = f(x_i) + l_{line(i)} + s(t_i) + e_i

f is the field of :mod:`magbridge.estimation.gaussian_field`, l the level of a line, s slow changes with time.
Maximum evidence determines the amplitude, correlation length and smoothness of f, and the prior widths of l
and s. Map and sigma are the posterior's mean and standard deviation. The uncertainty of the calibration (its
`modes`) is not estimated from the same data, but added to the sigma (a *considered* uncertainty: Schmidt
1966).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.calibration.fitting.field_search import (
    ENOUGH_RATIO,
    Choice,
    Weighed,
    about_the_middle,
    choose,
    climb,
    ladder,
    nodes_for,
    plausible,
    too_coarse,
)
from magbridge.estimation.blocks import (
    NO_COEFFICIENTS,
    ParameterBlock,
    SlowFunctions,
    in_chunks,
    with_blocks,
)
from magbridge.estimation.elimination import MAX_CONDITION, FieldEliminated, SampleSums, eliminate_field
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.hyperparameters import Hyperparameters, maximise_evidence
from magbridge.estimation.information import covariance_of
from magbridge.estimation.priors import PriorFamily
from magbridge.estimation.residual import robust_scale
from magbridge.estimation.select import select_blocks
from magbridge.estimation.sparse import InverseBlocks, SparseFactor, inverse_blocks
from magbridge.survey.kriged import Kriged, kriged
from magbridge.survey.samples import Roughness, Rows, Samples

__all__ = ["FINER_NODES", "FINE_NOISE_NT", "Gridded", "Posterior", "gridded", "level_blocks"]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of the field for one pair of amplitude and correlation length."""

    weight: float
    """Posterior probability of this amplitude and correlation length."""
    field: GaussianField
    size: float
    sigma: float
    """`size`, `sigma`: standard deviation of the field where the roughness is 1, and of the noise, nT."""
    w: FloatArray
    """Coefficients of the field (nodes,)."""
    follow: FloatArray
    """Change (nodes, r) of the coefficients with 1-sigma of each other uncertainty: levels, slow changes,
    calibration."""
    precision: csr_array
    """Precision of the coefficients (nodes, nodes), in units of the noise's precision."""
    inverse: InverseBlocks
    """Blocks of the inverse of `precision`."""
    levels: FloatArray
    """Line level plus slow change (n,), nT, about their mean, to be subtracted from each sample."""
    mean: float
    """Mean of the field over the samples, nT, which a survey does not determine and the sigma excludes."""

    def evaluate(self, B: csr_array) -> tuple[FloatArray, FloatArray]:
        """Return the field (n,), nT, and its variance (n,), nT², at places with spline rows B (n, nodes)."""
        return B @ self.w, self.sigma**2 * self.inverse.variances(B) + ((B @ self.follow) ** 2).sum(axis=1)

    def draw(self, rng: np.random.Generator, number: int) -> FloatArray:
        """Draw `number` sets of coefficients (nodes, number) from the posterior."""
        # Random field by its precision, and the other uncertainties by their modes.
        off = self.sigma * SparseFactor(self.precision).draw(rng.normal(size=(len(self.w), number)))
        return np.asarray(
            self.w[:, None] + off + self.follow @ rng.normal(size=(self.follow.shape[1], number))
        )


@dataclass(frozen=True, eq=False)
class Gridded:
    """Gridded survey, whose :meth:`evaluate` returns the anomaly and its sigma at any place."""

    posteriors: tuple[Posterior, ...]
    """Posteriors for the plausible pairs of amplitude and correlation length, the likeliest first."""
    roughness: Roughness
    """Variation of the field's amplitude from place to place."""
    rho: float
    """Autocorrelation of the noise of successive samples."""
    middle: float
    """Depth at which the map holds, m."""
    mean: float
    """Mean of the kept samples, and of the map over them, nT."""
    kept: BoolArray
    """True (n,) for samples that are not outliers."""
    widths: Hyperparameters
    """Prior widths and noise that maximise the evidence."""
    kriged: Kriged | None = None
    """Predictor to use instead of the nodes if these are coarser than the crustal field."""

    @property
    def field(self) -> GaussianField:
        """Gaussian field of the likeliest posterior."""
        return self.posteriors[0].field

    @property
    def size(self) -> float:
        """Standard deviation of the field where the roughness is 1, nT."""
        return float(np.sqrt(sum(one.weight * one.size**2 for one in self.posteriors)))

    @property
    def sigma(self) -> float:
        """Standard deviation of the samples' noise, nT."""
        return self.posteriors[0].sigma if self.kriged is None else self.kriged.noise

    @property
    def levels(self) -> FloatArray:
        """Line level plus slow change (n,), nT, to be subtracted from each sample."""
        return np.asarray(sum(one.weight * one.levels for one in self.posteriors))

    def evaluate(
        self, place: FloatArray, depth: FloatArray | float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the anomaly and its 1-sigma, (n,) each, nT, at places (n, 2), m, and depths (n,), m.

        The default depth is the map's. Kriging ignores `depth`: its anomaly is at the samples' depth.
        """
        if self.kriged is not None:
            return self._beside_samples(place)
        # Mixture over the plausible sizes and lengths: mean, and second moment for the variance.
        deeper = 0.0 if depth is None else np.asarray(depth, float) - self.middle
        scale = self.roughness.evaluate(place)
        outside = ~self.field.nodes.covers(place)
        mean, square = np.zeros(len(place)), np.zeros(len(place))
        for one in self.posteriors:
            here, variance = one.evaluate(csr_array(diags_array(scale) @ one.field.basis(place, deeper)))
            # Beyond the nodes the prior is all that is known.
            variance[outside] = (one.size * scale[outside]) ** 2
            if depth is not None:
                here = here + scale * one.field.lacking(place, np.broadcast_to(deeper, len(place)), one.w)
            here = here - one.mean
            mean += one.weight * here
            square += one.weight * (variance + here**2)
        return self.mean + mean, np.sqrt(np.maximum(square - mean**2, 0.0))

    def _beside_samples(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return anomaly and 1-sigma (n,), nT, by kriging; levels and calibration add to the sigma."""
        assert self.kriged is not None
        # Kriging gives field and noise; levels and calibration enter by the coarse nodes.
        mean, variance = self.kriged.evaluate(place)
        B = csr_array(diags_array(self.roughness.evaluate(place)) @ self.field.basis(place))
        return mean, np.sqrt(variance + ((B @ self.posteriors[0].follow) ** 2).sum(axis=1))

    def draw(self, place: FloatArray, number: int) -> Iterator[FloatArray]:
        """Yield about `number` random anomalies (n,), nT, from the posterior at places (n, 2), m."""
        rng, rough = np.random.default_rng(0), self.roughness.evaluate(place)
        for one in self.posteriors:
            B = one.field.basis(place)
            for w in one.draw(rng, round(one.weight * number)).T:
                yield self.mean - one.mean + rough * (B @ w)

    def at_samples(self, samples: Samples) -> FloatArray:
        """Return the gridded anomaly (n,), nT, at the places and depths of the samples."""
        # Chunks bound the memory of the splines.
        deeper, rough = np.nan_to_num(samples.depth - self.middle), self.roughness.evaluate(samples.place)

        def evaluate_rows(rows: slice) -> FloatArray:
            parts = [
                one.weight
                * (rough[rows] * (one.field.basis(samples.place[rows], deeper[rows]) @ one.w) - one.mean)
                for one in self.posteriors
            ]
            return np.asarray(self.mean + sum(parts))

        lacking = [one.weight * one.field.lacking(samples.place, deeper, one.w) for one in self.posteriors]
        return np.asarray(in_chunks(len(rough), evaluate_rows) + rough * np.sum(lacking, axis=0))


LEVEL, LEVEL_SPREAD = 5.0, np.log(5.0)
"""Prior 1-sigma of the levels of lines, nT, and the 1-sigma of its logarithm."""
SLOW, SLOW_SPREAD = 2.0, np.log(10.0)
"""Prior 1-sigma of slow changes, nT, and the 1-sigma of its logarithm."""
UNOBSERVED_CHANGE_NT = 0.25
"""Prior 1-sigma of slow changes, nT, if the evidence does not require larger ones. On a track that never
crosses itself, slow changes look like crustal anomalies: with a free width they absorbed 6 nT of these."""
SEARCHED, SEARCHED_NODES = 4_000, 12_000
"""Largest numbers of samples and of nodes in the search for the field's parameters."""
VARIATION_BOX_M = 5_000.0
"""Smallest half width of the square about the middle from which the search takes (thinned) samples, m."""
GRID_OUTLIER_SIGMA = 6.0
"""Residual in sigmas beyond which a sample is an outlier."""
FINER_NODES = 2.5
"""Factor of the nodes per correlation length if a joint fit has found the field and its small noise."""
FINE_NOISE_NT = 0.05
"""Initial noise of a scalar survey's search, nT; it is below the true noise, because only that is fast."""
LARGE, LIKELIER = 100.0, 5.0
"""Smallest area, in squared correlation lengths, and smallest gain of log likelihood with which the field's
amplitude varies from place to place."""
MAX_GRID_NODES = 40_000
"""Largest number of nodes; their variances take 0.5 GB of memory."""


def gridded(samples: Samples, *, local: bool = True, start: Choice | None = None) -> Gridded:
    """Return the gridded field of the corrected samples of a survey.

    With `local`, the field's amplitude may vary from place to place. `start` is the field and noise that a
    joint fit has found; without it, a search over part of the samples determines them.
    """
    # 1. Field and noise from a part of the samples, or from a joint fit.
    sigma = max(robust_scale(np.diff(samples.value)) / 2.0**0.5, 0.1) if start is None else FINE_NOISE_NT
    choice, roughness = _searched(samples, sigma, local=local, start=start)
    # 2. Nodes for the whole area at that length.
    finer = 1.0 if start is None else FINER_NODES
    choice = _on_nodes(choice, samples.place, finer)
    nodes = choice.field.nodes
    every = np.arange(len(samples.value))
    # 3. Sums over all samples; keep slow changes only if the evidence wants them.
    problem = Rows(samples, level_blocks(samples), roughness)
    sums = problem.sums(choice.field, every)
    groups = _needed(problem.groups, sums, choice, sigma)
    family = with_blocks(NO_COEFFICIENTS, groups)
    weighed = Weighed(family, family.centre, sigma, choice.field.length)
    # 4. Fit, leave out the outliers, subtract what the basis lacks of the fitted field, and fit again.
    deep = choice.field.harmonic and bool(problem.deeper.any())
    turns = 3 if deep else 2
    for turn in range(turns):
        reduced = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
        widths = maximise_evidence(reduced.quadratic, family, weighed.eta, sigma)
        z, _ = _solved(reduced, widths, family)
        w = reduced.field(z)
        problem.correct(choice.field, w)
        e = samples.value - problem.mean - problem.D @ z - problem.rock(choice.field, w)
        e = e / problem.scale  # unresolved anomalies grow with the roughness of the crustal field
        far = np.abs(e) > GRID_OUTLIER_SIGMA * max(robust_scale(e), widths.sigma)
        if turn == turns - 1 or not (deep or far.any()):
            break
        problem.kept = ~far
        sums = problem.sums(choice.field, every)
        weighed = replace(weighed, eta=widths.eta, sigma=widths.sigma)
    # 5. The calibration's uncertainty is considered, not estimated (Schmidt 1966).
    shaken = np.empty((nodes.size, 0))
    if samples.modes.shape[1]:
        shaken = _considered(problem, choice, reduced, widths, family, every)

    # 6. One posterior for each plausible size and length.
    weighed = replace(weighed, eta=widths.eta)

    def score(choice: Choice) -> float:
        reduced = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
        return weighed.score(reduced, choice.field, choice.ratio)

    posteriors = [
        _posterior(weight, one, sums, problem, family, widths, shaken)
        for weight, one in plausible(score, choice)
    ]
    found = Gridded(
        tuple(posteriors), roughness, choice.rho, problem.middle,
        float(samples.value[problem.kept].mean()), problem.kept, widths,
    )  # fmt: skip
    # 7. Krige from the nearest samples where the nodes are coarser than the field.
    if not too_coarse(nodes, choice.field.length, choice.field.alpha, finer):
        return found
    levelled, kept = samples.value - found.levels, problem.kept
    return replace(found, kriged=kriged(samples.part(kept), levelled[kept], choice.field.length))


def _on_nodes(choice: Choice, place: FloatArray, finer: float) -> Choice:
    """Return the choice on nodes for places (n, 2), m, at least `finer` times as many per length as usual."""
    # The splines' error decreases with the fourth power of the spacing, and must stay below the noise.
    wanted, field = max((choice.ratio / ENOUGH_RATIO) ** 0.25, finer), choice.field
    while True:
        nodes = nodes_for(place, field.length, field.alpha, MAX_GRID_NODES, wanted)
        field = replace(field, nodes=nodes)
        # The prior of a smooth field on very fine nodes is singular to rounding.
        if field.condition <= MAX_CONDITION or wanted <= finer:
            return replace(choice, field=field)
        wanted = max(0.9 * wanted, finer)


def _posterior(
    weight: float,
    choice: Choice,
    sums: SampleSums,
    problem: Rows,
    family: PriorFamily,
    widths: Hyperparameters,
    shaken: FloatArray,
) -> Posterior:
    """Return the posterior of the field for the amplitude and length of `choice`, with a given `weight`.

    `shaken` (nodes, r) is the change of the coefficients with 1-sigma of each of the calibration's modes.
    """
    reduced = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
    z, covariance = _solved(reduced, widths, family)
    # Shift of the nodes with 1-sigma of each other unknown: dw/dz times a root of its covariance.
    follow = np.hstack([reduced.follow @ np.linalg.cholesky(covariance), shaken])
    w, mean = reduced.field(z), problem.mean_over_samples(choice.field)
    follow -= (mean @ follow)[None, :] / max(mean.sum(), 1e-9)  # the level is uncertain by itself
    levels = problem.D @ z
    return Posterior(
        weight, choice.field, choice.ratio * widths.sigma, widths.sigma, w, follow,
        reduced.precision, inverse_blocks(reduced.precision, choice.field.edges(reduced.precision)),
        levels - levels[problem.kept].mean(), float(mean @ w + problem.lacking[problem.kept].mean()),
    )  # fmt: skip


def level_blocks(samples: Samples) -> tuple[ParameterBlock, ...]:
    """Return the parameter blocks of the lines' levels and, if the time is known, of slow changes."""
    # One column for each line: 1 at its samples.
    of = np.unique(samples.line, return_inverse=True)[1].ravel()
    levels = np.zeros((len(of), int(of.max()) + 1))
    levels[np.arange(len(of)), of] = 1.0
    groups = [ParameterBlock("levels of lines", levels, np.ones(levels.shape[1]), LEVEL, LEVEL_SPREAD)]
    if levels.shape[1] == 1:  # along a single line, the crustal field may have one sign: a wide prior
        groups = [ParameterBlock("level", levels, np.ones(1), max(float(np.ptp(samples.value)), LEVEL))]
    if np.isfinite(samples.time).all():
        # Slow changes are offered: the evidence decides whether they are needed.
        waves = SlowFunctions(samples.time, powers=2)
        if len(waves.shape):
            groups.append(
                ParameterBlock("slow change with time", waves, waves.shape, SLOW, SLOW_SPREAD, offered=True)
            )
    return tuple(groups)


def _needed(
    groups: tuple[ParameterBlock, ...], sums: SampleSums, choice: Choice, sigma: float
) -> tuple[ParameterBlock, ...]:
    """Return the blocks with a small width for slow changes, unless the evidence requires a larger one."""
    if not any(one.offered for one in groups):
        return groups
    reduced = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
    kept = select_blocks(
        reduced.quadratic, NO_COEFFICIENTS, groups, with_blocks(NO_COEFFICIENTS, groups).centre, sigma
    )
    return tuple(
        one if one in kept else replace(one, width=UNOBSERVED_CHANGE_NT, spread=0.0) for one in groups
    )


def _searched(
    samples: Samples, sigma: float, *, local: bool, start: Choice | None = None
) -> tuple[Choice, Roughness]:
    """Return field and roughness from a part of the samples, whose noise is about `sigma` nT."""
    # The part about the middle, thinned to SEARCHED samples.
    part = np.flatnonzero(about_the_middle(samples.place, SEARCHED, VARIATION_BOX_M))
    step = max(len(part) // SEARCHED, 1)
    few = samples.part(part[::step])
    groups, rows = level_blocks(few), np.arange(len(few.value))
    family = with_blocks(NO_COEFFICIENTS, groups)
    weighed = Weighed(family, family.centre, sigma, float(np.median(ladder(few.place))))
    even = Roughness.uniform()
    problem = Rows(few, groups, even)
    # Scatter of the samples, as the first guess of the field's size.
    size = max(robust_scale(few.value - problem.mean), 5.0)
    uniform = not local or _few_lengths(samples, start)
    if start is not None and uniform:
        return start, even
    if start is not None:
        begin = replace(start, rho=start.rho**step)
        best = climb(problem.sums(start.field, rows), begin, weighed, move_rho=False, steps=16)
        rho = start.rho
    else:
        best = choose(
            lambda field: problem.sums(field, rows), few.place, weighed, size / sigma,
            deeper=problem.deeper, effort=0.5, most=SEARCHED_NODES,
            rho=None if samples.rho is None else samples.rho**step,
        )  # fmt: skip
        rho = best.rho ** (1.0 / step) if samples.rho is None else samples.rho
    if uniform or _few_lengths(samples, best):
        return replace(best, rho=rho), even
    # Compare a field of one amplitude with a field whose amplitude is proportional to the roughness.
    uneven = Roughness.from_samples(samples, best.field.length)
    problem = Rows(few, groups, uneven)
    other = climb(problem.sums(best.field, rows), best, weighed, move_rho=False, steps=16)
    best, chosen = (other, uneven) if other.score > best.score + LIKELIER else (best, even)
    return replace(best, rho=rho), chosen


def _few_lengths(samples: Samples, choice: Choice | None) -> bool:
    """Return True if a survey is too small for a field of varying amplitude; False without a field."""
    # Number of independent cells: area over length squared.
    area = float(np.prod(np.ptp(samples.place, axis=0)))
    return choice is not None and area < LARGE * choice.field.length**2


def _solved(
    reduced: FieldEliminated, widths: Hyperparameters, family: PriorFamily
) -> tuple[FloatArray, FloatArray]:
    """Return the posterior mean (q,) and covariance (q, q) of all unknowns but the field."""
    # Posterior of z with the field eliminated.
    precision = reduced.quadratic.precision / widths.sigma**2 + family.prior(widths.eta).precision
    z = np.linalg.solve(precision, reduced.quadratic.vector / widths.sigma**2)
    return np.asarray(z, float), covariance_of(precision)


def _considered(
    problem: Rows,
    choice: Choice,
    reduced: FieldEliminated,
    widths: Hyperparameters,
    family: PriorFamily,
    rows: IndexArray,
) -> FloatArray:
    """Return the change (nodes, r) of the field's coefficients with 1-sigma of each calibration mode."""
    q = len(problem.D)
    sums = problem.sums(choice.field, rows, modes=True)
    # Eliminate the field with the modes as further unknowns; then let levels follow the modes.
    all_in = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
    H = all_in.quadratic.precision / widths.sigma**2
    own = np.linalg.solve(H[:q, :q] + family.prior(widths.eta).precision, H[:q, q:])
    return np.asarray(all_in.follow[:, q:] - reduced.follow @ own)
