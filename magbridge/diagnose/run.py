"""The whole of a diagnosis: compare, search, weigh names against descriptions, extend, measure the gain."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.instrument_effects import TimeEffect
from magbridge.calibration.model import Calibration
from magbridge.diagnose.accept import odds_over_random_walk, settle
from magbridge.diagnose.causes import Cause, known
from magbridge.diagnose.causes.candidates import Candidate, since, slices
from magbridge.diagnose.causes.time_dependent import interference_tone
from magbridge.diagnose.compare.load_survey import load_survey
from magbridge.diagnose.compare.problem import Problem, pose
from magbridge.diagnose.compare.survey import Survey
from magbridge.diagnose.diagnosis import WORTH, Diagnosis, Finding, counted, small, verdict_of
from magbridge.diagnose.extend import extend, flyable, relinearised, with_map_error, with_misfit
from magbridge.diagnose.inference.competing import CompetingHypothesis
from magbridge.diagnose.inference.evidence import ODDS, REMNANT
from magbridge.diagnose.inference.hypothesis import Hypothesis
from magbridge.diagnose.inference.isolability import isolability
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.left_out import held_out, paired
from magbridge.diagnose.inference.nonlinear_uncertainty import loosened
from magbridge.diagnose.inference.outliers import Outliers, outliers
from magbridge.diagnose.inference.search import Outcome
from magbridge.diagnose.seen import memory
from magbridge.diagnose.unexplained.leftover import leftover
from magbridge.diagnose.unexplained.unlisted import switching, unlisted
from magbridge.errors import DataError
from magbridge.field.grid import AnomalyGrid

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["diagnose"]

ABSURD = 0.5
"""Fraction of the field; when the corrected field is off by more, no diagnosis is attempted."""
SLOW = 0.5
"""Share of a cause's power that is left in means over 64 samples, from which on it is slow."""


def diagnose(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    out_dir: str | os.PathLike[str] | None = None,
    *,
    training_logs: Sequence[xr.Dataset] = (),
    grid: AnomalyGrid | None = None,
    causes: Mapping[str, Cause] | None = None,
    progress: Callable[[str], object] = str,
    remarks: Sequence[str] = (),
) -> Diagnosis:
    """Find what the forward model gets wrong in these deployments.

    Parameters
    ----------
    datasets : sequence of Dataset
        Deployments that the calibration has not seen.
    calibration : Calibration
        What the forward model knows.
    out_dir : path, optional
        Where ``findings.json``, ``calibration.json`` and ``report.html`` go; nothing is written if not given.
    training_logs : sequence of Dataset, optional
        The logs that the calibration was made from: what changed since then is seen against them. One that
        is diagnosed itself may be among them, lest what the calibration knows from it counts twice.
    grid : AnomalyGrid, optional
        Added to the main field where a log has no ``reference_field``.
    causes : mapping, optional
        The table of causes; by default :func:`.causes.known`, with those of other packages.
    progress : callable, optional
        Told each step's name.
    remarks : sequence of str, optional
        What the report's reader must know of the logs.

    Raises
    ------
    DataError
        The data do not allow it: one line that says which column is missing or too short.
    """
    causes = known() if causes is None else causes
    # one thread: for matrices this narrow more only wait, and sums keep one order on any machine
    with threadpool_limits(1, "blas"):
        diagnosis = _examine(datasets, calibration, training_logs, grid, causes, progress)
    if out_dir is not None:
        # matplotlib only where a report is wanted
        from magbridge.diagnose.report.page import write  # noqa: PLC0415

        progress("writing the report")
        write(diagnosis, out_dir, causes, remarks)
    return diagnosis


def _examine(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    training_logs: Sequence[xr.Dataset],
    grid: AnomalyGrid | None,
    causes: Mapping[str, Cause],
    progress: Callable[[str], object],
) -> Diagnosis:
    progress("reading")
    problem = _posed(load_survey(datasets, calibration, training_logs, grid), calibration)
    progress("preparing causes")
    candidates, untestable = _put_forward(problem, causes)
    progress("searching")
    tone = _strongest_tone(problem, candidates)
    outcome, stand, rest = settle(problem, candidates, len(causes), tone)
    problem = outcome.problem
    found = outcome.chosen, outcome.competing, outcome.fit
    named, competing, fit = found if stand else ((), (), outcome.null)
    off = _off(outcome, named, len(causes))
    if switched := switching(problem, outcome.fit, named, off, ended=outcome.switches):
        rest, named, competing, fit = switched, (), (), outcome.null
    model = [h.candidate for h in named]
    wrong = off if off is not None and off.isolated else None
    progress("extending the calibration")
    settled, columns, fit = relinearised(problem, model, fit)
    fit = with_misfit(model, loosened(settled, model, columns, fit, candidates))
    extended = calibration
    if model:
        extended = with_map_error(settled, model, fit, flyable(problem.survey, extend(settled, model, fit)))
    progress("measuring the gain")
    counts = counted(problem, wrong)
    before = after = problem.straight(outcome.null.z)
    alone = held_out(problem, [], outcome.null)
    if model:
        after, score = held_out(settled, columns, fit)
        settled.let_go()
        if score < alone.score - ODDS:
            # the dives left out speak 20:1 against these names
            named, competing, model, fit, after, extended = (), (), [], outcome.null, before, calibration
            rest = leftover(problem, [], outcome.null, tone)
    rest = rest or unlisted(problem, fit, named, off, after, counts)
    total, beyond = (paired(since, after, problem.survey.dive, counts) for since in (before, alone.residual))
    negligible = bool(named) and wrong is None and beyond.ratio > 1.0 - WORTH
    return Diagnosis(
        problem=problem, outcome=outcome,
        findings=_findings(problem, named, competing, fit, after, counts, outcome),
        wrong=wrong, unexplained=rest and rest._replace(fitted=()), calibration=extended, fit=fit,
        before=before, after=after, total=total,
        isolability=isolability(candidates, outcome.info, outcome.look_elsewhere, len(causes), untestable),
        beyond=beyond, verdict=verdict_of(named, wrong, rest, total), causes=causes,
        negligible=negligible and small(problem, alone.residual, rest),
    )  # fmt: skip


