"""Iterations of a joint fit to a survey, which alternate coefficients, prior widths and crustal field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.field_search import (
    SIZE,
    SMOOTH,
    Choice,
    Weighed,
    about_the_middle,
    choose,
    climb,
    fine_enough,
    ladder,
    nodes_for,
)
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.solve import approach, starts
from magbridge.errors import NoSolutionError
from magbridge.estimation.blocks import (
    BLOCK_ROWS,
    BlockColumns,
    OffsetBlock,
    ParameterBlock,
    in_chunks,
    with_blocks,
)
from magbridge.estimation.elimination import (
    FieldEliminated,
    LinearisedRows,
    SampleSums,
    eliminate_field,
    sum_rows,
)
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.hyperparameters import Hyperparameters, maximise_evidence
from magbridge.estimation.information import covariance_of
from magbridge.estimation.priors import PriorFamily
from magbridge.estimation.residual import (
    ResidualSamples,
    jacobian,
    residual_scale,
    residuals,
    residuals_of,
    robust_scale,
)
from magbridge.estimation.select import select_blocks

# ---- The state of the iterations, and where they begin ----


@dataclass(frozen=True, eq=False)
class Answer:
    """Solution of the joint fit after an iteration."""

    z: FloatArray
    """(q,): Unknowns other than the field: coefficients, and those of the blocks."""
    sums: SampleSums
    """Normal equations from which z follows."""
    choice: Choice
    """Chosen field and autocorrelation of the noise."""
    widths: Hyperparameters
    """Prior widths (their logarithms eta) and noise."""
    family: PriorFamily
    lacking: FloatArray
    """(n,): Part of the true field that the reference lacks: crustal field, bias and slow changes, nT."""
    score: float
    """Natural logarithm of the evidence."""

    def covariance(self) -> FloatArray:
        """Return the covariance of z (q, q) at the likeliest amplitude and length of the field.

        An average over other amplitudes and lengths would change the normalised error of a survey by 0.0001.
        """
        choice = self.choice
        reduced = eliminate_field(self.sums, choice.field, choice.ratio, choice.rho)
        precision = self.family.prior(self.widths.eta).precision
        return covariance_of(reduced.quadratic.precision / self.widths.sigma**2 + precision)


# ---- The iterations ----

INITIAL_ITERATIONS = 2
"""Number of iterations before the search of the field: first errors of coefficients look like crust."""
SEARCHES = 2
"""Number of further iterations in which the search continues."""
MAX_SURVEY_ITERATIONS = 40
"""Largest number of iterations; six are usual, twenty if the start is wrong by 10,000 nT."""
MAX_LATE_ITERATIONS = 8
"""Number of iterations after the search, after which the optional terms are selected at the latest."""
MAX_LAST_CHANGE = 0.05
"""RMS change of the residuals, as a fraction of the noise, below which the fit has converged."""
FIT_OUTLIER_SIGMA = 5.0
"""Residual beyond which a sample is excluded, in robust sigmas."""
OVERSHOT = 10.0
"""Factor of growth of the objective above which a step is halved."""
MIN_ITERATION_STEP = 1e-3
"""Smallest fraction to which a step is shortened."""
SEARCHED, WIDE = 12_000, 5_000.0
"""The search of the field's amplitude and length uses the SEARCHED samples nearest to the middle, or all
within WIDE m. If these are too many, it uses every second, third ... sample of them."""
FIRST_SAMPLES = 50_000
"""Approximate number of samples with which a longer log converges, before it continues with all."""
NOISE_ALONE: dict[str, Any] = {"move_ratio": False, "move_length": False, "steps": 16}
"""Arguments of :func:`climb` for a search of the noise's autocorrelation only."""
MAX_SAMPLE_NODES = 40_000
"""Approximate largest number of nodes around all samples."""


