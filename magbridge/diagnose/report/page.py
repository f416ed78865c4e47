"""``report.html``: the verdict on the first screen, the details folded below it. Also writes the files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from html import escape
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import encode_calibration
from magbridge.diagnose.alternatives import CompetingHypothesis
from magbridge.diagnose.assessment import Assessment, Delays, Fitness
from magbridge.diagnose.causes import CAUSES, Cause
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.evidence import CONFOUNDED, Visible
from magbridge.diagnose.joint import Improvement
from magbridge.diagnose.leftover import Leftover
from magbridge.diagnose.observed import Memory, Seen
from magbridge.diagnose.report import figures
from magbridge.diagnose.report.findings import findings_json, parameters
from magbridge.diagnose.words import (
    MAX_UNFOLDED_NUMBERS,
    bold,
    chance,
    figure,
    goes_with,
    label,
    listed,
    measured,
    number,
    physics,
    row,
    sizes,
    table,
)
from magbridge.estimation.residual import rms
from magbridge.files import atomic_path, new_folder
from magbridge.wording import counted

__all__ = ["described", "improved", "late", "nameless", "remaining", "report_html", "visible", "write"]

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
REPORT_STYLE = Path(__file__).with_name("style.css")
MARKS: dict[Fitness, str] = {"yes": "good", "conditional": "doubt", "no": "none"}
"""How an answer is marked."""
MIN_HOURS_S = 7200.0
"""s, from which on a length is given in hours."""


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


def report_html(diagnosis: Diagnosis, causes: Mapping[str, Cause], remarks: Sequence[str] = ()) -> str:
    """Return the page.

    Parameters
    ----------
    diagnosis : Diagnosis
        Diagnosis to show.
    causes : mapping
        The table of causes that were asked about.
    remarks : sequence of str
        What a reader must know of the logs, each without its full stop.
    """
    title = f"Diagnosis of {escape(diagnosis.problem.survey.source)}"
    caption = (
        "Measured less reference, in time: "
        + ("as calibrated, and extended, each part left out of the fit." if diagnosis.findings else "as "
           "calibrated, and with the calibration's own numbers refitted.")
        + " Grey: what the calibration allows."
    )  # fmt: skip
    folded = {
        "Each cause: evidence and numbers": found(diagnosis, causes),
        "What is left": remaining(diagnosis, causes),
        "Against telemetry, in frequency, along the track": _compared(diagnosis),
        "What this log could have shown": visible(diagnosis),
    }
    body = [
        f"<h1>{title}</h1>",
        _log(diagnosis),
        f'<p class="verdict">{_sentence(diagnosis)}</p>',
        _fitness(diagnosis.assessment),
        *(f"<p><b>Note:</b> {escape(remark)}.</p>" for remark in remarks),
        _overview(diagnosis),
        figure(figures.measured(diagnosis), caption),
        late(diagnosis.assessment.delays),
        *(
            f"<details><summary><h2>{header}</h2></summary>{''.join(parts)}</details>"
            for header, parts in folded.items()
        ),
    ]
    content = "\n".join(part for part in body if part)
    for unit in (" %", " nT", " UTC"):  # no line ends between a number and its unit
        content = content.replace(unit, f"\N{NO-BREAK SPACE}{unit[1:]}")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
        f"<style>\n{REPORT_STYLE.read_text('utf-8')}</style></head><body><main>{content}</main></body></html>\n"
    )


def _log(diagnosis: Diagnosis) -> str:
    """Return the compared data as one line."""
    survey, calibration = diagnosis.problem.survey, diagnosis.problem.calibration
    new = survey.time[~survey.learned]
    first, last = (datetime.fromtimestamp(float(t), UTC).strftime("%Y-%m-%d %H:%M") for t in new[[0, -1]])
    span = float(new[-1] - new[0])
    length = f"{span / 3600.0:.1f} h" if span > MIN_HOURS_S else f"{span / 60.0:.0f} min"
    dives = f" in {np.unique(survey.dive[~survey.learned]).size} dives" * (survey.parts == "dives")
    training = f", beside {int(survey.learned.sum())} that the calibration was fitted to"
    return (
        f'<p class="faint">{first} to {last} UTC ({length}) · {new.size} samples{dives}'
        f"{training if survey.learned.any() else ''} · calibration by method "
        f"{escape(calibration.method or 'unnamed')}, {calibration.coefficients.size} coefficients</p>"
    )


def _sentence(diagnosis: Diagnosis) -> str:
    """Return the verdict: the causes, the improvement, and the unexplained part."""
    total, rest, residual = diagnosis.total, diagnosis.unexplained, diagnosis.assessment.residual
    before, stated = number(total.before), diagnosis.assessment.budget.predicted
    allowed = f" {before} nT are within the {number(stated)} nT that the calibration states for itself."
    allowed *= stated > total.before
    if diagnosis.verdict == "nothing_found":
        return (
            f"Nothing was found: {before} nT RMS is consistent with noise ({number(rms(diagnosis.residual))} "
            "nT) and the calibration's stated uncertainty."
        )
    if diagnosis.verdict == "unexplained" and rest:
        within = f"no name is asserted; it resembles {listed(rest.within)}"
        name = within if rest.within else "none of the known causes explains it"
        more = f"The difference of {before} nT RMS is more than noise"
        return f"{more}, but {name}. {described(rest, residual)}.{allowed}"
    names = [bold(one.candidate) + _or(one.competing[:2]) for one in diagnosis.findings]
    if diagnosis.wrong is not None:
        names.append(f"<b>outliers</b> ({diagnosis.wrong.rows.size} wrong samples)")
    worth = f"Without them, {before} nT RMS; nothing is added to the calibration."
    if diagnosis.findings:
        survey, refitted = diagnosis.problem.survey, number(diagnosis.over_refit.before)
        own = (survey.fitted & ~survey.learned).any()  # the calibration was fitted to the diagnosed log
        worth = (
            f"{improved(diagnosis.improvement, '' if own else survey.parts)} A refit of the calibration "
            f"alone leaves {refitted} nT.{_reference_part(diagnosis)}{allowed}"
        )
    louder = rest and all(rest.signal_to_noise > one.signal_to_noise for one in diagnosis.findings)
    other = f"Something {'stronger' if louder else 'else'} is left that no known cause explains."
    if not rest:
        remembers = f" that remembers {number(residual.correlation_time, 2)} s" * residual.lasts
        other = f"The remaining {number(residual.rms)} nT RMS look like noise{remembers}."
    start = "Nothing needs explaining: the causes found make next to no difference. "
    if rest and diagnosis.negligible:
        other = "What else is left has no name, and is as small."
    return f"{start * diagnosis.negligible}Found: {'; '.join(names)}. {worth} {other}"


def _reference_part(diagnosis: Diagnosis) -> str:
    """Return the RMS without the named errors of the reference; empty if none is named."""
    if all(candidate.about == "vehicle" for candidate in diagnosis.named):
        return ""
    left = number(diagnosis.total.after)
    return f" Without the named errors of the reference, {left} nT are left."


def _or(competing: Sequence[CompetingHypothesis]) -> str:
    return f" <span class=faint>or {listed(competing, ' or ')}</span>" * bool(competing)


def improved(improvement: Improvement, parts: str) -> str:
    """Return by how much the corrected field improves on held-out parts, or that it does not.

    `parts` names the held-out parts; it is empty if the calibration was fitted to the log itself.
    """
    low, high = improvement.interval
    where = f"On {parts} left out of the fit" if parts else "On the log that the calibration was fitted to"
    return (
        f"{where}, the error of the corrected field, {number(improvement.before)} nT RMS, became "
        f"{number(improvement.after)} nT (ratio {improvement.ratio:.2f}, 95 % interval {low:.2f} to "
        f"{high:.2f}{'' if improvement.shown else ': no improvement is shown'})."
    )


def _fitness(found: Assessment) -> str:
    """Return whether the extended calibration is fit for use, with the reasons, as a box."""
    mark = MARKS[found.fit_for_use]
    if found.reason in ("refused", "no_improvement", "refit_as_good"):
        mark = "bad"
    reasons = [*found.reasons_for, *found.reasons_against]
    items = "".join(f"<li>{escape(reason.text)}</li>" for reason in reasons)
    return (
        f'<div class="box {mark}"><p><b>Is the extended calibration fit for use?</b> {escape(_answer(found))}'
        f"</p>{f'<ul>{items}</ul>' if items else ''}</div>"
    )


def _answer(found: Assessment) -> str:
    """Return the answer in words."""
    word = {"yes": "Yes. ", "conditional": "", "no": "No. "}[found.fit_for_use]
    return word + found.summary


def _overview(diagnosis: Diagnosis) -> str:
    """Return a table with a row for each named cause; empty if there is none."""
    rows = [
        f'<tr><td>{bold(one.candidate)}<br><span class="faint">'
        f"{escape(diagnosis.causes[one.candidate.cause].meaning)}</span></td>"
        f"<td>{goes_with(one.follows(diagnosis.problem, diagnosis.fit)) or 'noise hides it'}</td>"
        f'<td class="n">{number(rms(one.field(diagnosis.problem)))} nT</td>'
        f'<td class="n">{one.signal_to_noise:.1f}</td>'
        f'<td class="n">× {1 / max(one.improvement.ratio, 1e-9):.2f}</td>'
        f"<td>{listed(one.competing)}</td></tr>"
        for one in diagnosis.findings
    ]
    heads = ("may be", "is seen to follow", "its field, RMS", "S/N", "held-out RMS without it", "or possibly")
    return table(heads, rows)


def late(found: Delays | None) -> str:
    """Return a warning if the axes look interpolated, a noise that no calibration can undo; else ''."""
    if found is None:
        return ""
    y, z = (f"{measured(x, s)} ± {measured(s, s)} s" for x, s in zip(found.later, found.sigma, strict=True))
    return (
        f"<p><b>Note:</b> The axes look sampled in turn and interpolated to each row: y {y} and z {z} later "
        f"than x. The {number(found.rms)} nT RMS that this causes is removed here; logging each axis' own "
        "time (mag_time_x, mag_time_y, mag_time_z) avoids it.</p>"
    )


def _compared(diagnosis: Diagnosis) -> list[str]:
    """Show the difference against telemetry, as a spectrum, and along the track."""
    return [
        figure(
            figures.channels(diagnosis),
            "Mean and scatter in twenty bins, for the series that the difference follows most: a line that "
            "is not flat is an effect that the model lacks.",
        ),
        figure(
            figures.spectrum(diagnosis),
            "Spectrum: where a line lies above the dashed one, there is more than noise.",
        ),
        figure(figures.track(diagnosis), "A map's error looks the same on every pass at one depth."),
    ]


def write(
    diagnosis: Diagnosis,
    out_dir: str | os.PathLike[str],
    causes: Mapping[str, Cause] = CAUSES,
    remarks: Sequence[str] = (),
) -> None:
    """Write ``findings.json``, ``calibration.json`` and ``report.html``: all three, or none.

    WriteError: one of them cannot be written; the previous files are unchanged.
    """
    contents = {
        "calibration.json": encode_calibration(diagnosis.calibration),
        "findings.json": findings_json(diagnosis, causes, remarks),
        "report.html": report_html(diagnosis, causes, remarks).encode(),
    }
    with new_folder(out_dir) as folder, ExitStack() as written:
        for name, content in contents.items():
            written.enter_context(atomic_path(folder / name)).write_bytes(content)
