"""The whole of a diagnosis: compare, search, extend, measure the gain, write it down."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from magbridge.calibration.file import save
from magbridge.calibration.model import Calibration
from magbridge.diagnose.candidates import Candidate
from magbridge.diagnose.causes import CAUSES, Cause
from magbridge.diagnose.extend import extend, settle, widened
from magbridge.diagnose.findings import findings_json
from magbridge.diagnose.gain import Gain, held_out, paired
from magbridge.diagnose.isolability import Isolability, isolability
from magbridge.diagnose.joint import Joint
from magbridge.diagnose.outliers import Outliers, outliers
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.search import Hypothesis, Outcome, Rival, search
from magbridge.diagnose.survey import take
from magbridge.diagnose.unexplained import Leftover, accept, leftover
from magbridge.diagnose.weigh import ODDS, REMNANT
from magbridge.errors import DataError
from magbridge.field.grid import AnomalyGrid
from magbridge.files import atomic_path

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Diagnosis", "diagnose"]

FloatArray = NDArray[np.float64]

LOUD = 2.0
"""Times what the calibration states of itself: noise half as loud again is still noise, of twice that something is wrong."""
ABSURD = 0.5
"""Of the field: when the corrected one is off by more, no cause of the table is looked for."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything that was found out.

    Attributes
    ----------
    problem : Problem
    outcome : Outcome
    named : tuple of Hypothesis
        The causes that stand; their rivals in `rivals`.
    rivals : tuple of tuple of Rival
    wrong : Outliers or None
        Isolated wrong samples.
    unexplained : Leftover or None
    calibration : Calibration
        Extended.
    fit : Joint
        At the extended calibration.
    before, after : (n,) array
        nT, residuals with the calibration as it was, and extended, held out.
    total : Gain
    gains : tuple of Gain
        Of each named cause beside the others.
    isolability : Isolability
    verdict : str
    """

    problem: Problem
    outcome: Outcome
    named: tuple[Hypothesis, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    wrong: Outliers | None
    unexplained: Leftover | None
    calibration: Calibration
    fit: Joint
    before: FloatArray
    after: FloatArray
    total: Gain
    gains: tuple[Gain, ...]
    isolability: Isolability
    verdict: str


def diagnose(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    out_dir: str | os.PathLike[str] | None = None,
    *,
    learned_from: Sequence[xr.Dataset] = (),
    grid: AnomalyGrid | None = None,
    causes: Mapping[str, Cause] = CAUSES,
    progress: Callable[[str], object] = str,
) -> Diagnosis:
    """Find what the forward model gets wrong in these deployments.

    Parameters
    ----------
    datasets : sequence of Dataset
        Deployments that the calibration has not seen.
    calibration : Calibration
    out_dir : path, optional
        Where ``findings.json``, ``calibration.json`` and ``report.html`` go; nothing is written if not given.
    learned_from : sequence of Dataset, optional
        The logs that the calibration was made from: what changed since then is seen against them.
    grid : AnomalyGrid, optional
        Added to the main field where a log has no ``reference_field``.
    causes : mapping, optional
        The table of causes.
    progress : callable, optional
        Told each step's name.

    Raises
    ------
    DataError
        The data do not allow it: one line that says which column is missing or too short.
    """
    # one thread: matrices this narrow only wait for each other, and sums keep one order on any machine
    with threadpool_limits(1, "blas"):
        diagnosis = _examine(datasets, calibration, learned_from, grid, causes, progress)
    if out_dir is not None:
        progress("writing the report")
        write(diagnosis, out_dir, causes)
    return diagnosis


def _examine(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    learned_from: Sequence[xr.Dataset],
    grid: AnomalyGrid | None,
    causes: Mapping[str, Cause],
    progress: Callable[[str], object],
) -> Diagnosis:
    progress("reading")
    survey = take(datasets, calibration, learned_from, grid)
    problem = pose(survey, calibration)
    off, field = float(np.median(np.abs(problem.residual))), float(np.median(survey.reference))
    if off > ABSURD * field:
        raise DataError(
            f"{survey.source}: the corrected field is off by {off:.0f} nT of {field:.0f}: mag_x, mag_y, mag_z or a "
            "parameter in other units than the calibration's, or of another vehicle"
        )
    progress("preparing causes")
    candidates = {name: cause.candidates(problem) for name, cause in causes.items()}
    untestable = {name: causes[name].needs for name, made in candidates.items() if not made}
    if len(untestable) == len(causes):
        needs = "; ".join(sorted(set(untestable.values())))
        raise DataError(f"{survey.source}: nothing can be tested here; it would take {needs}")
    flat = [candidate for made in candidates.values() for candidate in made]
    progress("searching")
    outcome = search(problem, flat, len(causes))
    progress("what is left")
    wrong = outliers(outcome.fit, len(causes))
    tones = [] if "interference_tone" in causes else CAUSES["interference_tone"].candidates(problem)
    tone = tones[0] if tones else None
    stand, rest = accept(problem, outcome, tone)
    named, rivals, fit = (outcome.chosen, outcome.rivals, outcome.fit) if stand else ((), (), outcome.null)
    model = [h.candidate for h in named]
    if wrong is not None and named and wrong.ratio < (REMNANT * max(h.signal_to_noise for h in named)) ** 2:
        wrong = None  # a few samples that the loudest cause's regressor has left
    progress("extending the calibration")
    settled, columns, fit = settle(problem, model, fit, outcome.order)
    fit = widened(model, fit)
    extended = extend(settled, model, fit) if model else calibration
    progress("measuring the gain")
    counts = ~survey.learned
    if wrong is not None:
        counts = counts.copy()
        counts[wrong.rows] = False
    counts = counts if counts.any() else ~counts
    before, after = problem.residual, problem.residual
    if model:
        after, score = held_out(settled, columns, fit)
        if score < held_out(problem, [], outcome.null).score - ODDS:
            # dives that were left out do without these names: they are no explanation
            named, rivals, model, fit, after, extended = (), (), [], outcome.null, before, calibration
            rest = leftover(problem, [], outcome.null, outcome.order, tone)
    rest = rest or _loud(problem, after, counts)
    gains = []
    for k in range(len(model)):
        others = [candidate.columns for i, candidate in enumerate(model) if i != k]
        # the others, the calibration and the noise are fitted anew; only the cause is missing
        without, _ = held_out(problem, others, _without(fit, model, k))
        gains.append(paired(without, after, survey.dive, counts))
    return Diagnosis(
        problem=problem, outcome=outcome, named=named, rivals=rivals, wrong=wrong, unexplained=rest,
        calibration=extended, fit=fit, before=before, after=after,
        total=paired(before, after, survey.dive, counts), gains=tuple(gains),
        isolability=isolability(flat, outcome.info, outcome.trials, len(causes), untestable),
        verdict=_verdict(named, wrong, rest),
    )  # fmt: skip


def write(
    diagnosis: Diagnosis, out_dir: str | os.PathLike[str], causes: Mapping[str, Cause] = CAUSES
) -> None:
    """Write ``findings.json``, ``calibration.json`` and ``report.html``, each whole or not at all."""
    from magbridge.diagnose.report import report_html  # noqa: PLC0415  (matplotlib only where a report is wanted)

    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    save(diagnosis.calibration, folder / "calibration.json")
    with atomic_path(folder / "findings.json") as beside:
        beside.write_bytes(findings_json(diagnosis, causes))
    with atomic_path(folder / "report.html") as beside:
        beside.write_text(report_html(diagnosis, causes), encoding="utf-8")


def _loud(problem: Problem, after: FloatArray, counts: NDArray[np.bool_]) -> Leftover | None:
    """Describe what has no structure, but is more than the calibration states of its noise and of its coefficients."""
    noise, free = problem.calibration.noise, problem.free
    variance = noise.sensor**2 + noise.reference**2 + (free * free).sum(axis=1)
    power = float(np.sum(after[counts] ** 2 / np.maximum(variance[counts], 1e-12)))
    n = int(counts.sum())
    if noise.sensor <= 0.0 or power < LOUD**2 * n:
        return None
    return Leftover("broadband", float(np.sqrt(power - n)), float(chi2.sf(power, n)), 0.0, None, None)


def _without(fit: Joint, model: Sequence[Candidate], k: int) -> Joint:
    """Return the fit with the k-th effect's coefficients taken out."""
    start = sum(candidate.size for candidate in model[:k])
    own = np.arange(start, start + model[k].size)
    return replace(
        fit, coefficients=np.delete(fit.coefficients, own), prior=np.delete(fit.prior, own + len(fit.z))
    )


def _verdict(named: Sequence[Hypothesis], wrong: Outliers | None, rest: Leftover | None) -> str:
    if named or wrong:
        return "partly_explained" if rest else "explained"
    return "unexplained" if rest else "nothing_found"
