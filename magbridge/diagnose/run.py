"""Entry point of a diagnosis: search for causes, decide on their names, extend, measure the improvement."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import BoolArray
from magbridge.calibration.effects import TimeEffect
from magbridge.calibration.file import encode_calibration
from magbridge.calibration.model import Calibration
from magbridge.datasets import expect, standard_log
from magbridge.diagnose.assessment import DiagnosisResult, assess
from magbridge.diagnose.causes import Cause, known
from magbridge.diagnose.columns import Candidate, Group, absent_before, slices
from magbridge.diagnose.diagnosis import MIN_RMS_REDUCTION, Diagnosis, Finding, counted, small, verdict_of
from magbridge.diagnose.evidence import (
    ODDS,
    REMNANT,
    Hypothesis,
    bayes_factor_threshold,
    isolability,
    log_odds,
    shaped_ratio,
)
from magbridge.diagnose.improvement import (
    Extension,
    attempt,
    check_written,
    corrected,
    extension_of,
    fit_without,
)
from magbridge.diagnose.joint import Improvement, Joint, fit_joint, held_out, paired
from magbridge.diagnose.leftover import (
    Leftover,
    amplitude_evidence,
    leftover,
    loud,
    not_isolated,
    slow_remainder,
    soft_iron_evidence,
    switching,
    varying,
)
from magbridge.diagnose.noise import autoregressive_order
from magbridge.diagnose.observed import memory
from magbridge.diagnose.problem import Problem, pose, with_slow_noise
from magbridge.diagnose.scalar import scalar_findings
from magbridge.diagnose.search import SearchOutcome, beside_slow_noise, outliers, search
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnose.survey import Survey, days_of, load_survey
from magbridge.errors import DataError, WrongUse
from magbridge.field.grid import AnomalyGrid

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["accept", "diagnose", "odds_over_random_walk", "settle"]

AGAINST = 2.0
"""Log odds against the named causes, of held-out dives or of a change of soft iron, above which the names are
rejected. Of 14 right names of S/N 8 one had 1.9 by held-out dives; of 13 none had more than 0.2 by iron."""
MAX_VARYING = 2.5
"""Log evidence of an amplitude that varies in time above which the names are rejected. Of 38 right names of
S/N 8 the largest had 2.3."""
ABSURD = 0.5
"""Largest median error of the corrected field, as a fraction of the field, for which a diagnosis is made."""
MIN_SLOW_FRACTION = 0.5
"""Least fraction of a slow cause's power that remains in means over up to 64 samples."""


def accept(problem: Problem, outcome: SearchOutcome) -> tuple[bool, Leftover | None]:
    """Return True if the causes found are named, and a description of the signal that remains, or None.

    If the causes are not named, the description is of the whole signal. Causes and descriptions have a
    penalty for their alternatives. The causes are named if, with a description of the remaining signal, they
    are likelier than every description of the whole signal, and predict held-out dives about as well. Their
    odds over no effect must be 20:1, their amplitude constant in the log, and an offset without telemetry
    likelier than the same change of soft iron.
    """
    model = outcome.model
    # Names: their likelihood ratio with all prices
    varied = [varying(problem, candidate, outcome.look_elsewhere) for candidate in model]
    uneven = [description for description in varied if description is not None]
    rest = residual = leftover(problem, model, outcome.fit, also=uneven)
    if not model:
        return False, rest
    ratio = 2.0 * (outcome.fit.log_likelihood - outcome.null.log_likelihood)
    shaped = shaped_ratio(ratio, model, outcome.fit)
    names = log_odds(ratio, model, outcome.look_elsewhere, shaped) - float(
        np.log(len(outcome.look_elsewhere))
    )
    if rest is not None:
        names += rest.evidence_of_choice
        if rest.signal_to_noise < REMNANT * _strongest(outcome).signal_to_noise:
            rest = None
    # The names' odds over no effect must be 20:1. A true cause has a constant amplitude, and a true offset
    # depends on attitude as an offset does: otherwise they are of another cause
    behind = max(
        ODDS - names,
        amplitude_evidence(problem, outcome.fit, outcome.chosen) - MAX_VARYING,
        soft_iron_evidence(problem, outcome.fit, outcome.chosen) - AGAINST,
    )
    # a description that contains the names' own regressors and nothing else is not an alternative
    alone = rest is None or _same(outcome.chosen, rest)
    but = model if alone else ()
    free = leftover(problem, [], outcome.null, but=but, also=uneven)
    if not alone:
        names -= ODDS
    if free is not None:
        # Free descriptions of the whole signal: by evidence, and by prediction of held-out dives
        ours = _foretold(problem, model, outcome.fit, residual)
        described = _foretold(problem, [], outcome.null, free)
        behind = max(behind, free.evidence_of_choice - names, described - ours - AGAINST)
    if behind <= 0.0:
        return True, rest
    return False, (free or _unnamed(outcome))._replace(within=_possible_names(outcome, behind))


