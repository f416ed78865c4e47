r"""Lag, lever arm and heading error of a survey's scalar magnetometer, from the survey itself.

.. math:: s_i = f(x_i - \tau v_i + R(\psi_i) a) + h(\psi_i) + \sum_k c_k \cdot z_k + l_{line} + e_i

f is the crustal field, :math:`\tau` the lag of the reading after the position, v the velocity, a the
lever arm (forward, starboard) from the positions to the sensor, h the heading error with two harmonics, z_k
the telemetry channels or the uncertain combinations of a compensation, and l the level of the line.

Lag and forward lever arm shift the samples along the track. The likelihood of this shift has several maxima,
so a scan on a grid comes first. Gauss-Newton steps then refine all terms; the field's gradient gives the
derivative by the shift. At constant speed the samples determine only ``lever - v * lag``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.figure_of_merit import figure_of_merit, merit_text
from magbridge.calibration.fitting.field_search import (
    BENDS,
    SMOOTH,
    Choice,
    Weighed,
    about_the_middle,
    choose,
    climb,
    ladder,
    nodes_for,
    too_coarse,
)
from magbridge.calibration.fitting.scalar_fit import is_significant
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError
from magbridge.estimation.blocks import NO_COEFFICIENTS, ParameterBlock, with_blocks
from magbridge.estimation.elimination import eliminate_field
from magbridge.estimation.hyperparameters import maximise_evidence
from magbridge.estimation.information import covariance_of
from magbridge.estimation.residual import rms, robust_scale
from magbridge.survey.gridding import FINE_NOISE_NT, FINER_NODES, level_blocks
from magbridge.survey.read import COMPENSATION, ScalarRows
from magbridge.survey.samples import Roughness, Rows, Samples, crossovers

__all__ = ["ScalarTerms", "align"]

LAG_SIGMA_S, LEVER_SIGMA_M = 0.5, 2.0
"""Prior 1-sigma of the lag, s, and of each component of the lever arm, m."""
SCANNED_LAG_S, SCANNED_LEVER_M = 1.0, 5.0
"""Largest lag, s, and forward lever arm, m, of the scan."""
SCAN_STEP_LENGTHS, MIN_SCAN_STEPS, MAX_SCAN_STEPS = 1.0 / 8.0, 9, 41
"""Step of the scan in correlation lengths of the field, and fewest and most steps."""
HEADING_WIDTH_NT, LOG_HEADING_SPREAD = 2.0, float(np.log(5.0))
"""Prior 1-sigma of a harmonic of the heading error, nT, and the 1-sigma of its logarithm."""
CHANNEL_WIDTH_NT, LOG_CHANNEL_SPREAD = 10.0, 1.5
"""Prior 1-sigma of a channel's effect for one swing, nT, and the 1-sigma of its logarithm."""
FITTED_SAMPLES, FITTED_NODES = 8_000, 8_000
"""Largest numbers of samples and nodes of the joint fit."""
SCANNED_SAMPLES, SCANNED_NODES = 4_000, 3_000
"""Largest numbers of samples and nodes of the scan."""
MAX_SPACING_FRACTION = 1.0 / 240.0
"""Largest spacing of fitted samples, as a fraction of the survey's extent."""
GAUSS_NEWTON_STEPS, SEARCH_EFFORT, CLIMB_STEPS, CORRECTIONS = 4, 0.3, 14, 2
SEPARABLE_FRACTION = 0.5
"""Largest posterior over prior 1-sigma of lag and of lever arm with which the two count as separable."""
SPEED_QUANTILES = 0.05, 0.95
"""Quantiles of the speeds between which their spread is measured."""
IMPLAUSIBLE_SIGMAS = 3.0
"""Lag or lever arm, in multiples of its prior 1-sigma, beyond which it is implausible."""
MIN_SPREAD_FRACTION = 0.05
"""Smallest spread of the speeds, as a fraction of the median, that separates lag and lever arm. Their average
over seconds is too small by 0.7 % in a turn of 300 m at 60 m/s."""
SHIFT_NAMES = ("lag", "forward", "starboard")
HARMONICS = ("cos", "sin", "cos2", "sin2")
"""Names of the harmonics of the heading in the heading error."""


