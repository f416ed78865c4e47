"""The page's folded parts: each cause, the unexplained part, and the causes that such a log can show."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from html import escape
from math import isfinite
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.inference.isolability import CONFOUNDED, Visible
from magbridge.diagnose.report import figures
from magbridge.diagnose.report.findings import parameters
from magbridge.diagnose.seen import Memory, Seen
from magbridge.diagnose.unexplained.leftover import Leftover
from magbridge.diagnose.words import (
    MAX_UNFOLDED_NUMBERS,
    bold,
    chance,
    figure,
    goes_with,
    label,
    listed,
    number,
    physics,
    row,
    sizes,
    table,
)
from magbridge.estimation.residual import rms
from magbridge.wording import counted

__all__ = ["described", "found", "nameless", "remaining", "visible"]

KIND_SENTENCES = {
    "switching": "Something that switches or comes and goes",
    "drift": "A slow drift",
    "tone": "A tone",
    "transient": "A transient",
    "broadband": "Something broadband",
}
"""Descriptions of the unexplained part, as the subject of a sentence."""
MIN_WORSE_RATIO = 1.3
"""Multiple of the fitted residual from which the one held out is remarked on."""
MAX_SIMILAR_CAUSES = 4
"""Causes listed that look like one."""


def found(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Return the details of each cause, and of isolated outliers."""
    if not diagnosis.findings and diagnosis.wrong is None:
        return [f"<p>None of {len(causes)} causes is named.</p>"]
    parts = [figure(figures.terms(diagnosis), "What each cause adds, through what all others leave.")]
    for finding, notes in zip(diagnosis.findings, diagnosis.assessment.notes, strict=False):
        numbers = parameters(finding, len(diagnosis.problem))
        of = finding.candidate
        ratio, (low, high) = finding.improvement.ratio, finding.improvement.interval
        rows = (row(name, **one) for name, one in numbers.items())
        evidence = (
            f"<p>Signal-to-noise ratio {finding.signal_to_noise:.1f}; by noise alone with a chance of "
            f"{chance(finding.hypothesis.p_value)}; without it the held-out RMS is "
            f"{1 / max(ratio, 1e-9):.2f} times as large (95 %: {1 / max(high, 1e-9):.2f} to "
            f"{1 / max(low, 1e-9):.2f}).</p>"
        )
        parts += [
            f"<h3>{bold(of)}</h3>",
            f'<p class="faint">{physics(causes[of.cause])}</p>',
            evidence,
            _folded(table(("term", "value", "1 sigma", "unit"), rows), numbers),
            *(f"<p>{escape(note.text)}</p>" for note in notes),
        ]
    if diagnosis.wrong is not None:
        parts.append(_outliers(diagnosis.problem.survey.time[diagnosis.wrong.rows]))
    return parts


def _when(time: FloatArray) -> str:
    """Return the first of times (k,), s since 1970, as a clock shows them."""
    first = f"the first {MAX_UNFOLDED_NUMBERS} " if time.size > MAX_UNFOLDED_NUMBERS else ""
    shown = time[:MAX_UNFOLDED_NUMBERS].tolist()
    return f"{first}at {', '.join(f'{datetime.fromtimestamp(t, UTC):%H:%M:%S}' for t in shown)} UTC"


def _outliers(time: FloatArray) -> str:
    """Return how many samples are outliers, and when: `time` (k,) in s since 1970."""
    wrong = "1 isolated sample is wrong" if time.size == 1 else f"{time.size} isolated samples are wrong"
    return f"<h3><b>outliers</b></h3><p>{wrong}, {_when(time)}. No RMS before or after counts them.</p>"


def _folded(terms: str, numbers: Mapping[str, Mapping[str, Any]]) -> str:
    """Fold a table that is too long to be read line by line: its terms count together, few by themselves."""
    if len(numbers) <= MAX_UNFOLDED_NUMBERS:
        return terms
    clear = sum(abs(one["value"]) > 2.0 * one["sigma"] for one in numbers.values() if one["sigma"])
    return (
        f"<details><summary>{len(numbers)} terms, {clear} of them beyond 2 sigma</summary>{terms}</details>"
    )