def _strongest(outcome: SearchOutcome) -> Hypothesis:
    return max(outcome.chosen, key=lambda h: h.signal_to_noise)


def _unnamed(outcome: SearchOutcome) -> Leftover:
    """Return the signal of the strongest cause as a structure without a name."""
    found = _strongest(outcome)
    period, _ = found.candidate.point.shape.get("period", (None, ""))
    return Leftover(
        "broadband" if period is None else "tone", found.signal_to_noise, found.p_value, found.evidence,
        period, found.candidate.channel,
    )  # fmt: skip


def settle(
    problem: Problem, candidates: Sequence[Candidate], causes: int
) -> tuple[SearchOutcome, bool, Leftover | None]:
    """Search for causes, and return the selected outcome with the result of :func:`accept`.

    Slow noise absorbs part of the signal that descriptions represent. Therefore no search with slow noise is
    made if the causes found without it are not named, or if the signal switches.
    """

    def rival(problem: Problem, model: Sequence[Candidate], fit: Joint, further: Candidate) -> float | None:
        free = leftover(problem, model, fit, but=[further])
        return None if free is None else _foretold(problem, model, fit, free)

    plain = search(problem, candidates, causes, rival)
    asserted, rest = accept(problem, plain)
    if not asserted or plain.switches:
        return plain, asserted, rest
    outcome = beside_slow_noise(plain, candidates, causes, rival)
    return outcome, *((True, rest) if outcome is plain else accept(outcome.problem, outcome))


def _foretold(problem: Problem, model: Sequence[Candidate], fit: Joint, best: Leftover | None) -> float:
    """Return the held-out score of a model with the best of the descriptions in `best`, if any helps."""
    columns = [candidate.columns for candidate in model]
    scores = [held_out(problem, columns, fit, interleaved=True).score]
    for one in best.fitted if best else ():
        score = held_out(problem, [*columns, one.columns], one.fit, interleaved=True).score
        scores.append(score - float(np.log(one.look_elsewhere)))
    return max(scores)


def _same(chosen: Sequence[Hypothesis], rest: Leftover) -> bool:
    """Return True if the description `rest` contains the regressors of a stronger chosen cause."""
    description = rest.description
    if description is None or description.wider:
        return False
    return any(description.covers([h.candidate]) and h.signal_to_noise > rest.signal_to_noise for h in chosen)


def _possible_names(outcome: SearchOutcome, deficit: float) -> tuple[CompetingHypothesis, ...]:
    """Return the causes and competing hypotheses that a description better by `deficit` leaves possible."""
    found: dict[Group, CompetingHypothesis] = {}
    for hypothesis, competing in zip(outcome.chosen, outcome.competing, strict=True):
        limit = bayes_factor_threshold(hypothesis.ratio)
        for one in (CompetingHypothesis(hypothesis.candidate, 0.0), *competing):
            known = found.get(one.candidate.group)
            if one.behind + deficit < limit and (known is None or one.behind + deficit < known.behind):
                found[one.candidate.group] = replace(one, behind=one.behind + deficit)
    return tuple(sorted(found.values(), key=lambda one: one.behind))


