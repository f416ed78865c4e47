"""The result of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import floor, isfinite, log10

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.model import Calibration
from magbridge.diagnose.causes import CAUSES, Cause
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.evidence import ODDS, Hypothesis, Isolability
from magbridge.diagnose.joint import Improvement, Joint
from magbridge.diagnose.leftover import Leftover, far_from_white
from magbridge.diagnose.observed import Seen, memory, seen
from magbridge.diagnose.problem import Problem
from magbridge.diagnose.search import Outliers, SearchOutcome
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.estimation.residual import rms

MIN_RMS_REDUCTION = 0.01
"""Least fraction of the refitted calibration's RMS that the findings have to remove."""


def counted(problem: Problem, wrong: Outliers | None) -> BoolArray:
    """Return (n,) samples by which a gain is measured: new to the calibration, and not wrong."""
    # Where every sample was learned from, all of them count
    counts = ~problem.survey.learned
    if wrong is not None:
        counts[wrong.rows] = False
    return counts if counts.any() else ~counts


@dataclass(frozen=True, eq=False)
class Finding:
    """A cause that is named, with its part of the joint fit of all named causes."""

    hypothesis: Hypothesis
    """The cause tested against the model without it."""
    competing: tuple[CompetingHypothesis, ...]
    """The causes that could take its place, the likeliest first."""
    improvement: Improvement
    """Improvement by this cause in addition to the others."""
    coefficients: FloatArray
    """(k,) in units of their prior width."""
    covariance: FloatArray
    """(k, k)."""
    over_random_walk: float = np.inf
    """Log odds over a sensor whose offsets wander (:mod:`.run`); infinite for a cause that is not slow."""
    further: tuple[Candidate, ...] = ()
    """Further causes of the same family that the fit contains: alternatives, not findings of their own."""

    @property
    def candidate(self) -> Candidate:
        """Its effects and columns."""
        return self.hypothesis.candidate

    @property
    def possible(self) -> list[Candidate]:
        """The cause, and its competing hypotheses."""
        return [self.candidate, *(competitor.candidate for competitor in self.competing)]

    @property
    def signal_to_noise(self) -> float:
        """With the calibration refitted."""
        return self.hypothesis.signal_to_noise

    @property
    def may_be_noise(self) -> bool:
        """Return True if a random walk of the offsets explains the signal nearly as well."""
        return self.over_random_walk < ODDS

    def field(self, problem: Problem) -> FloatArray:
        """Return the effect on the total field (n,), nT; its columns are in the sensor's nanotesla."""
        columns = self.candidate.columns(slice(0, len(problem)))
        return np.asarray(columns @ self.coefficients / problem.reference_jacobian)

    def follows(self, problem: Problem, fit: Joint) -> Seen:
        """Return the series that it follows in the residual of all other causes: none if noise hides it."""
        field = self.field(problem)
        found = seen(problem, field + fit.residual / problem.reference_jacobian, field)
        return found._replace(size=rms(field))


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything that was found out."""

    problem: Problem
    outcome: SearchOutcome
    findings: tuple[Finding, ...]
    """The causes that are named."""
    wrong: Outliers | None
    """Isolated wrong samples."""
    unexplained: Leftover | None
    calibration: Calibration
    """Extended."""
    fit: Joint
    """At the extended calibration."""
    before: FloatArray
    """Corrected field less reference (n,), nT, with the calibration as given."""
    after: FloatArray
    """The same, held out, with the extended one, the named errors of the reference subtracted."""
    total: Improvement
    """Improvement by all findings together, with the named errors of the reference subtracted."""
    improvement: Improvement
    """Improvement of the corrected field over the calibration as given, against the reference as given."""
    over_refit: Improvement
    """Improvement of the corrected field over a refit of the calibration alone."""
    other_day: Improvement | None
    """Improvement of the corrected field on whole days left out of the fit; None for a log of one day."""
    refused: str
    """Code of the reason why the extension was refused; empty where it stands."""
    refusal_values: tuple[float, float]
    """Allowed and found value behind a refusal, nT."""
    isolability: Isolability
    verdict: str
    """Verdict of ``findings.json``: ``explained`` only if held-out parts show a gain."""
    negligible: bool
    """True if the findings hardly improve on a refit of the calibration's own coefficients."""
    causes: Mapping[str, Cause] = field(default_factory=lambda: CAUSES)
    """The table of causes that were asked about."""

    @property
    def counts(self) -> BoolArray:
        """(n,) samples by which an improvement is measured."""
        return counted(self.problem, self.wrong)

    @cached_property
    def residual(self) -> FloatArray:
        """(n,) nT of the sensor, what the fit to the whole log leaves: noise of any kind."""
        return self.fit.residual + self.problem.slow_noise(self.fit.z)

    @property
    def named(self) -> list[Candidate]:
        """The causes of the findings, with all of each family."""
        return [candidate for one in self.findings for candidate in (one.candidate, *one.further)]

    @property
    def possible(self) -> list[Candidate]:
        """The causes of the findings, and their competing hypotheses."""
        return [candidate for one in self.findings for candidate in one.possible]


def small(problem: Problem, residual: FloatArray, rest: Leftover | None) -> bool:
    """Return True if the unnamed remainder is negligible, too, and the residual (n,), nT, is noise."""
    if rest is not None and (
        rest.size is None or rest.size**2 > 2.0 * MIN_RMS_REDUCTION * rms(residual) ** 2
    ):
        return False
    return not far_from_white(problem, memory(problem, residual / problem.reference_jacobian))


def verdict_of(
    named: Sequence[Hypothesis], wrong: Outliers | None, rest: Leftover | None, total: Improvement
) -> str:
    """Return the verdict of ``findings.json``; names without a held-out gain explain only in part."""
    if named or wrong:
        return "partly_explained" if rest or (named and not total.shown) else "explained"
    return "unexplained" if rest else "nothing_found"


def label(cause: str, channel: str | None) -> str:
    """Return a cause as people read it."""
    return cause.replace("_", " ") + (f" ({channel})" if channel else "")


def names_of(candidates: Sequence[Candidate], joint: str = ", ") -> str:
    """Return causes as a list in words."""
    return joint.join(label(candidate.cause, series_of(candidate)) for candidate in candidates)


def series_of(candidate: Candidate) -> str | None:
    """Return the telemetry that a candidate follows, as people read it; None where it follows none."""
    several = len({channel for effect in candidate.effects for channel in effect.channels()}) > 1
    return "several together" if candidate.channel is None and several else candidate.channel


def measured(value: float, sigma: float | None) -> str:
    """Write a number to the second digit of its sigma; without one (a count, a period), to four digits."""
    if not sigma or not isfinite(sigma):
        return f"{float(f'{value:.4g}'):g}"
    places = 1 - floor(log10(sigma))
    # an added 0 turns a value that was rounded to -0 into 0
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}".replace("-", "\N{MINUS SIGN}")