@dataclass(frozen=True, eq=False)
class ScalarTerms:
    """Terms of a scalar magnetometer that the joint fit has estimated, and their effects."""

    column: str
    shift: FloatArray
    """Lag (s), forward and starboard lever arm (m), (3,)."""
    shift_sigma: FloatArray
    """1-sigma (3,) of each component of `shift`."""
    along_m: float
    along_sigma_m: float
    """`along_m`, `along_sigma_m`: forward lever arm minus speed times lag, and its 1-sigma, m."""
    speed: float
    """Median speed, m/s."""
    separable: bool
    """True if the samples determine lag and forward lever arm separately."""
    heading_error: FloatArray
    """Amplitudes (4,), nT, of cos and sin of the heading, and of cos and sin of twice the heading."""
    contribution: dict[str, float]
    """Standard deviation of each term's effect over the survey, nT."""
    misties_raw: float
    """RMS mis-tie at the crossovers before correction, nT."""
    field: Choice
    """Crustal field and noise of the joint fit, for the map."""
    merit: dict[str, Any] | None
    """Figure of merit of a box flight, which was not fitted; None without a box flight."""
    findings: tuple[Diagnostic, ...] = ()
    """Statistically significant terms (:func:`.is_significant`): shift along the track, heading, channels."""

    def facts(self) -> dict[str, Any]:
        """Return the estimated terms as plain values, to print as JSON."""
        named = zip(SHIFT_NAMES, self.shift.tolist(), self.shift_sigma.tolist(), strict=True)
        shift = {
            f"{name}_{'s' if name == 'lag' else 'm'}": {"value": value, "sigma": sigma}
            for name, value, sigma in named
        }
        return {
            "column": self.column,
            **shift,
            "along_track_m": {"value": self.along_m, "sigma": self.along_sigma_m},
            "speed_m_s": self.speed,
            "lag_and_lever_separable": self.separable,
            "heading_error_nT": dict(zip(HARMONICS, self.heading_error.tolist(), strict=True)),
            "contribution_nT": self.contribution,
            "misties_as_read_nT": self.misties_raw,
            "figure_of_merit": self.merit and {**self.merit, "fitted": False},
            "findings": [finding.text for finding in self.findings],
        }

    def summary(self) -> str:
        """Return the estimated terms as text."""
        lag, forward, starboard = self.shift
        sigma = self.shift_sigma
        if self.separable:
            parts = [f"lag {lag:.3f} ± {sigma[0]:.3f} s, forward lever arm {forward:.2f} ± {sigma[1]:.2f} m"]
        else:
            known = f"lever - v * lag = {self.along_m:.2f} ± {self.along_sigma_m:.2f} m forward"
            parts = [f"{known} (lag and lever arm cannot be separated at one speed, {self.speed:.1f} m/s)"]
        parts.append(f"starboard {starboard:.2f} ± {sigma[2]:.2f} m")
        turn = np.radians(np.arange(0.0, 360.0, 5.0))
        parts.append(f"heading error {np.ptp(_harmonics(turn) @ self.heading_error):.2f} nT peak to peak")
        parts.append(f"crossings {self.misties_raw:.2f} nT RMS as read")
        if self.merit:
            parts.append(merit_text(self.merit))
        parts += [finding.text for finding in self.findings if finding.code == "scalar.channel"]
        return f"scalar {self.column}: " + ", ".join(parts)


