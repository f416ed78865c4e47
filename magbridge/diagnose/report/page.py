"""``report.html``: one file that a reader who was not there can follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path

import numpy as np

from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.report import figures, figures_of_causes
from magbridge.diagnose.report.decision import decision, gained, late
from magbridge.diagnose.report.found import found, overview
from magbridge.diagnose.report.limits import unknown, visible
from magbridge.diagnose.report.remaining import described, remaining
from magbridge.diagnose.report.words import bold, figure, listed, number

__all__ = ["report_html"]

STYLE = Path(__file__).with_name("style.css")
FOLDED = 3
"""Sections that are unfolded at once; the others wait for those who want to know more."""
LONG = 7200.0
"""s, from which on a length is told in hours."""


def report_html(diagnosis: Diagnosis, causes: Mapping[str, Cause], remarks: Sequence[str] = ()) -> str:
    """Return the page.

    Parameters
    ----------
    diagnosis : Diagnosis
        What is told.
    causes : mapping
        The table of causes that were asked about.
    remarks : sequence of str
        What a reader must know of the logs, each without its full stop.
    """
    title = f"Diagnosis of {escape(diagnosis.problem.survey.source)}"
    sections = {
        "Measured against simulated": _compared(diagnosis),
        "What was found, and why it is believed": found(diagnosis, causes),
        "What is left": remaining(diagnosis, causes),
        "What is not known": unknown(diagnosis, causes),
        "What this log could have shown at all": visible(diagnosis),
    }
    body = [f"<h1>{title}</h1>", *_verdict(diagnosis, remarks), _contents(list(sections))]
    for place, (head, parts) in enumerate(sections.items()):
        titled = [f'<h2 id="part{place}">{head}</h2>', *parts]
        if place >= FOLDED:
            titled = ["<details><summary>", titled[0], "</summary>", *parts, "</details>"]
        body += titled
    content = "\n".join(part for part in body if part)
    for unit in (" %", " nT", " UTC"):  # no line ends between a number and its unit
        content = content.replace(unit, f"\N{NO-BREAK SPACE}{unit[1:]}")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
        f"<style>\n{STYLE.read_text('utf-8')}</style></head><body>{content}</body></html>\n"
    )


def _contents(heads: Sequence[str]) -> str:
    """Return the page's contents in one line."""
    links = (f'<a href="#part{place}">{head}</a>' for place, head in enumerate(heads))
    return f'<p class="faint">Below: {" · ".join(links)}</p>'


def _verdict(diagnosis: Diagnosis, remarks: Sequence[str]) -> list[str]:
    """Say what was compared, the verdict, whether it is fit for use, and what a reader must know."""
    survey = diagnosis.problem.survey
    new = survey.time[~survey.learned]
    first, last = (datetime.fromtimestamp(float(t), UTC).strftime("%Y-%m-%d %H:%M") for t in new[[0, -1]])
    span = float(new[-1] - new[0])
    length = f"{span / 3600.0:.1f} h" if span > LONG else f"{span / 60.0:.0f} min"
    dives = f" in {survey.dives} dives" if survey.dives else ""
    beside = f", beside {int(survey.learned.sum())} that the calibration has learned from"
    return [
        (
            f'<p class="faint">{first} to {last} UTC ({length}) · {new.size} samples{dives}'
            f"{beside if survey.learned.any() else ''} · calibration by method "
            f"{escape(diagnosis.problem.calibration.method or 'unnamed')}, "
            f"{diagnosis.problem.calibration.coefficients.size} coefficients</p>"
        ),
        f'<p class="verdict">{_sentence(diagnosis)}</p>',
        decision(diagnosis.assessment),
        *(f"<p><b>Note:</b> {escape(remark)}.</p>" for remark in remarks),
        overview(diagnosis),
    ]


