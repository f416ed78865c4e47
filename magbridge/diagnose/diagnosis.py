"""The result of a diagnosis: its findings, the extended calibration, and their improvement."""

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
from magbridge.diagnostics import Diagnostic
from magbridge.estimation.residual import rms

MIN_RMS_REDUCTION = 0.01
"""Least fraction of the refitted calibration's RMS that findings must remove, or they are negligible."""


def counted(problem: Problem, wrong: Outliers | None) -> BoolArray:
    """Return the samples (n,) that count: outside the calibration's logs, and no outliers."""
    # Where every sample was learned from, all of them count
    counts = ~problem.survey.learned
    if wrong is not None:
        counts[wrong.rows] = False
    return counts if counts.any() else ~counts


@dataclass(frozen=True, eq=False)
class Finding:
    """A named cause, with its coefficients in the joint fit of all named causes."""

    hypothesis: Hypothesis
    """The cause with its test against the model without it."""
    competing: tuple[CompetingHypothesis, ...]
    """Causes that the data do not exclude in its place, the likeliest first."""
    improvement: Improvement
    """Held-out improvement by this cause in addition to the other named causes."""
    coefficients: FloatArray
    """(k,) coefficients, in units of their prior width."""
    covariance: FloatArray
    """(k, k) covariance of the coefficients, in the same units."""
    over_random_walk: float = np.inf
    """Log odds over random-walk offsets (:mod:`.run`); infinite for a cause that is not slow."""
    further: tuple[Candidate, ...] = ()
    """Further causes of the same family in the fit: competing hypotheses, not findings of their own."""

    @property
    def candidate(self) -> Candidate:
        """The candidate of the cause, with its effects and columns."""
        return self.hypothesis.candidate

    @property
    def possible(self) -> list[Candidate]:
        """Candidates of the cause and of its competing hypotheses."""
        return [self.candidate, *(competitor.candidate for competitor in self.competing)]

    @property
    def signal_to_noise(self) -> float:
        """Signal-to-noise ratio of the effect, with the calibration refitted."""
        return self.hypothesis.signal_to_noise

    @property
    def may_be_noise(self) -> bool:
        """Return True if a random walk of the offsets explains the signal within odds of 20:1."""
        return self.over_random_walk < ODDS

    def field(self, problem: Problem) -> FloatArray:
        """Return the effect of the cause on the total field (n,), nT."""
        columns = self.candidate.columns(slice(0, len(problem)))
        return np.asarray(columns @ self.coefficients / problem.reference_jacobian)

    def follows(self, problem: Problem, fit: Joint) -> Seen:
        """Return the series that the residual of all other causes follows; None if noise hides it."""
        field = self.field(problem)
        found = seen(problem, field + fit.residual / problem.reference_jacobian, field)
        return found._replace(size=rms(field))


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of a diagnosis, from which the assessment and the report are made."""

    problem: Problem
    outcome: SearchOutcome
    findings: tuple[Finding, ...]
    """The named causes."""
    wrong: Outliers | None
    """Isolated outliers; None if there are none."""
    unexplained: Leftover | None
    calibration: Calibration
    """Calibration to write: the extended one, or the given one without an extension or if it is refused."""
    fit: Joint
    """Joint fit at the extended calibration; without named causes, the fit without any cause."""
    before: FloatArray
    """Corrected field less reference (n,), nT, with the calibration as given."""
    after: FloatArray
    """Held-out error (n,), nT, of the extended calibration, less the named errors of the reference."""
    total: Improvement
    """Improvement by all findings together, from `before` to `after`."""
    improvement: Improvement
    """Improvement of the corrected field over the calibration as given; reference unchanged."""
    over_refit: Improvement
    """Improvement of the corrected field over a refit of the given calibration without new effects."""
    other_day: Improvement | None
    """Improvement of the corrected field on held-out whole days; None for one day or no extension."""
    refused: str
    """Code of the reason why the extension was refused; empty if it was not."""
    refusal_values: tuple[float, float]
    """Allowed and actual value of the check that refused the extension, nT."""
    isolability: Isolability
    verdict: str
    """Verdict of ``findings.json``, by :func:`verdict_of`."""
    negligible: bool
    """True if the findings hardly improve on a refit of the calibration's own coefficients."""
    causes: Mapping[str, Cause] = field(default_factory=lambda: CAUSES)
    """The tested causes, by name."""
    scalars: tuple[Diagnostic, ...] = ()
    """Findings for the calibration's scalar sensors (:mod:`.scalar`)."""

    @property
    def counts(self) -> BoolArray:
        """(n,) samples that count for an improvement (:func:`counted`)."""
        return counted(self.problem, self.wrong)

    @cached_property
    def residual(self) -> FloatArray:
        """(n,) residual of the fit to the whole log, slow noise included, in the sensor's nT."""
        return self.fit.residual + self.problem.slow_noise(self.fit.z)

    @property
    def named(self) -> list[Candidate]:
        """Candidates of all named causes, including further causes of a family."""
        return [candidate for one in self.findings for candidate in (one.candidate, *one.further)]

    @property
    def possible(self) -> list[Candidate]:
        """Candidates of the findings and of their competing hypotheses."""
        return [candidate for one in self.findings for candidate in one.possible]


def small(problem: Problem, residual: FloatArray, rest: Leftover | None) -> bool:
    """Return True if the unnamed remainder `rest` is negligible and the residual (n,), nT, is noise."""
    if rest is not None and (
        rest.size is None or rest.size**2 > 2.0 * MIN_RMS_REDUCTION * rms(residual) ** 2
    ):
        return False
    return not far_from_white(problem, memory(problem, residual / problem.reference_jacobian))


def verdict_of(
    named: Sequence[Hypothesis], wrong: Outliers | None, rest: Leftover | None, total: Improvement
) -> str:
    """Return the verdict of ``findings.json``; causes without held-out improvement explain only in part."""
    if named or wrong:
        return "partly_explained" if rest or (named and not total.shown) else "explained"
    return "unexplained" if rest else "nothing_found"


def label(cause: str, channel: str | None) -> str:
    """Return the name of a cause for people, with its channel in brackets."""
    return cause.replace("_", " ") + (f" ({channel})" if channel else "")


def names_of(candidates: Sequence[Candidate], joint: str = ", ") -> str:
    """Return the names of candidates' causes as a list, joined by `joint`."""
    return joint.join(label(candidate.cause, series_of(candidate)) for candidate in candidates)


def series_of(candidate: Candidate) -> str | None:
    """Return the name, for people, of the telemetry that a candidate follows; None if it follows none."""
    several = len({channel for effect in candidate.effects for channel in effect.channels()}) > 1
    return "several together" if candidate.channel is None and several else candidate.channel


def measured(value: float, sigma: float | None) -> str:
    """Write a number to the second digit of its sigma; without one (a count, a period), to four digits."""
    if not sigma or not isfinite(sigma):
        return f"{float(f'{value:.4g}'):g}"
    places = 1 - floor(log10(sigma))
    # an added 0 turns a value that was rounded to -0 into 0
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}".replace("-", "\N{MINUS SIGN}")
