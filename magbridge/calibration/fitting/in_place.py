r"""The fit to a survey: coefficients and the rock below the track, jointly.

Where nobody knows the true field, the reference is the main field, and what it lacks at a place,

.. math:: H_e(x, t) = |\mathrm{IGRF}| + b + f(x) + s(t),

has a level b, a Gaussian field f in place (:mod:`magbridge.field.place`) and a slow part s in time. A
criss-cross meets the same rock with another heading, roll and position of the masses, so f and the
coefficients can be told apart. The errors stand in the readings, as in every fit here
(:mod:`magbridge.calibration.residual`): without the weight of :math:`|A^T u|` a joint fit would shrink A to
have less rock to explain.

Notes
-----
Rounds of Gauss-Newton about the last answer; in each the sparse field is eliminated (:mod:`.joint`), the
prior's widths are chosen by the evidence of what remains (:mod:`.evidence`), and the field's size and length
and the noise's autocorrelation by that of the whole (:mod:`.field_search`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.crossings import left_open
from magbridge.calibration.fitting.evidence import Widths, maximise
from magbridge.calibration.fitting.field_doubt import plausible
from magbridge.calibration.fitting.field_nodes import about_the_middle, ladder, nodes_for
from magbridge.calibration.fitting.field_search import (
    Choice,
    Weighed,
    choose,
    first_guess,
    refined,
    same_noise,
)
from magbridge.calibration.fitting.fit import Fit, assemble
from magbridge.calibration.fitting.joint import Reduced, Sums, add_up, eliminate
from magbridge.calibration.fitting.known import Known
from magbridge.calibration.fitting.latent import Group, likeliest, slow_functions, with_groups
from magbridge.calibration.fitting.level import with_level
from magbridge.calibration.fitting.noise import NoiseModel
from magbridge.calibration.fitting.nominal import check_scales, starts
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.offset_terms import (
    Creep,
    offered,
    with_creep,
    with_temperature,
)
from magbridge.calibration.fitting.pose import Vehicle, pose
from magbridge.calibration.fitting.prior import Prior, PriorFamily
from magbridge.calibration.fitting.solve import covariance_of, gauss_newton
from magbridge.calibration.fitting.survey_samples import Drift, SurveySamples
from magbridge.calibration.residual import Samples, residuals_of, rms, robust_scale
from magbridge.errors import CalibrationError
from magbridge.field.place.matern import Matern

__all__ = ["fit_in_place"]

SLOW, SLOW_SPREAD = 2.0, np.log(10.0)
"""nT over a stretch, and the 1-sigma of its logarithm: a quiet day's currents aloft, a sensor's drift."""
GUESSED = 2
"""Rounds before the field is searched: while the coefficients are far off, they look like rock and noise."""
SEARCHES = 2
"""Rounds after that in which the search goes on."""
ROUNDS = 40
"""Rounds at most; six are usual, and some twenty from a start 10,000 nT off, whose steps are shortened."""
STILL = 0.05
"""Of the noise: a round that moves no residual by more (RMS) is the last."""
OUTLIER = 5.0
"""Sigmas beyond which a sample is left out."""
DRIFTING = 2700.0
"""s, half the period of the fastest drift of a position."""
OVERSHOT = 10.0
"""Growth of the objective by which a step goes too far; less may be the track that is bent only after it."""
SHORTEST = 1e-3
"""Part of a step, below which it is not shortened further."""
SEARCHED, WIDE = 12_000, 5_000.0
"""Samples about the middle that the field's size and length are searched with; where there are more within so
many m north and east, every second or third of these."""
MOST = 40_000
"""Nodes about all samples, at most."""


def fit_in_place(
    data: Observations,
    order: int = 3,
    *,
    level: float,
    vehicle: Vehicle | None = None,
    position_sigma: float = 0.0,
    known: Known | None = None,
) -> Fit:
    """Fit coefficients, level, slow changes, what the offset follows, and the field in place.

    Parameters
    ----------
    data : Observations
        With places, none of them far from all others.
    order : int
        Highest total degree of the polynomials in the masses' positions.
    level : float
        nT, 1-sigma of the reference's error that is the same everywhere.
    vehicle, known : optional
        As for :func:`~.auto.fit_auto`.
    position_sigma : float
        m, by which dead-reckoned positions slowly drift; the track is then bent to where the rock repeats.

    Raises
    ------
    CalibrationError
        There are no positions, or the fit collapsed or did not settle.
    """
    if data.place is None:
        raise CalibrationError(
            "method survey: expected latitude and longitude, and a field that is not known"
        )
    posed = pose(data, order, vehicle, known)
    samples, q = posed.samples, posed.family.E.shape[1]
    groups = (*_groups(data, level), *offered(data))
    survey = SurveySamples(data, samples, groups, _drift(data, position_sigma))
    rounds = _Rounds(survey, posed.family)
    try:
        found = rounds.settle()
    except np.linalg.LinAlgError as problem:
        raise CalibrationError("the fit to the survey has no answer: rock cannot be told apart") from problem
    prior, z = found.family.at(found.widths.eta), found.z
    coefficients = prior.coefficients(z)
    check_scales(samples, coefficients)
    covariance = rounds.covariance(found)
    creep = survey.offset(z[q:], [one for one in survey.offsets if one.lag is None])
    lifted = replace(
        samples, reference=samples.reference + found.lacking, field=samples.field - survey.offset(z[q:])
    )
    fit = assemble(
        data, lifted, posed.ranges, posed.exponents, coefficients, prior.E @ covariance @ prior.E.T,
        NoiseModel(found.widths.sigma, found.choice.rho), "survey",
        prior=Prior(prior.precision[:q, :q], prior.E[:, :q], prior.offset), details=_details(found, survey),
    )  # fmt: skip
    calibration = with_temperature(fit.calibration, data, survey.groups, (z, covariance, prior.E))
    if level:
        calibration = with_level(calibration, lifted, float(z[q]), level)
    fit = replace(fit, calibration=calibration, open=tuple(left_open(data, found.choice.field.length)))
    if not creep.any():
        return fit
    return replace(
        fit, calibration=with_creep(calibration, creep), creep=Creep(data.time, creep, calibration)
    )


def _groups(data: Observations, level: float) -> tuple[Group, ...]:
    """Return the unknowns beside coefficients and field: the level, and what changes slowly with time."""
    groups = [Group("level", np.ones((len(data), 1)), np.ones(1), max(level, 1e-3))]
    waves, shape = slow_functions(data.time)
    if len(shape):
        groups.append(Group("slow change with time", waves, shape, SLOW, SLOW_SPREAD, offered=True))
    return tuple(groups)


def _drift(data: Observations, sigma: float) -> Drift | None:
    """Return how far positions may drift with time: as a random walk of `sigma` m, north and east."""
    waves, shape = slow_functions(data.time, DRIFTING)
    return Drift(waves, shape, sigma) if sigma and len(shape) else None


def _details(found: _Answer, survey: SurveySamples) -> dict[str, Any]:
    part = about_the_middle(survey.place, SEARCHED, WIDE)
    choice, field, names = found.choice, found.choice.field, found.family.names
    latent = found.z[len(found.z) - sum(len(group.shape) for group in survey.groups) :]
    return {
        "log_evidence": found.score,
        "determined": found.widths.determined,
        "autocorrelation": choice.rho,
        "outliers": int((~survey.kept).sum()),
        "widths_nT": dict(zip(names, np.exp(found.widths.eta).tolist(), strict=True)),
        "offsets_nT": {one.name: rms(survey.offset(latent, [one])) for one in survey.offsets},
        "rock": {
            "size_nT": choice.ratio * found.widths.sigma,
            "length_m": field.length,
            "smoothness": field.alpha - 1,
            "shortest_m": float(ladder(survey.place[part])[0]),
            "falls_off_upwards": field.harmonic,
            "nodes": field.nodes.size,
        },
    }


@dataclass(frozen=True, eq=False)
class _Answer:
    """Where the rounds stand; `lacking` (n,) nT is what they add to the reference at every sample."""

    z: FloatArray
    w: FloatArray
    reduced: Reduced
    choice: Choice
    widths: Widths
    family: PriorFamily
    lacking: FloatArray
    score: float


class _Rounds:
    """Alternate coefficients, widths and the field until no residual moves."""

    def __init__(self, survey: SurveySamples, own: PriorFamily) -> None:
        self.survey, self.own, self.q = survey, own, own.E.shape[1]
        self.until = GUESSED + SEARCHES
        self.weigh_offers = self.until + 1 if any(one.offered for one in survey.groups) else -1
        self.family = with_groups(own, survey.groups)
        self.part = about_the_middle(survey.place, SEARCHED, WIDE)
        self.step = max(int(self.part.sum()) // SEARCHED, 1)
        self.harmonic = bool(np.ptp(survey.deeper) > 5.0)
        self.middle = float(np.median(ladder(survey.place[self.part])))
        self.choice = self._everywhere(first_guess(survey.place[self.part]))
        self.z, self.sigma = _start(survey, self.family)
        self.eta, self.w = self.family.centre, np.zeros(self.choice.field.nodes.size)
        self.nodes = self.choice.field.nodes

    def settle(self) -> _Answer:
        """Return the answer.

        Raises
        ------
        CalibrationError
            The rounds do not come to rest.
        """
        survey, last, moved = self.survey, None, np.inf
        for turn in range(ROUNDS):
            if self.own.renew is not None and turn:
                self.own = self.own.renew(self.z[: self.q])
                self.family = with_groups(self.own, survey.groups)
            if turn == self.weigh_offers:
                self._weigh_offers()
            answer = self._round(turn)
            e = self._residuals(answer.z, answer.lacking)
            if last is not None:
                moved = float(np.sqrt(np.mean((e - last) ** 2)))
            last = e
            if turn > self.until and moved < STILL * self.sigma:
                return answer
            if GUESSED <= turn <= self.until:
                survey.kept = np.abs(e) <= OUTLIER * robust_scale(e)
        if moved > self.sigma:
            raise CalibrationError("the fit to the survey did not settle: the data contradict themselves")
        return answer

    def _round(self, turn: int) -> _Answer:
        """Search the field where it is time to, and solve for all that is linear about the last answer."""
        weighed = Weighed(self.family, self.eta, self.sigma, self.middle)
        if searched := self.until - SEARCHES <= turn <= self.until:
            self._search(weighed, anew=turn == self.until - SEARCHES)
        sums = self._sums(self.choice.field)
        if searched and self.step > 1:
            self.choice = same_noise(sums, self.choice, weighed)
        choice, reduced = self.choice, eliminate(sums, self.choice.field, self.choice.ratio, self.choice.rho)
        widths = maximise(reduced.quadratic, self.family, self.eta, self.sigma)
        self.eta, self.sigma = widths.eta, widths.sigma
        precision = reduced.quadratic.H / self.sigma**2 + self.family.at(self.eta).precision
        step = np.linalg.solve(precision, reduced.quadratic.b / self.sigma**2) - self.z
        B = self.survey.basis(choice.field)
        self.z = self._damped(np.asarray(step, float), reduced, B)
        self.w, self.nodes = reduced.field(self.z), choice.field.nodes
        if self.survey.drift is not None:
            self.survey.bend(choice.field, self.w, self.z[self.q :])
            B = self.survey.basis(choice.field)
        lacking = self._slow(self.z) + B @ self.w
        score = widths.log_evidence + reduced.log_evidence
        return _Answer(self.z, self.w, reduced, choice, widths, self.family, lacking, score)

    def _search(self, weighed: Weighed, *, anew: bool) -> None:
        """Choose the field with a part of the samples, and put it on nodes about them all."""
        place, before = self.survey.place[self.part], self.choice
        if anew:
            found = choose(self._few, place, weighed, before.ratio, harmonic=self.harmonic)
        else:
            start = replace(before, rho=before.rho**self.step)
            if not self.part.all():
                field = before.field
                start = replace(
                    start, field=replace(field, nodes=nodes_for(place, field.length, field.alpha))
                )
            found = refined(self._few, place, start, weighed)
        self.choice = self._everywhere(replace(found, rho=found.rho ** (1.0 / self.step)))

    def _everywhere(self, choice: Choice) -> Choice:
        """Return a choice that was made with a part of the samples on nodes about them all."""
        if self.part.all():
            return choice
        field = choice.field
        nodes = nodes_for(self.survey.place, field.length, field.alpha, MOST)
        return replace(choice, field=replace(field, nodes=nodes))

    def _weigh_offers(self) -> None:
        """Keep of what is offered what the log needs; where that is not all, the search goes on without."""
        survey, choice = self.survey, self.choice
        reduced = eliminate(self._sums(choice.field), choice.field, choice.ratio, choice.rho)
        kept = likeliest(reduced.quadratic, self.own, survey.groups, self.eta, self.sigma)
        if len(kept) < len(survey.groups):
            self._regroup(kept)
            self.until += SEARCHES

    def _regroup(self, groups: tuple[Group, ...]) -> None:
        """Go on with other groups of unknowns; those that were there stay where they are."""
        at, width, row, column = {}, {}, self.q, len(self.own.centre)
        for one in self.survey.groups:
            at[one.name], width[one.name] = self.z[row : row + len(one.shape)], self.eta[column : column + 1]
            row, column = row + len(one.shape), column + bool(one.spread)
        z = [at.get(one.name, np.zeros(len(one.shape))) for one in groups]
        eta = [width.get(one.name, np.log([one.width])) for one in groups if one.spread]
        self.z = np.concatenate([self.z[: self.q], *z])
        self.eta = np.concatenate([self.eta[: len(self.own.centre)], *eta])
        self.survey.keep(groups)
        self.family = with_groups(self.own, groups)

    def covariance(self, answer: _Answer) -> FloatArray:
        """Return that of z (q, q), with what the data leave open of the field's size and length."""
        start, z = answer.choice, answer.z
        sums, s2 = self._sums(start.field), self.sigma**2
        precision = self.family.at(self.eta).precision
        weighed = Weighed(self.family, self.eta, self.sigma, self.middle)

        def reduced(one: Choice) -> Reduced:
            return eliminate(sums, one.field, one.ratio, one.rho)

        total = np.zeros_like(precision)
        for weight, one in plausible(lambda one: weighed.score(reduced(one), one.field, one.ratio), start):
            quadratic = reduced(one).quadratic
            P = covariance_of(quadratic.H / s2 + precision)
            moved = P @ quadratic.b / s2 - z
            total += weight * (P + np.outer(moved, moved))
        return total

    def _damped(self, step: FloatArray, reduced: Reduced, B: csr_array) -> FloatArray:
        """Return z after the step (q,), shortened while it overshoots, as it may far off."""
        precision = self.family.at(self.eta).precision

        def objective(z: FloatArray) -> float:
            e = self._residuals(z, self._lacking(z, reduced, B))[self.survey.kept]
            return float(e @ e) / self.sigma**2 + float(z @ precision @ z)

        before, part = objective(self.z), 1.0
        while part > SHORTEST and not objective(self.z + part * step) < OVERSHOT * before:
            part *= 0.5
        return self.z + part * step

    def _lacking(self, z: FloatArray, reduced: Reduced, B: csr_array) -> FloatArray:
        """Return what the reference lacks at every sample with z (q,) and the field that follows, nT.

        A track that bends from the last answer's to that of z meets the field's slopes on its way.
        """
        bent = self.q + self.survey.bent
        moved = self.survey.slopes @ (z[bent:] - self.z[bent:])
        return np.asarray(self._slow(z) + moved + B @ reduced.field(z))

    def _few(self, field: Matern) -> Sums:
        return self._sums(field, np.flatnonzero(self.survey.kept & self.part)[:: self.step], self.step)

    def _sums(self, field: Matern, rows: IndexArray | None = None, step: int = 1) -> Sums:
        """Return the sums of all samples, or of `rows`, every `step`-th one, about the last answer.

        Where the nodes are new they are about a field of 0.
        """
        w = self.w if field.nodes is self.nodes else np.zeros(field.nodes.size)
        self.survey.bend(field, w, self.z[self.q :])
        rows = np.flatnonzero(self.survey.kept) if rows is None else rows
        B = self.survey.basis(field, rows)
        lacking = self._slow(self.z)[rows] + B @ w
        return add_up(self.survey.linear(self.family, self.z, lacking, w, B, rows, step))

    def _slow(self, z: FloatArray) -> FloatArray:
        """Return level and slow changes at every sample with z (q,), nT."""
        steady = self.survey.steady
        return np.asarray(steady @ z[self.q : self.q + steady.shape[1]])

    def _residuals(self, z: FloatArray, lacking: FloatArray) -> FloatArray:
        samples = self.survey.samples
        known: Samples = replace(
            samples,
            reference=samples.reference + lacking,
            field=samples.field - self.survey.offset(z[self.q :]),
        )
        return residuals_of(known, self.family.E @ z + self.family.offset)


def _start(survey: SurveySamples, family: PriorFamily) -> tuple[FloatArray, float]:
    """Return z near the answer, the rock taken for noise; and the size of that."""
    samples, prior = survey.samples, family.at(family.centre)
    found: list[tuple[float, FloatArray]] = []
    for start in starts(samples):
        z = family.near(start)
        sigma = np.inf
        for _ in range(5):
            e = residuals_of(samples, prior.coefficients(z))
            sigma = max(robust_scale(e), 1.0)
            z = gauss_newton(samples, prior, NoiseModel(sigma), z, steps=8).z
        found.append((sigma, z))
    sigma, z = min(found, key=lambda one: one[0])
    return z, sigma