def _compared(diagnosis: Diagnosis) -> list[str]:
    """Show the difference between measured and simulated field in five figures."""
    parts = diagnosis.problem.survey.parts
    mended, nameless = bool(diagnosis.findings), diagnosis.verdict == "unexplained"
    after = (
        f"“After, held out” is the extended calibration on {parts} that its fit had not seen."
        if mended
        else "“Calibration refitted” lets the calibration's own numbers move within their uncertainty."
    )
    drawn = " The logs that the calibration has learned from are drawn, too."
    learned = drawn if diagnosis.problem.survey.learned.any() else ""
    flat = "A line that is not flat is an effect that the model lacks" + (
        "." if mended else ", unless it is flat once the calibration is refitted."
    )
    return [
        (
            "<p>The calibration describes what the vehicle's own magnetism and the sensor's errors do to "
            "every reading. Corrected by it, the measured total field should differ from the reference, "
            "the field that a model or a map gives for the place, by noise alone. Any other structure in the "
            "difference is something that the calibration does not describe.</p>"
        ),
        figure(
            figures.measured(diagnosis),
            "In time: does the difference stay about zero, within the grey band?",
            f"{after} Grey: what the calibration as given allows (noise, and its own uncertainty).{learned}",
        ),
        late(diagnosis.assessment.delays),
        '<div class="pair">',
        figure(
            figures.spectrum(diagnosis),
            "As a spectrum: at which periods is there more than noise?",
            "Where a line lies above the dashed one, the difference holds more than noise at that period.",
        ),
        figure(
            figures_of_causes.evidence(diagnosis),
            "By cause: what would explain it best, alone?",
            "Each cause tried by itself, with calibration and noise fitted anew. At the bar: the chance that "
            "noise alone looks so; below 0.01 it counts as detected."
            + " Blue: named in the end. A grey one explains the same, less well or less plausibly." * mended
            + " None is named: a description without a name explains it better." * nameless,
        ),
        "</div>",
        figure(
            figures.channels(diagnosis),
            "Against each channel: does the difference follow something?",
            "Mean (line) and scatter (bars) in twenty bins, for the channels that it follows most; the first "
            f"follow it most. {flat}",
        ),
        figure(
            figures.track(diagnosis),
            "Along the track: does the difference belong to a place?",
            "An error of the map looks the same on every pass at one depth.",
        ),
    ]


def _sentence(diagnosis: Diagnosis) -> str:
    total = diagnosis.total
    causes = [
        bold(one.candidate) + (f" <span class=faint>or {_others(one)}</span>" if one.rivals else "")
        for one in diagnosis.findings
    ]
    if diagnosis.wrong is not None:
        causes.append(f"<b>outliers</b> ({diagnosis.wrong.rows.size} wrong samples)")
    worth = (
        gained(total, diagnosis.problem.survey.parts)
        if diagnosis.findings
        else f"Without them, {number(total.before)} nT RMS; nothing is added to the calibration."
    )
    names = f"Found: {'; '.join(causes)}. {worth}"
    rest = diagnosis.unexplained
    withheld = rest.within if rest else ()
    left = diagnosis.assessment.residual
    nothing_else = (
        f"What is left, {number(left.rms)} nT RMS, fits no description of the list better than noise that "
        f"remembers {number(left.correlation_time, 2)} s."
    )
    louder = rest and all(rest.signal_to_noise > one.signal_to_noise for one in diagnosis.findings)
    name = (
        f"no name is asserted; it resembles {listed(withheld)}"
        if withheld
        else "none of the known causes explains it"
    )
    seen = f" {described(rest)}." if rest else ""
    return {
        "nothing_found": f"Nothing was found: {number(total.before)} nT RMS is consistent with noise "
        f"({number(float(np.std(diagnosis.fit.left)))} nT) and the calibration's stated uncertainty.",
        "explained": f"{names} {nothing_else}",
        "partly_explained": f"{names} {'Something stronger' if louder else 'Something else'} is left that no "
        "known cause explains."
        if rest
        else f"{names} {nothing_else}",
        "unexplained": f"The difference of {number(total.before)} nT RMS is more than noise, but {name}."
        f"{seen}",
    }[diagnosis.verdict]


def _others(finding: Finding) -> str:
    """Return the rivals of a cause, or how many there are."""
    return (
        listed(finding.rivals, " or ") if len(finding.rivals) < 3 else f"one of {len(finding.rivals)} others"
    )
