"""``report.html``: one file for someone who was not there."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from magbridge.diagnose.report import figures
from magbridge.diagnose.report.doubts import (
    grounded,
    implausible,
    in_motion,
    late,
    nameless,
    no_gain,
    outshone,
    rivalled,
    several,
)
from magbridge.diagnose.report.findings import parameters, told
from magbridge.diagnose.report.words import (
    MANY,
    chance,
    label,
    listed,
    measured,
    number,
    physics,
    plain,
    sizes,
)

if TYPE_CHECKING:
    from magbridge.diagnose.causes import Cause
    from magbridge.diagnose.diagnosis import Diagnosis
    from magbridge.diagnose.inference.search import Hypothesis

__all__ = ["report_html"]

STYLE = """
:root{color-scheme:light}body{font:15px/1.55 system-ui,sans-serif;color:#22303c;max-width:62rem;margin:2.5rem auto;padding:0 1.2rem}
h1{font-size:1.6rem;margin-bottom:.2rem}h2{font-size:1.15rem;margin-top:2.4rem;border-bottom:1px solid #dde2e6;padding-bottom:.3rem}
h3{font-size:1rem;margin-bottom:.2rem}figure{margin:1rem 0}img{max-width:100%}figcaption,.faint{color:#66727e;font-size:.88rem}
table{border-collapse:collapse;font-size:.9rem;margin:.6rem 0}td,th{padding:.22rem .8rem .22rem 0;text-align:left;border-bottom:1px solid #eceff1}
th{white-space:nowrap}td.n{text-align:right;font-variant-numeric:tabular-nums}.verdict{font-size:1.1rem;background:#f2f6f8;border-left:4px solid #1f6f8b;padding:.8rem 1.1rem}
.pair{display:flex;gap:1rem;flex-wrap:wrap;align-items:flex-start}.pair figure{flex:1 1 24rem}code{background:#f2f4f6;padding:0 .25em}
"""
KINDS = {
    "switching": "An offset that switches",
    "drift": "A slow drift",
    "tone": "A tone",
    "transient": "A transient",
    "broadband": "Something of no one frequency",
}
"""What is left, as a sentence's subject."""


def report_html(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> str:
    """Return the page."""
    survey = diagnosis.problem.survey
    first, last = (
        datetime.fromtimestamp(float(t), UTC).strftime("%Y-%m-%d %H:%M") for t in survey.time[[0, -1]]
    )
    body = [
        f"<h1>Diagnosis of {escape(survey.source)}</h1>",
        (f'<p class="faint">{first} to {last} UTC · {len(survey)} samples in {np.unique(survey.dive).size} {survey.parts} · '
        f"calibration: {escape(diagnosis.problem.calibration.method or 'unnamed')}, "
        f"{diagnosis.problem.calibration.coefficients.size} coefficients</p>"),
        f'<p class="verdict">{_verdict(diagnosis)}</p>',
        "<h2>Measured against simulated</h2>",
        ("<p>The calibration knows what the vehicle's own magnetism and the sensor's errors do to every reading. What is left "
         "after it has corrected them should be the Earth's field, and should differ from the reference by noise alone. "
         "Whatever else is in the difference is something that the calibration does not know.</p>"),
        late(diagnosis.problem, diagnosis.fit),
        _figure(figures.measured(diagnosis), "The total field as measured and corrected by the calibration, and as the "
                "reference says it should be; below, their difference"
                + (f" before, and with the extended calibration on {survey.parts} that its fit had not seen." if diagnosis.named else
                   ", and what is left of it when the calibration may move within its own uncertainty.")),
        '<div class="pair">',
        _figure(figures.spectrum(diagnosis), "Spectral density of the difference; dashed, the noise model."),
        _figure(figures.evidence(diagnosis), "The likeliest causes, each tried alone, with calibration and "
                "noise fitted anew. Below p = 0.01 a cause is found" + ("; blue: what was named in the end." if diagnosis.named else ".")),
        "</div>",
        _figure(figures.channels(diagnosis), "The difference against each channel: mean and scatter in twenty bins. A "
                "line that is not flat is something the simulation gets wrong."),
        _figure(figures.track(diagnosis), "The difference along the track: an error of the map looks the same on every pass."),
        "<h2>What was found, and why it is believed</h2>",
        *_found(diagnosis, causes),
        "<h2>What is left</h2>",
        _left(diagnosis, causes),
        "<h2>What this log could have shown at all</h2>",
        *_isolability(diagnosis),
    ]  # fmt: skip
    content = "\n".join(part for part in body if part)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Diagnosis of {escape(survey.source)}</title>'
        f"<style>{STYLE}</style></head><body>{content}</body></html>\n"
    )


def _figure(png: str | None, caption: str) -> str:
    if png is None:
        return ""
    return f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{png}"><figcaption>{caption}</figcaption></figure>'


def _name(hypothesis: Hypothesis) -> str:
    channel = hypothesis.candidate.channel
    return f"<b>{hypothesis.candidate.cause.replace('_', ' ')}</b>" + (
        f" ({escape(channel)})" if channel else ""
    )


def _verdict(diagnosis: Diagnosis) -> str:
    total = diagnosis.total
    causes = [
        _name(h) + (f" <span class=faint>or {listed(rivals)}</span>" if rivals else "")
        for h, rivals in zip(diagnosis.named, diagnosis.rivals, strict=True)
    ]
    if diagnosis.wrong is not None:
        causes.append(f"<b>outliers</b> ({diagnosis.wrong.rows.size} wrong samples)")
    gained = (
        f"On {diagnosis.problem.survey.parts} left out, {number(total.before)} nT RMS became {number(total.after)} nT (ratio {total.ratio:.2f}, 95 % interval "
        f"{total.interval[0]:.2f} to {total.interval[1]:.2f})."
    )
    withheld = diagnosis.unexplained.within if diagnosis.unexplained else ()
    name = (
        f"no name is asserted; not ruled out: {listed(withheld)}"
        if withheld
        else "none of the known causes explains it"
    )
    return {
        "nothing_found": f"Nothing was found: {number(total.before)} nT RMS cannot be told from noise ({number(float(np.std(diagnosis.fit.left)))} nT) "
        "and what the calibration states it may be off by.",
        "explained": f"Found: {', '.join(causes)}. {gained} Nothing else stands out of the noise.",
        "partly_explained": f"Found: {', '.join(causes)}. {gained} Something else is left that no cause explains.",
        "unexplained": f"Something is there ({number(total.before)} nT RMS), but {name}.",
    }[diagnosis.verdict]


def _found(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    if not diagnosis.named and diagnosis.wrong is None:
        if diagnosis.unexplained is not None:
            return ["<p>Something, but no name is asserted: see what is left.</p>"]
        return ["<p>No cause passes the test at a family-wise false-alarm rate of 1 %.</p>"]
    parts = [_figure(figures.terms(diagnosis), "What each cause adds to the total field.")]
    at = len(diagnosis.problem.centre)
    for hypothesis, rivals, gain in zip(diagnosis.named, diagnosis.rivals, diagnosis.gains, strict=True):
        candidate = hypothesis.candidate
        numbers = parameters(diagnosis, hypothesis, at)
        rows = "".join(
            f'<tr><td>{escape(name)}</td><td class="n">{measured(value["value"], value["sigma"])}</td>'
            f'<td class="n">{"± " + measured(value["sigma"], value["sigma"]) if value["sigma"] else ""}</td>'
            f"<td>{escape(value['unit'])}</td></tr>"
            for name, value in numbers.items()
        )
        start, at = at - len(diagnosis.problem.centre), at + candidate.size
        parts += [
            f"<h3>{_name(hypothesis)}</h3>",
            f'<p class="faint">{physics(causes[candidate.cause])}</p>',
            (
                f"<p>Signal-to-noise {hypothesis.signal_to_noise:.1f} with the calibration refitted; chance of a false alarm among "
                f"all that was tried {chance(hypothesis.p_value)}. Leaving it out multiplies the held-out RMS by {1 / max(gain.ratio, 1e-9):.2f} "
                f"(95 %: {1 / max(gain.interval[1], 1e-9):.2f} to {1 / max(gain.interval[0], 1e-9):.2f}).</p>"
            ),
            _folded(
                f"<table><tr><th>term</th><th>value</th><th>1 sigma</th><th>unit</th></tr>{rows}</table>",
                len(numbers),
            ),
            several(candidate.names),
            implausible(candidate, diagnosis.fit.coefficients[start : start + candidate.size]),
            in_motion(diagnosis, start, candidate),
            grounded(diagnosis, candidate),
            rivalled(causes[candidate.cause], rivals, told(diagnosis, hypothesis)),
            no_gain(gain),
            outshone(hypothesis, diagnosis.unexplained),
        ]
    if diagnosis.wrong is not None:
        rows_at = ", ".join(
            datetime.fromtimestamp(float(t), UTC).strftime("%H:%M:%S")
            for t in diagnosis.problem.survey.time[diagnosis.wrong.rows[:12]]
        )
        parts.append(
            f"<h3><b>outliers</b></h3><p>{diagnosis.wrong.rows.size} isolated samples are wrong, the first at {rows_at} UTC; "
            "they take no part in the figures above.</p>"
        )
    return parts


def _folded(table: str, size: int) -> str:
    """Fold a table that nobody reads line by line."""
    return table if size <= MANY else f"<details><summary>{size} terms</summary>{table}</details>"


def _left(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> str:
    rest, noise = diagnosis.unexplained, diagnosis.fit.noise
    tails = "Gaussian" if noise.nu > 1e5 else f"tails like Student's t with {noise.nu:g} degrees of freedom"
    samples = len(noise.scale)
    memory = (
        f"by its memory, {samples} samples say as much of a constant as {noise.independent:.0f} independent ones"
        if noise.independent < 0.95 * samples
        else "without memory that matters"
    )
    model = (
        f"The noise that remains: {number(float(np.median(noise.scale)))} nT a sample, {tails}; {memory}. The calibration stated "
        f"{number(diagnosis.problem.calibration.noise.sensor)} nT."
    )
    if rest is None:
        return f"<p>No structure is left that a slow curve, steps or a function of attitude would find. {model}</p>"
    goes = f", and goes best with <code>{escape(rest.best_channel)}</code>" if rest.best_channel else ""
    period = f" of period {rest.period_s:.4g} s" if rest.period_s else ""
    return f"<p><b>{KINDS[rest.kind]}</b>{period} is left, of signal-to-noise {rest.signal_to_noise:.1f}{goes}. {nameless(rest, causes)} {model}</p>"


def _isolability(diagnosis: Diagnosis) -> list[str]:
    report = diagnosis.isolability
    rows = "".join(
        f"<tr><td>{escape(label(v.cause, v.channel))}</td>"
        f'<td class="n">{v.half:.1f}</td><td class="n">{v.sure:.1f}</td>'
        f"<td>{sizes(v.sizes)}</td></tr>"
        for v in report.visible
    )
    pairs = "".join(
        f'<tr><td>{plain(a)}</td><td>{plain(b)}</td><td class="n">{100 * rho:.0f} %</td></tr>'
        for a, b, rho in report.pairs[:20]
    )
    missing = "; ".join(
        f"{name.replace('_', ' ')}: {escape(needs)}" for name, needs in report.untestable.items()
    )
    return [
        (
            '<p class="faint">From telemetry, attitude and noise alone: the size of each effect that would be found in 95 of 100 '
            "deployments like this one, and which causes look alike in it. Signal-to-noise (S/N) is the size of an effect's trace "
            "in the whole log, in units of the noise, after the calibration has taken all of it that it can imitate.</p>"
        ),
        f"<table><tr><th>cause</th><th>50 % at S/N</th><th>95 % at S/N</th><th>seen from</th></tr>{rows}</table>",
        f"<h3>Look alike</h3><table><tr><th>one</th><th>another</th><th>how alike</th></tr>{pairs}</table>"
        if pairs
        else "",
        f"<p>Not testable here, and what it would take: {missing}.</p>" if missing else "",
        _figure(
            figures.likeness(diagnosis),
            "How alike the signatures of two causes are in this log, calibration free.",
        ),
    ]