def odds_over_random_walk(outcome: SearchOutcome, hypothesis: Hypothesis) -> float:
    """Return the log odds of a chosen cause over a random walk of the offsets in its place.

    Notes
    -----
    A random walk has a spectral density of 1/f^2: half waves of variance ``g / k^2`` in place of ``g / k`` in
    :mod:`.problem`. The two models are compared by their evidence, with Akaike's penalty for each
    autoregression.
    """
    slots, noise = outcome.problem.survey.slots, outcome.null.noise
    others = [one.candidate for one in outcome.chosen if one is not hypothesis]
    columns, spectra = [one.columns for one in others], [one.spectra for one in others]
    # The model without this cause, once with a random walk, once with its own noise
    walking = with_slow_noise(outcome.problem, 2)
    rough = fit_joint(walking, columns, 1, spectra=spectra, rounds=2)
    order = autoregressive_order(rough.residual, slots)
    walk = fit_joint(walking, columns, order, spectra=spectra, blocks=noise.uneven)
    without = fit_joint(outcome.problem, columns, noise.past.order, spectra=spectra, blocks=noise.uneven)
    # coefficients that the remainder does not need have each gained half a log-likelihood unit by chance
    price = 0.5 * (noise.past.order + autoregressive_order(outcome.fit.residual, slots))
    price += float(np.log(outcome.look_elsewhere[hypothesis.candidate.cause]))
    return hypothesis.evidence - price + without.log_likelihood - (walk.log_likelihood - order)


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
) -> DiagnosisResult:
    """Find the causes of a forward model's errors in deployments, and extend the calibration by them.

    Parameters
    ----------
    datasets : sequence of Dataset
        Deployments that the calibration has not seen.
    calibration : Calibration
        The forward model to test.
    out_dir : path, optional
        Folder for ``findings.json``, ``calibration.json`` and ``report.html``; without it nothing is written.
    training_logs : sequence of Dataset, optional
        Logs that the calibration was fitted to, which show what changed since. Include a diagnosed log that
        the calibration was fitted to, so that its information does not count twice.
    grid : AnomalyGrid, optional
        Anomaly map that is added to the main field if a log has no ``reference_field``.
    causes : mapping, optional
        Causes to test, by name; default :func:`.causes.known`, which includes causes of other packages.
    progress : callable, optional
        Function that is called with the name of each step.
    remarks : sequence of str, optional
        Sentences on the logs for the report.

    Raises
    ------
    WrongUse
        `datasets` is empty.
    DataError
        A column is missing or has too few values, values are out of range, or no cause can be tested.
    """
    if not datasets:
        raise WrongUse("deployments: expected at least one Dataset, got none")
    expect("calibration", calibration, Calibration, "magbridge.load(path)")
    datasets = [standard_log(dataset) for dataset in datasets]
    training_logs = [standard_log(dataset) for dataset in training_logs]
    causes = known() if causes is None else causes
    # one thread: for matrices this narrow more only wait, and sums keep one order on any machine
    with threadpool_limits(1, "blas"):
        diagnosis = _examine(datasets, calibration, training_logs, grid, causes, progress)
        diagnosis = replace(diagnosis, scalars=scalar_findings(datasets, calibration, grid))
    if out_dir is None:
        return assess(diagnosis)
    # matplotlib only where a report is wanted
    from magbridge.diagnose.report.page import write  # noqa: PLC0415

    progress("checking the written calibration")
    if diagnosis.calibration is not calibration:
        worse = check_written(encode_calibration(diagnosis.calibration), calibration, datasets, grid)
        if worse and not any(candidate.about != "vehicle" for candidate in diagnosis.named):
            diagnosis = _refused(diagnosis, worse)
    progress("writing the report")
    result = assess(diagnosis)
    write(result, out_dir, remarks)
    return result


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
    outcome, stand, rest = settle(problem, candidates, len(causes))
    # The search is over: for a month its arrays would fill hundreds of megabytes during the extension
    rest = rest and rest._replace(fitted=())
    for one in (problem, outcome.problem):
        one.let_go()
    problem = outcome.problem
    nothing = outcome.with_chosen((), outcome.null)
    names = outcome if stand else nothing
    # Wrong samples, unless they may be a remnant of the strongest cause and nothing switches
    off = outliers(outcome.fit, len(causes))
    strongest = max((h.signal_to_noise for h in names.chosen), default=0.0)
    if off is not None and not outcome.switches and off.ratio < (REMNANT * strongest) ** 2:
        off = None
    if switched := switching(problem, outcome.fit, names.chosen, off, ended=outcome.switches):
        rest, names = switched, nothing
    wrong = off if off is not None and off.isolated else None
    counts = counted(problem, wrong)
    progress("refitting the calibration alone")
    refit = extension_of(problem, [], outcome.null, counts)
    refit.problem.let_go()
    progress("extending the calibration")
    kept, extension, gains = _extended(problem, names, refit, counts, causes)
    if len(kept.chosen) < len(names.chosen):
        names = kept if kept.chosen else nothing
        rest = leftover(problem, names.model, names.fit)
    named, model = names.chosen, names.model
    progress("measuring the improvement")
    fit = extension.fit if model else outcome.null
    before = corrected(problem.survey, calibration).total - problem.survey.reference
    after = extension.error - extension.reference_error if model else before
    rest = rest or not_isolated(off) or slow_remainder(problem, fit, named)
    rest = rest or loud(problem, after * problem.reference_jacobian, counts)
    dive, stands = problem.survey.dive, bool(model) and not extension.refused
    total, beyond = (paired(since, after, dive, counts) for since in (before, refit.error))
    day = days_of(problem.survey.time, problem.survey.learned)
    other_day = None
    if stands and day is not None and extension.day_error is not None:
        other_day = paired(before, extension.day_error, day, counts)
    negligible = bool(named) and wrong is None and beyond.ratio > 1.0 - MIN_RMS_REDUCTION
    return Diagnosis(
        problem=problem, outcome=outcome,
        findings=_findings(problem, names, extension, gains, outcome, causes),
        wrong=wrong, unexplained=rest and rest._replace(fitted=()),
        calibration=extension.calibration if stands else calibration, fit=fit,
        refused=extension.refused if model else "",
        refusal_values=extension.details, other_day=other_day,
        before=before, after=after, total=total,
        improvement=paired(before, extension.error if stands else before, dive, counts),
        over_refit=paired(refit.error, extension.error if stands else before, dive, counts),
        isolability=isolability(candidates, outcome.info, outcome.look_elsewhere, len(causes), untestable),
        verdict=verdict_of(named, wrong, rest, total), causes=causes,
        negligible=negligible and small(problem, refit.error * problem.reference_jacobian, rest),
    )  # fmt: skip