class Rounds:
    """Iterative solver of a joint fit, which alternates coefficients, prior widths and field.

    `survey`: data of the fit. `family`: prior of the coefficients.
    """

    def __init__(self, survey: SurveySamples, family: PriorFamily) -> None:
        self.survey, self.own, self.q = survey, family, family.E.shape[1]
        # iterations up to `until` search the field; the fit may end only after them
        self.until = INITIAL_ITERATIONS + SEARCHES
        self.offers = any(one.offered for one in survey.groups)
        self.family = with_blocks(family, survey.groups)
        # a part about the middle shows size and length of the field as well as all samples do
        self.part = about_the_middle(survey.place, SEARCHED, WIDE)
        self.step = max(int(self.part.sum()) // SEARCHED, 1)
        place = survey.place[self.part]
        lengths = ladder(place)
        self.middle, length = float(np.median(lengths)), float(lengths[len(lengths) // 2 + 1])
        # a field of middle length and usual amplitude, with white noise
        field = GaussianField(nodes_for(place, length, SMOOTH), length, SMOOTH)
        self.choice = self._everywhere(Choice(field, SIZE, 0.0))
        # begin near the solution, with the crustal field as noise: the start with the smaller residuals
        samples, prior = survey.samples, self.family.prior(self.family.centre)
        begun = [approach(samples, prior, self.family.nearest_latent(one)) for one in starts(samples)]
        near = min(begun, key=lambda one: one.noise.sigma)
        self.z, self.sigma = near.z, max(near.noise.sigma, 1.0)
        self.eta, self.w = self.family.centre, np.zeros(self.choice.field.nodes.size)
        self.nodes = self.choice.field.nodes
        self.last: FloatArray | None = None

    def go_on(self, survey: SurveySamples, step: int) -> None:
        """Continue with all samples, `survey`, and no search, after a fit of every `step`-th sample."""
        self.survey, self.until = survey, -1
        # samples are now closer by `step`: AR(1) noise has rho^(1/step) between neighbours
        self.choice = replace(self.choice, rho=self.choice.rho ** (1.0 / step))
        field = self.choice.field
        survey.bend(field, self.w, self.z[self.q :])
        self.last = self._residuals(self.z, self._slow(self.z) + survey.rock(field, self.w))
        survey.kept = survey.at_rest & (np.abs(self.last) <= FIT_OUTLIER_SIGMA * robust_scale(self.last))
        weighed = Weighed(self.family, self.eta, self.sigma, self.middle)
        self.choice = climb(self._sums(field), self.choice, weighed, **NOISE_ALONE)

    def settle(self) -> Answer:
        """Return the converged solution; NoSolutionError: the iterations do not converge."""
        survey, moved = self.survey, np.inf
        for turn in range(MAX_SURVEY_ITERATIONS):
            # dipoles are not linear in their positions: linearise the prior about the last solution
            if self.own.renew is not None and turn:
                self.own = self.own.renew(self.z[: self.q])
                self.family = with_blocks(self.own, survey.groups)
            answer = self._round(turn)
            e = self._residuals(answer.z, answer.lacking)
            # the fit has converged when the residuals no longer change, even if coefficients still do
            if self.last is not None:
                moved = float(np.sqrt(np.mean((e - self.last) ** 2)))
            self.last = e
            # exclude outliers only after the first iterations, whose residuals show the wrong start
            if turn >= INITIAL_ITERATIONS:
                survey.kept = survey.at_rest & (np.abs(e) <= FIT_OUTLIER_SIGMA * robust_scale(e))
            still = turn > self.until and moved < MAX_LAST_CHANGE * self.sigma
            if still and not self.offers:
                return answer
            if self.offers and (still or turn == self.until + MAX_LATE_ITERATIONS):
                self._weigh_offers(turn)
        if moved > self.sigma:
            raise NoSolutionError("the fit to the survey did not converge: the data contradict themselves")
        return answer

    def _round(self, turn: int) -> Answer:
        """Return the solution after iteration number `turn`, which may include a search of the field."""
        weighed = Weighed(self.family, self.eta, self.sigma, self.middle)
        if searched := self.until - SEARCHES <= turn <= self.until:
            self._search(weighed, anew=turn == self.until - SEARCHES)
        # 1. normal equations about the last answer, and the sparse field eliminated from them
        sums = self._sums(self.choice.field)
        if searched and self.step > 1:
            # size and length were chosen with a part of the samples
            self.choice = climb(sums, self.choice, weighed, **NOISE_ALONE)
        choice = self.choice
        reduced = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
        # 2. widths of the priors, and sigma, by the evidence of the eliminated problem
        widths = maximise_evidence(reduced.quadratic, self.family, self.eta, self.sigma)
        self.eta, self.sigma = widths.eta, widths.sigma
        # 3. the Gauss-Newton step of z, then the field's coefficients w given z
        precision = reduced.quadratic.precision / self.sigma**2 + self.family.prior(self.eta).precision
        step = np.linalg.solve(precision, reduced.quadratic.vector / self.sigma**2) - self.z
        self.z, lacking = self._damped(np.asarray(step, float), reduced, choice.field)
        self.w, self.nodes = reduced.field(self.z), choice.field.nodes
        # 4. move the track, and linearise its drift about the new one
        if self.survey.drift is not None:
            self.survey.bend(choice.field, self.w, self.z[self.q :])
            lacking = self._slow(self.z) + self.survey.rock(choice.field, self.w)
        score = widths.log_evidence + reduced.log_evidence
        return Answer(self.z, sums, choice, widths, self.family, lacking, score)

    def _search(self, weighed: Weighed, *, anew: bool) -> None:
        """Choose the field with a part of the samples, and set it up on nodes around all samples."""
        place, before = self.survey.place[self.part], self.choice
        # first over a ladder of lengths, later from the last choice
        if anew:
            found = choose(self._few, place, weighed, before.ratio, deeper=self.survey.deeper[self.part])
        else:
            field = before.field
            if not self.part.all() or not fine_enough(field.nodes, field.length, field.alpha):
                field = replace(field, nodes=nodes_for(place, field.length, field.alpha))
            begin = replace(before, field=field, rho=before.rho**self.step)
            found = climb(self._few(field), begin, weighed, steps=30)
        self.choice = self._everywhere(replace(found, rho=found.rho ** (1.0 / self.step)))

    def _everywhere(self, choice: Choice) -> Choice:
        """Return a choice that was made with a part of the samples, with its nodes around all samples."""
        if self.part.all():
            return choice
        field = choice.field
        nodes = nodes_for(self.survey.place, field.length, field.alpha, MAX_SAMPLE_NODES)
        return replace(choice, field=replace(field, nodes=nodes))

    def _weigh_offers(self, turn: int) -> None:
        """Keep the optional terms that the evidence supports; before convergence they fit outliers."""
        survey, choice = self.survey, self.choice
        self.offers = False
        reduced = eliminate_field(self._sums(choice.field), choice.field, choice.ratio, choice.rho)
        kept = select_blocks(reduced.quadratic, self.own, survey.groups, self.eta, self.sigma)
        if len(kept) < len(survey.groups):
            self._regroup(kept)
            self.until = turn + SEARCHES

    def _regroup(self, groups: tuple[ParameterBlock, ...]) -> None:
        """Continue with the blocks of unknowns `groups`; blocks that stay keep their values and widths."""
        # read the present values by name, and copy them to the position of the same block in the new order
        at, width, row, column = {}, {}, self.q, len(self.own.centre)
        for one in self.survey.groups:
            at[one.name], width[one.name] = self.z[row : row + len(one.shape)], self.eta[column : column + 1]
            row, column = row + len(one.shape), column + bool(one.spread)
        z = [at.get(one.name, np.zeros(len(one.shape))) for one in groups]
        eta = [width.get(one.name, np.log([one.width])) for one in groups if one.spread]
        self.z = np.concatenate([self.z[: self.q], *z])
        self.eta = np.concatenate([self.eta[: len(self.own.centre)], *eta])
        self.survey.keep(groups)
        self.family = with_blocks(self.own, groups)

    def _damped(
        self, step: FloatArray, reduced: FieldEliminated, field: GaussianField
    ) -> tuple[FloatArray, FloatArray]:
        """Return z (q,) after a step, and the part (n,), nT, of the true field that the reference then lacks.

        `step` (q,): Gauss-Newton step of z; it is halved while it increases the objective too much.
        """
        precision, survey = self.family.prior(self.eta).precision, self.survey
        # after the fraction `part` of the step the reference lacks `here + part * change`
        here, change = survey.rock(field, np.column_stack([reduced.field(self.z), reduced.follow @ step])).T
        here, change = here + self._slow(self.z), change + self._slow(step)
        if survey.slopes.size:
            change += survey.slopes @ step[self.q + survey.bent :]

        def objective(part: float) -> float:
            z = self.z + part * step
            e = self._residuals(z, here + part * change)[survey.kept]
            return float(e @ e) / self.sigma**2 + float(z @ precision @ z)

        # halve the step until the objective stays within OVERSHOT of the previous one
        before, part = objective(0.0), 1.0
        while part > MIN_ITERATION_STEP and not objective(part) < OVERSHOT * before:
            part *= 0.5
        return self.z + part * step, here + part * change

    def _few(self, field: GaussianField) -> SampleSums:
        return self._sums(field, np.flatnonzero(self.survey.kept & self.part)[:: self.step], self.step)

    def _sums(self, field: GaussianField, rows: IndexArray | None = None, step: int = 1) -> SampleSums:
        """Return the normal equations of `rows`, every `step`-th sample, linear about the last solution."""
        # on new nodes the linearisation is about a field of 0
        w = self.w if field.nodes is self.nodes else np.zeros(field.nodes.size)
        self.survey.bend(field, w, self.z[self.q :])
        rows = np.flatnonzero(self.survey.kept) if rows is None else rows
        return sum_rows(self.survey.linear(self.family, self.z, field, w, rows, step))

    def _slow(self, z: FloatArray) -> FloatArray:
        return self.survey.slow(z[self.q :])

    def _residuals(self, z: FloatArray, lacking: FloatArray) -> FloatArray:
        samples = self.survey.samples
        known: ResidualSamples = replace(
            samples,
            reference=samples.reference + lacking,
            field=samples.field - self.survey.offset(z[self.q :]),
        )
        return residuals_of(known, self.family.E @ z + self.family.offset)


class SurveySamples:
    """Samples of a joint fit, with the unknowns besides coefficients and field, and their linearisation.

    `data`: observations with positions and `unmapped`. `samples`: the same samples with their monomials.
    `groups`: blocks of unknowns in addition to the coefficients. `drift`: block of slow functions for the
    drift of a position; None: positions are exact.
    """

    def __init__(
        self,
        data: Observations,
        samples: ResidualSamples,
        groups: tuple[ParameterBlock, ...],
        drift: ParameterBlock | None = None,
    ) -> None:
        assert data.place is not None
        assert data.unmapped is not None
        self.samples, self.drift = samples, drift
        self.unmapped = data.unmapped
        self.place = self.as_logged = data.place[:, :2]
        self.middle = float(np.nanmedian(data.place[:, 2]))
        self.deeper = np.nan_to_num(data.place[:, 2] - self.middle)
        self.at_rest = data.at_rest
        self.kept = self.at_rest.copy()
        if drift is not None:
            nothing = np.zeros((len(samples.field), 0))
            ways = (replace(drift, name=f"position {way}", functions=nothing) for way in ("north", "east"))
            groups = (*groups, *ways)
        self.keep(groups)

    def thinned(self, step: int) -> SurveySamples:
        """Return a copy with every `step`-th sample."""
        few, rows = copy(self), np.arange(0, len(self.kept), step)
        for name in ("unmapped", "place", "as_logged", "deeper", "at_rest", "kept"):
            setattr(few, name, getattr(self, name)[rows])
        # intervals are counted in units of `step`, so that the noise has one autocorrelation per row
        few.samples = replace(self.samples.part(rows), steps=np.append(np.inf, self._intervals(rows)) / step)
        if self.drift is not None:
            few.drift = replace(self.drift, functions=self.drift.functions[rows])
        few.keep(tuple(replace(group, functions=group.functions[rows]) for group in self.groups))
        return few

    def keep(self, groups: tuple[ParameterBlock, ...]) -> None:
        """Set the blocks of unknowns: blocks of the reference come first, then offsets, then drift."""
        self.groups = groups
        self.offsets = [group for group in groups if isinstance(group, OffsetBlock)]
        self.steady = BlockColumns([group for group in groups if not isinstance(group, OffsetBlock)])
        self.bent = len(self.steady) + sum(len(group.shape) for group in self.offsets)
        """Index of the first unknown of the positions' drift among the unknowns of all blocks."""
        many = 0 if self.drift is None else len(self.drift.shape)
        # columns: reference blocks, offset blocks (x, y, z of each), drift north, drift east
        self.slopes = np.zeros((len(self.kept), 2 * many))

    def slow(self, latent: FloatArray) -> FloatArray:
        """Return the bias and slow changes (n,), nT, that the reference lacks, of all unknowns (p,)."""
        return (self.steady @ latent[: len(self.steady)]) * self.unmapped

    def offset(self, latent: FloatArray, blocks: Sequence[OffsetBlock] | None = None) -> FloatArray:
        """Return the sensor's offset (n, 3), nT, by temperature and drift.

        `latent` (p,): unknowns of all blocks. `blocks`: offset blocks to include; default: all.
        """
        # an offset block has its functions on each axis in turn: d = (x..., y..., z...)
        out, start = np.zeros((len(self.kept), 3)), len(self.steady)
        for group in self.offsets:
            d = latent[start : start + len(group.shape)]
            start += len(d)
            if blocks is None or group in blocks:
                out += group.functions @ d.reshape(3, -1).T
        return out

    def basis(self, field: GaussianField, rows: IndexArray | slice) -> csr_array:
        """Return the matrix (m, nodes) from coefficients of the field to the reference at `rows`."""
        known = field.basis(self.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.unmapped[rows]) @ known)

    def rock(self, field: GaussianField, w: FloatArray) -> FloatArray:
        """Return the crustal field (n,) or (n, k), nT, of coefficients w, (nodes,) or (nodes, k)."""
        return in_chunks(len(self.kept), lambda rows: self.basis(field, rows) @ w)

    def bend(self, field: GaussianField, w: FloatArray, latent: FloatArray) -> None:
        """Move the track by the drift in `latent`, and update the derivatives of the field by the drift.

        `w` (nodes,): coefficients of the field. `latent` (p,): unknowns of all blocks.
        """
        if self.drift is None:
            return
        # f(x + dx) = f(x) + grad f . dx, dx = waves @ (north, east): the slope is taken at the new place
        north, east = latent[self.bent :].reshape(2, -1)
        waves = self.drift.functions[:]
        self.place = self.as_logged + np.stack([waves @ north, waves @ east], axis=1)
        slopes = [(slope @ w * self.unmapped)[:, None] * waves for slope in field.slopes(self.place)]
        self.slopes = np.hstack(slopes)

    def linear(
        self,
        family: PriorFamily,
        z: FloatArray,
        field: GaussianField,
        w: FloatArray,
        rows: IndexArray,
        step: int = 1,
    ) -> Iterator[LinearisedRows]:
        """Yield blocks of the samples `rows` (m,), linearised about z (q,) and w (nodes,).

        `step`: spacing of `rows` in samples.
        """
        # One row of the linearised residual: e(z, w) = e_0 + D (z - z_0) + B (w - w_0). D holds the
        # derivatives by coefficients, reference blocks, offsets and drift; everything is over s, the size
        # of a sensor nT.
        latent = z[family.E.shape[1] - sum(len(group.shape) for group in self.groups) :]
        slow, offset = self.slow(latent), self.offset(latent)
        follows = np.zeros(len(rows), bool)
        follows[1:] = self._intervals(rows) == step
        c = family.E @ z + family.offset
        E = family.E[:, : len(z) - len(latent)]
        for start in range(0, len(rows), BLOCK_ROWS):
            # one row of overlap: whitening needs the previous row of the last block
            part = slice(max(start - 1, 0), start + BLOCK_ROWS)
            mine = rows[part]
            B, samples = self.basis(field, mine), self.samples.part(mine)
            piece = replace(
                samples, reference=samples.reference + slow[mine] + B @ w, field=samples.field - offset[mine]
            )
            e, g = residuals(piece, c)
            size = residual_scale(piece, c)
            # a higher reference lowers the residual: -1/s
            steady = self.steady[mine] * (-self.unmapped[mine] / size)[:, None]
            # an offset acts as T does: columns 6 to 8 of the derivative by the nine slots
            offsets = [g[:, 6 + k, None] * one.functions[mine] for one in self.offsets for k in range(3)]
            slopes = -self.slopes[mine] / size[:, None]
            D = np.hstack([jacobian(piece.phi, g) @ E, steady, *offsets, slopes])
            here = csr_array(diags_array(-1.0 / size) @ B)
            yield LinearisedRows(
                np.column_stack([e - D @ z - here @ w, D]), here, follows[part], overlap=start > 0
            )

    def _intervals(self, rows: IndexArray) -> FloatArray:
        """Return the number of sampling intervals between successive `rows`, (m - 1,); 1e9 across runs."""
        # a run begins 1e9 intervals after the previous run, so that their noise is independent
        steps = np.where(np.isfinite(self.samples.steps), self.samples.steps, 1e9)
        steps[0] = 0.0
        return np.diff(np.cumsum(steps)[rows])