def align(
    rows: ScalarRows, *, lag: float | None = None, lever_known: bool = False
) -> tuple[Samples, ScalarTerms]:
    """Fit lag, lever arm, heading error and channels together with the crustal field and the lines' levels.

    `lag`, s, is that of the reading after the position; it is estimated if not given. With `lever_known` the
    positions are the sensor's already. The returned samples are at the sensor's places, corrected for heading
    error and channels; the uncertainty of the corrections is in `modes`.

    CalibrationError: the samples do not determine a field.
    """
    free = np.array([lag is None, not lever_known, not lever_known])
    try:
        with threadpool_limits(1, "blas"):
            fit = _JointFit(rows, np.array([lag or 0.0, 0.0, 0.0]), free)
            return fit.result()
    except np.linalg.LinAlgError as problem:
        raise CalibrationError(
            f"{rows.column}: lag and heading error cannot be fitted to this survey: {problem}"
        ) from problem


class _Solution(NamedTuple):
    """Solution of the joint fit."""

    effects: FloatArray
    """Estimates (m,): heading error, coefficients of each term, last step of the k free shift components."""
    covariance: FloatArray
    """Covariance (m, m) of `effects`."""
    slopes: FloatArray
    """Change (n, k) of each fitted sample with each free component of the shift, nT/s and nT/m."""
    field: FloatArray
    """Coefficients (nodes,) of the crustal field."""