def _refused(diagnosis: Diagnosis, values: tuple[float, float]) -> Diagnosis:
    """Return the diagnosis with a refused extension; `values` are RMS errors, nT, as given and written."""
    problem, counts = diagnosis.problem, diagnosis.counts
    unchanged = paired(diagnosis.before, diagnosis.before, problem.survey.dive, counts)
    return replace(
        diagnosis, calibration=problem.calibration, refused="written_file", refusal_values=values,
        improvement=unchanged, over_refit=diagnosis.over_refit._replace(after=unchanged.after),
        other_day=None,
    )  # fmt: skip


def _posed(survey: Survey, calibration: Calibration) -> Problem:
    """Return the linearised problem; DataError: the data are of another vehicle or in another unit."""
    problem = pose(survey, calibration)
    off, field = float(np.median(np.abs(problem.residual))), float(np.median(survey.reference))
    if off > ABSURD * field:
        raise DataError(
            f"{survey.source}: the corrected field is off by {off:.0f} nT of {field:.0f}: mag_x, mag_y, "
            "mag_z or a parameter in other units than the calibration's, or of another vehicle"
        )
    return problem


def _put_forward(problem: Problem, causes: Mapping[str, Cause]) -> tuple[list[Candidate], dict[str, str]]:
    """Return all candidates, and the needs of causes without any; DataError: no candidate at all."""
    candidates = {name: cause.candidates(problem) for name, cause in causes.items()}
    untestable = {name: causes[name].needs for name, made in candidates.items() if not made}
    if len(untestable) == len(causes):
        needs = "; ".join(sorted(set(untestable.values())))
        raise DataError(f"{problem.survey.source}: nothing can be tested here; it would take {needs}")
    every = [candidate for made in candidates.values() for candidate in made]
    if problem.survey.learned.any():
        # A variant that is absent from the calibration's own logs; an effect with its own time needs none
        lasting = [c for c in every if c.effects and not any(isinstance(e, TimeEffect) for e in c.effects)]
        every += [absent_before(candidate, problem.survey.learned) for candidate in lasting]
    return every, untestable