def _posed(survey: Survey, calibration: Calibration) -> Problem:
    """Pose the problem; refuse another vehicle's data, or data in another unit."""
    problem = pose(survey, calibration)
    off, field = float(np.median(np.abs(problem.residual))), float(np.median(survey.reference))
    if off > ABSURD * field:
        raise DataError(
            f"{survey.source}: the corrected field is off by {off:.0f} nT of {field:.0f}: mag_x, mag_y, "
            "mag_z or a parameter in other units than the calibration's, or of another vehicle"
        )
    return problem


def _put_forward(problem: Problem, causes: Mapping[str, Cause]) -> tuple[list[Candidate], dict[str, str]]:
    """Return all candidates, and what it would take to test the causes that have none."""
    candidates = {name: cause.candidates(problem) for name, cause in causes.items()}
    untestable = {name: causes[name].needs for name, made in candidates.items() if not made}
    if len(untestable) == len(causes):
        needs = "; ".join(sorted(set(untestable.values())))
        raise DataError(f"{problem.survey.source}: nothing can be tested here; it would take {needs}")
    every = [candidate for made in candidates.values() for candidate in made]
    return _whenever(every, problem.survey.learned), untestable


def _whenever(candidates: Sequence[Candidate], learned: BoolArray) -> list[Candidate]:
    """Return the candidates and, given the calibration's own logs, of each a variant absent from those logs.

    Steps, drifts and tones have no variant, since they have a time of their own; nor have errors of the
    reference.
    """
    if not learned.any():
        return list(candidates)
    lasting = [c for c in candidates if c.effects and not any(isinstance(e, TimeEffect) for e in c.effects)]
    return [*candidates, *(since(candidate, learned) for candidate in lasting)]


def _strongest_tone(problem: Problem, candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the strongest tone, to describe what is left, where tones are not among the candidates."""
    known = any(isinstance(e, TimeEffect) and e.shape == "tone" for c in candidates for e in c.effects)
    return None if known else next(iter(interference_tone(problem)), None)


def _off(outcome: Outcome, named: Sequence[Hypothesis], causes: int) -> Outliers | None:
    """Return the wrong samples, unless they may be a remnant of the strongest cause and nothing switches."""
    off = outliers(outcome.fit, causes)
    strongest = max((h.signal_to_noise for h in named), default=0.0)
    own = outcome.switches or (off is not None and off.ratio >= (REMNANT * strongest) ** 2)
    return off if own else None


def _findings(
    problem: Problem,
    named: Sequence[Hypothesis],
    competing: Sequence[tuple[CompetingHypothesis, ...]],
    fit: Joint,
    after: FloatArray,
    counts: BoolArray,
    outcome: Outcome,
) -> tuple[Finding, ...]:
    """Collect each cause's results; its gain is that over a fit of the others without it."""
    found, q = [], len(fit.z)
    places = slices([h.candidate for h in named])
    for k, (own, hypothesis, others) in enumerate(zip(places, named, competing, strict=True)):
        columns = [h.candidate.columns for i, h in enumerate(named) if i != k]
        kept = np.delete(fit.prior, slice(q + own.start, q + own.stop))
        alone = replace(fit, coefficients=np.delete(fit.coefficients, own), prior=kept)
        without = held_out(problem, columns, alone).residual
        improvement = paired(without, after, problem.survey.dive, counts)
        covariance = fit.effects_covariance[own, own]
        odds = odds_over_random_walk(outcome, hypothesis) if _is_slow(problem, hypothesis) else np.inf
        found.append(Finding(hypothesis, others, improvement, fit.coefficients[own], covariance, odds))
    return tuple(found)


def _is_slow(problem: Problem, one: Hypothesis) -> bool:
    """Say whether a cause is slow: most of its power is left in means over many samples."""
    added = one.candidate.columns(slice(0, len(problem))) @ one.fit.coefficients[-one.candidate.size :]
    return memory(problem, added).slow >= SLOW