class _JointFit:
    """Joint fit on a part of the samples: a scan of the shift, then Gauss-Newton steps.

    `shift` (3,) is the initial lag (s) and lever arm (m), of which the components with `free` (3,) are
    estimated.
    """

    def __init__(self, rows: ScalarRows, shift: FloatArray, free: FloatArray) -> None:
        self.rows, self.shift, self.free = rows, shift, np.flatnonzero(free)
        self.prior_sigma = np.array([LAG_SIGMA_S, LEVER_SIGMA_M, LEVER_SIGMA_M])[self.free]
        self.speed = float(np.median(np.linalg.norm(rows.velocity, axis=1)))
        forward = np.stack([np.cos(rows.heading), np.sin(rows.heading)], axis=1)
        starboard = np.stack([-np.sin(rows.heading), np.cos(rows.heading)], axis=1)
        # Derivatives of the place by lag, forward and starboard lever arm.
        self.directions = np.stack([-rows.velocity, forward, starboard])
        self.chosen = _fitted_rows(rows.samples, FITTED_SAMPLES)
        self.lacking = np.zeros(len(rows.raw))
        few = _fitted_rows(rows.samples, SCANNED_SAMPLES)
        # The likelihood has several maxima along the shift: a field first, then a scan, then Gauss-Newton.
        choice = self._search(few)
        choice = self._scan(few, choice)
        nodes = nodes_for(
            rows.samples.place[self.chosen], choice.field.length, choice.field.alpha, FITTED_NODES
        )
        self.choice = replace(choice, field=replace(choice.field, nodes=nodes))
        self._gauss_newton()
        # The noise is smaller at the right shift: choose field and noise again, on finer nodes.
        choice = self.choice
        self.choice = self._refine_field(choice)
        if self.choice.rho:  # an error of the shift looks like correlated noise: reduce it with white noise
            self.choice = self._refine_field(choice, white=True)
            self._gauss_newton()
            self.choice = self._refine_field(choice)
        self.solution = self._gauss_newton()
        # The field of the vehicle's iron, which turns with the heading, passes for a large shift.
        size = np.abs(self.shift[self.free])
        self.implausible = bool((size > IMPLAUSIBLE_SIGMAS * self.prior_sigma).any())
        if self.implausible:
            covariance = self.solution.covariance
            scale = np.ones(len(covariance))
            last = slice(len(scale) - len(size), None)
            scale[last] = np.maximum(size / np.sqrt(np.diag(covariance)[last]), 1.0)
            self.solution = self.solution._replace(covariance=covariance * np.outer(scale, scale))

    def place(self, shift: FloatArray) -> FloatArray:
        """Return the sensor's places (n, 2), m, for a `shift` (3,): lag (s) and lever arm (m)."""
        return np.asarray(self.rows.samples.place + np.tensordot(shift, self.directions, 1))

    def _blocks(self, chosen: IndexArray) -> tuple[ParameterBlock, ...]:
        """Return the blocks of levels, slow changes, heading error and terms for the samples `chosen`."""
        blocks = list(level_blocks(self.rows.samples.part(chosen)))
        # Heading error: first and second harmonic of the heading, with one width for all four.
        harmonics = _harmonics(self.rows.heading[chosen])
        blocks.append(
            ParameterBlock("heading error", harmonics, np.ones(4), HEADING_WIDTH_NT, LOG_HEADING_SPREAD)
        )
        for name, columns in self.rows.terms:
            width, spread = (1.0, 0.0) if name == COMPENSATION else (CHANNEL_WIDTH_NT, LOG_CHANNEL_SPREAD)
            shape = np.ones(columns.shape[1])
            blocks.append(ParameterBlock(f"effect of {name}", columns[chosen], shape, width, spread))
        return tuple(replace(block, offered=False) for block in blocks)

    def _problem(self, chosen: IndexArray, shift: FloatArray, blocks: tuple[ParameterBlock, ...]) -> Rows:
        samples = replace(self.rows.samples, place=self.place(shift)).part(chosen)
        problem = Rows(samples, blocks, Roughness.uniform())
        problem.lacking = self.lacking[chosen]
        return problem

    def _weighed(self, blocks: tuple[ParameterBlock, ...], length: float) -> Weighed:
        family = with_blocks(NO_COEFFICIENTS, blocks)
        return Weighed(family, family.centre, FINE_NOISE_NT, length)

    def _search(self, chosen: IndexArray) -> Choice:
        """Return the likeliest field on coarse nodes for the samples `chosen`, at the initial shift."""
        blocks, every = self._blocks(chosen), np.arange(len(chosen))
        problem = self._problem(chosen, self.shift, blocks)
        place = problem.samples.place
        weighed = self._weighed(blocks, float(np.median(ladder(place))))
        # Start values: field size by the scatter of the samples, noise by the change from sample to sample.
        size = max(robust_scale(problem.samples.value - problem.mean), 5.0)
        change = max(robust_scale(np.diff(problem.samples.value)) / 2.0**0.5, FINE_NOISE_NT)
        return choose(
            lambda field: problem.sums(field, every), place, weighed, size / change,
            deeper=problem.deeper, effort=SEARCH_EFFORT, most=SCANNED_NODES,
        )  # fmt: skip

    def _scan(self, chosen: IndexArray, choice: Choice) -> Choice:
        """Set the shift along the track to the likeliest value on a grid; return the field for this shift."""
        if not len(self.free):
            return choice
        component = int(self.free[0])  # lag, else forward lever arm
        reach = SCANNED_LAG_S if component == 0 else SCANNED_LEVER_M
        metres = reach * (self.speed if component == 0 else 1.0)
        # A step is a fraction of the crustal length: the likelihood changes within it.
        steps = int(
            np.clip(2.0 * metres / (SCAN_STEP_LENGTHS * choice.field.length), MIN_SCAN_STEPS, MAX_SCAN_STEPS)
        )
        blocks, every = self._blocks(chosen), np.arange(len(chosen))
        weighed = self._weighed(blocks, choice.field.length)

        def score(value: float) -> float:
            shift = self.shift.copy()
            shift[component] = value
            sums = self._problem(chosen, shift, blocks).sums(choice.field, every)
            reduced = eliminate_field(sums, choice.field, choice.ratio, choice.rho)
            return weighed.score(reduced, choice.field, choice.ratio)

        # An odd number of steps contains zero.
        grid = np.linspace(-reach, reach, steps | 1)
        self.shift[component] = grid[int(np.argmax([score(value) for value in grid]))]
        sums = self._problem(chosen, self.shift, blocks).sums(choice.field, every)
        return climb(sums, choice, weighed, steps=CLIMB_STEPS)

    def _refine_field(self, choice: Choice, *, white: bool = False) -> Choice:
        """Return the field and noise on finer nodes, with `white` noise or the likelier noise."""
        blocks, every = self._blocks(self.chosen), np.arange(len(self.chosen))
        problem = self._problem(self.chosen, self.shift, blocks)
        field = choice.field
        if field.alpha > SMOOTH and not field.buried:  # finer nodes would be too many for its condition
            length = field.length * ((field.alpha - 1) / (SMOOTH - 1)) ** BENDS
            field = replace(field, alpha=SMOOTH, length=length)
        nodes = nodes_for(problem.samples.place, field.length, field.alpha, FITTED_NODES, FINER_NODES)
        # Finer nodes resolve parts of the field that counted as noise in the scan.
        field = replace(field, nodes=nodes)
        weighed, start = self._weighed(blocks, field.length), replace(choice, field=field)
        # White noise has the amplitude of the innovations; the correlated noise is larger.
        ratio = choice.ratio / np.sqrt(1.0 - choice.rho**2)
        # What the basis lacks of the field depends on the nodes.
        prior = weighed.sigma**2 * weighed.family.prior(weighed.eta).precision
        for _ in range(CORRECTIONS if field.harmonic else 0):
            reduced = eliminate_field(problem.sums(field, every), field, ratio, 0.0)
            z = np.asarray(np.linalg.solve(reduced.quadratic.precision + prior, reduced.quadratic.vector))
            problem.correct(field, reduced.field(z))
        self.lacking[self.chosen] = problem.lacking
        sums = problem.sums(field, every)
        best = climb(sums, replace(start, rho=0.0, ratio=ratio), weighed, move_rho=False, steps=CLIMB_STEPS)
        lengths = field.length, best.field.length
        was, now = (too_coarse(nodes, length, field.alpha, FINER_NODES) for length in lengths)
        if now and not was:
            ratio = best.ratio * np.sqrt(1.0 - choice.rho**2)
            return self._refine_field(replace(choice, field=best.field, ratio=ratio), white=white)
        if white or choice.rho == 0.0:
            return best
        return max(best, climb(sums, start, weighed, steps=CLIMB_STEPS), key=lambda found: found.score)

    def _gauss_newton(self) -> _Solution:
        """Refine the shift together with all other terms by Gauss-Newton steps; return the last solution."""
        blocks, every = self._blocks(self.chosen), np.arange(len(self.chosen))
        # Effects are the heading error and the terms, not line levels or slow changes.
        names = "heading error", "effect of "
        effects = sum(len(block.shape) for block in blocks if block.name.startswith(names))
        slopes: FloatArray | None = None
        for _ in range(GAUSS_NEWTON_STEPS + 1):
            # Linearise about the shift so far: y = levels + heading error + terms + field + slopes * step.
            joint = blocks
            if slopes is not None and len(self.free):
                joint = (*blocks, ParameterBlock("shift", slopes, self.prior_sigma, 1.0))
            problem = self._problem(self.chosen, self.shift, joint)
            family = with_blocks(NO_COEFFICIENTS, joint)
            sums = problem.sums(self.choice.field, every)
            reduced = eliminate_field(sums, self.choice.field, self.choice.ratio, self.choice.rho)
            sigma = self._weighed(joint, self.choice.field.length).sigma
            widths = maximise_evidence(reduced.quadratic, family, family.centre, sigma)
            prior = family.prior(widths.eta).precision
            # The prior mean of the shift is zero, so that of the step is minus the shift so far.
            mean = np.zeros(len(prior))
            moved = len(self.free) if slopes is not None else 0
            if moved:
                mean[-moved:] = -self.shift[self.free]
            precision = reduced.quadratic.precision / widths.sigma**2 + prior
            z = np.asarray(
                np.linalg.solve(precision, reduced.quadratic.vector / widths.sigma**2 + prior @ mean), float
            )
            # Back-substitution: the field given the dense unknowns.
            w = reduced.field(z)
            problem.correct(self.choice.field, w)
            self.lacking[self.chosen] = problem.lacking
            if moved:
                self.shift[self.free] += z[-moved:]
            # Levels and slow changes come first in z; the report needs the rest.
            used = slice(len(z) - effects - moved, None)
            solution = _Solution(
                z[used], covariance_of(precision)[used, used], self._slopes(self.chosen, w), w
            )
            slopes = solution.slopes
        return solution

    def _slopes(self, chosen: IndexArray, w: FloatArray) -> FloatArray:
        """Return the change (n, k) of the samples with each free component of the shift, nT/s and nT/m."""
        place, field = self.place(self.shift)[chosen], self.choice.field
        # Slope of the field north and east, times the change of place with each component of the shift.
        inside = field.nodes.covers(place)
        gradient = np.zeros((len(place), 2))
        gradient[inside] = np.stack([part @ w for part in field.slopes(place[inside])], axis=1)
        return np.asarray(np.einsum("knj,nj->nk", self.directions[self.free][:, chosen], gradient))

    def result(self) -> tuple[Samples, ScalarTerms]:
        """Return all samples, aligned and corrected, and the estimated terms."""
        rows, found = self.rows, self.solution
        every = np.arange(len(rows.raw))
        slopes = self._slopes(every, found.field)
        columns = [_harmonics(rows.heading), *(term.columns for term in rows.terms)]
        edges = np.cumsum([0, *(part.shape[1] for part in columns)])
        parts = [found.effects[a:b] for a, b in pairwise(edges)]
        effects = [part @ values for part, values in zip(columns, parts, strict=True)]
        # Uncertainty of the terms as modes of the samples: columns times a root of the covariance.
        modes = np.hstack([*columns, slopes]) @ _root(found.covariance)
        samples = replace(
            rows.samples,
            place=self.place(self.shift),
            value=rows.samples.value - np.sum(effects, axis=0),
            modes=modes,
        )
        names = ["heading error", *(term.name for term in rows.terms)]
        contribution = dict(rows.compensated)
        for name, effect in zip(names, effects, strict=True):
            contribution["correction of the compensation" if name == COMPENSATION else name] = float(
                np.std(effect)
            )
        contribution["lag and lever arm"] = float(np.std(slopes @ self.shift[self.free]))
        raw = crossovers(rows.samples).misties(rows.raw)
        return samples, self._terms(parts, contribution, rms(raw) if len(raw) else 0.0)

    def _terms(self, parts: list[FloatArray], contribution: dict[str, float], misties: float) -> ScalarTerms:
        """Return the estimated terms with their uncertainties and effects."""
        many = len(self.free)
        covariance = np.zeros((3, 3))
        if many:
            covariance[np.ix_(self.free, self.free)] = self.solution.covariance[-many:, -many:]
        sigma = np.sqrt(np.diag(covariance))
        # Combination that every survey determines: forward lever arm minus speed times lag.
        along = np.array([-self.speed, 1.0, 0.0])
        both = {0, 1} <= set(self.free.tolist())
        along_sigma = float(np.sqrt(along @ covariance @ along))
        known = sigma[:2] < SEPARABLE_FRACTION * np.array([LAG_SIGMA_S, LEVER_SIGMA_M])
        # Only different speeds separate the two; at one speed, errors of the model seem to do so.
        spread = float(np.ptp(np.quantile(np.linalg.norm(self.rows.velocity, axis=1), SPEED_QUANTILES)))
        differ = spread > MIN_SPREAD_FRACTION * self.speed
        known_by_speed = differ and along_sigma < SEPARABLE_FRACTION * LAG_SIGMA_S * spread
        separable = not both or bool(known.all() and known_by_speed)
        if not separable:
            # A lag with a lever arm that cancels it remains unknown: no change of the shift along the track.
            sigma = np.hypot(sigma, LAG_SIGMA_S * np.array([1.0, self.speed, 0.0]))
        merit = None
        if self.rows.boxes:
            box, heading, raw, value, terms = self.rows.boxes[0]
            columns = [_harmonics(heading), *(term.columns for term in terms)]
            after = value - sum(part @ values for part, values in zip(columns, parts, strict=True))
            merit = figure_of_merit(box, raw, after)
        step = int(np.median(np.diff(self.chosen)))  # the noise of successive samples is correlated more
        choice = replace(self.choice, rho=self.choice.rho ** (1.0 / step))
        return ScalarTerms(
            self.rows.column, self.shift, sigma, float(along @ self.shift), along_sigma, self.speed,
            separable, parts[0], contribution, misties, choice, merit, self._findings(parts, contribution),
        )  # fmt: skip

    def _findings(self, parts: list[FloatArray], contribution: dict[str, float]) -> tuple[Diagnostic, ...]:
        """Return the statistically significant terms: shift, heading error, channels."""
        names = ["heading error", *(term.name for term in self.rows.terms)]
        covariance, column = self.solution.covariance, self.rows.column
        tests, found = len(names) + 2, []
        if self.implausible:
            values = dict(zip(("lag_s", "forward_m", "starboard_m"), self.shift.tolist(), strict=True))
            found.append(Diagnostic("scalar.implausible_shift", {"column": column, **values}))
        if len(self.free):
            # At one speed only the shift along the track is known: forward lever arm minus speed times lag.
            along = np.array([-self.speed, 1.0, 0.0])[self.free]
            metres = np.array([along @ self.shift[self.free]])
            many = len(self.free)
            variance = np.array([[along @ covariance[-many:, -many:] @ along]])
            if is_significant(metres, variance, tests):
                values = {
                    "column": column,
                    "shift_m": float(metres[0]),
                    "sigma_m": float(variance[0, 0] ** 0.5),
                }
                found.append(Diagnostic("scalar.shift", values))
        edges = np.cumsum([0, *(len(part) for part in parts)])
        for name, part, first, last in zip(names, parts, edges[:-1], edges[1:], strict=True):
            # Each harmonic of the heading is a test of its own: one of 4 degrees of freedom would be weaker.
            is_heading = name == "heading error"
            ends = [first, first + 2, last] if is_heading else [first, last]
            named = any(
                is_significant(part[a - first : b - first], covariance[a:b, a:b], tests)
                for a, b in pairwise(ends)
            )
            if name != COMPENSATION and named:
                code = "scalar.heading_error" if is_heading else "scalar.channel"
                values = {"column": column, "channel": name, "effect_nT": contribution[name]}
                found.append(Diagnostic(code, values))
        return tuple(found)


def _harmonics(heading: FloatArray) -> FloatArray:
    """Return cosine and sine of the heading (n,), rad, and of twice the heading, as columns (n, 4)."""
    return np.stack([np.cos(heading), np.sin(heading), np.cos(2 * heading), np.sin(2 * heading)], axis=1)


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix root R (r, r) of a covariance (r, r), which is ``R R^T``."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _fitted_rows(samples: Samples, most: int) -> IndexArray:
    """Return indices of about `most` samples: thin dense samples evenly, then keep those about the middle."""
    place = samples.place
    spacing = float(np.median(np.linalg.norm(np.diff(place, axis=0), axis=1)))
    extent = float(np.hypot(*np.ptp(place, axis=0)))
    longest = max(1, int(MAX_SPACING_FRACTION * extent / max(spacing, 1e-6)))
    # Thin evenly as far as the field allows, then cut to the middle of the survey.
    rows = np.arange(0, len(place), int(np.clip(len(place) // most, 1, longest)))
    return rows[about_the_middle(place[rows], most)]