def _extended(
    problem: Problem,
    names: SearchOutcome,
    refit: Extension,
    counts: BoolArray,
    causes: Mapping[str, Cause],
) -> tuple[SearchOutcome, Extension, dict[int, Improvement]]:
    """Return the causes that held-out dives support, their extension, and each family's improvement."""
    while names.chosen:
        # Extend by all names, then measure each family against an extension by the others
        extension = extension_of(problem, names.model, names.fit, counts)
        extension.problem.let_go()
        if extension.score < refit.score - ODDS:  # the held-out dives contradict these names 20:1
            break
        groups = _families(names.chosen, causes)
        after, gains = extension.error - extension.reference_error, {}
        for group in groups:
            without = refit
            if len(group) < len(names.chosen):
                without = attempt(problem, *fit_without(problem, names.model, group, names.fit), counts)
                without.problem.let_go()
            error = without.error - without.reference_error
            gains[group[0]] = paired(error, after, problem.survey.dive, counts)
        # A further name that does not improve the held-out corrected field is a remnant without a name
        strongest = max(gains, key=lambda k: names.chosen[k].signal_to_noise)
        idle = [
            k for group in groups if group[0] != strongest and gains[group[0]].ratio >= 1.0 for k in group
        ]
        if not idle:
            return names, extension, gains
        _, fit = fit_without(problem, names.model, idle, names.fit)
        names = names.with_chosen([k for k in range(len(names.chosen)) if k not in idle], fit)
    return names.with_chosen((), names.fit), refit, {}


def _findings(
    problem: Problem,
    names: SearchOutcome,
    extension: Extension,
    gains: Mapping[int, Improvement],
    outcome: SearchOutcome,
    causes: Mapping[str, Cause],
) -> tuple[Finding, ...]:
    """Return a finding for each family of named causes, with the name of its strongest cause."""
    found, fit, places = [], extension.fit, slices(names.model)
    for first, *further in _families(names.chosen, causes):
        own, hypothesis = places[first], names.chosen[first]
        others = (*(CompetingHypothesis(names.model[k], 0.0) for k in further), *names.competing[first])
        odds = odds_over_random_walk(outcome, hypothesis) if _is_slow(problem, hypothesis) else np.inf
        found.append(
            Finding(
                hypothesis, others, gains[first], fit.coefficients[own], fit.effects_covariance[own, own],
                odds, tuple(names.model[k] for k in further),
            )
        )  # fmt: skip
    return tuple(found)


def _families(named: Sequence[Hypothesis], causes: Mapping[str, Cause]) -> list[list[int]]:
    """Return the indices of the named causes, grouped by family, the strongest of each family first."""
    groups: dict[str, list[int]] = {}
    for k in sorted(range(len(named)), key=lambda n: -named[n].signal_to_noise):
        groups.setdefault(causes[named[k].candidate.cause].family or str(k), []).append(k)
    return sorted(groups.values(), key=lambda group: group[0])


def _is_slow(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Return True if a cause is slow: half of its power or more remains in means over many samples."""
    candidate = hypothesis.candidate
    b = hypothesis.fit.coefficients[-candidate.size :]
    added = candidate.columns(slice(0, len(problem))) @ b
    return memory(problem, added).slow >= MIN_SLOW_FRACTION