def remaining(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Return the unexplained part: amplitude, time scale, the series that it follows, and its prediction."""
    rest, residual = diagnosis.unexplained, diagnosis.assessment.residual
    shifts = diagnosis.problem.survey.time[list(rest.shifts if rest else ())]
    budget, parts = diagnosis.assessment.budget, diagnosis.problem.survey.parts
    rows = {
        "predicted by the calibration as given: noise and its own uncertainty": budget.predicted,
        "with the calibration as given": budget.before,
        f"with its own coefficients refitted, on {parts} left out": budget.refitted,
        f"extended, without the named errors of the reference, on {parts} left out": budget.after,
        "left in the fit to the whole log": budget.fitted,
    }
    lines = (
        f'<tr><td>{name}</td><td class="n">{number(size)} nT</td></tr>'
        for name, size in rows.items()
        if size is not None
    )
    worse = (
        f"<p>Held-out parts are predicted {number((budget.after or 0.0) / budget.fitted, 2)} times worse "
        "than fitted ones: this log determines some of the new terms badly, or they act differently from "
        "part to part.</p>"
    )
    how = (
        f"<p>It is {number(residual.rms)} nT RMS, {number(residual.white)} nT from one sample to the next, "
        + f"remembers {number(residual.correlation_time, 2)} s, " * residual.lasts
        + f"{_goes(diagnosis.assessment.follows)}. "
        f"{_noise(diagnosis)}</p>"
    )
    return [
        f"<p>{described(rest, residual)}. {nameless(rest, causes)}</p>" if rest else "",
        f"<p>The level shifts at {counted(len(shifts), 'place')}, {_when(shifts)}.</p>" * bool(len(shifts)),
        how,
        table(("difference between measured and reference", "RMS"), lines),
        worse * ((budget.after or 0.0) > MIN_WORSE_RATIO * budget.fitted),
    ]


def _goes(what: Seen) -> str:
    """Return the series that the rest follows, and the axis along which it lies."""
    reported = goes_with(what, share=True)
    if what.channel:
        return f"and follows {reported}"
    nothing = "and no logged series explains a tenth of it"
    return f"lies {reported}, {nothing}" if reported else nothing


def nameless(rest: Leftover, causes: Mapping[str, Cause]) -> str:
    """Return why the rest has no name, and how to distinguish the possible causes."""
    if not rest.within:
        return "It fits no known cause, so it has no name."
    return (
        "No name is asserted: a description without a cause does as well. It resembles: "
        f"{listed(rest.within)}. To tell: {escape(causes[rest.within[0].candidate.cause].disambiguation)}."
    )


def described(rest: Leftover, residual: Memory) -> str:
    """Return the unexplained part, its size and duration, as a sentence without its full stop, as HTML."""
    goes = f"; best described by <code>{escape(rest.best_channel)}</code>" if rest.best_channel else ""
    period = f" of period {rest.period_s:.4g} s" if rest.period_s else ""
    size = f"signal-to-noise ratio {rest.signal_to_noise:.1f}"
    own = f"{number(rest.size)} nT RMS of its own, " if rest.size is not None else ""
    lasts = f", which last {number(residual.correlation_time, 2)} s" * residual.lasts
    all_of_it = f"{own}in all {number(residual.rms)} nT RMS{lasts}"
    return f"<b>{KIND_SENTENCES[rest.kind]}</b>{period} is left ({size}{goes}; {all_of_it})"


def _noise(diagnosis: Diagnosis) -> str:
    noise, slow = diagnosis.fit.noise, rms(diagnosis.problem.slow_noise(diagnosis.fit.z))
    tails = (
        "Gaussian" if noise.nu > 1e5 else f"with heavy tails (Student's t, {noise.nu:g} degrees of freedom)"
    )
    samples = len(noise.scale)
    correlation = (
        f"{samples} samples tell as much of a constant as {noise.independent:.0f} independent ones"
        if noise.independent < 0.95 * samples
        else "practically uncorrelated in time"
    )
    return (
        f"The noise model: {number(float(np.median(noise.scale)))} nT per sample, {tails}; {correlation}"
        f"{f'; also {number(slow)} nT RMS of slow noise, of power 1/f or so' if slow else ''}. "
        f"The calibration states {number(diagnosis.problem.calibration.noise.sensor)} nT."
    )


def visible(diagnosis: Diagnosis) -> list[str]:
    """Return how large each cause must be to be found in such a log, and which ones are similar to it."""
    report = diagnosis.isolability
    hidden = [one for one in report.visible if not any(isfinite(size) for size, _ in one.sizes.values())]
    rows = (
        f"<tr><td>{escape(label(one.cause, one.channel))}</td><td>{sizes(one.sizes)}</td>"
        f"<td>{_alike(diagnosis, one)}</td></tr>"
        for one in report.visible
        if one not in hidden
    )
    heads = ("cause", "smallest size found in 95 %", "looks like")
    unseen = "; ".join(escape(label(one.cause, one.channel)) for one in hidden)
    missing = "; ".join(f"{label(name, None)}: {escape(needs)}" for name, needs in report.untestable.items())
    basis = (
        "<p>From telemetry, attitude and noise alone. The true cause may be none of them, and beyond the "
        f"ranges that were flown nothing was measured. Likeness above {100 * CONFOUNDED:.0f} %: such causes "
        "are easily taken for each other.</p>"
    )
    track = diagnosis.assessment.returns
    return [
        basis,
        f"<p>{track.text}</p>" if track else "",
        table(heads, rows),
        f"<p>Not to be found at any plausible size: {unseen}.</p>" if unseen else "",
        f"<p>Not testable here, with the requirements: {missing}.</p>" if missing else "",
    ]


def _alike(diagnosis: Diagnosis, one: Visible) -> str:
    """List the causes that look most like `one`, the likest first."""
    alike = [(b if a is one else a, rho) for a, b, rho in diagnosis.isolability.pairs if one is a or one is b]
    few = [
        f"{escape(label(other.cause, other.channel))} {100 * rho:.0f} %"
        for other, rho in alike[:MAX_SIMILAR_CAUSES]
    ]
    return ", ".join(few) + (
        f", and {len(alike) - MAX_SIMILAR_CAUSES} more" if len(alike) > MAX_SIMILAR_CAUSES else ""
    )
