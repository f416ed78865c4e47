"""``report.html``: one file that a reader who was not there can follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path

import numpy as np

from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.report import figures
from magbridge.diagnose.report.doubts import gained, late, nameless, unsettled, useful
from magbridge.diagnose.report.found import found, overview
from magbridge.diagnose.report.words import bold, figure, label, listed, number, sizes, table

__all__ = ["report_html"]

STYLE = Path(__file__).with_name("style.css")
KINDS = {
    "switching": "Something that switches or comes and goes",
    "drift": "A slow drift",
    "tone": "A tone",
    "transient": "A transient",
    "broadband": "Something broadband",
}
"""What is left, as the subject of a sentence."""


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
    body = [
        f"<h1>{title}</h1>",
        *_verdict(diagnosis, remarks),
        "<h2>Measured against simulated</h2>",
        *_compared(diagnosis),
        "<h2>What was found, and why it is believed</h2>",
        *found(diagnosis, causes),
        "<h2>What is left</h2>",
        _left(diagnosis, causes),
        "<h2>What this log could have shown at all</h2>",
        *_isolability(diagnosis),
    ]
    content = "\n".join(part for part in body if part)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>\n{STYLE.read_text('utf-8')}</style></head><body>{content}</body></html>\n"
    )


def _verdict(diagnosis: Diagnosis, remarks: Sequence[str]) -> list[str]:
    """Say what was compared, the verdict, and what a reader must know of both."""
    survey = diagnosis.problem.survey
    first, last = (
        datetime.fromtimestamp(float(t), UTC).strftime("%Y-%m-%d %H:%M") for t in survey.time[[0, -1]]
    )
    doubt = unsettled(diagnosis.problem, diagnosis.possible, diagnosis.calibration)
    dives = f" in {np.unique(survey.dive).size} dives" if survey.parts == "dives" else ""
    return [
        (
            f'<p class="faint">{first} to {last} UTC · {len(survey)} samples{dives} · '
            f"calibration by method {escape(diagnosis.problem.calibration.method or 'unnamed')}, "
            f"{diagnosis.problem.calibration.coefficients.size} coefficients</p>"
        ),
        f'<p class="verdict">{_sentence(diagnosis)}</p>',
        overview(diagnosis),
        *(f"<p><b>Note:</b> {escape(remark)}.</p>" for remark in remarks),
        f"<p><b>Note:</b> {doubt}.</p>" if doubt else "",
        useful(diagnosis),
    ]


def _compared(diagnosis: Diagnosis) -> list[str]:
    """Show the difference between measured and simulated field in five figures."""
    parts = diagnosis.problem.survey.parts
    sides = (
        f"before, and with the extended calibration on {parts} that its fit had not seen"
        if diagnosis.findings
        else "as calibrated, and with the calibration refitted within its own uncertainty"
    )
    lacks = "A line that is not flat is an effect that the model lacks" + (
        "." if diagnosis.findings else ", unless it is flat once the calibration is refitted."
    )
    return [
        (
            "<p>The calibration describes what the vehicle's own magnetism and the sensor's errors do to "
            "every reading. The corrected field should therefore differ from the reference by noise alone. "
            "Any other structure in the difference is an effect that the calibration does not describe.</p>"
        ),
        late(diagnosis.problem, diagnosis.fit),
        figure(
            figures.measured(diagnosis),
            f"The total field, measured and corrected, and the reference; below, their difference {sides}.",
        ),
        '<div class="pair">',
        figure(
            figures.spectrum(diagnosis),
            "Spectral density of the difference; dashed: the noise model.",
        ),
        figure(
            figures.evidence(diagnosis),
            "The likeliest causes, each tried alone with calibration and noise refitted. A cause is "
            "detected below p = 0.01" + ("; blue: named in the end." if diagnosis.findings else "."),
        ),
        "</div>",
        figure(
            figures.channels(diagnosis),
            "The difference against the channels that it follows most: mean and scatter in twenty bins. "
            + lacks,
        ),
        figure(
            figures.track(diagnosis),
            "The difference along the track. An error of the map looks the same on every pass at one depth.",
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
    names = f"Found: {'; '.join(causes)}. {gained(total, diagnosis.problem.survey.parts)}"
    rest = diagnosis.unexplained
    withheld = rest.within if rest else ()
    nothing_else = "Nothing else stands out of the noise."
    louder = rest and all(rest.signal_to_noise > one.signal_to_noise for one in diagnosis.findings)
    name = (
        f"no name is asserted; not ruled out: {listed(withheld)}"
        if withheld
        else "none of the known causes explains it"
    )
    return {
        "nothing_found": f"Nothing was found: {number(total.before)} nT RMS is consistent with noise "
        f"({number(float(np.std(diagnosis.fit.left)))} nT) and the calibration's stated uncertainty.",
        "explained": f"{names} {nothing_else}",
        "partly_explained": f"{names} {'Something stronger' if louder else 'Something else'} is left that no "
        "known cause explains."
        if rest
        else f"{names} {nothing_else}",
        "unexplained": f"The difference of {number(total.before)} nT RMS is more than noise, but {name}.",
    }[diagnosis.verdict]


def _others(finding: Finding) -> str:
    """Return the rivals of a cause, or how many there are."""
    return (
        listed(finding.rivals, " or ") if len(finding.rivals) < 3 else f"one of {len(finding.rivals)} others"
    )


def _left(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> str:
    rest, noise = diagnosis.unexplained, diagnosis.fit.noise
    tails = "Gaussian" if noise.nu > 1e5 else f"tails like Student's t with {noise.nu:g} degrees of freedom"
    samples = len(noise.scale)
    correlation = (
        f"correlated in time, so that {samples} samples determine a constant as well as "
        f"{noise.independent:.0f} independent ones would"
        if noise.independent < 0.95 * samples
        else "practically uncorrelated in time"
    )
    model = (
        f"The remaining noise: {number(float(np.median(noise.scale)))} nT per sample, {tails}; {correlation}."
        f" The calibration states {number(diagnosis.problem.calibration.noise.sensor)} nT."
    )
    if rest is None:
        return (
            "<p>No further structure was found: no slow curve, no steps, no function of attitude. "
            f"{model}</p>"
        )
    goes = f"; it follows <code>{escape(rest.best_channel)}</code> best" if rest.best_channel else ""
    period = f" of period {rest.period_s:.4g} s" if rest.period_s else ""
    return (
        f"<p><b>{KINDS[rest.kind]}</b>{period} is left, of signal-to-noise "
        f"{rest.signal_to_noise:.1f}{goes}. {nameless(rest, causes)} {model}</p>"
    )


def _isolability(diagnosis: Diagnosis) -> list[str]:
    report = diagnosis.isolability
    heads = ("cause", "S/N found in 50 %", "in 95 %", "smallest size found in 95 %")
    rows = (
        f"<tr><td>{escape(label(v.cause, v.channel))}</td>"
        f'<td class="n">{v.half:.1f}</td><td class="n">{v.sure:.1f}</td>'
        f"<td>{sizes(v.sizes)}</td></tr>"
        for v in report.visible
    )
    pairs = (
        f"<tr><td>{escape(label(a.cause, a.channel))}</td><td>{escape(label(b.cause, b.channel))}</td>"
        f'<td class="n">{100 * rho:.0f} %</td></tr>'
        for a, b, rho in report.pairs[:20]
    )
    missing = "; ".join(
        f"{name.replace('_', ' ')}: {escape(needs)}" for name, needs in report.untestable.items()
    )
    return [
        (
            '<p class="faint">Computed from telemetry, attitude and noise alone: how large each effect must '
            "be to be found in 95 of 100 deployments like this one, and which causes look alike in it. "
            "Signal-to-noise (S/N) is the size of an effect over the whole log, in units of the noise, less "
            "the part that the calibration can imitate. A cause that the log hardly excites, as a delay "
            "while no mass moves, does not reach it at any plausible size (at most 50 times the usual "
            "one).</p>"
        ),
        table(heads, rows),
        "<h3>Causes that look alike</h3>" * bool(report.pairs),
        table(("one", "another", "correlation"), pairs),
        f"<p>Not testable in this log, with what it would take: {missing}.</p>" if missing else "",
        figure(
            figures.likeness(diagnosis),
            "Correlation of the signatures of two causes in this log, with the calibration free.",
        ),
    ]
